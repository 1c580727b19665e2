"""Guard: conditions that trip it, and conditions that do not."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.drive import Command, Counters, Mode, PowerState
from drivers.errors import CommandRejected, CommunicationLost, DriveFault, LimitHit, TdhilError
from profiles import MessageCode
from tdhil.runner.guard import Guard
from tests.runner.fake_drive import LIMITS, NAN, PERIOD_S, SPEED_RESOLUTION, TORQUE_RESOLUTION
from tests.runner.guarded import MODEL, OFFSET, REST, REVERSIBLE, guard, sample

INF = math.inf


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("which", ["speed", "torque"])
def test_a_setpoint_that_is_no_number_is_rejected_in_either_place(mode, value, which):
    command = Command(mode, value, 0.0) if which == "speed" else Command(mode, 0.0, value)
    with pytest.raises(CommandRejected, match="not finite"):
        guard().check_command(command)


@pytest.mark.parametrize(
    ("speed", "torque", "what"),
    [(10.001, 0.0, "speed setpoint"), (-0.001, 0.0, "speed setpoint"), (0.0, 400.1, "torque setpoint"),
     (0.0, -400.1, "torque setpoint")],
)
def test_a_setpoint_outside_the_limits_is_rejected(speed, torque, what):
    for mode in Mode:
        with pytest.raises(CommandRejected, match=what):
            guard().check_command(Command(mode, speed, torque))


@given(torque=st.floats(-400.0, 400.0), mode=st.sampled_from(Mode))
def test_a_braking_torque_that_is_not_allowed_is_held_back_in_torque_mode(torque, mode):
    watch = guard()
    watch.no_braking, watch.to_brake = "none has been tried", "Try one"
    if mode is Mode.TORQUE and torque < 0.0:
        with pytest.raises(LimitHit, match="was not sent: none has been tried"):
            watch.check_command(Command(mode, 1.0, torque))
    else:
        watch.check_command(Command(mode, 1.0, torque))


def test_a_braking_torque_is_held_back_too_without_a_known_remedy():
    watch = guard()
    watch.no_braking = "none has been tried"
    with pytest.raises(LimitHit, match="was not sent") as caught:
        watch.check_command(Command(Mode.TORQUE, 1.0, -5.0))
    assert caught.value.next_step == ""


def test_backwards_setpoints_need_allow_reverse():
    guard(REVERSIBLE).check_command(Command(Mode.SPEED, -10.0, 0.0))
    with pytest.raises(CommandRejected, match="outside -10 to 10"):
        guard(REVERSIBLE).check_command(Command(Mode.SPEED, -10.1, 0.0))


@given(speed=st.floats(0.0, 10.0), torque=st.floats(-400.0, 400.0), mode=st.sampled_from(Mode))
def test_no_command_inside_the_limits_is_rejected(speed, torque, mode):
    guard().check_command(Command(mode, speed, torque))


@given(speed=st.floats(), torque=st.floats())
def test_a_command_passes_if_and_only_if_it_is_within_the_limits(speed, torque):
    inside = 0.0 <= speed <= 10.0 and abs(torque) <= 400.0 * (1.0 + 1e-9)
    try:
        guard().check_command(Command(Mode.TORQUE, speed, torque))
    except CommandRejected:
        assert not inside
    else:
        assert inside


@given(speed=st.floats(-0.19, 10.0), torque=st.floats(-500.0, 500.0), time_s=st.floats(0.0, 900.0))
def test_no_sample_inside_the_limits_trips(speed, torque, time_s):
    watch = guard()
    watch.start_clock(0.0)
    watch.expected = PowerState.ENABLED
    watch.check_sample(REST, sample(speed, torque, time_s=time_s))


@pytest.mark.parametrize(
    ("limits", "seen", "what"),
    [
        (LIMITS, sample(10.01), "above the limit of 10 rad/s"),
        (LIMITS, sample(-0.21), "turns backwards"),
        (LIMITS, sample(torque=511.0), "torque 511 N·m is above"),
        (LIMITS, sample(torque=-511.0), "torque -511 N·m is above"),
        (LIMITS, sample(time_s=901.0), "longer than the limit of 900 s"),
        (REVERSIBLE, sample(10.01), "above the limit of 10 rad/s"),
        (REVERSIBLE, sample(-10.01), "above the limit of 10 rad/s"),
    ],
)
def test_every_limit_trips(limits, seen, what):
    watch = guard(limits)
    watch.start_clock(0.0)
    with pytest.raises(LimitHit, match=what) as caught:
        watch.check_sample(REST, seen)
    assert caught.value.where
    assert caught.value.next_step


def test_a_lower_highest_speed_of_one_run_does_not_turn_noise_into_reverse_rotation():
    careful = replace(LIMITS, speed_max_rad_s=2.0)
    for limits, noise_rad_s in ((careful, 0.04), (replace(careful, rig_speed_max_rad_s=10.0), 0.19),
                                (replace(careful, rig_speed_max_rad_s=1000.0), 0.19)):
        guard(limits).check_sample(REST, sample(-noise_rad_s))
        with pytest.raises(LimitHit, match="turns backwards"):
            guard(limits).check_sample(REST, sample(-noise_rad_s - 0.02))


def test_the_time_limit_counts_from_the_first_motion():
    watch = guard()
    watch.check_sample(REST, sample(time_s=5000.0))
    watch.start_clock(5000.0)
    watch.check_sample(REST, sample(time_s=5900.0))
    with pytest.raises(LimitHit):
        watch.check_sample(REST, sample(time_s=5900.1))


def test_reverse_rotation_is_allowed_if_the_rig_permits_it():
    guard(REVERSIBLE).check_sample(REST, sample(-9.9))


@pytest.mark.parametrize(("speed", "torque"), [(NAN, 0.0), (0.0, NAN), (INF, 0.0), (0.0, -INF), (-INF, 0.0)])
def test_feedback_that_is_no_number_trips(speed, torque):
    for limits in (LIMITS, REVERSIBLE):
        with pytest.raises(TdhilError):
            guard(limits).check_sample(REST, sample(speed, torque))


@pytest.mark.parametrize("state", [state for state in PowerState if state is not PowerState.ENABLED])
def test_a_drive_that_leaves_its_state_trips(state):
    watch = guard()
    watch.check_sample(REST, sample(state=state))       # nothing expected yet
    watch.expected = PowerState.ENABLED
    with pytest.raises(DriveFault, match=state.value):
        watch.check_sample(REST, sample(state=state))


@pytest.mark.parametrize(
    ("period_s", "watchdog_s", "allowed"),
    [(0.02, 0.5, 13), (0.004, 0.5, 63), (0.001, 5.0, 250), (0.004, 0.1, 13), (0.1, 0.5, 3), (0.5, 5.0, 3)],
)
def test_feedback_may_fail_to_come_for_so_many_cycles(period_s, watchdog_s, allowed):
    """The limit is 0.25 s or half of the watchdog time, whichever is less, and at least two cycles."""
    watch = Guard(replace(LIMITS, watchdog_s=watchdog_s), period_s, SPEED_RESOLUTION, TORQUE_RESOLUTION)
    for _ in range(3):
        for _ in range(allowed - 1):
            watch.check_sample(REST, sample(fresh=False))
        watch.check_sample(REST, sample())              # a fresh sample restarts the count
    with pytest.raises(CommunicationLost, match=f"no feedback for {allowed} cycles"):
        for _ in range(allowed):
            watch.check_sample(REST, sample(fresh=False))


# -- time ----------------------------------------------------------------------------------------------------------


def test_what_the_time_limit_leaves():
    watch = guard()
    assert watch.left_s(100.0) == 900.0                 # the full time, before the first motion
    watch.start_clock(50.0)
    assert watch.left_s(100.0) == 850.0


# -- the loop's pace (row 8) ---------------------------------------------------------------------------------------


def pace(*steps):
    """Check the pace with counters that grow by these (cycles, overruns), one after the other."""
    watch, cycles, overruns = guard(), 0, 0
    for more, late in steps:
        cycles, overruns = cycles + more, overruns + late
        watch.check_pace(Counters(cycles=cycles, overruns=overruns))


def test_a_loop_that_is_late_repeatedly_ends_the_run():
    pace((100, 20), (100, 20), (99, 99))                # at most a fifth, and an incomplete window
    with pytest.raises(CommunicationLost, match="late in 21 of 100 cycles"):
        pace((100, 21))
    with pytest.raises(CommunicationLost):
        pace((100, 0), (99, 99), (1, 0))                # the next window begins at the end of the last one
    pace((100, 20), (100, 0))                           # and earlier overruns are not counted twice
    pace((100, 20), (100, 20))


def test_a_slow_loop_is_judged_by_no_less_than_ten_cycles():
    watch = Guard(LIMITS, 0.5, SPEED_RESOLUTION, TORQUE_RESOLUTION)
    watch.check_pace(Counters(cycles=9, overruns=9))
    with pytest.raises(CommunicationLost, match="9 of 10"):
        watch.check_pace(Counters(cycles=10, overruns=9))


@given(late=st.lists(st.sampled_from([0, 0, 0, 1]), min_size=1, max_size=450), reckoning=st.integers(0, 150),
       before=st.integers(0, 300))
def test_counters_that_are_read_only_when_due_end_the_run_in_the_same_cycle(late, reckoning, before):
    """The result is that of counters read in each cycle. ``before``: cycles of the drive before the loop begins."""
    def ends(due):
        watch, overruns = guard(), 0
        for k, one in enumerate(late):
            overruns += one
            watch.reckoning = reckoning // 2 <= k < reckoning
            if due(watch):
                try:
                    watch.check_pace(Counters(cycles=before + k + 1, overruns=overruns))
                except CommunicationLost as error:
                    return k, error.what
        return None

    assert ends(Guard.pace_is_due) == ends(lambda _: True)


# -- frozen feedback (row 19) --------------------------------------------------------------------------------------


def feed(rows, mode=Mode.TORQUE, *, limits=LIMITS):
    """Check samples of (time, setpoint, reported speed, reported torque[, limit active]), one after the other."""
    watch = guard(limits)
    for time_s, setpoint, speed, torque, *active in rows:
        command = Command(mode, setpoint, 0.0) if mode is Mode.SPEED else Command(mode, 5.0, setpoint)
        watch.check_sample(command, sample(speed, torque, time_s=time_s)._replace(limit_active=bool(active)))


def ramp(end, count=30, start=0.0):
    return [start + (end - start) * k / (count - 1) for k in range(count)]


@pytest.mark.parametrize(("mode", "limit"), [(Mode.TORQUE, 400.0), (Mode.SPEED, 10.0)])
def test_constant_feedback_while_the_setpoint_changes_is_frozen(mode, limit):
    enough, little = 0.2 * limit, 0.09 * limit
    times = [0.02 * k for k in range(30)]
    with pytest.raises(CommunicationLost, match=r"frozen at 5.000 rad/s and 90 N·m for 0.5 s") as raised:
        feed([(t, s, 5.0, 90.0) for t, s in zip(times, ramp(enough), strict=True)], mode)
    assert raised.value.entry is MessageCode.FEEDBACK_REPEATS
    with pytest.raises(CommunicationLost, match="frozen"):          # downwards as well
        feed([(t, s, 5.0, 90.0) for t, s in zip(times, ramp(0.0, start=enough), strict=True)], mode)
    with pytest.raises(CommunicationLost, match="frozen"):          # there and back
        feed([(t, s, 5.0, 90.0) for t, s in zip(times, [*ramp(enough, 15), *ramp(0.0, 15, enough)], strict=True)], mode)
    feed([(t, s, 5.0, 90.0) for t, s in zip(times, ramp(little), strict=True)], mode)
    feed([(t, s, 5.0, 90.0) for t, s in zip(times[:24], ramp(enough, 24), strict=True)], mode)   # not for long enough


@pytest.mark.parametrize(("mode", "limit", "answer_s"), [(Mode.TORQUE, 400.0, 0.25), (Mode.SPEED, 10.0, 1.0)])
def test_coarse_reports_of_a_steady_shaft_may_repeat_until_the_setpoint_steps(mode, limit, answer_s):
    """A drive that reports whole revolutions per minute repeats a value at steady speed. It responds later: to a
    torque within 0.25 s, a speed along the drive's own ramp (seed 1472 of benchmarks/healthy_runs.py)."""
    steady, step, last = [(0.02 * k, 0.0, 5.0, 90.0) for k in range(50)], 0.2 * limit, round(answer_s / 0.02) - 1
    answered = [(1.0 + 0.02 * k, step, 5.0, 90.0 + max(0, k - last)) for k in range(last + 40)]
    feed(steady + answered, mode)
    with pytest.raises(CommunicationLost, match="frozen"):
        feed(steady + [(1.0 + 0.02 * k, step, 5.0, 90.0) for k in range(last + 3)], mode)


