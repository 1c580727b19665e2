"""Model of the reported speed in a run that steps the set speed up and down, with its prior knowledge.

All quantities but P and I have the result's intervals as prior knowledge (standard deviation = half-width/1.96). A
rigid shaft may have a coupling above the excited lines. The rounding of the report is part of the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from math import ceil, exp, pi, sqrt
from statistics import NormalDist
from typing import Any, ClassVar, Literal

import numpy as np

from tdhil.speed_loop.design import LEAST_SPLIT, Range, UncertainPlant
from tdhil.speed_loop.loop import LoopPlant, NotchFilter, PiGains, Reals, SpringLoad
from tdhil.speed_loop.step import closed_loop

DELAY_CYCLES, DELAY_SD_CYCLES = 1.0, 1.0
"""Delay until the drive applies a setpoint, and its standard deviation, cycles. It acts at once or within two cycles,
always alike on one machine; so the ends of the range are one standard deviation away."""
NORMAL_95 = 1.96
"""Half-width of a 95 % interval, in standard deviations of a normal distribution."""
REPORT_WIDER = 3.0
"""Factor on the half-width of the reported lag. The steps determine this lag well. A result of tones may contain only
its difference from the lag of the torque."""
COUPLING_TIMES, COUPLING_MOST = 11.0, 4.0
"""Antiresonance of a coupling that a rigid shaft may have above the excited lines, as a multiple of the crossover
P/(2πJ) at one standard deviation of the prior knowledge; and largest value of that parameter, a multiple of 5.5."""
COUPLED_SHARE, COUPLED_SHARE_SD, COUPLING_DAMPING = 0.35, 0.1, 0.05
"""Share of J behind such a coupling, its standard deviation, and damping ratio of the resonance (within a factor e)."""
SETTLED_LAGS, SETTLED_TIMES = 3.0, 2.0
"""Length of a step: number of lags of the reported speed, plus number of predicted settling times."""

_GOLDEN = 0.5 * (sqrt(5.0) - 1.0)
"""Golden ratio − 1. Its multiples, modulo 1, fill an interval evenly."""
_UNSTABLE = 1e6
"""Response, as a share of the step, from which a loop counts as unstable."""
_ROUNDING_HARMONICS = 12
"""Number of harmonics of the rounding error in the model."""
_ROUNDING_SD, _ROUNDING_MOST = 0.7, 0.98
"""Prior standard deviation, and limit, of the amplitude of the first harmonic, as a share of that without noise."""
_SPLITS = (0.02, 0.5, 0.98)
"""First lags of a sum from which to fit, as a share of its range. A fit from one split ends at another minimum."""
_LEAST_COUPLING, _MOST_LOG = 1e-4, 50.0
"""Least coupling parameter (the shaft is then rigid), and largest ln of P and I as a multiple of the typed value."""


@dataclass(frozen=True)
class StepCase:
    """Prediction with which steps are compared, at the motor shaft."""

    kind: str
    """``tuned`` or ``present``: the gains that are in the drive."""
    plant: UncertainPlant
    gains: PiGains
    overshoot_share: Range
    rise_s: Range
    settling_s: Range
    reported_lag_s: Range
    """Time constant of the reported speed."""
    source: str = ""
    """File of the tuning."""
    coulomb_nm: Range | None = None
    """Coulomb friction T_c; None: unknown."""
    motion: ClassVar[str] = "small steps of the set speed"     # of stage 5, for the confirmation

    @property
    def mode(self) -> Literal["speed", "torque"]:
        """Return the drive's mode in stage 5."""
        return "speed"

    @property
    def torque_offset(self) -> bool:
        """Return whether stage 5 writes the drive's torque offset."""
        return False

    def friction_nm(self, speed_rad_s: float) -> float:
        """Return the steady torque T_c + B ω of the best estimate; only B ω if T_c is unknown."""
        coulomb_nm = 0.0 if self.coulomb_nm is None else self.coulomb_nm.value
        return coulomb_nm + self.plant.viscous_nm_s_rad.value * speed_rad_s

    def plain(self) -> dict[str, Any]:
        """Return the case as plain data for the log; `step_case_of` reads it."""
        return asdict(self)


