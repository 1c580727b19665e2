"""Plans stay within the limits, refuse requests that do not fit, and state the exact motion."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdhil.config.registry import EXCITATIONS, names
from tdhil.recording.recording import LagPrior
from tdhil.runner.design import DesignKnowledge, assumed_noise, choose
from tdhil.runner.excitation import MotionLimits, PlanRefused, PlanRequest, RigGuess, make_plan, make_transition

LIMITS = MotionLimits(0.5, 10.0, 400.0)
GUESS = RigGuess(104.0, 8.0, 60.0)
KINDS = names(EXCITATIONS, periodic=True)
MODES = ("torque", "speed")


def sampled(segment, points=2000):
    times = np.arange(points) / points * segment.reference.period_s
    return times, np.array([segment.reference.reference(t) for t in times])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", KINDS)
def test_stays_inside_even_if_the_inertia_is_wrong_by_a_fifth(kind, mode):
    plan = make_plan(LIMITS, GUESS, PlanRequest(kind=kind, mode=mode))
    for segment in plan.segments:
        _, values = sampled(segment)
        speed, torque = values[:, 0], values[:, 1]
        assert speed.min() == pytest.approx(segment.speed_min_rad_s, abs=1e-3)
        assert speed.max() == pytest.approx(segment.speed_max_rad_s, abs=1e-3)
        assert torque.min() == pytest.approx(segment.torque_min_nm, abs=0.5)
        assert torque.max() == pytest.approx(segment.torque_max_nm, abs=0.5)
        swing = (speed - segment.reference.offset_rad_s) * (1.25 if mode == "torque" else 1.0)
        assert segment.reference.offset_rad_s + swing.min() > LIMITS.speed_low_rad_s
        assert segment.reference.offset_rad_s + swing.max() < LIMITS.speed_high_rad_s
        mean = segment.reference.mean_torque_nm
        real = mean + (torque - mean) * (1.0 if mode == "torque" else 1.25)
        assert np.max(np.abs(real)) <= 0.85 * 400.0 + 0.5


def test_torque_is_what_the_speed_needs():
    """Compare with the numerical derivative of the reference."""
    plan = make_plan(LIMITS, GUESS)
    for segment in plan.segments:
        reference = segment.reference.reference
        for t in np.linspace(0.0, 10.0, 23):
            acceleration = (reference(t + 1e-5)[0] - reference(t - 1e-5)[0]) / 2e-5
            speed, torque = reference(t)
            assert torque == pytest.approx(104.0 * acceleration + 8.0 * speed + 60.0, abs=1e-3)


def test_default_plan():
    plan = make_plan(LIMITS, GUESS)
    assert len(plan.segments) == 2
    assert plan.duration_s < 240.0
    low, high = (segment.reference.offset_rad_s for segment in plan.segments)
    assert high - low > 2.5
    for segment in plan.segments:
        recorded = segment.recorded(12.5)
        assert recorded.end_s - recorded.start_s == pytest.approx(segment.duration_s)
        assert recorded.settle_periods >= 1
        cycles = np.array(recorded.lines_hz) * recorded.period_s
        assert np.allclose(cycles, np.round(cycles))
        expected = recorded.offset_rad_s + sum(
            a * math.cos(2 * math.pi * f * 3.3 + p)
            for a, f, p in zip(recorded.amplitudes_rad_s, recorded.lines_hz, recorded.phases_rad, strict=True)
        )
        assert segment.reference.reference(3.3)[0] == pytest.approx(expected)


def test_crest_of_the_multisine_is_low():
    segment = make_plan(LIMITS, GUESS).segments[0]
    _, values = sampled(segment)
    for signal, crest in ((values[:, 0], 1.65), (values[:, 1], 1.45)):
        deviation = signal - signal.mean()
        assert 0.5 * np.ptp(deviation) / np.std(deviation) < crest


@pytest.mark.parametrize("mode", MODES)
def test_realisations_have_the_same_lines_and_other_phases_within_the_limits(mode):
    plan = make_plan(LIMITS, GUESS, PlanRequest(mode=mode, realisations=3))
    assert len(plan.segments) == 6 and len({one.reference.phases_rad for one in plan.segments}) == 6
    assert len({(one.reference.lines_hz, one.reference.amplitudes_rad_s) for one in plan.segments}) == 1
    speeds = [one.reference.offset_rad_s for one in plan.segments]
    assert speeds == sorted(speeds) and len(set(speeds)) == 2
    for segment in plan.segments:
        _, values = sampled(segment)
        assert LIMITS.speed_low_rad_s < values[:, 0].min() and values[:, 0].max() < LIMITS.speed_high_rad_s
        assert np.abs(values[:, 1]).max() < 400.0
    once = make_plan(LIMITS, GUESS, PlanRequest(mode=mode))
    counted = sum(one.periods - one.settle_periods for one in once.segments)
    assert sum(one.periods - one.settle_periods for one in plan.segments) == pytest.approx(counted, rel=0.25)
    assert plan == make_plan(LIMITS, GUESS, PlanRequest(mode=mode, realisations=3))        # the phases are seeded


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "multisine"])
def test_a_motion_whose_phases_are_its_form_has_one_realisation(kind):
    with pytest.raises(PlanRefused, match="has one realisation"):
        make_plan(LIMITS, GUESS, PlanRequest(kind=kind, realisations=2))


def test_an_aborted_segment_ends_with_its_last_whole_period():
    segment = make_plan(LIMITS, GUESS).segments[0]
    assert segment.recorded(100.0, 147.0).end_s == pytest.approx(140.0)
    assert segment.recorded(100.0, 100.0).end_s == 100.0
    assert segment.recorded(100.0, 1e6).end_s == pytest.approx(100.0 + segment.duration_s)


@pytest.mark.parametrize(
    ("wish", "word"),
    [
        (PlanRequest(amplitude_rad_s=6.0), "speed window"),
        (PlanRequest(kind="sine", frequency_hz=2.0, amplitude_rad_s=1.0), "torque limit"),
        (PlanRequest(offsets_rad_s=(0.4,)), "speed window"),
        (PlanRequest(offsets_rad_s=(5.0, 11.0)), "speed window"),
        (PlanRequest(frequency_hz=0.0), "frequency"),
        (PlanRequest(amplitude_rad_s=-1.0), "amplitude"),
        (PlanRequest(amplitude_rad_s=math.nan), "amplitude"),
        (PlanRequest(periods=1), "periods"),
        (PlanRequest(offsets_rad_s=()), "offset"),
        (PlanRequest(kind="noise"), "unknown"),
    ],
)
def test_refuses_by_name(wish, word):
    with pytest.raises(PlanRefused, match=word):
        make_plan(LIMITS, GUESS, wish)


@pytest.mark.parametrize(("wish", "words", "advice"), [
    (PlanRequest(amplitude_rad_s=15.0), "speed window (upper end): an amplitude of 15 rad/s (143 rpm) at",
     "If you meant rpm, write --amplitude 15rpm. Otherwise change --amplitude, --offset, --frequency or the limits"),
    (PlanRequest(amplitude_rad_s=15.00005), "of 15 rad/s (143 rpm)", "Change --amplitude"),    # 143.24rpm
    (PlanRequest(amplitude_rad_s=400.0), "of 400 rad/s (3820 rpm)", "Change --amplitude"),
    (PlanRequest(offsets_rad_s=(40.0,)), "leaves no room for any excitation at 40 rad/s (382 rpm)",
     "If you meant rpm, write --offset 40rpm. "),
    (PlanRequest(offsets_rad_s=(400.0,)), "at 400 rad/s (3820 rpm)", "Change --amplitude"),
])
def test_a_speed_outside_the_window_is_stated_in_both_units(wish, words, advice):
    with pytest.raises(PlanRefused) as caught:
        make_plan(LIMITS, GUESS, wish)
    assert words in str(caught.value) and caught.value.next_step.startswith(advice)
    assert str(caught.value).endswith(". A plan uses 0.785 to 9.71 rad/s (7.5 to 92.8 rpm)")


@pytest.mark.parametrize(
    ("limits", "guess", "word"),
    [
        ((0.5, 10.0, 60.0), (104.0, 8.0, 60.0), "torque limit"),
        ((5.0, 5.0, 400.0), (104.0, 8.0, 60.0), "speed window"),
        ((0.5, 10.0, 0.0), (104.0, 8.0, 60.0), "torque limit"),
        ((0.5, math.inf, 400.0), (104.0, 8.0, 60.0), "finite"),
        ((0.5, 10.0, 400.0), (0.0, 8.0, 60.0), "inertia"),
        ((0.5, 10.0, 400.0), (math.nan, 8.0, 60.0), "inertia"),
    ],
)
def test_refuses_impossible_machines(limits, guess, word):
    with pytest.raises(PlanRefused, match=word):
        make_plan(MotionLimits(*limits), RigGuess(*guess))


def test_requested_values_are_kept():
    wish = PlanRequest(kind="sine", frequency_hz=0.3, amplitude_rad_s=0.5, offsets_rad_s=(3.0, 6.0), periods=9)
    plan = make_plan(LIMITS, GUESS, wish)
    assert [segment.reference.offset_rad_s for segment in plan.segments] == [3.0, 6.0]
    assert plan.segments[0].reference.lines_hz == (pytest.approx(0.3),)
    assert plan.segments[0].reference.amplitudes_rad_s == (pytest.approx(0.5),)
    assert plan.segments[0].periods == 9


def test_transition_has_no_step():
    plan = make_plan(LIMITS, GUESS)
    transition = plan.transition(2.0, 0)
    segment = plan.segments[0].reference
    speed, torque = transition.reference(transition.duration_s)
    assert speed == segment.reference(0.0)[0]
    assert torque == pytest.approx(segment.reference(0.0)[1], abs=25.0)     # some percent of the limit
    assert transition.reference(0.0)[0] == 2.0
    peak = max(abs(transition.reference(t)[1]) for t in np.linspace(0.0, transition.duration_s, 200))
    assert peak < 0.85 * 400.0


def test_transition_refuses_where_friction_takes_all():
    with pytest.raises(PlanRefused, match="torque limit"):
        make_transition(1.0, 2.0, MotionLimits(0.5, 10.0, 70.0), GUESS)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    scale=st.floats(1e-4, 1e2),
    low=st.floats(0.1, 3.0),
    width=st.floats(0.5, 50.0),
    kind=st.sampled_from(KINDS),
    mode=st.sampled_from(MODES),
)
def test_any_rig_is_planned_inside_its_limits_or_refused(scale, low, width, kind, mode):
    limits = MotionLimits(low, low + width, 400.0 * scale)
    try:
        guess = RigGuess(104.0 * scale, 8.0 * scale, 60.0 * scale)
        plan = make_plan(limits, guess, PlanRequest(kind=kind, mode=mode))
    except PlanRefused:
        return
    assert limits.speed_low_rad_s < plan.speed_min_rad_s < plan.speed_max_rad_s < limits.speed_high_rad_s
    assert max(abs(plan.torque_min_nm), abs(plan.torque_max_nm)) <= 0.85 * limits.torque_limit_nm * (1 + 1e-9)


def test_pseudo_random_torque():
    """The spectrum is flat over its lines, at one speed for ten minutes. No half-width is predicted."""
    plan = make_plan(LIMITS, RigGuess(104.0, 8.0, 60.0), PlanRequest(kind="prbs"))
    (segment,) = plan.segments
    reference = segment.reference
    assert (segment.periods - segment.settle_periods) * reference.period_s == 600.0
    assert np.allclose(np.diff(reference.lines_hz), 1.0 / reference.period_s)
    torque = np.array(reference.amplitudes_rad_s) * np.array(reference.lines_hz)
    assert torque.min() > 0.6 * torque.max()
    elements = np.array([reference.reference((n + 0.5) * reference.period_s / 63)[1] for n in range(63)])
    elements -= reference.mean_torque_nm
    assert abs(np.count_nonzero(elements > 0.0) - 32) <= 5
    usual = np.abs(np.fft.rfft(elements))[1:31]
    assert usual.min() > 0.4 * usual.max()
    chosen = choose(LIMITS, GUESS, PlanRequest(kind="prbs"), DesignKnowledge(assumed_noise(400.0, 10.0), LagPrior()),
                    0.95)
    with pytest.raises(PlanRefused, match=r"0\.1 Hz apart"):
        make_plan(LIMITS, GUESS, PlanRequest(kind="prbs", frequency_hz=0.1))
    assert math.isnan(chosen.half_width) and math.isnan(chosen.usual_half_width)
