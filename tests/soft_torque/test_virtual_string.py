"""Virtual string below a real top, compared with the theory of lines, the simulation and ideal rotors."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from tdhil.soft_torque import (
    RPM,
    Begin,
    HostController,
    HostLoop,
    IdentifiedRig,
    Phase,
    ProgramCourse,
    RotorObserver,
    SpeedProgram,
    TopDrive,
    VirtualString,
    control_law,
    simulate,
)
from tests.soft_torque.cases import DRIVE, HALF, SOFT_025, STRING, string_with

SMOOTH = {"friction": "coulomb", "static_nm": None, "stribeck_speed_rad_s": None, "coulomb_nm": 0.0}


def phasor(time_s, values, hertz):
    """Return the complex amplitude at ``hertz``, over whole periods."""
    return 2.0 * np.mean(values * np.exp(-2j * pi * hertz * time_s))


@pytest.mark.heavy
def test_an_oscillating_top_sees_the_impedance_of_the_lines():
    hertz, dt_s = 0.5, 0.02
    string = string_with(**SMOOTH, length_m=1000.0, drag=0.1)
    virtual = VirtualString(string)
    count, whole = round(80.0 / dt_s), round(2.0 / hertz / dt_s)
    time_s = dt_s * np.arange(1, count + 1)
    speed = 5.0 + np.sin(2.0 * pi * hertz * time_s)
    virtual.begin(5.0)
    torque = np.array([virtual.step(float(one), dt_s) for one in speed])
    found = phasor(time_s[-whole:], torque[-whole:], hertz) / phasor(time_s[-whole:], speed[-whole:], hertz)
    theory = string.impedance_at(np.array(2j * pi * hertz))
    assert abs(found - theory) < 0.02 * (abs(theory) + string.impedance_nm_s_rad)


def test_steps_of_any_length_give_the_same():
    fine, coarse = VirtualString(STRING), VirtualString(STRING)
    for one in (fine, coarse):
        one.begin(4.0)
    rng = np.random.default_rng(3)
    before = 4.0
    for after in 4.0 + rng.normal(0.0, 0.5, 200):
        between = np.linspace(before, after, 6)[1:]
        for speed in between:
            last = fine.step(float(speed), 0.004)
        assert coarse.step(float(after), 0.02) == pytest.approx(last, abs=1e-6)
        before = float(after)
    assert coarse.bit_rad_s == pytest.approx(fine.bit_rad_s, abs=1e-9)


def test_a_bit_at_its_limit_breaks_away_at_once_and_a_stuck_one_twists_the_string():
    virtual = VirtualString(STRING)
    assert virtual.torque_nm == pytest.approx(STRING.bit.static_nm)
    virtual.begin(4.0)
    for _ in range(200):
        virtual.step(4.0, 0.02)
    assert virtual.bit_rad_s > 1.0
    virtual.release()
    for _ in range(500):
        virtual.step(4.0, 0.02)
    assert virtual.bit_rad_s > 0.0      # the bit continues: a top at constant speed gives no damping
    virtual.arm()
    assert virtual.bit_rad_s == 0.0 and virtual.torque_nm == pytest.approx(STRING.bit.static_nm)


def test_a_string_without_a_bit_is_refused():
    with pytest.raises(ValueError, match="no bit"):
        VirtualString(string_with(**{**SMOOTH, "coulomb_nm": None}))


# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("period_s", [0.004, 0.02])
def test_the_controller_of_the_host_has_the_stated_law(period_s):
    hertz = 0.2
    host = HostController(HALF, (0.020, 0.010, 0.003), period_s)
    time_s = period_s * np.arange(round(50.0 / period_s))
    speed = np.sin(2.0 * pi * hertz * time_s)
    torque = np.array([host.step(0.0, float(one)) for one in speed])
    # a command waits half a cycle on average
    late = np.exp(-2j * pi * hertz * 0.5 * period_s)
    half = len(time_s) // 2
    found = phasor(time_s[half:], torque[half:], hertz) / phasor(time_s[half:], speed[half:], hertz)
    s = np.array(2j * pi * hertz)
    lags = (1.0 + 0.020 * s) * (1.0 + 0.010 * s) * (1.0 + 0.003 * s)
    theory = -control_law(HALF, s) / lags
    assert abs(found * late - theory) < 0.01 * abs(theory)


@pytest.mark.parametrize(("lag_s", "period_s"), [(0.4, 0.01), (0.4, 0.05), (0.02, 0.02), (0.0, 0.02)])
def test_the_observer_estimates_a_lagged_speed_and_an_unknown_torque(lag_s, period_s):
    drive = TopDrive(1500.0, 8.0, 60.0)
    observer = RotorObserver(drive, lag_s, period_s)
    observer.begin(5.0)
    speed = reported = 6.0
    fine = 50
    for _ in range(round(8.0 / period_s)):
        for _ in range(fine):
            dt = period_s / fine
            reported += (speed - reported) / max(lag_s, 1e-3) * dt if lag_s else speed - reported
            speed += (300.0 + 40.0 - 60.0 - 8.0 * speed) / 1500.0 * dt
        observer.see(300.0, reported)
    assert observer.speed_rad_s == pytest.approx(speed, abs=0.01)
    assert observer.unknown_nm == pytest.approx(40.0, abs=3.0)
    assert observer.ahead(300.0) == pytest.approx(speed + (280.0 - 8.0 * speed) / 1500.0 * period_s, abs=0.01)


# ---------------------------------------------------------------------------------------------------------------------


def through(course, turns_from, *, sticks=True, longest_s=5000.0, period_s=0.1):
    """Run the program with a bit that turns from that set speed on. Return (set speeds of the trials, phases)."""
    trials, phases, since_s = [], [], 0.0
    for _ in range(round(longest_s / period_s)):
        since_s += period_s
        stuck = sticks and (course.set_rad_s < turns_from and since_s % 6.0 < 2.0)
        begun = course.step(stuck)
        if begun is not None:
            phases.append(begun)
            since_s = 0.0
            if begun is Phase.TRIAL:
                trials.append(course.set_rad_s)
        assert 0.0 <= course.share <= 1.0
        if course.phase is Phase.DONE:
            break
    return trials, phases


@pytest.mark.parametrize("turns_from_rpm", [43.2, 50.0, 61.7])
def test_the_program_finds_the_critical_speed_to_one_rpm(turns_from_rpm):
    program = SpeedProgram(40.0 * RPM, 80.0 * RPM)
    course = ProgramCourse(program, 0.1)
    trials, phases = through(course, turns_from_rpm * RPM)
    assert phases[:7] == [Phase.ARM, Phase.HOLD, Phase.RAMP, Phase.STEADY, Phase.RELEASED, Phase.FADE_OUT, Phase.MOVE]
    assert phases[-2:] == [Phase.FADE_OUT, Phase.DONE]
    above = min(one for one in trials if one >= turns_from_rpm * RPM)
    below = max([one for one in trials if one < turns_from_rpm * RPM] + [program.start_rad_s])
    assert above - below <= 1.0 * RPM + 1e-9
    assert all(program.start_rad_s < one <= program.highest_rad_s for one in trials)


def test_the_program_ends_if_the_bit_never_sticks_or_never_turns():
    _, phases = through(ProgramCourse(SpeedProgram(40.0 * RPM, 60.0 * RPM), 0.1), 1e9, sticks=False)
    assert phases == [Phase.ARM, Phase.HOLD, Phase.FADE_OUT, Phase.DONE]
    trials, phases = through(ProgramCourse(SpeedProgram(40.0 * RPM, 60.0 * RPM), 0.1), 1e9)
    assert Phase.STEADY not in phases and phases[-1] is Phase.DONE
    assert max(trials) == pytest.approx(60.0 * RPM)
    assert len(trials) <= 8


def test_the_set_speed_changes_only_on_ramps_and_the_string_only_fades():
    program = SpeedProgram(40.0 * RPM, 80.0 * RPM)
    course = ProgramCourse(program, 0.1)
    set_before, share_before = course.set_rad_s, course.share
    for tick in range(6000):
        course.step(course.set_rad_s < 55.0 * RPM and tick % 60 < 20)
        assert abs(course.set_rad_s - set_before) <= program.move_rad_s2 * 0.1 + 1e-12
        assert abs(course.share - share_before) <= 0.1 / program.fade_s + 1e-9
        set_before, share_before = course.set_rad_s, course.share
    assert course.phase is Phase.DONE and course.share == 0.0


# ---------------------------------------------------------------------------------------------------------------------


def on_ideal_rotor(loop, program, rig, period_s, seconds, unknown_nm=0.0):
    """Return (rows, true speed at the main shaft) of an ideal rotor whose reported speed has the rig's lag."""
    speed = reported = program.start_rad_s * rig.gear_ratio
    torque = next_nm = rig.coulomb_nm + rig.viscous_nm_s_rad * speed
    loop.begin(reported, torque)
    rows, speeds = [], []
    fine = 10
    dt = period_s / fine
    for tick in range(round(seconds / period_s)):
        torque, next_nm = next_nm, loop.step(tick * period_s, reported)
        rows.append(loop.row)
        speeds.append(speed / rig.gear_ratio)
        for _ in range(fine):
            # exact for a constant speed over a hundredth of the lag
            reported += (speed - reported) * (1.0 - np.exp(-dt / rig.speed_lag_s))
            friction = rig.coulomb_nm * np.sign(speed) + rig.viscous_nm_s_rad * speed
            speed += (torque + unknown_nm - friction) / rig.inertia_kg_m2 * dt
    return np.array(rows), np.array(speeds)


