"""Carries a design out: every run simulated, its line fitted, its level means taken."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from time import perf_counter

import numpy as np

from tdhil.estimation import Identification, LineFit, Options, identify
from tdhil.recording import Excitation, FloatArray, LagPrior, Recording, Segment
from tdhil.studies.paper.loop import LoopRecord, LoopSettings, changed, reference_of, simulate
from tdhil.studies.paper.orthogonal_design import DesignSettings, LevelMeans, main_effects, ranking
from tdhil.studies.paper.processing import backward_difference, settled_periods, torque_line
from tdhil.studies.study import Progress

# ---------------------------------------------------------------------------------------------------------------------
# Why the paper's estimate is low: the start from rest, in closed form.
#
# The fit of T_in on α gives, with T_in = Jα + Bω + T_f,
#
#     Ĵ − J = B cov(ω, α)/var(α) + cov(T_f, α)/var(α) + a term from sampling.
#
# **Viscous.** Over a record 0…T that begins at rest and ends near the offset E, mean(ωα) = ω(T)²/2T and mean ω · mean
# α ≈ E·E/T, so cov(ω, α) ≈ −E²/(2T): while the speed is still low, the acceleration is large.
#
# **Sampling.** α between two samples belongs to the middle of the interval, T_in to its end: T_in is late by Ts/2,
# which adds (Ts/2)·J·mean(α dα/dt) = (Ts/2)·J·(α(T)² − α(0)²)/(2T) ≈ −J Ts (Kp E/J)²/(4T), as the first torque is
# Kp·E.
#
# **var(α)** is that of the sine, (2πf A|G|)²/2, and of the start-up, (1/T)∫α_tr² dt, with G = (Kp s + Ki)/(J s² + (Kp
# + B)s + Ki) at s = j2πf. A step to E makes α_tr = E(Kp s + Ki)/(J s² + (Kp + B)s + Ki), and by Parseval (the
# integral of a second order, (b1² a0 + b0² a2)/(2 a0 a1 a2)) ∫α_tr² dt = E²(Kp² + Ki J)/(2J(Kp + B)).
#
# Left out: the bristle, which fills while the shaft starts (a few tenths to 4 kg·m², lower still), and reversals.
# What remains in steady state is B·Ts/2 (see `processing.torque_line`): whole periods make cov(ω, α) zero.


def closed_form_inertia(run: LoopSettings) -> float | None:
    """Return approximately what the fit over all samples gives; None for references other than a sine."""
    if run.signal != "sine":
        return None
    inertia, viscous, offset, duration = run.inertia_kg_m2, run.viscous_nm_s_rad, run.offset_rad_s, run.duration_s
    kp, ki = run.kp_nm_s_rad, run.ki_nm_rad
    if kp + viscous == 0.0:
        return None
    s = 2j * pi * run.frequency_hz
    followed = abs((kp * s + ki) / (inertia * s * s + (kp + viscous) * s + ki))
    sine = 0.5 * abs(s * run.amplitude_rad_s * followed) ** 2
    start = offset**2 * (kp**2 + ki * inertia) / (2.0 * inertia * (kp + viscous)) / duration
    speed = viscous * offset**2 / (2.0 * duration)
    sampling = inertia * run.sample_period_s * (kp * offset / inertia) ** 2 / (4.0 * duration)
    return inertia - (speed + sampling) / (sine + start)


# ---------------------------------------------------------------------------------------------------------------------
# The paper's simulated runs, identified as this tool does it: whole periods, errors in both signals, no lags.
#
# The paper's fit of T on α finds 0.2 to 1.6 % too little in these very records (`closed_form_inertia` says why).


_SETTLE = 1      # periods: the loop settles within J/Kp, below a second


def recording_of(
    settings: LoopSettings, time_s: FloatArray, speed_rad_s: FloatArray, torque_nm: FloatArray
) -> Recording:
    """A run of the paper's loop as a recording: samples of one instant, unfiltered, lags declared absent."""
    period = 1.0 / settings.frequency_hz
    whole = math.floor(float(time_s[-1]) / period + 1e-9)
    segment = Segment(
        start_s=0.0, end_s=whole * period, period_s=period, settle_periods=_SETTLE, offset_rad_s=settings.offset_rad_s,
        lines_hz=(settings.frequency_hz,), amplitudes_rad_s=(settings.amplitude_rad_s,), phases_rad=(0.0,),
    )
    return Recording(
        time_s=time_s,
        speed_rad_s=speed_rad_s,
        torque_nm=torque_nm,
        fresh=np.ones(len(time_s), dtype=np.bool_),
        limited=np.zeros(len(time_s), dtype=np.bool_),
        excitation=Excitation("sine", "speed", (segment,)),
        lag_prior=LagPrior(0.0, 0.0, 0.0, 0.0, "the simulation", skew_sd_s=1e-4),
        simulated=True,
    )


