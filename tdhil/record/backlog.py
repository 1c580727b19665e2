"""The bounded queue between the control loop and the log's thread."""

from collections import deque
from threading import Event as Flag
from typing import Any, Final

NUDGE: Final = 256
WAKE_S: Final = 0.2
LAG_S: Final = 0.4                     # of control time: what a kill may cost in stepped time, plus a cycle
SPARE: Final = 1024


class Backlog:
    """First in, first out. `put` belongs to the run, everything else to the log's thread.

    A deque, since its append and popleft are atomic: no lock on the way in. ``block`` says what a full queue does:
    make the caller wait (stepped time, where nothing is lost by waiting) or drop the record and count it (real
    time, where the shaft turns on).
    """

    def __init__(self, limit: int, *, block: bool) -> None:
        self.items: deque[Any] = deque()
        self.wake = Flag()                 # there is enough to do, or the end has come
        self.room = Flag()                 # something was taken out
        self.dropped = 0
        self.ended = False
        self.hurry = False                 # somebody waits until all that is here is in the file
        self.written = Flag()              # that is done
        self.saved_s = 0.0                 # control time up to which the file holds everything
        self._limit = limit
        self._block = block
        self._alert = min(NUDGE, limit)

    def put(self, item: Any) -> bool:
        """Takes ``item``; False if the queue is full (it is dropped and counted) or the log has ended."""
        if len(self.items) >= self._alert and not self._crowded(self._limit):
            return False
        self.items.append(item)
        return True

    def put_rare(self, item: Any) -> bool:
        """Takes an item that is too precious to be dropped with the cyclic ones: some spare places are kept."""
        if len(self.items) >= self._alert and not self._crowded(self._limit + SPARE):
            return False
        self.items.append(item)
        return True

    def keep_up(self, time_s: float) -> None:
        """Stepped time, after the cycle of control time ``time_s``: waits while the file is `LAG_S` behind it."""
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
            pass                           # the time-out covers an end that came in between

    def end(self) -> None:
        """Nothing is taken any more; whoever waits for room goes on."""
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
