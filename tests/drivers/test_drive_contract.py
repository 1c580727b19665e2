"""Contract of every `drivers.drive.Drive`, for each bench in conftest."""

import itertools
import math
import time

import pytest

from drivers.drive import Command, Counters, Mode, Outcome, PowerState
from drivers.errors import CommandRejected, CommunicationLost, PreflightRefused, TdhilError
from sim_bus.params import RigParams
from tests.drivers.drive_benches import Run

SPEED_GAIN = 300.0                                 # of its speed loop, N·m·s/rad
VISCOUS, COULOMB, INERTIA = 8.0, 60.0, 104.0       # the simulated rig


@pytest.fixture
def torque_run(run):
    """Return a run with torque mode. For a drive without it, check the refusal and skip the test."""
    if Mode.TORQUE not in run.bench.modes:
        run.ready()
        with pytest.raises(PreflightRefused, match="torque"):
            run.drive.enable(Mode.TORQUE)
        with pytest.raises(CommandRejected, match="torque"):
            run.cycle(Mode.TORQUE)
        pytest.skip("a drive without torque mode: it refused, as it must")
    return run


def other_mode(run):
    """Return torque mode if the drive has it."""
    return Mode.TORQUE if Mode.TORQUE in run.bench.modes else Mode.SPEED


def test_identity_and_preflight(run):
    identity = run.drive.connect()
    assert identity.simulated
    assert identity.name
    found = run.drive.preflight(run.bench.limits)
    assert found.refused == ()
    assert found.identity == identity
    assert found.modes == run.bench.modes
    assert found.rated_torque_nm == pytest.approx(run.bench.rated_nm)
    assert found.torque_resolution_nm == pytest.approx(run.bench.torque_lsb)
    assert found.speed_resolution_rad_s == pytest.approx(run.bench.speed_lsb)
    assert found.watchdog_s == run.bench.limits.watchdog_s
    assert found.safe_action == run.bench.safe_action
    # The state after a quick stop is stated by hand for each bench.
    assert found.quick_stop_holds is (run.bench.ends is PowerState.QUICK_STOP)
    assert all(check.where for check in found.checks if check.outcome is not Outcome.NOTE)


def test_preflight_needs_connect(run):
    with pytest.raises(PreflightRefused):
        run.drive.preflight(run.bench.limits)


def test_nothing_moves_before_it_is_enabled(run):
    run.ready()
    last = run.go(0.5, speed=5.0, torque=200.0)
    assert last.state is PowerState.OFF
    assert run.bench.true_speed_rad_s == 0.0


def test_the_whole_order(run):
    run.ready()
    run.enable()
    run.go(3.0, speed=2.0)
    run.stop()
    states = [sample.state for sample in run.samples]
    order = list(dict.fromkeys(states))
    assert order == [PowerState.OFF, PowerState.READY, PowerState.ENABLED, PowerState.QUICK_STOP]
    assert states[-1] is PowerState.OFF
    run.drive.close()
    assert run.bench.true_speed_rad_s == 0.0


@pytest.mark.parametrize("sign", [1, -1])
def test_torque_drives_speed_of_its_own_sign(torque_run, sign):
    run = torque_run
    run.ready()
    run.enable(Mode.TORQUE)
    begin = run.samples[-1]
    last = run.go(2.0, Mode.TORQUE, torque=sign * 150.0)
    assert last.torque_nm == pytest.approx(sign * 150.0, abs=run.bench.torque_lsb)
    # J dω/dt = T − T_c − B ω, solved by hand
    elapsed_s = last.time_s - begin.time_s
    wanted = sign * (150.0 - COULOMB) / VISCOUS * (1.0 - math.exp(-VISCOUS * elapsed_s / INERTIA))
    assert last.speed_rad_s == pytest.approx(wanted, rel=0.02, abs=0.6 * run.bench.speed_lsb)


@pytest.mark.heavy
@pytest.mark.parametrize("speed", [5.0, -3.0, pytest.param(12.5, marks=pytest.mark.long)])
def test_the_steady_speed_is_the_one_commanded(run, speed):
    run.ready()
    run.enable()
    last = run.go(12.0, speed=speed)
    near = max(1.1 * run.bench.speed_lsb, 0.01)
    assert last.speed_rad_s == pytest.approx(speed, abs=near)
    assert run.bench.true_speed_rad_s == pytest.approx(speed, abs=near)
    friction = math.copysign(COULOMB, speed) + VISCOUS * speed
    assert last.torque_nm == pytest.approx(friction, abs=max(2.0 * run.bench.torque_lsb, 1.0))


