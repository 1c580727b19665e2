"""Identification of one log into one row: the same function for the pool, a cluster, and any other caller."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pydantic import Field

from profiles import DataModel
from tdhil.errors import LogError, MessageCode, NothingRecoverable, TdhilError, UsageError
from tdhil.fleet.rows import FleetRow, FleetSettings, failure_row, row_of
from tdhil.version import __version__

if TYPE_CHECKING:
    from tdhil.session import RunRecord

_CACHE_FORMAT: Final = 2
_BLOCK: Final = 2**20


@dataclass(frozen=True)
class LogTask:
    """One log to identify. ``log``: a path, or a URL that fsspec can open; ``cache``: a folder for recordings that were
    read, or None.
    """

    log: str
    settings: FleetSettings = field(default_factory=FleetSettings)
    cache: str | None = None


@dataclass(frozen=True)
class Done:
    """Row of a task, with facts that differ between calls. ``cpu_s``: CPU time, s; ``cached``: the recording was in the
    cache.
    """

    row: FleetRow
    cpu_s: float = 0.0
    cached: bool = False


def identify_log(task: LogTask) -> Done:
    """Identify one log. Raises no error of the file: a file that can't be read gives a row with its error."""
    import time

    began = time.process_time()
    facts: dict[str, Any] = {}
    cached = False
    try:
        with local_copy(task.log) as path:
            facts = {"sha256": content_hash(path), "size_bytes": path.stat().st_size}
            row, cached = _row(task, path, facts)
    except Exception as error:
        row = failure_row(task.log, type(error).__name__, _text(error), task.settings, **facts)
    return Done(row, time.process_time() - began, cached)


def _text(error: Exception) -> str:
    """Return the error's text for a row. For a TdhilError it is without the place, which the row has."""
    if isinstance(error, TdhilError):
        return error.what if not error.next_step else f"{error.what}. {error.next_step}"
    if isinstance(error, OSError):
        return f"can't be read: {error.strerror or error}"
    if isinstance(error, MemoryError):
        return "needs more memory than it may take"
    # A defect of tdhil that this file shows. The other logs continue.
    return f"internal error, please report it with this log: {error}"


def _row(task: LogTask, path: Path, facts: dict[str, Any]) -> tuple[FleetRow, bool]:
    from tdhil.report import rehearsed_faults
    from tdhil.session import conclude

    kept = None if task.cache is None else Path(task.cache) / f"{facts['sha256']}.v{_CACHE_FORMAT}.npz"
    record = None if kept is None else _from_cache(kept)
    cached = record is not None
    if record is None:
        record = read_any(path)
        if kept is not None:
            _into_cache(kept, record)
    record = replace(record, log=task.log)
    if faults := rehearsed_faults(record.configuration):
        facts["rehearsed_faults"] = ", ".join(faults)          # also in the row of a log without a result
    record.require_motion()
    configuration = record.asked(task.settings.asked())
    found = conclude(record.recording, configuration, task.log, record.assumed)
    recording = record.recording
    time_s = recording.time_s
    excitation = recording.excitation
    warnings = (*record.problems, *found.document["warnings"])
    row = row_of(
        task.log, {**found.document, "warnings": warnings}, settings=task.settings, stored=record.stored_result,
        torque_scale_rel_sd=recording.torque_scale_rel_sd,
        excitation=None if excitation is None else excitation.kind,
        mode=None if excitation is None else excitation.mode,
        duration_s=float(time_s[-1] - time_s[0]) if len(time_s) else 0.0,
        samples=len(time_s),
        **facts,
    )
    return row, cached


# ---------------------------------------------------------------------------------------------------------------------
# Reading: a tdhil log, or a trace with its sidecar


class Sidecar(DataModel):
    """trace.yaml beside trace.csv: the options of ``tdhil replay`` for a trace, and its rig."""

    rig: str | None = Field(default=None, max_length=200, description="rig of the trace")
    date: str | None = Field(default=None, max_length=40, description="when it was recorded, ISO 8601")
    columns: tuple[str, ...] | None = Field(default=None, description="such as time=t_s, speed=n_rpm:rpm")
    excitation: str | None = Field(default=None, description="an excitation.yaml in the same folder")
    rated_torque_nm: float | None = Field(default=None, gt=0, description="N·m; 100 % torque")
    torque_limit_nm: float | None = Field(default=None, gt=0, description="N·m; the drive's torque limit")
    gear_ratio: float | None = Field(default=None, gt=0, description="ω_motor/ω_main")
    torque_scale_rel_sd: float | None = Field(default=None, ge=0, lt=1, description="standard uncertainty of the scale")
    speed_lag_s: float | None = Field(default=None, ge=0, description="s; filter on the reported speed")
    speed_lag_sd_s: float | None = Field(default=None, ge=0, description="s; its standard deviation")
    torque_lag_s: float | None = Field(default=None, ge=0, description="s; filter on the reported torque")
    torque_lag_sd_s: float | None = Field(default=None, ge=0, description="s; its standard deviation")


def sidecar_of(trace: Path) -> Path:
    """Return the path of a CSV trace's sidecar: the same name, ending .yaml."""
    return trace.with_suffix(".yaml")


