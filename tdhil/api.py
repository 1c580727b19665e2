"""The Python API: read, identify, open_drive, simulate, run. The command line uses the same functions.

::

    recording = tdhil.read("run.mcap")
    result = tdhil.identify(recording)
    result.inertia.value, result.to_dict()

    with tdhil.simulate(seed=7) as drive:
        recording = tdhil.run(drive, tdhil.Multisine())

All functions raise `tdhil.TdhilError` or a subclass, with what happened, where, and what to do next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.config import (
    DEFAULT_BUS,
    OF_THE_RESULT,
    OF_THE_RUN,
    OF_THE_SIMULATOR,
    OPTION,
    Overrides,
    RunDetails,
    values_of,
    with_keywords,
)
from tdhil.runner import StopRequest
from tdhil.session import ByKeyword, RunRecord, read

if TYPE_CHECKING:
    from tdhil.buses import Connection, PeerPlan
    from tdhil.config import Rig, RunOptions
    from tdhil.errors import ExitCode
    from tdhil.estimation import FrequencyResponse, Identification, InertiaEstimate, Verdict
    from tdhil.recording import LiveInertia
    from tdhil.session import OperatorInterface, RunRequest

__all__ = [
    "CoastDown", "DriveHandle", "Motion", "Multisine", "Pulses", "Result", "RunRecord", "Sine", "Step", "StopRequest",
    "identify", "open_drive", "read", "run", "simulate",
]


# ---------------------------------------------------------------------------------------------------------------------
# Motions of stage 5


@dataclass(frozen=True)
class Motion:
    """Request for stage 5: any excitation of `tdhil.config.registry`, by name. None: chosen to fit the rig.

    The classes below are part of tdhil. ``amplitude_rad_s``: greatest deviation of the speed from its mean;
    ``offset_rad_s``: mean speed; ``periods``: number at each mean speed, or number of ways up and down.
    """

    kind: str
    frequency_hz: float | None = None
    amplitude_rad_s: float | None = None
    offset_rad_s: float | None = None
    periods: int | None = None


@dataclass(frozen=True)
class Multisine(Motion):
    """Several tones at once, with a low crest factor: the default. None: chosen to fit the rig.

    ``frequency_hz``: lowest excited frequency; ``amplitude_rad_s``: amplitude about the mean speed; ``offset_rad_s``:
    mean speed; ``periods``: number at each mean speed, including those for settling.
    """

    kind: str = field(default="multisine", init=False)


@dataclass(frozen=True)
class Sine(Multisine):
    """One tone (equation 8 of the paper)."""

    kind: str = field(default="sine", init=False)


@dataclass(frozen=True)
class Step(Multisine):
    """A square wave of speed (equation 9 of the paper)."""

    kind: str = field(default="step", init=False)


@dataclass(frozen=True)
class Pulses(Motion):
    """Torque pulses between steady speeds, without spectral lines and without a period."""

    kind: str = field(default="pulses", init=False)
    frequency_hz: None = field(default=None, init=False)


@dataclass(frozen=True)
class CoastDown(Pulses):
    """Coast-down without torque from one speed to another, and acceleration back. Never with a drill string."""

    kind: str = field(default="coast-down", init=False)


# ---------------------------------------------------------------------------------------------------------------------
# Identification


@dataclass(frozen=True)
class Result:
    """The identification of one recording. It is displayed as the card in a terminal and in a notebook.

    ``exit_code``: exit code of ``tdhil replay`` for a whole run; 0 if J can be quoted, 9 if not.
    """

    identification: Identification
    document: Mapping[str, Any]
    exit_code: ExitCode
    record: RunRecord = field(repr=False)

    @property
    def inertia(self) -> InertiaEstimate | None:
        """Return J at the motor shaft, kg·m², with both intervals; None if it is not identifiable, see `reason`."""
        return self.identification.inertia

    @property
    def verdict(self) -> Verdict:
        """Return whether the result is valid."""
        return self.identification.verdict

    @property
    def reason(self) -> str:
        """Return the reason for the verdict, in words."""
        return self.identification.reason

    @property
    def frf(self) -> FrequencyResponse | None:
        """Return the frequency response ω/T at every excited frequency; None without a periodic excitation.

        ``frf.to_frd()`` is for ``control.FRD``, ``frf.to_xarray()`` for a notebook.
        """
        return self.identification.frequency_response

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON document of ``tdhil identify --json``, without any change."""
        return dict(self.document)

    def save_report(self, path: str | Path, letterhead: str | Path | None = None) -> Path:
        """Write the report, HTML or PDF by its name, and return its path. Raises UsageError (extra `report`).

        ``letterhead``: a letterhead.yaml with company, address and logo, as for ``--letterhead``.
        """
        from tdhil.report import check_report_path, load_letterhead, write_report

        check_report_path(Path(path), Path(self.record.log), where="save_report")
        return write_report(self.document, self.record.recording, Path(path),
                            load_letterhead(None if letterhead is None else Path(letterhead)))

    def __repr__(self) -> str:
        from tdhil.report import inertia_text

        said = self.document["inertia_kg_m2"]
        simulated = "SIMULATED " if self.document["simulated"] else ""
        return f"<{simulated}{self.verdict.value}" + (f": {inertia_text(said, '_total')}" if said else "") + (
            f", {self.document['log']}>")

    def __str__(self) -> str:
        from tdhil.report import card_text

        return card_text(self.document)

    def _repr_html_(self) -> str:
        from tdhil.report import card_html

        return card_html(self.document)


