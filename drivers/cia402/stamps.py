"""The stamps that frames bear, mapped to control time: only to know where the two stand, nothing is timed by them.

SocketCAN stamps with the wall clock, which somebody may set while a run goes on. A sample's time is the control time
of its SYNC, its age is control time too; so a jump changes nothing, but it is noticed, for whoever lays a candump
beside the log.
"""

from typing import Final

WINDOW_S: Final = 0.5
WINDOW_FRAMES: Final = 4
JUMP_S: Final = 0.1
_EPOCH_S: Final = 1e9
"""Stamps below it count from a start of the adapter's (or there are none: 0); they are no wall clock's."""


class FrameStamps:
    """``offset_s`` is wall clock minus control time; None as long as it isn't known.

    A frame that waited in a buffer looks as if the offset were smaller. So of each half second the largest counts:
    a burst that was taken late is over long before.
    """

    def __init__(self) -> None:
        self.offset_s: float | None = None
        self.jumps = 0
        self._best_s = 0.0
        self._frames = 0
        self._begun_s = 0.0

    def take(self, stamp_s: float, now_s: float) -> None:
        """One received frame: its stamp, and the control time at which it was taken off the bus."""
        if stamp_s < _EPOCH_S:
            return
        offset_s = stamp_s - now_s
        if self._frames == 0:
            self._best_s, self._begun_s = offset_s, now_s
        elif offset_s > self._best_s:
            self._best_s = offset_s
        self._frames += 1
        if self._frames >= WINDOW_FRAMES and now_s - self._begun_s >= WINDOW_S:
            if self.offset_s is not None and abs(self._best_s - self.offset_s) > JUMP_S:
                self.jumps += 1
            self.offset_s = self._best_s
            self._frames = 0
