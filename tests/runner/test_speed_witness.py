"""Check of the unit of speed in stage 2, on a minimal shaft: no bus, no guard, no computer clock."""

import math
from types import SimpleNamespace

import pytest

from drivers.drive import Command, Mode, PositionReading, PowerState, Sample
from drivers.errors import PreflightRefused
from profiles import MessageCode
from tdhil.runner.settings import ControlAssumptions
from tdhil.runner.speed_check import SILENT, SpeedUnitCheck, SpeedWitness, slow_speed, speed_warnings
from tests.runner.fake_drive import LIMITS, FakeLog

PERIOD_S, RESOLUTION_RAD_S, MEAN_RAD_S, RATE_RAD_S2 = 0.02, 0.001, 2.0, 0.2


class Shaft:
    """Shaft that turns ``unit`` times as fast as reported. ``reading(shaft)`` may replace a reading or be None."""

    def __init__(self, unit=1.0, reading=None, counts=4096, follows=True):
        self.unit, self.reading, self.follows = unit, reading, follows
        self.count_rad = 2.0 * math.pi / counts
        self.time_s = self.speed_rad_s = self.angle_rad = 0.0
        self.highest_rad_s = 0.0
        self.readings = 0

    def exchange(self, command):
        self.time_s += PERIOD_S
        self.speed_rad_s = command.speed_rad_s if self.follows else 0.0
        self.angle_rad += self.unit * self.speed_rad_s * PERIOD_S
        self.highest_rad_s = max(self.highest_rad_s, abs(self.unit * self.speed_rad_s))
        return Sample(self.time_s, 0.0, 0.0, True, self.speed_rad_s, 0.0, None, Mode.SPEED, PowerState.ENABLED, False,
                      False, 0)

    def counted(self, **changes):
        angle_rad = self.count_rad * math.floor(self.angle_rad / self.count_rad)
        return PositionReading(self.time_s, 0.001, angle_rad, None, "6064h")._replace(**changes)

    def read_position(self):
        self.readings += 1
        return self.counted() if self.reading is None else self.reading(self)


class WithoutAngle:
    def __init__(self, shaft):
        self.exchange = shaft.exchange


class Loop:
    """The part of `ControlLoop` that the check uses."""

    def __init__(self, drive):
        self.drive, self.log, self.period_s = drive, FakeLog(), PERIOD_S
        self.observer, self.quiet, self.now_s = None, False, 0.0
        self.compared, self.speeds = [], []
        self.guard = SimpleNamespace(observer=SimpleNamespace(compare_position=self.compared.append))

    def cycle(self, command):
        assert command.mode is Mode.SPEED
        sample = self.drive.exchange(command)
        self.now_s = sample.time_s
        self.speeds.append(command.speed_rad_s)
        if self.observer is not None:
            self.observer(command, sample)
        return sample

    def hold(self, command, seconds):
        return [self.cycle(command) for _ in range(self.cycles(seconds))]

    def cycles(self, seconds):
        return max(1, round(seconds / PERIOD_S))


class Checked:
    """The check during stage 2, up to the end of its operating point."""

    def __init__(self, shaft, *, has_angle=True, answer=None, mean_rad_s=MEAN_RAD_S, **witness):
        self.shaft, self.said, self.asked, self.refused = shaft, [], [], None
        self.loop = loop = Loop(shaft if has_angle else WithoutAngle(shaft))

        def confirm(speed_rad_s, why, idle):
            assert loop.quiet
            before = len(loop.speeds)
            idle()
            assert len(loop.speeds) == before + 1
            self.asked.append((speed_rad_s, why))
            if answer is not True:
                raise PreflightRefused("it was not seen", where="prompt")

        check = SpeedUnitCheck(
            loop, LIMITS, ControlAssumptions(largest_speed_lag_s=0.1), RESOLUTION_RAD_S,
            SpeedWitness(confirm, say=self.said.append, **witness),
        )
        try:
            check.ramp(0.0, mean_rad_s, RATE_RAD_S2)
            self.ramped = len(loop.speeds)
            check.level()
            loop.hold(Command(Mode.SPEED, mean_rad_s, 0.0), 5.0)
            check.conclude(Command(Mode.SPEED, mean_rad_s, 0.0))
        except PreflightRefused as error:
            self.refused = error
        assert not loop.quiet
        assert loop.observer is None                # nothing is read in the stages after it, nor in the stop

    @property
    def unit(self):
        return self.loop.log.run.get("speed_unit")