def test_any_change_shows_that_it_is_not_frozen():
    rows = [(0.02 * k, s, 5.0, 90.0) for k, s in enumerate(ramp(100.0, 60))]
    for change in ({2: 5.01}, {3: 91.0}):
        moved = [list(row) for row in rows]
        for k in range(20, 60, 20):
            for place, value in change.items():
                moved[k][place] = value
        feed(moved)
    limited = [(*row, True) if k % 20 == 0 else row for k, row in enumerate(rows)]
    feed(limited)
    watch = guard()
    for k in range(60):
        mode = Mode.TORQUE if k // 20 % 2 else Mode.SPEED
        watch.check_sample(Command(mode, 0.1 * (k % 20), 10.0 * (k % 20)), sample(5.0, 90.0, time_s=0.02 * k))


# -- the drive's own limit (row 33) --------------------------------------------------------------------------------


def limited(active, mode=Mode.TORQUE):
    watch = guard()
    for k, on in enumerate(active):
        seen = sample(5.0, 90.0 + k % 2, time_s=0.1 * k)._replace(limit_active=on)
        watch.check_sample(Command(mode, 5.0, 90.0), seen)


def test_a_limit_of_the_drive_may_act_for_a_moment_in_torque_mode_and_always_in_speed_mode():
    limited([True] * 5)
    limited([True] * 4 + [False] + [True] * 5)
    limited([True] * 50, Mode.SPEED)
    with pytest.raises(LimitHit, match="internal limit") as caught:
        limited([True] * 6)
    assert "bit 11" in caught.value.where


