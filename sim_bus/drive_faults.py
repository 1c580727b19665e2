"""Scripted faults of a drive and of what it turns, on any bus of CiA 402; each sets something and restores it.

And what the faults of a bus are made of: something done where a fault takes place, and the script of one drive.
"""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from sim_bus.fault_script import STOP, Cast, FaultKind, Passing, Scripted, plain, share
from sim_bus.reports import Lie, lying
from sim_bus.timed_drive import TimedDrive

_PROFILE_VELOCITY = 3
M = TypeVar("M")
"""Type of a fault on the bus in question."""

F = TypeVar("F", bound=Passing)
P = TypeVar("P")
"""Type of the place of a fault: a drive and its line."""

V = TypeVar("V")
"""Type of a fault's value."""


class FaultAct(Passing, Generic[P]):
    """Act at its place when it begins, and when it ends."""

    place: P

    def __init__(self, begin: Callable[[P], object], end: Callable[[P], object] | None = None) -> None:
        self._begin, self._end = begin, end

    def begin(self) -> None:
        """It starts."""
        self._begin(self.place)

    def end(self) -> None:
        """It is over."""
        if self._end is not None:
            self._end(self.place)


def changed(of: Callable[[P], Any], name: str, value: Callable[[P], object]) -> FaultAct[P]:
    """An attribute has another value while the fault lasts."""
    before: list[object] = []

    def begin(place: P) -> None:
        before.append(getattr(of(place), name))
        setattr(of(place), name, value(place))

    return FaultAct(begin, lambda place: setattr(of(place), name, before.pop()))


def once(parse: Callable[[str], V], act: Callable[[P, V], None]) -> Callable[[str], FaultAct[P]]:
    """Something that happens once, with the value of the fault."""
    def make(text: str) -> FaultAct[P]:
        value = parse(text)
        return FaultAct(lambda place: act(place, value))

    return make


class FaultSchedule(Generic[F]):
    """The script of one drive; `happen_to` makes it act."""

    def __init__(self, script: tuple[Scripted, ...], make: Callable[[Scripted], F]) -> None:
        self.cast: Cast[F] = Cast(script, make)

    def happen_to(self, drive: TimedDrive) -> None:
        """Let the faults happen to this drive from now on."""
        self._drive = drive
        drive.on_time = self.moved
        drive.on_stage = self._on_stage
        drive.application.on_stop = lambda: self._on_stage(STOP)

    @property
    def waiting(self) -> tuple[str, ...]:
        """Faults whose moment hasn't come, as they were written."""
        return self.cast.waiting

    def moved(self, now_us: int) -> None:
        """Plant time has come so far."""
        self.cast.moved(now_us, self._drive.note)

    def _on_stage(self, number: int) -> None:
        self.cast.stage(number, self._drive.time_us)
        self.moved(self._drive.time_us)


class InjectedFault:
    """Nothing by itself; a fault overrides what it needs."""

    def begin(self, drive: TimedDrive) -> None:
        """It starts."""

    def end(self, drive: TimedDrive) -> None:
        """It is over."""


class Deaf(InjectedFault):
    """The state machine doesn't move on commands any more."""

    def begin(self, drive: TimedDrive) -> None:
        drive.application.deaf = True

    def end(self, drive: TimedDrive) -> None:
        drive.application.deaf = False


class SafeTorqueOff(Deaf):
    """STO: torque off at once, and no enabling while it lasts. The shaft coasts."""

    def begin(self, drive: TimedDrive) -> None:
        drive.application.power_off()
        super().begin(drive)


class ModeKept(InjectedFault):
    """6060h is taken and not followed: 6061h goes on showing the old mode."""

    def begin(self, drive: TimedDrive) -> None:
        drive.application.keeps_mode = True

    def end(self, drive: TimedDrive) -> None:
        drive.application.keeps_mode = False


class ModeLost(ModeKept):
    """The drive goes over to its profile velocity mode (3) by itself, and stays there whatever 6060h says."""

    def begin(self, drive: TimedDrive) -> None:
        drive.application.set_mode(_PROFILE_VELOCITY)
        super().begin(drive)


class LimitedTorque(InjectedFault):
    """An internal limit leaves this share of the torque limit."""

    def __init__(self, share: float) -> None:
        self._share = share

    def begin(self, drive: TimedDrive) -> None:
        limits = drive.inverter.control.limits
        self._before = limits.torque_forward_nm, limits.torque_reverse_nm
        limits.torque_forward_nm *= self._share
        limits.torque_reverse_nm *= self._share

    def end(self, drive: TimedDrive) -> None:
        limits = drive.inverter.control.limits
        limits.torque_forward_nm, limits.torque_reverse_nm = self._before


class LoadLost(InjectedFault):
    """The coupled load comes off: this share of the motor end's inertia and friction is left."""

    def __init__(self, share: float) -> None:
        self._share = share

    def begin(self, drive: TimedDrive) -> None:
        drive.inverter.lose_load(self._share)


class Lying(InjectedFault):
    """Sensor, power stage or reports of the drive are wrong (`sim_bus.reports`)."""

    def __init__(self, lie: Lie) -> None:
        self._lie = lie

    def begin(self, drive: TimedDrive) -> None:
        self._lie.begin(drive.inverter.lies)

    def end(self, drive: TimedDrive) -> None:
        self._lie.end(drive.inverter.lies)


def of_drive(act: Callable[[InjectedFault], M]) -> dict[str, FaultKind[M]]:
    """The table as faults of one bus; ``act`` makes one of its faults."""
    return {
        "stuck-state": FaultKind(31, "the controlword is ignored", plain(lambda: act(Deaf()))),
        "mode-not-followed": FaultKind(32, "6061h doesn't follow 6060h", plain(lambda: act(ModeKept()))),
        "mode-lost": FaultKind(82, "the drive goes over to mode 3 by itself, and stays there",
                               plain(lambda: act(ModeLost()))),
        "sto": FaultKind(33, "safe torque off: the shaft coasts, and nothing enables the drive",
                         plain(lambda: act(SafeTorqueOff()))),
        "internal-limit": FaultKind(33, "an internal limit leaves this share of the torque",
                                    lambda v: act(LimitedTorque(share(v))), "10%", "SHARE"),
        "load-lost": FaultKind(34, "the load comes off: this share of inertia and friction is left",
                               lambda v: act(LoadLost(max(0.001, share(v)))), "10%", "SHARE"),
        **lying(lambda lie: act(Lying(lie))),
    }
