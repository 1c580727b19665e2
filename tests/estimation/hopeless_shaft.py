"""Shaft with faults, many records at once: data that give no J, or J with a warning only.

It shares no code with the tested code. J 104 kg·m², B 8 N·m·s/rad, lags 0.40/0.15 s, torque mode with a slow PI on the
mean speed; two mean speeds, five periods of 10 s each after one of settling. Physical faults (friction that
jumps, warms or drifts, another motion than declared, a limit) are simulated here. Faults of the record are added
to the Recording afterwards. The step of 10 ms causes an error of 0.04 % of J, far below the uncertainty here.
"""

from dataclasses import dataclass, fields

import numpy as np

from tdhil.recording.recording import Excitation, Recording, Segment
from tests.estimation.reporting import recorded

INERTIA, VISCOUS, COULOMB = 104.0, 8.0, 60.0
DT = 0.01
PERIOD_S, PERIODS = 10.0, 6
LINES = (0.1, 0.2, 0.3, 0.5)
AMPLITUDES = (0.45, 0.40, 0.35, 0.25)
PHASES = (0.0, 2.0, 4.6, 1.1)
JOIN_S = 6.0
LEAD_S = 3.0


@dataclass(frozen=True)
class Trouble:
    """Faults of one record; the defaults are a good record."""

    slow: float = 2.2             # mean speeds, rad/s
    fast: float = 5.0
    size: float = 1.0             # of the excitation
    stretched: float = 0.0        # relative error of the motion's clock, slower than the record's
    undeclared: float = 0.0       # rad/s, of an undeclared tone, at
    undeclared_hz: float = 0.23
    stiction: float = 0.0         # N·m above Coulomb friction, gone by
    stribeck: float = 0.3         # rad/s
    warming: float = 0.0          # N·m of friction that is lost, by the time constant
    warming_s: float = 80.0
    creep: float = 0.0            # N·m/s
    hunting: float = 0.0          # N·m of a load that oscillates at
    hunting_hz: float = 1.7
    torque_limit: float = 400.0   # of the motor
    gust: float = 3.0             # N·m sd of the load
    ripple: float = 0.0           # rad/s in the reported speed, at
    ripple_hz: float = 100.1
    only: int = -1                # the only excited and declared line; −1: all
    quiet: float = 0.0            # 1: no noise at all
    rate_hz: float = 100.0


def sound_segments(trouble: Trouble) -> tuple[Segment, ...]:
    """Return the declared segments; the motion differs by the fault only."""
    length = PERIODS * PERIOD_S
    starts = (LEAD_S, LEAD_S + length + JOIN_S)
    return tuple(
        Segment(start, start + length, PERIOD_S, 1, offset, *declared(trouble.only))
        for start, offset in zip(starts, (trouble.slow, trouble.fast), strict=True)
    )


def declared(only: int) -> tuple[tuple[float, ...], ...]:
    """Return lines, amplitudes and phases of the declaration."""
    return tuple(part if only < 0 else part[only : only + 1] for part in (LINES, AMPLITUDES, PHASES))


