"""Independent bench for identification: shaft, drive and host in plain numpy, many seeds at once.

It shares no code with the tested code. The plant is stepped at 2 ms (semi-implicit Euler on ω, exact for the filters),
the drive's speed loop and the host's slow PI are written out here, and the reported signals are filtered, disturbed and
rounded as on the field-like rig of the notes (J 104 kg·m², B 8, Coulomb 60 N·m, lags 0.40/0.15 s).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tdhil.recording.recording import Excitation, LagPrior, Level, Recording, Segment
from tests.estimation.reporting import delayed, lagged, recorded
from tests.rigs import FieldRig

DT = 0.002


@dataclass(frozen=True)
class Rig(FieldRig):
    stribeck: float = 0.0            # additional friction at standstill, a bell curve with this width in rad/s
    stribeck_width: float = 2.0
    torque_limit: float = 400.0
    speed_poles: tuple[float, ...] = (0.40,)
    torque_poles: tuple[float, ...] = (0.15,)
    speed_average: float = 0.0       # moving average in the speed report, s
    speed_delay: float = 0.0         # of the reported speed, s
    torque_delay: float = 0.0
    harmonics: tuple[tuple[int, float, float], ...] = ()     # order n, N·m, rad: against rotation, over the angle
    quiet: bool = False              # no disturbance, no noise, no rounding


@dataclass(frozen=True)
class Motion:
    """Segments of (reference(t) → speed, feed-forward torque), with their durations, joined by ramps of ``ramp_s``."""

    references: tuple[Callable[[float], tuple[float, float]], ...]
    segments: tuple[Segment, ...]    # start_s and end_s as they will be recorded
    kind: str = "multisine"
    levels: tuple[Level, ...] = ()
    end_s: float = field(default=0.0)


def averaged(x: np.ndarray, width_s: float) -> np.ndarray:
    n = round(width_s / DT)
    if n < 2:
        return x
    total = np.cumsum(np.concatenate([np.repeat(x[:1], n, axis=0), x]), axis=0)
    return (total[n:] - total[:-n]) / n


@dataclass(frozen=True)
class Shaft:
    """True motion, (steps, seeds): speed at the sensor, torque at the shaft. Reports are derived from it."""

    speed: np.ndarray
    torque: np.ndarray
    angle: np.ndarray | None = None


def simulate(rig: Rig, motion: Motion, seeds: list[int], mode: str = "torque", **report: object) -> list[Recording]:
    """Return one recording per seed."""
    return recordings(rig, motion, turn_shaft(rig, motion, seeds, mode), seeds, mode, **report)


def turn_shaft(rig: Rig, motion: Motion, seeds: list[int], mode: str = "torque") -> Shaft:
    """Step drive, shaft and host."""
    streams = [np.random.default_rng(seed) for seed in seeds]
    steps = round(motion.end_s / DT)
    many = len(seeds)
    noisy = 0.0 if rig.quiet else 1.0

    def white() -> np.ndarray:
        return np.stack([r.standard_normal(steps) for r in streams], axis=1)

    keep = np.exp(-DT / rig.load_time)
    from scipy.signal import lfilter

    start = noisy * rig.load_sd * np.array([r.standard_normal() for r in streams])
    load = lfilter(
        [1.0], [1.0, -keep], noisy * rig.load_sd * np.sqrt(1.0 - keep**2) * white(), axis=0, zi=(keep * start)[None]
    )[0]
    ripple = noisy * rig.ripple_sd * white()
    sensor = noisy * rig.sensor_sd * white()

    target, feed = references(motion, steps)
    omega = np.full(many, target[0])
    motor = np.full(many, feed[0])
    measured = omega.copy()
    host_view = omega.copy()
    integral = np.zeros(many)
    speed = np.empty((steps, many))
    torque = np.empty((steps, many))
    a_motor = np.exp(-DT / rig.torque_lag)
    a_measured = np.exp(-DT / 0.020)
    a_host = np.exp(-DT / 0.40)
    target_seen = target[0]
    slow = 0.2 / 0.40                                # bandwidth of the host's PI, rad/s
    kp, ki = (300.0, 300.0) if mode == "speed" else (slow * rig.inertia * 0.5, slow * rig.inertia * 0.05)
    for n in range(steps):
        speed[n] = omega
        actual = motor + ripple[n]
        torque[n] = actual
        if mode == "speed":
            measured = a_measured * measured + (1.0 - a_measured) * (omega + sensor[n])
            error = target[n] - measured
            integral += ki * DT * error
            command = feed[n] * 0.0 + kp * error + integral + feed[0]
        else:
            host_view = a_host * host_view + (1.0 - a_host) * omega
            target_seen = a_host * target_seen + (1.0 - a_host) * target[n]
            error = target_seen - host_view
            integral += ki * DT * error
            command = feed[n] + kp * error + integral
        command = np.clip(command, -rig.torque_limit, rig.torque_limit)
        motor = a_motor * motor + (1.0 - a_motor) * command
        friction = rig.viscous * omega + rig.coulomb * np.sign(omega)
        if rig.stribeck:
            friction += rig.stribeck * np.exp(-((omega / rig.stribeck_width) ** 2)) * np.sign(omega)
        omega = omega + DT / rig.inertia * (actual + load[n] - friction)

    return Shaft(speed + sensor, torque)


def recordings(
    rig: Rig,
    motion: Motion,
    shaft: Shaft,
    seeds: list[int],
    mode: str = "torque",
    rate_hz: float = 250.0,
    jitter_s: float = 0.0,
    drop: float = 0.0,
    lag_prior: LagPrior | None = None,
    torque_scale_rel_sd: float = 0.0,
) -> list[Recording]:
    """Return the drive's reports, one recording per seed. Fewer seeds than columns use the first columns."""
    many = len(seeds)
    seen = averaged(lagged(shaft.speed[:, :many], rig.speed_poles, DT), rig.speed_average)
    speed = delayed(seen, rig.speed_delay, DT)
    torque = delayed(lagged(shaft.torque[:, :many], rig.torque_poles, DT), rig.torque_delay, DT)
    streams = [np.random.default_rng(seed + 1_000_003) for seed in seeds]
    return [
        _recorded(rig, motion, mode, k, streams[k], speed[:, k], torque[:, k], rate_hz, jitter_s, drop,
                  lag_prior or LagPrior(), torque_scale_rel_sd)
        for k in range(many)
    ]


