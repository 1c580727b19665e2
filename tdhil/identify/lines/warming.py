"""Friction that changes during the run: as bearings and oil warm up, or as the torque's zero wanders.

The tie of B to the levels takes mean torque at two mean speeds for friction at two speeds. They are also torque at two
times: a friction that loses c N·m a second puts c D/Δω into B, with D the time between the levels, and from there into
J. Within a segment the speed stays the same on the mean, so that the trend of the periods' mean torque tells c, free of
every lag. With σ² the variance of one period's mean and t_p its time within the segment,

    ĉ = Σ (t_p − t̄) y_p / Σ (t_p − t̄)²,    sd(ĉ) = σ / √Σ (t_p − t̄)²,
with σ² from what is left once every segment has its own trend (a warming that slows down must not pass for scatter), on
Σ (P − 2) degrees of freedom.

To allow for c always would make B two to three times less sure in runs that show no trend, to allow for it only beyond
a sharp limit would make it wrong just within. So a share w of ĉ is taken off, from none at 2 sd to all of it at 4, and
what a share leaves open goes into the variance: w² sd(ĉ)² + w (1 − w) ĉ², the mean square about w ĉ of a mixture, of
"no drift" and "ĉ ± sd". Below 2 sd nothing is changed: a drift that the run can't show is not allowed for.
Friction warms along an exponential: by the segments' own trends c_s it bends, and the straight line misses the step
between two segments by at most about a seventh of (c₁ − c₂) D for time constants down to half of D.
"""

from dataclasses import dataclass

import numpy as np

from tdhil.recording.recording import FloatArray

_NONE, _ALL = 2.0, 4.0       # normal deviations of the trend at which none, and all, of it is believed
_TOLD = 3.5                  # at which the user is told
_BEND = 0.15                 # of the trends' difference times the time between segments


@dataclass(frozen=True)
class Warming:
    """Trend of friction: ``rate`` (N·m/s) as believed, its ``variance``, ``own`` (S,) per segment as believed.

    ``bend`` (N·m/s): sd of what the segments' different trends leave open; ``clear``: worth a warning.
    """

    rate: float = 0.0
    variance: float = 0.0
    own: tuple[float, ...] = ()
    bend: float = 0.0
    clear: bool = False


def warming_of(times: list[FloatArray], torques: list[FloatArray]) -> Warming:
    """Of S segments' periods: middle (P,) in s and mean torque less J times its acceleration, (P,) N·m."""
    none = Warming(own=(0.0,) * len(times))
    dof = sum(max(len(time) - 2, 0) for time in times)
    centred = [(time - time.mean(), torque - torque.mean()) for time, torque in zip(times, torques, strict=True)]
    lever = sum(float(t @ t) for t, _ in centred)
    if dof < 2 or lever <= 0.0:
        return none
    trend = sum(float(t @ y) for t, y in centred) / lever
    own = [float(t @ y) / power if (power := float(t @ t)) > 0.0 else trend for t, y in centred]
    variance = sum(float(np.sum((y - c * t) ** 2)) for c, (t, y) in zip(own, centred, strict=True)) / dof
    sd = float(np.sqrt(variance / lever))
    deviations = _deviations(trend, sd, dof)
    share = min(max((deviations - _NONE) / (_ALL - _NONE), 0.0), 1.0)
    if share == 0.0:
        return none
    spread = max(own) - min(own)
    unsure = sum(variance / power for t, _ in centred if (power := float(t @ t)) > 0.0)
    return Warming(
        rate=share * trend,
        variance=share**2 * sd**2 + share * (1.0 - share) * trend**2,
        own=tuple(share * c for c in own),
        bend=share * _BEND * float(np.sqrt(max(spread**2 - unsure, 0.0))),
        clear=deviations >= _TOLD,
    )


def warming_warning(warming: Warming) -> tuple[str, ...]:
    """What a user should know; empty where there is no clear trend."""
    if not warming.clear:
        return ()
    how = "falls" if warming.rate < 0.0 else "rises"
    return (
        f"drifting: at steady speed the torque {how} by {abs(60.0 * warming.rate):.2g} N·m a minute (friction that "
        "warms, or a wandering torque zero), which is allowed for; warm the machine up first",
    )


def _deviations(trend: float, sd: float, dof: int) -> float:
    """How many standard deviations of a normal distribution are as unlikely as this trend is by Student's t."""
    from scipy.special import ndtri, stdtr

    if sd <= 0.0:
        return 0.0 if trend == 0.0 else np.inf
    tail = float(stdtr(dof, -abs(trend) / sd))
    return float(-ndtri(tail)) if tail > 0.0 else np.inf
