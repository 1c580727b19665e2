"""Common part of all families: a control word comes in, the power side executes it, a status word goes out.

All families use the power state machine of `sim_bus.cia402`: PROFIdrive's is the same with other names, and the start
and stop commands of simpler drives are paths through it. A family only converts its own bits into commands, and states
into its own bits. The meaning of the bits comes from the manuals, not from the profile. The profile only states how the
user has configured the drive (`Wiring`).
"""

from collections.abc import Callable
from dataclasses import dataclass

from sim_bus.cia402 import FAULT_RESET, Application, DeviceCommand, OperationMode, State

_WORDS = {
    DeviceCommand.SHUTDOWN: 0x0006,
    DeviceCommand.SWITCH_ON: 0x0007,
    DeviceCommand.ENABLE: 0x000F,
    DeviceCommand.QUICK_STOP: 0x0002,
    DeviceCommand.DISABLE_VOLTAGE: 0x0000,
}
AT_SETPOINT_RAD_S = 0.1


@dataclass(frozen=True, slots=True)
class Wiring:
    """Configuration of the drive by its user, if the family permits a choice."""

    torque_bits: int = 0
    """Bits of the control word that select torque; 0: the word does not select the mode."""
    mode_register: bool = False
    """True if a register selects torque. If bits select it too, both must select torque."""
    reverse_bits: int = 0
    switch_while_enabled: bool = True
    brakes_in_torque: bool = True
    """False: a quick stop in torque mode switches the torque off."""
    holds_after_quick_stop: bool = False
    ramps: bool = False
    """True if a speed setpoint passes the drive's ramp generator."""
    status_address: int = 0
    """Address of the status register. Some families have several status registers with different bits."""


@dataclass(frozen=True, slots=True)
class Extra:
    """A register of the family in addition to those of the profile."""

    read: Callable[[], int]
    write: Callable[[int], None] | None = None


class ControlWords:
    """A family. `write` takes a control word, `status` returns the status word."""

    shutdown_option = 1
    """605Bh of the power side: down a ramp, then ready."""
    disable_option = 0
    """605Ch: without the enable the shaft coasts."""

    def __init__(self, application: Application, wiring: Wiring) -> None:
        self.application = application
        self.wiring = wiring
        self.word = 0
        self.reversed = False
        """True if the speed setpoint is for reverse rotation."""
        self.listens = True
        """True if setpoints act."""
        self.register_says_torque = False
        self._word_says_torque = False
        application.settings.shutdown_option = self.shutdown_option
        application.settings.disable_option = self.disable_option
        self.set_quick_stop()

    def write(self, word: int) -> None:
        """Take the control word from the host."""
        before, self.word = self.word, word
        self.obey(before, word)

    def obey(self, before: int, word: int) -> None:
        """Do the family's own part of `write`."""
        raise NotImplementedError

    def status(self) -> int:
        """Return the status word."""
        raise NotImplementedError

    def host_lost(self) -> None:
        """React to a stop by the drive itself: the present control word must not start the drive again."""

    def extras(self) -> dict[int, Extra]:
        """Return the family's own registers by address."""
        return {}

    # -- for the families ----------------------------------------------------------------------------------

    def order(self, command: DeviceCommand, *, reset: bool = False) -> None:
        """Send a command to the power side."""
        self.set_quick_stop()
        self.application.write_controlword(_WORDS[command] | (FAULT_RESET if reset else 0))

    def select(self, word: int) -> None:
        """Select speed or torque, and the direction, if the control word selects them."""
        self.reversed = bool(word & self.wiring.reverse_bits)
        if self.wiring.torque_bits:
            self._word_says_torque = word & self.wiring.torque_bits == self.wiring.torque_bits
            self._choose()

    def select_by_register(self, torque: bool) -> None:
        """Take the mode register's value. The caller has checked `may_switch`."""
        self.register_says_torque = torque
        self._choose()

    def may_switch(self, torque: bool) -> bool:
        """Return whether the mode register may have this value now."""
        return self.wiring.switch_while_enabled or not self.application.energised or torque is self.register_says_torque

    def _choose(self) -> None:
        """Select torque if all selectors request it. Drives that don't allow it keep the mode while enabled."""
        wiring = self.wiring
        said = [self._word_says_torque] * bool(wiring.torque_bits) + [self.register_says_torque] * wiring.mode_register
        speed = OperationMode.PROFILE_VELOCITY if self.wiring.ramps else OperationMode.CYCLIC_VELOCITY
        mode = OperationMode.CYCLIC_TORQUE if said and all(said) else speed
        if mode is not self.application.mode and (wiring.switch_while_enabled or not self.application.energised):
            self.application.set_mode(mode.value)
            self.set_quick_stop()

    def set_quick_stop(self) -> None:
        """Set the power side's option code for a quick stop, by the configuration and the present mode."""
        if self.torque and not self.wiring.brakes_in_torque:
            self.application.settings.quick_stop_option = 0
        else:
            self.application.settings.quick_stop_option = 6 if self.wiring.holds_after_quick_stop else 2

    @property
    def torque(self) -> bool:
        """True in torque mode, enabled or not."""
        return self.application.mode is OperationMode.CYCLIC_TORQUE

    @property
    def state(self) -> State:
        """State of the power side."""
        return self.application.state

    @property
    def faulted(self) -> bool:
        """True in fault and in fault reaction."""
        return self.state in {State.FAULT, State.FAULT_REACTION}

    @property
    def follows(self) -> bool:
        """True if setpoints act: enabled, and no stop under way."""
        return self.state is State.ENABLED and not self.application.stopping

    @property
    def backwards(self) -> bool:
        """True if the shaft turns backwards, by the drive's own speed signal."""
        return self.application.inverter.control.filtered_rad_s < -0.01

    @property
    def at_setpoint(self) -> bool:
        """True if speed control has reached the setpoint."""
        control = self.application.inverter.control
        return self.follows and not self.torque and abs(control.reference - control.filtered_rad_s) < AT_SETPOINT_RAD_S


class StartStop(ControlWords):
    """A family whose word requests run or stop by level.

    After a stop by the drive itself, a run command acts only after it was withdrawn once. Manuals state this for most
    of these drives (start on an edge), and for the others it is the safe interpretation.
    """

    def __init__(self, application: Application, wiring: Wiring) -> None:
        super().__init__(application, wiring)
        self._blocked = False

    def host_lost(self) -> None:
        self._blocked = True

    def run(self) -> None:
        """Start, or continue."""
        if self._blocked or self.faulted:
            return
        if self.state is not State.ENABLED:
            self.order(DeviceCommand.SHUTDOWN)
        self.order(DeviceCommand.ENABLE)

    def ramp_stop(self) -> None:
        """Brake down a ramp, then switch the torque off."""
        self._blocked = False
        self.order(DeviceCommand.SHUTDOWN)

    def quick_stop(self) -> None:
        """Brake down the quick-stop ramp, then switch the torque off."""
        self._blocked = False
        self.order(DeviceCommand.QUICK_STOP)

    def coast(self) -> None:
        """Remove the torque at once."""
        self._blocked = False
        self.order(DeviceCommand.DISABLE_VOLTAGE)

    def reset(self) -> None:
        """Leave the fault state."""
        self.order(DeviceCommand.DISABLE_VOLTAGE)
        self.order(DeviceCommand.DISABLE_VOLTAGE, reset=True)