@with_keywords(OF_THE_RESULT)
@ByKeyword()
def identify(recorded: RunRecord, **options: Any) -> Result:
    """Identify J and all other results from a recording. The results have the same digits as ``tdhil replay``.

    ``options``: ``model`` of the shaft, ``confidence`` of the intervals, ``tolerance``: the largest relative
    half-width for ``valid``; the page on rig.yaml describes them. None: the value of the run. Raises UsageError for
    impossible values, and NothingRecorded if the run ended before any motion.
    """
    from tdhil.session import conclude

    recorded.require_motion()
    configuration = recorded.asked(values_of(OF_THE_RESULT, options, "tdhil.identify"))
    found = conclude(recorded.recording, configuration, recorded.log, recorded.assumed)
    return Result(found.identification, found.document, found.exit_code, recorded)


# ---------------------------------------------------------------------------------------------------------------------
# Motion


@dataclass(frozen=True)
class DriveHandle:
    """A drive, its bus and its rig. No connection is open: each `run` opens one, and closes it at standstill."""

    rig: Rig | None
    options: Mapping[str, Any]
    faults: tuple[str, ...] = ()


@contextmanager
def open_drive(rig: str | Path, **options: Any) -> Iterator[DriveHandle]:
    """Yield the drive of a rig.yaml. ``options``: options of the command line by their names in rig.yaml, such as
    ``interface``, ``channel``, ``node``, ``host``, ``unit``, ``profile``, ``rate_hz``.

    Raises DataFileError with every problem and its line, and UsageError for impossible options.
    """
    from tdhil.config import load_rig

    handle = DriveHandle(load_rig(Path(rig)), dict(options))
    with ByKeyword():
        _peer(handle, {})
    yield handle


@with_keywords(OF_THE_SIMULATOR)
@contextmanager
def simulate(*, rig: str | Path | None = None, **options: Any) -> Iterator[DriveHandle]:
    """Yield the embedded simulated drive and rig: in stepped time unless ``real_time``, CANopen unless ``drive``.

    ``options``: options of the drive and of the simulated rig, such as ``seed``, ``plant`` (a plant.yaml) and
    ``faults`` (a list, as for ``--fault``); the page on rig.yaml describes them.
    """
    from tdhil.config import load_rig

    given = {"drive": DEFAULT_BUS, **values_of(OF_THE_SIMULATOR, options, "tdhil.simulate"), "simulate": True}
    handle = DriveHandle(None if rig is None else load_rig(Path(rig)), given, RunDetails.of(given).faults)
    with ByKeyword():
        _peer(handle, {})
    yield handle


