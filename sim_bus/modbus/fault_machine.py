"""Faults of the Modbus drive itself and of what it turns."""

from collections.abc import Callable

from sim_bus.cia402 import Mode
from sim_bus.modbus.fault_hooks import Misbehaviour
from sim_bus.modbus.machine import Machine


class Act(Misbehaviour):
    """Something is done to the drive, and undone where it can be."""

    def __init__(self, begin: Callable[[Machine], None], end: Callable[[Machine], None] | None = None) -> None:
        self._begin, self._end = begin, end

    def begin(self) -> None:
        self._begin(self.scene.machine)

    def end(self) -> None:
        if self._end is not None:
            self._end(self.scene.machine)


class NotArmed(Misbehaviour):
    """The watchdog's time is written without an error, and keeps what it was."""

    def begin(self) -> None:
        watchdog = self.scene.profile.watchdog.parameter
        if watchdog is not None:
            self.scene.machine.parameters.not_kept.add(watchdog)

    def end(self) -> None:
        self.scene.machine.parameters.not_kept.clear()


def drive_fault() -> Act:
    """The drive finds a fault: its own fault reaction, then fault."""
    return Act(Machine.trip)


def stuck() -> Act:
    """The state machine doesn't move on commands any more."""
    return Act(lambda machine: _deaf(machine, True), lambda machine: _deaf(machine, False))


def safe_torque_off() -> Act:
    """STO: torque off at once, and no enabling while it lasts. The shaft coasts."""
    def begin(machine: Machine) -> None:
        mode = machine.application.mode
        machine.application.power_off()
        machine.application.set_mode(mode.value)        # how the drive regulates is its wiring's
        _deaf(machine, True)

    return Act(begin, lambda machine: _deaf(machine, False))


def mode_kept() -> Act:
    """Speed or torque is chosen and not followed; the display shows what was before."""
    def keep(machine: Machine, keeps: bool) -> None:
        machine.application.keeps_mode = keeps

    return Act(lambda machine: keep(machine, True), lambda machine: keep(machine, False))


def mode_lost() -> Act:
    """The drive regulates speed from then on, whatever is chosen, and shows it."""
    def lose(machine: Machine) -> None:
        machine.application.set_mode(Mode.CYCLIC_VELOCITY.value)
        machine.application.keeps_mode = True

    def over(machine: Machine) -> None:
        machine.application.keeps_mode = False

    return Act(lose, over)


def limited_torque(share: float) -> Act:
    """An internal limit leaves this share of the torque limits, whatever their registers say."""
    return Act(lambda machine: machine.leave_torque(share), lambda machine: machine.leave_torque(1.0))


def hot(temperature_c: float) -> Act:
    """Motor and drive have become so hot."""
    return Act(lambda machine: machine.heat(temperature_c), lambda machine: machine.heat(40.0))


def load_lost(share: float) -> Act:
    """What was coupled comes off: this share of the motor end's inertia and friction is left."""
    return Act(lambda machine: machine.inverter.lose_load(share))


def reported(*, speed: float = 1.0, torque: float = 1.0) -> Act:
    """What the drive reports is scaled so; what it regulates by isn't."""
    def scale(machine: Machine, by_speed: float, by_torque: float) -> None:
        machine.inverter.reporting.speed_scale, machine.inverter.reporting.torque_scale = by_speed, by_torque

    return Act(lambda machine: scale(machine, speed, torque), lambda machine: scale(machine, 1.0, 1.0))


def _deaf(machine: Machine, deaf: bool) -> None:
    machine.application.deaf = deaf
