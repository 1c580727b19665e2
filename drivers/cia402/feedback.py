"""What comes back for each SYNC: one TPDO1, the drive's own, and how it is told from others that bear its identifier.

A drive answers a SYNC once, and in the order in which they came. So there are never more answers than SYNCs, ours and
those of others; one more is a frame that was doubled on its way, or sent by somebody else: a duplicate node-ID, a
recording that is played back. The first of a cycle is then taken; which of the two is the drive's can't be told, and
while a shaft is being stopped none of several counts (`Feedback.doubted`): old frames of a shaft at rest must not end
a stop. One too many that says something else than the first contradicts it.

A host or an adapter that was late finds a burst: the answers of all the SYNCs that went out meanwhile. In stepped time,
and where a cycle is longer than anything is late, an answer that didn't come within its cycle was lost. In real time it
may still come, and the next answer is not the next SYNC's: answers are given to SYNCs in their order, and a cycle's
own is the last one. Where a cycle ends with fewer answers than SYNCs, one of them was lost or all are late, and nobody
knows which SYNC the last one belongs to: no sample of that cycle. A single one that came as soon after this cycle's
SYNC as answers do shows that an older one was lost; should that one come yet, in the next cycle, neither counts.
"""

from collections import deque
from collections.abc import Callable

from drivers.canopen.pdo import Shape
from profiles.simulator_marker import CYCLES_END, LAST_CYCLE_OVER

_NO_WORD = b""
ANSWER_WITHIN_S = 0.5
"""What hasn't been answered for so long was lost: the host gives up a drive that says nothing for half as long."""
LONGEST_LATE_S = 0.05
"""An adapter isn't late by more than a cycle that is longer than this."""
_USUAL_SHARE, _QUICKEST_SHARE = 0.25, 0.5
_RECENT = 1000


class Feedback:
    """Of the cycle under way; `begin` starts the next. ``now_s``: control time, in real time; None: nothing is late."""

    def __init__(self, shape: Shape, now_s: Callable[[], float] | None = None, period_s: float = 0.0) -> None:
        self._wide = shape.wide
        self._size = shape.data_size()
        self._now_s = now_s
        self._period_s = period_s
        self._waits = now_s is not None and period_s < LONGEST_LATE_S
        self._half: tuple[float, bool, bytes] | None = None    # when, is it the status, what
        self._due: deque[float] = deque()      # SYNCs whose answers may come yet, in order; the last is this cycle's
        self._given_up: deque[float] = deque() # answers that count as lost, and are nobody else's should they come
        self._begun_s = 0.0
        self._here = 0                 # answers since `begin`
        self._last_s = 0.0             # when the last one came
        self._spoiled = False          # one of another length has come since `begin`
        self._doubtful = False         # an answer was given up in the cycle before: it may come in this one
        self._quickest_s: float | None = None
        self._usual_s = 0.0            # from a SYNC to its answer
        self._extra = False            # since `believed` was asked last
        self._ends_cycles = False      # a simulated peer says where a cycle ends
        self.data = _NO_WORD           # statusword, torque, speed; as `Shape.feedback` packs them
        self.over = False              # the peer said so of this cycle
        self.arrived = 0               # TPDO1s, all told
        self.second = 0                # of them, a second one of a cycle that the peer had not ended yet
        self.older = 0                 # of them, those of a SYNC before this cycle's
        self.contradictions = 0        # of them, those that can't be the drive's if the first was
        self._late_s: deque[tuple[float, float]] = deque(maxlen=_RECENT)   # when one came, how long after its cycle

    def begin(self, now_s: float = 0.0, *, sync: bool = True) -> None:
        """A SYNC is about to go out; without ``sync`` none is, in this cycle."""
        if not self._waits:
            self._given_up += self._due
            self._due.clear()
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
        self.data = _NO_WORD
        self.over = False

    def doubted(self) -> bool:
        """Has more than one TPDO1 come for a SYNC since this was asked last?"""
        extra, self._extra = self._extra, False
        return extra

    def on_foreign_sync(self) -> None:
        """Somebody else's: the drive answers that one too."""
        self._given_up.append(self._begun_s)

    def late_since(self, since_s: float) -> list[float]:
        """By how much answers came after their cycles, s; those that came since then."""
        return [late_s for came_s, late_s in self._late_s if came_s >= since_s]

    @property
    def done(self) -> bool:
        """Nothing more is waited for in this cycle."""
        if self._now_s is None:
            return self.over or (bool(self.data) and not self._ends_cycles)
        return bool(self.data) and not self._doubtful

    def settle(self) -> None:
        """In real time: this cycle's time is up."""
        if self._doubtful:
            self._doubtful = False
            if self._here > 1:         # the one that was given up has come: then the first was not this cycle's
                self.data = _NO_WORD
            return
        if self.data or not self._due:
            return
        self._doubtful = self._here == 1 and self._came_as_usual()
        # A drive that has never answered wasn't listening yet.
        if self._doubtful or not self.arrived or (self._spoiled and not self._here):
            self._given_up += self._due
            self._due.clear()

    def on_tpdo1(self, data: bytes) -> None:
        """180h + node. A frame of another length says nothing; if no other comes, it was the answer."""
        if len(data) != self._size:
            self._spoiled = True
        elif self._wide:
            self._join(False, data)
        else:
            self._take(data)

    def on_status(self, status: bytes) -> None:
        """The statusword in a wide drive's TPDO2; its two TPDOs of one SYNC come in whichever order."""
        self._join(True, status)

    def on_cycle_end(self, data: bytes) -> None:
        """Of a simulated peer with scripted faults, in stepped time (`profiles.simulator_marker.CYCLE_ID`)."""
        self._ends_cycles = data != LAST_CYCLE_OVER
        self.over = data != CYCLES_END

    def _join(self, is_status: bool, data: bytes) -> None:
        now_s = 0.0 if self._now_s is None else self._now_s()
        half, self._half = self._half, None
        if half is not None and self._waits and now_s - half[0] > 0.5 * self._period_s:
            half = None                # its other half was lost: the two come together
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
        if self._here == 1:
            self._learn(now_s - asked_s)

    def _learn(self, took_s: float) -> None:
        took_s = min(took_s, self._period_s)
        first = self._quickest_s is None
        self._quickest_s = took_s if self._quickest_s is None else min(self._quickest_s, took_s)
        self._usual_s += (1.0 if first else 0.1) * (took_s - self._usual_s)

    def _came_as_usual(self) -> bool:
        took_s, quickest_s = self._last_s - self._begun_s, self._quickest_s
        if quickest_s is None:
            return False
        near = abs(took_s - self._usual_s) <= _USUAL_SHARE * self._period_s
        return near and took_s >= _QUICKEST_SHARE * quickest_s