def step_case_of(plain: Mapping[str, Any]) -> StepCase:
    """Return the case that `StepCase.plain` wrote. Raises KeyError or TypeError."""
    said = plain["plant"]

    def ranged(part: Mapping[str, Any]) -> Range:
        return Range(*(float(part[name]) for name in ("value", "low", "high")))

    gains = plain["gains"]
    notch = gains.get("notch")
    plant = UncertainPlant(
        ranged(said["inertia_kg_m2"]), ranged(said["viscous_nm_s_rad"]), tuple(map(ranged, said["lags_s"])),
        ranged(said["dead_time_s"]), *(None if said.get(name) is None else ranged(said[name]) for name in
                                       ("antiresonance_hz", "resonance_hz", "damping_nm_s_rad", "lag_sum_s")))
    law = PiGains(float(gains["gain_nm_s_rad"]), float(gains["integral_nm_rad"]),
                  None if notch is None else NotchFilter(*(float(notch[name]) for name in (
                      "hertz", "numerator_damping", "denominator_damping"))))
    overshoot, rise, settling, lag = (
        ranged(plain[name]) for name in ("overshoot_share", "rise_s", "settling_s", "reported_lag_s"))
    coulomb = plain.get("coulomb_nm")
    return StepCase(str(plain["kind"]), plant, law, overshoot, rise, settling, lag, str(plain.get("source", "")),
                    None if coulomb is None else ranged(coulomb))


@dataclass(frozen=True)
class StepProgram:
    """Speed setpoints of a verification: repeated steps up and down between two speeds."""

    low_rad_s: float
    high_rad_s: float
    half_s: float
    """Duration of each step."""
    pairs: int
    """Number of evaluated pairs of an up step and a down step. One more pair before them is not evaluated."""
    dither_rad_s: float = 0.0
    """Resolution of the reported speed. Pairs are offset by fractions of it, so that the rounding averages out."""

    def speeds_rad_s(self, pair: int) -> tuple[float, float]:
        """Return the upper and the lower speed setpoint of a pair."""
        offset = self.dither_rad_s * ((pair * _GOLDEN) % 1.0 - 0.5)
        return self.high_rad_s + offset, self.low_rad_s + offset

    @property
    def step_rad_s(self) -> float:
        """Size of each step."""
        return self.high_rad_s - self.low_rad_s

    @property
    def duration_s(self) -> float:
        """Duration of all steps, including the pair that is not evaluated."""
        return 2.0 * self.half_s * (self.pairs + 1)


def step_length_s(case: StepCase) -> float:
    """Return the time after which the reported speed of a step has settled, s."""
    return SETTLED_TIMES * case.settling_s.high + SETTLED_LAGS * case.reported_lag_s.high


