"""Writing of a run's log: fast calls for the control loop, and a thread for all other work.

The calls of the control loop only append to a bounded queue. The thread (`Pump`) empties the queue every 50 ms, encodes
the messages, and closes a chunk after 0.25 s of wall time or 0.2 s of control time, whichever is first: a killed
process loses less than half a second. In stepped time, in which control time is faster than the wall clock, the control
loop wakes the thread when 256 records wait, and waits if the file is 0.4 s of control time behind. A third thread
(`Syncer`) requests the operating system to store the data on the disk, against a loss of power.
"""

import errno
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Event as Flag
from threading import Thread
from types import TracebackType
from typing import Any, Final, Self

from drivers import Command, RawFrame, Sample
from tdhil.errors import LogBroken, LogError, LogRefused, LogUnopened
from tdhil.recording import log_messages
from tdhil.recording.log_format import (
    CAN,
    CLASSES,
    COMMAND,
    EVENT,
    LOG,
    REHEARSAL,
    SAMPLE,
    Event,
    LiveInertia,
    log_payload,
)
from tdhil.recording.log_messages import Cold, event_message, pack_command, pack_frames, pack_sample
from tdhil.recording.mcap_container import Container, LogGone, RawFile
from tdhil.recording.recording import Excitation, Level, Ramp, Stage

# ---------------------------------------------------------------------------------------------------------------------
# Bounded queue between the control loop and the thread of the log.


NUDGE: Final = 256
WAKE_S: Final = 0.2
LAG_S: Final = 0.4                     # s of control time that a killed process may lose in stepped time, plus a cycle
SPARE: Final = 1024


class Backlog:
    """First-in, first-out queue. `put` belongs to the run, all other methods to the thread of the log.

    It is a deque, whose append and popleft are atomic, so `put` needs no lock. ``block`` selects the effect of a full
    queue: the caller waits (stepped time, in which waiting does no harm), or the record is dropped and counted (real
    time, in which the shaft continues to turn).
    """

    def __init__(self, limit: int, *, block: bool) -> None:
        self.items: deque[Any] = deque()
        self.wake = Flag()                 # set if there is work, or at the end
        self.room = Flag()                 # set if a record was removed
        self.dropped = 0
        self.ended = False
        self.hurry = False                 # True if a caller waits until all data are in the file
        self.written = Flag()              # set when all data are in the file
        self.saved_s = 0.0                 # control time, s, up to which the file is complete
        self._limit = limit
        self._block = block
        self._alert = min(NUDGE, limit)

    def put(self, item: Any) -> bool:
        """Add ``item``. Returns False if the queue is full (the item is dropped and counted) or the log has ended."""
        if len(self.items) >= self._alert and not self._crowded(self._limit):
            return False
        self.items.append(item)
        return True

    def put_rare(self, item: Any) -> bool:
        """Add an item that must not be dropped with the cyclic ones: some places are reserved for such items."""
        if len(self.items) >= self._alert and not self._crowded(self._limit + SPARE):
            return False
        self.items.append(item)
        return True

    def keep_up(self, time_s: float) -> None:
        """Wait while the file is `LAG_S` behind control time ``time_s``. For stepped time, after each cycle."""
        behind_s = time_s - self.saved_s
        if behind_s < WAKE_S:
            return
        if behind_s < LAG_S:
            if not self.wake.is_set():
                self.wake.set()
            return
        self.written.clear()
        self.hurry = True
        self.wake.set()
        while not self.ended and not self.written.wait(0.05):
            pass                           # the time-out covers an end that happened in between

    def end(self) -> None:
        """Accept no more data, and release callers that wait for room."""
        self.ended = True
        self._alert = 0
        self.room.set()
        self.written.set()

    def _crowded(self, limit: int) -> bool:
        if not self.wake.is_set():
            self.wake.set()
        while not self.ended and len(self.items) >= limit:
            if not self._block:
                self.dropped += 1
                return False
            self.room.clear()
            self.wake.set()
            if len(self.items) >= limit:
                self.room.wait(0.05)       # the time-out covers a flag cleared just after it was set
        return not self.ended