@with_keywords(OF_THE_RUN)
@ByKeyword()
def run(
    drive: DriveHandle,
    motion: Motion | None = None,
    *,
    confirm: Callable[[str], bool] | None = None,
    stop: StopRequest | None = None,
    on_inertia: Callable[[LiveInertia], object] | None = None,
    **options: Any,
) -> RunRecord:
    """Run the five stages and the stop, and return the recording. Then the log is closed and the shaft at standstill.

    ``confirm`` is called once before a real shaft moves, with a description of the motion. Only True confirms. None:
    the operator types it at the terminal; without a terminal, the run is refused. A simulated drive needs none.
    ``options``: those of motion, result, control loop, overrides and log, such as ``log``, ``mode``, ``tolerance``,
    ``max_time_s``, ``operator``, ``note``, ``no_watchdog``; ``help(tdhil.run)`` lists them, the page on rig.yaml
    describes them. ``on_inertia`` is called after periods of the excitation with the present J, in a separate thread:
    ``inertia_kg_m2``, ``low_kg_m2``, ``high_kg_m2``, ``p_value`` and more. The coverage of each interval holds for
    that interval alone. A stop at the first narrow interval lowers the coverage; ``tolerance`` accounts for this.
    In the main thread, Ctrl-C is a stop, as on the command line. In another thread, signals are not handled: pass a
    ``stop`` and call its ``ask()``.

    Raises the error that ended the run, with the log's name as a note, after the stop of the shaft. Raises
    StopNotConfirmed if standstill was not confirmed: use the hard-wired emergency stop then.
    """
    from tdhil.runner import not_confirmed
    from tdhil.session import RunRequest, RunSession

    motion = motion or Multisine()
    asked = {"excitation" if name == "kind" else name: value for name, value in asdict(motion).items()}
    asked |= {"log": OPTION["log"].default, **values_of(OF_THE_RUN, options, "tdhil.run")}
    details = RunDetails.of(asked)
    chosen, connection, peer = _peer(drive, {name: one for name, one in asked.items() if one is not None})
    request = RunRequest.of(chosen, connection, peer, drive.rig, overrides=Overrides.of(asked),
                            stated=details.texts(),
                            real_time_priority=bool(details.real_time_priority), expect=details.expect)
    session = RunSession(request, _operator_interface(request, confirm, on_inertia))
    try:
        outcome = session.move(stop)
    except BaseException:
        session.abandon()
        raise
    recording, configuration = session.log.recording(complete=True), session.log.run
    cause = outcome.cause
    if cause is not None:
        cause.add_note(f"log: {session.path}")
        session.abandon()
    else:
        session.close()
    if outcome.stop is not None and not outcome.stop.confirmed:
        raise not_confirmed(outcome.stop) from cause       # the most serious error, so it takes precedence
    if cause is not None:
        raise cause
    return RunRecord(recording, configuration, str(session.path))


def _peer(drive: DriveHandle, asked: Mapping[str, Any]) -> tuple[RunOptions, Connection, PeerPlan]:
    """Return options, connection and drive of a run, all checked. Raises UsageError and DataFileError."""
    from tdhil.config import resolve
    from tdhil.session import check_log_path, check_unverified, connection_of, plan_peer, with_faults

    cli = {**drive.options, **asked}
    options, connection = connection_of(cli, drive.rig, resolve(cli, drive.rig))
    check_unverified(connection.profile, options)
    check_log_path(Path(options.log), "log")
    return options, connection, with_faults(plan_peer(options, connection), drive.faults, connection.drive)


def _operator_interface(
    request: RunRequest, confirm: Callable[[str], bool] | None, on_inertia: Callable[[LiveInertia], object] | None
) -> OperatorInterface:
    from tdhil.report import stderr_console
    from tdhil.session import CallbackOperator, TerminalOperator

    gear_ratio = 1.0 if request.rig is None else request.rig.gear.ratio
    if confirm is None:
        return TerminalOperator(stderr_console(), gear_ratio=gear_ratio, on_inertia=on_inertia)
    return CallbackOperator(stderr_console(), confirm, gear_ratio=gear_ratio, on_inertia=on_inertia)
