"""A drive that leaves operation by itself is not enabled again by itself, whichever way it left."""

import pytest

from drivers.canopen.drive import Cia402Drive
from drivers.clock import SteppedClock
from drivers.drive import Command, DriveLimits, Mode, PowerState
from tests.drivers.power_machine import ENABLED, FAULT, OFF, READY
from tests.drivers.scripted_drive import TPDO1

LIMITS = DriveLimits(speed_rad_s=10.0, torque_nm=300.0, quick_stop_rad_s2=2.0, watchdog_s=0.4)
TURN = Command(Mode.SPEED, 1.0, 0.0)


def cycles(drive, wire, count=20):
    for _ in range(count):
        wire.put(0x701, b"\x05")
        state = drive.exchange(TURN).state
    return state


@pytest.fixture
def drive(wire, peer, profile):
    drive = Cia402Drive(wire, profile, SteppedClock(), node=1)
    drive.connect()
    drive.preflight(LIMITS)
    drive.enable(Mode.SPEED)
    assert cycles(drive, wire) is PowerState.ENABLED
    return drive


@pytest.mark.parametrize(("state", "shown"), [
    (OFF, PowerState.OFF), (READY, PowerState.OFF), (FAULT, PowerState.FAULT),
])
def test_it_stays_out(drive, wire, peer, state, shown):
    peer.machine.state = state
    assert cycles(drive, wire) is shown
    begin = len(peer.setpoints)
    assert cycles(drive, wire, 100) is shown
    assert all(word & 0x0F != 0x0F for word, _, _ in peer.setpoints[begin:])


def test_it_comes_back_when_asked_in_again(drive, wire, peer):
    peer.machine.state = OFF
    assert cycles(drive, wire) is PowerState.OFF
    drive.enable(Mode.SPEED)
    assert cycles(drive, wire) is PowerState.ENABLED
    assert peer.machine.state == ENABLED


def test_one_that_was_enabled_and_shows_no_state_is_left_to_its_watchdog(drive, wire, peer):
    """A statusword of zero, whoever made it one, is no proof that the drive is off."""
    armed = peer.value(0x1016, 1)
    peer.tpdo = lambda cycle: TPDO1.pack(0, 0, 50_000)
    assert cycles(drive, wire) is PowerState.NOT_READY
    written = len(peer.writes)
    drive.close()
    assert peer.value(0x1016, 1) == armed != 0
    assert len(peer.writes) == written
