"""Execution of a design: every run is simulated, its line fitted, and the level means computed."""

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
# Closed form of the error of the paper's estimate, which is low because of the start from standstill.
#
# The fit of T_in on α gives, with T_in = Jα + Bω + T_f,
#
#     Ĵ − J = B cov(ω, α)/var(α) + cov(T_f, α)/var(α) + a term from sampling.
#
# **Viscous.** Over a record 0…T that begins at standstill and ends near the offset E, mean(ωα) = ω(T)²/2T and mean ω ·
# mean α ≈ E·E/T, so cov(ω, α) ≈ −E²/(2T): the acceleration is large while the speed is low.
#
# **Sampling.** α between two samples belongs to the middle of the interval, T_in to its end: T_in is late by Ts/2,
# which adds (Ts/2)·J·mean(α dα/dt) = (Ts/2)·J·(α(T)² − α(0)²)/(2T) ≈ −J Ts (Kp E/J)²/(4T), as the first torque is
# Kp·E.
#
# **var(α)** is that of the sine, (2πf A|G|)²/2, and of the start-up, (1/T)∫α_tr² dt, with G = (Kp s + Ki)/(J s² + (Kp
# + B)s + Ki) at s = j2πf. A step to E makes α_tr = E(Kp s + Ki)/(J s² + (Kp + B)s + Ki), and by Parseval (the
# integral of a second order, (b1² a0 + b0² a2)/(2 a0 a1 a2)) ∫α_tr² dt = E²(Kp² + Ki J)/(2J(Kp + B)).
#
# Not included: the bristle, which is deflected during the start (lowers the estimate further, by a few tenths to 4
# kg·m²), and reversals. In steady state B·Ts/2 remains (see `processing.torque_line`), because cov(ω, α) is zero over
# whole periods.


def closed_form_inertia(run: LoopSettings) -> float | None:
    """Return the approximate result of the fit over all samples; None for references other than a sine."""
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
# The paper's simulated runs, identified by tdhil: whole periods, errors in both signals, no lags.
#
# The paper's fit of T on α gives 0.2 to 1.6 % too little for the same records (`closed_form_inertia` gives the reason).


_SETTLE = 1      # periods; the loop settles within J/Kp, below 1 s


def recording_of(
    settings: LoopSettings, time_s: FloatArray, speed_rad_s: FloatArray, torque_nm: FloatArray
) -> Recording:
    """Return a run of the paper's loop as a recording: samples of one instant, unfiltered, lags declared absent."""
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
    """Line of the paper: all samples, including the start."""
    settled: LineFit | None
    """Line over whole periods only, without the start; None if no period is left."""
    closed_form_kg_m2: float | None
    silent_kg_m2: float | None
    """Line of the paper without any noise; only if noise is a factor."""
    alpha_rad_s2: FloatArray
    torque_nm: FloatArray
    """Points of the scatter, evenly reduced."""
    identification: Identification | None = None
    """Identification by tdhil of the same samples, with lags declared absent; None if the motion is not a sine."""


@dataclass(frozen=True)
class DesignResult:
    """All runs in array order, and the effects of the factors."""

    runs: tuple[DesignRun, ...]
    effects: tuple[LevelMeans, ...]
    simulated_s: float
    wall_s: float

    @property
    def inertias(self) -> tuple[float, ...]:
        """J of every run by the paper's method."""
        return tuple(run.line.inertia_kg_m2 for run in self.runs)

    @property
    def ranks(self) -> tuple[int, ...]:
        """Ranks of the factors, 1 for the largest range."""
        return ranking([effect.range for effect in self.effects])


def run_design(settings: DesignSettings, progress: Callable[[float], None]) -> DesignResult:
    """Simulate all runs together, and a second time without noise if noise is a factor."""
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
        """Run the design, and report the progress."""
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
