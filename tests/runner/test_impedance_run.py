"""Run that measures the impedance of the drive: stages, limits, and removal of the torque offset at its end."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.drive import DriveLimits, Mode
from drivers.errors import CommunicationLost, LimitHit, PreflightRefused
from sim_bus.params import DriveParams, RigParams
from tdhil.errors import Interrupted
from tdhil.estimation import Verdict, identify
from tdhil.runner.excitation import MotionLimits, PlanRequest, RigGuess
from tdhil.runner.preconditions import choose_mode, refuse_slow_reference
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.stages import impedance
from tests.runner.line_drive import LIMITS, Line, LineDrive, run_line

pytestmark = pytest.mark.one_worker      # its fixture is expensive

ZETA = 20.56
OFFSET = ExcitationRequest(impedance="offset", string_nm_s_rad=ZETA, periods=8)
RIG = RigParams(drive=DriveParams(control_period_s=0.01, speed_gain_nm_s_rad=82.2, speed_integral_gain_nm_rad=69.3))
LARGEST_NM = 160.0                     # four tenths of the torque limit


def drive(**others):
    return LineDrive(Line(0.02, share=0.2, jitter=0.0), params=RIG, modes=frozenset({Mode.SPEED}), **others)


@pytest.fixture(scope="module")
def measured():
    return run_line(drive(seed=3), OFFSET)


@pytest.mark.heavy
def test_it_goes_through_its_stages_and_finds_the_gains(measured):
    assert measured.outcome.cause is None
    assert [(one.name, one.outcome) for one in measured.outcome.stages] == [
        ("setup", "ok"), ("speed", "ok"), ("torque", "skipped"), ("hold", "ok"), ("acquire", "ok"),
    ]
    found = identify(measured.recording).impedance
    assert found.verdict is Verdict.VALID, found.reason
    assert found.gain_nm_s_rad.value == pytest.approx(82.2, rel=0.03)
    assert found.integral_nm_rad.value == pytest.approx(69.3, rel=0.02)


@pytest.mark.heavy
def test_the_offset_stays_within_its_share_of_the_torque_limit_and_is_gone_before_the_stop(measured):
    sent = np.array(measured.drive.offsets_nm)
    assert 60.0 < np.max(np.abs(sent)) <= LARGEST_NM
    (segment,) = measured.recording.excitation.segments
    assert len(segment.torque_amplitudes_nm) == len(segment.lines_hz) == 9
    rising = np.flatnonzero(sent)
    assert np.all(sent[rising[-1] + 1 :] == 0.0)
    step = np.max(np.abs(np.diff(sent)))
    assert step < 0.25 * LARGEST_NM        # faded in and out without a step
    assert abs(sent[rising[-1]]) < 0.05 * LARGEST_NM
    assert measured.outcome.stop.confirmed and measured.drive.disabled_at == pytest.approx([0.0], abs=0.01)


@pytest.mark.heavy
def test_the_motion_is_as_planned(measured):
    plan = measured.display.plans[0]
    excited = measured.recording.time_s > measured.recording.excitation.segments[0].start_s
    ended = measured.recording.time_s < measured.recording.excitation.segments[0].end_s
    speed = measured.recording.speed_rad_s[excited & ended]
    assert plan.speed_min_rad_s - 0.2 < speed.min() and speed.max() < plan.speed_max_rad_s + 0.2
    assert plan.speed_max_rad_s - plan.speed_min_rad_s < 2.5 * np.ptp(speed)
    assert np.max(np.abs(measured.recording.torque_nm)) < LIMITS.torque_nm


@pytest.mark.parametrize("seed", [10, 189, 331])
def test_the_planned_offset_stays_within_its_limit_between_the_points_of_the_grid(seed, monkeypatch):
    """The peak was looked for at 1024 points of the period. The guard refused a higher one in mid-run, with exit 1."""
    rng = np.random.default_rng(seed)
    monkeypatch.setattr(impedance, "DRAWS", 1)
    monkeypatch.setattr(impedance, "PHASES_RAD", tuple(rng.uniform(0.0, 2.0 * np.pi, len(impedance.HARMONICS))))
    lines = len(impedance.HARMONICS)
    plan = impedance._planned(
        (np.full(lines, 1e-6 + 0j), np.full(lines, 21.0 + 0j)), 20.0, 4.0,
        MotionLimits(1.0, 7.0, 4000.0, 20.0), RigGuess(104.0, 8.0, 60.0), 0.4, PlanRequest(), 0.0, 160.0, 30)
    time_s = np.arange(0.0, impedance.PERIOD_S, 5e-4)
    offset_nm = sum(
        size * np.cos(2.0 * np.pi * harmonic / impedance.PERIOD_S * time_s + phase)
        for harmonic, size, phase in zip(impedance.HARMONICS, plan.torque_amplitudes_nm, plan.phases_rad, strict=True))
    assert 159.0 < np.max(np.abs(offset_nm)) <= 160.0


@pytest.mark.heavy
def test_a_loop_with_a_small_integral_gain_is_stopped_with_its_cause():
    """P 300 and I 2 approach a setpoint with minutes of time constant: about (P + B)/I."""
    weak = RigParams(drive=DriveParams(control_period_s=0.01, speed_gain_nm_s_rad=300.0,
                                       speed_integral_gain_nm_rad=2.0))
    slow = run_line(LineDrive(Line(0.02, share=0.2, jitter=0.0), params=weak, modes=frozenset({Mode.SPEED}), seed=3),
                    OFFSET)
    said = str(slow.outcome.cause)
    assert "did not settle" in said
    assert "The integral gain of the drive's speed loop is small for its proportional gain" in said
    assert "Raise the integral gain about" in said
    seconds = float(said.split("time constant of ")[1].split(" s", maxsplit=1)[0])
    assert seconds == pytest.approx(308.0 / 2.0, rel=0.25)
    assert slow.outcome.stop.confirmed
    assert identify(slow.recording).verdict is not Verdict.VALID


class Ending(LineDrive):
    """Line that misbehaves once the torque offset acts."""

    act = staticmethod(lambda drive, sample: sample)
    acts_after = 300
    seen_offsets = 0

    def exchange(self, command):
        sample = super().exchange(command)
        self.seen_offsets += abs(command.torque_offset_nm) > 5.0
        if self.seen_offsets > self.acts_after:
            return self.act(self, sample)
        return sample


def lost_torque(drive, sample):
    """Lower the torque limit of the drive, so that half of the torque is lost."""
    drive.inverter.control.limits.torque_forward_nm = 20.0
    return sample


def frozen(drive, sample):
    drive.held = getattr(drive, "held", sample)
    return sample._replace(speed_rad_s=drive.held.speed_rad_s, torque_nm=drive.held.torque_nm)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("act", "cause"), [(lost_torque, LimitHit), (frozen, CommunicationLost)])
def test_whatever_ends_it_the_offset_goes_with_the_first_cycle_of_the_stop(act, cause):
    one = Ending(Line(0.02, share=0.2, jitter=0.0), params=RIG, modes=frozenset({Mode.SPEED}))
    one.act = act
    asked = []
    quick_stop = one.quick_stop

    def stop():
        asked.append(len(one.offsets_nm))
        quick_stop()

    one.quick_stop = stop
    ended = run_line(one, OFFSET)
    assert isinstance(ended.outcome.cause, cause), ended.outcome.cause
    assert one.offsets_nm[asked[0] - 1] != 0.0
    assert not any(one.offsets_nm[asked[0] :])
    if act is lost_torque:
        assert ended.outcome.stop.confirmed


@pytest.mark.heavy
def test_an_interrupt_takes_it_away_as_well():
    one = Ending(Line(0.02, share=0.2, jitter=0.0), params=RIG, modes=frozenset({Mode.SPEED}))

    calls = []

    def once(drive, sample):
        if not calls:
            calls.append(len(drive.offsets_nm))
            raise Interrupted(2)
        return sample

    one.act = once
    ended = run_line(one, OFFSET)
    assert isinstance(ended.outcome.cause, Interrupted)
    assert not any(one.offsets_nm[calls[0] :])
    assert ended.outcome.stop.confirmed


@pytest.mark.parametrize(
    ("request_", "limits", "words"),
    [
        (replace(OFFSET, mode="torque"), LIMITS, "speed loop"),
        (OFFSET, replace(LIMITS, load="string"), "without a load"),
        (replace(OFFSET, kind="sine"), LIMITS, "chooses its excited frequencies itself"),
        (replace(OFFSET, frequency_hz=0.2), LIMITS, "chooses its excited frequencies itself"),
    ],
)
def test_unsuitable_drives_and_rigs_are_refused(request_, limits, words):
    found = drive().preflight(DriveLimits(10.0, 400.0, 2.0, 0.5, torque_offset=True))
    with pytest.raises(PreflightRefused, match=words):
        choose_mode(request_, limits, found)


def test_a_reference_that_comes_in_slow_steps_is_refused():
    slow = ExcitationRequest(impedance="reference")
    refuse_slow_reference(slow, 0.01)
    refuse_slow_reference(OFFSET, 0.05)
    with pytest.raises(PreflightRefused, match="a filter of the reference could not be identified"):
        refuse_slow_reference(slow, 0.05)


@pytest.mark.heavy
def test_too_little_time_is_refused_before_the_offset_grows():
    short = run_line(drive(), OFFSET, replace(LIMITS, time_s=220.0))
    assert isinstance(short.outcome.cause, LimitHit)
    assert "too few" in str(short.outcome.cause)
    assert max(map(abs, short.drive.offsets_nm)) <= 20.1
