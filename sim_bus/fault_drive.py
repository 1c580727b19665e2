"""Faults of the drive itself and of what it turns."""

from sim_bus import emergency as emcy
from sim_bus.fault_hooks import Misbehaviour

_PROFILE_VELOCITY = 3


class Emcy(Misbehaviour):
    """An emergency message, and nothing else."""

    def __init__(self, code: int) -> None:
        self._code = code

    def begin(self) -> None:
        self.scene.node.emergency.report(self._code, emcy.GENERIC)


class DriveFault(Emcy):
    """The drive finds a fault: emergency message, its own fault reaction (605Eh), fault state."""

    def begin(self) -> None:
        super().begin()
        self.scene.node.application.fault()


class Restart(Misbehaviour):
    """The drive restarts: torque off, defaults, boot-up message."""

    def begin(self) -> None:
        node = self.scene.node
        node.on_frame(0x000, bytes((0x81, node.id)))


class ForeignNmt(Misbehaviour):
    """A third party sends an NMT command: 2 stop, 128 pre-operational (CiA 301)."""

    def __init__(self, command: int) -> None:
        self._command = command

    def begin(self) -> None:
        self.scene.foreign(0x000, bytes((self._command, self.scene.node.id)))


class Deaf(Misbehaviour):
    """The state machine doesn't move on commands any more."""

    def begin(self) -> None:
        self.scene.node.application.deaf = True

    def end(self) -> None:
        self.scene.node.application.deaf = False


class SafeTorqueOff(Deaf):
    """STO: torque off at once, and no enabling while it lasts. The shaft coasts."""

    def begin(self) -> None:
        self.scene.node.application.power_off()
        super().begin()


class ModeKept(Misbehaviour):
    """6060h is taken and not followed: 6061h goes on showing the old mode."""

    def begin(self) -> None:
        self.scene.node.application.keeps_mode = True

    def end(self) -> None:
        self.scene.node.application.keeps_mode = False


class ModeLost(ModeKept):
    """The drive goes over to its profile velocity mode (3) by itself, and stays there whatever 6060h says."""

    def begin(self) -> None:
        self.scene.node.application.set_mode(_PROFILE_VELOCITY)
        super().begin()


class LimitedTorque(Misbehaviour):
    """An internal limit leaves this share of the torque limit."""

    def __init__(self, share: float) -> None:
        self._share = share

    def begin(self) -> None:
        limits = self.scene.node.inverter.control.limits
        self._before = limits.torque_forward_nm, limits.torque_reverse_nm
        limits.torque_forward_nm *= self._share
        limits.torque_reverse_nm *= self._share

    def end(self) -> None:
        limits = self.scene.node.inverter.control.limits
        limits.torque_forward_nm, limits.torque_reverse_nm = self._before


class LoadLost(Misbehaviour):
    """What was coupled comes off: this share of the motor end's inertia and friction is left."""

    def __init__(self, share: float) -> None:
        self._share = share

    def begin(self) -> None:
        self.scene.node.inverter.lose_load(self._share)


class Reported(Misbehaviour):
    """What the drive reports is scaled so; what it regulates by isn't."""

    def __init__(self, *, speed: float = 1.0, torque: float = 1.0) -> None:
        self._speed, self._torque = speed, torque

    def begin(self) -> None:
        self._scale(self._speed, self._torque)

    def end(self) -> None:
        self._scale(1.0, 1.0)

    def _scale(self, speed: float, torque: float) -> None:
        reporting = self.scene.node.inverter.reporting
        reporting.speed_scale, reporting.torque_scale = speed, torque
