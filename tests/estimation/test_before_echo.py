"""String on bottom: impedance before and after an echo, oscillation that is no scatter, and J above the string."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from tdhil.estimation import Verdict, identify, torque_answer
from tdhil.estimation.frequency_domain.before_echo import ECHO, EchoShaft, problem_of, unleaked
from tdhil.estimation.frequency_domain.inference import standard_deviation
from tdhil.estimation.frequency_domain.optimiser import box, minimise
from tdhil.estimation.result import Refused
from tdhil.estimation.spectrum import PeriodLines, SpectralLine, pooled_lines
from tdhil.recording import Excitation, LagPrior, Segment
from tests.estimation.loaded_bench import STEP_S, Loaded, late, records, turned
from tests.estimation.reporting import recorded

PLANT = Loaded(bit_noise_nm=200.0)
PERIOD_S, COUNT = 20.0, 20
LINES_HZ = tuple(harmonic / PERIOD_S for harmonic in range(1, COUNT + 1))
TORQUES = 200.0 * np.exp(1j * np.pi * np.arange(COUNT) ** 2 / COUNT)


@pytest.fixture(scope="module")
def record():
    return records(PLANT, [3], LINES_HZ, TORQUES, PERIOD_S, 15)[0]


@pytest.mark.parametrize(("end", "wave"), ((1.0, np.tanh), (-1.0, lambda x: 1.0 / np.tanh(x))), ids=("free", "held"))
def test_one_echo_is_a_bar_that_ends(end, wave):
    """The reference is d'Alembert's bar, free or held at the bottom: ζ tanh(s T) or ζ/tanh(s T), with travel time T."""
    pipe, s = PLANT.pipe(), 2j * np.pi * np.array(LINES_HZ)
    shaft = EchoShaft(pipe, 1.0)
    m = np.concatenate([[900.0, 7.0, 250.0], np.zeros(len(shaft.at_s))])
    m[ECHO + 15] = end
    expected = 900.0 * s + 7.0 + 250.0 * wave(0.5 * s * shaft.at_s[15])
    assert np.allclose(shaft.impedance(m, s), expected, rtol=1e-9)


def test_slopes_are_differences():
    shaft, s = EchoShaft(PLANT.pipe(), 1.0), 2j * np.pi * np.array(LINES_HZ)
    m = shaft.start(1500.0)
    slopes, off = shaft.jacobian(m, s), shaft.beliefs(m)
    for index in (0, 1, 2, ECHO, ECHO + 12, ECHO + 30):
        by = np.eye(len(m))[index] * 1e-5 * max(abs(m[index]), 1.0)
        rise = (shaft.impedance(m + by, s) - shaft.impedance(m - by, s)) / (2.0 * by[index])
        assert np.allclose(slopes[:, index], rise, rtol=1e-4, atol=1e-6 * np.max(np.abs(rise)))
        believed = (shaft.beliefs(m + by)[0] - shaft.beliefs(m - by)[0]) / (2.0 * by[index])
        assert np.allclose(off[1][:, index], believed, atol=1e-6)


def test_a_wave_returns_after_the_round_trip_time():
    """The bench shows only ζ until 2L/v after a torque pulse, independent of the bottom."""
    push = np.zeros(200)
    push[10] = 1000.0
    free = replace(PLANT, drag=0.0, hold=0.0, viscous=0.0)
    ways = [turned(plant, push, np.zeros((200, 1)))[0][:, 0] - plant.mean_rad_s
            for plant in (free, replace(free, bottom=5.0, bit_viscous=500.0))]
    back = 11 + round(2.0 * free.pipe().delay_s / STEP_S)
    assert np.allclose(ways[0][:back], ways[1][:back], atol=1e-9)
    assert abs(ways[0][back + 5] - ways[1][back + 5]) > 1e-4
    decay = np.exp(-free.resistance / free.motor * STEP_S * np.arange(back - 11))
    assert np.allclose(ways[0][11:back], ways[0][11] * decay, rtol=1e-9)


@pytest.mark.heavy
def test_the_inertia_is_covered(record):
    found = identify(record)
    assert found.verdict is not Verdict.MODEL_REJECTED and found.model == "string"
    assert found.inertia.low <= PLANT.motor <= found.inertia.high
    assert found.inertia.value == pytest.approx(PLANT.motor, rel=0.08)
    assert found.inertia.high - found.inertia.low < 0.4 * PLANT.motor
    assert any("almost no echo returns within 1.40 s" in one for one in found.inertia.conditional_on)
    assert {line.source for line in found.budget} >= {"noise", "echo", "string", "lags", "torque scale"}


@pytest.mark.heavy
def test_a_torque_scale_that_is_wrong_shows_in_the_impedance_of_the_pipe(record):
    """J would be wrong by the same factor (lie 4891 of `sim_bus.lying_runs`)."""
    found = identify(replace(record, torque_nm=2.0 * record.torque_nm, torque_answer=None))
    assert (found.verdict, found.inertia) == (Verdict.MODEL_REJECTED, None)
    assert re.search(r"the string has [\d.]+ times the characteristic impedance of the pipe", found.reason)


def test_the_bottom_may_respond_at_any_time():
    """Lines of d'Alembert's bar with drag, without scatter. Data of only 6 s caused an error of J
    above the stated uncertainty."""
    pipe, hertz = PLANT.pipe(), 0.05 * np.arange(1, 31)
    s = 2j * np.pi * hertz
    below, down, along = 1000.0 * s + 20.0, s * pipe.inertia_kg_m2 + 11.5, s / pipe.stiffness_nm_rad
    wave, ways = np.sqrt(down / along), np.tanh(np.sqrt(down * along))
    g = (PLANT.motor * s + 8.0 + wave * (below + wave * ways) / (wave + below * ways)) * (1 + 0.4 * s) / (1 + 0.15 * s)
    torque = 100.0 * np.exp(1j * np.pi * np.arange(30) ** 2 / 30)
    lines = tuple(SpectralLine(float(hz), np.array([t / z]), np.array([t]), np.array([30.0]), 3.6e-7, 1.0, 0j, 87.0)
                  for hz, t, z in zip(hertz, torque, g, strict=True))
    problem = problem_of(lines, pipe, LagPrior())
    held = dict.fromkeys(problem.model.structure, 0.0)
    start = np.concatenate([problem.model.shaft.start(1400.0), [0.35, 0.0, 0.12, 0.0, 0.0, 0.0]])
    found = minimise(problem, box(problem, 1400.0), start, held).theta
    sd, _ = standard_deviation(problem, found, 0, [index for index in range(len(found)) if index not in held])
    assert sd < 0.02 * PLANT.motor
    assert abs(found[0] - PLANT.motor) < sd


def test_refusals(record):
    bare = identify(replace(record, pipe=None))
    assert bare.verdict is Verdict.NOT_IDENTIFIABLE and "rig.yaml" in bare.advice
    short = identify(replace(record, pipe=replace(record.pipe, inertia_kg_m2=0.1 * record.pipe.inertia_kg_m2,
                                                  stiffness_nm_rad=10.0 * record.pipe.stiffness_nm_rad)))
    assert short.verdict is Verdict.NOT_IDENTIFIABLE and "too short" in short.reason
    lines = pooled_lines((_fit(np.random.default_rng(1), 5),), 0.0)
    with pytest.raises(Refused, match=r"0\.2 Hz apart"):
        problem_of(tuple(replace(line, hertz=0.2 * (k + 1)) for k, line in enumerate(lines)), record.pipe, LagPrior())


def test_stick_slip_is_reported_with_its_period(record):
    swing = 6.0 * np.sin(2.0 * np.pi * record.time_s / 5.3) + 1.5 * np.sin(4.0 * np.pi * record.time_s / 5.3)
    found = identify(replace(record, speed_rad_s=record.speed_rad_s + swing))
    assert found.verdict is Verdict.NOT_IDENTIFIABLE
    assert "every 5.2 s" in found.reason or "every 5.3 s" in found.reason, found.reason
    assert "stick-slip" in found.reason and "lift the bit" in found.advice


def _fit(rng, count, swing=0.0, periods=40):
    """Return a fit of lines with white scatter and an oscillation that continues over the periods."""
    speed = np.ones((periods, count)) + 0.0j
    torque = np.full((periods, count), 5.0 + 3.0j)
    torque += rng.standard_normal((periods, count)) + 1j * rng.standard_normal((periods, count))
    torque += swing * np.diff(rng.standard_normal(periods + 1))[:, None]
    means = np.zeros(periods)
    return PeriodLines(tuple(0.05 * (k + 1) for k in range(count)), speed, torque, np.zeros((periods, count)) + 0.0j,
                       means, means, means)


@pytest.mark.parametrize("swing", (0.0, 30.0))
def test_a_continuing_oscillation_is_no_scatter(swing):
    fits = (_fit(np.random.default_rng(5), 30, swing),)
    plain = pooled_lines(fits, 0.0)
    found = np.mean([line.s_tt for line in unleaked(plain, fits)])
    assert found == pytest.approx(2.0, rel=0.15)
    assert np.mean([line.s_tt for line in plain]) > 2.0 * (1.0 + 0.5 * swing**2) * 0.5
    assert unleaked(plain[::2], fits) == plain[::2]


def answering(filtered, own_lag_s=0.01, length=None):
    """Return the torque response from a random torque command and a report through ``filtered``."""
    time = STEP_S * np.arange(round(6 * PERIOD_S / STEP_S))
    commanded = (np.exp(2j * np.pi * np.outer(time, LINES_HZ)) @ TORQUES).real
    commanded += 100.0 * lfilter([0.1], [1.0, -0.9], np.random.default_rng(4).standard_normal(len(time)))
    segment = Segment(0.0, 6 * PERIOD_S, PERIOD_S, 2, 20.0, LINES_HZ, (), ())
    one = recorded(time, 20.0 + 0.0 * time, filtered(late(commanded, own_lag_s)),
                   excitation=Excitation("prbs", "torque", (segment,)))
    return torque_answer(one, commanded[:length])


def test_the_filter_of_the_reported_torque_is_found_by_its_response():
    one = answering(lambda torque: np.roll(late(torque, 0.15), 3))
    assert one.lag_s == pytest.approx(0.16, abs=0.01) and one.shape == pytest.approx(0.06, abs=0.03)
    two = answering(lambda torque: late(late(torque, 0.1), 0.1))
    assert two.lag_s == pytest.approx(0.21, abs=0.012) and two.shape == pytest.approx(0.27, abs=0.03)


def test_a_response_that_is_no_filter_of_two_poles_is_not_used():
    average = np.ones(35) / 35.0
    assert answering(lambda torque: np.convolve(torque, average)[: len(torque)]) is None
    assert answering(lambda torque: np.random.default_rng(1).standard_normal(len(torque))) is None
    assert answering(lambda torque: late(torque, 0.15), length=100) is None


@pytest.mark.heavy
def test_the_torque_response_narrows_the_interval(record):
    """With unknown filters, long ones with a lighter motor give the same data."""
    found, blind = identify(record).inertia, identify(replace(record, torque_answer=None)).inertia
    assert found.low <= PLANT.motor <= found.high and blind.low <= PLANT.motor <= blind.high
    assert found.high - found.low < 0.7 * (blind.high - blind.low)
    assert any("follows its setpoint" in one for one in found.conditional_on)
    assert not any("follows its setpoint" in one for one in blind.conditional_on)
    stated = replace(record, lag_prior=LagPrior(None, 0.0, 0.15, 0.01, "the manual"))
    assert not any("follows its setpoint" in one for one in identify(stated).inertia.conditional_on)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("strongest_nm", (5.0, 4000.0), ids=("all", "all but one"))
def test_lines_in_the_noise_of_the_string_name_it(strongest_nm):
    """A multisine has few lines, and the noise of the bit is much larger than their effect."""
    lines = LINES_HZ[1:8:2]
    torques = np.array([strongest_nm, 5.0, 5.0, 5.0]) + 0.0j
    weak = records(replace(PLANT, bit_noise_nm=1000.0, answered=False), [1], lines, torques, PERIOD_S, 8)[0]
    found = identify(replace(weak, excitation=replace(weak.excitation, kind="multisine")))
    assert found.verdict is Verdict.NOT_IDENTIFIABLE
    assert "The string moves it by ±" in found.reason and "--excitation prbs" in found.advice


@pytest.mark.heavy
@pytest.mark.parametrize(("torque_nm", "verdict"), ((200.0, Verdict.NOT_IDENTIFIABLE), (300.0, Verdict.VALID_WIDE)))
def test_with_some_lines_in_the_noise_of_the_string_a_better_motion_is_advised(torque_nm, verdict):
    multiples = np.array([1, 2, 3, 4, 6, 8, 10, 13, 16, 20])
    torques = torque_nm * np.exp(2j * np.pi * np.random.default_rng(1).random(10))
    lines_hz = tuple(0.05 * multiples)
    weak = records(replace(PLANT, bit_noise_nm=500.0, answered=False), [1], lines_hz, torques, PERIOD_S, 8)[0]
    found = identify(replace(weak, excitation=replace(weak.excitation, kind="multisine")))
    assert found.verdict is verdict
    assert found.advice.startswith("add --excitation prbs")
    unknown = identify(replace(weak, pipe=None, excitation=replace(weak.excitation, kind="multisine")))
    assert "prbs" not in unknown.advice
