"""Independent bench of stages 2 to 5, many seeds at once: ramps and holds before the excitation.

Speeds, times and loops are like those of the protocol's default run, written out here: two steady speeds under a speed
loop, the switch to torque and the drift to a lower speed, the host's slow PI to the first mean speed, a multisine about
two mean speeds. Reports are made by `shaft_bench.recordings`. A coast-down may be added at the end.
"""

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy.signal import lfilter

from tdhil.recording.recording import Level, Segment
from tests.estimation.shaft_bench import DT, Motion, Rig, Shaft, recordings

LINES, AMPLITUDES = (0.1, 0.2, 0.3, 0.4), (1.45, 0.8, 0.22, 0.22)
PHASES = (0.97, 5.08, 6.05, 0.74)
OFFSETS, HOLDS, PERIOD = (3.6, 7.0), (2.9, 7.15), 10.0


@dataclass(frozen=True)
class Stages:
    """Differences from the usual run."""

    rig: Rig = field(default_factory=Rig)
    periods: int = 4                  # periods of each segment, including the settling one
    static: float = 0.0               # Stribeck: breakaway torque above Coulomb's, N·m
    stribeck_speed: float = 3.0
    coast: bool = False               # torque off at the end, from the second mean speed
    coast_torque: float = 0.0         # true torque while the drive reports none
    play: "Play | None" = None        # a load behind a coupling with play; None: one rigid shaft


@dataclass(frozen=True)
class Play:
    """Load behind a coupling with play. Its inertia and friction are parts of the rig's."""

    angle: float                      # from flank to flank, rad; 0: a linear spring
    inertia: float                    # of the load, kg·m²
    coulomb: float = 0.0              # of the load, N·m
    viscous: float = 0.0              # of the load, N·m·s/rad
    natural: float = 80.0             # of the closed coupling, rad/s
    ratio: float = 0.3                # damping ratio of the closed coupling


class _Coupling:
    """Load and coupling, stepped beside the motor: a spring and a damper that transmit pressure only."""

    def __init__(self, play: Play, rig: Rig, speed: np.ndarray) -> None:
        self.play, self.motor_inertia = play, rig.inertia - play.inertia
        reduced = self.motor_inertia * play.inertia / rig.inertia
        self.stiffness = reduced * play.natural**2
        self.damping = 2.0 * play.ratio * reduced * play.natural
        self.speed = speed.copy()
        held = play.coulomb + play.viscous * speed
        self.twist = 0.5 * play.angle + held / self.stiffness

    def torque(self, motor_speed: np.ndarray) -> np.ndarray:
        """Return the torque on the load; advance load and twist by one step."""
        half = 0.5 * self.play.angle
        closed = np.where(np.abs(self.twist) > half, self.twist - half * np.sign(self.twist), 0.0)
        found = self.stiffness * closed + self.damping * (motor_speed - self.speed)
        if half > 0.0:
            found = np.where(closed > 0.0, np.maximum(found, 0.0), np.where(closed < 0.0, np.minimum(found, 0.0), 0.0))
        drag = self.play.viscous * self.speed + self.play.coulomb * np.sign(self.speed)
        self.speed = self.speed + DT / self.play.inertia * (found - drag)
        return found

    def turn(self, motor_speed: np.ndarray) -> None:
        """Advance the twist by one step, after both speeds."""
        self.twist = self.twist + DT * (motor_speed - self.speed)


def run_stages(stages: Stages, seeds: list[int], **report) -> list:
    """Return one recording per seed."""
    motion, shaft, reported = turn(stages, seeds)
    return recordings(stages.rig, motion, replace(shaft, torque=reported), seeds, **report)


@cache
def ten_runs() -> tuple:
    """Return the first ten of `usual_runs`, bit for bit: the run of a seed does not depend on the others."""
    return tuple(run_stages(Stages(coast=True), list(range(10)), rate_hz=100.0))


@cache
def usual_runs() -> tuple:
    """Return 210 seeds of the usual run with a coast-down at the end, simulated once for several tests."""
    stages = Stages(coast=True)
    return tuple(r for first in (0, 70, 140) for r in run_stages(stages, list(range(first, first + 70)), rate_hz=100.0))


