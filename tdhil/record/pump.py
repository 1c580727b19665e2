"""The log's thread: takes what waits, lays it out, closes chunks in time."""

import time
from collections.abc import Callable
from typing import Final

from drivers.drive import RawFrame, Sample
from tdhil.record.backlog import Backlog
from tdhil.record.event import Event
from tdhil.record.foxglove import log_payload
from tdhil.record.sync import Syncer
from tdhil.record.wire import pack_command, pack_frames, pack_sample
from tdhil.recording.log_format import CAN, CLASSES, COMMAND, EVENT, LOG, SAMPLE
from tdhil.recording.log_messages import Cold, event_message
from tdhil.recording.mcap_container import Container

POLL_S: Final = 0.05
CHUNK_WALL_S: Final = 0.25
CHUNK_LOG_NS: Final = 200_000_000
CHUNK_BYTES: Final = 2**20
FRAMES: Final = 64


class Pump:
    """Runs until the backlog has ended and is empty, or until something fails; then finishes the file.

    ``failure`` is the first exception, whatever came after it.
    """

    def __init__(
        self, backlog: Backlog, container: Container, syncer: Syncer, epoch_ns: int, frames: int = CAN
    ) -> None:
        self.failure: BaseException | None = None
        self._backlog = backlog
        self._container = container
        self._syncer = syncer
        self._epoch_ns = epoch_ns
        self._channel = frames                 # of raw frames
        self._time_s = 0.0                     # of the latest record, control time
        self._frames: list[RawFrame] = []      # of the cycle that is under way
        self._chunk_ns: int | None = None      # log time of the open chunk's first sample
        self._opened_s: float | None = None    # when the open chunk was first seen, wall time
        self._told = 0                         # drops that have been logged

    def run(self) -> None:
        """The thread's body; lets no exception out. However it ends, nobody waits for it any more."""
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
        except BaseException as error:         # kept for the run, which raises it in its own thread
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
                self._put_sample(item)
            elif kind is Cold:
                self._put_cold(item)
            else:
                time_s, command = item
                self._container.add(COMMAND, self._log_ns(time_s), pack_command(time_s, command))

    def _put_sample(self, sample: Sample) -> None:
        if self._frames:
            self._put_frames()
        log_ns = self._log_ns(sample[0])
        self._container.add(SAMPLE, log_ns, pack_sample(sample))
        if self._chunk_ns is None:
            self._chunk_ns = log_ns
        elif not 0 <= log_ns - self._chunk_ns < CHUNK_LOG_NS:
            self._close_chunk()

    def _put_frames(self) -> None:
        frames, self._frames = self._frames, []
        self._container.add(self._channel, self._log_ns(frames[0][0]), pack_frames(frames))
        if self._container.size > CHUNK_BYTES:
            self._close_chunk()

    def _put_cold(self, cold: Cold) -> None:
        channel, time_s, payload, flush = cold
        log_ns = self._log_ns(self._time_s if time_s is None else time_s)
        self._container.add(channel, log_ns, payload)
        if channel == EVENT:
            self._put_log(log_ns, payload)
        if flush or self._container.size > CHUNK_BYTES:
            self._close_chunk()

    def _put_log(self, log_ns: int, payload: bytes) -> None:
        """An event again, as viewers know it."""
        event = CLASSES["Event"].FromString(payload)
        self._container.add(LOG, log_ns, log_payload(event.kind, event.text, log_ns))

    def _close_chunk(self) -> None:
        if self._frames:
            frames, self._frames = self._frames, []
            self._container.add(self._channel, self._log_ns(frames[0][0]), pack_frames(frames))
        dropped = self._backlog.dropped
        if dropped > self._told:
            text = f"{dropped - self._told} records found no place in the log's queue; {dropped} so far"
            self._told = dropped
            event = event_message(Event(self._time_s, "dropped", text))
            self._container.add(event.channel, self._log_ns(self._time_s), event.payload)
            self._put_log(self._log_ns(self._time_s), event.payload)
        self._chunk_ns = self._opened_s = None
        self._container.close_chunk()
        self._backlog.saved_s = self._time_s
        self._syncer.poke()

    def _log_ns(self, time_s: float) -> int:
        """Log time of a control time; NaN counts as the time of the record before, an impossible one as the epoch."""
        try:
            log_ns = self._epoch_ns + round(time_s * 1e9)
        except (ValueError, OverflowError):
            return self._log_ns(self._time_s)
        if not 0 <= log_ns < 2**63:
            return max(0, min(self._epoch_ns, 2**63 - 1))
        self._time_s = time_s
        return log_ns
