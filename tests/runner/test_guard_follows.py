"""Guard of the drive's control: the displayed mode, and the following error in speed mode."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.drive import Command, Mode, PowerState
from drivers.errors import LimitHit, ModeNotConfirmed
from tdhil.errors import ExitCode, exit_code
from tdhil.runner.guard import FOLLOW_S, FOLLOW_STRING_S, MODE_CYCLES, MODE_LOST_S, MODE_SWITCH_S, Guard
from tests.runner.fake_drive import LIMITS, SPEED_RESOLUTION, TORQUE_RESOLUTION, FakeDrive
from tests.runner.guarded import sample

PERIODS = st.sampled_from([0.01, 0.02, 0.1, 0.25])     # the runs at the usual rate of a drive have shorter periods
STRING = replace(LIMITS, load="string", torque_ramp_nm_s=20.0)


def watching(limits=LIMITS, period_s=0.02, resolution=SPEED_RESOLUTION):
    watch = Guard(limits, period_s, resolution, TORQUE_RESOLUTION)
    watch.expected = PowerState.ENABLED
    return watch


# -- the displayed mode --------------------------------------------------------------------------------------------


def shown(rows, period_s=0.02, expected=PowerState.ENABLED):
    """Check (commanded, displayed[, fresh]) modes one after the other; return the number of accepted cycles."""
    watch = watching(period_s=period_s)
    watch.expected = expected
    for k, (commanded, displayed, *fresh) in enumerate(rows):
        seen = sample(5.0, 90.0 + k % 2, time_s=k * period_s, fresh=not fresh or fresh[0])._replace(mode=displayed)
        command = Command(commanded, 5.0, 90.0)
        try:
            watch.check_sample(command, seen)
        except ModeNotConfirmed as error:
            assert exit_code(error) is ExitCode.DRIVE_FAULT
            assert "left its mode" in error.what and "mode display" in error.where and error.next_step
            return k
    return None


@pytest.mark.parametrize("period_s", [0.004, 0.02, 0.1])
@pytest.mark.parametrize("displayed", [Mode.SPEED, None])
def test_a_mode_that_is_lost_trips_once_it_can_be_no_late_frame(period_s, displayed):
    seen = [(Mode.TORQUE, Mode.TORQUE)] * 20
    lost = [(Mode.TORQUE, displayed)]
    allowed = max(MODE_CYCLES, round(MODE_LOST_S / period_s))
    assert shown(seen + lost * allowed + seen, period_s) is None
    assert shown(seen + lost * (allowed + 5), period_s) == pytest.approx(20 + allowed, abs=1)
    # The mode returns in between each time. The driver counts such losses.
    assert shown((seen + lost * 12) * 5, period_s) is None
    what = "speed mode" if displayed else "an unknown mode"
    with pytest.raises(ModeNotConfirmed, match=what):
        watch = watching(period_s=period_s)
        for k in range(2000):
            there = Mode.TORQUE if k < 3 else displayed
            watch.check_sample(Command(Mode.TORQUE, 5.0, 9.0), sample(5.0, time_s=k * period_s)._replace(mode=there))


@pytest.mark.parametrize("period_s", [0.004, 0.02, 0.1])
def test_a_mode_switch_may_take_longer_and_its_own_time_out_comes_first(period_s):
    before, there = [(Mode.SPEED, Mode.SPEED)] * 20, [(Mode.TORQUE, Mode.TORQUE)] * 9
    allowed = max(MODE_CYCLES, round(MODE_SWITCH_S / period_s))
    assert shown(before + [(Mode.TORQUE, Mode.SPEED)] * (allowed - 1) + there, period_s) is None
    assert shown(before + [(Mode.TORQUE, Mode.SPEED)] * (allowed + 5), period_s) == pytest.approx(20 + allowed, abs=1)
    assert MODE_SWITCH_S > 0.5 and MODE_CYCLES > 10             # `Bench.switch_mode`
    # A second switch has its own time.
    back = [(Mode.SPEED, Mode.TORQUE)] * (allowed - 1) + [(Mode.SPEED, Mode.SPEED)] * 2
    assert shown(before + there + back, period_s) is None


def test_frames_that_do_not_come_show_no_mode():
    rows = [(Mode.TORQUE, Mode.TORQUE)] * 3 + [(Mode.TORQUE, Mode.SPEED)] * 10
    assert shown(rows + [(Mode.TORQUE, Mode.SPEED, False)] * 5 + [(Mode.TORQUE, Mode.TORQUE)] * 3) is None


def test_before_it_is_enabled_no_mode_is_expected():
    assert shown([(Mode.TORQUE, Mode.SPEED)] * 500, expected=None) is None


def test_a_mode_displayed_before_a_new_enable_does_not_count():
    watch = watching()
    for k in range(100):
        watch.expected = None if k % 14 == 13 else PowerState.ENABLED
        seen = sample(5.0, 90.0 + k % 2, time_s=0.02 * k)._replace(mode=Mode.SPEED)
        watch.check_sample(Command(Mode.TORQUE, 5.0, 90.0), seen)


def test_a_mode_displayed_before_it_is_enabled_does_not_shorten_a_switch():
    watch, command = watching(), Command(Mode.TORQUE, 5.0, 90.0)
    watch.expected = None
    watch.check_sample(command, sample(5.0)._replace(mode=Mode.TORQUE))
    watch.expected = PowerState.ENABLED
    for k in range(1, round(MODE_SWITCH_S / 0.02)):
        watch.check_sample(command, sample(5.0, 90.0 + k % 2, time_s=0.02 * k)._replace(mode=Mode.SPEED))


# -- the following error -------------------------------------------------------------------------------------------


def followed(
    reference, speed, seconds, limits=LIMITS, period_s=0.02, torque=lambda t: 90.0, resolution=SPEED_RESOLUTION,
    active=False,
):
    """Report ``speed(time, reference(time), period)`` to a guard; return None or (time, message)."""
    watch = watching(limits, period_s, resolution)
    for k in range(round(seconds / period_s)):
        t = k * period_s
        wanted = reference(t)
        # The last bit changes, so that the torque is not frozen.
        seen = sample(speed(t, wanted), torque(t) + 0.5 * (k % 2), time_s=t)._replace(limit_active=active)
        try:
            watch.check_sample(Command(Mode.SPEED, wanted, 0.0), seen)
        except LimitHit as error:
            assert "does not follow" in error.what and error.next_step
            return t, str(error)
    return None


def ramp(start, end, rate, at=0.0):
    return lambda t: start + math.copysign(min(abs(end - start), max(0.0, t - at) * rate), end - start)


@pytest.mark.parametrize(("limits", "within_s"), [(LIMITS, FOLLOW_S), (STRING, FOLLOW_STRING_S)])
@pytest.mark.parametrize("reported", [0.0, 2.2, 3.8, 9.0])
@pytest.mark.parametrize("period_s", [0.004, 0.1])
def test_a_shaft_that_stays_at_another_speed_trips(limits, within_s, reported, period_s):
    found = followed(lambda t: 3.0, lambda t, _: reported, 30.0, limits, period_s)
    assert found is not None
    assert within_s <= found[0] <= within_s + 1.0
    assert f"3.000 rad/s commanded, {reported:.3f} rad/s reported, deviating since 0.0 s" in found[1]
    assert "torque 90." in found[1] and "not at its limit of 400 N·m" in found[1]
    assert "panel, another master" in found[1]


def test_one_within_the_window_does_not():
    assert followed(lambda t: 3.0, lambda t, _: 2.55, 60.0) is None
    assert followed(lambda t: 3.0, lambda t, _: 3.45, 60.0) is None


@pytest.mark.parametrize(("active", "torque", "said"), [
    (False, 380.0, "at its limit of 400 N·m"), (False, -380.0, "at its limit of 400 N·m"),
    (True, 40.0, "internal limit acts"),
])
def test_torque_at_its_limit_is_distinguished(active, torque, said):
    found = followed(lambda t: 3.0, lambda t, _: 1.0, 30.0, torque=lambda t: torque, active=active)
    assert said in found[1] and "limits.torque_nm" in found[1] and "not at its limit" not in found[1]


def test_the_message_states_since_when_the_speed_is_lost():
    found = followed(lambda t: 3.0, lambda t, _: 3.0 if t < 20.0 else 1.0, 60.0)
    assert found[0] == pytest.approx(20.5 + FOLLOW_S, abs=0.6)
    assert "deviating since 20." in found[1]


def test_a_shaft_that_runs_away_from_it_trips():
    assert followed(lambda t: 3.0, lambda t, _: 3.0 + 0.2 * t, 30.0)[0] < 2.5 + 0.5 + FOLLOW_S + 0.5
    assert followed(ramp(0.0, 8.0, 1.0), lambda t, _: 2.0, 60.0)[0] == pytest.approx(2.0 + 2.6 + FOLLOW_S, abs=1.5)


def test_torque_mode_and_a_drive_that_is_not_enabled_yet_are_not_judged_by_it():
    watch = watching()
    for k in range(3000):
        mode, watch.expected = (Mode.TORQUE, PowerState.ENABLED) if k < 1500 else (Mode.SPEED, None)
        seen = sample(1.0, 90.0 + k % 2, time_s=0.02 * k)._replace(mode=mode)
        watch.check_sample(Command(mode, 9.0, 90.0), seen)
    # Earlier samples do not count.
    watch.expected = PowerState.ENABLED
    for k in range(3000, 3000 + round(0.9 * FOLLOW_S / 0.02)):
        watch.check_sample(Command(Mode.SPEED, 9.0, 0.0), sample(1.0, 90.0 + k % 2, time_s=0.02 * k))


def test_samples_before_another_mode_do_not_count():
    watch = watching()
    for k in range(3000):
        mode = Mode.TORQUE if k % 220 > 210 else Mode.SPEED        # deviations of 4.2 s each
        seen = sample(1.0, 90.0 + k % 2, time_s=0.02 * k)._replace(mode=mode)
        watch.check_sample(Command(mode, 9.0, 90.0), seen)


def test_a_reference_before_another_mode_does_not_count():
    watch = watching()
    with pytest.raises(LimitHit, match="does not follow") as caught:
        for k in range(3000):
            mode = Mode.TORQUE if 500 <= k < 550 else Mode.SPEED
            seen = sample(3.0, 90.0 + k % 2, time_s=0.02 * k)._replace(mode=mode)
            watch.check_sample(Command(mode, 3.0 if k < 550 else 7.0, 90.0), seen)
    assert 11.0 + FOLLOW_S <= float(caught.value.where.split()[2]) <= 11.1 + FOLLOW_S


def test_a_reference_as_fast_as_the_blocks_is_averaged_correctly():
    """Two cycles up and two down form a block. A check of one phase of it only would see a wrong mean speed."""
    found = followed(
        lambda t: 7.0 if round(t / 0.03) % 4 < 2 else 3.0, lambda t, _: 5.0, 30.0, period_s=0.03
    )
    assert found is None


class Rig:
    """Rig with J ω' = T − friction under a PI speed loop with a torque limit, a ramp in the drive and a lag."""

    def __init__(self, inertia, torque_nm, lag_s=0.0, ramp_rad_s2=math.inf, friction_nm=60.0):
        self.inertia, self.torque_nm, self.lag_s, self.ramp, self.friction = (
            inertia, torque_nm, lag_s, ramp_rad_s2, friction_nm)
        self.time_s = self.speed = self.reported = self.reference = self.total = 0.0

    def __call__(self, t, wanted):
        step = 0.005
        while self.time_s < t - 1e-9:
            self.time_s += step
            self.reference += max(-self.ramp * step, min(self.ramp * step, wanted - self.reference))
            error = self.reference - self.speed
            torque = 2.0 * self.inertia * error + self.total
            held = max(-self.torque_nm, min(self.torque_nm, torque))
            if held == torque:
                self.total += self.inertia * error * step
            drive = held - math.copysign(self.friction, self.speed) if abs(self.speed) > 1e-3 else (
                held - math.copysign(min(abs(held), self.friction), held))
            self.speed += drive / self.inertia * step
            self.reported += (self.speed - self.reported) * (step / self.lag_s if self.lag_s > step else 1.0)
        return max(0.0, self.reported)


