"""Stop with a drill string: the trapped torque falls on the ramp, and a twisted string is never disabled."""

import math
import random
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.drive import Check, Command, Identity, Mode, Outcome, PowerState
from drivers.errors import DriveFault, LimitHit, PreflightRefused
from tdhil.runner.preconditions import refuse_with_string
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.standstill import standstill_speed
from tdhil.runner.stop import BLOCK_S, LONGEST_S, MODE_S, StopTimeout
from tdhil.runner.string_release import (
    FASTEST_SWING_S,
    HARD_SHARE,
    QUIET_S,
    STIFFEST,
    TRAVEL_RAD,
    StringRelease,
    StringReleaseLimits,
)
from tests.rigs import DRIVE_LIMITS
from tests.runner.fake_drive import NAN, PERIOD_S, FakeDrive, lost, refused_check
from tests.runner.string_drive import RESIDUAL_NM, STRING, StringWorld

LIMITS = StringReleaseLimits(torque_nm=400.0, speed_rad_s=10.0, ramp_nm_s=20.0, torque_resolution_nm=1.0)


def torques(here):
    """Return every reported torque since the beginning of the stop."""
    seen = []
    here.drive.misbehave = lambda drive, sample: (seen.append(sample.torque_nm), sample)[1]
    return seen


@pytest.mark.heavy
@pytest.mark.parametrize("twist_nm", [300.0, -300.0, pytest.param(100.0, marks=pytest.mark.heavy)])
def test_trapped_torque_comes_down_on_the_ramp_before_anything_is_disabled(twist_nm):
    here = StringWorld(twist_nm=twist_nm)
    seen = torques(here)
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble
    assert report.trouble == ()
    assert report.trapped_nm == pytest.approx(twist_nm, rel=0.05)
    assert abs(here.drive.string_nm) < 2.0 * RESIDUAL_NM
    assert here.drive.disabled_at == [0.0]
    assert here.drive.calls.index("quick_stop") > 0.9 * abs(twist_nm) / 20.0 / PERIOD_S   # on the ramp, and not before
    calls = [call for call in here.drive.calls if call != "exchange"]
    assert calls == ["quick_stop", "disable"]
    # Never faster than the ramp over a second, except for the sign of friction.
    second = round(1.0 / PERIOD_S)
    falls = [abs(a) - abs(b) for a, b in zip(seen, seen[second:], strict=False)]
    assert max(falls) < 20.0 * 1.5 + 2.0 * here.drive.coulomb
    # Never through zero to the other side.
    sign = math.copysign(1.0, twist_nm)
    assert min(sign * torque for torque in seen) > -RESIDUAL_NM
    assert here.drive.work_j <= 1e-9   # the motor did no work on the string


@pytest.mark.heavy
def test_reverse_rotation_is_limited_to_the_twist():
    here = StringWorld(twist_nm=300.0)
    assert not STRING.allow_reverse
    assert here.stop_sequence().run().confirmed
    assert here.drive.lowest_speed >= -1.0 - 1e-9          # a tenth of the speed limit
    assert here.drive.angle == pytest.approx(0.0, abs=0.15)
    assert here.drive.angle > -0.01


@pytest.mark.parametrize("mode", Mode)
def test_from_a_turning_shaft_in_either_mode(mode):
    here = StringWorld(speed=4.0, mode=mode, stiffness=10.0, torque=60.0)
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble
    assert report.trapped_nm > 20.0                        # torque that the string took up on the way to standstill
    assert abs(here.drive.string_nm) < 2.0 * RESIDUAL_NM
    assert "quick_stop" in here.drive.calls
    kept = [command.torque_nm for command in here.drive.commands[:2]]
    assert kept == [60.0 if mode is Mode.TORQUE else 0.0, 0.0]      # no longer once speed mode is displayed


@pytest.mark.heavy
def test_the_stop_waits_for_an_oscillating_string():
    here = StringWorld(swing_nm=200.0)
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble
    assert here.bench.now_s > 10.0 * math.log(200.0 / RESIDUAL_NM) / 2.0
    assert abs(here.drive.string_nm) < RESIDUAL_NM


def test_an_untwisted_string_takes_only_the_wait_of_half_a_period():
    here = StringWorld()
    assert here.stop_sequence().run().confirmed
    assert here.bench.now_s == pytest.approx(QUIET_S + 2 * 1.5, abs=0.5)


