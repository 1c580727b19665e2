"""Supervision of a drive during a run, on any bus: its errors, remarks, and the read-back of its settings.

Each kind of error is kept until it was raised once, in the order of occurrence. So it does not disturb a stop sequence
that continues to exchange.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from drivers.cia402.objects import name
from drivers.clock import LOWER_THE_RATE, Clock
from drivers.errors import CommunicationLost, DriveFault, SensorFault, TdhilError
from profiles import MessageCode

HOST_SILENT = "host silent"
THIN = "thin feedback"
OF_A_LATE_HOST = (HOST_SILENT, THIN)
OF_A_SILENT_HOST = ("heartbeat", "nmt", *OF_A_LATE_HOST)
"""Kinds of error that a delay of this host causes. After a delay some of them only look like errors of the drive."""

MOST_REMARKS = 20
"""Largest number of different remarks in one run."""
HOST_LOST = 0x8130
"""Error code of a drive that lost its host: life guard error or heartbeat error (CiA 301)."""

_SENSOR = 0x73
"""Class of the error codes of a sensor: tachometer, incremental sensor, resolver (CiA 402)."""

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
    _SENSOR: "sensor",
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


class DriveWatch:
    """Errors of one drive during a run, and remarks. ``place``: name of the drive on its bus.

    ``allowed_silence_s`` is the longest time without a sign of life (`heard`), s; 0: not supervised.
    """

    def __init__(self, place: str, clock: Clock) -> None:
        self.place = place
        self._clock = clock
        self._heard_s: float | None = None
        self.allowed_silence_s = 0.0
        self.emcy_code = 0             # latest error code that the drive reported; 0: no error
        self.on_restart: Callable[[], None] = lambda: None
        self._troubles: list[tuple[str, TdhilError]] = []
        self._raised: set[str] = set()
        self._remarks: list[str] = []
        self._said: set[str] = set()
        self.expect_operational = False
        self.host_stood_still: Callable[[], str] = lambda: ""
        """Function that returns the delay of this host, in words, to report before the error; empty without one."""
        self.host_late: Callable[[], str] = lambda: ""
        """Function that returns repeated short delays of this host, in words. A drive's watchdog may trip because of
        them."""

    def start(self, allowed_silence_s: float) -> None:
        """Treat what happens to the drive as errors from now on. ``allowed_silence_s``: 0 = not supervised."""
        self.heard()
        self.allowed_silence_s = allowed_silence_s
        self.expect_operational = True

    def stop(self) -> None:
        """End the supervision."""
        self.expect_operational = False
        self.allowed_silence_s = 0.0

    def heard(self) -> None:
        """Record a sign of life of the drive."""
        self._heard_s = self._clock.now_s()

    @property
    def overdue(self) -> bool:
        """True if the drive's sign of life has been missing for too long, in the frames read so far."""
        return 0.0 < self.allowed_silence_s < self._silent_s

    @property
    def _silent_s(self) -> float:
        return 0.0 if self._heard_s is None else self._clock.now_s() - self._heard_s

    def silence(self) -> tuple[str, str, str]:
        """Return what is missing, where, and what to check. A bus with another sign of life overrides this."""
        return "the drive has been silent", self.place, "Check the drive's supply and the bus"

    @property
    def quiet(self) -> bool:
        """True if `check` has nothing to raise."""
        return not (self._troubles or self.overdue)

    def check(self) -> None:
        """Raise the oldest error that was not raised yet."""
        if self.overdue:
            what, where, look = self.silence()
            self.keep("heartbeat", CommunicationLost(
                f"{what} for {self._silent_s:.2f} s", where=where,
                next_step=f"{look}. The drive's own watchdog stops the shaft", entry=MessageCode.FEEDBACK_LOST,
            ))
        if self._troubles:
            kind, trouble = self._troubles.pop(0)
            if kind in OF_A_SILENT_HOST:
                # A delay of this host is stated first: it may be the only cause. The drive's watchdog also trips on
                # many cycles that are each only a little late.
                away = self.host_late() if kind in OF_A_LATE_HOST else self.host_stood_still()
                if away:
                    raise CommunicationLost(
                        f"{away}. After that: {trouble.what}",
                        where=trouble.where if kind == HOST_SILENT else f"host; {trouble.where}",
                        next_step=LOWER_THE_RATE, entry=MessageCode.HOST_LATE,
                    )
            raise trouble

    def interference(self, what: str, where: str, next_step: str, *, kind: str) -> None:
        """Record that another master changes or drives this drive; `check` raises it once for each ``kind``."""
        self.keep(kind, CommunicationLost(what, where=where, next_step=next_step))

    def on_emcy(self, data: bytes) -> None:
        """Handle an emergency message (CiA 301): error code u16, error register u8, manufacturer's bytes; code 0 = no
        error left.
        """
        if len(data) < 2:
            return
        code = self.emcy_code = int.from_bytes(data[:2], "little")
        if code == HOST_LOST and self.expect_operational:
            self.watchdog_acted(emcy_text(code))
        elif code and self.expect_operational:
            extra = f" (manufacturer's bytes {data[3:].hex(' ')})" if any(data[3:]) else ""
            kind = SensorFault if code >> 8 == _SENSOR else DriveFault
            # a drive may report its trip first: the sensor's message must not get lost behind it
            self.keep("emcy, sensor" if kind is SensorFault else "emcy", kind(
                emcy_text(code) + extra, where=self.place,
                next_step="See the drive's fault list, remove the cause, then start with --reset-fault",
            ))

    def watchdog_acted(self, reported: str) -> None:
        """Record that the drive reports the end of its watchdog's time."""
        self.keep(HOST_SILENT, CommunicationLost(
            f"the drive's watchdog has tripped: {reported}", where=f"host or bus, reported by {self.place}",
            next_step="This host was silent for too long (frozen, asleep, overloaded) or its frames were lost",
            entry=MessageCode.WATCHDOG_ACTED,
        ))

    def restarted(self, shown_by: str) -> None:
        """Record that the drive has started again; ``shown_by``: the sign of it, in words."""
        self.on_restart()
        if self.expect_operational:
            self.keep("boot-up", DriveFault(
                f"the drive restarted during the run{shown_by}", where=self.place,
                next_step="tdhil does not enable it again. Find the cause of the restart, then start again",
                entry=MessageCode.DRIVE_RESTARTED,
            ))

    def taken_out(self, state: str) -> None:
        """Record that another master took the drive out of operation; ``state``: the state that it shows."""
        self.keep("nmt", CommunicationLost(
            f"another master put the drive into {state}", where=self.place,
            next_step="Disconnect the second master from the bus, and start again", entry=MessageCode.FOREIGN_MASTER,
        ))

    def thin_feedback(self, missed: int, cycles: int, period_s: float, where: str) -> None:
        """Record that ``missed`` of the last cycles brought no feedback."""
        self.keep(
            THIN,
            CommunicationLost(
                f"{missed} of the last {cycles} cycles ({cycles * period_s:.2g} s) brought no feedback",
                where=f"{self.place}, {where}",
                next_step="Check the TPDO's transmission type and mapping, the bus load and the cable",
                entry=MessageCode.FEEDBACK_LOST,
            ),
        )

    def remark(self, text: str) -> None:
        """Add a remark; each text once."""
        if text not in self._said and len(self._said) < MOST_REMARKS:
            self._said.add(text)
            self._remarks.append(text)

    def remarks(self) -> tuple[str, ...]:
        """Return the remarks since the last call, one line each."""
        if not self._remarks:
            return ()
        remarks, self._remarks = tuple(self._remarks), []
        return remarks

    def keep(self, kind: str, trouble: TdhilError) -> None:
        """Keep an error until `check` raises it; each kind once."""
        if kind not in self._raised:
            self._raised.add(kind)
            self._troubles.append((kind, trouble))