def read_any(path: Path) -> RunRecord:
    """Return the record of a tdhil log, or of a trace with its sidecar. Raises TdhilError."""
    from tdhil.session import is_log, read

    if is_log(path):
        return read(path)
    if path.suffix.lower() != ".csv":
        empty = path.stat().st_size == 0
        raise NothingRecoverable("the file is empty" if empty else "this is not an MCAP file", where=str(path),
                                 next_step="Give a run.mcap of tdhil, or a trace that ends in .csv")
    from tdhil.session import stated_lags

    known = _known(path)
    if known.excitation is not None and Path(known.excitation).name != known.excitation:
        raise UsageError("name a file in the same folder", where=f"{sidecar_of(path)}: excitation")
    lags = stated_lags(
        known.speed_lag_s, known.speed_lag_sd_s, known.torque_lag_s, known.torque_lag_sd_s, sidecar_of(path).name
    )
    record = read(
        path,
        columns=None if known.columns is None else list(known.columns),
        excitation=None if known.excitation is None else path.with_name(known.excitation),
        rated_torque_nm=known.rated_torque_nm, torque_limit_nm=known.torque_limit_nm, gear_ratio=known.gear_ratio,
        torque_scale_rel_sd=known.torque_scale_rel_sd, lags=lags,
    )
    said: dict[str, Any] = {} if known.rig is None else {"bench": {"name": known.rig}}
    if known.date is not None:
        said["started"] = known.date
    return replace(record, configuration={**record.configuration, **said})


def _known(trace: Path) -> Sidecar:
    """Return the content of the sidecar. Raises DataFileError with every problem and its line."""
    from profiles import load_model

    side = sidecar_of(trace)
    return load_model(side, Sidecar) if side.is_file() else Sidecar()


def content_hash(path: Path) -> str:
    """Return the SHA-256 of the file; for a trace in CSV, with its sidecar and excitation. Raises OSError."""
    sum_ = hashlib.sha256()
    _add(sum_, path)
    side = sidecar_of(path)
    if path.suffix.lower() == ".csv" and side.is_file():
        sum_.update(b"\0sidecar\0")
        _add(sum_, side)
        with suppress(TdhilError):             # the reader of the file reports its errors
            named = _known(path).excitation
            if named is not None and path.with_name(Path(named).name).is_file():
                sum_.update(b"\0excitation\0")
                _add(sum_, path.with_name(Path(named).name))
    return sum_.hexdigest()


def _add(sum_: Any, path: Path) -> None:
    with path.open("rb", buffering=0) as file:
        while block := file.read(_BLOCK):
            sum_.update(block)


@contextmanager
def local_copy(log: str) -> Iterator[Path]:
    """Yield the file as a path of this machine. The content of a URL is in a temporary file until the end
    of the block.
    """
    if "://" not in log:
        yield Path(log)
        return
    with tempfile.TemporaryDirectory(prefix="tdhil-fleet-") as folder:
        target = Path(folder) / log.rsplit("/", 1)[-1]
        system, inside = remote(log)
        with named_errors(log), system.open(inside, "rb") as source, target.open("wb") as file:
            while block := source.read(_BLOCK):
                file.write(block)
        yield target


def remote(url: str) -> tuple[Any, str]:
    """Return fsspec's file system of a URL, and the path there. Raises UsageError if a library is missing."""
    from importlib import import_module

    try:
        with named_errors(url):
            system, inside = import_module("fsspec").core.url_to_fs(url)
    except ImportError as error:
        extra = "s3" if url.startswith(("s3://", "s3a://")) else "cluster"
        raise UsageError(f"a library for this address is missing: {error}", where=url,
                         next_step=f"Install it in the clone of tdhil: pip install '.[{extra}]'",
                         entry=MessageCode.PACKAGE_MISSING) from error
    return system, inside


@contextmanager
def named_errors(url: str) -> Iterator[None]:
    """Convert errors of libraries behind fsspec (no credentials, no network) to a LogError."""
    try:
        yield
    except (OSError, ImportError):
        raise
    except Exception as error:
        raise LogError(f"can't be fetched: {error}", where=url, next_step="Look at address and credentials") from error


# ---------------------------------------------------------------------------------------------------------------------
# Cache of recordings by the content of their files. A damaged entry is read again from its log and rewritten.


def _from_cache(kept: Path) -> RunRecord | None:
    from tdhil.recording import RunEnd, unpack_recording
    from tdhil.session import RunRecord

    found = unpack_recording(kept)
    if found is None or found[1].get("by") != __version__:
        return None
    recording, beside = found
    try:
        ended = beside["ended"]
        return RunRecord(
            recording, beside["configuration"], beside["log"],
            None if beside["assumed"] is None else tuple(beside["assumed"]), tuple(beside["problems"]),
            None if ended is None else RunEnd(**ended), beside["stored_result"],
        )
    except (KeyError, TypeError):
        return None


def _into_cache(kept: Path, record: RunRecord) -> None:
    """Write a record to the cache. An error is ignored, because the row does not depend on the cache."""
    from tdhil.recording import pack_recording

    beside = {
        "by": __version__, "log": record.log, "configuration": record.configuration, "problems": record.problems,
        "assumed": record.assumed, "ended": None if record.ended is None else asdict(record.ended),
        "stored_result": record.stored_result,
    }
    part = kept.with_name(f"{kept.name}.{os.getpid()}.part")
    with suppress(OSError, TypeError, ValueError):
        try:
            part.write_bytes(pack_recording(record.recording, beside))
            part.replace(kept)
        finally:
            part.unlink(missing_ok=True)

