r"""The paper's closed loop (figure 8), simulated for all runs together.

::

    e = w_r − ω                         T_in = Kp e + Ki ∫e dt          (equations 9 and 10 of section 3.2.2)
    J dω/dt = T_in + d − T_f − B ω      dz/dt = ω (1 − (σ z/F_c) sgn ω), T_f = σ z          (equations 4 and 6)

d is band-limited white torque, held over a sample: a disturbance of the shaft that T_in does not contain. The start is
at standstill: speed, bristle and integral are zero, so T_in begins with Kp·w_r(0).

The controller is continuous. The torque is constant over a step h of the plant, so the step is computed twice (Heun's
method): with the torque at the beginning, which predicts e, and again with the mean of that torque and the predicted
one. The integral is trapezoidal. Both errors are of order h²: at Kp h/J = 0.017 (15000 N·m·s/rad, 1 ms, 900 kg·m²)
about 1e-4 of the fastest transient, and at most 0.04 kg·m² in the J of any run of Tables 6 and 7 (a test halves h).

A sample contains T_in and ω of one instant. The paper's α between two samples (equation 16) is paired with the torque
at the end of the interval, see `processing`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi
from typing import Annotated, Literal, Protocol

import numpy as np
from pydantic import Field, model_validator

from profiles import DataModel, Finding, NonNegative, Positive, refuse_if
from sim_bus.plant import LARGEST_BRISTLE_STEP, SPEED, FixedStep, Shafts, white_torque
from tdhil.recording import FloatArray

# ---------------------------------------------------------------------------------------------------------------------
# Settings of one run of the paper's closed loop, and their names for factors and `--set`.
#
# If Table 1 of the paper gives one value, it is the default. The other defaults are inferred: friction and duration
# from Table 6, P and I from the two gains of section 3.4.3 (see `figures.SignalSettings`). They are consistent with the
# published figures, but not confirmed by them.


SamplePeriod = Annotated[float, Field(gt=0.0, le=0.1)]

MAX_SAMPLES = 2_000_000
_MAX_GAIN = 0.5      # largest share of an error that P may remove in one sample; above it, samples are too coarse
_SHORTER = "take a shorter sample_period_s"


class LoopSettings(DataModel):
    """One run: plant (equations 4 and 6), PI (equations 9, 10), reference (equation 8), record."""

    inertia_kg_m2: Positive = 900.0
    viscous_nm_s_rad: NonNegative = 74.3
    coulomb_nm: NonNegative = 82.4
    """Coulomb torque, the limit of Dahl's bristle, N·m (the paper prints N/m)."""
    dahl_stiffness_nm_rad: Positive = 5000.0
    """Stiffness of Dahl's bristle, N·m/rad (the paper prints N/m)."""
    friction: Literal["dahl", "coulomb"] = "dahl"
    kp_nm_s_rad: NonNegative = 15000.0
    ki_nm_rad: NonNegative = 9000.0
    frequency_hz: Positive = 1.0
    amplitude_rad_s: Positive = 1.0
    offset_rad_s: float = 2.0 * pi
    signal: Literal["sine", "step", "chirp", "multisine"] = "sine"
    chirp_end_hz: Positive = 2.0
    """End frequency of a chirp that begins at `frequency_hz`, Hz."""
    noise_power_nm2_s: NonNegative = 1.0e-4
    """Spectral density of the torque disturbance, (N·m)²·s (the paper prints (N·m)²)."""
    duration_s: Positive = 10.0
    sample_period_s: SamplePeriod = 0.001
    seed: Annotated[int, Field(ge=0)] = 1

    @property
    def steps(self) -> int:
        """Number of samples after the first."""
        return round(self.duration_s / self.sample_period_s)

    @model_validator(mode="after")
    def _simulable(self) -> LoopSettings:
        findings: list[Finding] = []
        if not 10 <= self.steps <= MAX_SAMPLES:
            findings.append(("duration_s", f"gives {self.steps} samples; 10 to {MAX_SAMPLES} are possible"))
        if self.frequency_hz * self.sample_period_s > 0.1:
            findings.append(("frequency_hz", "fewer than ten samples a period: " + _SHORTER))
        share = self.kp_nm_s_rad * self.sample_period_s / self.inertia_kg_m2
        if share > _MAX_GAIN:
            findings.append(("kp_nm_s_rad", f"Kp·Ts/J = {share:.2g} is above {_MAX_GAIN}: {_SHORTER}"))
        stiff = self.dahl_stiffness_nm_rad * self.sample_period_s**2 / self.inertia_kg_m2
        if self.friction == "dahl" and stiff > LARGEST_BRISTLE_STEP:
            findings.append(
                ("dahl_stiffness_nm_rad", f"σ·Ts²/J = {stiff:.2g} is above {LARGEST_BRISTLE_STEP}: {_SHORTER}")
            )
        refuse_if(findings)
        return self