class StepModel:
    """Model of the reported response. All parameters but ln P and ln I have prior mean 0 and standard deviation 1."""

    def __init__(self, case: StepCase, program: StepProgram, period_s: float, count: int, timing_sd_s: float,
                 reference_filter_s: float) -> None:
        self.case, self.period_s, self.count = case, period_s, count
        self._apart = round(program.half_s / period_s)
        self.counts = program.step_rad_s / program.dither_rad_s if program.dither_rad_s > 0.0 else 0.0
        self._reference_filter_s = reference_filter_s
        self._delay_s = DELAY_CYCLES * period_s, DELAY_SD_CYCLES * period_s + timing_sd_s
        plant = case.plant
        lags = (*plant.lags_s, plant.dead_time_s) if plant.lag_sum_s is None else (plant.lag_sum_s,)
        total = sum(lag.value for lag in lags)
        self._lags_sd = sum(lag.high - lag.low for lag in lags) / (2.0 * NORMAL_95 * total) if total > 0.0 else 0.0
        least_s, most_s = self._first_s = plant.first_lags_s
        self.size = 12 if least_s < most_s else 11
        """Parameters: ln P, ln I, J, B, lags of the loop, reporting lag, delay, antiresonance, resonance, damping,
        rounding of the report, and the first lag of a sum that is known better than its parts: with a normal parameter,
        each first lag within the intervals is as probable. For a rigid shaft the three of the spring are those of
        `_coupled`."""
        self.prior = np.r_[0.0, 0.0, np.ones(self.size - 2)]
        """Prior knowledge of each parameter, 1/variance."""
        self.starts = (np.zeros(self.size),)
        """Parameters from which to fit: the nominal plant with the typed gains, then other splits of the sum."""
        if least_s < most_s:
            nominal = (plant.lags_s[0].value - least_s) / (most_s - least_s)
            shares = (min(max(nominal, _SPLITS[0]), _SPLITS[-1]), *_SPLITS)
            self.starts = tuple(np.r_[np.zeros(11), NormalDist().inv_cdf(share)] for share in shares)

    def loop(self, theta: Reals) -> tuple[LoopPlant, PiGains]:
        """Return plant and gains for these parameters."""
        case, plant = self.case, self.case.plant
        believed = plant.believed
        inertia = _moved(plant.inertia_kg_m2, theta[2])
        scale = exp(self._lags_sd * float(np.clip(theta[4], -6.0, 6.0)))
        spring = believed.spring
        if spring is None:
            inertia, spring = self._coupled(inertia, theta)
        elif plant.antiresonance_hz is not None and plant.resonance_hz is not None:
            low = _moved(plant.antiresonance_hz, theta[7])
            spring = replace(
                spring, antiresonance_hz=low, resonance_hz=max(_moved(plant.resonance_hz, theta[8]), LEAST_SPLIT * low),
                damping_nm_s_rad=0.0 if plant.damping_nm_s_rad is None else max(
                    0.0, _shifted(plant.damping_nm_s_rad, theta[9])))
        lags_s = tuple(scale * lag for lag in believed.lags_s)
        if self.size > 11:
            least, most = self._first_s
            first_s = scale * (least + (most - least) * NormalDist().cdf(float(theta[11])))
            lags_s = first_s, sum(lags_s) - first_s
        found = LoopPlant(inertia, max(0.0, _shifted(plant.viscous_nm_s_rad, theta[3])), lags_s,
                          scale * believed.dead_time_s, spring)
        by_p, by_i = (exp(float(one)) for one in np.clip(theta[:2], -_MOST_LOG, _MOST_LOG))
        gains = replace(case.gains, gain_nm_s_rad=case.gains.gain_nm_s_rad * by_p,
                        integral_nm_rad=case.gains.integral_nm_rad * by_i)
        return found, gains

    def _coupled(self, inertia_kg_m2: float, theta: Reals) -> tuple[float, SpringLoad]:
        """Return the motor's part of J, and the spring to the rest of it.

        A shaft is rigid as far as the excited lines reach. A coupling above them lets the motor answer sooner. Without
        it in the model P was 1.19 times too high at 2.6 Hz, and a tenth of right gains got *differs* below 6 Hz.
        """
        coupling = float(np.clip(theta[7], _LEAST_COUPLING, COUPLING_MOST))
        share = float(np.clip(COUPLED_SHARE + COUPLED_SHARE_SD * theta[8], 0.05, 0.8))
        crossover_hz = self.case.gains.gain_nm_s_rad / (2.0 * pi * inertia_kg_m2)
        low_hz = COUPLING_TIMES * crossover_hz / sqrt(coupling)
        high_hz = low_hz / sqrt(1.0 - share)
        stiffness_nm_rad = share * inertia_kg_m2 * (2.0 * pi * low_hz) ** 2
        damping = COUPLING_DAMPING * exp(float(np.clip(theta[9], -3.0, 3.0)))
        spring = SpringLoad(low_hz, high_hz, damping * stiffness_nm_rad / (pi * high_hz))
        return (1.0 - share) * inertia_kg_m2, spring

    @np.errstate(over="ignore", invalid="ignore")     # a fit may try an unstable loop
    def reported(self, theta: Reals) -> Reals:
        """Return the reported response (N,) to alternating steps, as a share of the step."""
        from scipy.linalg import expm

        plant, gains = self.loop(theta)
        a, b, c = closed_loop(plant, gains)
        lag_s = max(0.0, _shifted(self.case.reported_lag_s, REPORT_WIDER * float(theta[5])))
        for tau in (lag_s, self._reference_filter_s):
            if tau > 0.0:      # a first-order lag at the output
                size = len(a)
                joined = np.zeros((size + 1, size + 1))
                joined[:size, :size], joined[size, :size], joined[size, size] = a, c / tau, -1.0 / tau
                a, b, c = joined, np.append(b, 0.0), np.append(np.zeros(size), 1.0)
        delay_s = self._delay_s[0] + self._delay_s[1] * float(theta[6])       # below 0 if the sample times are late
        size, length = len(a), self.count + self._apart
        whole = np.zeros((size + 1, size + 1))
        whole[:-1, :-1], whole[:-1, -1] = a, b
        first = min(length, max(0, ceil(delay_s / self.period_s - 1e-9)))     # a fit may try any delay
        state = expm(whole * (first * self.period_s - delay_s))[:, -1]
        out = np.r_[np.zeros(first), _outputs(expm(whole * self.period_s), np.append(c, 0.0), state, length - first)]
        response = out[:self.count] + 1.0 - out[self._apart:]
        return np.asarray(response + self._rounding(response, self.rounding_amplitude(theta)), dtype=np.float64)

    def rounding_amplitude(self, theta: Reals) -> float:
        """Return the amplitude of the first harmonic of the rounding error, as a share of that without noise."""
        most = _ROUNDING_MOST if self.counts else 0.0
        return float(np.clip(_ROUNDING_SD * theta[10], -most, most))

    def _rounding(self, response: Reals, amplitude: float) -> Reals:
        """Return the mean rounding error (N,) of the reported response, as a share of the step.

        A drive rounds speed x, in counts, to Q(x), and Q(x) − x = Σ (−1)^k sin(2πk x)/(πk), with k from 1. Noise of
        standard deviation s makes the mean of harmonic k e^(−2π²k²s²) = a^(k²) times as large. Truncation in place of
        rounding gives a negative a, a set speed between two counts a small one. As set speeds are whole counts, the
        last half count of each response is lost: without this error in the model, the loop seems to settle sooner than
        it does, and I seems too large.
        """
        if not amplitude:
            return np.zeros_like(response)
        error = sum((-1.0) ** k * amplitude ** (k * k) * np.sin(2.0 * np.pi * k * self.counts * response) / (np.pi * k)
                    for k in range(1, _ROUNDING_HARMONICS + 1))
        return np.asarray(error / self.counts, dtype=np.float64)


