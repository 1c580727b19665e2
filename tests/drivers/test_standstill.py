"""Standstill in a stop outside of any run: within one bound, and by the position if a count is coarser."""

import json

import pytest

from drivers.canopen.quick_stop import CanopenTarget
from drivers.clock import MonotonicClock, SteppedClock
from drivers.drive import PositionReading
from drivers.modbus.link import EmbeddedLink
from drivers.modbus.quick_stop import ModbusTarget
from drivers.quick_stop import Ended, bare_stop
from drivers.standstill import STANDSTILL_RAD_S, PositionSource, StandstillTest
from profiles.library import load_profile
from profiles.modbus import ModbusProfile
from tests.drivers.modbus_bank import Bank
from tests.drivers.power_machine import STOPPING
from tests.drivers.scripted_drive import ScriptedDrive, u

RPM = 0.10471975511965977
COUNTS_PER_TURN = 4096


def no_position():
    return None


@pytest.mark.parametrize(("count_rad_s", "counts", "near"), [
    (0.1 * RPM, 4, True), (0.1 * RPM, 5, False), (0.02, 3, True), (0.02, 4, False),
    (RPM, 1, True), (RPM, 2, False), (RPM, -3, False), (0.2, 1, True), (0.21, 1, False), (10.0 * RPM, 1, False),
    (10.0 * RPM, 0, True), (None, 1, False), (None, 0, True),
])
def test_three_counts_are_noise_only_below_the_bound(count_rad_s, counts, near):
    test = StandstillTest(count_rad_s, no_position)
    assert test.near_zero(counts) is near
    assert not near or count_rad_s is None or abs(counts) * count_rad_s <= STANDSTILL_RAD_S


class Turning:
    """Position that turns at ``rad_s``, is read every ``every_s``, and wraps."""

    def __init__(self, rad_s, every_s=0.04, wraps_rad=6.0, count_rad=0.002):
        self.rad_s, self.every_s, self.wraps_rad, self.time_s, self.fails = rad_s, every_s, wraps_rad, 0.0, False
        self.source, self.sought = PositionSource(count_rad, self.read), 0

    def find(self):
        self.sought += 1
        return self.source

    def read(self):
        self.time_s += self.every_s
        if self.fails:
            return None
        return PositionReading(self.time_s, 0.001, self.time_s * self.rad_s % self.wraps_rad, self.wraps_rad, "6064h")


def longest_s(turning, test):
    """Return the longest uninterrupted time at standstill within ten seconds."""
    most = run = 0
    for _ in range(round(10.0 / turning.every_s)):
        run = run + 1 if test.near_zero(0) else 0
        most = max(most, run)
    return most * turning.every_s


@pytest.mark.parametrize(("rad_s", "stands"), [(0.0, True), (0.05, True), (-0.09, True), (0.2, False), (-1.0, False)])
def test_a_coarse_speed_of_zero_needs_a_constant_position(rad_s, stands):
    turning = Turning(rad_s)
    within_s = longest_s(turning, StandstillTest(10.0 * RPM, turning.find))
    assert within_s > 9.0 if stands else within_s < 1.0
    assert turning.sought == 1


@pytest.mark.parametrize(("rad_s", "stands"), [(0.0, True), (0.05, True), (0.2, False), (1.0, False)])
def test_a_fine_speed_of_zero_needs_a_constant_position_too(rad_s, stands):
    """A lost speed signal reports zero with any resolution."""
    turning = Turning(rad_s)
    test = StandstillTest(RPM, turning.find)
    within_s = longest_s(turning, test)
    assert within_s > 9.0 if stands else within_s < 1.0
    assert turning.sought == 1 and test.remarks() == ()


def test_a_fine_speed_without_a_position_is_taken_alone():
    assert StandstillTest(RPM, lambda: None).near_zero(1)
    assert not StandstillTest(RPM, lambda: None).near_zero(3)


def test_a_position_that_is_not_read_shows_no_standstill():
    turning = Turning(0.0)
    test = StandstillTest(10.0 * RPM, turning.find)
    assert test.near_zero(0)
    turning.fails = True
    assert not test.near_zero(0)