FACTORS = (
    "inertia_kg_m2", "viscous_nm_s_rad", "coulomb_nm", "dahl_stiffness_nm_rad", "kp_nm_s_rad", "ki_nm_rad",
    "frequency_hz", "amplitude_rad_s", "offset_rad_s", "noise_power_nm2_s",
)
"""Values that may differ between the runs of one design."""

SYMBOLS = {
    "J": "inertia_kg_m2", "B": "viscous_nm_s_rad", "Fc": "coulomb_nm", "sigma": "dahl_stiffness_nm_rad",
    "Kp": "kp_nm_s_rad", "Ki": "ki_nm_rad", "f": "frequency_hz", "A": "amplitude_rad_s", "offset": "offset_rad_s",
    "P_noise": "noise_power_nm2_s", "T": "duration_s", "Ts": "sample_period_s",
}
"""Short names, as in formulas, for `--set` and for factors."""

LABELS = {
    "inertia_kg_m2": "J, kg·m²", "viscous_nm_s_rad": "B, N·m·s/rad", "coulomb_nm": "F$_c$, N·m",
    "dahl_stiffness_nm_rad": "σ, N·m/rad", "kp_nm_s_rad": "K$_p$, N·m·s/rad", "ki_nm_rad": "K$_i$, N·m/rad",
    "frequency_hz": "f, Hz", "amplitude_rad_s": "amplitude, rad/s", "offset_rad_s": "offset, rad/s",
    "noise_power_nm2_s": "noise, (N·m)²·s",
}
"""Labels for the axes of plots."""


def full_name(name: str) -> str:
    """Return the field of a symbol, or the name itself."""
    return SYMBOLS.get(name, name)


def changed(settings: LoopSettings, **values: object) -> LoopSettings:
    """Return one run with some values replaced, validated again; fields of a subclass are dropped."""
    kept = {name: getattr(settings, name) for name in LoopSettings.model_fields}
    return LoopSettings.model_validate(kept | values)


# ---------------------------------------------------------------------------------------------------------------------
# References of the loop, in rad/s: sine with offset (equation 8), step (equation 9), chirp, multisine.


class Reference(Protocol):
    """Reference speed for every time; ``period_s`` is None without a period."""

    @property
    def period_s(self) -> float | None: ...

    def at(self, time_s: FloatArray) -> FloatArray: ...


@dataclass(frozen=True)
class SineReference:
    """w(t) = A sin(2πf t) + offset (equation 8; the paper's w_t is 2πf)."""

    offset_rad_s: float
    amplitude_rad_s: float
    frequency_hz: float

    @property
    def period_s(self) -> float:
        return 1.0 / self.frequency_hz

    def at(self, time_s: FloatArray) -> FloatArray:
        return self.offset_rad_s + self.amplitude_rad_s * np.sin(2.0 * pi * self.frequency_hz * time_s)


@dataclass(frozen=True)
class StepReference:
    """w(t) = A0 before, A1 from ``at_s`` on (equation 9, whose step is at zero)."""

    before_rad_s: float
    after_rad_s: float
    at_s: float
    period_s: None = None

    def at(self, time_s: FloatArray) -> FloatArray:
        return np.where(time_s < self.at_s, self.before_rad_s, self.after_rad_s)


@dataclass(frozen=True)
class ChirpReference:
    """w(t) = offset + A sin(2π(f0 t + (f1 − f0) t²/(2T))): the frequency rises linearly from f0 to f1 within T."""

    offset_rad_s: float
    amplitude_rad_s: float
    begin_hz: float
    end_hz: float
    duration_s: float
    period_s: None = None

    def at(self, time_s: FloatArray) -> FloatArray:
        rate = (self.end_hz - self.begin_hz) / (2.0 * self.duration_s)
        cycles = self.begin_hz * time_s + rate * time_s**2
        return self.offset_rad_s + self.amplitude_rad_s * np.sin(2.0 * pi * cycles)


