"""Independent bench for shafts that are not rigid: motor, spring or string, and drive reports, in plain numpy.

It shares no code with the tested code or sim_bus. Many seeds run at once, one column each. Two masses are stepped
by the exact solution of their linear equations over 10 ms, with the friction at the beginning of the step. The
waves of the string move cell by cell along the pipe. Torque is fed forward from the truth, with a slow PI on the mean
speed. The reports have first-order lags. With this noise, the Cramér-Rao bounds of the two-mass design are
J_r 0.3 %, J_L and k 4 %, c 25 % with known lags, and 1.6, 4, 4 and 35 % with estimated lags.
"""

import cmath
from dataclasses import dataclass

import numpy as np

from tdhil.recording.recording import Excitation, LagPrior, Recording, Segment
from tests.estimation.reporting import lagged, recorded

DT = 0.01                              # also of the samples
PERIOD_S = 20.0
LINES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.75, 0.9)
PHASES = (0.3, 2.1, 5.2, 1.1, 3.9, 0.2, 4.4, 2.7, 5.9, 1.6, 3.3)
OFFSETS = (3.2, 5.7)
FADE_S = 20.0                          # rise time of the excitation, since an oscillation decays within minutes
MOST_SWING_RAD_S = 0.8                 # of the load, at one line
SETTLE, USED = 4, 6                    # periods about each mean speed: 240 s used


@dataclass(frozen=True)
class Noise:
    load_nm: float = 220.0             # correlated over 0.5 s
    sensor_rad_s: float = 0.10         # white per step
    torque_nm: float = 10.0            # ripple of the motor's torque, white per step
    quantum_rad_s: float = 0.0105
    quantum_nm: float = 10.0


