import pytest

from sim_bus.cia402 import STATUS, DeviceCommand, State, decode, fault_reset_edge, next_state

# From the table of transitions in CiA 402-2: number, from, command, to.
TABLE = """
 2 SWITCH_ON_DISABLED SHUTDOWN        READY
 3 READY              SWITCH_ON       SWITCHED_ON
 3 READY              ENABLE          SWITCHED_ON
 4 SWITCHED_ON        ENABLE          ENABLED
 5 ENABLED            SWITCH_ON       SWITCHED_ON
 6 SWITCHED_ON        SHUTDOWN        READY
 7 READY              QUICK_STOP      SWITCH_ON_DISABLED
 7 READY              DISABLE_VOLTAGE SWITCH_ON_DISABLED
 8 ENABLED            SHUTDOWN        READY
 9 ENABLED            DISABLE_VOLTAGE SWITCH_ON_DISABLED
10 SWITCHED_ON        QUICK_STOP      SWITCH_ON_DISABLED
10 SWITCHED_ON        DISABLE_VOLTAGE SWITCH_ON_DISABLED
11 ENABLED            QUICK_STOP      QUICK_STOP
12 QUICK_STOP         DISABLE_VOLTAGE SWITCH_ON_DISABLED
16 QUICK_STOP         ENABLE          ENABLED
"""
ROWS = {(row[1], row[2]): row[3] for row in (line.split() for line in TABLE.strip().splitlines())}


@pytest.mark.parametrize("state", list(State))
@pytest.mark.parametrize("command", list(DeviceCommand))
def test_every_pair_of_state_and_command(state: State, command: DeviceCommand) -> None:
    wanted = ROWS.get((state.name, command.name), state.name)
    assert next_state(state, command, 6).name == wanted


def test_leaving_quick_stop_needs_an_option_that_stays() -> None:
    for option in (0, 1, 2, 3):
        assert next_state(State.QUICK_STOP, DeviceCommand.ENABLE, option) is State.QUICK_STOP


@pytest.mark.parametrize(("word", "command"), [
    (0x0000, "DISABLE_VOLTAGE"), (0x000D, "DISABLE_VOLTAGE"), (0x0002, "QUICK_STOP"), (0x000B, "QUICK_STOP"),
    (0x0006, "SHUTDOWN"), (0x000E, "SHUTDOWN"), (0x0007, "SWITCH_ON"), (0x000F, "ENABLE"), (0x010F, "ENABLE"),
])
def test_controlwords(word: int, command: str) -> None:
    assert decode(word).name == command


def test_statuswords_under_their_masks() -> None:
    masks = {"NOT_READY": (0x4F, 0x00), "SWITCH_ON_DISABLED": (0x4F, 0x40), "READY": (0x6F, 0x21),
             "SWITCHED_ON": (0x6F, 0x23), "ENABLED": (0x6F, 0x27), "QUICK_STOP": (0x6F, 0x07),
             "FAULT_REACTION": (0x4F, 0x0F), "FAULT": (0x4F, 0x08)}
    for state in State:
        for name, (mask, value) in masks.items():
            assert (STATUS[state] & mask == value) is (state.name == name)


def test_reset_is_an_edge() -> None:
    assert fault_reset_edge(0x00, 0x80)
    assert not fault_reset_edge(0x80, 0x80) and not fault_reset_edge(0x80, 0x00)