@pytest.mark.parametrize(("count_rad", "count_rad_s", "words"), [
    (0.002, 10.0 * RPM, ("one count of the reported speed is 1.05 rad/s", "The position was compared, too")),
    (6.28, 10.0 * RPM, ("at most 0.2 rad/s", "There is no position to compare", "by sight")),
    (0.002, None, ("the unit of the reported speed is unknown", "The position was compared, too")),
])
def test_the_message_names_the_reason(count_rad, count_rad_s, words):
    turning = Turning(0.0, count_rad=count_rad)
    test = StandstillTest(count_rad_s, turning.find)
    assert test.remarks() == ()
    test.near_zero(0)
    (said,) = test.remarks()
    assert all(one in said for one in words)


# -- CiA 402 -----------------------------------------------------------------------------------------------------


def canopen(wire, rpm_per_lsb):
    peer = ScriptedDrive(wire, marker=False)
    peer.machine.state = STOPPING
    peer.objects |= {(0x606C, 0): u(0, 4), (0x605A, 0): u(6, 2)}
    profile = load_profile("generic/cia402")
    speed = profile.speed.model_copy(update={"rpm_per_lsb": rpm_per_lsb})
    return peer, CanopenTarget(wire, profile.model_copy(update={"speed": speed}), MonotonicClock(), node=1)


@pytest.mark.parametrize(("rpm_per_lsb", "counts", "near"), [(0.1, 3, True), (1.0, 3, False), (10.0, 3, False),
                                                             (10.0, 1, False), (10.0, 0, True)])
def test_canopen(wire, rpm_per_lsb, counts, near):
    peer, target = canopen(wire, rpm_per_lsb)
    peer.objects[0x606C, 0] = u(counts, 4)
    assert target.poll().near_zero is near


@pytest.mark.parametrize("rpm_per_lsb", [0.1, 10.0])
@pytest.mark.parametrize("turns", [False, True])
def test_canopen_with_a_position(wire, turns, rpm_per_lsb):
    """The speed reads zero, in fine counts or in counts of 10 rpm, and the shaft turns at 4 rad/s."""
    peer, target = canopen(wire, rpm_per_lsb)
    peer.objects |= {(0x608F, 1): u(COUNTS_PER_TURN, 4), (0x608F, 2): u(1, 4), (0x6064, 0): u(0, 4)}

    def turn(request):
        counts = round(wire.time.now_s * 4.0 / 6.2832 * COUNTS_PER_TURN) if turns else 77
        peer.objects[0x6064, 0] = u(counts % (1 << 32), 4)

    peer.before_answer = turn
    report = bare_stop(target, MonotonicClock())
    assert report.ended is (Ended.TURNING if turns else Ended.AT_REST)
    assert any("The position was compared, too" in remark for remark in report.remarks) is (rpm_per_lsb == 10.0)


def test_canopen_with_another_unit_than_the_profile(wire):
    """60A9h is not that of the profile: a count may be any speed."""
    peer, target = canopen(wire, 1.0)
    speed = target._profile.speed.model_copy(update={"si_unit": 0x00B44700})
    target._profile = target._profile.model_copy(update={"speed": speed})
    peer.objects |= {(0x60A9, 0): u(0x01B44700, 4), (0x606C, 0): u(1, 4)}
    assert not target.poll().near_zero
    peer.objects[0x606C, 0] = u(0, 4)
    assert target.poll().near_zero
    assert any("unit of the reported speed is unknown" in remark for remark in target.remarks())


# -- Modbus ------------------------------------------------------------------------------------------------------


def modbus(bank, per_lsb):
    plain = load_profile("generic/modbus").model_dump(by_alias=True)
    plain["cycle"]["speed"] |= {"per_lsb": per_lsb}
    profile = ModbusProfile.model_validate_json(json.dumps(plain))
    return ModbusTarget(EmbeddedLink(bank.serve, SteppedClock()), profile, unit=1)


@pytest.mark.parametrize(("per_lsb", "counts", "near"), [(0.01, 40, True), (1.0, 1, True), (1.0, 3, False),
                                                         (10.0, 3, False), (10.0, 1, False), (10.0, 0, True)])
def test_modbus(per_lsb, counts, near):
    bank = Bank()
    bank.feedback = lambda: (counts, 0)
    target = modbus(bank, per_lsb)
    assert target.poll().near_zero is near
    assert bool(target.remarks()) is (per_lsb == 10.0 and counts == 0)