QUIET = Noise(0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class TwoMass:
    motor: float = 1500.0
    load: float = 374.0
    stiffness: float = 473.0
    damping: float = 23.2
    motor_viscous: float = 8.0
    load_viscous: float = 4.0

    @property
    def total(self) -> float:
        return self.motor + self.load

    def impedance(self, hz: float) -> complex:
        """Return the impedance from the equations of motion, solved for the two speeds at T = 1."""
        s = 2j * cmath.pi * hz
        spring = self.stiffness / s + self.damping
        matrix = np.array([
            [self.motor * s + self.motor_viscous + spring, -spring],
            [-spring, self.load * s + self.load_viscous + spring],
        ])
        return complex(1.0 / np.linalg.solve(matrix, np.array([1.0, 0.0]))[0])

    def swing(self, hz: float) -> float:
        """Return the ratio of the load's speed to the motor's."""
        s = 2j * cmath.pi * hz
        spring = self.stiffness / s + self.damping
        return abs(spring / (self.load * s + self.load_viscous + spring))

    def body(self, many: int, speed: float, dry: tuple[float, float]) -> "_TwoMassBody":
        return _TwoMassBody(self, many, speed, dry)


@dataclass(frozen=True)
class Pipe:
    """String with `inertia` and static `stiffness`; the other parameters describe its ends."""

    motor: float = 1500.0
    end: float = 374.0
    inertia: float = 214.56            # 2300 m of 5 inch pipe
    stiffness: float = 414.0           # waves take 0.72 s
    drag: float = 11.5
    motor_viscous: float = 8.0
    end_viscous: float = 4.0

    @property
    def load(self) -> float:
        return self.inertia + self.end

    @property
    def total(self) -> float:
        return self.motor + self.load

    @property
    def delay(self) -> float:
        return float(np.sqrt(self.inertia / self.stiffness))

    def impedance(self, hz: float) -> complex:
        """Return the impedance by the telegraph equation, from the waves at both ends."""
        s = 2j * cmath.pi * hz
        shunt, series = self.inertia * s + self.drag, s / self.stiffness
        gamma, wave = cmath.sqrt(shunt * series), cmath.sqrt(shunt / series)
        bottom = self.end * s + self.end_viscous
        back = (bottom - wave) / (bottom + wave) * cmath.exp(-2.0 * gamma)
        return self.motor * s + self.motor_viscous + wave * (1.0 + back) / (1.0 - back)

    def swing(self, hz: float) -> float:
        """Return the ratio of the speed at the lower end to the motor's."""
        s = 2j * cmath.pi * hz
        shunt, series = self.inertia * s + self.drag, s / self.stiffness
        gamma, wave = cmath.sqrt(shunt * series), cmath.sqrt(shunt / series)
        return abs(1.0 / (cmath.cosh(gamma) + (self.end * s + self.end_viscous) / wave * cmath.sinh(gamma)))

    def body(self, many: int, speed: float, dry: tuple[float, float]) -> "_PipeBody":
        return _PipeBody(self, many, speed, dry)


class _TwoMassBody:
    """State of two masses: ω_r, ω_L and twist, first in steady rotation."""

    def __init__(self, plant: TwoMass, many: int, speed: float, dry: tuple[float, float]) -> None:
        from scipy.signal import cont2discrete

        p = plant
        a = np.array([
            [-(p.damping + p.motor_viscous) / p.motor, p.damping / p.motor, -p.stiffness / p.motor],
            [p.damping / p.load, -(p.damping + p.load_viscous) / p.load, p.stiffness / p.load],
            [1.0, -1.0, 0.0],
        ])
        b = np.array([[1.0 / p.motor, 0.0], [0.0, 1.0 / p.load], [0.0, 0.0]])
        self.a, self.b, *_ = cont2discrete((a, b, np.eye(3), np.zeros((3, 2))), DT)
        self.dry = dry
        held = (dry[1] + p.load_viscous * speed) / p.stiffness
        self.state = np.tile([[speed], [speed], [held]], (1, many))

    def step(self, torque: np.ndarray) -> np.ndarray:
        """Advance by one step; return the motor speed before it."""
        speed = self.state[0]
        friction = np.sign(self.state[1]) * self.dry[1]
        forces = np.stack([torque - self.dry[0] * np.sign(speed), -friction])
        self.state = self.a @ self.state + self.b @ forces
        return speed


class _PipeBody:
    """Waves of torque in cells of one step; drag between cells."""

    def __init__(self, plant: Pipe, many: int, speed: float, dry: tuple[float, float]) -> None:
        self.p, self.dry = plant, dry
        self.cells = round(plant.delay / DT)
        delay = self.cells * DT
        # a small change of stiffness makes the delay a whole number of cells
        self.wave = plant.inertia / delay
        self.beta = plant.drag / self.cells
        self.motor = np.full(many, speed)
        self.end = np.full(many, speed)
        held = dry[1] + plant.end_viscous * speed
        torque = held + plant.drag * speed * (1.0 - (np.arange(self.cells) + 0.5) / self.cells)
        self.down = np.tile((torque + self.wave * speed)[:, None], (1, many))
        self.up = np.tile((self.wave * speed - torque)[:, None], (1, many))

    def step(self, torque: np.ndarray) -> np.ndarray:
        before = self.motor
        p, z, beta = self.p, self.wave, self.beta
        arrived_up, arrived_down = self.up[0].copy(), self.down[-1].copy()
        self.motor = _moved(before, torque - np.sign(before) * self.dry[0] + arrived_up, p.motor,
                            p.motor_viscous + z + 0.5 * beta)
        end = _moved(self.end, arrived_down - np.sign(self.end) * self.dry[1], p.end, p.end_viscous + z + 0.5 * beta)
        mean_motor, mean_end = 0.5 * (before + self.motor), 0.5 * (self.end + end)
        self.end = end
        between = (self.down[:-1] + self.up[1:]) * (2.0 * z / (2.0 * z + beta))
        down, up = np.empty_like(self.down), np.empty_like(self.up)
        down[1:], up[:-1] = between - self.up[1:], between - self.down[:-1]
        down[0] = 2.0 * z * mean_motor - arrived_up
        up[-1] = 2.0 * z * mean_end - arrived_down
        self.down, self.up = down, up
        return before


def _moved(speed: np.ndarray, force: np.ndarray, inertia: float, viscous: float) -> np.ndarray:
    """J dω/dt = force − B ω over a step, by the trapezoidal rule."""
    half = 0.5 * DT * viscous
    return ((inertia - half) * speed + DT * force) / (inertia + half)


def run(
    plant: TwoMass | Pipe,
    seeds: list[int],
    *,
    noise: Noise = Noise(),
    lags_s: tuple[float, float] = (0.40, 0.15),
    lag_prior: LagPrior | None = None,
    lines: tuple[float, ...] = LINES,
    amplitude: float = 0.25,
    settle: int = SETTLE,
) -> list[Recording]:
    """One recording per seed: torque mode, two mean speeds."""
    many, length = len(seeds), (settle + USED) * PERIOD_S
    rng = [np.random.default_rng(seed) for seed in seeds]
    phases = np.array(PHASES[: len(lines)])
    z = np.array([plant.impedance(hz) for hz in lines])
    # the load must not reverse during its own oscillation, since its friction would reverse too
    amplitudes = np.array([min(amplitude, MOST_SWING_RAD_S / plant.swing(hz)) for hz in lines])
    ramp_s, dry = 10.0, (60.0, 30.0)
    time = np.arange(round((2 * length + ramp_s) / DT)) * DT
    u = np.clip((time - length) / ramp_s, 0.0, 1.0)
    mean = OFFSETS[0] + (OFFSETS[1] - OFFSETS[0]) * (0.5 - 0.5 * np.cos(np.pi * u))
    target, drag = mean.copy(), sum(dry) + mean * plant.impedance(1e-4).real
    feed = drag + plant.total * np.gradient(mean, DT)
    starts = (0.0, length + ramp_s)
    for start in starts:
        inside = (time >= start) & (time < start + length)
        since = time[inside] - start
        fade = np.sin(0.5 * np.pi * np.clip(since / FADE_S, 0.0, 1.0)) ** 2
        turned = fade[:, None] * np.exp(1j * (2.0 * np.pi * np.outer(since, lines) + phases))
        target[inside] += (turned @ amplitudes).real
        feed[inside] += (turned @ (amplitudes * z)).real
    speed, torque = _turned(plant, many, rng, noise, time, mean, target, feed, dry)
    seen_speed, seen_torque = (lagged(x, (lag,), DT) for x, lag in zip((speed, torque), lags_s, strict=True))
    segments = tuple(
        Segment(start, start + length, PERIOD_S, settle, offset, lines,
                tuple(float(a) for a in amplitudes), tuple(float(p) for p in phases))
        for start, offset in zip(starts, OFFSETS, strict=True)
    )
    return [
        _recorded(seen_speed[:, k], seen_torque[:, k], noise, segments, lag_prior or LagPrior())
        for k in range(many)
    ]


def _turned(plant, many, rng, noise, time, mean, target, feed, dry):
    from scipy.signal import lfilter

    steps = len(time)
    keep = np.exp(-DT / 0.5)
    white = np.stack([r.standard_normal(steps) for r in rng], axis=1)
    start = noise.load_nm * np.array([[r.standard_normal() for r in rng]])
    load = lfilter([noise.load_nm * np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0, zi=keep * start)[0]
    ripple = noise.torque_nm * np.stack([r.standard_normal(steps) for r in rng], axis=1)
    body = plant.body(many, float(mean[0]), dry)
    speed, torque = np.empty((steps, many)), np.empty((steps, many))
    gain, pull, integral = 0.05 * plant.total, 0.0005 * plant.total, np.zeros(many)
    error = np.zeros(many)
    for n in range(steps):
        actual = feed[n] + gain * error + integral + ripple[n]
        speed[n] = body.step(actual - load[n])
        torque[n] = actual
        error = 0.975 * error + 0.025 * (target[n] - speed[n])
        integral += pull * DT * error
    sensed = speed + noise.sensor_rad_s * np.stack([r.standard_normal(steps) for r in rng], axis=1)
    return sensed, torque


def _recorded(speed, torque, noise, segments, lag_prior):
    if noise.quantum_rad_s > 0.0:
        speed = np.round(speed / noise.quantum_rad_s) * noise.quantum_rad_s
        torque = np.round(torque / noise.quantum_nm) * noise.quantum_nm
    return recorded(
        np.arange(len(speed)) * DT, np.ascontiguousarray(speed), np.ascontiguousarray(torque),
        excitation=Excitation("multisine", "torque", segments),
        lag_prior=lag_prior,
        speed_resolution_rad_s=noise.quantum_rad_s,
        torque_resolution_nm=noise.quantum_nm,
        torque_limit_nm=12000.0,
        simulated=True,
    )
