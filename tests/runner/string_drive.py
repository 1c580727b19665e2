"""Fake drive with a drill string that is stuck at the bottom and twisted. It turns back once torque is released."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from drivers.drive import Command, Mode, PowerState
from tdhil.runner.stop import QuickStopKind, StopSequence
from tests.runner.fake_drive import LIMITS, FakeDrive, World

STRING = replace(LIMITS, load="string", torque_ramp_nm_s=20.0)
RESIDUAL_NM = 8.0                     # 2 % of 400 N·m; five quanta of 1 N·m are less


@dataclass
class StringDrive(FakeDrive):
    """Drive and string. ``twist_nm``: trapped torque at first. ``swing_nm``: amplitude that decays within 10 s."""

    stiffness: float = 100.0
    twist_nm: float = 0.0
    swing_nm: float = 0.0
    swing_s: float = 5.0
    coulomb: float = 5.0
    angle: float = 0.0
    lowest_speed: float = 0.0
    work_j: float = 0.0               # work of the motor on the string

    def __post_init__(self) -> None:
        self.angle = self.twist_nm / self.stiffness

    @property
    def string_nm(self) -> float:
        time_s = self.clock.now_s()
        swing = self.swing_nm * math.exp(-time_s / 10.0) * math.sin(2.0 * math.pi * time_s / self.swing_s)
        return self.stiffness * self.angle + swing

    def _move(self, command: Command) -> None:
        dt = self.period_s
        if self.state is PowerState.QUICK_STOP:
            self.speed = math.copysign(max(0.0, abs(self.speed) - 2.0 * dt), self.speed)
        elif self.state is PowerState.ENABLED and self.mode is Mode.SPEED:
            self.speed = command.speed_rad_s
        elif self.state is PowerState.ENABLED:
            self._push(command.torque_nm - self.string_nm)
        else:
            self._push(-self.string_nm)
        self.angle += self.speed * dt
        self.work_j += self.string_nm * self.speed * dt
        self.lowest_speed = min(self.lowest_speed, self.speed)
        held = self.state in (PowerState.ENABLED, PowerState.QUICK_STOP)
        friction = math.copysign(self.coulomb, self.speed) if self.speed else 0.0
        self.torque = self.string_nm + friction if held else 0.0


class StringWorld(World):
    """Bench above a string, enabled in speed mode, at standstill or in motion."""

    def __init__(self, limits=STRING, speed: float = 0.0, mode: Mode = Mode.SPEED, **drive) -> None:
        super().__init__(StringDrive(**drive), limits)
        self.drive.state = self.drive.wish = PowerState.ENABLED
        self.drive.mode, self.drive.speed = mode, speed
        self.bench.last = self.drive.report()

    def stop_sequence(self, **options) -> StopSequence:
        quick_stop = QuickStopKind(self.drive.quick_stop_in_torque_mode)
        return StopSequence(self.bench, self.limits, 0.01, quick_stop, torque_resolution_nm=1.0, **options)
