"""Drive that leaves operation without a command: it is not enabled again without a request."""

import pytest

from drivers.drive import Mode, PowerState
from drivers.errors import CommunicationLost
from tests.drivers.on_wire import cycles, enabled
from tests.drivers.power_machine import ENABLED, FAULT, OFF, READY
from tests.drivers.scripted_drive import TPDO1


@pytest.fixture
def drive(wire, peer, profile):
    drive = enabled(wire, profile)
    assert cycles(drive, wire).state is PowerState.ENABLED
    return drive


@pytest.mark.parametrize(("state", "shown"), [
    (OFF, PowerState.OFF), (READY, PowerState.OFF), (FAULT, PowerState.FAULT),
])
def test_it_stays_out_of_operation(drive, wire, peer, state, shown):
    peer.machine.state = state
    assert cycles(drive, wire).state is shown
    begin = len(peer.setpoints)
    assert cycles(drive, wire, 100).state is shown
    assert all(word & 0x0F != 0x0F for word, _, _ in peer.setpoints[begin:])


def test_it_returns_to_operation_on_request(drive, wire, peer):
    peer.machine.state = OFF
    assert cycles(drive, wire).state is PowerState.OFF
    drive.enable(Mode.SPEED)
    assert cycles(drive, wire).state is PowerState.ENABLED
    assert peer.machine.state == ENABLED


def test_one_that_was_enabled_and_shows_no_state_is_left_to_its_watchdog(drive, wire, peer):
    """A statusword of zero from any cause is no proof that the drive is disabled."""
    armed = peer.value(0x1016, 1)
    peer.tpdo = lambda cycle: TPDO1.pack(0, 0, 50_000)
    assert cycles(drive, wire).state is PowerState.UNKNOWN
    written = len(peer.writes)
    drive.close()
    assert peer.value(0x1016, 1) == armed != 0
    assert len(peer.writes) == written


# -- control place -----------------------------------------------------------------------------------------------------


def test_a_drive_that_is_switched_to_another_control_place_ends_the_run(drive, wire, peer):
    """The test clears bit 9 of the statusword, which was set in operation."""
    peer.tpdo = lambda cycle: TPDO1.pack(peer.machine.status | 0x1000, 0, 0)
    with pytest.raises(CommunicationLost, match=r"bit 9 \(remote\) of the statusword 1037h is 0"):
        cycles(drive, wire, 5)
    drive.quick_stop()
    cycles(drive, wire, 20)            # reported once


def test_a_drive_that_never_sets_that_bit_is_not_judged_by_it(wire, peer, profile):
    peer.tpdo = lambda cycle: TPDO1.pack(peer.machine.status | 0x1000, 0, 0)
    assert cycles(enabled(wire, profile), wire, 100).state is PowerState.ENABLED


def test_one_frame_without_it_is_an_accident(drive, wire, peer):
    plain, few = peer.tpdo, iter((True, True, False) * 100)
    peer.tpdo = lambda cycle: TPDO1.pack(peer.machine.status | 0x1000, 0, 0) if next(few) else plain(cycle)
    assert cycles(drive, wire, 60).state is PowerState.ENABLED


@pytest.mark.parametrize("target", [0, 1])
def test_pre_operational_and_start_in_quick_succession_are_noticed(drive, wire, target):
    """The heartbeat does not show it, since the drive is operational again at the next one."""
    wire.put(0x000, bytes((0x80, target)))
    wire.put(0x000, bytes((0x01, target)))
    with pytest.raises(CommunicationLost, match="another master put the drive into NMT state pre-operational"):
        cycles(drive, wire, 3)
    assert [line for line in drive.remarks() if "NMT start" in line]


def test_commands_to_other_nodes_and_a_start_are_no_trouble(drive, wire):
    wire.put(0x000, bytes((0x80, 5)))
    wire.put(0x000, bytes((0x01, 0)))
    assert cycles(drive, wire, 20).state is PowerState.ENABLED
    assert drive.remarks() == ("another master sent NMT start to all nodes",)
