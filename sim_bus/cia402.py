"""The CiA 402 device profile over one inverter: states, modes, option codes, statusword. Knows no bus.

All stops use speed control, from torque mode too: quick stop (605Ah), halt (605Dh), shutdown and disable operation with
ramp (605Bh, 605Ch), fault reaction (605Eh). Ramp by option code: 1 slow-down ramp 6084h, 2 quick-stop ramp 6085h, 3
torque limit; 5, 6, 7 are 1, 2, 3 and then stay in quick stop active.

A drive may have a quick stop that doesn't brake from the torque modes: it then switches off (`ApplicationSettings`). A
quick stop that the drive began by itself (6007h) is not ended by a repeated enable-operation word: another command must
come first.
"""


from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, IntEnum
from math import inf

from sim_bus.inverter import RPM, Inverter

# ---------------------------------------------------------------------------------------------------------------------
# CiA 402-2 power drive system state machine, drive side: states, commands, transitions. Pure.
#
# Controlword 6040h (CiA 402-2, "command coding"); x = doesn't matter::
#
#     bit            7  3  2  1  0
#     shutdown       ·  x  1  1  0     transitions 2, 6, 8
#     switch on      ·  0  1  1  1     3; in operation enabled: disable operation, 5
#     enable op.     ·  1  1  1  1     4, 16; from ready to switch on 3 and 4 at once
#     quick stop     ·  x  0  1  x     7, 10, 11
#     disable volt.  ·  x  x  0  x     7, 9, 10, 12
#     fault reset    ↑                 15, rising edge only
#
# Statusword 6041h, low byte: 0 ready to switch on · 1 switched on · 2 operation enabled · 3 fault · 4 voltage enabled
# · 5 quick stop (0 = active) · 6 switch on disabled · 7 warning.


FAULT_RESET = 0x0080
HALT = 0x0100
RELEASED = 0x0070          # velocity mode: ramp enabled (4), not locked (5), reference used (6)

VOLTAGE_ENABLED = 0x0010
WARNING = 0x0080
REMOTE = 0x0200
TARGET_REACHED = 0x0400
INTERNAL_LIMIT = 0x0800
MODE_SPECIFIC = 0x1000


DISABLED_BY_HOST = "power stage off by the host's controlword"
"""Event of a switch-off by the host, at once or after a ramp. The end of a quick stop by the drive itself is no such
event."""
DISABLED_BY_ANOTHER = "power stage off by another master's controlword"
"""Event of a switch-off at once by another master."""

RAMP_SHARE, RAMP_TOLERANCE, RAMP_STEPS, RAMP_GAP_S = 0.35, 0.015, 16, 0.2
"""Definition of a stop by the speed setpoint: it falls in at least 15 steps, with gaps of at most 0.2 s, to 35 % of its
initial value. No stage lowers the setpoint so far along a line. Every step lies on the line within 1.5 % of the fall;
those of a sine do not."""

TURNING_SHARE = 0.05
"""Share of the speed limit above which a shaft counts as turning, for a scripted stop. A sign probe stays below."""

STANDSTILL_RAD_S, STANDSTILL_SHARE = 0.05, 0.0015
"""Velocity threshold (606Fh) as delivered: rad/s, or a share of the speed limit if that is more. The speed of a fast
drive is noisier: at 3000 1/min the threshold is 4.5 1/min."""


class State(Enum):
    """States by name; `STATUS` has their statusword bits."""

    __hash__ = object.__hash__     # Enum's own is Python code, too slow for a look-up in every cycle

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"


