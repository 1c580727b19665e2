"""A line that delivers every request and loses every reply: a stop must reach the drive, which feeds its watchdog."""

import json
from contextlib import suppress
from dataclasses import replace

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Command, Mode
from drivers.errors import CommunicationLost, TdhilError
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from drivers.modbus.quick_stop import ModbusTarget
from drivers.quick_stop import Ended, bare_stop
from profiles.library import load_modbus_profile
from profiles.modbus import ModbusProfile
from tests.drivers.modbus_bank import CONTROL, Bank
from tests.drivers.modbus_turning import CASES, FREE, Turning
from tests.drivers.power_machine import ENABLED, STOPPING
from tests.rigs import DRIVE_LIMITS

LIMITS = replace(DRIVE_LIMITS, watchdog_s=10.0)
"""Long watchdog times, so that the host must stop the shaft: requests that feed no watchdog come for some seconds."""
EVERY_CASE = pytest.mark.parametrize(("profile", "mode"), CASES, ids=lambda one: getattr(one, "name", one))


def assert_braked(turning, since_s):
    """The shaft is braked to standstill by the host's word, never free, and without the drive's watchdog."""
    assert not turning.simulated.machine.watchdog.lost, "the drive's watchdog stopped the shaft, not the host"
    rows = [row for row in turning.rows() if row[0] >= since_s]
    assert abs(rows[0][1]) > 2.0 and abs(rows[-1][1]) < 0.05
    assert not [row for row in rows if row[2] in FREE and abs(row[1]) > 0.1], "a turning shaft was released"


@EVERY_CASE
def test_a_bare_stop_writes_the_quick_stop(profile, mode, tmp_path):
    turning = Turning(profile, mode, tmp_path, LIMITS)
    turning.mute, since_s = True, turning.clock.now_s()
    report = bare_stop(ModbusTarget(turning.link, profile, unit=1), turning.clock)
    assert report.ended is Ended.NO_ANSWER
    assert turning.quick_stop_word in turning.control_words()
    assert any("without knowing the drive's state" in remark for remark in report.remarks)
    if profile.watchdog.fed_by == "any_request":       # reading feeds no other watchdog, so that it acts by itself
        assert_braked(turning, since_s)


@EVERY_CASE
def test_a_run_writes_the_quick_stop(profile, mode, tmp_path):
    turning = Turning(profile, mode, tmp_path, LIMITS)
    drive, since_s = turning.drive, turning.clock.now_s()
    turning.mute = True
    with pytest.raises(CommunicationLost, match="no good reply") as lost:
        for _ in range(1000):
            drive.exchange(turning.command)
    turning.requests.clear()
    drive.quick_stop()
    until_s = turning.clock.now_s() + 4.0
    while turning.clock.now_s() < until_s:
        with suppress(TdhilError):
            assert not drive.exchange(Command(Mode.SPEED, 0.0, 0.0)).fresh
    assert set(turning.control_words()) == {turning.quick_stop_word}
    assert "tdhil continues to send the quick stop" in lost.value.next_step
    if mode is Mode.SPEED or profile.quick_stop.decelerates_in_torque_mode:
        assert_braked(turning, since_s)


# -- removing the torque by polls, while the cycles fail ---------------------------------------------------------


@pytest.mark.parametrize("coast", [0x0005, None])
@pytest.mark.parametrize("state", [ENABLED, STOPPING])
def test_a_poll_does_not_give_the_torque_back(coast, state):
    """A shaft that accelerates against its quick stop has lost its torque; a poll must not write the quick stop."""
    data = load_modbus_profile("generic/modbus").model_dump(by_alias=True)
    data["control"] |= {"coast": coast}
    bank, clock = Bank(), SteppedClock()
    drive = ModbusDrive(EmbeddedLink(bank.serve, clock), ModbusProfile.model_validate_json(json.dumps(data)), unit=1)
    drive.connect()
    assert not drive.preflight(DRIVE_LIMITS).refused
    drive.enable(Mode.SPEED)
    for _ in range(4):
        drive.exchange(Command(Mode.SPEED, 1.0, 0.0))
    drive.quick_stop()
    bank.machine.state = state
    bank.feedback = lambda: (3000, 0)
    drive.poll()
    bank.writes.clear()
    drive.remove_torque()
    bank.machine.obey = lambda word: None              # the drive ignores it, so that polls continue
    for _ in range(3):
        drive.poll()
    assert bank.writes == [(CONTROL, [0x0000 if coast is None else coast])] * 3
