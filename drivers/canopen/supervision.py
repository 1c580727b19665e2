"""Supervision of the drive during a run: heartbeat, boot-up, emergency messages, and read-back of its settings.

Each kind of error is kept until it was raised once, in the order of occurrence. So it does not disturb a stop sequence
that continues to exchange.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from drivers.canopen.bus import CanLink
from drivers.canopen.sdo import name
from drivers.clock import LOWER_THE_RATE, Clock
from drivers.errors import CommunicationLost, DriveFault, TdhilError
from profiles import MessageCode
from profiles.canopen import CanopenProfile

BOOT_UP = 0x00
STOPPED = 0x04
OPERATIONAL = 0x05
PRE_OPERATIONAL = 0x7F

_NMT_NAMES = {STOPPED: "stopped", OPERATIONAL: "operational", PRE_OPERATIONAL: "pre-operational"}

FOREIGN_FRAMES, FOREIGN_S = 3, 1.0
"""This number of foreign frames within this time, s, with an identifier that only the drive sends: another drive."""
FOREIGN_IN_A_RUN = 2
"""This number of frames of one kind that only we send (SYNC, the drive's RPDOs, our heartbeat) shows another node, at
any distance in time: CAN's checksum excludes an accident. Before the start it takes `FOREIGN_FRAMES`, because frames
from the queue of another run may still arrive."""

START_GRACE_S = 0.5
"""A heartbeat that was in transit when the node was started still reports pre-operational."""

HOST_LOST = 0x8130
"""EMCY of a drive that lost its host: life guard error or heartbeat error (CiA 301)."""

HOST_SILENT = "host silent"
THIN = "thin feedback"
OF_A_LATE_HOST = (HOST_SILENT, THIN)
OF_A_SILENT_HOST = ("heartbeat", "nmt", *OF_A_LATE_HOST)
"""Kinds of error that a delay of this host causes, or that it mistakes for errors of the drive."""

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
    """Return the meaning of an EMCY error code, by its class."""
    meaning = _EMCY_CLASSES.get(code >> 8) or _EMCY_CLASSES.get(code >> 8 & 0xF0) or "manufacturer specific"
    return f"EMCY {code:04X}h, {meaning}"


class NodeWatch:
    """Follows one node. ``allowed_silence_s`` is the longest time without a heartbeat (0 = not supervised).

    With node guarding, `Guarding` passes the answers on as if they were heartbeats.
    """

    def __init__(self, node: int, clock: Clock) -> None:
        self._node = node
        self._clock = clock
        self._heard_s: float | None = None
        self._troubles: list[tuple[str, TdhilError]] = []
        self._raised: set[str] = set()
        self._foreign_s: deque[float] = deque(maxlen=FOREIGN_FRAMES)
        self.foreign: Counter[str] = Counter()     # foreign frames since the start, by kind
        self._contradicted_s: deque[float] = deque(maxlen=FOREIGN_FRAMES)
        self._started_s = 0.0
        self._operational = False
        self.allowed_silence_s = 0.0
        self.expect_operational = False
        self.emcy_code = 0
        self.nmt_state: int | None = None      # last reported by the drive; None before
        self.on_boot_up: Callable[[], None] = lambda: None
        self.sign_of_life: Callable[[], tuple[str, str]] = lambda: ("heartbeat has been missing", "1017h")
        self.host_stood_still: Callable[[], str] = lambda: ""
        """Returns the delay of this host, in words, to report before the error; empty if there was none."""
        self.host_late: Callable[[], str] = lambda: ""
        """The same for repeated short delays, on which a drive's watchdog acts."""

    def on_heartbeat(self, data: bytes) -> None:
        """Handle 700h + node: the NMT state, or 0 for boot-up."""
        if not data:
            return
        state = data[0] & 0x7F
        self._heard_s = self._clock.now_s()
        self.nmt_state = state
        if state == BOOT_UP:
            self.on_boot_up()
        if not self.expect_operational:
            return
        if state == BOOT_UP:
            self._keep(
                "boot-up",
                DriveFault(
                    "the drive restarted during the run (boot-up message)",
                    where=f"node {self._node}",
                    next_step="tdhil does not enable it again. Find the cause of the restart, then start again",
                    entry=MessageCode.DRIVE_RESTARTED,
                ),
            )
        elif state == OPERATIONAL:
            self._operational = True
        elif self._operational or self._clock.now_s() - self._started_s > START_GRACE_S:
            self._keep(
                "nmt",
                CommunicationLost(
                    f"another master put the drive into NMT state {_NMT_NAMES.get(state, state)}",
                    where=f"node {self._node}",
                    next_step="Disconnect the second master from the bus, and start again",
                    entry=MessageCode.FOREIGN_MASTER,
                ),
            )

    def on_emcy(self, data: bytes) -> None:
        """Handle 080h + node: error code u16, error register u8, manufacturer's bytes; code 0 = no error left."""
        if len(data) < 2:
            return
        code = int.from_bytes(data[:2], "little")
        self.emcy_code = code
        if code == HOST_LOST and self.expect_operational:
            self._keep(
                HOST_SILENT,
                CommunicationLost(
                    f"the drive's watchdog has tripped: {emcy_text(code)}",
                    where=f"host or bus, reported by node {self._node}",
                    next_step="This host was silent for too long (frozen, asleep, overloaded) or its frames were lost",
                    entry=MessageCode.WATCHDOG_ACTED,
                ),
            )
        elif code and self.expect_operational:
            extra = data[3:].hex(" ")
            self._keep(
                "emcy",
                DriveFault(
                    emcy_text(code) + (f" (manufacturer's bytes {extra})" if any(data[3:]) else ""),
                    where=f"node {self._node}",
                    next_step="See the drive's fault list, remove the cause, then start with --reset-fault",
                ),
            )

    def on_foreign(self, kind: str, why: str = "") -> None:
        """Handle a frame of a kind that only this host sends: another master drives this drive, or is about to.

        ``kind``: name for messages; ``why``: its effect, if it is not a master's frame.
        """
        self.foreign[kind] += 1
        if self.expect_operational:
            certain = self.foreign[kind] >= FOREIGN_IN_A_RUN
        else:
            certain = self._no_accident(self._foreign_s)
        if certain:
            self.interference(
                why or f"a second master is on the bus: it sends {kind}",
                f"node {self._node}",
                "Disconnect it from the bus, or give it other identifiers, and start again",
                kind="master",
            )

    def interference(self, what: str, where: str, next_step: str, *, kind: str) -> None:
        """Record that another master changes or drives this drive; `check` raises it once for each ``kind``."""
        self._keep(kind, CommunicationLost(what, where=where, next_step=next_step))

    def thin_feedback(self, missed: int, cycles: int, period_s: float, where: str) -> None:
        """Record that ``missed`` of the last cycles brought no feedback."""
        self._keep(
            THIN,
            CommunicationLost(
                f"{missed} of the last {cycles} cycles ({cycles * period_s:.2g} s) brought no feedback",
                where=f"node {self._node}, {where}",
                next_step="Check the TPDO's transmission type and mapping, the bus load and the cable",
                entry=MessageCode.FEEDBACK_LOST,
            ),
        )

    def on_contradiction(self) -> None:
        """Handle a feedback frame that contradicts an earlier one for the same SYNC: one of them is foreign."""
        if self._no_accident(self._contradicted_s):
            self._keep(
                "feedback",
                CommunicationLost(
                    "several different feedback frames come for one SYNC: another node sends them too",
                    where=f"node {self._node}, TPDO1 ({0x180 + self._node:03X}h)",
                    next_step="Check for a duplicate node-ID, or a recording that is played back; start again",
                    entry=MessageCode.FOREIGN_MASTER,
                ),
            )

    def check(self) -> None:
        """Raise the oldest error that was not raised yet."""
        if self.overdue and self._heard_s is not None:
            missing, where = self.sign_of_life()
            self._keep(
                "heartbeat",
                CommunicationLost(
                    f"the drive's {missing} for {self._clock.now_s() - self._heard_s:.2f} s",
                    where=f"node {self._node}, {where}",
                    next_step="Check the drive's supply and the bus. The drive's own watchdog stops the shaft",
                    entry=MessageCode.FEEDBACK_LOST,
                ),
            )
        if self._troubles:
            kind, trouble = self._troubles.pop(0)
            raise self._of_host(kind, trouble) if kind in OF_A_SILENT_HOST else trouble

    @property
    def overdue(self) -> bool:
        """True if the drive's heartbeat has been missing for too long, in the frames read so far."""
        silent_s = 0.0 if self._heard_s is None else self._clock.now_s() - self._heard_s
        return 0.0 < self.allowed_silence_s < silent_s

    def _of_host(self, kind: str, trouble: TdhilError) -> TdhilError:
        """Return the error with the delay of this host in front, if there was one: the delay may be its only cause.

        The drive's watchdog also trips on many cycles that are each only a little late.
        """
        away = self.host_late() if kind in OF_A_LATE_HOST else self.host_stood_still()
        if not away:
            return trouble
        where = trouble.where if kind == HOST_SILENT else f"host; {trouble.where}"
        return CommunicationLost(f"{away}. After that: {trouble.what}", where=where, next_step=LOWER_THE_RATE,
                                 entry=MessageCode.HOST_LATE)

    def start(self, allowed_silence_s: float) -> None:
        """Treat silence, boot-up, EMCY and foreign NMT commands as errors from now on."""
        self._heard_s = self._started_s = self._clock.now_s()
        self._operational = False
        self.foreign.clear()
        self.allowed_silence_s = allowed_silence_s
        self.expect_operational = True

    def stop(self) -> None:
        """End the supervision."""
        self.expect_operational = False
        self.allowed_silence_s = 0.0

    def _no_accident(self, seen_s: deque[float]) -> bool:
        """Count one more event. Return whether `FOREIGN_FRAMES` came within `FOREIGN_S`."""
        now_s = self._clock.now_s()
        seen_s.append(now_s)
        return len(seen_s) == FOREIGN_FRAMES and now_s - seen_s[0] <= FOREIGN_S

    def _keep(self, kind: str, trouble: TdhilError) -> None:
        if kind not in self._raised:
            self._raised.add(kind)
            self._troubles.append((kind, trouble))


# ---------------------------------------------------------------------------------------------------------------------
# Node guarding, the host's side (CiA 301): the watchdog of drives without a heartbeat consumer.
#
# ::
#
#     host   700h + node, remote frame     ─►  the drive restarts its life time (100Ch x 100Dh)
#     drive  700h + node, toggle | state   ─►  bit 7 changes with every answer, bits 0 to 6 are the NMT state
#
# The control loop itself sends the requests, so that a frozen or dead host is silent and the drive's watchdog trips. An
# answer without a toggle does not count: it is an old frame, or another station's. `NodeWatch` checks the state and the
# longest time without one.


class Guarding:
    """Node guarding by this host; ``ask`` puts the remote frame on the bus."""

    def __init__(self, watch: NodeWatch, ask: Callable[[], None]) -> None:
        self._watch = watch
        self._ask = ask
        self._toggle: int | None = None
        self.asked = self.answers = self.repeated = 0
        watch.sign_of_life = self._missing

    def feed(self) -> None:
        """Send one request."""
        self.asked += 1
        self._ask()

    def on_frame(self, data: bytes) -> None:
        """Handle 700h + node from the drive."""
        if not data:
            return
        state, toggle = data[0] & 0x7F, data[0] >> 7
        if state == BOOT_UP:
            self._toggle = None
        elif toggle == self._toggle:
            self.repeated += 1
            return
        else:
            self._toggle = toggle
            self.answers += 1
            self.repeated = 0
        self._watch.on_heartbeat(bytes((state,)))

    def _missing(self) -> tuple[str, str]:
        if self.repeated:
            return f"answers to node guarding have not toggled ({self.repeated} alike)", "100Ch"
        return "answers to node guarding have been missing", "100Ch"


# ---------------------------------------------------------------------------------------------------------------------
# Read-back of the settings that preflight made: two objects a second, beside the cycle, during the whole run.
#
# A tool, the drive's panel or another fieldbus may change the watchdog, its reaction, the quick stop or a limit while
# the shaft turns, without any frame on this bus. So a request is sent after a cycle's feedback; tdhil does not wait for
# the answer and checks it when it comes (SDO upload, expedited, CiA 301). Watchdog and quick stop have every third
# turn, limits and setpoints another, and the content of the feedback frames (mapping, transmission type, COB-ID of the
# TPDOs) the third. So a change shows within 0.5 s times three times the number of objects in its group. An object that
# a tool writes on this bus is checked in the next cycle.
#
# Setpoints and mode (6071h, 60FFh, 6060h) are read too: they must be the values that this host sent last. A drive
# echoes them if it has returned a value of ours other than zero. Only then does another value come from another master.
#
# An answer that differs is requested again at once, and counts the second time (a setpoint the third time). The changed
# value is written back once before the stop, because the stop may depend on it (605Ah). Some drives do not answer SDO
# requests while running; tdhil reports this and continues. If a drive stops answering after it has answered before,
# `LOST` missed replies count as a lost connection.


READ_BACK_EVERY_S = 0.5
READ_BACK_ANSWER_S = 0.5
"""Control time for an answer, s."""
GIVE_UP, LOST = 5, 10
"""Unanswered requests in a row: limit for a drive that never answered, and for one that did."""
TRIES = 2
REMEMBERED = 8
"""Number of cycles whose setpoints an answer may show."""
_UPLOAD, _ABORT = 2, 4


class Group(Enum):
    """Objects that are read back in the same turn."""

    SAFETY = "watchdog, its reaction, quick stop"
    REST = "limits, setpoints, RPDOs"
    FEEDBACK = "what the TPDOs carry, and when"


@dataclass(eq=False)
class _WatchedObject:
    """``data``: required value; None: one of the setpoints sent last."""

    index: int
    sub: int
    title: str
    data: bytes | None
    differs: int = 0
    refused: int = 0
    echoed: bool = False


class ReadBack:
    """``ask`` puts an upload request on the bus; `step` is called once a cycle, `take` for each SDO answer."""

    def __init__(self, watch: NodeWatch, ask: Callable[[bytes], None], tell: Callable[[str], None], node: int) -> None:
        self._watch = watch
        self._ask = ask
        self._tell = tell
        self._node = node
        self._groups: dict[Group, list[_WatchedObject]] = {group: [] for group in Group}
        self.on_changed: Callable[[int, int], None] = lambda index, sub: None
        """Called with index and sub-index of an object that another master changed, before the error is raised."""
        self._next: deque[_WatchedObject] = deque()      # to read before their turn
        self._turn = 0
        self._asked: _WatchedObject | None = None
        self._asked_s = 0.0
        self._due_s: float | None = None
        self._silent = 0
        self._answered = False
        self._over = False
        self._sent: dict[int, deque[int]] = {}

    def clear(self) -> None:
        """Remove all objects."""
        for group in self._groups.values():
            group.clear()
        self._sent.clear()
        self._next.clear()

    def watch(self, title: str, index: int, sub: int, data: bytes, group: Group) -> None:
        """Add an object that must keep its value."""
        self._groups[group].append(_WatchedObject(index, sub, title, data))

    def stands(self, index: int, sub: int, data: bytes) -> None:
        """Note that this host has written a watched object itself."""
        for one in self._all():
            if (one.index, one.sub) == (index, sub):
                one.data = data

    def watch_setpoint(self, title: str, index: int) -> None:
        """Add an object that must show the setpoint sent (`sent`)."""
        self._sent[index] = deque(maxlen=REMEMBERED)
        self._groups[Group.REST].append(_WatchedObject(index, 0, title, None))

    def sent(self, index: int, value: int) -> None:
        """Record a setpoint that was sent in this cycle."""
        if index in self._sent:
            self._sent[index].append(value)

    def soon(self, index: int, sub: int) -> None:
        """Read this object before its turn, because another master wrote it."""
        for one in self._all():
            if (one.index, one.sub) == (index, sub) and one not in self._next:
                self._next.append(one)

    def put_back(self, index: int, sub: int) -> None:
        """Write the required value into a supervised object, without waiting for an answer (SDO download,
        expedited).
        """
        for one in self._all():
            if (one.index, one.sub) == (index, sub) and one.data is not None:
                command = 0x23 | (4 - len(one.data)) << 2
                self._ask(bytes((command,)) + self._head(one) + one.data.ljust(4, b"\0"))

    def step(self, now_s: float) -> None:
        """Send the next request, after a cycle's feedback."""
        if self._over or not any(self._groups.values()):
            return
        if self._asked is not None:
            if now_s - self._asked_s < READ_BACK_ANSWER_S:
                return
            self._asked = None
            self._unanswered()
        if self._due_s is None:
            self._due_s = now_s
        if self._next or now_s >= self._due_s - 1e-9:
            if not self._next:
                self._due_s = now_s + READ_BACK_EVERY_S
            self._asked, self._asked_s = self._choose(), now_s
            self._ask(bytes((_UPLOAD << 5,)) + self._head(self._asked) + bytes(4))

    def take(self, data: bytes) -> None:
        """Handle an SDO answer of the drive, to this or another client."""
        one = self._asked
        if one is None or len(data) != 8 or data[1:4] != self._head(one):
            return
        command = data[0] >> 5
        if command == _ABORT:
            self._asked, self._silent = None, 0
            one.refused += 1
            if one.refused == GIVE_UP:
                self._tell(f"the drive refuses to read {name(one.index, one.sub)} in motion; it is not supervised")
                self._drop(one)
        elif command == _UPLOAD and data[0] & 0x02:
            self._asked, self._silent, self._answered = None, 0, True
            self._compare(one, data[4 : 8 - (data[0] >> 2 & 3 if data[0] & 1 else 0)])

    def _choose(self) -> _WatchedObject:
        if self._next:
            return self._next.popleft()
        groups = [group for group in self._groups.values() if group]
        turn, self._turn = self._turn, self._turn + 1
        group = groups[turn % len(groups)]
        return group[turn // len(groups) % len(group)]

    def _all(self) -> list[_WatchedObject]:
        return [one for group in self._groups.values() for one in group]

    def _compare(self, one: _WatchedObject, found: bytes) -> None:
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
            self.put_back(one.index, one.sub)      # before the stop, which may depend on it
            self.on_changed(one.index, one.sub)
            self._watch.interference(
                f"{one.title} was changed by another master during the run: {_shown(one.data)} was set,"
                f" {_shown(found)} is there now",
                f"node {self._node}, {name(one.index, one.sub)}",
                "Find the tool, panel or master that writes to this drive, disconnect it, and start again",
                kind=f"changed {one.index:04X}:{one.sub}",
            )
        else:
            self._watch.interference(
                f"{one.title} is not what this host sent: {_shown(found)} is there, {sent[-1]} was sent",
                f"node {self._node}, {name(one.index, one.sub)}",
                "A second master, a panel or another fieldbus may drive it. Disconnect it and start again",
                kind="setpoint",
            )

    def _unanswered(self) -> None:
        self._silent += 1
        if not self._answered and self._silent >= GIVE_UP:
            self._over = True
            self._tell("the drive answers no SDO requests in motion: watchdog and limits were not read back")
        elif self._answered and self._silent >= LOST:
            self._over = True
            self._watch.interference(
                f"the drive did not answer {LOST} SDO requests in a row: watchdog and limits can't be read back",
                f"node {self._node}, SDO",
                "Check a gateway in between and the load of the drive; see the frames in the log", kind="read back",
            )

    def _drop(self, one: _WatchedObject) -> None:
        for those in self._groups.values():
            if one in those:
                those.remove(one)

    @staticmethod
    def _head(one: _WatchedObject) -> bytes:
        return one.index.to_bytes(2, "little") + bytes((one.sub,))


def _shown(data: bytes) -> str:
    number = int.from_bytes(data, "little")
    return f"{number} ({number:X}h)" if number > 9 else str(number)


# ---------------------------------------------------------------------------------------------------------------------
# The host's sign of life for the drive's watchdog: a heartbeat, or a request of node guarding.
#
# Only the control loop sends it, neither a thread nor the kernel, which would outlive a frozen loop.


HEARTBEAT_S = 0.1
"""Heartbeat period in both directions, s. The host's is shorter if the watchdog is shorter than five of them."""
ANSWER_S = 0.2
"""Wall time for the answer to the first request of node guarding, s."""


class SignOfLife:
    """Sends heartbeats of ``host_node``, or guards ``node`` and takes its answers from the link."""

    def __init__(
        self, link: CanLink, watch: NodeWatch, clock: Clock, profile: CanopenProfile, *, node: int, host_node: int
    ) -> None:
        self._link = link
        self._clock = clock
        self.host_node = host_node
        self._ended = False
        self._guarding = Guarding(watch, lambda: link.ask(0x700 + node)) if _guarded(profile) else None
        self._asks = self._guarding is not None
        link.handlers[0x700 + node] = watch.on_heartbeat if self._guarding is None else self._guarding.on_frame
        self._every_s = HEARTBEAT_S
        self._next_s = 0.0

    @property
    def asks(self) -> bool:
        """True if the drive is supervised by node guarding, so that it must answer; else the host sends a heartbeat."""
        return self._asks

    def feed(self) -> None:
        """Send one now; the next is due one period later."""
        if self._ended:
            return
        if self._guarding is not None and self._asks:
            self._guarding.feed()
        else:
            self._link.send(0x700 + self.host_node, bytes((OPERATIONAL,)))
        self._next_s = self._clock.now_s() + self._every_s

    def end(self) -> None:
        """Send none any more: the drive's watchdog is to trip."""
        self._ended = True

    def feed_when_due(self, now_s: float) -> None:
        """Send one if it is due; called in every cycle."""
        if now_s >= self._next_s:
            self.feed()

    def feed_between(self) -> None:
        """Send one more between two cycles. The ones due in control time stay due."""
        due_s = self._next_s
        self.feed()
        self._next_s = due_s

    def pace(self, every_s: float) -> None:
        """Set the longest period, s."""
        self._every_s = min(HEARTBEAT_S, every_s)

    def keep_to(self, feed_s: float) -> None:
        """Set the period of the armed watchdog, s; 0: it is not armed."""
        if not feed_s:                 # not every adapter carries remote frames
            self._asks = False
        self.pace(feed_s or HEARTBEAT_S)

    def answered(self) -> bool:
        """Wait for the first answer of a guarded drive. Return whether it came."""
        guarding = self._guarding
        return guarding is None or self._link.await_answer(lambda: guarding.answers > 0, ANSWER_S)


def _guarded(profile: CanopenProfile) -> bool:
    return profile.watchdog.kind == "node_guarding"
