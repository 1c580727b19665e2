"""What the drive says unasked: heartbeat, boot-up and emergency messages.

Each kind of trouble is kept until it has been raised, once, in the order in which they came; a stop sequence that
goes on exchanging is then not disturbed by it again.
"""

from collections import Counter, deque
from collections.abc import Callable

from drivers.clock import Clock
from drivers.errors import CommunicationLost, DriveFault, TdhilError
from drivers.ticks import LOWER_THE_RATE

BOOT_UP = 0x00
STOPPED = 0x04
OPERATIONAL = 0x05
PRE_OPERATIONAL = 0x7F

_NMT_NAMES = {STOPPED: "stopped", OPERATIONAL: "operational", PRE_OPERATIONAL: "pre-operational"}

FOREIGN_FRAMES, FOREIGN_S = 3, 1.0
"""So many frames within this time that only the drive sends, besides its own, are another drive's."""
FOREIGN_IN_A_RUN = 2
"""So many frames of one kind that only we send (SYNC, the drive's RPDOs, our heartbeat) are another node's, however far
apart: CAN's checksum lets no frame become another one by accident. Before the start it takes `FOREIGN_FRAMES`, for what
another run left in a queue is then still under way."""

START_GRACE_S = 0.5
"""A heartbeat that was under way when the node was started still says pre-operational."""

HOST_LOST = 0x8130
"""EMCY of a drive that lost its host: life guard or heartbeat error (CiA 301)."""

HOST_SILENT = "host silent"
OF_A_SILENT_HOST = ("heartbeat", "nmt", HOST_SILENT)
"""Kinds of trouble that a host which was away brings about, or takes for the drive's."""

# EMCY error code classes (CiA 301) and the CiA 402 codes a field engineer meets first.
_EMCY_CLASSES = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current, input side",
    0x22: "current inside the drive",
    0x23: "current, output side (short circuit or overload)",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "DC link voltage",
    0x33: "output voltage",
    0x40: "temperature",
    0x42: "drive temperature",
    0x43: "motor temperature",
    0x50: "drive hardware",
    0x54: "power section (or STO)",
    0x60: "drive software",
    0x70: "additional modules",
    0x73: "sensor",
    0x75: "communication module",
    0x80: "monitoring",
    0x81: "communication (host heartbeat lost, CAN overrun or passive)",
    0x82: "protocol error (PDO length)",
    0x84: "speed controller (speed limit or following error)",
    0x86: "positioning",
    0x90: "external error",
    0xF0: "additional functions",
}


def emcy_text(code: int) -> str:
    """What an EMCY error code means, by its class."""
    meaning = _EMCY_CLASSES.get(code >> 8) or _EMCY_CLASSES.get(code >> 8 & 0xF0) or "manufacturer specific"
    return f"EMCY {code:04X}h, {meaning}"


