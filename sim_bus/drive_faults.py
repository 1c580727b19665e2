"""Scripted faults of a drive and of what it turns, on any bus of CiA 402; each sets something and restores it."""

from collections.abc import Callable
from typing import TypeVar

from sim_bus.fault_script import FaultKind, plain, share
from sim_bus.reports import Lie, lying
from sim_bus.timed_drive import TimedDrive

_PROFILE_VELOCITY = 3
M = TypeVar("M")
"""Type of a fault on the bus in question."""


class DriveFault:
    """Nothing by itself; a fault overrides what it needs."""

    def begin(self, drive: TimedDrive) -> None:
        """It starts."""

    def end(self, drive: TimedDrive) -> None:
        """It is over."""


class Deaf(DriveFault):
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


class ModeKept(DriveFault):
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


class LimitedTorque(DriveFault):
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


class LoadLost(DriveFault):
    """The coupled load comes off: this share of the motor end's inertia and friction is left."""

    def __init__(self, share: float) -> None:
        self._share = share

    def begin(self, drive: TimedDrive) -> None:
        drive.inverter.lose_load(self._share)


class Lying(DriveFault):
    """Sensor, power stage or reports of the drive are wrong (`sim_bus.reports`)."""

    def __init__(self, lie: Lie) -> None:
        self._lie = lie

    def begin(self, drive: TimedDrive) -> None:
        self._lie.begin(drive.inverter.lies)

    def end(self, drive: TimedDrive) -> None:
        self._lie.end(drive.inverter.lies)


def of_drive(act: Callable[[DriveFault], M]) -> dict[str, FaultKind[M]]:
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
