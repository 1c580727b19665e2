"""A recorded run with all that identification needs, read from a tdhil log or from a trace in CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ContextDecorator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.errors import ExitCode, LogError, MessageCode, NothingRecoverable, TdhilError, UsageError
from tdhil.file_kind import MAGIC, begins_like_log, require_log_kind

if TYPE_CHECKING:
    import pandas
    import xarray

    from tdhil.recording import FloatArray, LagPrior, Recording, RunEnd

_REPEATED = frozenset(ExitCode) - {ExitCode.INTERNAL, ExitCode.INTERRUPTED, ExitCode.TERMINATED}
"""Exit codes that describe the run itself. The others describe its process."""

_UNITS = {"time_s": "s", "speed_rad_s": "rad/s", "torque_nm": "N m", "fresh": "1", "limited": "1"}
_LONG_NAMES = {
    "time_s": "control time of the SYNC", "speed_rad_s": "reported speed of the motor shaft",
    "torque_nm": "reported torque of the motor shaft", "fresh": "this cycle brought new feedback",
    "limited": "an internal limit of the drive was active",
}


@dataclass(frozen=True)
class RunRecord:
    """One run or one trace. ``configuration``: that of the run, as in its log; ``log``: the file.

    ``assumed``: assumptions in reading a foreign trace, None for the log of a run; ``problems``: parts of the file that
    were skipped, one line each; ``stored_result``: the result document that the run itself wrote to its log;
    ``virtual_string``: one row per cycle, with the columns of `tdhil.recording.VIRTUAL_COLUMNS`.
    """

    recording: Recording
    configuration: Mapping[str, Any]
    log: str
    assumed: tuple[str, ...] | None = None
    problems: tuple[str, ...] = ()
    ended: RunEnd | None = None
    stored_result: Mapping[str, Any] | None = None
    virtual_string: FloatArray | None = None

    @property
    def whole(self) -> bool:
        """Return whether the run reached its end and the log holds all of it."""
        from tdhil.recording import aborted_stage

        return self.recording.complete and aborted_stage(self.recording) is None

    @property
    def partial(self) -> bool:
        """Return whether this is a log without its end, of a run or of a trace. A trace in CSV has no end."""
        return not self.whole and (self.assumed is None or "trace" in self.configuration)

    def asked(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Return the configuration, with other settings of identification."""
        own = {**self.configuration.get("identify", {}), **asked}
        return {**self.configuration, "identify": own} if asked else dict(self.configuration)

    def with_said(self, said: Mapping[str, str]) -> RunRecord:
        """Return the same record with another operator or note."""
        return replace(self, configuration={**self.configuration, **said})

    def require_motion(self) -> None:
        """Raise NothingRecorded if the run was refused or ended in setup. The error repeats the cause of the run's end.

        It has that run's exit code, except for codes that describe a process and not a run. Raises NothingRecoverable
        for a log that was cut off before its first sample.
        """
        from tdhil.errors import NothingRecorded, NothingRecoverable

        ended, stages = self.ended, self.recording.stages
        if ended is None and not self.recording.complete and not len(self.recording.time_s):
            raise NothingRecoverable("the log was cut off before its first sample", where=self.log,
                                     next_step="Look for an older copy, or run again")
        if ended is None or (len(self.recording.time_s) and any(stage.name != "setup" for stage in stages)):
            return
        in_stage = f"in stage {stages[-1].name}" if stages else "before its first stage"
        raise NothingRecorded(
            f"the run in this log ended {in_stage}, with nothing to identify from: {ended.message}",
            ended.exit_code if ended.exit_code in _REPEATED else ExitCode.PARTIAL,
            where=self.log, next_step=ended.next_step,
        )

    def to_pandas(self) -> pandas.DataFrame:
        """Return the samples, one row per cycle, indexed by ``time_s``; units in ``attrs`` (extra `notebook`)."""
        frame = _extra("pandas").DataFrame(self._columns()).set_index("time_s")
        frame.attrs = {"units": dict(_UNITS), "log": self.log, "simulated": self.recording.simulated}
        return frame

    def to_xarray(self) -> xarray.Dataset:
        """Return the samples along ``time_s``, each with its unit and long name (extra `notebook`)."""
        library = _extra("xarray")
        columns = self._columns()
        time_s = columns.pop("time_s")
        described = {name: {"units": _UNITS[name], "long_name": _LONG_NAMES[name]} for name in _UNITS}
        data: xarray.Dataset = library.Dataset(
            {name: ("time_s", values, described[name]) for name, values in columns.items()},
            coords={"time_s": ("time_s", time_s, described["time_s"])},
            attrs={"log": self.log, "gear_ratio": self.recording.gear_ratio,
                   "simulated": int(self.recording.simulated)},
        )
        return data

    def __len__(self) -> int:
        return len(self.recording.time_s)

    def __repr__(self) -> str:
        recording = self.recording
        time_s = recording.time_s
        lasted = f", {time_s[-1] - time_s[0]:.0f} s" if len(time_s) else ""
        kind = f", {recording.excitation.kind}" if recording.excitation is not None else ""
        return f"<{'SIMULATED ' if recording.simulated else ''}run {self.log}: {len(self)} samples{lasted}{kind}>"

    def _columns(self) -> dict[str, Any]:
        return {name: getattr(self.recording, name) for name in _UNITS}


