"""Two masses on a spring: impedance compared with the equations of motion, and results from recordings."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from tdhil.estimation import Options, Verdict, identify
from tdhil.estimation.frequency_domain.compliant import Chosen, choose, may_swing
from tdhil.estimation.frequency_domain.compliant_fit import (
    RESONANCE,
    STIFFNESS,
    TOTAL,
    ViewedShaft,
    fit_compliant,
    inertias,
    shaft_covariance,
)
from tdhil.estimation.frequency_domain.rigid import fit_rigid
from tdhil.estimation.frequency_domain.shafts import (
    KnownStringShaft,
    StringShaft,
    TwoMassShaft,
    resonances,
    stiffness,
)
from tdhil.estimation.friction_levels import Levels, ViscousConstraint
from tdhil.estimation.result import Refusal, rejects
from tdhil.estimation.spectrum import SpectralLine
from tdhil.recording.recording import LagPrior, Pipe
from tests.estimation.compliant_bench import LINES, Noise, TwoMass, run
from tests.estimation.compliant_bench import Pipe as PipeBench

S = 2j * np.pi * np.array(LINES)
MILD = Noise(load_nm=55.0, sensor_rad_s=0.025)
KNOWN = LagPrior(0.40, 0.004, 0.15, 0.0015, "the manual")
NO_LEVELS = Levels(*(np.zeros(0),) * 4, 0.0, 0.0)

sizes = st.floats(0.05, 20.0)
few = settings(max_examples=20, deadline=None, derandomize=True, phases=[Phase.generate])


def parameters(plant):
    return np.array([plant.motor, plant.motor_viscous + plant.load_viscous, plant.load,
                     np.sqrt(plant.stiffness / plant.load), plant.damping, plant.load_viscous])


def synthetic(plant, seed, noise_nm, hertz=LINES, amplitude=0.2, lags=(0.4, 0.15)):
    """Return lines as from six periods about each of two mean speeds, and B from the operating points."""
    rng, found = np.random.default_rng(seed), []
    for hz in hertz:
        s = 2j * np.pi * hz
        speed = [amplitude + 0.0005 * (rng.normal(size=6) + 1j * rng.normal(size=6)) for _ in range(2)]
        g = plant.impedance(hz) * (1.0 + lags[0] * s) / (1.0 + lags[1] * s)
        torque = [g * amplitude + noise_nm * (rng.normal(size=6) + 1j * rng.normal(size=6)) for _ in range(2)]

        def scatter(one, other):
            return sum(np.sum((a - a.mean()) * np.conj(b - b.mean())) for a, b in zip(one, other, strict=True)) / 10.0

        found.append(SpectralLine(hz, np.array([x.mean() for x in speed]), np.array([x.mean() for x in torque]),
                                  np.array([6.0, 6.0]), scatter(speed, speed).real, scatter(torque, torque).real,
                                  complex(scatter(torque, speed)), 10.0))
    sd = 0.05 * noise_nm
    return tuple(found), ViscousConstraint(plant.impedance(1e-5).real + sd * rng.normal(), 0.0, sd, 10.0)


@few
@given(motor=sizes, load=sizes, k=sizes, c=st.floats(0.0, 1.0), b=st.floats(0.0, 1.0), hz=st.floats(0.01, 3.0))
def test_impedance_solves_the_equations_of_motion(motor, load, k, c, b, hz):
    plant = TwoMass(motor, load, k, c, 0.3, b)
    found = TwoMassShaft().impedance(parameters(plant), np.array([2j * np.pi * hz]))[0]
    assert found == pytest.approx(plant.impedance(hz), rel=1e-9)


def test_slow_motion_has_both_inertias_and_fast_motion_the_motors_only():
    plant = replace(TwoMass(), damping=0.0, load_viscous=0.0)
    slow, fast = TwoMassShaft().impedance(parameters(plant), 2j * np.pi * np.array([1e-3, 50.0])).imag
    assert slow == pytest.approx(plant.total * 2e-3 * np.pi, rel=1e-4)
    assert fast == pytest.approx(plant.motor * 100.0 * np.pi, rel=1e-4)


def test_resonances_are_the_notes_and_those_of_the_matrix():
    found = resonances(parameters(TwoMass()))
    p = TwoMass()
    free = np.linalg.eigvals(np.array([[p.stiffness, -p.stiffness]] * 2) * [[1 / p.motor], [-1 / p.load]])
    assert np.array(found) / (2.0 * np.pi) == pytest.approx([0.179, 0.200], abs=5e-4)
    assert found[1] == pytest.approx(np.sqrt(np.max(free.real)), rel=1e-9)
    assert stiffness(parameters(p)) == pytest.approx(473.0)


@pytest.mark.parametrize("view", (None, TOTAL, STIFFNESS, RESONANCE), ids=("plain", "total", "stiffness", "resonance"))
@pytest.mark.parametrize("shaft", (TwoMassShaft(), StringShaft()), ids=("lumps", "string"))
def test_jacobian_is_the_derivative_through_every_view(shaft, view):
    m = parameters(TwoMass())
    m = np.append(m, [0.3, 0.6]) if isinstance(shaft, StringShaft) else m
    plain = shaft.impedance(m, S)
    if view is not None:
        shaft, seen = ViewedShaft(shaft, view), m.copy()
        seen[view.index] = view.of(m)
        m = seen
        assert np.allclose(shaft.impedance(m, S), plain, rtol=1e-12)
    jacobian = shaft.jacobian(m, S)
    for index in range(len(m)):
        step = np.zeros(len(m))
        step[index] = 1e-6 * m[index]
        slope = (shaft.impedance(m + step, S) - shaft.impedance(m - step, S)) / (2.0 * step[index])
        assert np.allclose(jacobian[:, index], slope, rtol=1e-5, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("view", (None, TOTAL, STIFFNESS, RESONANCE), ids=("plain", "total", "stiffness", "resonance"))
def test_a_known_pipe_has_its_derivative_through_every_view(view):
    pipe = Pipe(215.0, 410.0, 0.03)
    shaft, m = KnownStringShaft(pipe), np.append(parameters(TwoMass()), [0.3, 0.6])
    m[2], m[3] = 215.0 / 0.3, np.sqrt(410.0 / (215.0 / 0.3 * 0.8))
    assert np.allclose(shaft.beliefs(m)[0], 0.0, atol=1e-12)
    m[2] *= 1.05
    known = shaft.beliefs(m)[0]
    assert known == pytest.approx([np.log(1.05) / 0.03, 0.0], abs=1e-12)
    if view is not None:
        shaft, seen = ViewedShaft(shaft, view), m.copy()
        seen[view.index] = view.of(m)
        m = seen
        assert shaft.beliefs(m)[0] == pytest.approx(known, abs=1e-9)
    slopes = shaft.beliefs(m)[1]
    for index in range(len(m)):
        step = np.zeros(len(m))
        step[index] = 1e-6 * m[index]
        slope = (shaft.beliefs(m + step)[0] - shaft.beliefs(m - step)[0]) / (2.0 * step[index])
        assert np.allclose(slopes[:, index], slope, rtol=1e-5, atol=1e-6 * np.abs(slopes).max())


@pytest.fixture(scope="module")
def recording():
    return run(TwoMass(), [3], noise=MILD, lag_prior=KNOWN)[0]


@pytest.mark.heavy
def test_auto_finds_two_masses_and_says_so(recording):
    found = identify(recording)
    shaft = found.compliant
    assert found.model == "two-mass"
    assert found.verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    assert found.inertia.value == pytest.approx(1500.0, rel=0.01)
    assert shaft.load_inertia.value == pytest.approx(374.0, rel=0.1)
    assert shaft.stiffness_nm_rad.value == pytest.approx(473.0, rel=0.1)
    assert shaft.total_inertia.value == pytest.approx(1874.0, rel=0.01)
    # seeded: always within twice the half-width
    for one, truth in ((found.inertia, 1500.0), (shaft.total_inertia, 1874.0), (shaft.load_inertia, 374.0)):
        assert abs(one.value - truth) < one.high - one.low
    stated = dict(zip(shaft.covariance.quantities, np.sqrt(np.diag(shaft.covariance.matrix)), strict=True))
    for name, one in (("inertia_kg_m2", found.inertia), ("load_inertia_kg_m2", shaft.load_inertia),
                      ("stiffness_nm_rad", shaft.stiffness_nm_rad)):
        assert 0.0 < 1.96 * stated[name] < 1.5 * 0.5 * (one.high - one.low)      # it may also contain a string
    assert "contradict a rigid shaft" in found.reason or "residuals contradict" in found.reason
    assert any("resonance at 0.2 Hz lies inside the excited band" in warning for warning in found.warnings)
    half = 0.5 * (found.inertia.high - found.inertia.low)
    squares = sum(line.half_width_kg_m2**2 for line in found.budget if line.source != "torque scale")
    assert np.sqrt(squares) == pytest.approx(half, rel=0.05)


@pytest.mark.heavy
def test_if_a_string_is_possible_and_widens_most_the_user_is_asked_for_the_load():
    """A string as heavy as the load has its second resonance above all lines at 0.4 Hz."""
    stiffer = run(replace(TwoMass(), stiffness=4.0 * 473.0, damping=2.0 * 23.2), [3])[0]
    found = identify(stiffer, Options(tolerance=0.01))
    assert found.verdict is Verdict.VALID_WIDE
    assert found.inertia.low <= 1500.0 <= found.inertia.high
    assert found.advice.startswith("add --model two-mass for a coupling")
    told = identify(stiffer, Options(model="two-mass", tolerance=0.001))
    assert told.verdict is Verdict.VALID_WIDE
    assert told.advice.startswith("state the drive's")
    assert told.inertia.high - told.inertia.low < found.inertia.high - found.inertia.low


@pytest.mark.heavy
def test_a_model_that_is_asked_for_is_the_one_that_is_fitted(recording):
    two = identify(recording, Options(model="two-mass"))
    assert two.model == "two-mass"
    assert "the spring weighs nothing" in two.inertia.conditional_on
    rigid = identify(recording, Options(model="rigid"))
    assert rigid.verdict is Verdict.MODEL_REJECTED
    assert rigid.inertia is None


@pytest.mark.heavy
def test_the_same_recording_gives_the_same_bits(recording):
    asked = Options(model="two-mass")
    assert identify(recording, asked) == identify(recording, asked)


@pytest.mark.heavy
def test_intervals_cover_over_seeds():
    """With five seeds and four quantities at 95 %, four or more misses have a probability of 2 %."""
    plant, misses = TwoMass(), 0
    truth = {"inertia": plant.motor, "load": plant.load, "stiffness": plant.stiffness, "total": plant.total}
    for seed in range(5):
        lines, constraint = synthetic(plant, seed, 20.0)
        found = inertias(fit_compliant(TwoMassShaft(), lines, constraint, (), {}), 0.95)
        for name, value in truth.items():
            one = found[name]
            assert one.value == pytest.approx(value, rel=0.15)
            misses += not one.low <= value <= one.high
    assert misses < 4


def test_a_resonance_just_above_the_band_is_no_rigid_shaft():
    """The rigid model is rejected, or doubted and then replaced by an oscillating load."""
    plant = TwoMass(83.0, 21.0, 21.0 * (2.0 * np.pi * 0.55) ** 2, 2.0, 6.0, 2.0)
    for seed in range(3):
        lines, constraint = synthetic(plant, seed, 1.0, (0.05, 0.1, 0.15, 0.25, 0.35, 0.5))
        rigid = fit_rigid(lines, NO_LEVELS, constraint, (), {}, 0.95)
        assert may_swing(rigid)


@pytest.mark.parametrize("seed", [pytest.param(1, marks=pytest.mark.heavy), pytest.param(5, marks=pytest.mark.long)])
def test_a_line_that_stands_still_at_the_antiresonance_is_no_weak_line(seed):
    """The load absorbs the motion of the motor at 0.08 Hz: two lines have torque and hardly any speed.

    The other nine lines fit a rigid shaft, with an inertia that is neither the motor's nor the total one.
    """
    total = TwoMass().total
    plant = TwoMass(motor=0.7 * total, load=0.3 * total, stiffness=0.3 * TwoMass().stiffness)
    (recording,) = run(plant, [seed], noise=Noise(), lags_s=(0.40, 0.15), settle=4)
    found = identify(recording)
    assert found.model == "two-mass", found.reason
    assert found.inertia.low <= plant.motor <= found.inertia.high
    assert identify(recording, Options(model="rigid")).residual.p_value < 0.01


@pytest.mark.heavy
def test_a_line_by_the_swing_that_the_mean_speeds_differ_at_counts_by_the_difference():
    """The dry friction of the load changes its sign only at this line and at the slower mean speed."""
    plant = TwoMass()
    lines, constraint = synthetic(plant, 2, 20.0, (0.05, 0.1, 0.18, 0.35, 0.7))
    swing = next(index for index, line in enumerate(lines) if line.hertz == 0.18)

    def unlike(at):
        torque = lines[at].torque * np.array([1.15 + 0.1j, 1.0])
        return (*lines[:at], replace(lines[at], torque=torque), *lines[at + 1:])

    bad = fit_compliant(TwoMassShaft(), unlike(swing), constraint, (), {})
    assert rejects(bad.residual)
    found = choose("two-mass", unlike(swing), constraint, (), {})
    assert (found.rejected, found.unlike_hz) == (False, (0.18,))
    assert found.fit.mechanical[0] == pytest.approx(plant.motor, rel=0.02)
    elsewhere = choose("two-mass", unlike(swing + 1), constraint, (), {})
    assert (elsewhere.rejected, elsewhere.unlike_hz) == (True, ())


@pytest.mark.heavy
def test_what_is_known_of_a_pipe_counts_as_equations():
    """Four lines and two mean speeds give nine equations for the eleven unknowns of a string with lags."""
    plant = PipeBench()
    lines, constraint = synthetic(plant, 1, 5.0, (0.07, 0.2, 0.4, 0.7))
    known = Pipe(plant.inertia, plant.stiffness, 0.03, "rig.yaml")
    found = choose("auto", lines, constraint, (), {}, known)
    assert found.pipe is known
    assert found.fit.is_string
    assert found.fit.mechanical[0] == pytest.approx(plant.motor, rel=0.05)


@pytest.mark.heavy
def test_too_few_lines_are_counted_and_refused():
    lines, constraint = synthetic(TwoMass(), 0, 20.0, LINES[:3])
    found = choose("two-mass", lines, constraint, (), {})
    assert isinstance(found, Refusal)
    assert "9 unknowns" in found.reason
    assert "at least 4 lines" in found.advice
    assert isinstance(choose("two-mass", *synthetic(TwoMass(), 0, 20.0), (), {}), Chosen)


@pytest.mark.heavy
def test_the_covariance_of_the_fit_is_the_scatter_over_seeds():
    """With 24 seeds, the standard deviations agree within a factor of 1.6, and the clear correlations in sign."""
    fits = [fit_compliant(TwoMassShaft(), *synthetic(TwoMass(), seed, 20.0), (), {}) for seed in range(24)]
    stated = [shaft_covariance(fit) for fit in fits]
    names = stated[0].quantities
    assert names == ("inertia_kg_m2", "stiffness_nm_rad", "antiresonance_hz", "load_inertia_kg_m2", "damping_nm_s_rad")
    found = np.array([[m[0], m[3] ** 2 * m[2], m[3] / (2.0 * np.pi), m[2], m[4]]
                      for m in (fit.fitted.simple.theta for fit in fits)])
    mean = np.mean([one.matrix for one in stated], axis=0)
    assert np.allclose(mean, mean.T)
    ratios = found.std(axis=0, ddof=1) / np.sqrt(np.diag(mean))
    assert np.all((ratios > 1.0 / 1.6) & (ratios < 1.6))
    promised, seen = (one / np.sqrt(np.outer(np.diag(one), np.diag(one))) for one in (mean, np.cov(found.T)))
    clear = np.abs(promised) > 0.5
    assert clear.sum() > len(names)          # more than the diagonal
    assert np.all(promised[clear] * seen[clear] > 0.0)
