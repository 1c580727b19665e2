"""The log of a run as it is written: a cheap front for the control loop, a thread behind it for all the rest.

The front appends to a bounded queue and does nothing else. The thread (`pump`) empties the queue every 50 ms, lays
out the messages, and closes a chunk after 0.25 s of wall time or 0.2 s of control time, whichever comes first:
a kill costs less than half a second. In stepped time, where control time runs ahead of the wall, the front wakes
the thread as soon as 256 records wait, and itself waits where the file is 0.4 s of control time behind. A third
thread (`sync`) has the disk take what was written, against a loss of power.
"""

import errno
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Thread
from types import TracebackType
from typing import Any, Final, Self

from drivers.drive import Command, RawFrame, Sample
from tdhil.record.backlog import Backlog
from tdhil.record.errors import LogBroken, LogError, LogRefused, LogUnopened
from tdhil.record.event import Event
from tdhil.record.pump import Pump
from tdhil.record.sync import Syncer
from tdhil.recording import log_messages
from tdhil.recording.log_format import CAN, MODBUS
from tdhil.recording.mcap_container import Container, LogGone, RawFile
from tdhil.recording.recording import Excitation, Level, Ramp, Stage

STEPPED_QUEUE: Final = 1024            # records; small, since in stepped time it can hold much control time
REAL_TIME_QUEUE: Final = 16384         # some seconds at 250 Hz: what a slow disk may take before records are lost
ALIVE_EVERY_S: Final = 1.0             # of control time: whether there still is a thread that writes
_FULL: Final = (errno.ENOSPC, errno.EDQUOT)


class RunWriter:
    """One run.mcap. ``epoch_ns`` is the wall clock at control time zero.

    ``modbus``: the raw frames are a Modbus line's, on a topic of their own.

    ``queue_size`` counts records; None takes the default of stepped or real time.
    ``block``: a full queue makes the caller wait (stepped time); otherwise the record is dropped, counted in
    ``dropped``, and the drop is logged as an event (real time).

    Raises `LogUnopened` and, where less than ``min_free_bytes`` are free, `LogRefused`.

    When the thread fails (disk full, file removed or cut short by somebody), the next call raises `LogBroken`, once;
    after that records are discarded, so that the stop sequence isn't disturbed by a log that is gone, and `close`
    raises it again.
    `frame` never raises: it is called from inside the drive's own input and output.
    """

    def __init__(
        self,
        path: Path,
        *,
        epoch_ns: int,
        block: bool,
        queue_size: int | None = None,
        min_free_bytes: int = 200_000_000,
        overwrite: bool = True,
        opener: Callable[[Path], RawFile] | None = None,
        modbus: bool = False,
    ) -> None:
        self.path = path
        self._raised = self._closing = False
        self._looked_s = 0.0
        self._backlog = Backlog(queue_size or (STEPPED_QUEUE if block else REAL_TIME_QUEUE), block=block)
        try:
            free = shutil.disk_usage(path.absolute().parent).free
            if free < min_free_bytes:
                raise LogRefused(
                    f"only {free / 1e6:.0f} MB free for the log, {min_free_bytes / 1e6:.0f} MB wanted",
                    where=str(path), next_step="Free some space, or log to another disk")
            file = opener(path) if opener else path.open("wb" if overwrite else "xb", buffering=0)
            container = Container(file)
        except OSError as error:
            kind = LogRefused if error.errno in _FULL else LogUnopened
            raise self._error(kind, "the log can't be opened", error) from error
        self._block = block
        self._pump = Pump(self._backlog, container, Syncer(file), epoch_ns, MODBUS if modbus else CAN)
        self._thread = Thread(target=self._pump.run, name="tdhil-log", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Records that did not make it into the log so far."""
        return self._backlog.dropped

    @property
    def failure(self) -> LogError | None:
        """What ended the log before its time, or None."""
        cause = self._pump.failure
        return None if cause is None else self._error(LogBroken, "the log can't be written any more", cause)

    def sample(self, sample: Sample) -> None:
        """One cycle's feedback; call it after the cycle's command and frames."""
        if abs(sample[0] - self._looked_s) >= ALIVE_EVERY_S:
            self._looked_s = sample[0]
            if not (self._closing or self._thread.is_alive()):
                self._pump.failure = self._pump.failure or RuntimeError("its thread has ended")
                self._backlog.end()
        if not self._backlog.put(sample):
            self._refused()
        elif self._block:
            self._backlog.keep_up(sample[0])

    def command(self, time_s: float, command: Command) -> None:
        """One cycle's command; ``time_s`` is control time."""
        if not self._backlog.put((time_s, command)):
            self._refused()

    def frame(self, frame: RawFrame) -> None:
        """One frame from the bus; a `FrameTap`, may be called from any thread."""
        self._backlog.put(frame)

    def stage(self, stage: Stage) -> None:
        """A stage that has ended."""
        self._rare(log_messages.stage_message(stage))

    def excitation(
        self, excitation: Excitation | None, levels: Sequence[Level] = (), ramps: Sequence[Ramp] = ()
    ) -> None:
        """Everything known so far of the motion; may be called again, the last call counts."""
        self._rare(log_messages.excitation_message(excitation, levels, ramps))

    def event(self, event: Event) -> None:
        """Something that happened."""
        self._rare(log_messages.event_message(event))

    def configuration(self, run: Mapping[str, Any], facts: Mapping[str, Any]) -> None:
        """The run's configuration and `RecordingBuilder.facts`; may be called again, the last call counts."""
        self._rare(log_messages.configuration_message(run, facts))

    def result(self, result: Mapping[str, Any]) -> None:
        """The result document; may be called again, the last call counts."""
        self._rare(log_messages.result_message(result))

    def close(self, timeout_s: float = 30.0) -> None:
        """Writes what waits and finishes the file; idempotent. Raises `LogBroken` if the log isn't whole."""
        self._closing = True
        self._backlog.end()
        self._backlog.wake.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise LogBroken(f"the disk has not taken the log within {timeout_s:g} s", where=str(self.path),
                            next_step="What is there can be replayed")
        if self.failure is not None:
            raise self.failure from self._pump.failure

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except LogError:
            if error is None:                  # an exception under way is the first cause and stays it
                raise

    def _rare(self, message: log_messages.Cold) -> None:
        if not self._backlog.put_rare(message):
            self._refused()

    def _refused(self) -> None:
        failure = self.failure
        if failure is not None and not self._raised:
            self._raised = True
            raise failure from self._pump.failure

    def _error(self, kind: type[LogError], what: str, cause: BaseException) -> LogError:
        reason = cause.strerror if isinstance(cause, OSError) and cause.strerror else f"{type(cause).__name__}: {cause}"
        full = isinstance(cause, OSError) and cause.errno in _FULL
        next_step = "Free some space, or log to another disk" if full else "Choose another file"
        if isinstance(cause, LogGone):
            next_step = "Leave the log alone while a run is under way"
        return kind(f"{what}: {reason}", where=str(self.path), next_step=next_step)