def _outputs(move: Reals, c: Reals, state: Reals, length: int) -> Reals:
    """Return c Aᵏ x (length,), k from 0, for the matrix A and the state x; `_UNSTABLE` from where it is exceeded.

    The outputs of a block, and the states at the start of all blocks, take the root of ``length`` products each.
    """
    block = max(1, round(sqrt(length)))
    rows, states = [c], [state]
    for _ in range(1, block):
        rows.append(rows[-1] @ move)
    far = np.linalg.matrix_power(move, block)
    for _ in range(1, ceil(length / block)):
        states.append(far @ states[-1])
    out: Reals = np.asarray((np.array(states) @ np.array(rows).T).ravel()[:length], dtype=np.float64)
    beyond = np.flatnonzero(~(np.abs(out) < _UNSTABLE))
    if beyond.size:
        out[beyond[0]:] = _UNSTABLE
    return out


def _moved(part: Range, by: float) -> float:
    """Return the value changed by ``by`` relative standard deviations."""
    if part.value <= 0.0:
        return part.value
    return part.value * exp((part.high - part.low) / (2.0 * NORMAL_95 * part.value) * float(np.clip(by, -6.0, 6.0)))


def _shifted(part: Range, by: float) -> float:
    return part.value + (part.high - part.low) / (2.0 * NORMAL_95) * by
