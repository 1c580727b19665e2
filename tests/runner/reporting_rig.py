"""Rigid shaft, drive, and the reports of the drive, for tests of the observer alone.

The shaft has Coulomb and viscous friction. The drive follows a speed setpoint by a PI controller, or puts the commanded
torque on the shaft. Each report has its own first-order lag, noise and resolution. A lie changes the reports; a wrong
sensor also changes the speed that the drive's speed control uses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drivers import Command, Mode, PowerState, Sample
from tdhil.runner.excitation import RigGuess
from tdhil.runner.observer import Observer
from tdhil.runner.settings import MachineLimits
from tests.rigs import LIMITS

STEP_S = 0.002


class Reports(NamedTuple):
    """Reports of a drive about its shaft."""

    speed_rad_s: float
    torque_nm: float
    position_rad: float | None


Lie = Callable[[Reports], Reports]


@dataclass(frozen=True)
class Rig:
    """Shaft, limits and reports of a rig."""

    inertia: float = 100.0
    viscous: float = 8.0
    coulomb: float = 20.0
    limits: MachineLimits = LIMITS
    rate_hz: float = 50.0
    speed_lag_s: float = 0.1
    torque_lag_s: float = 0.05
    noise_rad_s: float = 0.005
    speed_count: float = 0.01
    torque_count: float = 1.0
    position_count: float = 0.0        # rad; 0: no position is reported
    demand: bool = False

    @property
    def period_s(self) -> float:
        return 1.0 / self.rate_hz

    def friction(self, speed: float) -> float:
        return self.coulomb + self.viscous * speed

    @property
    def acceleration(self) -> float:
        """Acceleration with half of the torque that exceeds friction, rad/s²."""
        return 0.5 * (self.limits.torque_nm - self.friction(self.limits.speed_max_rad_s)) / self.inertia


@dataclass
class Bench:
    """One run on a rig: true shaft, drive, reports, and the observer of the reports."""

    rig: Rig
    seed: int = 1
    lie: Lie | None = None
    sensor: Callable[[float], float] | None = None
    polarity: float = 1.0              # of the true torque; the drive reports another one
    stuck_nm: float | None = None      # torque that stays, independent of the control; it is reported
    inverted_stop: bool = False        # a quick stop accelerates; the torque report is true

    time_s: float = 0.0
    speed: float = 0.0
    angle: float = 0.0
    torque: float = 0.0
    demand: float = 0.0
    state: PowerState = PowerState.ENABLED
    samples: list[Sample] = field(default_factory=list)
    fastest: float = 0.0

    def __post_init__(self) -> None:
        rig = self.rig
        self.noise = np.random.default_rng(self.seed)
        self.observer = Observer(rig.limits, rig.period_s, rig.speed_count, rig.torque_count)
        if rig.position_count:
            self.observer.position(rig.position_count, math.inf)
        self._lagged_speed = self._lagged_torque = 0.0
        self._integral = 0.0
        self._setpoint = 0.0
        self._mode: Mode | None = None

    # -- the drive and its shaft -----------------------------------------------------------------------------------

    def cycle(self, command: Command) -> Sample:
        rig, dt = self.rig, STEP_S
        steps = max(1, round(rig.period_s / STEP_S))
        dt = rig.period_s / steps
        for _ in range(steps):
            self._step(command, dt)
        self.time_s += rig.period_s
        sample = self.report(command)
        self.samples.append(sample)
        self.observer.see(command, sample)
        self.fastest = max(self.fastest, abs(self.speed))
        return sample

    def report(self, command: Command) -> Sample:
        rig = self.rig
        speed = self._lagged_speed + rig.noise_rad_s * self.noise.standard_normal()
        reports = Reports(
            _counts(speed, rig.speed_count), _counts(self._lagged_torque, rig.torque_count),
            _counts(self.angle, rig.position_count) if rig.position_count else None,
        )
        if self.lie is not None:
            reports = self.lie(reports)
        rests = self.state is PowerState.QUICK_STOP and abs(reports.speed_rad_s) <= 3.0 * rig.speed_count
        return Sample(
            self.time_s, 0.0, 0.0, True, reports.speed_rad_s, reports.torque_nm, self.demand if rig.demand else None,
            command.mode, self.state, rests, False, 0x27, reports.position_rad,
        )

    def _step(self, command: Command, dt: float) -> None:
        rig, limit = self.rig, self.rig.limits.torque_nm
        measured = self.speed if self.sensor is None else self.sensor(self.speed)
        stopping = self.state is PowerState.QUICK_STOP
        regulated = stopping or command.mode is Mode.SPEED
        if self.state not in (PowerState.ENABLED, PowerState.QUICK_STOP):
            wanted = 0.0
            self._mode = None
        elif regulated:
            if self._mode is not Mode.SPEED:
                self._mode, self._setpoint = Mode.SPEED, measured
                self._integral = self.torque
            if stopping:
                change = rig.limits.quick_stop_rad_s2 * dt
                self._setpoint -= max(-change, min(change, self._setpoint))
            else:
                self._setpoint = command.speed_rad_s
            apart = self._setpoint - measured
            wanted = self._integral + 6.0 * rig.inertia * apart
            if abs(wanted) < limit:
                self._integral += 8.0 * rig.inertia * apart * dt
            wanted = max(-limit, min(limit, wanted))
        else:
            self._mode, wanted = Mode.TORQUE, max(-limit, min(limit, command.torque_nm))
        self.demand = wanted
        if self.stuck_nm is not None and self.state in (PowerState.ENABLED, PowerState.QUICK_STOP):
            wanted = self.stuck_nm
        if stopping and self.inverted_stop:
            wanted = -wanted
        self.torque = wanted
        self._push(self.polarity * wanted, dt)
        self._lagged_speed += _share(dt, rig.speed_lag_s) * (measured - self._lagged_speed)
        self._lagged_torque += _share(dt, rig.torque_lag_s) * (wanted - self._lagged_torque)

    def _push(self, torque: float, dt: float) -> None:
        rig = self.rig
        if self.speed == 0.0 and abs(torque) <= rig.coulomb:
            return
        sign = math.copysign(1.0, self.speed or torque)
        speed = self.speed + dt * (torque - sign * rig.coulomb - rig.viscous * self.speed) / rig.inertia
        self.speed = 0.0 if speed * sign < 0.0 and abs(torque) <= rig.coulomb else speed
        self.angle += self.speed * dt

    # -- the phases of a run ---------------------------------------------------------------------------------------

    def hold(self, seconds: float, speed: float) -> None:
        """Speed mode at a constant setpoint."""
        for _ in range(round(seconds / self.rig.period_s)):
            self.cycle(Command(Mode.SPEED, speed, 0.0))

    def ramp(self, speed: float, acceleration: float | None = None) -> None:
        """Speed mode along a ramp from the setpoint before."""
        rate = acceleration or min(0.5 * self.rig.limits.speed_max_rad_s, self.rig.acceleration)
        start = self._setpoint
        cycles = max(1, math.ceil(abs(speed - start) / rate / self.rig.period_s))
        for step in range(1, cycles + 1):
            self.cycle(Command(Mode.SPEED, start + (speed - start) * step / cycles, 0.0))

    def probe(self) -> None:
        """Raise the torque until the shaft moves, as the sign probe does."""
        most = self.rig.limits.torque_nm
        for step in range(round(6.0 / self.rig.period_s)):
            sample = self.cycle(Command(Mode.TORQUE, 0.0, most * step * self.rig.period_s / 6.0))
            if sample.speed_rad_s > 0.03 * self.rig.limits.speed_max_rad_s:
                return

    def first_levels(self) -> None:
        """Run standstill, sign probe and two operating points: the phases before J is known."""
        for _ in range(round(0.5 / self.rig.period_s)):
            self.cycle(Command(Mode.TORQUE, 0.0, 0.0))
        self.probe()
        top = self.rig.limits.speed_max_rad_s
        self.ramp(0.2 * top)
        self.hold(4.0, 0.2 * top)
        self.ramp(0.4 * top)
        self.hold(3.0, 0.4 * top)

    def know(self, wrong: float = 0.05, rel_error: float = 0.15) -> None:
        """Give the observer the result of stage 2: J with a relative error of ``wrong``."""
        rig = self.rig
        self.observer.know(RigGuess(rig.inertia * (1.0 + wrong), rig.viscous, rig.coulomb, rel_error))
        if rig.position_count:
            self.observer.compare_position(1.0)

    def begun(self, speed: float = 5.0) -> Bench:
        """Run everything up to the end of stage 2, then go to a speed."""
        self.first_levels()
        self.know()
        self.ramp(speed)
        self.hold(3.0, speed)
        return self

    def excite(self, seconds: float, speed: float, swing: float, frequency_hz: float = 0.25) -> None:
        """Excite in torque mode: a sine about a mean speed that weak feedback holds."""
        rig = self.rig
        start_s, omega = self.time_s, 2.0 * math.pi * frequency_hz
        for _ in range(round(seconds / rig.period_s)):
            at = omega * (self.time_s - start_s)
            wave = swing * math.sin(at)
            torque = rig.friction(speed + wave) + rig.inertia * swing * omega * math.cos(at)
            torque += 0.3 * rig.inertia * (speed + wave - (self.samples[-1].speed_rad_s if self.samples else 0.0))
            self.cycle(Command(Mode.TORQUE, 0.0, torque))

    def quick_stop(self, seconds: float) -> str:
        """Brake the drive; return how it runs away, once the observer finds it."""
        self.state = PowerState.QUICK_STOP
        self.observer.begin_stop()
        for _ in range(round(seconds / self.rig.period_s)):
            sample = self.cycle(Command(Mode.SPEED, 0.0, 0.0))
            if how := self.observer.runs_away(sample):
                return how
        return ""

    def found_after(self, seconds: float, act: Callable[[], None]) -> float | None:
        """Repeat ``act``; return the time until the observer doubts a report, s. None: no doubt within ``seconds``."""
        start_s = self.time_s
        while self.time_s - start_s < seconds:
            act()
            if self.observer.doubt is not None:
                return self.observer.doubt.time_s - start_s
        return None


def _share(dt: float, lag_s: float) -> float:
    return 1.0 if lag_s <= 0.0 else 1.0 - math.exp(-dt / lag_s)


def _counts(value: float, count: float) -> float:
    return value if count <= 0.0 else count * round(value / count)