def test_switching_modes_both_ways_is_bumpless_and_confirmed(torque_run):
    run = torque_run
    steady = run.turning(5.0)
    seed = steady.torque_nm
    run.until(lambda sample: sample.mode is Mode.TORQUE, 1.0, Mode.TORQUE, 5.0, seed)
    run.go(1.0, Mode.TORQUE, 5.0, seed)
    run.until(lambda sample: sample.mode is Mode.SPEED, 1.0, Mode.SPEED, run.samples[-1].speed_rad_s, seed)
    run.go(1.0, Mode.SPEED, run.samples[-1].speed_rad_s, seed)
    after = [sample for sample in run.samples if sample.time_s > steady.time_s]
    assert {sample.state for sample in after} == {PowerState.ENABLED}
    # At the switch, half a count of speed causes a step in the torque of the speed loop.
    assert max(abs(sample.torque_nm - seed) for sample in after) < max(8.0, 0.55 * SPEED_GAIN * run.bench.speed_lsb)
    assert max(abs(sample.speed_rad_s - 5.0) for sample in after) < max(0.05, 1.3 * run.bench.speed_lsb)


def test_the_displayed_mode_is_that_of_the_drive(torque_run):
    run = torque_run
    run.ready()
    run.enable(Mode.TORQUE)
    assert run.go(0.1, Mode.TORQUE).mode is Mode.TORQUE
    assert run.go(0.2, Mode.SPEED).mode is Mode.SPEED


def test_the_limits_are_in_the_drive_and_effective(run):
    if not run.bench.has_limits:
        pytest.skip("a drive whose limits are set by hand")
    run.ready()
    mode = other_mode(run)
    run.enable(mode)
    run.go(3.0, mode, speed=19.0, torque=390.0)
    assert max(sample.torque_nm for sample in run.samples) == pytest.approx(300.0, abs=run.bench.torque_lsb)
    assert run.samples[-1].limit_active
    run.go(1.0, Mode.SPEED, speed=run.samples[-1].speed_rad_s)
    limit = run.bench.limits.speed_rad_s
    run.until(lambda sample: sample.speed_rad_s > 0.97 * limit, 25.0, Mode.SPEED, speed=19.0)
    last = run.go(2.0, Mode.SPEED, speed=19.0)
    assert last.limit_active
    assert last.speed_rad_s == pytest.approx(limit, rel=0.01)


@pytest.mark.heavy(but_first=3)
@pytest.mark.parametrize("mode", [Mode.SPEED, Mode.TORQUE])
def test_a_quick_stop_brakes_on_the_ramp_and_holds(run, mode):
    if mode not in run.bench.modes:
        pytest.skip("a drive without torque mode")
    if mode is Mode.TORQUE and not getattr(run.bench, "brakes_in_torque_mode", True):
        pytest.skip("a drive whose quick stop doesn't brake there, as its preflight says")
    steady = run.turning(8.0)
    if mode is Mode.TORQUE:
        run.go(0.5, mode, 8.0, steady.torque_nm)
    run.drive.quick_stop()
    begin = len(run.samples)
    run.until(run.rests, 20.0, mode, 8.0, steady.torque_nm)
    fall = [sample for sample in run.samples[begin:] if 1.0 < sample.speed_rad_s < 7.0]
    ramp = (fall[0].speed_rad_s - fall[-1].speed_rad_s) / (fall[-1].time_s - fall[0].time_s)
    assert ramp == pytest.approx(run.bench.ramp_rad_s2, rel=run.bench.ramp_rel)
    assert {sample.state for sample in fall} == {PowerState.QUICK_STOP}
    # further setpoints cause no motion
    last = run.go(1.0, mode, 8.0, 200.0)
    assert last.state is run.bench.ends
    assert run.rests(last)
    assert abs(run.bench.true_speed_rad_s) < 0.01


def test_a_quick_stop_is_not_ended_by_itself(run):
    run.turning(2.0, for_s=2.0)
    run.drive.quick_stop()
    run.go(6.0, speed=2.0)
    run.drive.disable()
    run.go(1.0, speed=2.0)
    assert run.samples[-1].state is PowerState.OFF
    assert abs(run.bench.true_speed_rad_s) < 0.01


