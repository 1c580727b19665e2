"""Scripted faults of a drive and of its load, on any CiA 402 bus. Each changes a value and restores it.

The module also has the parts of which the faults of a bus are made: an act at the place of the fault, and the script of
one drive.
"""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np

from sim_bus.fault_script import (
    FAULT_SEED,
    STOP,
    Cast,
    FaultKind,
    Passing,
    Scripted,
    error_code,
    object_place,
    plain,
    share,
)
from sim_bus.object_drive import ObjectDrive
from sim_bus.reports import Lie, lying
from sim_bus.sdo_server import Meddling

_PROFILE_VELOCITY = 3

M = TypeVar("M")
"""Type of a fault on the bus."""

F = TypeVar("F", bound=Passing)
P = TypeVar("P")
"""Type of the place of a fault: a drive and its line."""

V = TypeVar("V")
"""Type of a fault's value."""


class FaultAct(Passing, Generic[P]):
    """Act at the place of the fault, once when it begins and once when it ends."""

    place: P

    def __init__(self, begin: Callable[[P], object], end: Callable[[P], object] | None = None) -> None:
        self._begin, self._end = begin, end

    def begin(self) -> None:
        """Act at the begin."""
        self._begin(self.place)

    def end(self) -> None:
        """Act at the end."""
        if self._end is not None:
            self._end(self.place)


def changed(of: Callable[[P], Any], name: str, value: Callable[[P], object]) -> FaultAct[P]:
    """Return a fault that gives an attribute another value while it lasts."""
    before: list[object] = []

    def begin(place: P) -> None:
        before.append(getattr(of(place), name))
        setattr(of(place), name, value(place))

    return FaultAct(begin, lambda place: setattr(of(place), name, before.pop()))


def once(parse: Callable[[str], V], act: Callable[[P, V], None]) -> Callable[[str], FaultAct[P]]:
    """Return a fault that acts once, with the fault's value."""
    def make(text: str) -> FaultAct[P]:
        value = parse(text)
        return FaultAct(lambda place: act(place, value))

    return make


class FaultSchedule(Generic[F]):
    """Script of one drive; `happen_to` activates it."""

    def __init__(self, script: tuple[Scripted, ...], make: Callable[[Scripted], F], seed: int) -> None:
        self.cast: Cast[F] = Cast(script, make)
        self.rng = np.random.default_rng((seed, FAULT_SEED))

    def happen_to(self, drive: ObjectDrive) -> None:
        """Apply the faults to this drive from now on."""
        self._drive = drive
        drive.on_time = self.moved
        drive.on_stage = self._on_stage
        drive.application.on_stop = lambda: self._on_stage(STOP)

    @property
    def waiting(self) -> tuple[str, ...]:
        """Faults that have not begun yet, as they were written."""
        return self.cast.waiting

    def end(self) -> None:
        """Advance to the end of a rehearsal in stepped time, after the host has left for good."""
        if self.cast.all and self._drive.stepped and self._drive.cycled:
            self._drive.run_out()

    def moved(self, now_us: int) -> None:
        """Begin and end the faults that are due at this plant time, µs."""
        self.cast.moved(now_us, self._drive.note)

    def _on_stage(self, number: int) -> None:
        self.cast.stage(number, self._drive.time_us)
        self.moved(self._drive.time_us)


class InjectedFault:
    """A fault without effect; a subclass overrides the methods that it needs."""

    def begin(self, drive: ObjectDrive) -> None:
        """Begin the fault."""

    def end(self, drive: ObjectDrive) -> None:
        """End the fault."""


class Emcy(InjectedFault):
    """Emergency message without any other effect."""

    def __init__(self, code: int) -> None:
        self._code = code

    def begin(self, drive: ObjectDrive) -> None:
        drive.emergency.report(self._code, drive.error_register)


class FaultReaction(Emcy):
    """Fault of the drive: emergency message, its own fault reaction (605Eh), fault state."""

    def begin(self, drive: ObjectDrive) -> None:
        super().begin(drive)
        drive.application.fault()


class Deaf(InjectedFault):
    """State machine that ignores all commands."""

    def begin(self, drive: ObjectDrive) -> None:
        drive.application.deaf = True

    def end(self, drive: ObjectDrive) -> None:
        drive.application.deaf = False


class SafeTorqueOff(Deaf):
    """STO: torque off at once, and no enabling while it lasts. The shaft coasts."""

    def begin(self, drive: ObjectDrive) -> None:
        drive.application.power_off()
        super().begin(drive)


class ModeKept(InjectedFault):
    """Mode change without effect: 6060h is accepted, and 6061h still shows the old mode."""

    def begin(self, drive: ObjectDrive) -> None:
        drive.application.keeps_mode = True

    def end(self, drive: ObjectDrive) -> None:
        drive.application.keeps_mode = False


class ModeLost(ModeKept):
    """Loss of the mode: the drive changes to profile velocity mode (3) by itself and stays there, whatever the value of
    6060h.
    """

    def begin(self, drive: ObjectDrive) -> None:
        drive.application.set_mode(_PROFILE_VELOCITY)
        super().begin(drive)