def identified(
    settings: LoopSettings, time_s: FloatArray, speed_rad_s: FloatArray, torque_nm: FloatArray
) -> Identification | None:
    """Return tdhil's own identification of a run; None for motions that are not a sine."""
    if settings.signal != "sine":
        return None
    return identify(recording_of(settings, time_s, speed_rad_s, torque_nm), Options())


# ---------------------------------------------------------------------------------------------------------------------


_POINTS = 1500


@dataclass(frozen=True)
class DesignRun:
    """One run of an array, identified."""

    factors: dict[str, float]
    settings: LoopSettings
    line: LineFit
    """The paper's: all samples, start-up included."""
    settled: LineFit | None
    """Whole periods only, the start-up dropped; None where no period is left."""
    closed_form_kg_m2: float | None
    silent_kg_m2: float | None
    """The paper's line with no noise at all; only where noise is a factor."""
    alpha_rad_s2: FloatArray
    torque_nm: FloatArray
    """Points of the scatter, evenly thinned out."""
    identification: Identification | None = None
    """This tool's own, of the same samples, lags declared absent; None where the motion is no sine."""


@dataclass(frozen=True)
class DesignResult:
    """All runs in array order, and what the factors do."""

    runs: tuple[DesignRun, ...]
    effects: tuple[LevelMeans, ...]
    simulated_s: float
    wall_s: float

    @property
    def inertias(self) -> tuple[float, ...]:
        """J of every run, as the paper identifies it."""
        return tuple(run.line.inertia_kg_m2 for run in self.runs)

    @property
    def ranks(self) -> tuple[int, ...]:
        """Return the ranks of the factors, 1 for the largest range."""
        return ranking([effect.range for effect in self.effects])


def run_design(settings: DesignSettings, progress: Callable[[float], None]) -> DesignResult:
    """Simulates all runs side by side, and each a second time without noise if noise is a factor."""
    runs = settings.runs()
    noisy = "noise_power_nm2_s" in {factor.field for factor in settings.factors}
    twins = [changed(run, noise_power_nm2_s=0.0) for run in runs] if noisy else []
    begun = perf_counter()
    record = simulate(runs + twins, progress)
    wall_s = perf_counter() - begun
    done = tuple(
        _identified(record, number, run, settings.values(number), number + len(runs) if noisy else None)
        for number, run in enumerate(runs)
    )
    effects = main_effects(settings.rows, [run.line.inertia_kg_m2 for run in done])
    return DesignResult(done, effects, record.simulated_s, wall_s)


class OverDesign:
    """Study over all runs of a design: its name, its settings, and the runs."""

    def __init__(self, name: str, title: str, model: type[DesignSettings]) -> None:
        self.name = name
        self.title = title
        self.settings_model = model

    def carried_out(self, settings: DesignSettings, progress: Progress) -> DesignResult:
        """Every run, with a word on how far they are."""
        return run_design(settings, lambda share: progress(share, f"{self.name}: {len(settings.rows)} runs"))


def _identified(
    record: LoopRecord, number: int, run: LoopSettings, factors: dict[str, float], twin: int | None
) -> DesignRun:
    time, _, speed, torque = record.of(number)
    thin = slice(None, None, max(1, len(time) // _POINTS))
    return DesignRun(
        factors, run, torque_line(time, speed, torque), _settled(record, number, run), closed_form_inertia(run),
        None if twin is None else _line(record, twin, slice(None)).inertia_kg_m2,
        backward_difference(time, speed)[thin].copy(), torque[1:][thin].copy(),
        identified(run, time, speed, torque),
    )


def _settled(record: LoopRecord, number: int, run: LoopSettings) -> LineFit | None:
    period_s = reference_of(run).period_s
    window = None if period_s is None else settled_periods(run.steps, run.sample_period_s, period_s)
    return None if window is None else _line(record, number, window)


def _line(record: LoopRecord, number: int, samples: slice) -> LineFit:
    time, _, speed, torque = record.of(number, samples)
    return torque_line(time, speed, torque)