@dataclass(frozen=True)
class MultisineReference:
    """w(t) = offset + (A/M) Σ sin(2πk f t + φ_k), k = 1…n, with Schroeder's phases φ_k = −π k(k−1)/n for a low crest.

    M is the sum's own peak, so that the speed stays within offset ± A. (M. R. Schroeder, IEEE Trans. Inf. Theory 16,
    1970, p. 85.)
    """

    offset_rad_s: float
    amplitude_rad_s: float
    frequency_hz: float
    lines: int = 4

    @property
    def period_s(self) -> float:
        return 1.0 / self.frequency_hz

    def at(self, time_s: FloatArray) -> FloatArray:
        fine = np.arange(4096 * self.lines) / (4096 * self.lines * self.frequency_hz)
        return self.offset_rad_s + self.amplitude_rad_s / float(np.abs(self._sum(fine)).max()) * self._sum(time_s)

    def _sum(self, time_s: FloatArray) -> FloatArray:
        total = np.zeros_like(time_s)
        for line in range(1, self.lines + 1):
            total += np.sin(2.0 * pi * line * self.frequency_hz * time_s - pi * line * (line - 1) / self.lines)
        return total


def reference_of(run: LoopSettings) -> Reference:
    """Return the reference of ``run``. The step goes from the offset to offset + amplitude at a quarter of the period
    (3.4.3).
    """
    if run.signal == "step":
        return StepReference(run.offset_rad_s, run.offset_rad_s + run.amplitude_rad_s, 0.25 / run.frequency_hz)
    if run.signal == "chirp":
        return ChirpReference(run.offset_rad_s, run.amplitude_rad_s, run.frequency_hz, run.chirp_end_hz, run.duration_s)
    if run.signal == "multisine":
        return MultisineReference(run.offset_rad_s, run.amplitude_rad_s, run.frequency_hz)
    return SineReference(run.offset_rad_s, run.amplitude_rad_s, run.frequency_hz)


# ---------------------------------------------------------------------------------------------------------------------


_PROGRESS_STEPS = 500


@dataclass(frozen=True)
class LoopRecord:
    """Logged samples: one row per sample (the first at t = 0), one column per run."""

    time_s: FloatArray
    reference_rad_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray

    @property
    def simulated_s(self) -> float:
        """Plant time of all runs together, s."""
        return float(self.time_s[-1].sum())

    def of(self, run: int, samples: slice = slice(None)) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return (time, reference, speed, torque) of one run."""
        return (
            self.time_s[samples, run], self.reference_rad_s[samples, run], self.speed_rad_s[samples, run],
            self.torque_nm[samples, run],
        )


def simulate(
    runs: Sequence[LoopSettings],
    progress: Callable[[float], None] = lambda share: None,
    references: Sequence[Reference] | None = None,
) -> LoopRecord:
    """Simulate ``runs`` together; they need the same number of samples, not the same duration.

    The noise comes from the first run's seed.
    """
    steps = runs[0].steps
    if any(run.steps != steps for run in runs):
        raise ValueError("runs of one batch must have the same number of samples")
    shafts = Shafts.of(
        [run.inertia_kg_m2 for run in runs], [run.viscous_nm_s_rad for run in runs], [run.coulomb_nm for run in runs],
        [run.dahl_stiffness_nm_rad for run in runs], [run.friction == "dahl" for run in runs],
    )
    kp, ki, period, power = (
        np.array([getattr(run, name) for run in runs])
        for name in ("kp_nm_s_rad", "ki_nm_rad", "sample_period_s", "noise_power_nm2_s")
    )
    time = np.arange(steps + 1)[:, np.newaxis] * period
    asked = np.empty_like(time)
    for column, reference in enumerate(references or [reference_of(run) for run in runs]):
        asked[:, column] = reference.at(time[:, column])
    speed, torque = np.zeros_like(time), np.zeros_like(time)
    disturbance = white_torque(power, period, steps, np.random.default_rng(runs[0].seed))
    plant, state, half = FixedStep(shafts, period), shafts.at_rest(), 0.5 * period
    integral = np.zeros(len(runs))
    error = asked[0] - state[SPEED]
    torque[0] = kp * error
    for now in range(steps):
        drive = torque[now]
        guess = asked[now + 1] - plant.advance(state, drive + disturbance[now])[SPEED]
        ahead = kp * guess + ki * (integral + half * (error + guess))
        state = plant.advance(state, 0.5 * (drive + ahead) + disturbance[now])
        later = asked[now + 1] - state[SPEED]
        integral = integral + half * (error + later)
        error = later
        speed[now + 1] = state[SPEED]
        torque[now + 1] = kp * error + ki * integral
        if now % _PROGRESS_STEPS == 0:
            progress(now / steps)
    return LoopRecord(time, asked, speed, torque)
