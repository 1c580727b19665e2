"""Drill string: its impedance compared with the waves, and its distinction from two masses."""

import cmath
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from profiles import MessageCode
from tdhil.estimation import Verdict, identify
from tdhil.estimation.frequency_domain.compliant_fit import chance_gain, fit_compliant, too_slow
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import Model
from tdhil.estimation.frequency_domain.optimiser import box, lowest, minimise, rough_inertia_of
from tdhil.estimation.frequency_domain.shafts import StringShaft, TwoMassShaft, stiffness, string_resonances
from tdhil.recording import Pipe as KnownPipe
from tdhil.recording.recording import LagPrior
from tests.estimation.compliant_bench import LINES, Noise, Pipe, TwoMass, run
from tests.estimation.test_two_mass import KNOWN, MILD, S, parameters, synthetic

few = settings(max_examples=20, deadline=None, derandomize=True, phases=[Phase.generate])


def string_parameters(pipe):
    """Return the parameters of the string in the estimator's form."""
    share = pipe.inertia / pipe.load
    swing = np.sqrt(pipe.stiffness / (pipe.load * (1.0 - 2.0 / 3.0 * share)))
    below = pipe.drag + pipe.end_viscous
    drag_share = pipe.drag / below if below > 0.0 else share
    return np.array([pipe.motor, pipe.motor_viscous + below, pipe.load, swing, 0.0, below, share, drag_share])


@few
@given(share=st.floats(0.01, 0.99), k=st.floats(50.0, 2000.0), drag=st.floats(0.0, 50.0), b=st.floats(0.0, 50.0),
       hz=st.floats(0.01, 3.0))
def test_impedance_is_that_of_the_waves(share, k, drag, b, hz):
    pipe = Pipe(end=600.0 * (1.0 - share), inertia=600.0 * share, stiffness=k, drag=drag, end_viscous=b)
    found = StringShaft().impedance(string_parameters(pipe), np.array([2j * np.pi * hz]))[0]
    assert found == pytest.approx(pipe.impedance(hz), rel=1e-8)


def test_a_string_without_inertia_is_a_spring():
    m = parameters(TwoMass())
    assert np.allclose(StringShaft().impedance(np.append(m, [0.0, 0.0]), S), TwoMassShaft().impedance(m, S), rtol=1e-12)
    near, far = (StringShaft().impedance(np.append(m, [share, share]), S) for share in (1e-9, 1e-6))
    assert np.allclose(near, far, rtol=1e-4)


@pytest.mark.parametrize("share", (0.0, 0.05, 0.4, 0.9, 1.0))
def test_resonances_are_where_the_impedance_has_its_pole_and_its_zero(share):
    m = np.array([1500.0, 0.0, 600.0, 1.0, 0.0, 0.0, share, 0.5])
    held, free = string_resonances(m)
    assert 0.0 < held < free
    at = StringShaft().impedance(m, 1j * np.array([held * (1 - 1e-7), held * (1 + 1e-7), free, 0.5 * held])).imag
    assert at[0] > 1e5 * at[3] and at[1] < -1e5 * at[3]
    assert abs(at[2]) < 1e-6 * at[3]


@pytest.mark.heavy
def test_auto_finds_the_string():
    pipe = Pipe()
    found = identify(run(pipe, [4], noise=MILD, lag_prior=KNOWN, settle=8)[0])
    shaft = found.compliant
    assert found.model == "string"
    assert found.verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    assert found.inertia.value == pytest.approx(pipe.motor, rel=0.01)
    assert shaft.total_inertia.value == pytest.approx(pipe.total, rel=0.015)
    assert shaft.load_inertia.value == pytest.approx(pipe.load, rel=0.1)
    pole = abs(pipe.impedance(shaft.antiresonance_hz.value))
    assert pole > 5.0 * max(abs(pipe.impedance(shaft.antiresonance_hz.value * by)) for by in (0.8, 1.15))
    assert any("a resonance" in warning for warning in found.warnings)
    stated = dict(zip(shaft.covariance.quantities, np.sqrt(np.diag(shaft.covariance.matrix)), strict=True))
    assert "damping_nm_s_rad" not in stated
    for name, one in (("inertia_kg_m2", found.inertia), ("load_inertia_kg_m2", shaft.load_inertia),
                      ("stiffness_nm_rad", shaft.stiffness_nm_rad), ("antiresonance_hz", shaft.antiresonance_hz)):
        half = 0.5 * (one.high - one.low)
        assert 0.3 * half < 1.96 * stated[name] < 2.0 * half, name


@pytest.mark.heavy
def test_a_known_pipe_is_used_and_a_wrong_one_is_reported():
    plant = Pipe()
    recording = run(plant, [4], noise=MILD, lag_prior=KNOWN, settle=8)[0]
    free, found, wrong = (
        identify(replace(recording, pipe=None if scale is None else KnownPipe(
            scale * plant.inertia, plant.stiffness / scale, 0.03, "rig.yaml")))
        for scale in (None, 1.0, 2.0)
    )
    assert found.model == free.model == wrong.model == "string"
    assert found.inertia.value == pytest.approx(plant.motor, rel=0.01)
    assert found.inertia.low <= plant.motor <= found.inertia.high
    assert found.inertia.high - found.inertia.low <= free.inertia.high - free.inertia.low
    assert any("its pipe as in rig.yaml, to 3 %" in one for one in found.inertia.conditional_on)
    assert any("contradict the pipe's sizes in rig.yaml" in warning for warning in wrong.warnings)
    assert wrong.inertia.low <= plant.motor <= wrong.inertia.high