# ---------------------------------------------------------------------------------------------------------------------
# Request to the operating system to store the log on the disk, beside the thread that writes it.
#
# Written data survive a killed process; only a loss of power loses data that are not on the disk yet. A disk may take a
# second for this. Neither the control loop nor the thread that closes the chunks waits for it.


EVERY_S: Final = 0.25                  # s; least interval, wall time
_CANNOT: Final = frozenset({errno.EINVAL, errno.ENOTSUP, errno.EROFS, errno.ENOSYS})
_data_to_disk = getattr(os, "fdatasync", os.fsync)


class Syncer:
    """Disk synchronisation of one file. ``failure``: the error of the disk, if there was one."""

    def __init__(self, file: RawFile) -> None:
        self.failure: OSError | None = None
        self._file = file
        self._wake = Flag()
        self._end = Flag()
        self._thread = Thread(target=self._run, name="tdhil-sync", daemon=True)
        self._thread.start()

    def poke(self) -> None:
        """Announce new data in the file. Raises OSError if the disk failed since the last call."""
        if self.failure is not None:
            raise self.failure
        if not self._wake.is_set():
            self._wake.set()

    def finish(self) -> None:
        """Wait until all written data are on the disk. Raises OSError if this cannot be confirmed."""
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
                # pipes and devices have no disk
                self.failure = None if error.errno in _CANNOT else error
            self._end.wait(EVERY_S)


# ---------------------------------------------------------------------------------------------------------------------
# Thread of the log: empties the queue, encodes the messages, closes chunks in time.


POLL_S: Final = 0.05
CHUNK_WALL_S: Final = 0.25
CHUNK_LOG_NS: Final = 200_000_000
CHUNK_BYTES: Final = 2**20
FRAMES: Final = 64