def assert_refused(checked, words):
    assert checked.refused is not None and words in str(checked.refused)
    assert checked.refused.entry is MessageCode.SPEED_UNIT_WRONG
    assert checked.unit is None


RAMP_CYCLES = round(MEAN_RAD_S / RATE_RAD_S2 / PERIOD_S)


def test_a_right_unit_is_seen_on_the_way_and_at_the_mean_speed():
    checked = Checked(Shaft())
    assert checked.refused is None and not checked.asked and not checked.said
    assert checked.ramped == RAMP_CYCLES                         # without a pause
    assert checked.unit["seen_by"] == "position" and checked.unit["where"] == "6064h"
    assert checked.unit["ratio"] == pytest.approx(1.0, abs=0.01)
    assert checked.loop.compared == [checked.unit["ratio"]]      # the observer continues with this angle
    assert any("times the integral of the reported speed" in text for _, text in checked.loop.log.events)
    assert speed_warnings(checked.loop.log.run) == ()


def test_a_right_unit_is_seen_backwards_and_at_a_mean_speed_below_the_slow_one():
    assert Checked(Shaft(), mean_rad_s=-MEAN_RAD_S).unit["ratio"] == pytest.approx(1.0, abs=0.01)
    slowly = Checked(Shaft(), mean_rad_s=0.2)
    assert slowly.unit["seen_by"] == "position"
    assert max(slowly.loop.speeds) == pytest.approx(slow_speed(LIMITS, RESOLUTION_RAD_S))


@pytest.mark.parametrize("counts", [60, 12])
def test_a_coarse_angle_is_compared_at_the_slow_speed(counts):
    """The resolution of the angle is too coarse for a speed, so the ramp waits."""
    checked = Checked(Shaft(counts=counts))
    assert checked.ramped > RAMP_CYCLES + 100
    assert checked.unit["ratio"] == pytest.approx(1.0, abs=0.05)


class Slowing(Shaft):
    """Shaft that is faster than the slow speed after the sign probe. Its report lags by 0.4 s."""

    reported_rad_s = 0.0

    def exchange(self, command):
        told = super().exchange(command)
        extra_rad_s = 3.0 * math.exp(-self.time_s / 2.0)
        self.angle_rad += extra_rad_s * PERIOD_S
        self.reported_rad_s += PERIOD_S / 0.4 * (told.speed_rad_s + extra_rad_s - self.reported_rad_s)
        return told._replace(speed_rad_s=self.reported_rad_s)


def test_no_lag_counts_as_travel_while_the_shaft_still_slows_down():
    checked = Checked(Slowing(), mean_rad_s=0.6)
    assert checked.refused is None and checked.loop.compared[0] == pytest.approx(1.0, abs=0.04)


@pytest.mark.parametrize(("unit", "said"), [(1.015, False), (0.985, False), (1.05, True), (0.95, True)])
def test_a_small_difference_is_reported_from_two_percent_on(unit, said):
    checked = Checked(Shaft(unit))
    assert checked.refused is None and checked.unit["ratio"] == pytest.approx(unit, abs=0.01)
    assert [f"{100.0 * (unit - 1.0):+.0f}"[:2] in text for text in checked.said] == [True] * said
    assert len(speed_warnings(checked.loop.log.run)) == said