@pytest.mark.heavy
@settings(max_examples=5, deadline=None)
@given(
    inertia=st.floats(20.0, 4000.0), torque_nm=st.floats(300.0, 400.0), lag_s=st.sampled_from([0.0, 0.15, 0.5]),
    ramp_rad_s2=st.sampled_from([0.1, 0.5, 5.0, math.inf]), period_s=PERIODS, rate=st.sampled_from([1.2, 4.8, 76.0]),
)
def test_no_rig_that_does_what_it_can_trips(inertia, torque_nm, lag_s, ramp_rad_s2, period_s, rate):
    """The speed goes to both speeds of stage 2 and back on the steepest ramp. A heavy rig needs its full torque."""
    course = (ramp(0.0, 2.9, rate), ramp(2.9, 7.1, rate, 80.0), ramp(7.1, 2.9, rate, 160.0))

    def reference(t):
        return course[0](t) if t < 80.0 else course[1](t) if t < 160.0 else course[2](t)

    rig = Rig(inertia, torque_nm, lag_s, ramp_rad_s2)
    assert followed(reference, rig, 240.0, period_s=period_s, torque=lambda t: 90.0) is None


@pytest.mark.heavy
@settings(max_examples=6, deadline=None)
@given(
    hertz=st.sampled_from([0.02, 0.1, 0.5, 2.0]), amplitude=st.floats(0.3, 3.0), lag_s=st.sampled_from([0.0, 0.5]),
    inertia=st.sampled_from([50.0, 500.0, 2000.0]), period_s=PERIODS,
)
def test_an_excitation_that_a_rig_follows_at_its_torque_limit_does_not_trip(hertz, amplitude, lag_s, inertia, period_s):
    """With and without a torque limit, the speed crosses or approaches the reference."""
    rig = Rig(inertia, 400.0, lag_s)

    def reference(t):
        return min(5.0, 0.5 * t) + (amplitude * math.sin(2.0 * math.pi * hertz * (t - 40.0)) if t > 40.0 else 0.0)

    assert followed(reference, rig, 120.0, period_s=period_s) is None