def references(motion: Motion, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return target speed and feed-forward torque per step: segments, half-cosine ramps between them, and holds."""
    time = np.arange(steps) * DT
    target, feed = np.full(steps, np.nan), np.full(steps, np.nan)
    for reference, segment in zip(motion.references, motion.segments, strict=True):
        inside = np.flatnonzero((time >= segment.start_s - 1e-9) & (time < segment.end_s - 1e-9))
        values = np.array([reference(float(t) - segment.start_s) for t in time[inside]])
        target[inside], feed[inside] = values[:, 0], values[:, 1]
    known = np.flatnonzero(~np.isnan(target))
    missing = np.flatnonzero(np.isnan(target))
    gaps = np.split(missing, np.flatnonzero(np.diff(missing) > 1) + 1) if len(missing) else []
    for gap in gaps:
        before = known[known < gap[0]]
        after = known[known > gap[-1]]
        if len(before) == 0:
            target[gap], feed[gap] = target[after[0]], feed[after[0]]
        elif len(after) == 0:
            target[gap], feed[gap] = target[before[-1]], feed[before[-1]]
        else:
            u = 0.5 - 0.5 * np.cos(np.pi * (np.arange(len(gap)) + 1.0) / (len(gap) + 1.0))
            target[gap] = target[before[-1]] + (target[after[0]] - target[before[-1]]) * u
            slope = np.gradient(target[gap], DT) if len(gap) > 1 else 0.0
            feed[gap] = 60.0 + 8.0 * target[gap] + 104.0 * slope
    return target, feed


def _recorded(rig, motion, mode, k, rng, speed, torque, rate_hz, jitter_s, drop, lag_prior, scale_sd):
    stride = round(1.0 / rate_hz / DT)
    index = np.arange(0, len(speed), stride)
    if jitter_s > 0.0:
        index = index + np.round(rng.uniform(-jitter_s, jitter_s, len(index)) / DT).astype(int)
        index = np.unique(np.clip(index, 0, len(speed) - 1))
    seen_speed, seen_torque = speed[index], torque[index]
    if not rig.quiet:
        seen_speed = seen_speed + rig.speed_noise * rng.standard_normal(len(index))
        seen_torque = seen_torque + rig.torque_noise * rng.standard_normal(len(index))
        seen_speed = np.round(seen_speed / rig.speed_quantum) * rig.speed_quantum
        seen_torque = np.round(seen_torque / rig.torque_quantum) * rig.torque_quantum
    fresh = rng.random(len(index)) >= drop if drop > 0.0 else np.ones(len(index), dtype=bool)
    for i in np.flatnonzero(~fresh):     # a stale sample repeats the values before it
        if i > 0:
            seen_speed[i], seen_torque[i] = seen_speed[i - 1], seen_torque[i - 1]
    return recorded(
        index * DT, seen_speed, seen_torque,
        fresh=fresh,
        excitation=Excitation(motion.kind, mode, motion.segments),
        levels=motion.levels,
        lag_prior=lag_prior,
        speed_resolution_rad_s=0.0 if rig.quiet else rig.speed_quantum,
        torque_resolution_nm=0.0 if rig.quiet else rig.torque_quantum,
        torque_limit_nm=rig.torque_limit,
        torque_scale_rel_sd=scale_sd,
        simulated=True,
    )
