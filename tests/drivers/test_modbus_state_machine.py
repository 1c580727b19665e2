"""Control words for status words: the generic profile against the standard's table, typed in power_machine."""

import itertools

import pytest

from drivers.drive import Mode, PowerRequest, PowerState
from drivers.modbus.state_machine import controlword_towards, decode, power_state, seen
from profiles.library import load_modbus_profile
from profiles.modbus import Bits
from tests.drivers.power_machine import (
    ENABLED,
    FAULT,
    OFF,
    ON,
    REACTION,
    READY,
    STATUS_PATTERNS,
    STOPPING,
    PowerMachine,
    matches,
)

CONTROL = load_modbus_profile("generic/modbus").control
POWER = {
    "not ready": PowerState.NOT_READY, OFF: PowerState.OFF, READY: PowerState.READY, ON: PowerState.READY,
    ENABLED: PowerState.ENABLED, STOPPING: PowerState.QUICK_STOP, FAULT: PowerState.FAULT,
    REACTION: PowerState.FAULT_REACTION,
}


def test_every_status_word():
    for low in range(0x100):
        meant = [POWER[state] for state, pattern in STATUS_PATTERNS.items() if matches(low, pattern)]
        assert power_state(decode(CONTROL, 0xA200 | low)) is (meant[0] if meant else PowerState.UNKNOWN)


def walk(machine, wish, cycles=10, turning=False):
    states = [machine.state]
    for _ in range(cycles):
        word = controlword_towards(CONTROL, decode(CONTROL, machine.status), wish, Mode.SPEED, turning=turning)
        machine.obey(word)
        machine.step()
        states.append(machine.state)
    return [state for state, _ in itertools.groupby(states)]


def test_enable_and_disable():
    machine = PowerMachine()
    assert walk(machine, PowerRequest.ENABLED) == [OFF, READY, ON, ENABLED]
    assert walk(machine, PowerRequest.QUICK_STOP) == [ENABLED, STOPPING]
    assert walk(machine, PowerRequest.ENABLED) == [STOPPING]            # a quick stop is not ended by enabling
    assert walk(machine, PowerRequest.OFF) == [STOPPING, OFF]


@pytest.mark.parametrize("wish", list(PowerRequest))
def test_no_request_resets_a_fault(wish):
    machine = PowerMachine(FAULT)
    assert walk(machine, wish) == [FAULT]


@pytest.mark.parametrize("state", [ENABLED, STOPPING])
def test_a_turning_shaft_is_braked_not_disabled(state):
    machine = PowerMachine(state)
    assert walk(machine, PowerRequest.OFF, turning=True)[-1] == STOPPING
    assert walk(machine, PowerRequest.OFF)[-1] == OFF


@pytest.mark.parametrize("wish", list(PowerRequest))
def test_a_fault_reaction_that_brakes_is_never_switched_off(wish):
    """The power stage is on in fault reaction active and brakes the shaft (CiA 402-2)."""
    state = decode(CONTROL, 0x021F)
    assert controlword_towards(CONTROL, state, wish, Mode.SPEED, turning=True) == CONTROL.quick_stop


def test_bits_of_the_mode_and_the_direction_are_in_every_word():
    control = CONTROL.model_copy(update={"speed_bits": 0x0400, "torque_bits": 0x0C00, "reverse_bits": 0x2000})
    for state, wish in itertools.product((None, *control.states), PowerRequest):
        plain = controlword_towards(CONTROL, state, wish, Mode.SPEED)
        assert controlword_towards(control, state, wish, Mode.SPEED) == plain | 0x0400
        assert controlword_towards(control, state, wish, Mode.TORQUE) == plain | 0x0C00
        assert controlword_towards(control, state, wish, Mode.SPEED, reverse=True) == plain | 0x2400


def test_bits():
    bits = Bits(mask=0x0A00, value=0x0200)
    assert seen(bits, 0xF2FF)
    assert not seen(bits, 0x0A00)
    assert not seen(None, 0xFFFF)