class ByKeyword(ContextDecorator):
    """Make errors name options by their Python keywords. Use it as a decorator or as a context."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, TdhilError):
            from tdhil.buses import keys_by_flag
            from tdhil.config import OF_A_TRACE, OPTIONS

            of_buses = {flag: key.rpartition(".")[2] for flag, key in keys_by_flag().items()}
            error.spelling = of_buses | {option.flag: option.keyword for option in (*OF_A_TRACE, *OPTIONS)}


@ByKeyword()
def read(
    path: str | Path,
    *,
    columns: Sequence[str] | None = None,
    excitation: str | Path | Mapping[str, Any] | None = None,
    rated_torque_nm: float | None = None,
    torque_limit_nm: float | None = None,
    gear_ratio: float | None = None,
    torque_scale_rel_sd: float | None = None,
    lags: LagPrior | None = None,
    skew_sd_s: float | None = None,
) -> RunRecord:
    """Read a run.mcap, whole or cut short, or a trace in CSV; the options are those of ``tdhil replay`` for a trace.

    ``columns``: such as ``["time=t_s", "speed=n_rpm:rpm", "torque=m_pct:%"]``; ``excitation``: an
    excitation.yaml, or its content;
    ``skew_sd_s``: time offset between speed and torque, s (1 sd). A tdhil log contains all of this.
    Raises LogError (no tdhil data in the file), DataFileError (with the line) and UsageError.
    """
    path = Path(path)
    require_file(path)
    if is_log(path):
        of_trace = {
            "columns": columns, "excitation": excitation, "rated_torque_nm": rated_torque_nm, "lags": lags,
            "torque_limit_nm": torque_limit_nm, "gear_ratio": gear_ratio, "torque_scale_rel_sd": torque_scale_rel_sd,
            "skew_sd_s": skew_sd_s,
        }
        for name, value in of_trace.items():
            if value is not None:
                raise UsageError("is for a trace in CSV; this log contains its own", where=name,
                                 entry=MessageCode.OPTION_FOR_CSV_ONLY)
        return _read_log(path)
    require_log_kind(path, "run.mcap", trace=True)
    from tdhil.config import ASKED_AGAIN
    from tdhil.recording import USUAL, Bench, LagPrior, parse_columns, read_recording
    from tdhil.session.task import ASSUMED_TORQUE_SCALE_REL_SD

    scale = torque_scale_rel_sd
    bench = Bench(
        rated_torque_nm=rated_torque_nm,
        torque_limit_nm=torque_limit_nm,
        torque_scale_rel_sd=ASSUMED_TORQUE_SCALE_REL_SD if scale is None else scale,
        gear_ratio=1.0 if gear_ratio is None else gear_ratio,
        lag_prior=LagPrior() if lags is None else lags,
        skew_sd_s=skew_sd_s,
    )
    choices = USUAL if columns is None else parse_columns(list(columns))
    motion = Path(excitation) if isinstance(excitation, str) else excitation
    recording, assumed = read_recording(path, choices, motion, bench)
    if scale is None:
        share = f"{100 * ASSUMED_TORQUE_SCALE_REL_SD:.0f} %"
        assumed = (*assumed, f"standard uncertainty of the torque scale, assumed: {share}")
    return RunRecord(recording, {"identify": {one.name: one.default for one in ASKED_AGAIN}}, str(path), assumed)


def trace_arguments(given: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the keywords of `read` for a trace. ``given``: values of `tdhil.config.OF_A_TRACE` by name, None without
    one; ``source``: of the stated lags, as text. Raises UsageError for a motion that is not complete.
    """
    from tdhil.config import OF_A_TRACE
    from tdhil.recording import motion_of
    from tdhil.session.task import stated_lags

    lags = ("speed_lag_s", "speed_lag_sd_s", "torque_lag_s", "torque_lag_sd_s")
    motion, wrong = motion_of(given)
    if wrong:
        flags = {one.name: one.flag for one in OF_A_TRACE}
        raise UsageError("; ".join(f"{flags[name]}: {text}" for name, text in wrong), where="the motion of the trace",
                         entry=MessageCode.VALUE_NOT_ALLOWED)
    found = {one.name: given.get(one.name) for one in OF_A_TRACE
             if one.name not in lags and not one.name.startswith("motion_")}
    found["excitation"] = motion or found["excitation"]
    speed_s, speed_sd_s, torque_s, torque_sd_s = (given.get(name) for name in lags)
    return {**found, "lags": stated_lags(speed_s, speed_sd_s, torque_s, torque_sd_s, source)}


