"""Friction from mean torque at mean operating points (levels). Reporting lags do not change such means.

Momentum balance over a stretch of time (means over the stretch, a = its net change of speed per second):

    T̄ = B ω̄ + T_c sgn ω̄ + J a − mean disturbance,

This holds with any filters in the reports, because they do not change a mean. Without J a, the error of one period is
its mean disturbance, nearly independent from period to period. Its scatter, pooled over the segments, gives the
variance of every level. B is then the slope of a weighted straight line, as a function of the unknown J: B(J) = slope −
slope_per_inertia·J. The second term is small: the net change of speed nearly vanishes over a segment.

The levels are measured at different times. If the periods show that friction drifts at c N·m/s (`warming`), T̄ − c t̄
replaces T̄. With s, the slope of the levels' times over their speeds, the uncertainty of c adds to that of B: var B +=
s² var c.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.samples import Samples, Stretch
from tdhil.estimation.spectrum import PeriodLines
from tdhil.recording import FloatArray, Level

# ---------------------------------------------------------------------------------------------------------------------
# Friction that changes during the run, because bearings and oil warm up, or because the torque's zero drifts.
#
# The constraint of B takes mean torque at two mean speeds as friction at two speeds. The torques are also measured at
# two times. A friction that loses c N·m a second adds an error of c D/Δω to B, with D the time between the levels, and
# from B to J. Within a segment the mean speed is constant, so the trend of the periods' mean torque gives c without any
# effect of the lags. With σ² the variance of one period's mean and t_p its time within the segment,
#
#     ĉ = Σ (t_p − t̄) y_p / Σ (t_p − t̄)²,    sd(ĉ) = σ / √Σ (t_p − t̄)².
#
# σ² is the scatter after each segment's own trend is removed, on Σ (P − 2) degrees of freedom: a warming that slows
# down must not count as scatter.
#
# A correction in every run would make B two to three times less certain in runs without a trend. A correction only
# beyond a sharp limit would make B wrong just below the limit. Therefore a share w of ĉ is subtracted: none at 2 sd,
# all of it at 4 sd. The remaining uncertainty goes into the variance: w² sd(ĉ)² + w (1 − w) ĉ², the mean square about w
# ĉ of a mixture of "no drift" and "ĉ ± sd". Below 2 sd nothing changes: a drift that the run cannot show is not
# corrected. Friction warms along an exponential curve, so the segments' own trends c_s differ. For time constants down
# to half of D, the straight line misses the step between two segments by at most about a seventh of (c₁ − c₂) D.


_NONE, _ALL = 2.0, 4.0       # normal deviations of the trend at which none, and all, of it is subtracted
_TOLD = 3.5                  # normal deviations of the trend from which a warning is given
_BEND = 0.15                 # error of the straight line over (difference of the trends × time between segments)


@dataclass(frozen=True)
class FrictionDrift:
    """Trend of friction: ``rate`` (N·m/s) as corrected, its ``variance``, ``own`` (S,) corrected rate of each segment.

    ``bend`` (N·m/s): sd due to the different trends of the segments. ``clear``: the trend is large enough for a
    warning.
    """

    rate: float = 0.0
    variance: float = 0.0
    own: tuple[float, ...] = ()
    bend: float = 0.0
    clear: bool = False


def warming_of(times: list[FloatArray], torques: list[FloatArray]) -> FrictionDrift:
    """Return the drift. ``times``: middles of each segment's periods (P,), s. ``torques``: mean torque less J·dω/dt
    (P,), N·m.
    """
    from scipy.special import ndtri, stdtr

    none = FrictionDrift(own=(0.0,) * len(times))
    dof = sum(max(len(time) - 2, 0) for time in times)
    centred = [(time - time.mean(), torque - torque.mean()) for time, torque in zip(times, torques, strict=True)]
    lever = sum(float(t @ t) for t, _ in centred)
    if dof < 2 or lever <= 0.0:
        return none
    trend = sum(float(t @ y) for t, y in centred) / lever
    own = [float(t @ y) / power if (power := float(t @ t)) > 0.0 else trend for t, y in centred]
    variance = sum(float(np.sum((y - c * t) ** 2)) for c, (t, y) in zip(own, centred, strict=True)) / dof
    sd = float(np.sqrt(variance / lever))
    # standard deviations of a normal distribution with the same probability as this trend by Student's t
    deviations = 0.0 if sd <= 0.0 and trend == 0.0 else np.inf
    if sd > 0.0 and (tail := float(stdtr(dof, -abs(trend) / sd))) > 0.0:
        deviations = float(-ndtri(tail))
    share = min(max((deviations - _NONE) / (_ALL - _NONE), 0.0), 1.0)
    if share == 0.0:
        return none
    spread = max(own) - min(own)
    unsure = sum(variance / power for t, _ in centred if (power := float(t @ t)) > 0.0)
    return FrictionDrift(
        rate=share * trend,
        variance=share**2 * sd**2 + share * (1.0 - share) * trend**2,
        own=tuple(share * c for c in own),
        bend=share * _BEND * float(np.sqrt(max(spread**2 - unsure, 0.0))),
        clear=deviations >= _TOLD,
    )


def warming_warning(warming: FrictionDrift) -> tuple[str, ...]:
    """Return the warning about a trend; empty without a clear one."""
    if not warming.clear:
        return ()
    how = "falls" if warming.rate < 0.0 else "rises"
    return (CodedText(
        f"drifting: the torque at steady speed {how} by {abs(60.0 * warming.rate):.2g} N·m a minute (warming "
        "friction, or a drifting torque zero). The interval allows for this. Warm the machine up first",
        MessageCode.FRICTION_DRIFTS,
    ),)


# ---------------------------------------------------------------------------------------------------------------------

_LEAST_SPAN = 0.03    # least difference of mean speeds, as a share of the speed, for a slope


@dataclass(frozen=True)
class Levels:
    """N mean operating points: speed (rad/s), torque (N·m), net acceleration (rad/s²), duration (s); (N,) each.

    ``density`` is the disturbance's mean square times duration, (N·m)²·s: the variance of a level is density/duration.
    ``dof``: degrees of freedom of the density. ``torque`` is corrected for the drift of friction to the middle of the
    run (``warming``); ``time`` (N,): the levels' middles, s.
    """

    speed: FloatArray
    torque: FloatArray
    drift: FloatArray
    duration: FloatArray
    density: float
    dof: float
    time: FloatArray = field(default_factory=lambda: np.zeros(0))
    warming: FrictionDrift = field(default_factory=FrictionDrift)

    @property
    def direction(self) -> float:
        """Sign of rotation. Coulomb friction is constant only if all levels have the same sign."""
        return float(np.sign(np.mean(self.speed)))

    @property
    def weights(self) -> FloatArray:
        return self.duration / np.sum(self.duration)


@dataclass(frozen=True)
class ViscousConstraint:
    """B = slope − slope_per_inertia·J, with its standard deviation sd and degrees of freedom."""

    slope: float
    slope_per_inertia: float
    sd: float
    dof: float


def measure_levels(
    stretches: tuple[Stretch, ...],
    fits: tuple[PeriodLines, ...],
    samples: Samples,
    steady: tuple[Level, ...],
    rough_inertia: float,
) -> Levels:
    """Return the levels of the segments. The run's steady stretches are added only if the segments have one mean
    speed.
    """
    rows: list[tuple[float, ...]] = []
    errors: list[FloatArray] = []
    times: list[FloatArray] = []
    length = 1.0
    for stretch, fit in zip(stretches, fits, strict=True):
        drift = fit.drift
        errors.append(np.column_stack([fit.speed_mean, fit.torque_mean - rough_inertia * drift]))
        times.append(stretch.segment.start_s + stretch.segment.period_s * (np.array(stretch.index) + 0.5))
        if len(drift):
            length = stretch.segment.period_s
            means = (fit.speed_mean.mean(), fit.torque_mean.mean(), drift.mean())
            rows.append((*means, length * len(drift), times[-1].mean()))
    # the drift from the segments that have periods; the other segments get the mean rate
    fixed = [number for number, error in enumerate(errors) if len(error)]
    warming = warming_of([times[number] for number in fixed], [errors[number][:, 1] for number in fixed])
    own = dict(zip(fixed, warming.own, strict=True))
    warming = replace(warming, own=tuple(own.get(number, warming.rate) for number in range(len(errors))))
    if not _span_enough(rows):
        rows += [row for level in steady if (row := _steady_row(samples.between(level.start_s, level.end_s)))]
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    time = table[:, 4]
    if warming.rate != 0.0:
        table[:, 1] -= warming.rate * (time - _mean(time, table[:, 3]))
    slope = _slope(table[:, 0], table[:, 1] - rough_inertia * table[:, 2], table[:, 3]) if _span_enough(rows) else 0.0
    # the trend of a segment costs one degree of freedom if it is subtracted from its periods
    costs = 1 + (warming.rate != 0.0)
    dof = float(sum(max(len(error) - costs, 0) for error in errors))
    scatter = 0.0
    for error, when, rate in zip(errors, times, warming.own, strict=True):
        if len(error):
            left = error[:, 1] - slope * error[:, 0] - rate * when
            scatter += float(np.sum((left - left.mean()) ** 2))
    density = length * scatter / dof if dof > 0.0 else 0.0
    return Levels(table[:, 0], table[:, 1], table[:, 2], table[:, 3], density, dof, time, warming)


def tie_viscous(levels: Levels) -> ViscousConstraint | None:
    """Return the constraint on B from the levels; None if they do not span different speeds in one direction."""
    if len(levels.speed) < 2 or not _span_enough(list(zip(levels.speed, levels.torque, strict=True))):
        return None
    if levels.dof < 1.0 or np.any(np.sign(levels.speed) != levels.direction):
        return None
    weights = levels.weights
    centred = levels.speed - float(weights @ levels.speed)
    lever = float(np.sum(levels.duration * centred**2))
    variance = levels.density / lever
    if levels.warming.rate != 0.0:
        across = _slope(levels.speed, levels.time, levels.duration)
        variance += across**2 * (levels.warming.variance + levels.warming.bend**2)
    sd = float(np.sqrt(variance))
    slope = _slope(levels.speed, levels.torque, levels.duration)
    floor = 1e-9 * float(np.max(np.abs(levels.torque))) / float(np.max(np.abs(levels.speed)))
    return ViscousConstraint(slope, _slope(levels.speed, levels.drift, levels.duration), max(sd, floor), levels.dof)


def coulomb_level(levels: Levels, inertia: float, viscous: float, viscous_sd: float) -> tuple[float, float]:
    """Return T_c along the rotation (constant load included) and its standard deviation, N·m."""
    weights = levels.weights
    speed = float(weights @ levels.speed)
    torque = float(weights @ (levels.torque - inertia * levels.drift))
    variance = levels.density / float(np.sum(levels.duration)) + (speed * viscous_sd) ** 2
    return levels.direction * (torque - viscous * speed), float(np.sqrt(variance))


def slope_over_speed(levels: Levels, values: FloatArray) -> float:
    """Return the slope of ``values`` (N,) over the levels' speed, with the weights that B has for the torques."""
    return _slope(levels.speed, values, levels.duration)


