"""Common part of all families: a control word comes in, the power side executes it, a status word goes out.

Each family uses the one power state machine of `sim_bus.cia402`: PROFIdrive's is the same with other names, and the
start and stop commands of simpler drives are paths through it. A family only translates: its own bits into commands,
and states into its own bits. The bits' meaning comes from the manuals, not from the profile; the profile only states
how the user has wired the drive (`Wiring`).
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
    """Setup of the drive by its user, where the family permits a choice."""

    torque_bits: int = 0
    """Bits of the control word that select torque; 0: the word doesn't select."""
    mode_register: bool = False
    """A register selects torque; where bits do too, both have to."""
    reverse_bits: int = 0
    switch_while_enabled: bool = True
    brakes_in_torque: bool = True
    """False: a quick stop in torque mode takes the torque away."""
    holds_after_quick_stop: bool = False
    ramps: bool = False
    """A speed setpoint passes the drive's ramp generator."""
    status_address: int = 0
    """Some families have several status registers, of different bits."""


@dataclass(frozen=True, slots=True)
class Extra:
    """A register of the family beside those of the profile."""

    read: Callable[[], int]
    write: Callable[[int], None] | None = None


class ControlWords:
    """A family. `write` takes a control word, `status` gives the status word."""

    shutdown_option = 1
    """605Bh of the power side: down a ramp, then ready."""
    disable_option = 0
    """605Ch: taking the enable away lets the shaft coast."""

    def __init__(self, application: Application, wiring: Wiring) -> None:
        self.application = application
        self.wiring = wiring
        self.word = 0
        self.reversed = False
        """The speed setpoint is meant backwards."""
        self.listens = True
        """Setpoints count."""
        self.register_says_torque = False
        self._word_says_torque = False
        application.settings.shutdown_option = self.shutdown_option
        application.settings.disable_option = self.disable_option
        self.set_quick_stop()

    def write(self, word: int) -> None:
        """The host wrote the control word."""
        before, self.word = self.word, word
        self.obey(before, word)

    def obey(self, before: int, word: int) -> None:
        """The family's own part of `write`."""
        raise NotImplementedError

    def status(self) -> int:
        """The status word."""
        raise NotImplementedError

    def host_lost(self) -> None:
        """The drive has stopped by itself: the word that stands there still must not start it again."""

    def extras(self) -> dict[int, Extra]:
        """Registers of the family's own, by address."""
        return {}

    # -- for the families ----------------------------------------------------------------------------------

    def order(self, command: DeviceCommand, *, reset: bool = False) -> None:
        """A command to the power side."""
        self.set_quick_stop()
        self.application.write_controlword(_WORDS[command] | (FAULT_RESET if reset else 0))

    def select(self, word: int) -> None:
        """Speed or torque, and the direction, where the control word says so."""
        self.reversed = bool(word & self.wiring.reverse_bits)
        if self.wiring.torque_bits:
            self._word_says_torque = word & self.wiring.torque_bits == self.wiring.torque_bits
            self._choose()

    def select_by_register(self, torque: bool) -> None:
        """The mode register was written; `may_switch` has been asked."""
        self.register_says_torque = torque
        self._choose()

    def may_switch(self, torque: bool) -> bool:
        """The mode register may be written so now."""
        return self.wiring.switch_while_enabled or not self.application.energised or torque is self.register_says_torque

    def _choose(self) -> None:
        """Torque where everything that selects says so; no change while enabled on drives that don't allow it."""
        wiring = self.wiring
        said = [self._word_says_torque] * bool(wiring.torque_bits) + [self.register_says_torque] * wiring.mode_register
        speed = OperationMode.PROFILE_VELOCITY if self.wiring.ramps else OperationMode.CYCLIC_VELOCITY
        mode = OperationMode.CYCLIC_TORQUE if said and all(said) else speed
        if mode is not self.application.mode and (wiring.switch_while_enabled or not self.application.energised):
            self.application.set_mode(mode.value)
            self.set_quick_stop()

    def set_quick_stop(self) -> None:
        """The power side's option code for a quick stop, as the drive is wired and regulates now."""
        if self.torque and not self.wiring.brakes_in_torque:
            self.application.settings.quick_stop_option = 0
        else:
            self.application.settings.quick_stop_option = 6 if self.wiring.holds_after_quick_stop else 2

    @property
    def torque(self) -> bool:
        """Torque is regulated, or would be."""
        return self.application.mode is OperationMode.CYCLIC_TORQUE

    @property
    def state(self) -> State:
        """State of the power side."""
        return self.application.state

    @property
    def faulted(self) -> bool:
        """True in fault, or on the way there."""
        return self.state in {State.FAULT, State.FAULT_REACTION}

    @property
    def follows(self) -> bool:
        """Setpoints act: enabled, and no stop under way."""
        return self.state is State.ENABLED and not self.application.stopping

    @property
    def backwards(self) -> bool:
        """The shaft turns backwards, as far as the drive can see."""
        return self.application.inverter.control.filtered_rad_s < -0.01

    @property
    def at_setpoint(self) -> bool:
        """Speed control has arrived."""
        control = self.application.inverter.control
        return self.follows and not self.torque and abs(control.reference - control.filtered_rad_s) < AT_SETPOINT_RAD_S


class StartStop(ControlWords):
    """A family whose word says run or stop by level.

    After the drive has stopped by itself a run command must be seen to go before it counts again; manuals say so of
    most such drives (start on an edge), and it is the safe reading of the others.
    """

    def __init__(self, application: Application, wiring: Wiring) -> None:
        super().__init__(application, wiring)
        self._blocked = False

    def host_lost(self) -> None:
        self._blocked = True

    def run(self) -> None:
        """Start, or go on."""
        if self._blocked or self.faulted:
            return
        if self.state is not State.ENABLED:
            self.order(DeviceCommand.SHUTDOWN)
        self.order(DeviceCommand.ENABLE)

    def ramp_stop(self) -> None:
        """Down a ramp, then no torque."""
        self._blocked = False
        self.order(DeviceCommand.SHUTDOWN)

    def quick_stop(self) -> None:
        """Down the quick-stop ramp, then no torque."""
        self._blocked = False
        self.order(DeviceCommand.QUICK_STOP)

    def coast(self) -> None:
        """Remove the torque at once."""
        self._blocked = False
        self.order(DeviceCommand.DISABLE_VOLTAGE)

    def reset(self) -> None:
        """Out of fault."""
        self.order(DeviceCommand.DISABLE_VOLTAGE)
        self.order(DeviceCommand.DISABLE_VOLTAGE, reset=True)
