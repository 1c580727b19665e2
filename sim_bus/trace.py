"""The shaft trace: motion of the true shaft, for tests and for a comparison with the reported values.

::

    time_s,speed_rad_s,torque_nm,state,event
    0.010000,0.00314,1.25,operation enabled,
    0.012000,0.0041,1.3,quick stop active,host silent: running on in own time

Times are plant time. The trace has a row per 10 ms, and one for each change of state and each event. It is flushed with
every event and at least each 0.25 s of wall time, so that a reader sees a stop while it happens.
"""

import time
from contextlib import suppress
from pathlib import Path
from typing import Self

from profiles import MessageCode, TdhilError

HEADER = "time_s,speed_rad_s,torque_nm,state,event\n"
ROW_PERIOD_US = 10_000
INCOMPLETE = ".part"
"""Behind the name of a trace that could not be written to its end."""
_FLUSH_S = 0.25


class NotATrace(TdhilError):
    """Error for a trace path whose file holds other data."""

    entry = MessageCode.TRACE_NOT_OURS

    exit_code = 2


def check_trace_path(path: Path, where: str = "trace") -> None:
    """Check that the path is free or holds an older trace, which may be overwritten. Raises NotATrace."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        head = file.read(len(HEADER))
    if head and head != HEADER.encode():
        raise NotATrace("holds something else; it is left as it is", where=f"{where} {path}",
                        next_step="Name another file")


class ShaftTrace:
    """Writer of the trace file, which replaces an older trace. Without a path it does nothing. Raises NotATrace.

    A full disk ends the trace, not the simulated drive. The incomplete file then has `INCOMPLETE` behind its name.
    """

    def __init__(self, path: Path | None) -> None:
        if path is not None:
            check_trace_path(path)
        self._path = path
        self._file = path.open("w", encoding="utf-8") if path is not None else None
        self._flushed_s = time.monotonic()
        if self._file is not None:
            self._file.write(HEADER)
            self._file.flush()

    @property
    def active(self) -> bool:
        """True if there is a file."""
        return self._file is not None

    def row(self, time_s: float, speed_rad_s: float, torque_nm: float, state: str, event: str = "") -> None:
        """Write one row. An event is flushed at once."""
        if self._file is None:
            return
        text = event.replace(",", ";").replace("\n", " ")
        try:
            self._file.write(f"{time_s:.6f},{speed_rad_s:.7g},{torque_nm:.6g},{state},{text}\n")
        except OSError:
            self._abandon()
        self.flush(now=bool(event))

    def flush(self, *, now: bool = False) -> None:
        """Flush if it is due, or if ``now``."""
        if self._file is None:
            return
        wall_s = time.monotonic()
        if now or wall_s - self._flushed_s >= _FLUSH_S:
            try:
                self._file.flush()
            except OSError:
                self._abandon()
            self._flushed_s = wall_s

    def close(self) -> None:
        """Close the file; safe to repeat."""
        if self._file is not None:
            try:
                self._file.close()
            except OSError:
                self._abandon()
            self._file = None

    def _abandon(self) -> None:
        file, path, self._file = self._file, self._path, None
        if file is None or path is None:
            return
        with suppress(OSError):
            file.close()
        with suppress(OSError):
            path.replace(path.with_name(path.name + INCOMPLETE))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