@pytest.mark.parametrize(("unit", "words"), [
    (10.0, "too small by a factor of"), (3.0, "too small by a factor of 3"), (1.3, "too small by a factor of 1.3"),
    (0.7, "too large by a factor of 1.43"), (0.1, "too large by a factor of 10"), (-1.0, "a sign is inverted"),
])
def test_a_wrong_unit_is_refused_before_the_shaft_is_fast(unit, words):
    checked = Checked(Shaft(unit))
    assert_refused(checked, words)
    fastest = abs(unit) * MEAN_RAD_S if abs(unit) < 2.0 else max(abs(unit) * 0.55, 2.0)
    assert checked.shaft.highest_rad_s <= fastest                # 0.55 rad/s: the slow speed is 0.524
    assert "speed" in checked.refused.next_step


def test_the_ramp_waits_where_the_angle_is_twice_as_fast_as_commanded_and_beyond_a_tenth_of_the_limit():
    checked = Checked(Shaft(3.0))
    assert 0.1 * LIMITS.speed_max_rad_s < checked.shaft.highest_rad_s < 0.12 * LIMITS.speed_max_rad_s


def test_a_shaft_near_the_highest_speed_is_refused_without_a_comparison():
    """The unit changes on the ramp. The run ends at 0.7 of the highest speed by the angle, without a comparison."""
    class Jumping(Shaft):
        def exchange(self, command):
            self.unit = 1.0 if abs(command.speed_rad_s) < 1.5 else 4.9
            return super().exchange(command)

    checked = Checked(Jumping())
    assert_refused(checked, "rad/s or more, where")
    assert 0.7 * LIMITS.speed_max_rad_s < checked.shaft.highest_rad_s < 0.85 * LIMITS.speed_max_rad_s


def test_a_shaft_that_gets_too_fast_on_the_ramp_waits_there_and_is_compared():
    class Jumping(Shaft):
        def exchange(self, command):
            self.unit = 1.0 if abs(command.speed_rad_s) < 1.0 else 3.0
            return super().exchange(command)

    checked = Checked(Jumping())
    assert_refused(checked, "3 times as fast")
    assert checked.loop.speeds[-1] < 1.2
    assert checked.loop.speeds.count(checked.loop.speeds[-1]) > 2.0 / PERIOD_S


# -- accepted by override --------------------------------------------------------------------------------------------


def test_a_wrong_unit_is_accepted_by_override_if_the_second_mean_speed_is_not_too_fast():
    checked = Checked(Shaft(0.5), accepted=True)
    assert checked.refused is None and checked.unit["seen_by"] == "--accept-speed-unit"
    assert checked.unit["ratio"] == pytest.approx(0.5, abs=0.01)
    assert checked.loop.log.facts == {"speed_unit_accepted": True}
    assert "0.5 times as fast" in checked.said[0]
    assert any("0.5 times as fast" in text for _, text in checked.loop.log.events)
    assert "accepted by --accept-speed-unit" in str(speed_warnings(checked.loop.log.run)[0])
    assert_refused(Checked(Shaft(1.6), accepted=True), "1.6 times as fast")       # 1.6 · 7.15 rad/s > 10 rad/s
    assert Checked(Shaft(1.3), accepted=True).refused is None


# -- without an angle, or with a constant one ---------------------------------------------------------------------


def test_without_an_angle_the_operator_confirms_the_speed():
    checked = Checked(Shaft(), has_angle=False, answer=True)
    assert checked.refused is None and checked.unit == {"seen_by": "operator", "ratio": None, "where": ""}
    (speed, why), = checked.asked
    assert speed == pytest.approx(slow_speed(LIMITS, RESOLUTION_RAD_S)) and "reports no position" in why
    assert checked.ramped > RAMP_CYCLES + 3.0 / PERIOD_S         # the shaft turns for three seconds before the question
    assert sum("operator" in text for _, text in checked.loop.log.events) == 2
    assert "was not seen" in str(Checked(Shaft(), has_angle=False, answer=False).refused)


