"""Fake drive with false reports."""

from dataclasses import dataclass

from drivers.drive import PowerState
from tests.runner.fake_drive import FakeDrive


@dataclass
class Reporting(FakeDrive):
    """Drive that reports its position, answers polls and removes its torque on request. Each report may be false.

    ``sees``: the speed that the drive reports instead of its own. ``pushes_nm``: the torque that acts in its quick
    stop. ``polled``: the speed that a single request shows.
    """

    sees: float | None = None
    scale: float = 1.0
    pushes_nm: float | None = None
    polled: float | None = None
    no_state: bool = False
    with_position: bool = False
    angle: float = 0.0
    polls: int = 0

    def report(self):
        sample = super().report()
        if self.sees is not None or self.scale != 1.0:
            speed = self.scale * self.speed if self.sees is None else self.sees
            rests = self.state is PowerState.QUICK_STOP and abs(speed) < 1e-9
            sample = sample._replace(speed_rad_s=speed, standstill=rests)
        if self.no_state:
            sample = sample._replace(speed_rad_s=0.0, torque_nm=0.0, state=PowerState.UNKNOWN, standstill=False)
        angle = 0.0 if self.no_state else self.angle
        return sample._replace(position_rad=angle) if self.with_position else sample

    def poll(self):
        self.polls += 1
        sample = self.report()
        return sample if self.polled is None else sample._replace(speed_rad_s=self.polled, standstill=False)

    def _move(self, command):
        if self.pushes_nm is not None and self.state is PowerState.QUICK_STOP:
            self.torque = self.pushes_nm
            self._push(self.torque)
        else:
            super()._move(command)
        self.angle += self.speed * self.period_s