def test_a_change_of_mode_restarts_the_wait_for_the_limit():
    watch = guard()
    modes = [Mode.TORQUE] * 4 + [Mode.SPEED] + [Mode.TORQUE] * 5
    for k, mode in enumerate(modes):
        seen = sample(5.0, 90.0 + k % 2, time_s=0.1 * k)._replace(limit_active=True)
        watch.check_sample(Command(mode, 5.0, 90.0), seen)


# -- place and next step --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "seen"),
    [
        (REST, sample(time_s=1.25, fresh=False)),
        (REST, sample(NAN, time_s=1.25)),
        (REST, sample(10.01, time_s=1.25)),
        (REST, sample(-0.21, time_s=1.25)),
        (REST, sample(torque=511.0, time_s=1.25)),
        (Command(Mode.TORQUE, 8.0, 364.0), sample(8.0, 364.0, time_s=1.25)),
        (Command(Mode.TORQUE, 8.0, -300.0), sample(0.6, -300.0, time_s=1.25)),
        (Command(Mode.TORQUE, 8.0, 90.0), sample(0.3, 90.0, time_s=1.25)),
    ],
)
def test_every_message_states_the_place_and_the_next_step(command, seen):
    watch = guard()
    watch.model = MODEL
    with pytest.raises(TdhilError) as caught:
        for _ in range(20):
            watch.check_sample(command, seen)
    assert caught.value.where == "guard at 1.250 s"
    assert caught.value.next_step


