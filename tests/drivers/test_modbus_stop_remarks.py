"""Remarks of `tdhil stop`: another master, and a shaft that ran out, are reported only if the readings show them."""

from dataclasses import replace

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Mode, PowerState
from drivers.modbus.quick_stop import UNSLOWED_S, ModbusTarget
from drivers.quick_stop import PAUSE_S, Ended, Seen, bare_stop
from tests.drivers.modbus_turning import CASES, MODBUS, Turning
from tests.rigs import DRIVE_LIMITS

LIMITS = replace(DRIVE_LIMITS, watchdog_s=2.0)
EVERY_CASE = pytest.mark.parametrize(("profile", "mode"), CASES, ids=lambda one: getattr(one, "name", one))
UNLATCHED = pytest.mark.parametrize(
    "profile", [one for one in MODBUS if one.control.family not in ("profidrive", "abb")], ids=lambda one: one.name)
"""Profiles whose drives another master can enable by repeating its command. OFF3 inhibits that until OFF1 was 0."""


def stopped(turning, **options):
    return bare_stop(ModbusTarget(turning.link, turning.profile, unit=1), turning.clock, **options)


def said(report, *words):
    return [remark for remark in report.remarks if any(word in remark for word in words)]


@EVERY_CASE
def test_a_drive_alone_gives_no_remark(profile, mode, tmp_path):
    """Several drives show `enabled` during their own stop ramp, and all of them report a speed that lags."""
    report = stopped(Turning(profile, mode, tmp_path, LIMITS))
    assert report.ended is Ended.AT_REST
    assert said(report, "another master", "torque off", "ran out") == []


@UNLATCHED
def test_another_master_is_reported(profile, tmp_path):
    """It writes its own command and setpoint before each request of the host."""
    turning = Turning(profile, Mode.SPEED, tmp_path, LIMITS)
    turning.before = lambda: [turning.simulated.machine.request(pdu, 2) for pdu in turning.cycle]
    report = stopped(turning, longest_s=2.5 * UNSLOWED_S)
    assert report.ended is Ended.TURNING
    assert len(said(report, "follows another master")) == 1


@UNLATCHED
def test_another_master_that_begins_at_standstill_is_reported(profile, tmp_path):
    turning = Turning(profile, Mode.SPEED, tmp_path, LIMITS)
    left = [10]                        # requests of the host that it precedes

    def command():
        if left[0] and abs(turning.simulated.speed_rad_s) < 0.02:
            left[0] -= 1
            for pdu in turning.cycle:
                turning.simulated.machine.request(pdu, 2)

    turning.before = command
    report = stopped(turning)
    assert report.ended is Ended.AT_REST
    assert len(said(report, "enabled again after the quick stop")) == 1


class Falling:
    """Drive whose torque is off from ``off_s`` on. ``speed``: its reported speed, rad/s, over time."""

    def __init__(self, off_s, speed):
        self.clock, self.off_s, self.speed = SteppedClock(), off_s, speed

    def ask(self, attempt):
        pass

    def poll(self):
        now_s = self.clock.now_s()
        speed, state = self.speed(now_s), PowerState.OFF if now_s >= self.off_s else PowerState.QUICK_STOP
        return Seen(state, state.value, speed, "rad/s", near_zero=speed < 0.05, standstill=speed == 0.0, follows=False)

    def remarks(self):
        return ()


RAMP_RAD_S2 = 2.0


def ramp(now_s):
    return max(0.0, 4.0 - RAMP_RAD_S2 * now_s)


@pytest.mark.parametrize(("off_s", "speed", "ran_out"), [
    pytest.param(2.0, lambda now_s: ramp(now_s - 0.4), False, id="dead time"),
    pytest.param(1.8, ramp, False, id="off a little early"),
    pytest.param(1.0, lambda now_s: ramp(now_s) if now_s < 1.0 else max(0.0, 2.0 - 0.4 * (now_s - 1.0)), True,
                 id="off in the ramp"),
    pytest.param(0.5, lambda now_s: max(0.0, 4.0 - 0.4 * now_s), True, id="never braked"),
    pytest.param(0.0, lambda now_s: max(0.0, 4.0 - 0.4 * now_s), True, id="off before the stop"),
])
def test_a_shaft_that_ran_out_is_told_from_a_report_that_lags(off_s, speed, ran_out):
    drive = Falling(off_s, speed)
    report = bare_stop(drive, drive.clock)
    assert report.ended is Ended.AT_REST
    assert bool(said(report, "the shaft ran out without a brake")) is ran_out


def test_a_first_order_lag_is_no_shaft_that_ran_out():
    """The report follows a ramp by 0.4 s, and shows 0.8 rad/s when the drive has stopped the shaft."""
    drive, state = Falling(2.0, lambda now_s: 0.0), [4.0]

    def lagging(now_s):
        state[0] += PAUSE_S / 0.4 * (ramp(now_s) - state[0])
        return state[0]

    drive.speed = lagging
    report = bare_stop(drive, drive.clock)
    assert report.ended is Ended.AT_REST
    assert report.remarks == ()
