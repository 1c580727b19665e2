"""Foreign frames on the bus: a node with the host's number, frames of another master, SDO requests of a tool.

Only this host may send these frames to this drive. If one is received, another node sent it::

    700h + host      heartbeat: it would feed the drive's watchdog (1016h) after this computer has died
    700h + node      remote frame: it would do the same for a drive that is supervised by node guarding
    080h             SYNC
    RPDOs            setpoints
    600h + node      SDO requests: a tool that reads does no harm; a tool that writes may

A single frame is reported (`NodeWatch.remark`). The second frame of a kind, at any time in the run, ends the run
(`NodeWatch`). A tool that writes driving objects (6040h, 6060h, 6071h, 60FFh) repeatedly counts as a second master too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial

from drivers.canopen.bus import CanLink, Handler
from drivers.canopen.supervision import NodeWatch
from drivers.cia402 import name
from drivers.clock import Clock
from drivers.errors import PreflightRefused
from drivers.preflight import PreflightTable
from profiles import MessageCode

LISTEN_S = 3.0
"""Duration of listening to the bus before motion, s. Heartbeats usually come at least once a second."""
HIGHEST_NODE = 127
FOREIGN_WRITES = 3
"""Number of foreign writes to driving objects in one run that shows a second master."""
DRIVING = frozenset({0x6040, 0x6042, 0x6060, 0x6071, 0x60FF})
_DOWNLOAD, _EXPEDITED, _SIZED = 1, 0x02, 0x01


class ForeignTraffic:
    """Detector of foreign frames, active from the start. ``number``: the host's node number; ``on_write``: called for
    each foreign write.
    """

    def __init__(self, link: CanLink, watch: NodeWatch, clock: Clock, *, node: int, number: int) -> None:
        self._link = link
        self._watch = watch
        self._clock = clock
        self._node = node
        self._since_s = clock.now_s()
        self._beats: Counter[int] = Counter()
        self._writes: Counter[tuple[int, int]] = Counter()
        self._last: dict[tuple[int, int], int | None] = {}
        self._armed = False
        self.number = number
        self.feeds_by_heartbeat = True             # the drive's watchdog consumes a heartbeat
        self.on_write: Callable[[int, int], None] = lambda index, sub: None
        for other in range(1, HIGHEST_NODE + 1):
            if other != node:
                link.handlers[0x700 + other] = partial(self._on_beat, other)
        link.handlers[0x600 + node] = self._on_request

    def own(self, identifier: int, kind: str, then: Handler | None = None) -> None:
        """Register an identifier that only this host sends; ``then`` gets foreign frames with it too."""

        def take(data: bytes) -> None:
            if then is not None:
                then(data)
            self._foreign(kind)

        self._link.handlers[identifier] = take

    def own_questions(self) -> None:
        """Register that the drive is supervised by node guarding, with requests from this host."""
        self.feeds_by_heartbeat = False
        self._link.remote_handlers[0x700 + self._node] = lambda data: self._foreign("questions of node guarding")

    # -- the host's number -----------------------------------------------------------------------------------

    def settle_number(self, table: PreflightTable) -> int:
        """Listen for `LISTEN_S` and choose a node number that no other node uses. Return the number.

        In stepped time no time passes without a transmission. There the frames received so far decide; later ones are
        found before motion (`refuse_shared`) and during it. Raises PreflightRefused if no number is free.
        """
        left_s = self._since_s + LISTEN_S - self._clock.now_s()
        if not self._clock.stepped and left_s > 0.0:
            self._link.pump_until(lambda: False, left_s)
        self._link.drain()
        wanted, heard = self.number, self._beats[self.number]
        if heard or wanted == self._node:
            free = [n for n in range(HIGHEST_NODE, 0, -1) if n != self._node and not self._beats[n]]
            if not free:
                raise PreflightRefused(
                    "heartbeats were received from all node numbers: none is free for this host", where="701h to 77Fh",
                    next_step="Disconnect a node from the bus",
                    entry=MessageCode.NODE_ID_CONFLICT,
                )
            self.number = free[0]
            why = f"the drive itself has {wanted}, and would feed its own watchdog" if wanted == self._node else (
                f"another node uses {wanted}: its heartbeat ({0x700 + wanted:03X}h) was received"
                f" {heard} time{'s' * (heard > 1)}; it would feed the drive's watchdog after a failure of this host")
            table.note("host's node number", f"{self.number}, because {why}", f"{0x700 + wanted:03X}h")
        self._armed = True
        return self.number

    def refuse_shared(self) -> None:
        """Refuse motion if another node sends heartbeats under the host's number. Raises PreflightRefused."""
        if self._beats[self.number] and self.feeds_by_heartbeat:
            raise PreflightRefused(
                f"another node uses this host's number {self.number}: its heartbeat would feed the drive's watchdog",
                where=f"{0x700 + self.number:03X}h",
                next_step="Give that node another number or disconnect it, and start again",
                entry=MessageCode.NODE_ID_CONFLICT,
            )

    def _on_beat(self, number: int, data: bytes) -> None:
        self._beats[number] += 1
        if self._armed and number == self.number:
            kind = f"a heartbeat under this host's number {number} ({0x700 + number:03X}h)"
            if self.feeds_by_heartbeat:
                self._foreign(kind, f"another node sends {kind}: it would feed the drive's watchdog if this host fails")
            else:
                self._watch.remark(f"another node sends {kind}")

    def _foreign(self, kind: str, why: str = "") -> None:
        self._watch.remark(f"{kind} came from another master")
        self._watch.on_foreign(kind, why)

    # -- a tool's SDO ------------------------------------------------------------------------------------------

    def _on_request(self, data: bytes) -> None:
        """Handle a foreign SDO request. Only downloads change anything (CiA 301, initiate download)."""
        if len(data) != 8 or data[0] >> 5 != _DOWNLOAD:
            return
        index, sub = int.from_bytes(data[1:3], "little"), data[3]
        key = (index, sub)
        self._writes[key] += 1
        value: int | None = None
        if data[0] & _EXPEDITED:
            size = 4 - (data[0] >> 2 & 3) if data[0] & _SIZED else 4
            value = int.from_bytes(data[4 : 4 + size], "little")
        self._last[key] = value
        self._watch.remark(f"another master wrote {_shown(index, sub, value)} by SDO")
        self.on_write(index, sub)
        driving = sum(count for (one, _), count in self._writes.items() if one in DRIVING)
        if index in DRIVING and driving >= FOREIGN_WRITES:
            self._watch.interference(
                f"a second master writes setpoints by SDO: {driving} times, last {_shown(index, sub, value)}",
                f"node {self._node}, {name(index, sub)}",
                "Disconnect it from the bus and start again", kind="sdo setpoints",
            )

    # -- remarks ---------------------------------------------------------------------------------------------------

    def summary(self) -> tuple[str, ...]:
        """Return what other masters sent during the run, with the count."""
        written = [
            f"{_shown(*key, self._last[key])} was written by another master, {count} time{'s' * (count > 1)}"
            for key, count in sorted(self._writes.items())
        ]
        heard = [
            f"{kind} came from another master, {count} time{'s' * (count > 1)}"
            for kind, count in sorted(self._watch.foreign.items())
        ]
        return (*written, *heard)


def _shown(index: int, sub: int, value: int | None) -> str:
    return f"{name(index, sub)} = {value:X}h" if value is not None else name(index, sub)
