"""Stage 4, hold: the host controls the mean speed to the value at which stage 5 begins."""

from __future__ import annotations

from collections import deque

from drivers import Command, LimitHit, Mode
from profiles import MessageCode
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import RigGuess
from tdhil.runner.guard import LIGHTEN, kept_within
from tdhil.runner.settings import ControlAssumptions, MachineLimits

# ---------------------------------------------------------------------------------------------------------------------
# The host's slow control of the mean speed in torque mode. Pure: time and speed are arguments.
#
# A host loop as fast as a drive's own would oscillate or diverge with a lag τ_w of 0.4 s of the reported speed. With
# the plant 1/(J s + B), the lag 1/(1 + τ_w s) and
#
#     T = K_p e + K_i ∫e dt        K_p = J ω_b,  K_i = K_p ω_b / 4,  ω_b = 0.2 / τ_w
#
# the gain crossover is at about ω_b, where the lag costs atan(0.2) = 11° and the integral atan(1/4) = 14°: the phase
# margin is about 65°, and 45° if the lag is four times the assumed one.


class MeanSpeedControl:
    """PI control with clamping anti-windup; its torque is limited to ``authority_nm``."""

    def __init__(self, model: RigGuess, authority_nm: float, assumptions: ControlAssumptions) -> None:
        bandwidth_rad_s = 0.2 / assumptions.largest_speed_lag_s
        self._kp = model.inertia_kg_m2 * bandwidth_rad_s
        self._ki = self._kp * bandwidth_rad_s / 4.0
        self._authority_nm = authority_nm
        self._integral_nm = 0.0

    def update(self, error_rad_s: float, dt_s: float) -> float:
        """Return the torque to add, N·m, for the speed error (setpoint minus reported) of this cycle."""
        integral = self._integral_nm + self._ki * error_rad_s * dt_s
        torque = self._kp * error_rad_s + integral
        if abs(torque) > self._authority_nm:
            torque = self._authority_nm if torque > 0.0 else -self._authority_nm
            # The integral is held while the torque is at its bound, unless the error leads away from the bound.
            if (error_rad_s > 0.0) == (torque > 0.0):
                return torque
        self._integral_nm = integral
        return torque


# ---------------------------------------------------------------------------------------------------------------------

WINDOW_SHARE = 0.02       # of the target speed: the window of the mean speed
SETTLED_S = 3.0           # s; time in the window that counts as settled
MEAN_S = 1.0              # s; averaging time of the reported speed
TIMEOUT_S = 90.0
"""Longest settling after the ramp, s."""


def run_hold(
    loop: ControlLoop,
    limits: MachineLimits,
    model: RigGuess,
    control: MeanSpeedControl,
    target_rad_s: float,
    start_rad_s: float,
    speed_resolution_rad_s: float,
    wander_rad_s: float = 0.0,
) -> None:
    """Bring the mean speed into a window of 2 % and keep it there for 3 s, in torque mode.

    ``wander_rad_s``: deviation that a drill string under load causes; the window is at least this wide.

    The setpoint is ramped from the present speed, at a rate that needs a quarter of the torque limit.
    """
    tolerance_rad_s = max(3.0 * speed_resolution_rad_s, WINDOW_SHARE * target_rad_s, wander_rad_s)
    recent: deque[float] = deque(maxlen=loop.cycles(MEAN_S))
    rate = min(0.25 * limits.torque_nm / model.inertia_kg_m2, (limits.speed_max_rad_s - limits.speed_min_rad_s) / 5.0)
    inside_since_s: float | None = None
    wanted = reported = start_rad_s
    timeout_s = TIMEOUT_S + abs(target_rad_s - start_rad_s) / rate
    for _ in range(loop.cycles(timeout_s)):
        step = kept_within(target_rad_s - wanted, -rate * loop.period_s, rate * loop.period_s)
        wanted += step
        correction = control.update(wanted - reported, loop.period_s)
        ahead_nm = model.steady_torque_nm(wanted) + model.inertia_kg_m2 * step / loop.period_s
        torque = kept_within(ahead_nm + correction, loop.guard.least_torque_nm, limits.torque_nm)
        sample = loop.cycle(Command(Mode.TORQUE, wanted, torque))
        reported = sample.speed_rad_s
        recent.append(reported)
        mean = sum(recent) / len(recent)
        if abs(mean - target_rad_s) > tolerance_rad_s:
            inside_since_s = None
        elif inside_since_s is None:
            inside_since_s = sample.time_s
        elif sample.time_s - inside_since_s >= SETTLED_S:
            return
    raise LimitHit(
        f"no steady speed near {target_rad_s:.3f} rad/s within {timeout_s:.0f} s (last {mean:.3f} rad/s)"
        + (f"; {loop.guard.disturbed}" if loop.guard.disturbed else ""),
        where="stage hold",
        next_step=LIGHTEN
        if loop.guard.disturbed
        else "Check in the log whether the load changes or a brake drags",
        entry=MessageCode.NOT_SETTLED,
    )