def test_there_is_no_question_if_the_shaft_does_not_turn_at_the_slow_speed():
    assert_refused(Checked(Shaft(follows=False), has_angle=False, answer=True), "does not follow a speed of 0.524")


@pytest.mark.parametrize(("witness", "by", "words"), [
    ({"simulated": True}, "nobody", "not checked"), ({"accepted": True}, "--accept-speed-unit", "accepted by"),
])
def test_without_an_angle_a_simulated_or_accepted_drive_continues_with_a_note(witness, by, words):
    checked = Checked(Shaft(), has_angle=False, **witness)
    assert checked.refused is None and checked.ramped == RAMP_CYCLES and not checked.asked
    assert checked.unit == {"seen_by": by, "ratio": None, "where": ""}
    assert len(checked.said) == 1 and words in checked.said[0]
    assert any(words in text for _, text in checked.loop.log.events)


def frozen(shaft):
    return shaft.counted(position_rad=1.0)


def test_with_a_constant_angle_the_operator_is_asked_or_the_run_is_refused():
    checked = Checked(Shaft(reading=frozen), answer=True)
    assert checked.unit["seen_by"] == "operator" and "does not move while" in checked.asked[0][1]
    assert_refused(Checked(Shaft(reading=frozen), simulated=True), "does not move while")
    assert Checked(Shaft(reading=frozen), simulated=True, accepted=True).unit["seen_by"] == "--accept-speed-unit"


@pytest.mark.parametrize(("missing", "lost"), [(SILENT - 1, False), (SILENT, True)])
def test_an_angle_is_lost_after_five_readings_without_an_answer(missing, lost):
    def reading(shaft):
        return None if 20 < shaft.readings <= 20 + missing else shaft.counted()

    checked = Checked(Shaft(reading=reading), answer=True)
    assert checked.unit["seen_by"] == ("operator" if lost else "position")
    assert SILENT == 5
    if lost:
        assert "no longer reports the position" in checked.asked[0][1]
        assert checked.shaft.readings == 20 + missing            # no more readings are requested


def test_a_reading_of_uncertain_time_is_left_out():
    """The host was late: the shaft has turned by an unknown angle in the meantime."""
    def reading(shaft):
        if shaft.readings % 7:
            return shaft.counted()
        late = shaft.counted(half_width_s=0.05)
        return late._replace(position_rad=late.position_rad + 30.0)

    checked = Checked(Shaft(reading=reading))
    assert checked.unit["ratio"] == pytest.approx(1.0, abs=0.01) and checked.ramped == RAMP_CYCLES


def test_a_line_whose_readings_are_always_uncertain_is_used():
    checked = Checked(Shaft(reading=lambda shaft: shaft.counted(half_width_s=0.03)))
    assert checked.unit["seen_by"] == "position"


def test_the_angle_is_read_each_third_cycle_on_the_ramp_and_less_often_at_the_mean_speed():
    checked = Checked(Shaft())
    on_ramp = RAMP_CYCLES / 3
    assert on_ramp * 0.9 < checked.shaft.readings - 5.0 / 0.25 < on_ramp * 1.1


def test_an_angle_that_wraps_is_read_as_often_at_the_mean_speed_where_it_must():
    def reading(shaft):
        return shaft.counted(position_rad=shaft.counted().position_rad % (2.0 * math.pi), wraps_rad=2.0 * math.pi)

    checked = Checked(Shaft(reading=reading))
    assert checked.unit["ratio"] == pytest.approx(1.0, abs=0.01)
    assert checked.shaft.readings > (RAMP_CYCLES + 5.0 / PERIOD_S) / 3 * 0.9


@pytest.mark.parametrize("found", [{}, {"speed_unit": None}, {"speed_unit": {"seen_by": "operator", "ratio": None}}])
def test_a_log_without_a_difference_has_no_warning(found):
    assert speed_warnings(found) == ()
