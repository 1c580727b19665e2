"""The drive's loops: speed PI with anti-windup, torque mode under a speed limit, ramps, bumpless switching.

Speed control: e = ramped reference − filtered speed, demand = K_p e + I, dI/dt = K_i e, clamped to the
torque limits; the integral stands still while the clamp holds and e would push further into it.

Torque mode: demand = ramped torque − K_p x − I with x the speed beyond the limit and dI/dt = K_i x, I ≥ 0: nothing
happens below the limit, and in the long run the limit is held exactly. The same on the negative side.

Switching: to speed, the integral starts at the torque demand that flows and a ramp at the actual speed;
to torque, a ramp starts at the torque demand that flows. A setpoint without ramp acts at once: whoever
switches seeds it.

Stopping: the ramp starts at the actual speed. Once the speed has come to zero the integral is dropped, which
until then held the braking torque and would drive the shaft backwards.
"""

from dataclasses import dataclass
from enum import Enum
from math import copysign, inf

from sim_bus.params import DriveParams
from sim_bus.reporting import RPM, lag_gain


class Regulation(Enum):
    """What is regulated."""

    OFF = "off"
    SPEED = "speed"
    STOP = "stop"
    TORQUE = "torque"


@dataclass(slots=True)
class Limits:
    """What the loops must not exceed; torque both ways is given positive."""

    torque_forward_nm: float
    torque_reverse_nm: float
    speed_rad_s: float