class Pump:
    """Thread that runs until the queue has ended and is empty, or until a failure; then it finishes the file.

    ``failure``: the first exception.
    """

    def __init__(
        self, backlog: Backlog, container: Container, syncer: Syncer, epoch_ns: int, frames: int = CAN
    ) -> None:
        self.failure: BaseException | None = None
        self._backlog = backlog
        self._container = container
        self._syncer = syncer
        self._epoch_ns = epoch_ns
        self._channel = frames                 # channel of raw frames
        self._time_s = 0.0                     # control time of the latest record
        self._frames: list[RawFrame] = []      # frames of the present cycle
        self._chunk_ns: int | None = None      # log time of the open chunk's first sample
        self._opened_s: float | None = None    # when the open chunk was first seen, wall time
        self._drops_logged = 0                 # number of dropped records that have been logged

    def run(self) -> None:
        """Run the thread. No exception leaves it. At its end no caller is left waiting."""
        try:
            self._guarded(self._work)
        finally:
            self._backlog.end()
        self._backlog.items.clear()
        self._guarded(self._close_chunk)
        self._guarded(self._container.finish)
        self._guarded(self._syncer.finish)
        self._guarded(self._container.close)

    def _guarded(self, step: Callable[[], None]) -> None:
        try:
            step()
        except BaseException as error:         # stored for the run, which raises it in its own thread
            self.failure = self.failure or error

    def _work(self) -> None:
        backlog = self._backlog
        last = False
        while not last:
            backlog.wake.wait(POLL_S)
            backlog.wake.clear()
            last = backlog.ended
            hurry = backlog.hurry
            self._drain()
            if hurry:
                backlog.hurry = False
                self._close_chunk()
                backlog.written.set()
            now_s = time.monotonic()
            if self._opened_s is None:
                self._opened_s = now_s if self._container.size or self._frames else None
            elif now_s - self._opened_s >= CHUNK_WALL_S:
                self._close_chunk()

    def _drain(self) -> None:
        items, room = self._backlog.items, self._backlog.room
        while items:
            item = items.popleft()
            if not room.is_set():
                room.set()
            kind = type(item)
            if kind is RawFrame:
                self._frames.append(item)
                if len(self._frames) >= FRAMES:
                    self._put_frames()
            elif kind is Sample:
                if self._frames:
                    self._put_frames()
                log_ns = self._log_ns(item[0])
                self._container.add(SAMPLE, log_ns, pack_sample(item))
                if self._chunk_ns is None:
                    self._chunk_ns = log_ns
                elif not 0 <= log_ns - self._chunk_ns < CHUNK_LOG_NS:
                    self._close_chunk()
            elif kind is Cold:
                channel, time_s, payload, flush = item
                log_ns = self._log_ns(self._time_s if time_s is None else time_s)
                if channel == LOG:
                    payload = log_payload(REHEARSAL, payload.decode(), log_ns)
                self._container.add(channel, log_ns, payload)
                if channel == EVENT:
                    self._put_log(log_ns, payload)
                if flush or self._container.size > CHUNK_BYTES:
                    self._close_chunk()
            else:
                time_s, command = item
                self._container.add(COMMAND, self._log_ns(time_s), pack_command(time_s, command))

    def _put_frames(self) -> None:
        frames, self._frames = self._frames, []
        self._container.add(self._channel, self._log_ns(frames[0][0]), pack_frames(frames))
        if self._container.size > CHUNK_BYTES:
            self._close_chunk()

    def _put_log(self, log_ns: int, payload: bytes) -> None:
        """Add an event for viewers."""
        event = CLASSES["Event"].FromString(payload)
        self._container.add(LOG, log_ns, log_payload(event.kind, event.text, log_ns))

    def _close_chunk(self) -> None:
        if self._frames:
            frames, self._frames = self._frames, []
            self._container.add(self._channel, self._log_ns(frames[0][0]), pack_frames(frames))
        dropped = self._backlog.dropped
        if dropped > self._drops_logged:
            text = f"{dropped - self._drops_logged} records found no place in the log's queue; {dropped} so far"
            self._drops_logged = dropped
            event = event_message(Event(self._time_s, "dropped", text))
            self._container.add(event.channel, self._log_ns(self._time_s), event.payload)
            self._put_log(self._log_ns(self._time_s), event.payload)
        self._chunk_ns = self._opened_s = None
        self._container.close_chunk()
        self._backlog.saved_s = self._time_s
        self._syncer.poke()

    def _log_ns(self, time_s: float) -> int:
        """Return the log time of a control time; NaN counts as the time of the record before, an impossible one as
        the epoch.
        """
        try:
            log_ns = self._epoch_ns + round(time_s * 1e9)
        except (ValueError, OverflowError):
            return self._log_ns(self._time_s)
        if not 0 <= log_ns < 2**63:
            return max(0, min(self._epoch_ns, 2**63 - 1))
        self._time_s = time_s
        return log_ns


# ---------------------------------------------------------------------------------------------------------------------

STEPPED_QUEUE: Final = 1024            # records; few, because in stepped time they can contain much control time
REAL_TIME_QUEUE: Final = 16384         # records; some seconds at 250 Hz, in case of a slow disk
ALIVE_EVERY_S: Final = 1.0             # s of control time between two checks that the thread is alive
_FULL: Final = (errno.ENOSPC, errno.EDQUOT)


