"""Rough inertia from one change of speed, fast enough to plan the excitation while the shaft turns.

Momentum balance from one steady level to the next, over the time between the levels' middles:

    J (ω_b − ω_a) = ∫ (T − T_c − B ω) dt.

In the integral from steady state to steady state, a reported signal with lag τ loses τ times its own change: T_rep
loses τ_T (T_b − T_a) = τ_T B Δω, B ω_rep loses τ_w B Δω. Lags of any kind therefore change J by B (τ_w − τ_T), a few
percent at most. A regression of torque on acceleration would be wrong by the ratio of the lags. Noise averages out in
the integral. The remaining error is the scatter of the levels, which gives the friction during the ramp.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tdhil.recording import FloatArray, Level

_LEAST_REL = 0.05       # least relative uncertainty: unknown lags, nonlinear friction
_MOST_REL = 0.9           # largest relative uncertainty: the inertia stays positive
_BLOCK_S = 1.0          # s; means over blocks of this length are taken as independent


@dataclass(frozen=True)
class RoughFriction:
    """Friction T = viscous·ω + coulomb at steady speed, and the sd of a torque from this line, N·m."""

    viscous_nm_s_rad: float
    coulomb_nm: float
    level_sd_nm: float

    def opposing(self, speed_rad_s: float) -> "RoughFriction":
        """Return friction with the same torque at this speed, whose two parts both oppose a forward rotation.

        A line through friction that falls with speed, or through two levels disturbed by an oscillating string, has a
        part that drives the shaft. If only that part were removed, the other part would be too large.
        """
        torque_nm = max(0.0, self.coulomb_nm + self.viscous_nm_s_rad * speed_rad_s)
        if self.viscous_nm_s_rad < 0.0:
            return RoughFriction(0.0, torque_nm, self.level_sd_nm)
        if self.coulomb_nm < 0.0:
            return RoughFriction(torque_nm / speed_rad_s, 0.0, self.level_sd_nm)
        return self


@dataclass(frozen=True)
class RoughInertia:
    """Rough inertia, kg·m², with a generous relative uncertainty (about 2 sd), and the friction used for it."""

    inertia_kg_m2: float
    rel_error: float
    friction: RoughFriction


def rough_friction(
    time_s: FloatArray, speed_rad_s: FloatArray, torque_nm: FloatArray, level_a: Level, level_b: Level
) -> RoughFriction | None:
    """Return the line through two steady levels; Coulomb friction only if their speeds are similar. None without
    samples.
    """
    time = np.asarray(time_s, dtype=np.float64)
    means, deviations = [], []
    for level in (level_a, level_b):
        inside = (time >= level.start_s) & (time < level.end_s) & np.isfinite(speed_rad_s) & np.isfinite(torque_nm)
        if np.count_nonzero(inside) < 4:
            return None
        means.append((float(np.mean(speed_rad_s[inside])), float(np.mean(torque_nm[inside]))))
        deviations.append(_sd_of_mean(time[inside], torque_nm[inside]))
    (speed_a, torque_a), (speed_b, torque_b) = means
    if abs(speed_b - speed_a) < 0.05 * max(abs(speed_a), abs(speed_b), 1e-12):
        return RoughFriction(0.0, 0.5 * (torque_a + torque_b), max(deviations))
    viscous = (torque_b - torque_a) / (speed_b - speed_a)
    return RoughFriction(viscous, torque_a - viscous * speed_a, math.hypot(*deviations))


def rough_inertia(
    time_s: FloatArray,
    speed_rad_s: FloatArray,
    torque_nm: FloatArray,
    level_a: Level,
    level_b: Level,
    friction: RoughFriction | None = None,
    swinging: bool = False,
) -> RoughInertia | None:
    """Return the inertia from the change of speed between two levels, up or down; (N,) arrays, time rising.

    With ``friction`` from two levels of the speed stage, level_b need not be quite steady, as after a ramp of torque.
    Without ``friction``, it is computed from these two levels. ``swinging``: the shaft oscillates about the mean speeds
    of the levels. Returns None without a change of speed.
    """
    own = friction or rough_friction(time_s, speed_rad_s, torque_nm, level_a, level_b)
    good = np.isfinite(speed_rad_s) & np.isfinite(torque_nm)
    time = np.asarray(time_s, dtype=np.float64)[good]
    speed = np.asarray(speed_rad_s, dtype=np.float64)[good]
    torque = np.asarray(torque_nm, dtype=np.float64)[good]
    if own is None or level_b.start_s <= level_a.end_s:
        return None
    middle_a, middle_b = 0.5 * (level_a.start_s + level_a.end_s), 0.5 * (level_b.start_s + level_b.end_s)
    first, last = np.searchsorted(time, (middle_a, middle_b))
    before = speed[(time >= level_a.start_s) & (time < level_a.end_s)]
    after = speed[(time >= level_b.start_s) & (time < level_b.end_s)]
    if last - first < 8 or len(before) < 4 or len(after) < 4:
        return None
    change = float(np.mean(after) - np.mean(before))
    if swinging:
        ends = ((level_a, before), (level_b, after))
        scatter = math.hypot(*(
            _sd_of_mean(time[(time >= level.start_s) & (time < level.end_s)], seen) for level, seen in ends
        ))
    else:
        scatter = float(np.hypot(np.std(before), np.std(after)))
    if abs(change) <= 3.0 * scatter or change == 0.0:
        return None
    surplus = torque[first:last] - own.coulomb_nm - own.viscous_nm_s_rad * speed[first:last]
    spacing = np.diff(time[first:last])
    impulse = float(np.sum(0.5 * (surplus[1:] + surplus[:-1]) * spacing))
    inertia = impulse / change
    if not (np.isfinite(inertia) and inertia > 0.0):
        return None
    duration = float(np.sum(spacing))
    friction_error = 2.0 * own.level_sd_nm * duration / abs(impulse)
    relative = float(np.hypot(_LEAST_REL, friction_error) + scatter / abs(change))
    return RoughInertia(inertia, min(relative, _MOST_REL), own)


_BEFORE_S = 1.0         # s; time before a ramp over which torque and speed are averaged
_BEFORE_ECHO_ERROR = 0.3    # relative; reports with a lag of some 0.4 s, and the rest of the ramp


def rough_inertia_before_echo(
    ramps: Sequence[tuple[FloatArray, FloatArray, FloatArray, float]], echo_s: float, impedance_nm_s_rad: float,
    friction: RoughFriction,
) -> RoughInertia | None:
    """Estimate J of a motor above a drill string that is never at standstill, from each ramp before its echo returns.

    ``ramps``: time, speed, torque, (N,) each, and the start of the ramp, s. Until ``echo_s`` (2L/v) later the string is
    the resistance ζ, ``impedance_nm_s_rad``, and J Δω = ∫ (T − T_0 − ζ (ω − ω_0)) dt. The motion of the bit adds noise,
    which the scatter of the ramps shows. None without a usable ramp.
    """
    found = []
    for time, speed, torque, start_s in ramps:
        before = (time >= start_s - _BEFORE_S) & (time < start_s)
        first, last = np.searchsorted(time, (start_s, start_s + echo_s))
        if np.count_nonzero(before) < 4 or last - first < 8:
            continue
        speed_0, torque_0 = float(np.mean(speed[before])), float(np.mean(torque[before]))
        change = float(speed[last - 1]) - speed_0
        surplus = torque[first:last] - torque_0 - impedance_nm_s_rad * (speed[first:last] - speed_0)
        impulse = float(np.sum(0.5 * (surplus[1:] + surplus[:-1]) * np.diff(time[first:last])))
        if change != 0.0:
            found.append((abs(change), impulse / change))
    if len(found) < 2:
        return None
    weights, values = np.array(found).T
    inertia = float(np.average(values, weights=weights))
    if not (np.isfinite(inertia) and inertia > 0.0):
        return None
    scatter = 2.0 * float(np.std(values, ddof=1)) / math.sqrt(len(values)) / inertia
    return RoughInertia(inertia, min(math.hypot(_BEFORE_ECHO_ERROR, scatter), _MOST_REL), friction)


def _sd_of_mean(time: FloatArray, torque: FloatArray) -> float:
    """Return the standard deviation of a level's mean torque, from its block means, because the load disturbance is
    slow.
    """
    blocks = int(min(8, max(2, (time[-1] - time[0]) // _BLOCK_S)))
    means = [float(np.mean(part)) for part in np.array_split(torque, blocks)]
    return float(np.std(means, ddof=1) / np.sqrt(blocks))