# ---------------------------------------------------------------------------------------------------------------------
# Read-back of the settings that preflight made: two objects a second, beside the cycle, during the whole run.
#
# A tool, the drive's panel or another fieldbus may change the watchdog, its reaction, the quick stop or a limit while
# the shaft turns, without any frame on this bus. So a request is sent after a cycle's feedback; tdhil does not wait for
# the answer and checks it when it comes. Three groups of objects take turns: watchdog and quick stop; limits, setpoints
# and the settings that tdhil relies on (scales, filters, required values); content of the feedback frames (mapping,
# transmission type, COB-ID of the TPDOs). So a change shows within 0.5 s times three times the number of objects in its
# group. An object that a tool writes on this bus is checked in the next cycle.
#
# Setpoints and mode (6071h, 60FFh, 6060h) are read too: they must be the values that this host sent last. A drive
# echoes them if it has returned a value of ours other than zero. Only then does another value come from another master.
#
# An answer that differs is requested again at once, and counts the second time (a setpoint the third time). The changed
# value is written back once before the stop, because the stop may depend on it (605Ah). A setting that tdhil relies on
# is not: tdhil writes no scale of a drive. Some drives do not answer SDO requests while running; tdhil reports this and
# continues. If a drive stops answering after it has answered before, `LOST` missed replies count as a lost connection.


READ_BACK_EVERY_S = 0.5
READ_BACK_ANSWER_S = 0.5
"""Control time for an answer, s."""
GIVE_UP, LOST = 5, 10
"""Unanswered requests in a row: limit for a drive that never answered, and for one that did."""
TRIES = 2
REMEMBERED = 8
"""Number of cycles whose setpoints an answer may show."""