@pytest.mark.long(but_first=1)
@pytest.mark.heavy
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_torque_scale_that_the_pipe_contradicts_leaves_no_inertia(factor):
    """All reports and the travel time agree with the wrong scale. Only the impedance of the pipe contradicts it."""
    plant = Pipe()
    recording = run(plant, [4], noise=MILD, lag_prior=KNOWN, settle=8)[0]
    pipe = KnownPipe(plant.inertia, plant.stiffness, 0.03, "rig.yaml")
    found = identify(replace(recording, pipe=pipe, torque_nm=factor * recording.torque_nm))
    assert found.verdict is Verdict.MODEL_REJECTED
    assert found.entry is MessageCode.STRING_IMPEDANCE_DIFFERS
    assert found.inertia is None and found.compliant is None
    assert float(found.reason.split("has ")[1].split(" times")[0]) == pytest.approx(factor, rel=0.1)


def test_waves_on_the_bench_agree_with_its_impedance():
    """The waves of the bench agree with its formula for each tone, so the formula can be the reference."""
    pipe = replace(Pipe(), motor=20.0, motor_viscous=100.0, end_viscous=40.0)
    for hz in (0.1, 0.5):
        body, count = pipe.body(1, 0.0, (0.0, 0.0)), round(100.0 / hz)
        turn = np.exp(2j * np.pi * np.arange(count) / count)
        for _ in range(8):
            speed = np.array([body.step(np.array([torque]))[0] for torque in turn.real])
        seen = np.sum(turn.real * turn.conj()) / np.sum(speed * turn.conj())
        late = cmath.exp(1j * np.pi * hz * 0.01)       # torque is held over a step, speed is read at its beginning
        assert seen / late == pytest.approx(pipe.impedance(hz), rel=0.01)


@pytest.mark.long(but_first=1)
@pytest.mark.heavy
@pytest.mark.parametrize("seed", (2, 17))
def test_a_string_must_gain_more_than_chance_gives(seed):
    """A spring without inertia, where scatter suggests an inertia: two masses are kept.

    The intervals contain the result of a string. A descent may end at the double of that string with a wave of 10 s,
    depending on the linear algebra. Neither model nor intervals may depend on this.
    """
    plant = TwoMass()
    wrong = 1.0 + 0.01 * np.random.default_rng([seed, 1]).standard_normal(2)
    known = LagPrior(0.40 * wrong[0], 0.004, 0.15 * wrong[1], 0.0015, "the manual")
    found = identify(run(plant, [seed], noise=Noise(), lag_prior=known, lags_s=(0.40, 0.15), settle=4)[0])
    assert found.model == "two-mass", found.reason
    assert found.inertia.value == pytest.approx(plant.motor, rel=0.01)
    assert found.inertia.low <= plant.motor <= found.inertia.high
    assert "the motor turns a spring or a uniform string" in found.inertia.conditional_on
    assert "its lowest swing is above 0.025 Hz" in found.inertia.conditional_on
    total = found.compliant.total_inertia
    assert total.low <= plant.total <= total.high
    assert total.high - total.low < 0.1 * plant.total
    assert not any("interval of J_r + J_L is open" in warning for warning in found.warnings)


@few
@given(wave=st.floats(0.01, 2.0), resistance=st.floats(20.0, 500.0), end=st.floats(10.0, 1000.0), n=st.integers(1, 3))
def test_a_string_has_a_double_with_the_same_impedance_at_the_lines(wave, resistance, end, n):
    """With T + n/(2f) the impedance is the same at multiples of f. Its lowest antiresonance is always below f/2."""
    def pipe(wave):
        return Pipe(end=end, inertia=wave * resistance, stiffness=resistance / wave, drag=0.0)

    base = LINES[0]
    double = pipe(wave + n / (2.0 * base))
    for hz in LINES:
        assert double.impedance(hz) == pytest.approx(pipe(wave).impedance(hz), rel=1e-6)
    assert string_resonances(string_parameters(double))[0] <= np.pi * base


@pytest.mark.heavy
def test_the_double_of_a_string_does_not_replace_it():
    """The start of a descent has no effect, even at the double, if scatter makes it slightly more likely."""
    lines, constraint = synthetic(TwoMass(), 0, 20.0)
    two = fit_compliant(TwoMassShaft(), lines, constraint, (), {})
    problem = Likelihood(lines, Model(StringShaft()), constraint, ())
    limits = box(problem, rough_inertia_of(problem))
    held = dict.fromkeys(problem.model.structure, 0.0)
    m = two.mechanical
    spring, wave = stiffness(m), 1.0 / (2.0 * LINES[0])
    ends = []
    for resistance in (35.0, 60.0, 100.0):
        double = Pipe(m[0], m[2], resistance * wave, resistance / wave)
        start = np.concatenate([string_parameters(double), two.fitted.simple.theta[len(m):]])
        start[4] = 2.0 * m[4] * (resistance / spring / wave) ** 2       # as little damping as the spring has
        ends.append(minimise(problem, limits, start, held))
    beside = fit_compliant(StringShaft(), lines, constraint, (), {}, two)
    doubles = [fit for fit in ends if string_resonances(fit.theta[:8])[0] < np.pi * LINES[0]]
    assert min(abs(fit.objective - beside.fitted.simple.objective) for fit in doubles) < 1.0, "nearly as good"
    likelier = replace(doubles[0], objective=beside.fitted.simple.objective - 1.0)
    apart = too_slow(problem)
    assert lowest([likelier, beside.fitted.simple], apart) is beside.fitted.simple
    outdone = replace(doubles[0], objective=beside.fitted.simple.objective - 1.01 * chance_gain())
    assert lowest([beside.fitted.simple, outdone], apart) is outdone, "a much better fit is kept"
    assert lowest([likelier], apart) is likelier