@pytest.mark.heavy
def test_an_offset_of_the_torque_is_no_trapped_torque():
    here = StringWorld()
    here.drive.misbehave = lambda drive, sample: sample._replace(torque_nm=sample.torque_nm + 30.0)
    assert here.stop_sequence(torque_offset_nm=30.0).run().confirmed


@pytest.mark.heavy
def test_a_drive_that_leaves_speed_mode_gets_the_quick_stop_and_stays_enabled():
    here = StringWorld(twist_nm=300.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(mode=None)
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert not report.disabled
    assert "still holds 300 N·m" in report.trouble[-1]
    assert "disable" not in here.drive.calls
    assert here.drive.calls.index("quick_stop") == pytest.approx(MODE_S / PERIOD_S, abs=2)
    assert here.drive.disabled_at == []


@pytest.mark.heavy
def test_a_drive_that_leaves_operation_during_the_release():
    here = StringWorld(twist_nm=300.0)

    def fault(drive, sample):
        if drive.cycles == 100:
            drive.state = drive.wish = PowerState.QUICK_STOP
        return sample

    here.drive.misbehave = fault
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert any("during the release of trapped torque" in line for line in report.trouble)
    assert "still holds" in report.trouble[-1]
    assert "disable" not in here.drive.calls


def test_a_drive_without_torque_holds_nothing():
    """The string has already turned back without control in fault."""
    here = StringWorld(twist_nm=0.0)
    here.drive.fault()
    report = here.stop_sequence().run()
    assert report.confirmed
    assert report.trapped_nm == 0.0


def test_torque_that_is_still_reported_by_a_drive_without_any_is_not_held():
    here = StringWorld()
    here.drive.fault()
    here.drive.misbehave = lambda drive, sample: sample._replace(torque_nm=300.0)
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble


@pytest.mark.heavy
def test_a_release_without_effect_is_given_up_and_the_torque_is_held():
    here = StringWorld(twist_nm=300.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(torque_nm=300.0)
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert any("did not come down: 300 N·m at first" in line for line in report.trouble)
    assert "disable" not in here.drive.calls
    assert here.bench.now_s < 2 * 300.0 / 20.0 + 90.0 + 30.0


def test_torque_that_is_no_number_is_given_up_and_held():
    here = StringWorld(twist_nm=300.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(torque_nm=NAN)
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert "disable" not in here.drive.calls
    assert here.bench.now_s < 150.0


@pytest.mark.parametrize("begin", [1, 50])
@pytest.mark.parametrize("dead", [lost, lambda drive, sample: sample._replace(fresh=False)], ids=["dead", "stale"])
def test_a_drive_that_falls_silent_is_left_to_its_watchdog(begin, dead):
    here = StringWorld(twist_nm=300.0, speed=0.0)
    here.drive.misbehave = lambda drive, sample: dead(drive, sample) if drive.cycles >= begin else sample
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert "disable" not in here.drive.calls
    assert here.drive.cycles < begin + 150


@pytest.mark.heavy
@pytest.mark.parametrize("begin", [2, 60])
def test_single_lost_frames_are_survived(begin):
    here = StringWorld(twist_nm=60.0, speed=1.0, stiffness=50.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=drive.cycles % 10 >= 3 or drive.cycles < begin)
    assert here.stop_sequence().run().confirmed


def test_a_shaft_that_does_not_follow_speed_mode_gets_the_quick_stop():
    here = StringWorld(speed=4.0)
    plain = here.drive._move

    def deaf(command):
        if here.drive.state is PowerState.ENABLED:
            here.drive.torque = 0.0                       # continues to turn
        else:
            here.drive.angle = 0.0
            plain(command)

    here.drive._move = deaf
    report = here.stop_sequence().run()
    assert "did not follow speed mode" in report.trouble[0]
    assert here.drive.speed == 0.0
    assert report.at_rest_s is not None


@pytest.mark.parametrize("last", ["none", "nan"])
def test_it_begins_from_zero_if_the_speed_is_unknown(last):
    here = StringWorld()
    here.bench.last = None if last == "none" else here.bench.last._replace(speed_rad_s=NAN)
    assert here.stop_sequence().run().confirmed
    assert here.drive.commands[0].speed_rad_s == 0.0


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize("told", [40.0, -40.0, 1e12, NAN])
def test_one_wrong_report_is_not_followed(told):
    """The last report tripped the run. A ramp from this speed would accelerate the shaft to it."""
    here = StringWorld(speed=4.0, stiffness=10.0)
    here.drive.wish = PowerState.ENABLED
    here.drive.misbehave = lambda drive, sample: sample._replace(speed_rad_s=told) if drive.cycles == 3 else sample
    with pytest.raises((DriveFault, LimitHit)):
        here.bench.hold(Command(Mode.SPEED, 4.0, 0.0), 1.0)
    begun = len(here.drive.commands)
    assert here.stop_sequence().run().confirmed
    assert 3.9 < here.drive.commands[begun].speed_rad_s <= 4.0
    assert max(abs(command.speed_rad_s) for command in here.drive.commands) <= 4.0


@pytest.mark.heavy
def test_a_speed_beyond_the_limit_is_braked_from_the_limit():
    here = StringWorld(speed=1e12, stiffness=0.1)
    here.stop_sequence().run()
    assert here.drive.commands[0].speed_rad_s == pytest.approx(10.0 - 2.0 * PERIOD_S)


def test_reverse_rotation_too_is_stopped_first():
    here = StringWorld(replace(STRING, allow_reverse=True), speed=-3.0, stiffness=5.0)
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble
    assert here.drive.commands[0].speed_rad_s == pytest.approx(-3.0 + 2.0 * PERIOD_S)
    assert report.trapped_nm < 0.0


# -- release without a drive -----------------------------------------------------------------------------------------


def release_of(limits=LIMITS, period_s=0.02):
    return StringRelease(limits, 0.05, period_s)


@settings(max_examples=60)
@given(rows=st.lists(st.tuples(st.floats(-500.0, 500.0), st.floats(-1.0, 1.0)), min_size=1, max_size=60))
def test_the_release_never_winds_the_string_up(rows):
    going = release_of()
    for torque, speed in rows:
        wanted = going.step(torque, speed)
        assert wanted * torque <= 0.0
        assert abs(wanted) <= 1.0


@pytest.mark.parametrize("wrong", [(NAN, 0.0), (0.0, NAN), (math.inf, 0.0), (0.0, -math.inf)])
def test_a_report_that_is_no_number_holds_the_shaft(wrong):
    going = release_of()
    assert going.torque_nm == 0.0
    for _ in range(200):
        going.step(0.0, 0.0)
    assert going.step(*wrong) == 0.0
    for _ in range(299):
        going.step(0.0, 0.0)
    assert not going.done              # the quiet time restarted
    for _ in range(2):
        going.step(0.0, 0.0)
    assert going.done


def test_torque_about_zero_has_no_sign():
    """The ripple is below the residual torque. The release of a later torque is that without ripple."""
    calm, rippled = release_of(), release_of()
    for k in range(600):
        calm.step(0.0, 0.0)
        rippled.step(0.6 * RESIDUAL_NM * (-1.0) ** (k // 30), 0.0)
    assert rippled.step(300.0, 0.0) == pytest.approx(calm.step(300.0, 0.0)) != 0.0


@settings(max_examples=25, deadline=None)
@given(stiffness=st.floats(20.0, 20_000.0), lag_s=st.sampled_from([0.0, 0.15, 0.4]), trapped=st.floats(-380.0, 380.0))
def test_trapped_torque_of_any_string_is_released_behind_any_plausible_lag(stiffness, lag_s, trapped):
    """The stiffness is 20 to 20 000 N·m/rad. Reported torque and speed control have different lags."""
    going, angle, seen, speed = release_of(), trapped / stiffness, trapped, 0.0
    for _ in range(round(going.longest_s / 0.02) + 4000):
        wanted = going.step(seen, speed)
        speed += (wanted - speed) * min(1.0, 0.02 / 0.05)
        angle += speed * 0.02
        seen += (stiffness * angle - seen) * (min(1.0, 0.02 / lag_s) if lag_s else 1.0)
        if going.done:
            break
    assert going.done
    assert not going.failed
    assert abs(stiffness * angle) < 2.0 * LIMITS.residual_nm


def test_an_oscillation_faster_than_any_string_makes_it_stiffer():
    def yields_after(swing_s):
        going = release_of()
        for step in range(1000):
            going.step(200.0 * math.sin(2.0 * math.pi * 0.02 * step / swing_s), 0.0)
        for _ in range(40):
            last = going.step(-40.0, 0.0)
        return last

    assert yields_after(2.5 * FASTEST_SWING_S) == pytest.approx(40.0 / 80.0)
    assert yields_after(1.5) == pytest.approx(40.0 / 80.0 / STIFFEST, rel=1e-6)


def test_an_oscillation_within_a_few_cycles_makes_it_stiffer_though_the_mean_hides_it():
    """A report every 65 ms, and a torque that changes its sign every second cycle. The speed follows it."""
    def yields_after(torque_nm, speed_rad_s=1.0, position_rad=None):
        going = release_of(period_s=0.065)
        for step in range(80):
            side = 1.0 if step % 4 < 2 else -1.0
            going.step(side * torque_nm, side * speed_rad_s, None if position_rad is None else side * position_rad)
        return going.step(-40.0, 0.0)

    assert yields_after(0.9 * HARD_SHARE * LIMITS.torque_nm) == pytest.approx(40.0 / 80.0)
    assert yields_after(1.1 * HARD_SHARE * LIMITS.torque_nm) == pytest.approx(40.0 / 80.0 / STIFFEST, rel=1e-6)
    # a lost sensor: the torque must not become calm beside a speed that is always zero
    assert yields_after(1.1 * HARD_SHARE * LIMITS.torque_nm, speed_rad_s=0.0) == pytest.approx(40.0 / 80.0)
    assert yields_after(1.1 * HARD_SHARE * LIMITS.torque_nm, 0.0, position_rad=0.0) == pytest.approx(40.0 / 80.0)
    # a lag that hides the motion: the position shows it
    assert yields_after(1.1 * HARD_SHARE * LIMITS.torque_nm, 0.0, position_rad=0.01) == pytest.approx(
        40.0 / 80.0 / STIFFEST, rel=1e-6)


def test_limits_of_the_release_in_time_and_travel():
    going = release_of()
    going.step(100.0, 0.0)
    assert going.longest_s == pytest.approx(2.0 * 100.0 / 20.0 + 90.0)
    steps = 0
    while not going.failed:
        going.step(100.0, 0.0)
        steps += 1
    assert steps * 0.02 == pytest.approx(100.0, abs=0.05)
    slow = release_of(replace(LIMITS, ramp_nm_s=0.1))
    steps = 0
    while not slow.failed:
        slow.step(-5000.0 if steps else -100.0, 0.0)
        steps += 1
    assert slow.travel_rad == pytest.approx(TRAVEL_RAD, abs=0.05)


@pytest.mark.parametrize(("limit", "resolution", "residual"), [(400.0, 1.0, 8.0), (400.0, 10.0, 50.0)])
def test_residual_torque(limit, resolution, residual):
    limits = replace(LIMITS, torque_nm=limit, torque_resolution_nm=resolution)
    assert limits.residual_nm == residual


# -- waiting time ------------------------------------------------------------------------------------------------------


def waited(speeds, enough_s=19.0, period_s=0.5):
    patience = StopTimeout(enough_s, 0.05)
    for speed in speeds:
        if patience.over:
            break
        if speed is None:
            patience.wait(period_s)
        else:
            patience.see(speed, period_s)
    return patience.waited_s


def endless(first, factor):
    speed = first
    while True:
        yield speed
        speed *= factor


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_stop_waits_only_for_a_shaft_that_slows_down(sign):
    assert waited(endless(sign * 10.0, 1.0)) == pytest.approx(19.5)
    assert waited([*[sign * (10.0 - 0.05 * k) for k in range(100)], *[5.0] * 1000]) == pytest.approx(50.0 + 15.5, abs=6)
    assert waited(endless(sign * 10.0, 0.998)) == pytest.approx(LONGEST_S + 0.5, abs=0.6)
    assert waited(endless(sign * 10.0, 0.9995)) == pytest.approx(19.5)     # half a percent per block does not count


def test_noise_at_standstill_is_no_slowing_down():
    assert waited(endless(0.04, 0.99)) == pytest.approx(19.5)
    assert waited([None] * 1000) == pytest.approx(19.5)


def test_the_stop_always_waits_for_a_long_ramp():
    assert waited(endless(10.0, 1.0), enough_s=60.0) == pytest.approx(60.5)
    assert BLOCK_S == 5.0


# -- refusals with a string ----------------------------------------------------------------------------------------


REAL = Identity(1, 2, 3, 4, "real", simulated=False)


def preflight_of(**change):

    found = FakeDrive().preflight(DRIVE_LIMITS)
    return replace(found, **change)


@pytest.mark.parametrize(
    ("limits", "request_", "preflight", "what"),
    [
        (STRING, ExcitationRequest(kind="coast-down"), {}, "coast-down"),
        (replace(STRING, torque_ramp_nm_s=0.0), ExcitationRequest(), {}, "release rate"),
        (STRING, ExcitationRequest(), {"safe_action": "coast"}, "watchdog reaction is 'coast'"),
        (STRING, ExcitationRequest(), {"safe_action": "none"}, "watchdog reaction"),
        (STRING, ExcitationRequest(), {"safe_action": "none", "watchdog_s": 0.0}, "no watchdog is armed"),
        (replace(STRING, accept_no_watchdog=True), ExcitationRequest(), {"watchdog_s": 0.0}, "--accept-no-watchdog"),
        (STRING, ExcitationRequest(), {"safe_action": "fault_reaction"}, "watchdog reaction is 'fault_reaction'"),
        (STRING, ExcitationRequest(), {"quick_stop_holds": False}, "would release it"),
        (STRING, ExcitationRequest(), {"fed_by_any_client": True, "identity": REAL}, "any client feeds"),
        (STRING, ExcitationRequest(), {"quick_stop_holds": None}, "it is unknown"),
    ],
)
def test_what_a_string_forbids(limits, request_, preflight, what):
    with pytest.raises(PreflightRefused, match=what) as caught:
        refuse_with_string(limits, request_, preflight_of(**preflight))
    assert caught.value.where
    assert caught.value.next_step
    refuse_with_string(replace(limits, load="none"), request_, preflight_of(**preflight))


@pytest.mark.parametrize("limits", [STRING, replace(STRING, load="none")])
def test_without_pipe_data_there_is_no_echo(limits):
    with pytest.raises(PreflightRefused, match="whose pipe is known") as caught:
        refuse_with_string(limits, ExcitationRequest(kind="prbs"), preflight_of())
    assert "length_m" in caught.value.next_step
    piped = replace(STRING, wave_impedance_nm_s_rad=300.0, echo_s=1.4)
    refuse_with_string(piped, ExcitationRequest(kind="prbs"), preflight_of())
    with pytest.raises(PreflightRefused, match=r"after 0\.30 s"):
        refuse_with_string(replace(piped, echo_s=0.3), ExcitationRequest(kind="prbs"), preflight_of())


@pytest.mark.parametrize("title", ["quick-stop option", "something else"])
@pytest.mark.parametrize("found", ["0", "6", "?"])
def test_permissions_with_a_string_do_not_depend_on_rows_of_the_table(title, found):
    row = Check(title, "6", found, Outcome.OK, "605Ah")
    refuse_with_string(STRING, ExcitationRequest(), preflight_of(checks=(row, refused_check())))


def test_a_run_with_a_string_is_refused_before_anything_moves(world):
    here = world(limits=STRING)
    result = here.runner(ExcitationRequest(kind="coast-down")).run()
    assert isinstance(result.cause, PreflightRefused)
    assert "exchange" not in here.drive.calls


def test_a_late_change_to_speed_mode_does_not_drop_the_torque_of_the_string():
    """The target torque acts until the drive displays speed mode."""
    here, late = StringWorld(twist_nm=300.0), 10

    def switches_late(drive, sample):
        drive.seen += 1
        return sample._replace(mode=Mode.TORQUE if drive.seen <= late + 1 else sample.mode, torque_nm=300.0)

    here.drive.seen, here.drive.misbehave = 0, switches_late
    here.bench.cycle(Command(Mode.TORQUE, 0.0, 300.0))
    begun = len(here.drive.commands)
    here.stop_sequence().run()
    asked = [one.torque_nm for one in here.drive.commands[begun:]]
    assert asked[:late] == [300.0] * late
    assert asked[late + 1] == 0.0


@pytest.mark.parametrize("share", [0.01, 0.03])
def test_counts_of_a_noisy_speed_do_not_prolong_the_release(share):
    """One count restarted the time of quiet: the stop took 123 s, and reported 0 N·m as torque that did not fall."""
    noise, took_s, reports = random.Random(2), [], []
    for counts in (0.0, 1.05):
        here = StringWorld(replace(STRING, quick_stop_rad_s2=2.0), twist_nm=300.0, stiffness=30.0)
        size = counts * standstill_speed(here.limits, 0.01)
        here.drive.misbehave = lambda drive, one, size=size: one._replace(
            speed_rad_s=one.speed_rad_s + (noise.choice((-1, 1)) * size if noise.random() < share else 0.0))
        begun_s = here.bench.now_s
        reports.append(here.stop_sequence().run())
        took_s.append(here.bench.now_s - begun_s)
    assert all(one.confirmed and not one.trouble for one in reports), reports
    assert took_s[1] < took_s[0] + 10.0