@pytest.mark.heavy
@pytest.mark.parametrize("rig", [
    IdentifiedRig(1500.0, 8.0, 60.0, 0.4),
    IdentifiedRig(104.0, 8.0, 60.0, 0.4),                                # test bench with a fifteenth of the inertia
    IdentifiedRig(1500.0 / 64.0, 8.0 / 64.0, 60.0 / 8.0, 0.4, 8.0),
    # the intended machine, with a motor that turns eight times as fast
], ids=["itself", "bench", "geared"])
def test_the_loop_agrees_with_the_simulation_of_the_intended_machine(rig):
    """Bit and top move as in `simulate` with the same law: first oscillations at 50 rpm, soft controller."""
    program = SpeedProgram(50.0 * RPM, 80.0 * RPM, settle_s=1.0, fade_s=2.0, hold_s=15.0)
    loop = HostLoop(STRING, DRIVE, SOFT_025, rig, program, 0.02, 1e6)
    rows, speeds = on_ideal_rotor(loop, program, rig, 0.02, 18.0)
    begun = int(np.flatnonzero(rows[:, 1] == Phase.HOLD)[0])
    speed = np.array([[50.0 * RPM]])
    trace = simulate(STRING, [(DRIVE, SOFT_025)], Begin("stuck", speed), speed, 1.0, 14.0, keep_every_s=0.0)
    time_s = rows[begun:, 0] - rows[begun, 0]
    bit = np.interp(time_s, trace.time_s, trace.bit_rad_s[:, 0, 0])
    top = np.interp(time_s, trace.time_s, trace.top_rad_s[:, 0, 0])
    kept = time_s < 13.5
    assert np.sqrt(np.mean((rows[begun:, 8] - bit)[kept] ** 2)) < 0.25
    assert np.sqrt(np.mean((speeds[begun:] - top)[kept] ** 2)) < 0.06
    assert np.ptp(top) > 3.0 and bit.max() > 12.0