@pytest.mark.parametrize("command", [
    Command(Mode.SPEED, math.nan, 0.0), Command(Mode.SPEED, 0.0, math.nan), Command(Mode.SPEED, math.inf, 0.0),
    Command(Mode.TORQUE, 0.0, -math.inf), Command(Mode.SPEED, 1e300, 0.0), Command(Mode.TORQUE, 0.0, 1e9),
])
def test_an_invalid_setpoint_never_reaches_the_bus(run, command):
    run.ready()
    run.enable()
    frames, counters, now_s = len(run.bench.frames), run.drive.counters, run.drive.clock.now_s()
    with pytest.raises(CommandRejected):
        run.drive.exchange(command)
    assert (len(run.bench.frames), run.drive.counters, run.drive.clock.now_s()) == (frames, counters, now_s)
    assert run.cycle(speed=1.0).time_s == pytest.approx(now_s + run.drive.period_s)


def test_an_exchange_without_preflight_is_a_programming_error(run):
    run.drive.connect()
    frames = len(run.bench.frames)
    with pytest.raises(TdhilError):
        run.cycle()
    assert len(run.bench.frames) == frames


@pytest.mark.parametrize("rate_hz", [100.0, 250.0, 1000.0])
def test_samples_are_one_period_apart(make_bench, rate_hz):
    run = Run(make_bench(rate_hz=rate_hz))
    run.ready()
    run.go(1.0)
    assert run.drive.period_s == pytest.approx(1.0 / rate_hz)
    times = [sample.time_s for sample in run.samples]
    assert all(later - sooner == pytest.approx(1.0 / rate_hz, abs=1e-9)
               for sooner, later in itertools.pairwise(times))
    assert {(sample.age_s, sample.half_width_s, sample.fresh) for sample in run.samples} == {(0.0, 0.0, True)}


def test_a_frozen_loop_does_not_send_what_it_had_in_hand(run):
    """The process was frozen, or the laptop slept, for six times the watchdog time."""
    run.turning(2.0, for_s=1.0)
    frames, clock = len(run.bench.frames), run.drive.clock
    clock.wait_until(clock.now_s() + 6.0 * run.bench.limits.watchdog_s)
    told = []

    def cycles(count, speed):
        for _ in range(count):
            try:
                run.cycle(speed=speed)
            except CommunicationLost as error:
                told.append(error)

    cycles(1, 9.0)
    assert [(error.where, "the control loop stood still for" in error.what) for error in told] == [("host", True)]
    assert len(run.bench.frames) == frames
    # The stop continues: the same stall is raised only once, and missing replies are not attributed to the drive.
    run.drive.quick_stop()
    cycles(round(5.0 / run.drive.period_s), 0.0)
    assert len(told) <= 2
    assert all("this computer was late" in error.what for error in told[1:])
    assert all(speed < 3.0 for speed, _ in run.bench.setpoints(run.bench.frames[frames:]))
    assert run.rests(run.samples[-1])
    assert abs(run.bench.true_speed_rad_s) < 0.01


def test_a_short_stall_is_an_overrun_and_no_burst_follows(run):
    run.turning(2.0, for_s=1.0)
    clock, counted = run.drive.clock, run.drive.counters
    clock.wait_until(clock.now_s() + 0.2 * run.bench.limits.watchdog_s)
    times = [run.cycle(speed=2.0).time_s for _ in range(10)]
    assert run.drive.counters.overruns == counted.overruns + 1
    assert min(b - a for a, b in itertools.pairwise(times)) >= 0.5 * run.drive.period_s - 1e-9
    assert run.drive.counters.missed == counted.missed


def test_counters(run):
    run.ready()
    assert run.drive.counters == Counters()
    run.go(0.4)
    assert run.drive.counters == Counters(cycles=round(0.4 / run.drive.period_s))


def test_the_frames_on_the_bus_say_what_the_samples_say(make_bench):
    """The signals have lags, noise and resolution. The tests decode them with their own formats."""
    run = Run(make_bench(RigParams(), seed=3))
    run.turning(4.0, for_s=4.0)
    run.go(1.0, other_mode(run), 4.0, 90.0)
    run.stop()
    decoded = run.bench.decode(run.bench.frames)
    assert len(decoded) == len(run.samples)
    for sample, (status, speed, torque, demand, mode) in zip(run.samples, decoded, strict=True):
        assert (sample.status, sample.mode) == (status, mode)
        assert (sample.speed_rad_s, sample.torque_nm) == (pytest.approx(speed), pytest.approx(torque))
        assert sample.torque_demand_nm == (None if demand is None else pytest.approx(demand))