class DeviceCommand(Enum):
    """Request in bits 0 to 3 of a controlword."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE = "enable operation"
    QUICK_STOP = "quick stop"
    DISABLE_VOLTAGE = "disable voltage"


STATUS: dict[State, int] = {
    State.NOT_READY: 0x00,
    State.SWITCH_ON_DISABLED: 0x40,
    State.READY: 0x21,
    State.SWITCHED_ON: 0x23,
    State.ENABLED: 0x27,
    State.QUICK_STOP: 0x07,
    State.FAULT_REACTION: 0x0F,
    State.FAULT: 0x08,
}

TRANSITIONS: dict[tuple[State, DeviceCommand], State] = {
    (State.SWITCH_ON_DISABLED, DeviceCommand.SHUTDOWN): State.READY,                      # 2
    (State.READY, DeviceCommand.SWITCH_ON): State.SWITCHED_ON,                            # 3
    (State.READY, DeviceCommand.ENABLE): State.SWITCHED_ON,                               # 3, then 4
    (State.READY, DeviceCommand.QUICK_STOP): State.SWITCH_ON_DISABLED,                    # 7
    (State.READY, DeviceCommand.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,               # 7
    (State.SWITCHED_ON, DeviceCommand.ENABLE): State.ENABLED,                             # 4
    (State.SWITCHED_ON, DeviceCommand.SHUTDOWN): State.READY,                             # 6
    (State.SWITCHED_ON, DeviceCommand.QUICK_STOP): State.SWITCH_ON_DISABLED,              # 10
    (State.SWITCHED_ON, DeviceCommand.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,         # 10
    (State.ENABLED, DeviceCommand.SWITCH_ON): State.SWITCHED_ON,                          # 5
    (State.ENABLED, DeviceCommand.SHUTDOWN): State.READY,                                 # 8
    (State.ENABLED, DeviceCommand.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,             # 9
    (State.ENABLED, DeviceCommand.QUICK_STOP): State.QUICK_STOP,                          # 11
    (State.QUICK_STOP, DeviceCommand.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,          # 12
    (State.QUICK_STOP, DeviceCommand.ENABLE): State.ENABLED,                              # 16, see `next_state`
}
"""Transitions on command. The others are 0 and 1 (start), 12 (quick stop done), 13 and 14 (fault), 15 (reset)."""


def decode(controlword: int) -> DeviceCommand:
    """Return the command in bits 0 to 3; every word has one."""
    if not controlword & 0b0010:
        return DeviceCommand.DISABLE_VOLTAGE
    if not controlword & 0b0100:
        return DeviceCommand.QUICK_STOP
    if not controlword & 0b0001:
        return DeviceCommand.SHUTDOWN
    return DeviceCommand.ENABLE if controlword & 0b1000 else DeviceCommand.SWITCH_ON


def next_state(state: State, command: DeviceCommand, quick_stop_option: int) -> State:
    """Return the state after ``command``; ``state`` itself if not allowed. 16 needs an option code 605Ah of 5 to 8."""
    if state is State.QUICK_STOP and command is DeviceCommand.ENABLE and quick_stop_option < 5:
        return state
    return TRANSITIONS.get((state, command), state)


def fault_reset_edge(before: int, now: int) -> bool:
    """Return whether bit 7 has risen."""
    return bool(now & ~before & FAULT_RESET)


# ---------------------------------------------------------------------------------------------------------------------

class OperationMode(IntEnum):
    """Modes of operation, 6060h."""

    VELOCITY = 2                         # vl: follows its setpoint only with bits 4 to 6 set
    PROFILE_VELOCITY = 3
    PROFILE_TORQUE = 4
    CYCLIC_VELOCITY = 9
    CYCLIC_TORQUE = 10


@dataclass(slots=True)
class ApplicationSettings:
    """Option codes and rates in SI units; the object dictionary writes them."""

    quick_stop_option: int = 2           # 605Ah
    shutdown_option: int = 0             # 605Bh
    disable_option: int = 1              # 605Ch
    halt_option: int = 1                 # 605Dh
    fault_option: int = 2                # 605Eh
    connection_option: int = 1           # 6007h
    accel_rad_s2: float = 1.0            # 6083h
    decel_rad_s2: float = 1.0            # 6084h
    quick_stop_rad_s2: float = 3.0       # 6085h
    torque_slope_nm_s: float = 100.0     # 6087h
    window_rad_s: float = 0.1            # 606Dh
    window_s: float = 0.0                # 606Eh
    standstill_rad_s: float = STANDSTILL_RAD_S   # 606Fh
    standstill_s: float = 0.1            # 6070h
    torque_quick_stop: bool = True       # True: a quick stop on command decelerates from a torque mode


def _ignore(_text: str) -> None:
    pass


class Application:
    """The drive between its objects and its inverter. `step` advances it; all other methods only set requests."""

    def __init__(self, inverter: Inverter) -> None:
        self.inverter = inverter
        drive = inverter.params.drive
        self.settings = ApplicationSettings(
            quick_stop_rad_s2=drive.quick_stop_rad_s2,
            standstill_rad_s=max(STANDSTILL_RAD_S, STANDSTILL_SHARE * drive.speed_limit_rpm * RPM))
        self.state = State.SWITCH_ON_DISABLED
        self.mode = OperationMode.PROFILE_VELOCITY
        self.controlword = 0
        self.target_speed_rad_s = 0.0
        self.target_torque_nm = 0.0
        self.torque_offset_nm = 0.0    # 60B2h, for the cyclic synchronous modes
        self.modes = frozenset(OperationMode) - {OperationMode.VELOCITY}    # a profile may add vl
        self.warning = False
        self.deaf = False              # scripted: no command moves the state machine
        self.keeps_mode = False        # scripted: 6060h is accepted without effect
        self.on_event: Callable[[str], None] = _ignore
        self.on_fault_reset: Callable[[], None] = lambda: None
        self.on_stop: Callable[[], None] | None = None      # scripted: a stop is requested, once
        self._after_stop: State | None = None       # state after the stop under way
        self._stop_option = 0                       # option code of its ramp
        self._own_stop = False                      # quick stop begun by the drive itself
        self._time_s = 0.0
        self._fall: list[tuple[float, float]] = []      # time and magnitude of a falling speed setpoint
        self._by_host = False                       # the host has requested the state after the stop
        self.foreign = False
        """True while a request of another master is processed."""
        self._weighed: tuple[int, State] | None = None
        self._slow_for_s = 0.0
        self._in_window_s = 0.0

    # -- requests -----------------------------------------------------------------------------------------

    def write_controlword(self, word: int) -> None:
        """Take 6040h: a state command, fault reset on the rising edge of bit 7, halt in bit 8."""
        if self.deaf or self._weighed == (word, self.state):
            return
        before, self.controlword = self.controlword, word
        if self.state is State.FAULT and fault_reset_edge(before, word):
            self._enter(State.SWITCH_ON_DISABLED)
            self.on_fault_reset()
        command, was_on = decode(word), self.energised
        if self._own_stop and command is not DeviceCommand.ENABLE:
            self._own_stop = False
        if command is DeviceCommand.QUICK_STOP and self._quick_stop_coasts:
            self._enter(State.SWITCH_ON_DISABLED)
        while self._obey(command):
            pass
        if was_on and not self.energised:
            self.on_event(DISABLED_BY_ANOTHER if self.foreign else DISABLED_BY_HOST)
        self._by_host = self._after_stop in {State.READY, State.SWITCHED_ON} and not self.foreign
        self._weighed = (word, self.state)

    def set_mode(self, code: int) -> bool:
        """Take 6060h. Return False if the mode is not supported. 0 means no change (CiA 402-2)."""
        if code in {0, self.mode} or self.keeps_mode:
            return True
        if code not in self.modes:
            return False
        self.mode = OperationMode(code)
        self.on_event(f"mode {self.mode.value}")
        self._in_window_s = 0.0
        return True

    def fault(self) -> None:
        """Enter a fault (transition 13): fault reaction after 605Eh, then fault."""
        if self.state in {State.FAULT, State.FAULT_REACTION}:
            return
        turning = self.energised
        self._enter(State.FAULT_REACTION)
        if turning and self.settings.fault_option:
            self._stop_then(State.FAULT, self.settings.fault_option)
        else:
            self._enter(State.FAULT)

    def abort_connection(self) -> None:
        """React by 6007h: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop. The caller reports the fault
        itself (1).
        """
        option = self.settings.connection_option
        if option == 1:
            self.fault()
        elif option == 2:
            self._obey(DeviceCommand.DISABLE_VOLTAGE)
        elif option == 3 and self._quick_stop_coasts:
            self._enter(State.SWITCH_ON_DISABLED)
        elif option == 3 and self._obey(DeviceCommand.QUICK_STOP):
            self._own_stop = self.state is State.QUICK_STOP
        self._weighed = None

    @property
    def _quick_stop_coasts(self) -> bool:
        """True if a quick stop, of the host or of the watchdog, removes the torque: in torque mode of some drives."""
        return (self.mode in {OperationMode.PROFILE_TORQUE, OperationMode.CYCLIC_TORQUE}
                and not self.settings.torque_quick_stop and self.state is State.ENABLED)

    def power_off(self) -> None:
        """Reset the device: no torque, switch on disabled, setpoints cleared."""
        self.controlword = 0
        self.mode = self.first_mode
        self.target_speed_rad_s = self.target_torque_nm = self.torque_offset_nm = 0.0
        self._own_stop = False
        self._weighed = None
        self._enter(State.SWITCH_ON_DISABLED)
        self.inverter.control.off()

    # -- state -------------------------------------------------------------------------------------------

    @property
    def first_mode(self) -> OperationMode:
        """Mode after power-on: profile velocity, or the first one that the drive has instead."""
        usual = OperationMode.PROFILE_VELOCITY
        return usual if usual in self.modes else min(self.modes, default=OperationMode.VELOCITY)

    @property
    def standstill(self) -> bool:
        """True if the speed has been below 606Fh for 6070h."""
        return self._slow_for_s >= self.settings.standstill_s

    @property
    def energised(self) -> bool:
        """True if torque may flow by a command of the host."""
        return self.state in {State.ENABLED, State.QUICK_STOP}

    @property
    def halted(self) -> bool:
        """True if halt is requested in operation enabled."""
        return self.state is State.ENABLED and bool(self.controlword & HALT)

    @property
    def stopping(self) -> bool:
        """True while the drive stops or holds the shaft by command: quick stop, halt, or a ramp before
        switching off.
        """
        if self.state is State.ENABLED:
            return bool(self.controlword & HALT) or self._after_stop is not None
        return self.state is State.QUICK_STOP or self._after_stop is not None

    def statusword(self) -> int:
        """Return the statusword 6041h."""
        word = STATUS[self.state] | VOLTAGE_ENABLED | REMOTE
        if self.warning:
            word |= WARNING
        control = self.inverter.control
        if control.limited:
            word |= INTERNAL_LIMIT
        stopping, enabled = self.stopping, self.state is State.ENABLED
        if stopping:
            reached = self.standstill
        elif not enabled:
            reached = False
        elif self.mode is OperationMode.PROFILE_VELOCITY:
            reached = self._in_window_s > self.settings.window_s
        else:
            reached = self.mode is OperationMode.PROFILE_TORQUE and control.ramp_done
        if reached:
            word |= TARGET_REACHED
        if self.mode is OperationMode.PROFILE_VELOCITY:
            specific = self.standstill                                        # speed is zero
        else:
            cyclic = self.mode is OperationMode.CYCLIC_TORQUE or self.mode is OperationMode.CYCLIC_VELOCITY
            specific = cyclic and enabled and not stopping                    # follows the setpoint
        return word | MODE_SPECIFIC if specific else word

    # -- time --------------------------------------------------------------------------------------------

    def step(self, dt_s: float) -> None:
        """Advance by one step of at most the control period, with the setpoints that `regulate` has set."""
        inverter, settings = self.inverter, self.settings
        inverter.step(dt_s)
        self._time_s += dt_s
        speed = inverter.control.filtered_rad_s
        self._slow_for_s = self._slow_for_s + dt_s if abs(speed) < settings.standstill_rad_s else 0.0
        near = abs(speed - self.target_speed_rad_s) < settings.window_rad_s
        self._in_window_s = self._in_window_s + dt_s if near else 0.0
        if self._after_stop is not None and self.standstill and self.inverter.control.at_rest_reference:
            by_host = self._by_host
            self._enter(self._after_stop)
            if by_host:
                self.on_event(DISABLED_BY_HOST)
            self.regulate()

    def regulate(self) -> None:
        """Pass state, mode and setpoints to the control loops; called once before the steps of a cycle."""
        if self.on_stop is not None and self._told_to_rest():
            tell, self.on_stop = self.on_stop, None
            tell()
        control, settings = self.inverter.control, self.settings
        control.offset_nm = self.torque_offset_nm if self.mode is OperationMode.CYCLIC_VELOCITY else 0.0
        if self._after_stop is not None or self.state is State.QUICK_STOP:
            control.stop(self._ramp(self._stop_option))
        elif self.state is not State.ENABLED:
            control.off()
        elif self.controlword & HALT:
            control.stop(self._ramp(settings.halt_option))
        elif self.mode is OperationMode.VELOCITY:
            released = self.controlword & RELEASED == RELEASED
            target = self.target_speed_rad_s if released else 0.0
            control.speed(target, settings.accel_rad_s2, settings.decel_rad_s2)
        elif self.mode is OperationMode.CYCLIC_TORQUE:
            control.torque(self.target_torque_nm + self.torque_offset_nm)
        elif self.mode is OperationMode.CYCLIC_VELOCITY:
            control.speed(self.target_speed_rad_s)
        elif self.mode is OperationMode.PROFILE_TORQUE:
            control.torque(self.target_torque_nm, settings.torque_slope_nm_s)
        else:
            control.speed(self.target_speed_rad_s, settings.accel_rad_s2, settings.decel_rad_s2)

    def _told_to_rest(self) -> bool:
        """Return whether the host stops a turning shaft: quick stop, halt, no enable request any more, or a speed of
        zero.
        """
        if abs(self.inverter.speed_rad_s) < TURNING_SHARE * self.inverter.control.limits.speed_rad_s:
            return False
        if self.state is not State.ENABLED or self.halted or self._after_stop is not None:
            return True
        if self.mode not in {OperationMode.VELOCITY, OperationMode.PROFILE_VELOCITY, OperationMode.CYCLIC_VELOCITY}:
            return False
        if self.target_speed_rad_s == 0.0:
            return True
        # above a drill string the host lowers the speed setpoint along a straight line
        target, fall = abs(self.target_speed_rad_s), self._fall
        if fall and (target > fall[-1][1] or self._time_s - fall[-1][0] > RAMP_GAP_S):
            fall.clear()
        if not fall or target < fall[-1][1]:
            fall.append((self._time_s, target))
        if len(fall) < RAMP_STEPS or target > RAMP_SHARE * fall[0][1]:
            return False
        (began_s, high), (ended_s, low) = fall[0], fall[-1]
        slope = (high - low) / (ended_s - began_s)
        return all(abs(high - slope * (t - began_s) - w) < RAMP_TOLERANCE * (high - low) for t, w in fall)

    # -- transitions -------------------------------------------------------------------------------------

    def _obey(self, command: DeviceCommand) -> bool:
        """Execute one transition on command. Return whether the state changed, so that the next transition
        may follow.
        """
        if self._own_stop and command is DeviceCommand.ENABLE:
            return False
        target = next_state(self.state, command, self.settings.quick_stop_option)
        if target is self.state:
            if command is DeviceCommand.ENABLE and self.state is State.ENABLED:
                self._after_stop = None                  # the stop is cancelled while slowing down
            return False
        if self.state is State.ENABLED and target in {State.READY, State.SWITCHED_ON}:
            option = self.settings.shutdown_option if target is State.READY else self.settings.disable_option
            if option:
                self._stop_then(target, option)
                return False
        self._enter(target)
        if target is State.QUICK_STOP:
            option = self.settings.quick_stop_option
            if option == 0:
                self._enter(State.SWITCH_ON_DISABLED)
            else:
                self._stop_then(None if option >= 5 else State.SWITCH_ON_DISABLED, (option - 1) % 4 + 1)
        return True

    def _stop_then(self, state: State | None, option: int) -> None:
        self._after_stop = state
        self._stop_option = option

    def _ramp(self, option: int) -> float:
        """Return the deceleration of an option code (1, 2, 3), rad/s²."""
        if option == 1:
            return self.settings.decel_rad_s2
        return self.settings.quick_stop_rad_s2 if option == 2 else inf

    def _enter(self, state: State) -> None:
        self._after_stop = None
        if state is not self.state:
            self.state = state
            self._own_stop = self._own_stop and state is State.QUICK_STOP
            self._in_window_s = 0.0
            self.on_event("")