def test_an_active_torque_limit_is_in_the_row():
    rig = IdentifiedRig(1500.0, 8.0, 60.0, 0.4)
    program = SpeedProgram(50.0 * RPM, 80.0 * RPM, settle_s=0.2, fade_s=1.0, hold_s=6.0)
    loop = HostLoop(STRING, DRIVE, SOFT_025, rig, program, 0.02, 800.0)
    rows, _ = on_ideal_rotor(loop, program, rig, 0.02, 7.0)
    assert rows[:, 11].any()
    assert rows[rows[:, 1] <= Phase.ARM, 11].sum() == 0     # the fade-in needs no torque at the shaft


@pytest.mark.heavy
def test_fading_in_and_out_does_not_move_the_shaft():
    """The drive's torque balances the string's torque while it is faded in and out."""
    rig = IdentifiedRig(1500.0, 8.0, 60.0, 0.4)
    program = SpeedProgram(70.0 * RPM, 90.0 * RPM, settle_s=1.0, fade_s=3.0, hold_s=30.0)
    loop = HostLoop(STRING, DRIVE, SOFT_025, rig, program, 0.02, 1e6)
    rows, speeds = on_ideal_rotor(loop, program, rig, 0.02, 38.0)
    arming = rows[:, 1] == Phase.ARM
    assert rows[arming, 7].max() > 0.98 and np.abs(speeds[arming] - program.start_rad_s).max() < 0.01
    fading = rows[:, 1] == Phase.FADE_OUT
    assert fading.any() and rows[-1, 7] < 0.7
    assert np.abs(np.diff(speeds[fading])).max() < 0.05


@pytest.mark.parametrize(("gains", "unknown_nm"), [(1.0, (0.0, 120.0)), (1.6, (300.0, 2000.0))])
def test_in_the_drives_own_loop_the_string_uses_the_offset_and_other_gains_are_found(gains, unknown_nm):
    """A drive runs its own PI controller, with a rounded set speed that the host does not know."""
    rig, period_s, fine = IdentifiedRig(1500.0 / 64.0, 8.0 / 64.0, 60.0 / 8.0, 0.4, 8.0), 0.02, 10
    program = SpeedProgram(50.0 * RPM, 80.0 * RPM, settle_s=1.0, fade_s=8.0, armed_s=8.0, hold_s=15.0)
    host = HostLoop(STRING, DRIVE, SOFT_025, rig, program, period_s, 1e6, own_loop=True)
    speed = reported = program.start_rad_s * 8.0
    integral = 7.5 + 0.125 * speed
    host.begin(reported, integral)
    own = SOFT_025.at_shaft(8.0)
    offset, rows, speeds = 0.0, [], []
    for tick in range(round(30.0 / period_s)):
        acts, offset = offset, host.step(tick * period_s, reported)
        rows.append(host.row)
        set_rad_s = round(host.set_rad_s * 8.0 / 0.08) * 0.08
        for _ in range(fine):
            dt = period_s / fine
            reported += (speed - reported) * (1.0 - np.exp(-dt / 0.4))
            error = set_rad_s - speed
            integral += own.integral_nm_rad * error * dt
            torque = gains * own.gain_nm_s_rad * error + integral + acts
            speed += (torque - 7.5 - 0.125 * speed) / rig.inertia_kg_m2 * dt
        speeds.append(speed / 8.0)
    rows = np.array(rows)
    assert rows[-1, 1] == Phase.HOLD and np.ptp(speeds[-700:]) > 2.0
    arming = rows[:, 1] == Phase.ARM
    assert np.abs(np.array(speeds)[arming][-50:] - program.start_rad_s).max() < 0.1      # now balanced
    assert unknown_nm[0] <= np.sqrt(np.mean(rows[-600:, 9] ** 2)) <= unknown_nm[1]
