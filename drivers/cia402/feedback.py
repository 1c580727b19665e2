"""What comes back for each SYNC: one TPDO1, the drive's own, and how it is told from others that bear its identifier.

A drive answers a SYNC once. So a second TPDO1 before the next SYNC is a frame that was delayed, doubled on its way, or
sent by somebody else: a duplicate node-ID, a recording that is played back. The first of a cycle is taken; which of
the two is the drive's can't be told, and while a shaft is being stopped neither counts (`Feedback.doubted`): old
frames of a shaft at rest must not end a stop. One that says something else than the first, with no SYNC of late left
unanswered that it could belong to, contradicts it.
"""

from drivers.cia402.shape import Shape
from profiles.marker import CYCLES_END, LAST_CYCLE_OVER

_NO_WORD = b""
_OWING_AT_MOST = 3
"""Unanswered SYNCs whose answers may still come: older ones were lost."""


class Feedback:
    """Of the cycle under way; `begin` starts the next."""

    def __init__(self, shape: Shape) -> None:
        self._wide = shape.wide
        self._size = shape.data_size()
        self._data_half = self._status_half = _NO_WORD
        self._asked = False
        self._owing = 0                # SYNCs that brought nothing yet
        self._extra = False            # since `believed` was asked last
        self._ends_cycles = False      # a simulated peer says where a cycle ends
        self.data = _NO_WORD           # statusword, torque, speed; as `Shape.feedback` packs them
        self.over = False              # the peer said so of this cycle
        self.arrived = 0               # TPDO1s, all told
        self.second = 0                # of them, a second one of a cycle that the peer had not ended yet
        self.contradictions = 0        # of them, those that can't be the drive's if the first was

    def begin(self) -> None:
        """A SYNC is about to go out."""
        if self._asked and not self.data and self._owing < _OWING_AT_MOST:
            self._owing += 1
        self._asked = True
        self.data = self._data_half = self._status_half = _NO_WORD
        self.over = False

    def doubted(self) -> bool:
        """Has more than one TPDO1 come for a SYNC since this was asked last?"""
        extra, self._extra = self._extra, False
        return extra

    def on_foreign_sync(self) -> None:
        """Somebody else's: the drive answers that one too."""
        self._owing += 1

    @property
    def done(self) -> bool:
        """In stepped time: nothing more is waited for."""
        return self.over or (bool(self.data) and not self._ends_cycles)

    def on_tpdo1(self, data: bytes) -> None:
        """180h + node. A frame of another length is none."""
        if len(data) != self._size:
            return
        if self._wide:
            self._data_half = data
            self._join()
        else:
            self._take(data)

    def on_status(self, status: bytes) -> None:
        """The statusword in a wide drive's TPDO2; its two TPDOs of one SYNC come in whichever order."""
        self._status_half = status
        self._join()

    def on_cycle_end(self, data: bytes) -> None:
        """Of a simulated peer with scripted faults, in stepped time (`profiles.marker.CYCLE_ID`)."""
        self._ends_cycles = data != LAST_CYCLE_OVER
        self.over = data != CYCLES_END

    def _join(self) -> None:
        if self._data_half and self._status_half:
            self._take(self._status_half + self._data_half)

    def _take(self, data: bytes) -> None:
        self.arrived += 1
        if not self.data:
            self.data = data
            return
        self._extra = True
        self.second += self._ends_cycles
        if self._owing:
            self._owing -= 1
        elif data != self.data:
            self.contradictions += 1