def simulate(troubles: list[Trouble], seed: int) -> list[Recording]:
    """Return one recording per fault."""
    p = {field.name: np.array([getattr(t, field.name) for t in troubles]) for field in fields(Trouble)}
    many = len(troubles)
    steps = round((LEAD_S + 2 * PERIODS * PERIOD_S + JOIN_S + 2.0) / DT)
    noisy = 1.0 - p["quiet"]
    white = np.random.default_rng(seed).standard_normal((3, steps, many))
    keep = np.exp(-DT / 0.5)
    load = np.zeros(many)
    omega = p["slow"].copy()
    integral = np.zeros(many)
    speed_seen, torque_seen, late = omega.copy(), COULOMB + VISCOUS * omega, omega.copy()
    speed, torque = np.empty((steps, many)), np.empty((steps, many))
    slow = 0.5
    for n in range(steps):
        now = n * DT
        target, rate = _reference(now, p)
        late += DT / 0.4 * (target - late)
        error = late - speed_seen
        integral += 0.125 * slow * INERTIA * DT * error
        command = COULOMB + VISCOUS * target + INERTIA * rate + 0.5 * slow * INERTIA * error + integral
        motor = np.clip(command, -p["torque_limit"], p["torque_limit"])
        load = keep * load + np.sqrt(1.0 - keep**2) * p["gust"] * noisy * white[0, n]
        ripple = 4.0 * noisy * white[1, n]
        outer = load + p["hunting"] * np.sin(2.0 * np.pi * p["hunting_hz"] * now)
        coulomb = COULOMB - p["warming"] * (1.0 - np.exp(-now / p["warming_s"])) + p["creep"] * now
        breakaway = coulomb + p["stiction"]
        friction = (coulomb + p["stiction"] * np.exp(-((omega / p["stribeck"]) ** 2))) * np.sign(omega)
        push = motor + ripple + outer
        stuck = (omega == 0.0) & (np.abs(push) <= breakaway)
        after = omega + DT / INERTIA * (push - np.where(omega == 0.0, np.sign(push) * coulomb, friction)
                                        - VISCOUS * omega)
        stops = (omega != 0.0) & (np.sign(after) != np.sign(omega)) & (np.abs(push) <= breakaway)
        omega = np.where(stuck | stops, 0.0, after)
        speed_seen += DT / 0.40 * (omega + 0.01 * noisy * white[2, n] - speed_seen)
        torque_seen += DT / 0.15 * (motor + ripple - torque_seen)
        speed[n], torque[n] = speed_seen, torque_seen
    return [_recorded(troubles[k], speed[:, k], torque[:, k], np.random.default_rng((seed, k))) for k in range(many)]


def _reference(now: float, p: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the requested speed and acceleration, (many,) each."""
    length = PERIODS * PERIOD_S
    second = LEAD_S + length + JOIN_S
    u = np.clip((now - LEAD_S - length) / JOIN_S, 0.0, 1.0)
    mean = p["slow"] + (p["fast"] - p["slow"]) * (3.0 - 2.0 * u) * u * u
    mean_rate = (p["fast"] - p["slow"]) * 6.0 * u * (1.0 - u) / JOIN_S
    inside = np.clip((now - LEAD_S) / 1.0, 0.0, 1.0)
    own = (now - (second if now >= second - 0.5 * JOIN_S else LEAD_S)) / (1.0 + p["stretched"])
    speed, rate = mean, mean_rate
    for k, (hertz, full, phase) in enumerate(zip(LINES, AMPLITUDES, PHASES, strict=True)):
        amplitude = np.where((p["only"] < 0) | (p["only"] == k), full, 0.0)
        w = 2.0 * np.pi * hertz
        speed = speed + inside * p["size"] * amplitude * np.cos(w * own + phase)
        rate = rate - inside * p["size"] * amplitude * w / (1.0 + p["stretched"]) * np.sin(w * own + phase)
    w = 2.0 * np.pi * p["undeclared_hz"]
    return speed + p["undeclared"] * np.cos(w * now), rate - p["undeclared"] * w * np.sin(w * now)


def _recorded(trouble: Trouble, speed: np.ndarray, torque: np.ndarray, rng: np.random.Generator) -> Recording:
    time = np.arange(0.0, (len(speed) - 2) * DT, 1.0 / trouble.rate_hz)
    grid = np.arange(len(speed)) * DT
    seen_speed, seen_torque = np.interp(time, grid, speed), np.interp(time, grid, torque)
    seen_speed = seen_speed + trouble.ripple * np.cos(2.0 * np.pi * trouble.ripple_hz * time)
    steps = (0.0, 0.0) if trouble.quiet else (0.0105, 0.5)
    if not trouble.quiet:
        seen_speed = np.round((seen_speed + 0.005 * rng.standard_normal(len(time))) / steps[0]) * steps[0]
        seen_torque = np.round((seen_torque + 1.0 * rng.standard_normal(len(time))) / steps[1]) * steps[1]
    return recorded(
        time, seen_speed, seen_torque,
        excitation=Excitation("multisine", "torque", sound_segments(trouble)),
        speed_resolution_rad_s=steps[0],
        torque_resolution_nm=steps[1],
        torque_limit_nm=400.0,
        simulated=True,
    )