def test_the_frames_on_the_bus_carry_the_setpoints(run):
    run.ready()
    run.enable()
    begin = len(run.bench.frames)
    wanted = [(0.01 * k, -0.5 * k) for k in range(100)]
    for speed, torque in wanted:
        run.cycle(Mode.SPEED, speed, torque)
    sent = run.bench.setpoints(run.bench.frames[begin:])
    assert len(sent) == len(wanted)
    for (speed, torque), (speed_sent, torque_sent) in zip(wanted, sent, strict=True):
        assert abs(speed - speed_sent) <= 0.5001 * run.bench.speed_lsb
        if torque_sent is not None:
            assert abs(torque - torque_sent) <= 0.5001 * run.bench.torque_lsb


def test_the_tap_sees_every_frame_in_order(run):
    """The tap records the same frames as a second station on the bus: those of the driver and of the drive."""
    run.bench.heard()
    run.turning(1.0)
    run.drive.exchange(Command(Mode.SPEED, 1.0, 0.0))
    heard = run.bench.heard()
    tapped = [(frame.identifier, frame.data) for frame in run.bench.frames]
    assert len(tapped) > run.bench.LEAST_FRAMES
    times = [frame.time_s for frame in run.bench.frames]
    assert times == sorted(times)
    if not run.bench.OWN_IDENTIFIERS:
        assert heard == tapped
        return
    ours = [(frame.identifier, frame.data) for frame in run.bench.frames if frame.outgoing]
    theirs = [(frame.identifier, frame.data) for frame in run.bench.frames if not frame.outgoing]
    ids = {identifier for identifier, _ in ours}
    assert [frame for frame in heard if frame[0] in ids] == ours
    # The drive may have sent more since the last exchange.
    others = [frame for frame in heard if frame[0] not in ids]
    assert theirs == others[: len(theirs)]
    assert len(others) - len(theirs) <= 2


def test_nothing_is_sent_behind_the_loops_back(run):
    run.turning(1.0, for_s=2.0)
    for _ in range(20):                # frames of the drive that are still due for the last cycle
        time.sleep(0.1)
        if not run.bench.heard():
            break
    frames = len(run.bench.frames)
    time.sleep(0.2)
    assert run.bench.heard() == []
    assert len(run.bench.frames) == frames


def test_settings_are_given_back(run):
    before = run.bench.settings()
    run.turning(2.0, for_s=2.0)
    assert run.bench.settings() != before
    run.stop()
    run.drive.close()
    assert run.bench.settings() == before


def test_a_drive_that_may_still_turn_keeps_its_watchdog(run):
    run.turning(2.0, for_s=2.0)
    armed = run.bench.settings((run.bench.WATCHDOG,))
    left = run.drive.close()
    assert left and all("was not restored" in line for line in left)       # each remaining setting is named
    assert run.bench.settings((run.bench.WATCHDOG,)) == armed
    assert set(armed.values()) != {0}


def test_mapping_and_mode_are_restored_too(run):
    others = run.bench.MAPPING + run.bench.TARGETS
    before = mapped(run.bench.settings(others))
    run.ready()
    assert mapped(run.bench.settings(others)) != before
    run.drive.close()
    assert mapped(run.bench.settings(others)) == before


def mapped(settings):
    """Return the settings without mapping entries beyond the count of a PDO, which have no effect."""
    def counts(key):
        index, sub = key.split(":")
        is_mapping = 0x1600 <= int(index[:4], 16) < 0x1800 or 0x1A00 <= int(index[:4], 16) < 0x1C00
        return not is_mapping or int(sub) <= settings[f"{index}:0"]

    return {key: value for key, value in settings.items() if counts(key)}


def test_closing_without_having_moved(run):
    before = run.bench.settings()
    run.ready()
    run.drive.close()
    assert run.bench.settings() == before


@pytest.mark.heavy
def test_a_seed_repeats_a_run(make_bench):
    def once(seed):
        run = Run(make_bench(RigParams(), seed=seed))
        run.turning(3.0)
        run.go(1.0, other_mode(run), 3.0, 100.0)
        return run.samples

    first = once(7)
    assert once(7) == first
    assert once(8) != first
