"""The CiA 402 power state machine, pure: statusword in, controlword out.

::

    NOT_READY → SWITCH_ON_DISABLED ─2→ READY_TO_SWITCH_ON ─3→ SWITCHED_ON ─4→ OPERATION_ENABLED
                     ▲  ▲                                                        │11
                     │  └──────────────────── 12 ──────────── QUICK_STOP_ACTIVE ◄┘
                     └─15─ FAULT ◄─14─ FAULT_REACTION_ACTIVE ◄─13─ (any)

Source: CiA 402-2, power drive state machine; objects 6040h (controlword) and 6041h (statusword).
"""

from enum import Enum

from drivers.drive import PowerRequest, PowerState


class State(Enum):
    """States of the power drive system, in the figure of CiA 402-2."""

    __hash__ = object.__hash__     # Enum's own is Python code, too slow for a look-up in every cycle

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY_TO_SWITCH_ON = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION_ACTIVE = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "no valid state"     # no pattern of the standard: a gateway without its drive, or a dead TPDO


# Statusword bits (6041h).
FAULT_BIT = 1 << 3
REMOTE = 1 << 9
TARGET_REACHED = 1 << 10
INTERNAL_LIMIT = 1 << 11
SPEED_ZERO = 1 << 12               # profile velocity mode only

# Controlwords (6040h).
DISABLE_VOLTAGE = 0x0000
QUICK_STOP = 0x0002
SHUTDOWN = 0x0006
SWITCH_ON = 0x0007
ENABLE_OPERATION = 0x000F
FAULT_RESET = 0x0080

# (mask, value) → state. Bit 5 (quick stop) is don't care where the standard leaves it open.
_PATTERNS = (
    (0x4F, 0x00, State.NOT_READY),
    (0x4F, 0x40, State.SWITCH_ON_DISABLED),
    (0x6F, 0x21, State.READY_TO_SWITCH_ON),
    (0x6F, 0x23, State.SWITCHED_ON),
    (0x6F, 0x27, State.OPERATION_ENABLED),
    (0x6F, 0x07, State.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, State.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, State.FAULT),
)

_DECODED: dict[int, State] = {
    low: state for low in range(0x80) for mask, value, state in _PATTERNS if low & mask == value
}

_POWER = {
    State.NOT_READY: PowerState.NOT_READY,
    State.SWITCH_ON_DISABLED: PowerState.OFF,
    State.READY_TO_SWITCH_ON: PowerState.READY,
    State.SWITCHED_ON: PowerState.READY,
    State.OPERATION_ENABLED: PowerState.ENABLED,
    State.QUICK_STOP_ACTIVE: PowerState.QUICK_STOP,
    State.FAULT_REACTION_ACTIVE: PowerState.FAULT_REACTION,
    State.FAULT: PowerState.FAULT,
    State.UNKNOWN: PowerState.UNKNOWN,
}


def decode(statusword: int) -> State:
    """Return the state that a statusword shows; UNKNOWN for a pattern that the standard doesn't define (FFFFh)."""
    return _DECODED.get(statusword & 0x7F, State.UNKNOWN)


def decode_after(statusword: int) -> State:
    """Return the state for a drive that has shown another state since it started.

    A drive leaves not ready to switch on by itself (transitions 0 and 1) and returns to it only by a restart. Later
    zeros are not a state.
    """
    state = decode(statusword)
    return State.UNKNOWN if state is State.NOT_READY else state


def power_state(state: State) -> PowerState:
    """Return the state as callers above the driver see it."""
    return _POWER[state]


_TOWARDS_ENABLED = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,
    State.READY_TO_SWITCH_ON: SWITCH_ON,
    State.SWITCHED_ON: ENABLE_OPERATION,
    State.OPERATION_ENABLED: ENABLE_OPERATION,
}
_TOWARDS_OFF = {
    # Disable operation first, which ramps down (605Ch): without voltage a turning shaft would coast.
    State.OPERATION_ENABLED: SWITCH_ON,
}


def controlword_towards(state: State, wish: PowerRequest, *, removes_torque: bool = False) -> int:
    """Return the controlword that brings the drive one transition nearer to ``wish``.

    It never resets a fault and never ends a quick stop by enabling. Both need a request of their own; until then the
    word is harmless. ``removes_torque``: the power stage is switched off at once, in any state and for any ``wish``.

    Quick stop is the same word in every state. A drive that is not in operation switches off or does nothing
    (transitions 7 and 10). If the shown state is old or another node's and the drive is in operation, the shaft stops.
    So it is also the word for a drive that shows no valid state, for any ``wish``: disabling could let a shaft coast.
    """
    if removes_torque:
        return DISABLE_VOLTAGE
    if state is State.UNKNOWN:
        return QUICK_STOP
    if wish is PowerRequest.ENABLED:
        return _TOWARDS_ENABLED.get(state, QUICK_STOP if state is State.QUICK_STOP_ACTIVE else DISABLE_VOLTAGE)
    if wish is PowerRequest.QUICK_STOP:
        return QUICK_STOP
    return _TOWARDS_OFF.get(state, DISABLE_VOLTAGE)