class Group(Enum):
    """Objects that are read back in the same turn."""

    SAFETY = "watchdog, its reaction, quick stop"
    REST = "limits, setpoints, RPDOs, scales"
    FEEDBACK = "what the TPDOs carry, and when"


@dataclass(eq=False)
class _WatchedObject:
    """``data``: required value; None: one of the setpoints sent last. ``ours``: tdhil may write it."""

    index: int
    sub: int
    title: str
    data: bytes | None
    ours: bool = True
    differs: int = 0
    refused: int = 0
    echoed: bool = False


class ReadBack:
    """Read-back of the drive's settings. ``ask`` sends a read request, ``put`` a write request. `step` is called once a
    cycle, `take` for each answer.
    """

    def __init__(
        self, watch: DriveWatch, ask: Callable[[int, int], None], put: Callable[[int, int, bytes], None], place: str
    ) -> None:
        self._watch = watch
        self._ask = ask
        self._put = put
        self._place = place
        self._groups: dict[Group, list[_WatchedObject]] = {group: [] for group in Group}
        self.on_changed: Callable[[int, int], None] = lambda index, sub: None
        """Called with index and sub-index of an object that another master changed, before the error is raised."""
        self._next: deque[_WatchedObject] = deque()      # objects to read before their turn
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

    def watch(self, title: str, index: int, sub: int, data: bytes, group: Group, ours: bool = True) -> None:
        """Add an object that must keep its value. ``ours``: tdhil may write it."""
        self._groups[group].append(_WatchedObject(index, sub, title, data, ours))

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
        sent = self._sent.get(index)
        if sent is not None:
            sent.append(value)

    def soon(self, index: int, sub: int) -> None:
        """Read this object before its turn, because another master wrote it."""
        for one in self._all():
            if (one.index, one.sub) == (index, sub) and one not in self._next:
                self._next.append(one)

    def put_back(self, index: int, sub: int) -> None:
        """Write the required value into a supervised object that is ours, without waiting for an answer."""
        for one in self._all():
            if (one.index, one.sub) == (index, sub) and one.data is not None and one.ours:
                self._put(index, sub, one.data)

    def step(self, now_s: float) -> None:
        """Send the next request, after a cycle's feedback."""
        if self._over or not any(self._groups.values()):
            return
        if self._asked is not None:
            if now_s - self._asked_s < READ_BACK_ANSWER_S:
                return
            self._asked = None
            self._silent += 1
            if not self._answered and self._silent >= GIVE_UP:
                self._over = True
                self._watch.remark(
                    "the drive answers no SDO requests in motion: watchdog and limits were not read back")
            elif self._answered and self._silent >= LOST:
                self._over = True
                self._watch.interference(
                    f"the drive did not answer {LOST} SDO requests in a row: watchdog and limits can't be read back",
                    f"{self._place}, SDO",
                    "Check a gateway in between and the load of the drive; see the frames in the log", kind="read back",
                )
        if self._due_s is None:
            self._due_s = now_s
        if self._next or now_s >= self._due_s - 1e-9:
            if not self._next:
                self._due_s = now_s + READ_BACK_EVERY_S
            one = self._asked = self._choose()
            self._asked_s = now_s
            self._ask(one.index, one.sub)

    def take(self, index: int, sub: int, data: bytes | None) -> None:
        """Handle an answer of the drive, to this or another client; None: the drive refused the request."""
        one = self._asked
        if one is None or (index, sub) != (one.index, one.sub):
            return
        self._asked, self._silent = None, 0
        if data is None:
            one.refused += 1
            if one.refused == GIVE_UP:
                self._watch.remark(f"the drive refuses to read {name(index, sub)} in motion; it is not supervised")
                self._drop(one)
        else:
            self._answered = True
            self._compare(one, data)

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
                f"{one.title} was changed by another master during the run: {_shown(one.data)} was"
                f" {'set' if one.ours else 'read before motion'}, {_shown(found)} is there now",
                f"{self._place}, {name(one.index, one.sub)}",
                "Find the tool, panel or master that writes to this drive, disconnect it, and start again",
                kind=f"changed {one.index:04X}:{one.sub}",
            )
        else:
            self._watch.interference(
                f"{one.title} is not what this host sent: {_shown(found)} is there, {sent[-1]} was sent",
                f"{self._place}, {name(one.index, one.sub)}",
                "A second master, a panel or another fieldbus may drive it. Disconnect it and start again",
                kind="setpoint",
            )

    def _drop(self, one: _WatchedObject) -> None:
        for those in self._groups.values():
            if one in those:
                those.remove(one)


def _shown(data: bytes) -> str:
    number = int.from_bytes(data, "little")
    return f"{number} ({number:X}h)" if number > 9 else str(number)
