"""CiA 402-2 power drive system state machine, drive side: states, commands, transitions. Pure.

Controlword 6040h (CiA 402-2, "command coding"); x = doesn't matter::

    bit            7  3  2  1  0
    shutdown       ·  x  1  1  0     transitions 2, 6, 8
    switch on      ·  0  1  1  1     3; in operation enabled: disable operation, 5
    enable op.     ·  1  1  1  1     4, 16; from ready to switch on 3 and 4 at once
    quick stop     ·  x  0  1  x     7, 10, 11
    disable volt.  ·  x  x  0  x     7, 9, 10, 12
    fault reset    ↑                 15, rising edge only

Statusword 6041h, low byte: 0 ready to switch on · 1 switched on · 2 operation enabled · 3 fault · 4 voltage enabled ·
5 quick stop (0 = active) · 6 switch on disabled · 7 warning.
"""

from enum import Enum

FAULT_RESET = 0x0080
HALT = 0x0100
RELEASED = 0x0070          # velocity mode: ramp enabled (4), not locked (5), reference used (6)

VOLTAGE_ENABLED = 0x0010
WARNING = 0x0080
REMOTE = 0x0200
TARGET_REACHED = 0x0400
INTERNAL_LIMIT = 0x0800
MODE_SPECIFIC = 0x1000


class State(Enum):
    """The states by name; `STATUS` has their statusword bits."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"


class Command(Enum):
    """What a controlword's bits 0 to 3 ask for."""

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

TRANSITIONS: dict[tuple[State, Command], State] = {
    (State.SWITCH_ON_DISABLED, Command.SHUTDOWN): State.READY,                      # 2
    (State.READY, Command.SWITCH_ON): State.SWITCHED_ON,                            # 3
    (State.READY, Command.ENABLE): State.SWITCHED_ON,                               # 3, then 4
    (State.READY, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,                    # 7
    (State.READY, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,               # 7
    (State.SWITCHED_ON, Command.ENABLE): State.ENABLED,                             # 4
    (State.SWITCHED_ON, Command.SHUTDOWN): State.READY,                             # 6
    (State.SWITCHED_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,              # 10
    (State.SWITCHED_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,         # 10
    (State.ENABLED, Command.SWITCH_ON): State.SWITCHED_ON,                          # 5
    (State.ENABLED, Command.SHUTDOWN): State.READY,                                 # 8
    (State.ENABLED, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,             # 9
    (State.ENABLED, Command.QUICK_STOP): State.QUICK_STOP,                          # 11
    (State.QUICK_STOP, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,          # 12
    (State.QUICK_STOP, Command.ENABLE): State.ENABLED,                              # 16, see `next_state`
}
"""Transitions on command. Those without one: 0 and 1 (start), 12 (quick stop done), 13 and 14 (fault), 15 (reset)."""


def decode(controlword: int) -> Command:
    """The command in bits 0 to 3; every word is one."""
    if not controlword & 0b0010:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0b0100:
        return Command.QUICK_STOP
    if not controlword & 0b0001:
        return Command.SHUTDOWN
    return Command.ENABLE if controlword & 0b1000 else Command.SWITCH_ON


def next_state(state: State, command: Command, quick_stop_option: int) -> State:
    """Where ``command`` leads; ``state`` itself where it is not allowed. 16 needs an option code 605Ah of 5 to 8."""
    if state is State.QUICK_STOP and command is Command.ENABLE and quick_stop_option < 5:
        return state
    return TRANSITIONS.get((state, command), state)


def fault_reset_edge(before: int, now: int) -> bool:
    """Bit 7 has risen."""
    return bool(now & ~before & FAULT_RESET)