class LimitedTorque(InjectedFault):
    """Internal limit: only this share of the torque limit is left."""

    def __init__(self, share: float) -> None:
        self._share = share

    def begin(self, drive: ObjectDrive) -> None:
        limits = drive.inverter.control.limits
        self._before = limits.torque_forward_nm, limits.torque_reverse_nm
        limits.torque_forward_nm *= self._share
        limits.torque_reverse_nm *= self._share

    def end(self, drive: ObjectDrive) -> None:
        limits = drive.inverter.control.limits
        limits.torque_forward_nm, limits.torque_reverse_nm = self._before


class LoadLost(InjectedFault):
    """Loss of the coupled load: this share of the motor end's inertia and friction is left."""

    def __init__(self, share: float) -> None:
        self._share = share

    def begin(self, drive: ObjectDrive) -> None:
        drive.inverter.lose_load(self._share)


class Lying(InjectedFault):
    """Wrong sensor, power stage or reports of the drive (`sim_bus.reports`)."""

    def __init__(self, lie: Lie) -> None:
        self._lie = lie

    def begin(self, drive: ObjectDrive) -> None:
        self._lie.begin(drive.inverter.lies)

    def end(self, drive: ObjectDrive) -> None:
        self._lie.end(drive.inverter.lies)


def of_bus(
    *,
    dead: Callable[[], M],
    lossy: Callable[[float], M],
    loss: str,
    restart: Callable[[], M],
    restarts: str,
    transfers: Callable[[Meddling, int, int], M],
) -> dict[str, FaultKind[M]]:
    """Return the faults that each CiA 402 bus has: of its frames, of the transfers of an object.

    ``loss``: usual share of lost frames; ``restarts``: sign of a restart; ``transfers``: effect, index and subindex.
    """
    def transfer(row: int, summary: str, how: Meddling, usual: str) -> FaultKind[M]:
        return FaultKind(row, summary, lambda v: transfers(how, *object_place(v)), usual, "OBJECT")

    return {
        "bus-dead": FaultKind(12, "no frame is transmitted any more, as with a cut cable", plain(dead)),
        "frame-loss": FaultKind(17, "this share of all frames is lost, in both directions",
                                lambda v: lossy(share(v)), loss, "SHARE"),
        "node-reset": FaultKind(21, f"the drive restarts ({restarts}); its torque is off, the shaft coasts",
                                plain(restart)),
        "sdo-abort": transfer(24, "the drive aborts each SDO transfer of an object", Meddling.ABORTED, "6072h"),
        "sdo-timeout": transfer(25, "the drive does not answer SDO requests for an object", Meddling.UNANSWERED,
                                "6072h"),
        "wrong-identity": FaultKind(29, "the vendor ID, 1018h:1, is another one",
                                    plain(lambda: transfers(Meddling.OTHERWISE, 0x1018, 1))),
        "write-not-kept": transfer(45, "the drive confirms a write to an object, and keeps the old value",
                                   Meddling.NOT_KEPT, "6080h"),
        "reads-back-otherwise": transfer(45, "an object reads back with another value", Meddling.OTHERWISE, "6072h"),
    }


def of_drive(act: Callable[[InjectedFault], M]) -> dict[str, FaultKind[M]]:
    """Return the table as faults of one bus. ``act`` converts a fault into one of the bus."""
    return {
        "emcy": FaultKind(23, "the drive sends an emergency message and stays enabled",
                          lambda v: act(Emcy(error_code(v))), "7305h", "CODE"),
        "drive-fault": FaultKind(
            23, "the drive sends an emergency message, and is in the fault state after its fault reaction",
            lambda v: act(FaultReaction(error_code(v))), "3210h", "CODE"),
        "fault-at-start": FaultKind(30, "the drive is in the fault state before the run",
                                    lambda v: act(FaultReaction(error_code(v))), "3210h", "CODE"),
        "stuck-state": FaultKind(31, "the drive ignores the controlword", plain(lambda: act(Deaf()))),
        "mode-not-followed": FaultKind(32, "the mode display 6061h does not follow 6060h",
                                       plain(lambda: act(ModeKept()))),
        "mode-lost": FaultKind(82, "the drive changes to mode 3 without a command, and stays there",
                               plain(lambda: act(ModeLost()))),
        "sto": FaultKind(33, "safe torque off: the shaft coasts, and the drive cannot be enabled",
                         plain(lambda: act(SafeTorqueOff()))),
        "internal-limit": FaultKind(33, "an internal limit reduces the torque to this share",
                                    lambda v: act(LimitedTorque(share(v))), "10%", "SHARE"),
        "load-lost": FaultKind(34, "the load comes off the shaft: this share of inertia and friction remains",
                               lambda v: act(LoadLost(max(0.001, share(v)))), "10%", "SHARE"),
        **lying(lambda lie: act(Lying(lie))),
    }