@pytest.mark.heavy
@given(period_s=st.floats(3.0, 12.0), depth=st.floats(0.3, 1.0))
@settings(max_examples=8, deadline=None)
def test_a_string_that_sticks_and_slips_does_not(period_s, depth):
    """The string slows the top drive down once in each period of the oscillation."""
    def speed(t, wanted):
        return max(0.0, wanted * (1.0 - depth * max(0.0, math.sin(2.0 * math.pi * t / period_s))))

    assert followed(lambda t: min(7.0, t), speed, 90.0, STRING) is None


@pytest.mark.heavy
@given(st.lists(st.tuples(st.floats(0.0, 9.0), st.floats(0.0, 9.0)), min_size=1, max_size=60))
def test_the_short_cut_by_the_latest_reference_agrees_with_all_blocks(rows):
    """The short cut and the comparison with all blocks give the same result."""
    following = watching(period_s=0.1)._following
    for k, (reference, speed) in enumerate(rows):
        following.see(reference, sample(speed, time_s=0.1 * k))
        mean, window = following.speed_rad_s, following._window_rad_s
        below = min(block.lowest for block in following._blocks) - window - mean
        above = mean - max(block.highest for block in following._blocks) - window
        assert following._side == (1.0 if below > 0.0 else -1.0 if above > 0.0 else 0.0)


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_noise_about_a_wrong_speed_is_no_approach(noise):
    found = followed(lambda t: 3.0, lambda t, _: 1.0 + noise * math.sin(1e4 * t), 60.0)
    assert found[0] < 3.0 * FOLLOW_S


def test_coarse_speed_widens_the_window():
    assert followed(lambda t: 3.0, lambda t, _: 2.2, 60.0, resolution=0.2) is None
    assert followed(lambda t: 3.0, lambda t, _: 1.9, 60.0, resolution=0.2) is not None


# -- on the whole run ----------------------------------------------------------------------------------------------


def quivering(drive, seen):
    """Change the report slightly, so that it is not frozen."""
    return seen._replace(speed_rad_s=seen.speed_rad_s + 1e-3 * (drive.cycles % 2))


def test_a_drive_that_follows_another_setpoint_is_stopped_soon(world):
    """The stop comes before the settling time of a minute is over."""
    class Elsewhere(FakeDrive):
        def _to(self, speed, strongest_nm):
            super()._to(min(speed, 1.5), strongest_nm)

    here = world(Elsewhere(misbehave=quivering))
    result = here.runner().run()
    assert isinstance(result.cause, LimitHit), result.cause
    assert "1.50" in str(result.cause) and "not at its limit" in str(result.cause)
    assert result.stop.confirmed and here.bench.now_s < 30.0