class RunWriter:
    """Writer of one run.mcap. ``epoch_ns`` is the wall clock at control time zero.

    ``frames``: channel of the raw frames; each kind of bus has its own topic.

    ``queue_size``: number of records; None: the default of stepped or real time. ``block``: a full queue makes the
    caller wait (stepped time); otherwise the record is dropped, counted in ``dropped``, and the drop is logged as an
    event (real time). `keep_up`: no sample is taken while the file is behind, usual with ``block``. Set it to False for
    a copy of data that exist elsewhere: a killed process loses the queue.

    Raises `LogUnopened` and, if less than ``min_free_bytes`` are free, `LogRefused`.

    If the thread fails (disk full, file removed or truncated), the next call raises `LogBroken`, once. After that
    records are discarded, so that a lost log does not disturb the stop sequence, and `close` raises the error again.
    `frame` never raises, because the input and output of the drive calls it.
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
        frames: int = CAN,
    ) -> None:
        self.path = path
        self._raised = self._closing = self._marked = False
        self._checked_s = 0.0
        self._backlog = Backlog(queue_size or (STEPPED_QUEUE if block else REAL_TIME_QUEUE), block=block)
        try:
            free = shutil.disk_usage(path.absolute().parent).free
            if free < min_free_bytes:
                raise LogRefused(
                    f"only {free / 1e6:.0f} MB free for the log, {min_free_bytes / 1e6:.0f} MB wanted",
                    where=str(path), next_step="Free some space, or log to another disk")
            file = opener(path) if opener else path.open("w+b" if overwrite else "x+b", buffering=0)
            container = Container(file)
        except OSError as error:
            kind = LogRefused if error.errno in _FULL else LogUnopened
            raise self._error(kind, "the log can't be opened", error) from error
        self.keep_up = block
        self._pump = Pump(self._backlog, container, Syncer(file), epoch_ns, frames)
        self._thread = Thread(target=self._pump.run, name="tdhil-log", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Number of records lost so far."""
        return self._backlog.dropped

    @property
    def failure(self) -> LogError | None:
        """Error that ended the log too early, or None."""
        cause = self._pump.failure
        return None if cause is None else self._error(LogBroken, "the log can't be written any more", cause)

    def sample(self, sample: Sample) -> None:
        """Log the feedback of one cycle. Call it after the cycle's command and frames."""
        if abs(sample[0] - self._checked_s) >= ALIVE_EVERY_S:
            self._checked_s = sample[0]
            if not (self._closing or self._thread.is_alive()):
                self._pump.failure = self._pump.failure or RuntimeError("its thread has ended")
                self._backlog.end()
        if not self._backlog.put(sample):
            self._refused()
        elif self.keep_up:
            self._backlog.keep_up(sample[0])

    def command(self, time_s: float, command: Command) -> None:
        """Log the command of one cycle; ``time_s`` is control time."""
        if not self._backlog.put((time_s, command)):
            self._refused()

    def frame(self, frame: RawFrame) -> None:
        """Log one frame from the bus. This is a `FrameTap`; any thread may call it."""
        self._backlog.put(frame)

    def virtual(self, row: Sequence[float]) -> None:
        """Log one cycle of a virtual string (`log_format.VIRTUAL_COLUMNS`)."""
        if not self._backlog.put(log_messages.virtual_message(row)):
            self._refused()

    def stage(self, stage: Stage) -> None:
        """Log a stage that has ended."""
        self._rare(log_messages.stage_message(stage))

    def excitation(
        self, excitation: Excitation | None, levels: Sequence[Level] = (), ramps: Sequence[Ramp] = ()
    ) -> None:
        """Log everything known so far of the motion; the last call counts."""
        self._rare(log_messages.excitation_message(excitation, levels, ramps))

    def event(self, event: Event) -> None:
        """Log an event."""
        self._rare(log_messages.event_message(event))

    def configuration(self, run: Mapping[str, Any], facts: Mapping[str, Any]) -> None:
        """Log the run's configuration and `RecordingBuilder.facts`; the last call counts."""
        self._rare(log_messages.configuration_message(run, facts))
        if (faults := run.get("faults")) and not self._marked:
            self._rare(log_messages.rehearsal_mark(faults))
            self._marked = True

    def result(self, result: Mapping[str, Any]) -> None:
        """Log the result document; the last call counts."""
        self._rare(log_messages.result_message(result))
        if (response := result.get("frequency_response")) is not None:
            self._rare(log_messages.response_message(response))

    def inertia(self, found: LiveInertia) -> None:
        """An interim answer; may be called again."""
        self._rare(log_messages.inertia_message(found))

    def close(self, timeout_s: float = 30.0) -> None:
        """Write all waiting records and finish the file; idempotent. Raises `LogBroken` if the log is not complete."""
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
            if error is None:                  # an exception already in progress is the first cause, and is raised
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
