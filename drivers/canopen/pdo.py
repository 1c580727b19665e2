"""Content of the cyclic frames of a drive, where it differs from the usual CiA 402 objects.

- If 6060h can't be mapped and no torque offset is used, there is no RPDO2.
- A 32-bit torque leaves no room for the statusword beside the speed. TPDO1 then holds torque and speed, and TPDO2
  brings the statusword with every SYNC.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from drivers.cia402 import (
    MODE_DISPLAY,
    STATUSWORD,
    TORQUE_DEMAND,
    CyclicLayout,
    CyclicObjects,
    Mapped,
    angle_object,
    cyclic_objects,
)
from profiles import CYCLES_END, LAST_CYCLE_OVER
from profiles.canopen import CanopenProfile, Position

# ---------------------------------------------------------------------------------------------------------------------
# The CiA 402 objects that tdhil uses, and the pure codec between them and SI.
#
# Cyclic data, little endian, one instant for torque and speed::
#
#     RPDO1  6040h controlword u16 | 6071h target torque i16 ‰ | 60FFh target velocity i32 LSB
#     TPDO1  6041h statusword  u16 | 6077h torque actual i16 ‰ | 606Ch velocity actual i32 LSB
#     RPDO2  6060h modes of operation i8 [| 60B2h torque offset i16 ‰, then in every cycle]
#     TPDO2  6061h modes of operation display i8 [| 6074h torque demand i16 ‰] [| 6064h angle of the motor i32]
#
# ‰ is of the rated torque (6076h); the velocity's LSB is the profile's. `FrameShape` holds the differences of a drive.


PDO_BYTES = 8


def consumer_heartbeat(node: int, time_ms: int) -> int:
    """Return the u32 of 1016h: node-ID in bits 16 to 23, time in ms below."""
    return node << 16 | time_ms


# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FrameShape(CyclicObjects):
    """Frames that a drive receives and sends: its cyclic objects, and how they are packed."""

    @property
    def wide(self) -> bool:
        """True for a torque of 32 bits: the statusword then comes in TPDO2."""
        return self.torque[2] == 32

    @cached_property
    def rpdo1(self) -> CyclicLayout:
        """Layout of RPDO1; its values are the setpoints of a cycle."""
        return CyclicLayout(self.targets, self.setpoints)

    @cached_property
    def rpdo2(self) -> CyclicLayout:
        """Layout of RPDO2; its values are the setpoints of a cycle."""
        return CyclicLayout(self.mode_and_offset, self.setpoints)

    @cached_property
    def feedback(self) -> CyclicLayout:
        """Layout of statusword, torque, speed; wide: of both TPDOs combined."""
        return CyclicLayout(self.actual, self.actual, self.kinds())

    def data_size(self) -> int:
        """Return the length of TPDO1, bytes."""
        return self.feedback.size - 2 if self.wide else self.feedback.size


@dataclass(frozen=True)
class Slow:
    """Objects in TPDO2 behind the mode display, and behind the statusword in a wide shape.

    ``position`` counts the motor's angle. If there is no room for both, the demand is left out: only the angle comes
    from another source than the drive's speed and torque.
    """

    demand: bool = False
    position: Position | None = None
    wide: bool = False

    @classmethod
    def fitting(cls, demand: bool, position: Position | None, shape: FrameShape) -> Slow:
        """Return the objects that fit into the frame."""
        whole = cls(demand, position, shape.wide)
        return whole if whole.size + 2 * shape.wide <= PDO_BYTES else cls(False, position, shape.wide)

    @property
    def mapped(self) -> tuple[Mapped, ...]:
        """Index, subindex, bits of each object, the statusword among them."""
        angle = angle_object(self.position)
        carried = (STATUSWORD,) * self.wide + (MODE_DISPLAY,) + (TORQUE_DEMAND,) * self.demand
        return carried if angle is None else (*carried, angle)

    @property
    def size(self) -> int:
        """Length in bytes, without the statusword of a wide shape."""
        return self.layout.size

    @cached_property
    def layout(self) -> CyclicLayout:
        """Layout of mode display, demand and angle, without the statusword of a wide shape."""
        angle = angle_object(self.position)
        kinds = {} if angle is None or self.position is None else {angle: self.position.type}
        return CyclicLayout(self.mapped[self.wide :], (MODE_DISPLAY, TORQUE_DEMAND, angle), kinds)

    def unpack(self, data: bytes) -> tuple[int, int | None, float | None]:
        """Return mode display, demand, angle in counts; None for a value that is not carried."""
        shown, demand, angle = self.layout.unpack(data)
        return shown, demand, None if angle is None else float(angle)


STANDARD = FrameShape()


def shape_of(profile: CanopenProfile) -> FrameShape:
    """Return the frame shape that the profile describes."""
    return FrameShape(**vars(cyclic_objects(profile)))


# ---------------------------------------------------------------------------------------------------------------------
# Feedback of each SYNC: one TPDO1 of the drive, and how it is distinguished from foreign frames with its identifier.
#
# A drive answers each SYNC once, in order. So there are never more answers than SYNCs, ours and foreign ones together.
# One more answer is a duplicated or a foreign frame: a duplicate node-ID, or a recording that is played back. tdhil
# then takes the first of a cycle, because it can't know which one came from the drive. While a shaft is being stopped
# none of several counts (`PdoFeedback.doubted`): old frames of a standstill must not end a stop. A surplus frame that
# differs from the first contradicts it.
#
# A delayed host or adapter finds a burst: the answers to all SYNCs that were sent meanwhile. In stepped time, and if a
# cycle is longer than any delay, an answer that did not come within its cycle is lost. In real time it may still come,
# and the next answer does not belong to the next SYNC: answers are assigned to SYNCs in order, and the last one belongs
# to this cycle. If a cycle ends with fewer answers than SYNCs, one answer was lost or all are late. The last answer
# then cannot be assigned, and the cycle gets no sample. A single answer at the usual time after this cycle's SYNC shows
# that an older one was lost. If the older one still comes in the next cycle, neither counts.


NO_WORD = b""
ANSWER_WITHIN_S = 0.5
"""Time after which an answer counts as lost, s. The host gives up a silent drive after half of this time."""
LONGEST_LATE_S = 0.05
"""Longest delay of an adapter, s. If the cycle is longer, a late answer counts as lost."""
_USUAL_SHARE, _QUICKEST_SHARE = 0.25, 0.5
_RECENT = 1000


class PdoFeedback:
    """Feedback of the current cycle; `begin` starts the next. ``now_s`` returns the control time in real time; None in
    stepped time, where no answer is late.
    """

    def __init__(self, shape: FrameShape, now_s: Callable[[], float] | None = None, period_s: float = 0.0) -> None:
        self._wide = shape.wide
        self._size = shape.data_size()
        self._now_s = now_s
        self._period_s = period_s
        self._waits = now_s is not None and period_s < LONGEST_LATE_S
        self._half: tuple[float, bool, bytes] | None = None    # time, True for the statusword, data
        self._due: deque[float] = deque()      # SYNCs whose answers may come yet, in order; the last is this cycle's
        self._given_up: deque[float] = deque() # answers that count as lost, but may still come
        self._begun_s = 0.0
        self._here = 0                 # answers since `begin`
        self._last_s = 0.0             # arrival time of the latest answer, s
        self._spoiled = False          # a frame of another length has come since `begin`
        self._doubtful = False         # an answer of the previous cycle was given up; it may come in this one
        self._quickest_s: float | None = None
        self._usual_s = 0.0            # time from a SYNC to its answer
        self._extra = False            # a surplus answer has come since the last call of `doubted`
        self._ends_cycles = False      # a simulated peer reports the end of a cycle
        self.data = NO_WORD            # statusword, torque, speed; as `FrameShape.feedback` packs them
        self.over = False              # the peer reported the end of this cycle
        self.arrived = 0               # number of all TPDO1s
        self.second = 0                # number of surplus TPDO1s in cycles that the peer had not ended
        self.older = 0                 # number of answers to a SYNC before this cycle's
        self.contradictions = 0        # number of frames that contradict the first one of their cycle
        self._late_s: deque[tuple[float, float]] = deque(maxlen=_RECENT)   # time of arrival, delay after its cycle

    def begin(self, now_s: float = 0.0, *, sync: bool = True) -> None:
        """Start a cycle, before its SYNC is sent; without ``sync`` the cycle has no SYNC."""
        if self._due and not self._waits:
            self._given_up += self._due
            self._due.clear()
        if self._due or self._given_up:
            for waiting in (self._due, self._given_up):
                while waiting and now_s - waiting[0] > ANSWER_WITHIN_S:
                    waiting.popleft()
        if not self._due:
            self._half = None          # a half of another cycle must not complete this one
        if sync:
            self._due.append(now_s)
        self._begun_s = now_s
        self._here = 0
        self._spoiled = False
        self.data = NO_WORD
        self.over = False

    def doubted(self) -> bool:
        """Return whether more than one TPDO1 came for a SYNC since the last call."""
        extra, self._extra = self._extra, False
        return extra

    def on_foreign_sync(self) -> None:
        """Count a SYNC of another master: the drive answers that one too."""
        self._given_up.append(self._begun_s)

    def late_since(self, since_s: float) -> list[float]:
        """Return the delays of answers that came after the end of their cycles, s, for arrivals since ``since_s``."""
        return [late_s for came_s, late_s in self._late_s if came_s >= since_s]

    @property
    def done(self) -> bool:
        """True if no more frames are expected in this cycle."""
        if self._now_s is None:
            return self.over or (bool(self.data) and not self._ends_cycles)
        return bool(self.data) and not self._doubtful

    def settle(self) -> None:
        """End the cycle's waiting time, in real time."""
        if self._doubtful:
            self._doubtful = False
            if self._here > 1:         # the answer given up has come, so the first was not this cycle's
                self.data = NO_WORD
            return
        if self.data or not self._due:
            return
        took_s, quickest_s = self._last_s - self._begun_s, self._quickest_s
        self._doubtful = (         # a single answer, at the usual time after this cycle's SYNC
            self._here == 1 and quickest_s is not None
            and abs(took_s - self._usual_s) <= _USUAL_SHARE * self._period_s
            and took_s >= _QUICKEST_SHARE * quickest_s
        )
        # A drive that has never answered was not yet listening.
        if self._doubtful or not self.arrived or (self._spoiled and not self._here):
            self._given_up += self._due
            self._due.clear()

    def on_tpdo1(self, data: bytes) -> None:
        """Handle 180h + node. A frame of another length is not decoded; if no other comes, it was the answer."""
        if len(data) != self._size:
            self._spoiled = True
        elif self._wide:
            self._join(False, data)
        else:
            self._take(data)

    def on_status(self, status: bytes) -> None:
        """Handle the statusword in a wide drive's TPDO2; its two TPDOs of one SYNC come in any order."""
        self._join(True, status)

    def on_cycle_end(self, data: bytes) -> None:
        """Handle the cycle end of a simulated peer with scripted faults, in stepped time (`CYCLE_ID`)."""
        self._ends_cycles = data != LAST_CYCLE_OVER
        self.over = data != CYCLES_END

    def _join(self, is_status: bool, data: bytes) -> None:
        now_s = 0.0 if self._now_s is None else self._now_s()
        half, self._half = self._half, None
        if half is not None and self._waits and now_s - half[0] > 0.5 * self._period_s:
            half = None                # the other half was lost, since both come together
        if half is None or half[1] is is_status:
            self._half = (now_s, is_status, data)
        else:
            self._take(data + half[2] if is_status else half[2] + data)

    def _take(self, data: bytes) -> None:
        now_s = 0.0 if self._now_s is None else self._now_s()
        self.arrived += 1
        self._here += 1
        self._last_s = now_s
        if self._here > 1:
            self._extra = True
            self.second += self._ends_cycles
        if not self._due:
            if self._given_up:
                self._given_up.popleft()
            elif data != self.data:
                self.contradictions += 1
            return
        asked_s = self._due.popleft()
        if self._due:
            self.older += 1
            self._late_s.append((now_s, now_s - asked_s - self._period_s))
            return
        self.data = data
        if self._here == 1 and self._now_s is not None:
            self._learn(now_s - asked_s)

    def _learn(self, took_s: float) -> None:
        took_s = min(took_s, self._period_s)
        first = self._quickest_s is None
        self._quickest_s = took_s if self._quickest_s is None else min(self._quickest_s, took_s)
        self._usual_s += (1.0 if first else 0.1) * (took_s - self._usual_s)