def check_lags(given: Mapping[str, Any]) -> None:
    """Raise UsageError for the standard deviation of a lag without the lag; ``given`` as in `trace_arguments`."""
    from tdhil.config import OF_A_TRACE

    flags = {one.name: one.flag for one in OF_A_TRACE}
    for lag in ("speed_lag_s", "torque_lag_s"):
        sd = lag.replace("_lag_", "_lag_sd_")
        if given.get(lag) is None and given.get(sd) is not None:
            raise UsageError(f"needs {flags[lag]}, the value of this standard deviation", where=flags[sd])


def require_file(path: Path) -> None:
    """Raise UsageError if the file does not exist or is a folder."""
    if path.is_dir():
        raise UsageError("is a folder", where=str(path),
                         next_step=f"Name one log in it, or identify all of them: tdhil fleet {path} --out fleet.csv",
                         entry=MessageCode.FILE_NOT_FOUND)
    if not path.is_file():
        raise UsageError("this log does not exist", where=str(path),
                         next_step="Name a run.mcap of tdhil, or a trace in CSV", entry=MessageCode.FILE_NOT_FOUND)


def is_log(path: Path) -> bool:
    """Recognise MCAP by its first bytes, also in a file that holds only some of them. Raises NothingRecoverable."""
    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC))
    except OSError as error:
        raise NothingRecoverable(f"can't be read ({error.strerror or error})", where=str(path)) from error
    return begins_like_log(head)


def _read_log(path: Path) -> RunRecord:
    from tdhil.recording import find_ended, read_run

    try:
        found = read_run(path)
    except LogError as error:
        raise NothingRecoverable(error.what, where=error.where, next_step=error.next_step) from error
    ended = find_ended(found.configuration, found.events)
    configuration: dict[str, Any] = found.configuration | ({} if ended is None else {"ended": asdict(ended)})
    if "started" not in configuration and found.epoch_ns:      # a log from before 0.2, of a run in real time
        began = datetime.fromtimestamp(found.epoch_ns / 1e9, UTC).astimezone()
        configuration["started"] = began.isoformat(timespec="seconds")
    # The assumptions in a log that was made from a trace; the log of a run has none. A log is not trusted.
    trace = configuration.get("trace")
    listed = trace.get("assumed") if isinstance(trace, Mapping) else None
    assumed = tuple(str(one)[:500] for one in listed[:100]) if isinstance(listed, list) else None
    return RunRecord(found.recording, configuration, str(path), assumed, found.problems, ended, found.result,
                     found.virtual_string)


def write_as_log(record: RunRecord, path: Path, run: Mapping[str, Any]) -> None:
    """Write the record of a trace as a log of tdhil to ``path``, a new file. ``run``: more of its configuration.

    Raises LogError without disk space, or if the file can't be written.
    """
    from tdhil.recording import write_trace_log

    trace = {**run.get("trace", {}), "assumed": list(record.assumed or ())}
    write_trace_log(path, record.recording, {**record.configuration, **run, "trace": trace})


def _extra(name: str) -> Any:
    """Import a library of the extra `notebook`. Raises UsageError with the command that installs it."""
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError as error:
        raise UsageError(f"{name} is not installed", next_step="Install it with: pip install '.[notebook]'",
                         entry=MessageCode.PACKAGE_MISSING) from error