def turn(stages: Stages, seeds: list[int]) -> tuple[Motion, Shaft, np.ndarray]:
    rig, many = stages.rig, len(seeds)
    streams = [np.random.default_rng(seed) for seed in seeds]
    length = stages.periods * PERIOD
    begin = (46.0, 46.0 + length + 5.5)
    end = begin[1] + length + (14.0 if stages.coast else 1.0)
    time = np.arange(round(end / DT)) * DT
    target, rate, mode = reference(time, begin, length)
    steady = rig.coulomb + rig.viscous * target
    ramped = np.clip((time - 24.0) * 40.0, 0.0, 8.0 * (HOLDS[1] - HOLDS[0]))

    white = np.stack([s.standard_normal(len(time)) for s in streams], axis=1)
    keep = np.exp(-DT / rig.load_time)
    load = lfilter([rig.load_sd * np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0)
    ripple = rig.ripple_sd * np.stack([s.standard_normal(len(time)) for s in streams], axis=1)
    sensor = rig.sensor_sd * np.stack([s.standard_normal(len(time)) for s in streams], axis=1)

    omega, motor = np.full(many, HOLDS[0]), np.full(many, steady[0])
    seen, host, integral = omega.copy(), omega.copy(), motor.copy()
    host_target, slow = HOLDS[0], 0.2 / 0.5
    kp, ki = 300.0 * rig.inertia / 104.0, 300.0 * rig.inertia / 104.0
    host_kp, host_ki = slow * rig.inertia, slow**2 * rig.inertia / 4.0
    speed, torque, reported, turned = (np.empty((len(time), many)) for _ in range(4))
    angle = np.zeros(many)
    coupling = None if stages.play is None else _Coupling(stages.play, rig, omega)
    host_keep, drop = np.exp(-DT / 0.4), None
    for n in range(len(time)):
        phase = mode[n]
        if phase == 0:                                     # the drive's own speed loop
            seen += 0.1 * (omega + sensor[n] - seen)
            integral = integral + ki * DT * (target[n] - seen)
            command = kp * (target[n] - seen) + integral
        elif phase == 1:                                   # torque, open loop
            drop = integral.copy() if drop is None else drop
            command = drop - ramped[n]
        elif phase == 2:                                   # feed-forward and the host's slow PI
            if host_target == HOLDS[0]:
                integral, host_target = np.zeros(many), target[n]
            host_target += (1.0 - host_keep) * (target[n] - host_target)
            error = host_target - host
            integral = integral + host_ki * DT * error
            command = steady[n] + rig.inertia * rate[n] + host_kp * error + integral
        host += (1.0 - host_keep) * (omega - host)
        motor = motor + (DT / rig.torque_lag) * (command - motor) if phase < 3 else np.full(many, stages.coast_torque)
        actual = motor + (ripple[n] if phase < 3 else 0.0)
        speed[n], torque[n], turned[n] = omega, actual, angle
        reported[n] = actual if phase < 3 else 0.0
        extra = stages.static * np.exp(-((omega / stages.stribeck_speed) ** 2))
        friction = rig.viscous * omega + (rig.coulomb + extra) * np.sign(omega)
        for order, amplitude, shift in rig.harmonics:
            friction = friction + amplitude * np.cos(order * (angle + 0.5 * DT * omega) + shift)
        before = omega
        if coupling is None:
            omega = np.maximum(omega + DT / rig.inertia * (actual - load[n] - friction), 0.0)
        else:
            own = friction - coupling.play.viscous * omega - coupling.play.coulomb * np.sign(omega)
            given = coupling.torque(omega)
            omega = np.maximum(omega + DT / coupling.motor_inertia * (actual - load[n] - own - given), 0.0)
            coupling.turn(omega)
        angle = angle + 0.5 * DT * (before + omega)

    segments = tuple(
        Segment(start, start + length, PERIOD, 1, offset, LINES, AMPLITUDES, PHASES)
        for start, offset in zip(begin, OFFSETS, strict=True)
    )
    motion = Motion((), segments, levels=(Level(2.0, 8.0), Level(18.0, 24.0)), end_s=end)
    return motion, Shaft(speed + sensor, torque, turned), reported


def reference(time, begin, length):
    """Return set speed, its rate, and the control: 0 speed loop of the drive, 1 none, 2 the host, 3 coasting."""
    low, high = HOLDS
    target, rate = np.full(len(time), low), np.zeros(len(time))
    mode = np.where(time < 24.0, 0, np.where(time < 33.0, 1, 2))
    ramp = np.clip((time - 8.0) / 3.6, 0.0, 1.0)
    target = low + (high - low) * ramp
    back = (time >= 33.0) & (time < begin[0])
    target[back] = OFFSETS[0] + (5.0 - OFFSETS[0]) * np.clip(1.0 - (time[back] - 33.0) / 2.0, 0.0, 1.0)
    shift = sum(a * np.cos(p) for a, p in zip(AMPLITUDES, PHASES, strict=True))
    into = back & (time > begin[0] - 3.0)
    target[into] = OFFSETS[0] + shift * (0.5 - 0.5 * np.cos(np.pi * (time[into] - begin[0] + 3.0) / 3.0))
    for start, offset in zip(begin, OFFSETS, strict=True):
        inside = time >= start
        turns = 2.0 * np.pi * np.outer(time[inside] - start, LINES) + PHASES
        target[inside] = offset + np.cos(turns) @ AMPLITUDES
        rate[inside] = -np.sin(turns) @ (np.array(AMPLITUDES) * 2.0 * np.pi * np.array(LINES))
    between = (time >= begin[0] + length) & (time < begin[1])
    u = (time[between] - begin[0] - length) / (begin[1] - begin[0] - length)
    step = OFFSETS[1] - OFFSETS[0]
    target[between] = OFFSETS[0] + shift + step * (0.5 - 0.5 * np.cos(np.pi * u))
    rate[between] = step * 0.5 * np.pi * np.sin(np.pi * u) / (begin[1] - begin[0] - length)
    mode = np.where(time >= begin[1] + length, 3, mode)
    return target, rate, mode