class Watch:
    """Follows one node. ``allowed_silence_s`` is how long its heartbeat may fail to come (0 = not watched).

    Where the drive is guarded instead, `Guarding` hands on its answers as if they were heartbeats.
    """

    def __init__(self, node: int, clock: Clock) -> None:
        self._node = node
        self._clock = clock
        self._heard_s: float | None = None
        self._troubles: list[tuple[str, TdhilError]] = []
        self._raised: set[str] = set()
        self._foreign_s: deque[float] = deque(maxlen=FOREIGN_FRAMES)
        self.foreign: Counter[str] = Counter()     # frames of somebody else since the start, by their kind
        self._contradicted_s: deque[float] = deque(maxlen=FOREIGN_FRAMES)
        self._started_s = 0.0
        self._operational = False
        self.allowed_silence_s = 0.0
        self.expect_operational = False
        self.emcy_code = 0
        self.nmt_state: int | None = None      # as the drive last told it; None before
        self.sign_of_life: Callable[[], tuple[str, str]] = lambda: ("heartbeat has been missing", "1017h")
        self.host_stood_still: Callable[[], str] = lambda: ""
        """What is to be said of this host first, where it was away itself; empty: it wasn't."""

    def on_heartbeat(self, data: bytes) -> None:
        """700h + node: the NMT state, or 0 for boot-up."""
        if not data:
            return
        state = data[0] & 0x7F
        self._heard_s = self._clock.now_s()
        self.nmt_state = state
        if not self.expect_operational:
            return
        if state == BOOT_UP:
            self._keep(
                "boot-up",
                DriveFault(
                    "the drive restarted in the middle of the run (boot-up message)",
                    where=f"node {self._node}",
                    next_step="It is not enabled again by itself. Find out why it restarted, then start anew",
                ),
            )
        elif state == OPERATIONAL:
            self._operational = True
        elif self._operational or self._clock.now_s() - self._started_s > START_GRACE_S:
            self._keep(
                "nmt",
                CommunicationLost(
                    f"somebody put the drive into NMT state {_NMT_NAMES.get(state, state)}",
                    where=f"node {self._node}",
                    next_step="Is a second master on the bus? Take it off and start anew",
                ),
            )

    def on_emcy(self, data: bytes) -> None:
        """080h + node: error code u16, error register u8, manufacturer's bytes; code 0 = all errors gone."""
        if len(data) < 2:
            return
        code = int.from_bytes(data[:2], "little")
        self.emcy_code = code
        if code == HOST_LOST and self.expect_operational:
            self._keep(
                HOST_SILENT,
                CommunicationLost(
                    f"the drive's watchdog has acted: {emcy_text(code)}",
                    where=f"node {self._node}",
                    next_step="This host was silent for too long (frozen, asleep, overloaded) or its frames were lost",
                ),
            )
        elif code and self.expect_operational:
            extra = data[3:].hex(" ")
            self._keep(
                "emcy",
                DriveFault(
                    emcy_text(code) + (f" (manufacturer's bytes {extra})" if any(data[3:]) else ""),
                    where=f"node {self._node}",
                    next_step="See the drive's own fault list, mend the cause, then start with --reset-fault",
                ),
            )

    def on_foreign(self, kind: str, why: str = "") -> None:
        """A frame of a kind that we send came in: somebody else drives this drive, or is about to.

        ``kind``: as people call it; ``why`` it matters, where it isn't a master's.
        """
        self.foreign[kind] += 1
        if self.expect_operational:
            certain = self.foreign[kind] >= FOREIGN_IN_A_RUN
        else:
            certain = self._no_accident(self._foreign_s)
        if certain:
            self.interference(
                why or f"a second master is on the bus: it sends {kind} of its own",
                f"node {self._node}",
                "Take it off the bus, or give it other identifiers, and start anew",
                kind="master",
            )

    def interference(self, what: str, where: str, next_step: str, *, kind: str) -> None:
        """Somebody else changes this drive or drives it; raised by `check`, once for each ``kind``."""
        self._keep(kind, CommunicationLost(what, where=where, next_step=next_step))

    def on_contradiction(self) -> None:
        """A frame of feedback that the drive can't have sent, if it sent the one before it for the same SYNC."""
        if self._no_accident(self._contradicted_s):
            self._keep(
                "feedback",
                CommunicationLost(
                    "feedback comes more than once for a SYNC, and says different things: somebody else sends it too",
                    where=f"node {self._node}, TPDO1 ({0x180 + self._node:03X}h)",
                    next_step="Is the node-ID given twice, or a recording being played back? Mend it and start anew",
                ),
            )

    def check(self) -> None:
        """Raise the oldest trouble not raised yet."""
        if self.overdue and self._heard_s is not None:
            missing, where = self.sign_of_life()
            self._keep(
                "heartbeat",
                CommunicationLost(
                    f"the drive's {missing} for {self._clock.now_s() - self._heard_s:.2f} s",
                    where=f"node {self._node}, {where}",
                    next_step="Check the drive's supply and the bus; the drive's own watchdog stops the shaft",
                ),
            )
        if self._troubles:
            kind, trouble = self._troubles.pop(0)
            raise self._of_host(trouble) if kind in OF_A_SILENT_HOST else trouble

    @property
    def overdue(self) -> bool:
        """Has the drive's sign of life been missing for too long, as far as its frames have been read?"""
        silent_s = 0.0 if self._heard_s is None else self._clock.now_s() - self._heard_s
        return 0.0 < self.allowed_silence_s < silent_s

    def _of_host(self, trouble: TdhilError) -> TdhilError:
        """The same, where this host was away: that comes first, and may be all there is to it."""
        away = self.host_stood_still()
        if not away:
            return trouble
        return CommunicationLost(
            f"{away}; after that: {trouble.what}", where=f"host; {trouble.where}", next_step=LOWER_THE_RATE
        )

    def start(self, allowed_silence_s: float) -> None:
        """From now on silence, boot-up, EMCY and foreign NMT commands are trouble."""
        self._heard_s = self._started_s = self._clock.now_s()
        self._operational = False
        self.foreign.clear()
        self.allowed_silence_s = allowed_silence_s
        self.expect_operational = True

    def stop(self) -> None:
        """Nothing is trouble any more."""
        self.expect_operational = False
        self.allowed_silence_s = 0.0

    def _no_accident(self, seen_s: deque[float]) -> bool:
        """One more now; have there been so many within the time?"""
        now_s = self._clock.now_s()
        seen_s.append(now_s)
        return len(seen_s) == FOREIGN_FRAMES and now_s - seen_s[0] <= FOREIGN_S

    def _keep(self, kind: str, trouble: TdhilError) -> None:
        if kind not in self._raised:
            self._raised.add(kind)
            self._troubles.append((kind, trouble))