def _steady_row(samples: Samples) -> tuple[float, ...] | None:
    """Return a level from a stretch of steady speed: means, net acceleration, duration and middle."""
    if len(samples) < 16:
        return None
    time = samples.time_s
    part = max(4, len(samples) // 8)
    length = float(time[-1] - time[0])
    rise = float(np.mean(samples.speed_rad_s[-part:]) - np.mean(samples.speed_rad_s[:part]))
    between = float(np.mean(time[-part:]) - np.mean(time[:part]))
    middle = 0.5 * float(time[0] + time[-1])
    return float(np.mean(samples.speed_rad_s)), float(np.mean(samples.torque_nm)), rise / between, length, middle


def _span_enough(rows: Sequence[tuple[float, ...]]) -> bool:
    if len(rows) < 2:
        return False
    speeds = np.array([row[0] for row in rows])
    return bool(np.ptp(speeds) > _LEAST_SPAN * np.max(np.abs(speeds)))


def _mean(x: FloatArray, weight: FloatArray) -> float:
    return float(np.sum(weight * x) / np.sum(weight)) if len(x) else 0.0


def _slope(x: FloatArray, y: FloatArray, weight: FloatArray) -> float:
    centred = x - np.sum(weight * x) / np.sum(weight)
    return float(np.sum(weight * centred * y) / np.sum(weight * centred**2))