@pytest.mark.parametrize("limits", [LIMITS, REVERSIBLE])
def test_noise_about_zero_is_no_reverse_rotation(limits):
    coarse = Guard(limits, PERIOD_S, 0.1, TORQUE_RESOLUTION)       # five counts are more than 2 % of the limit
    coarse.check_sample(REST, sample(-0.49))
    guard(limits).check_sample(REST, sample(-0.19))


def test_missing_feedback_is_attributed_to_a_late_host():
    watch = guard()
    watch.host_late = lambda: "40 of the last 500 cycles were late: the computer or the adapter is too slow"
    said = r"no feedback for 13 cycles, which is the limit\. 40 of the last 500 cycles were late: the computer"
    with pytest.raises(CommunicationLost, match=said) as caught:
        for _ in range(20):
            watch.check_sample(REST, sample(fresh=False))
    assert caught.value.next_step == (
        f"Close other programs, add --real-time-priority, or lower --rate below {1 / PERIOD_S:g}")
    assert caught.value.where.startswith("host")


def test_a_computation_beside_the_loop_may_delay_it():
    watch = guard()
    watch.reckoning = True
    watch.check_pace(Counters(cycles=100, overruns=60))
    watch.check_pace(Counters(cycles=200, overruns=120))
    watch.reckoning = False
    watch.check_pace(Counters(cycles=300, overruns=125))          # the count begins at its end
    with pytest.raises(CommunicationLost, match="late in 30 of 100"):
        watch.check_pace(Counters(cycles=400, overruns=155))


