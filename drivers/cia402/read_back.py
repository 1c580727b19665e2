"""What preflight set is read back all through the run, one object a second beside the cycle.

A tool, the drive's own panel or another fieldbus may change the watchdog, its reaction, the quick stop or a limit while
the shaft turns; nothing on the bus need show it. So a question goes out once a cycle's feedback is in, nobody waits
for the answer, and it is looked at when it comes (SDO upload, expedited, CiA 301). The watchdog has every second turn.

Setpoints and mode (6071h, 60FFh, 6060h) are asked for too: they must be what this host sent last. A drive counts as
one that echoes them once it has given back a value of ours other than zero; only then is another value somebody else's.

An answer that differs is asked for again at once, and believed the second time (a setpoint the third). What was changed
is written back, once, before the stop that follows: that may rest on it (605Ah). A drive that answers no such question
from the beginning is let be, and that is told; one that answered and then falls silent for `LOST` turns has been lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from drivers.canopen.sdo import name
from drivers.canopen.supervision import Watch

EVERY_S = 1.0
ANSWER_S = 0.5
"""Control time for an answer."""
GIVE_UP, LOST = 5, 10
"""So many questions in a row without an answer: of a drive that never answered, and of one that did."""
TRIES = 2
REMEMBERED = 8
"""Cycles: an answer may show any setpoint that was sent so lately."""
_UPLOAD, _ABORT = 2, 4


@dataclass(eq=False)
class _Watched:
    """``data``: what must stand there; None: one of the setpoints sent last."""

    index: int
    sub: int
    title: str
    data: bytes | None
    differs: int = 0
    refused: int = 0
    echoed: bool = False


class ReadBack:
    """``ask`` puts an upload request on the bus; `step` is called once a cycle, `take` for each SDO answer."""

    def __init__(self, watch: Watch, ask: Callable[[bytes], None], tell: Callable[[str], None], node: int) -> None:
        self._watch = watch
        self._ask = ask
        self._tell = tell
        self._node = node
        self._first: list[_Watched] = []
        self._rest: list[_Watched] = []
        self._next: deque[_Watched] = deque()      # before their turn
        self._turn = 0
        self._asked: _Watched | None = None
        self._asked_s = 0.0
        self._due_s: float | None = None
        self._silent = 0
        self._answered = False
        self._over = False
        self._sent: dict[int, deque[int]] = {}

    def clear(self) -> None:
        """Nothing is watched."""
        self._first, self._rest = [], []
        self._sent.clear()
        self._next.clear()

    def watch(self, title: str, index: int, sub: int, data: bytes, *, often: bool = False) -> None:
        """One object that must stay as it is; ``often``: every second turn is for these."""
        (self._first if often else self._rest).append(_Watched(index, sub, title, data))

    def watch_setpoint(self, title: str, index: int) -> None:
        """One object that must show what was sent (`sent`)."""
        self._sent[index] = deque(maxlen=REMEMBERED)
        self._rest.append(_Watched(index, 0, title, None))

    def sent(self, index: int, value: int) -> None:
        """A setpoint went out in this cycle."""
        if index in self._sent:
            self._sent[index].append(value)

    def soon(self, index: int, sub: int) -> None:
        """Somebody wrote this object: ask for it before its turn."""
        for one in (*self._first, *self._rest):
            if (one.index, one.sub) == (index, sub) and one not in self._next:
                self._next.append(one)

    def put_back(self, index: int, sub: int) -> None:
        """Write what must stand in a watched object, and wait for no answer (SDO download, expedited)."""
        for one in (*self._first, *self._rest):
            if (one.index, one.sub) == (index, sub) and one.data is not None:
                command = 0x23 | (4 - len(one.data)) << 2
                self._ask(bytes((command,)) + self._head(one) + one.data.ljust(4, b"\0"))

    def step(self, now_s: float) -> None:
        """After a cycle's feedback."""
        if self._over or not (self._first or self._rest):
            return
        if self._asked is not None:
            if now_s - self._asked_s < ANSWER_S:
                return
            self._asked = None
            self._unanswered()
        if self._due_s is None:
            self._due_s = now_s
        if self._next or now_s >= self._due_s - 1e-9:
            if not self._next:
                self._due_s = now_s + EVERY_S
            self._asked, self._asked_s = self._choose(), now_s
            self._ask(bytes((_UPLOAD << 5,)) + self._head(self._asked) + bytes(4))

    def take(self, data: bytes) -> None:
        """An SDO answer of the drive, whosever question it is."""
        one = self._asked
        if one is None or len(data) != 8 or data[1:4] != self._head(one):
            return
        command = data[0] >> 5
        if command == _ABORT:
            self._asked, self._silent = None, 0
            one.refused += 1
            if one.refused == GIVE_UP:
                self._tell(f"the drive refuses to give {name(one.index, one.sub)} in motion: it is not read back")
                self._drop(one)
        elif command == _UPLOAD and data[0] & 0x02:
            self._asked, self._silent, self._answered = None, 0, True
            self._compare(one, data[4 : 8 - (data[0] >> 2 & 3 if data[0] & 1 else 0)])

    def _choose(self) -> _Watched:
        if self._next:
            return self._next.popleft()
        turn, self._turn = self._turn, self._turn + 1
        if self._first and (turn % 2 == 0 or not self._rest):
            return self._first[turn // 2 % len(self._first)]
        return self._rest[turn // 2 % len(self._rest)]

    def _compare(self, one: _Watched, found: bytes) -> None:
        if one.data is not None:
            good = found[: len(one.data)] == one.data
        else:
            value, sent = int.from_bytes(found, "little", signed=True), self._sent[one.index]
            good = value in sent
            one.echoed = one.echoed or (good and value != 0)
            if not good and not one.echoed:
                return
        if good:
            one.differs = 0
            return
        one.differs += 1
        if one.differs < TRIES + (one.data is None):
            self._next.appendleft(one)
        elif one.data is not None:
            self.put_back(one.index, one.sub)      # before the stop that follows, which may rest on it
            self._watch.interference(
                f"{one.title} was changed by somebody else in the run: {_shown(one.data)} was set, {_shown(found)}"
                " stands there now",
                f"node {self._node}, {name(one.index, one.sub)}",
                "Find the tool, panel or master that writes to this drive, take it off, and start anew",
                kind=f"changed {one.index:04X}:{one.sub}",
            )
        else:
            self._watch.interference(
                f"{one.title} is not what this host sent: {_shown(found)} stands there, and {sent[-1]} was sent",
                f"node {self._node}, {name(one.index, one.sub)}",
                "Is a second master, a panel or another fieldbus driving it? Take it off and start anew",
                kind="setpoint",
            )

    def _unanswered(self) -> None:
        self._silent += 1
        if not self._answered and self._silent >= GIVE_UP:
            self._over = True
            self._tell("the drive answers no SDO while it runs: watchdog and limits were not read back in motion")
        elif self._answered and self._silent >= LOST:
            self._over = True
            self._watch.interference(
                f"the drive left {LOST} questions in a row unanswered: watchdog and limits can't be read back any more",
                f"node {self._node}, SDO",
                "Is a gateway between, or the drive overloaded? Look at the log's frames", kind="read back",
            )

    def _drop(self, one: _Watched) -> None:
        for those in (self._first, self._rest):
            if one in those:
                those.remove(one)

    @staticmethod
    def _head(one: _Watched) -> bytes:
        return one.index.to_bytes(2, "little") + bytes((one.sub,))


def _shown(data: bytes) -> str:
    number = int.from_bytes(data, "little")
    return f"{number} ({number:X}h)" if number > 9 else str(number)
