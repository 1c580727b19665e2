"""Records without periodic excitation in plain numpy, many seeds at once. It shares no code with the tested code.

The shaft is stepped by the midpoint rule, with Coulomb friction that sticks at standstill. The drive has a speed PI
after a filter of 10 ms, a torque lag of 10 ms, a torque mode and an off state. Reports are filtered, disturbed, sampled
(with jitter, errors of time stamps, late speed, gaps) and rounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from tdhil.recording.recording import LagPrior, Recording
from tests.estimation.reporting import delayed, lagged, recorded

SPEED, TORQUE, OFF = 0.0, 1.0, 2.0


@dataclass(frozen=True)
class Report:
    """Poles (s), moving average (s) and delay (s) of a report, in series."""

    poles: tuple[float, ...] = ()
    average: float = 0.0
    delay: float = 0.0


@dataclass(frozen=True)
class Machine:
    """Machine in SI units at the motor shaft. ``pace`` scales the time of the motion; noise as sd, white per step."""

    name: str
    inertia: float
    viscous: float
    coulomb: float
    speed_report: Report
    torque_report: Report
    top: float                      # rad/s, highest requested speed
    limit: float                    # N·m
    pace: float = 1.0
    dt: float = 0.002
    load_sd: float = 3.0
    load_time: float = 0.5
    ripple_sd: float = 10.0
    sensor_sd: float = 0.02
    speed_noise: float = 0.003
    torque_noise: float = 2.0
    speed_quantum: float = 0.0105
    torque_quantum: float = 1.0
    quadratic: float = 0.0          # friction ∝ ω|ω|


@dataclass(frozen=True)
class Reading:
    """Sampling of a record."""

    rate_hz: float = 100.0
    jitter_s: float = 0.003
    stamp_error_s: float = 0.0
    speed_early_s: float = 0.0      # time by which speed is read before torque
    lost: float = 0.0               # share of rows missing, single
    hole_s: float = 0.0             # one hole of this length in the middle
    coarse: float = 1.0             # factor of a coarser resolution


@dataclass
class Script:
    """Requests at every step, (steps,) or (steps, seeds): regime, target speed, torque."""

    regime: np.ndarray
    target: np.ndarray
    torque: np.ndarray = field(default_factory=lambda: np.zeros(0))


def filtered(x: np.ndarray, report: Report, dt: float) -> np.ndarray:
    x = lagged(x, report.poles, dt)
    n = round(report.average / dt)
    if n > 1:
        total = np.cumsum(np.concatenate([np.zeros_like(x[:1]), np.repeat(x[:1], n - 1, axis=0), x]), axis=0)
        x = (total[n:] - total[:-n]) / n
    return delayed(x, report.delay, dt)


def turn(machine: Machine, script: Script, rngs: list[np.random.Generator]) -> tuple[np.ndarray, np.ndarray]:
    """Return true speed at the sensor and torque, (steps, seeds)."""
    from scipy.signal import lfilter

    m, dt, many = machine, machine.dt, len(rngs)
    steps = len(script.regime)
    white = np.stack([r.standard_normal((3, steps)) for r in rngs], axis=2)
    keep = np.exp(-dt / m.load_time)
    load, _ = lfilter([m.load_sd * np.sqrt(1 - keep**2)], [1.0, -keep], white[0], axis=0,
                      zi=keep * m.load_sd * np.stack([r.standard_normal(1) for r in rngs], axis=1))
    ripple, sensor = m.ripple_sd * white[1], m.sensor_sd * white[2]
    target = np.broadcast_to(script.target.reshape(steps, -1), (steps, many))
    torque = np.broadcast_to(script.torque.reshape(steps, -1), (steps, many))
    runs = [
        _turn(m, script.regime.tolist(), *(part[:, k].tolist() for part in (target, torque, load, ripple, sensor)))
        for k in range(many)
    ]
    speed_out, torque_out = (np.array(columns).T for columns in zip(*runs, strict=True))
    return speed_out + sensor, torque_out


def _turn(
    m: Machine, regimes: list[int], target: list[float], torque: list[float], load: list[float], ripple: list[float],
    sensor: list[float],
) -> tuple[list[float], list[float]]:
    """Simulate one seed with scalars: for a few seeds, arrays per step take ten times as long."""
    dt, limit, coulomb, viscous, quadratic = m.dt, m.limit, m.coulomb, m.viscous, m.quadratic
    omega = seen = target[0]
    motor = integral = viscous * omega + math.copysign(coulomb, omega) if omega else 0.0
    bandwidth = 3.0 / m.pace
    kp, ki = m.inertia * bandwidth, m.inertia * bandwidth**2 / 4.0
    keep = math.exp(-dt / (0.01 * min(m.pace, 1.0)))
    speeds, torques = [], []
    for n, regime in enumerate(regimes):
        seen = keep * seen + (1 - keep) * (omega + sensor[n])
        if regime == SPEED:
            error = target[n] - seen
            command = kp * error + integral
            if abs(command) < limit:
                integral += ki * dt * error
        elif regime == TORQUE:
            command = integral = torque[n]
        else:
            command = integral = 0.0
        motor = keep * motor + (1 - keep) * min(max(command, -limit), limit)
        actual = motor + ripple[n]
        if regime == OFF:
            actual = motor = 0.0
        push = actual + load[n]
        sign = math.copysign(1.0, omega or push)
        smooth = viscous * omega + quadratic * omega * abs(omega)
        half = omega + 0.5 * dt / m.inertia * (push - smooth - coulomb * sign)
        smooth = viscous * half + quadratic * half * abs(half)
        after = omega + dt / m.inertia * (push - smooth - coulomb * sign)
        if abs(push) <= coulomb and (omega == 0.0 or after * sign < 0.0):
            after = 0.0
        speeds.append(0.5 * (omega + after))
        torques.append(actual)
        omega = after
    return speeds, torques


def report(
    machine: Machine, reading: Reading, speed: np.ndarray, torque: np.ndarray, rngs: list[np.random.Generator],
    prior: LagPrior | None = None,
) -> list[Recording]:
    m, dt = machine, machine.dt
    speed, torque = filtered(speed, m.speed_report, dt), filtered(torque, m.torque_report, dt)
    grid = np.arange(len(speed)) * dt
    found = []
    for k, rng in enumerate(rngs):
        at = np.arange(0.2, grid[-1] - 0.2, 1.0 / reading.rate_hz)
        at = at + rng.uniform(-reading.jitter_s, reading.jitter_s, len(at))
        at = at[rng.random(len(at)) >= reading.lost]
        if reading.hole_s > 0.0:
            middle = 0.5 * grid[-1]
            at = at[(at < middle) | (at > middle + reading.hole_s)]
        w = np.interp(at - 0.5 * reading.speed_early_s, grid, speed[:, k])
        t = np.interp(at + 0.5 * reading.speed_early_s, grid, torque[:, k])
        w = w + m.speed_noise * rng.standard_normal(len(at))
        t = t + m.torque_noise * rng.standard_normal(len(at))
        q_w, q_t = m.speed_quantum * reading.coarse, m.torque_quantum * reading.coarse
        w, t = np.round(w / q_w) * q_w, np.round(t / q_t) * q_t
        stamps = np.sort(at + rng.uniform(-reading.stamp_error_s, reading.stamp_error_s, len(at)))
        found.append(recorded(
            stamps, w, t, lag_prior=prior or LagPrior(), speed_resolution_rad_s=q_w, torque_resolution_nm=q_t,
            simulated=True,
        ))
    return found


# -- motions -------------------------------------------------------------------------------------------------


def _grid(machine: Machine, duration: float) -> np.ndarray:
    return np.arange(round(duration * machine.pace / machine.dt)) * machine.dt / machine.pace


def speed_steps(machine: Machine, rng: np.random.Generator) -> Script:
    """Step the speed command of a PI loop every 4 to 9 s, within 15 to 100 % of the top speed."""
    t = _grid(machine, 100.0)
    edges = np.cumsum(rng.uniform(4.0, 9.0, 40))
    levels = machine.top * rng.uniform(0.15, 1.0, 41)
    return Script(np.full(len(t), SPEED), levels[np.searchsorted(edges, t)], np.zeros(len(t)))


def up_down(machine: Machine, rng: np.random.Generator) -> Script:
    """Triangles of the speed command, 3 to 8 s a flank."""
    t = _grid(machine, 100.0)
    knots = np.concatenate([[0.0], np.cumsum(rng.uniform(3.0, 8.0, 40))])
    levels = machine.top * np.where(np.arange(41) % 2 == 0, rng.uniform(0.15, 0.3, 41), rng.uniform(0.7, 1.0, 41))
    return Script(np.full(len(t), SPEED), np.interp(t, knots, levels), np.zeros(len(t)))


def ramp_coast(machine: Machine, rng: np.random.Generator) -> Script:
    """Ramp up from standstill, hold, coast down to standstill, and wait, four times."""
    t = _grid(machine, 120.0)
    cycle = 30.0
    phase = np.mod(t, cycle)
    number = (t // cycle).astype(int)
    top = machine.top * rng.uniform(0.7, 1.0, 8)[number]
    rise = rng.uniform(3.0, 6.0, 8)[number]
    target = top * np.clip((phase - 2.0) / rise, 0.0, 1.0)
    regime = np.where(phase < 2.0, OFF, np.where(phase < 14.0, SPEED, OFF))
    return Script(regime, target, np.zeros(len(t)))


def _about(machine: Machine) -> tuple[float, float]:
    middle = 0.55 * machine.top
    return middle, machine.viscous * middle + machine.coulomb + machine.quadratic * middle**2


def torque_pulses(machine: Machine, rng: np.random.Generator) -> Script:
    """Speed loop to a mean speed, then pairs of torque pulses up and down about the friction torque."""
    t = _grid(machine, 100.0)
    middle, hold = _about(machine)
    extra = np.zeros(len(t))
    begin = 5.0
    while begin < 98.0:
        width = rng.uniform(0.8, 1.6)
        size = 0.25 * machine.top * machine.inertia / (width * machine.pace) * rng.choice([-1.0, 1.0])
        size = np.clip(size, -0.8 * (machine.limit - hold), 0.8 * (machine.limit - hold))
        gap = rng.uniform(1.0, 3.0)
        extra[(t >= begin) & (t < begin + width)] = size
        extra[(t >= begin + width + gap) & (t < begin + 2 * width + gap)] = -size
        begin += 2 * width + gap + rng.uniform(1.0, 3.0)
    regime = np.where(t < 4.0, SPEED, TORQUE)
    return Script(regime, np.full(len(t), middle), hold + extra)


def torque_steps(machine: Machine, rng: np.random.Generator) -> Script:
    """Random torque levels, each held for 0.7 to 3 s. Their sum is limited by a feedback to the mean speed."""
    t = _grid(machine, 100.0)
    middle, hold = _about(machine)
    extra = np.zeros(len(t))
    begin, gone = 5.0, 0.0
    while begin < 100.0:
        width = rng.uniform(0.7, 3.0)
        change = np.clip(0.28 * machine.top * rng.standard_normal() - 0.8 * gone, -0.5, 0.5 * machine.top)
        change = np.clip(gone + change, -0.33 * machine.top, 0.33 * machine.top) - gone
        level = np.clip(machine.inertia * change / (width * machine.pace), -0.9 * (machine.limit - hold),
                        0.9 * (machine.limit - hold))
        extra[(t >= begin) & (t < begin + width)] = level
        gone += level * width * machine.pace / machine.inertia
        begin += width
    regime = np.where(t < 4.0, SPEED, TORQUE)
    return Script(regime, np.full(len(t), middle), hold + extra)


MOTIONS = {
    "speed steps": speed_steps, "torque pulses": torque_pulses, "up-down ramps": up_down, "ramp + coast": ramp_coast,
    "torque steps": torque_steps,
}
FOREIGN = Reading(rate_hz=10.0, jitter_s=0.010, stamp_error_s=0.005, speed_early_s=0.020, lost=0.02, coarse=5.0)

FIELD = Machine("field", 104.0, 8.0, 60.0, Report((0.40,)), Report((0.15,)), 8.0, 400.0)
SERVO = Machine("servo", 0.8, 0.05, 1.5, Report(), Report(), 80.0, 60.0, 0.5, 0.001, 0.3, 0.3, 1.0, 0.05, 0.01, 0.1,
                0.0105, 0.05)
HEAVY = Machine("heavy", 900.0, 74.3, 82.4, Report((0.25,)), Report((0.10,)), 10.0, 4500.0, 1.0, 0.002, 25.0, 0.5,
                60.0, 0.01, 0.003, 10.0, 0.0105, 5.0)


def simulate(
    machine: Machine, motion: str, seeds: list[int], reading: Reading | None = None, prior: LagPrior | None = None
) -> list[Recording]:
    """Return one recording per seed. The motion "foreign" is speed steps, read by a PLC ten times per second."""
    reading = reading or (FOREIGN if motion == "foreign" else Reading(250.0, 0.001) if machine.pace < 1 else Reading())
    make = MOTIONS["speed steps" if motion == "foreign" else motion]
    rngs = [np.random.default_rng([seed, 77]) for seed in seeds]
    scripts = [make(machine, rng) for rng in rngs]
    stacked = Script(scripts[0].regime, np.stack([s.target for s in scripts], axis=1),
                     np.stack([s.torque for s in scripts], axis=1))
    speed, torque = turn(machine, stacked, rngs)
    return report(machine, reading, speed, torque, rngs, prior)