@pytest.mark.parametrize("offset", [20.1, -20.1, NAN, INF])
def test_a_torque_offset_beyond_what_the_stage_may_command_is_rejected(offset):
    watch = guard()
    watch.torque_offset_nm = 20.0
    watch.check_command(OFFSET)
    with pytest.raises(CommandRejected, match="torque offset"):
        watch.check_command(OFFSET._replace(torque_offset_nm=offset))


def test_no_torque_offset_is_accepted_without_a_request_of_the_stage_or_in_torque_mode():
    watch = guard()
    with pytest.raises(CommandRejected, match="torque offset"):
        watch.check_command(OFFSET)
    watch.torque_offset_nm = 20.0
    with pytest.raises(CommandRejected, match="torque mode"):
        watch.check_command(OFFSET._replace(mode=Mode.TORQUE))


def test_a_torque_offset_moves_the_shaft_from_its_reference_and_the_window_is_held_instead():
    watch = guard()
    watch.expected, watch.torque_offset_nm = PowerState.ENABLED, 20.0
    for cycle in range(4000):          # 16 s, far from the reference
        watch.check_sample(OFFSET, sample(6.5 + 0.01 * (cycle % 2), time_s=cycle * PERIOD_S))
    with pytest.raises(LimitHit, match="left its window"):
        watch.check_sample(OFFSET, sample(0.5 * LIMITS.speed_min_rad_s, time_s=17.0))


def test_constant_feedback_while_the_torque_offset_changes_is_frozen():
    watch = guard()
    watch.expected = PowerState.ENABLED
    watch.allow_torque_offset(20.0)
    with pytest.raises(CommunicationLost, match="frozen"):
        for cycle in range(200):
            command = OFFSET._replace(torque_offset_nm=0.1 * cycle)
            watch.check_sample(command, sample(5.0, 50.0, time_s=cycle * PERIOD_S))


@given(speed=st.floats(-1.0, 12.0), torque=st.floats(-500.0, 500.0), commanded=st.floats(-400.0, 400.0))
def test_a_string_under_load_moves_no_limit(speed, torque, commanded):
    """The known oscillation is used for the message only."""
    said = []
    for disturbed in ("", "the string below swings by ±1200 N·m every 5.3 s"):
        held = guard()
        held.model, held.disturbed = MODEL, disturbed
        try:
            held.check_sample(Command(Mode.TORQUE, 5.0, commanded), sample(speed, torque))
            said.append(None)
        except TdhilError as error:
            said.append((type(error), error.what.removesuffix(f"; {disturbed}")))
    assert said[0] == said[1]


@pytest.mark.parametrize(("speed", "commanded"), ((0.4, 60.0), (9.9, 400.0), (10.1, 60.0)))
def test_the_message_names_the_string_if_its_oscillation_exceeds_the_window(speed, commanded):
    held = guard()
    held.model, held.disturbed = MODEL, "the string below swings by ±1200 N·m every 5.3 s"
    with pytest.raises(LimitHit, match=r"±1200 N·m every 5\.3 s") as hit:
        held.check_sample(Command(Mode.TORQUE, 5.0, commanded), sample(speed))
    assert "off bottom" in hit.value.next_step
    assert "off bottom" in held.torque_words(100.0, False)[1]
    assert "off bottom" not in held.torque_words(400.0, False)[1]