class Controller:
    """The loops and their memory; `step` is called with the measured speed once per control period."""

    __slots__ = (
        "_came_from",
        "_down",
        "_filter_gain",
        "_integral",
        "_overspeed",
        "_params",
        "_target",
        "_up",
        "demand_nm",
        "filtered_rad_s",
        "limited",
        "limits",
        "reference",
        "regulation",
    )

    def __init__(self, params: DriveParams) -> None:
        self._params = params
        self.limits = Limits(params.torque_limit_nm, params.torque_limit_nm, params.speed_limit_rpm * RPM)
        self.regulation = Regulation.OFF
        self.limited = False           # torque or speed limit acting
        self.filtered_rad_s = 0.0
        self.demand_nm = 0.0
        self.reference = 0.0           # ramped setpoint: rad/s, or N·m in torque mode
        self._target = 0.0
        self._up = inf                 # ramp towards larger magnitude, per second
        self._down = inf               # ramp towards zero, per second
        self._integral = 0.0
        self._overspeed = 0.0          # integral of the speed limiter, N·m
        self._came_from = 0.0          # sign of the speed when the stop began
        self.prepare(params.control_period_s)

    def prepare(self, dt_s: float) -> None:
        """Fits the speed filter to a step of ``dt_s``."""
        self._filter_gain = lag_gain(dt_s, self._params.speed_filter_s)

    def off(self) -> None:
        """No torque; the shaft coasts."""
        if self.regulation is not Regulation.OFF:
            self.regulation = Regulation.OFF
            self.demand_nm = self._integral = self._overspeed = 0.0
            self.limited = False

    def speed(self, target_rad_s: float, accel_rad_s2: float = inf, decel_rad_s2: float = inf) -> None:
        """Regulates speed, along a ramp unless the rates are infinite."""
        if self.regulation is not Regulation.SPEED:
            self._enter_speed_control(Regulation.SPEED)
        self._target = target_rad_s
        self._up, self._down = accel_rad_s2, decel_rad_s2

    def stop(self, decel_rad_s2: float = inf) -> None:
        """Brings the shaft to rest under speed control and holds it there; infinite: at the torque limit."""
        if self.regulation is not Regulation.STOP:
            self._enter_speed_control(Regulation.STOP)
            self.reference = self.filtered_rad_s
            self._came_from = copysign(1.0, self.filtered_rad_s)
        self._target = 0.0
        self._up = self._down = decel_rad_s2

    def torque(self, target_nm: float, slope_nm_s: float = inf) -> None:
        """Regulates torque, along a ramp unless the slope is infinite."""
        if self.regulation is not Regulation.TORQUE:
            self.regulation = Regulation.TORQUE
            self.reference = self.demand_nm
            self._overspeed = 0.0
        self._target = target_nm
        self._up = self._down = slope_nm_s

    @property
    def ramp_done(self) -> bool:
        """The ramped setpoint has arrived at its target."""
        return self.reference == self._target

    @property
    def speed_reference_rad_s(self) -> float:
        """The ramped speed setpoint; 0 where speed is not regulated."""
        return self.reference if self.regulation in {Regulation.SPEED, Regulation.STOP} else 0.0

    @property
    def at_rest_reference(self) -> bool:
        """Speed control is asked for zero and the ramp has come down."""
        return self.regulation in {Regulation.SPEED, Regulation.STOP} and self.reference == 0.0 == self._target

    def step(self, measured_rad_s: float, dt_s: float) -> float:
        """The torque demand for the coming ``dt_s``, N·m."""
        self.filtered_rad_s += self._filter_gain * (measured_rad_s - self.filtered_rad_s)
        regulation = self.regulation
        if regulation is Regulation.OFF:
            return 0.0
        if self.reference != self._target:
            self._ramp(dt_s)
        if regulation is Regulation.TORQUE:
            wanted, speed_limited = self._torque_wanted(dt_s), self._overspeed != 0.0
            self.demand_nm = demand = max(-self.limits.torque_reverse_nm, min(self.limits.torque_forward_nm, wanted))
            self.limited = speed_limited or demand != wanted
            return demand
        return self._speed_loop(dt_s)

    def _enter_speed_control(self, regulation: Regulation) -> None:
        if self.regulation not in {Regulation.SPEED, Regulation.STOP}:
            self.reference = self.filtered_rad_s
            self._integral = self.demand_nm
        self.regulation = regulation

    def _ramp(self, dt_s: float) -> None:
        """Moves the reference towards the target: down to zero with one rate, away from zero with the other."""
        now, target = self.reference, self._target
        falling = now * target < 0.0 or abs(target) < abs(now)
        rate = self._down if falling else self._up
        if now * target < 0.0:
            target = 0.0
        move = rate * dt_s
        self.reference = target if abs(target - now) <= move else now + copysign(move, target - now)

    def _speed_loop(self, dt_s: float) -> float:
        params, limits = self._params, self.limits
        reference = self.reference
        limited = False
        if abs(reference) > limits.speed_rad_s:
            reference = copysign(limits.speed_rad_s, reference)
            limited = True
        if self.regulation is Regulation.STOP and self._came_from and self.filtered_rad_s * self._came_from <= 0.0:
            self._came_from = 0.0
            self._integral = self.reference = reference = 0.0
        error = reference - self.filtered_rad_s
        growth = params.speed_integral_gain_nm_rad * error * dt_s
        demand = params.speed_gain_nm_s_rad * error + self._integral
        if demand > limits.torque_forward_nm:
            demand, limited = limits.torque_forward_nm, True
            growth = min(growth, 0.0)
        elif demand < -limits.torque_reverse_nm:
            demand, limited = -limits.torque_reverse_nm, True
            growth = max(growth, 0.0)
        self._integral = max(-limits.torque_reverse_nm, min(limits.torque_forward_nm, self._integral + growth))
        self.demand_nm = demand
        self.limited = limited
        return demand

    def _torque_wanted(self, dt_s: float) -> float:
        """The ramped torque, less what the speed limit takes away."""
        params, limit = self._params, self.limits.speed_rad_s
        speed, taken = self.filtered_rad_s, self._overspeed
        if taken == 0.0 and -limit <= speed <= limit:
            return self.reference
        forward = taken > 0.0 or (taken == 0.0 and speed > limit)
        excess = speed - limit if forward else speed + limit
        taken += params.speed_integral_gain_nm_rad * excess * dt_s
        if (taken > 0.0) is not forward:
            self._overspeed = 0.0
            return self.reference
        bound = limits_sum(self.limits)
        self._overspeed = max(-bound, min(bound, taken))
        beyond = max(excess, 0.0) if forward else min(excess, 0.0)
        return self.reference - self._overspeed - params.speed_gain_nm_s_rad * beyond


def limits_sum(limits: Limits) -> float:
    """The most that the speed limiter may ever have to take away: from one torque limit to the other."""
    return limits.torque_forward_nm + limits.torque_reverse_nm
