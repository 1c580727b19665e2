"""Asks the operating system to put the log on the disk, beside the thread that writes it.

What was written survives a killed process by itself; only a loss of power takes what the disk hasn't got yet. A disk
may take a second for that, and neither the control loop nor the thread that closes the chunks waits for it.
"""

import errno
import os
from threading import Event, Thread
from typing import Final

from tdhil.recording.mcap_container import RawFile

EVERY_S: Final = 0.25                  # of wall time, at most so often
_CANNOT: Final = frozenset({errno.EINVAL, errno.ENOTSUP, errno.EROFS, errno.ENOSYS})
_data_to_disk = getattr(os, "fdatasync", os.fsync)


class Syncer:
    """One file's. ``failure`` is what the disk said when it couldn't."""

    def __init__(self, file: RawFile) -> None:
        self.failure: OSError | None = None
        self._file = file
        self._wake = Event()
        self._end = Event()
        self._thread = Thread(target=self._run, name="tdhil-sync", daemon=True)
        self._thread.start()

    def poke(self) -> None:
        """There is something new in the file. Raises OSError where the disk failed since the last time."""
        if self.failure is not None:
            raise self.failure
        if not self._wake.is_set():
            self._wake.set()

    def finish(self) -> None:
        """Everything written is on the disk. Raises OSError if it can't be known to be."""
        self._end.set()
        self._wake.set()
        self._thread.join()
        if self.failure is not None:
            raise self.failure

    def _run(self) -> None:
        last = False
        while not last and self.failure is None:
            self._wake.wait()
            last = self._end.is_set()
            self._wake.clear()
            try:
                _data_to_disk(self._file.fileno())
            except OSError as error:
                # Pipes and devices have no disk behind them.
                self.failure = None if error.errno in _CANNOT else error
            self._end.wait(EVERY_S)
