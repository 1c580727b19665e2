"""Ramp to a speed in the drive's own speed loop."""

from __future__ import annotations

from drivers import Command, Mode
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import RigGuess
from tdhil.runner.settings import MachineLimits
from tdhil.runner.stages.steady import wait_until_steady

TORQUE_SHARE, RAMP_S = 0.25, 5.0
"""Ramp to the first set speed in the drive's own loop: share of the torque limit that may accelerate the shaft, and
least time from zero to the speed limit, s."""


def go_to(
    loop: ControlLoop, limits: MachineLimits, model: RigGuess, speed_rad_s: float, speed_resolution_rad_s: float
) -> None:
    """Ramp to a speed in speed mode, and settle. Raises what the bench raises, LimitHit if it does not settle."""
    begun = max(0.0, loop.last.speed_rad_s) if loop.last is not None else 0.0
    rate = min(TORQUE_SHARE * limits.torque_nm / model.inertia_kg_m2, limits.speed_max_rad_s / RAMP_S)
    steps = loop.cycles(abs(speed_rad_s - begun) / rate)
    for step in range(1, steps + 1):
        loop.cycle(Command(Mode.SPEED, begun + (speed_rad_s - begun) * step / steps, 0.0))
    tolerance = max(2.0 * speed_resolution_rad_s, 0.01 * limits.speed_max_rad_s)
    wait_until_steady(loop, Command(Mode.SPEED, speed_rad_s, 0.0), speed_rad_s, tolerance, timeout_s=90.0)
