"""Pure state machine, compared with a second copy of the standard's tables (power_machine)."""

import pytest

from drivers.cia402.state_machine import State, controlword_towards, decode, power_state
from drivers.drive import PowerRequest, PowerState
from tests.drivers.power_machine import (
    ENABLED,
    FAULT,
    NOT_READY,
    OFF,
    ON,
    REACTION,
    READY,
    STATUS_PATTERNS,
    STOPPING,
    PowerMachine,
    matches,
)

NEAR = {PowerRequest.OFF: {OFF}, PowerRequest.ENABLED: {ENABLED}, PowerRequest.QUICK_STOP: {STOPPING, OFF}}


def _short(name):
    return name.replace(" to switch on", "")


@pytest.mark.parametrize("high", [0x00, 0x02, 0x12, 0xFF])
def test_every_low_byte(high):
    shown = 0
    for low in range(0x100):
        fitting = [name for name, pattern in STATUS_PATTERNS.items() if matches(low, pattern)]
        assert len(fitting) <= 1
        wanted = fitting[0] if fitting else "no valid state"
        shown += bool(fitting)
        assert _short(decode(high << 8 | low).value) == _short(wanted), hex(low)
    # 4 patterns leave bits 4, 5, 7 open, 4 leave bits 4 and 7.
    assert shown == 4 * 8 + 4 * 4


@pytest.mark.parametrize(
    ("state", "seen"),
    [
        (State.NOT_READY, PowerState.NOT_READY),
        (State.SWITCH_ON_DISABLED, PowerState.OFF),
        (State.READY_TO_SWITCH_ON, PowerState.READY),
        (State.SWITCHED_ON, PowerState.READY),
        (State.OPERATION_ENABLED, PowerState.ENABLED),
        (State.QUICK_STOP_ACTIVE, PowerState.QUICK_STOP),
        (State.FAULT_REACTION_ACTIVE, PowerState.FAULT_REACTION),
        (State.FAULT, PowerState.FAULT),
        (State.UNKNOWN, PowerState.UNKNOWN),
    ],
)
def test_states_for_callers(state, seen):
    assert power_state(state) is seen


# 6040h by state and request, as in the manual of any CiA 402 drive.
WORDS = {
    #                          off   enabled  quick stop
    State.NOT_READY:             (0x00, 0x00, 0x02),
    State.SWITCH_ON_DISABLED:    (0x00, 0x06, 0x02),
    State.READY_TO_SWITCH_ON:    (0x00, 0x07, 0x02),
    State.SWITCHED_ON:           (0x00, 0x0F, 0x02),
    State.OPERATION_ENABLED:     (0x07, 0x0F, 0x02),
    State.QUICK_STOP_ACTIVE:     (0x00, 0x02, 0x02),
    State.FAULT_REACTION_ACTIVE: (0x00, 0x00, 0x02),
    State.FAULT:                 (0x00, 0x00, 0x02),
    State.UNKNOWN:               (0x02, 0x02, 0x02),
}


@pytest.mark.parametrize("state", list(State))
def test_controlwords(state):
    assert tuple(controlword_towards(state, wish) for wish in (PowerRequest.OFF, PowerRequest.ENABLED,
                                                               PowerRequest.QUICK_STOP)) == WORDS[state]


@pytest.mark.parametrize("wish", list(PowerRequest))
@pytest.mark.parametrize("state", list(State))
def test_no_word_resets_a_fault_or_halts(state, wish):
    assert controlword_towards(state, wish) & ~0x0F == 0


def follow(start, wish, cycles):
    machine = PowerMachine(start)
    path = [start]
    for _ in range(cycles):
        machine.step()
        machine.obey(controlword_towards(decode(machine.status), wish))
        path.append(machine.state)
    return path


@pytest.mark.parametrize("wish", list(PowerRequest))
@pytest.mark.parametrize("start", [NOT_READY, OFF, READY, ON, ENABLED, STOPPING])
def test_the_requested_state_is_reached_within_four_transitions_and_held(start, wish):
    path = follow(start, wish, 12)
    goal = {STOPPING} if (start, wish) == (STOPPING, PowerRequest.ENABLED) else NEAR[wish]
    assert path[4] in goal
    assert set(path[4:]) == {path[4]}


@pytest.mark.parametrize("wish", list(PowerRequest))
@pytest.mark.parametrize("start", [FAULT, REACTION, STOPPING])
def test_nothing_is_enabled_out_of_a_fault_or_a_quick_stop(start, wish):
    assert ENABLED not in follow(start, wish, 20)


@pytest.mark.parametrize("wish", list(PowerRequest))
@pytest.mark.parametrize("start", [FAULT, REACTION])
def test_a_fault_stays_until_it_is_reset(start, wish):
    assert follow(start, wish, 20)[-1] == FAULT


def test_a_turning_shaft_loses_no_voltage_on_the_way_to_a_stop():
    for wish in PowerRequest:
        assert controlword_towards(State.OPERATION_ENABLED, wish) & 0b0010
    assert follow(ENABLED, PowerRequest.OFF, 2) == [ENABLED, ON, OFF]
