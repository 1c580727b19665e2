"""Inside of the drive with the shaft: measure, control, lag, disturb, move, report; one call per step.

::

    speed ω ──+ sensor noise──► control ──demand──► lag 10 ms ──+ noise──► torque ──► plant ──► ω
                                                                   │                     │
                                                        reporting: lags, noise, quanta ◄─┘

The drive's own units of torque and speed may be wrong (`ReportingParams`). Commanded, demanded and reported torque have
the same wrong unit, and so do commanded and reported speed. The position counts true turns.

It owns no clock and no thread: the caller of `step` states the time step.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from math import copysign, exp, expm1, inf, pi, sqrt
from typing import cast

import numpy as np

from sim_bus.params import DriveParams, NoiseParams, RigParams
from sim_bus.plant import LoadedState, MotorState, build
from sim_bus.plant import Params as RigidParams
from sim_bus.plant import ShaftState as RigidState
from sim_bus.reports import Feedback, Lies

# ---------------------------------------------------------------------------------------------------------------------
# Seeded disturbances: white sensor and torque noise, and a load that varies at random (Ornstein–Uhlenbeck process).
#
# The load obeys dx = −x/τ dt + sd √(2/τ) dW; sampled every h, exactly: x ← a x + sd √(1 − a²) n, a = e^(−h/τ). White
# noise is specified for a step of 2 ms; in a step of h its standard deviation is √(2 ms/h) times as large, so that its
# spectral density does not depend on the step.


REFERENCE_STEP_S = 0.002
CHANNELS = 5
"""Number of independent normal variates per step: speed sensor, torque, load, reported speed, reported torque."""
_BLOCK = 2048


def normals(rng: np.random.Generator) -> Iterator[list[float]]:
    """Yield endless rows of standard normal variates, drawn in blocks. One draw per step would cost more time than the
    plant.
    """
    while True:
        yield from rng.standard_normal((_BLOCK, CHANNELS)).tolist()


class Disturbance:
    """Random load, and standard deviations of the white noises for the present step."""

    __slots__ = ("_decay", "_kick", "_params", "load_nm", "sensor_sd_rad_s", "torque_sd_nm")

    def __init__(self, params: NoiseParams) -> None:
        self._params = params
        self.load_nm = 0.0
        self.prepare(REFERENCE_STEP_S)

    def prepare(self, dt_s: float) -> None:
        """Compute the coefficients for a step of ``dt_s``."""
        params = self._params
        self._decay = exp(-dt_s / params.load_correlation_s)
        self._kick = params.load_nm * sqrt(1.0 - self._decay**2)
        scale = sqrt(REFERENCE_STEP_S / dt_s)
        self.sensor_sd_rad_s = params.speed_sensor_rad_s * scale
        self.torque_sd_nm = params.torque_nm * scale

    def wander(self, normal: float) -> float:
        """Advance the load by one step and return it, N·m."""
        self.load_nm = self._decay * self.load_nm + self._kick * normal
        return self.load_nm


BIT_CUTS_RAD_S = 0.1
"""Speed of the bit from which on its random load acts in full, rad/s (1 rev/min). The load comes from cutting. A bit at
rest has none, because it would swing a string that hangs at rest."""


class BottomLoad:
    """Random load at a bit that turns, with a random stream of its own."""

    def __init__(self, params: NoiseParams, rng: np.random.Generator) -> None:
        self._params = params
        self._normals = (one for row in normals(rng) for one in row)
        self._load_nm = 0.0

    def wander(self, dt_s: float, speed_rad_s: float) -> float:
        """Advance the load by one step and return it for a bit of this speed, N·m."""
        decay = exp(-dt_s / self._params.bottom_correlation_s)
        kick = self._params.bottom_load_nm * sqrt(1.0 - decay**2)
        self._load_nm = decay * self._load_nm + kick * next(self._normals)
        return self._load_nm * min(1.0, abs(speed_rad_s) / BIT_CUTS_RAD_S)


# ---------------------------------------------------------------------------------------------------------------------
# Reported signals: a first-order lag on speed and on torque, noise, then quantisation.
#
# The lag dy/dt = (x − y)/τ is exact for an input constant over the step: y ← y + (1 − e^(−h/τ)) (x − y). The torque is
# constant over a step; for the speed the mean of the step is taken.


RPM = 2.0 * pi / 60.0
"""rad/s in one rev/min."""


def lag_gain(dt_s: float, lag_s: float) -> float:
    """Return 1 − e^(−h/τ); 1 without a lag."""
    return -expm1(-dt_s / lag_s) if lag_s > 0.0 else 1.0


class Reporting:
    """Reported speed and torque, updated with every step and held in between."""

    __slots__ = (
        "_dt_s", "_params", "_speed_gain", "_speed_lagged", "_speed_quantum", "_torque_gain", "_torque_lagged",
        "_torque_quantum", "lies", "speed_rad_s", "torque_nm",
    )

    def __init__(self, rig: RigParams, lies: Lies) -> None:
        self._params = rig.reporting
        self.lies = lies
        self._speed_quantum = rig.reporting.speed_quantum_rpm * RPM
        self._torque_quantum = rig.reporting.torque_quantum_permille * rig.drive.rated_torque_nm / 1000.0
        self._speed_lagged = 0.0
        self._torque_lagged = 0.0
        self.speed_rad_s = 0.0
        self.torque_nm = 0.0
        self.prepare(rig.drive.control_period_s)

    def prepare(self, dt_s: float) -> None:
        """Compute the lags for a step of ``dt_s``."""
        self._dt_s = dt_s
        self._speed_gain = lag_gain(dt_s, self._params.speed_lag_s)
        self._torque_gain = lag_gain(dt_s, self._params.torque_lag_s)

    def step(self, speed_rad_s: float, torque_nm: float, speed_normal: float, torque_normal: float) -> None:
        """Advance by one step: measured mean speed and torque of that step, and two standard normal variates."""
        params = self._params
        self._speed_lagged = speed = self._speed_lagged + self._speed_gain * (speed_rad_s - self._speed_lagged)
        self._torque_lagged = torque = self._torque_lagged + self._torque_gain * (torque_nm - self._torque_lagged)
        speed += params.speed_noise_rad_s * speed_normal
        torque += params.torque_noise_nm * torque_normal
        if self.lies.of_values:
            speed = self.lies.told(Feedback.SPEED, speed, self._dt_s)
            torque = self.lies.told(Feedback.TORQUE, torque, self._dt_s)
        quantum = self._speed_quantum
        self.speed_rad_s = round(speed / quantum) * quantum if quantum else speed
        quantum = self._torque_quantum
        self.torque_nm = round(torque / quantum) * quantum if quantum else torque


# ---------------------------------------------------------------------------------------------------------------------
# The drive's control loops: speed PI with anti-windup, torque mode under a speed limit, ramps, bumpless switching.
#
# Speed control: e = ramped reference − filtered speed, demand = K_p e + I, dI/dt = K_i e, clamped to the torque limits.
# The integral is held while the clamp acts and e would drive it further into the clamp. The reference may be smoothed
# first. A torque offset (CiA 402-2, 60B2h) is added to the demand, inside the clamp. The standard does not define it in
# a quick stop. Here it acts during all speed control, which is the worse case for the stop.
#
# Torque mode: demand = ramped torque − K_p x − I with x the speed beyond the limit and dI/dt = K_i x, I ≥ 0. Below the
# limit the limiter has no effect, and in the steady state the limit is held exactly. The negative side is the same.
#
# Switching: to speed, the integral starts at the present torque demand and a ramp at the actual speed; to torque, a
# ramp starts at the present torque demand. A setpoint without ramp acts at once: the caller that switches sets it
# first.
#
# Stopping: the ramp starts at the actual speed. When the speed has reached zero, the integral is cleared. Until then it
# held the braking torque; after that it would drive the shaft backwards.


class Regulation(Enum):
    """Controlled quantity."""

    __hash__ = object.__hash__     # Enum's own is Python code, too slow for a look-up in every step

    OFF = "off"
    SPEED = "speed"
    STOP = "stop"
    TORQUE = "torque"


@dataclass(slots=True)
class LoopLimits:
    """Limits of the loops; the torque of each direction is positive."""

    torque_forward_nm: float
    torque_reverse_nm: float
    speed_rad_s: float


class Controller:
    """Control loops with their states; `step` is called with the measured speed once per control period."""

    __slots__ = (
        "_came_from",
        "_down",
        "_filter_gain",
        "_integral",
        "_overspeed",
        "_params",
        "_reference_gain",
        "_smoothed",
        "_target",
        "_up",
        "demand_nm",
        "filtered_rad_s",
        "limited",
        "limits",
        "offset_nm",
        "reference",
        "regulation",
    )

    def __init__(self, params: DriveParams) -> None:
        self._params = params
        self.limits = LoopLimits(params.torque_limit_nm, params.torque_limit_nm, params.speed_limit_rpm * RPM)
        self.regulation = Regulation.OFF
        self.limited = False           # torque or speed limit acting
        self.filtered_rad_s = 0.0
        self.demand_nm = 0.0
        self.reference = 0.0           # ramped setpoint: rad/s, or N·m in torque mode
        self._target = 0.0
        self._up = inf                 # ramp away from zero, per second
        self._down = inf               # ramp towards zero, per second
        self._integral = 0.0
        self._overspeed = 0.0          # integral of the speed limiter, N·m
        self._came_from = 0.0          # sign of the speed when the stop began
        self.offset_nm = 0.0           # torque offset
        self._smoothed = 0.0           # filtered reference, rad/s
        self.prepare(params.control_period_s)

    def prepare(self, dt_s: float) -> None:
        """Compute the speed and reference filters for a step of ``dt_s``."""
        self._filter_gain = lag_gain(dt_s, self._params.speed_filter_s)
        self._reference_gain = lag_gain(dt_s, self._params.reference_filter_s)

    def off(self) -> None:
        """Set torque to zero; the shaft coasts."""
        if self.regulation is not Regulation.OFF:
            self.regulation = Regulation.OFF
            self.demand_nm = self._integral = self._overspeed = 0.0
            self.limited = False

    def speed(self, target_rad_s: float, accel_rad_s2: float = inf, decel_rad_s2: float = inf) -> None:
        """Control speed, along a ramp unless the rates are infinite."""
        if self.regulation is not Regulation.SPEED:
            self._enter_speed_control(Regulation.SPEED)
        self._target = target_rad_s
        self._up, self._down = accel_rad_s2, decel_rad_s2

    def stop(self, decel_rad_s2: float = inf) -> None:
        """Bring the shaft to standstill under speed control and hold it there; infinite: at the torque limit."""
        if self.regulation is not Regulation.STOP:
            self._enter_speed_control(Regulation.STOP)
            self.reference = self.filtered_rad_s
            self._came_from = copysign(1.0, self.filtered_rad_s)
        self._target = 0.0
        self._up = self._down = decel_rad_s2

    def torque(self, target_nm: float, slope_nm_s: float = inf) -> None:
        """Control torque, along a ramp unless the slope is infinite."""
        if self.regulation is not Regulation.TORQUE:
            self.regulation = Regulation.TORQUE
            self.reference = self.demand_nm
            self._overspeed = 0.0
        self._target = target_nm
        self._up = self._down = slope_nm_s

    @property
    def ramp_done(self) -> bool:
        """True if the ramped setpoint has reached its target."""
        return self.reference == self._target

    @property
    def speed_reference_rad_s(self) -> float:
        """Ramped speed setpoint, rad/s; 0 if speed is not controlled."""
        return self.reference if self.regulation in {Regulation.SPEED, Regulation.STOP} else 0.0

    @property
    def at_rest_reference(self) -> bool:
        """True if speed control has a setpoint of zero and the ramp has ended."""
        return self.regulation in {Regulation.SPEED, Regulation.STOP} and self.reference == 0.0 == self._target

    def step(self, measured_rad_s: float, dt_s: float) -> float:
        """Return the torque demand for the coming ``dt_s``, N·m."""
        self.filtered_rad_s += self._filter_gain * (measured_rad_s - self.filtered_rad_s)
        regulation = self.regulation
        if regulation is Regulation.OFF:
            return 0.0
        if self.reference != self._target:
            self._ramp(dt_s)
        if regulation is Regulation.TORQUE:
            limits = self.limits
            if self._overspeed == 0.0 and -limits.speed_rad_s <= self.filtered_rad_s <= limits.speed_rad_s:
                wanted = self.reference        # the usual case: the speed limiter has no effect
            else:
                wanted = self._torque_wanted(dt_s)
            demand = wanted
            if not -limits.torque_reverse_nm <= wanted <= limits.torque_forward_nm:
                demand = max(-limits.torque_reverse_nm, min(limits.torque_forward_nm, wanted))
            self.demand_nm = demand
            self.limited = self._overspeed != 0.0 or demand != wanted
            return demand
        return self._speed_loop(dt_s)

    def _enter_speed_control(self, regulation: Regulation) -> None:
        if self.regulation not in {Regulation.SPEED, Regulation.STOP}:
            self.reference = self._smoothed = self.filtered_rad_s
            self._integral = self.demand_nm - self.offset_nm
        self.regulation = regulation

    def _ramp(self, dt_s: float) -> None:
        """Advance the reference towards the target: down to zero with one rate, away from zero with the other."""
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
        if self._reference_gain != 1.0:
            self._smoothed += self._reference_gain * (reference - self._smoothed)
            reference = self._smoothed
        error = reference - self.filtered_rad_s
        growth = params.speed_integral_gain_nm_rad * error * dt_s
        demand = params.speed_gain_nm_s_rad * error + self._integral + self.offset_nm
        if demand > limits.torque_forward_nm:
            demand, limited = limits.torque_forward_nm, True
            growth = min(growth, 0.0)
        elif demand < -limits.torque_reverse_nm:
            demand, limited = -limits.torque_reverse_nm, True
            growth = max(growth, 0.0)
        integral = self._integral + growth
        if not -limits.torque_reverse_nm <= integral <= limits.torque_forward_nm:
            integral = max(-limits.torque_reverse_nm, min(limits.torque_forward_nm, integral))
        self._integral = integral
        self.demand_nm = demand
        self.limited = limited
        return demand

    def _torque_wanted(self, dt_s: float) -> float:
        """Return the ramped torque minus the torque of the speed limiter. The limiter acts while or after the shaft is
        too fast.
        """
        params, limit = self._params, self.limits.speed_rad_s
        speed, taken = self.filtered_rad_s, self._overspeed
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


def limits_sum(limits: LoopLimits) -> float:
    """Return the largest torque of the speed limiter, N·m: from one torque limit to the other."""
    return limits.torque_forward_nm + limits.torque_reverse_nm


# ---------------------------------------------------------------------------------------------------------------------

class Inverter:
    """Control, power stage and shaft of one simulated drive."""

    __slots__ = (
        "_bottom_load", "_disturbance", "_divided_s", "_division", "_dt_s", "_lagged_nm", "_move", "_normals",
        "_speed_scale", "_torque_gain", "_torque_scale", "control", "lies", "params", "reporting", "state", "torque_nm",
    )

    def __init__(self, params: RigParams, rng: np.random.Generator) -> None:
        self.params = params
        self.control = Controller(params.drive)
        self.lies = Lies()
        """Scripted: distortions by sensor, power stage and reports."""
        self.reporting = Reporting(params, self.lies)
        plant = build(params.plant)
        self.state: MotorState = plant.rest()
        self._move: Callable[..., MotorState] = plant.step
        self.torque_nm = 0.0
        """True torque on the shaft during the last step, N·m."""
        self._disturbance = Disturbance(params.noise)
        self._normals = normals(rng)
        self._bottom_load = BottomLoad(params.noise, rng.spawn(1)[0]) if params.noise.bottom_load_nm > 0.0 else None
        self._lagged_nm = 0.0
        self._torque_scale, self._speed_scale = params.reporting.torque_scale, params.reporting.speed_scale
        self._dt_s = 0.0
        self._divided_s, self._division = 0.0, (1, 0.0)
        self._torque_gain = 1.0

    @property
    def speed_rad_s(self) -> float:
        """True speed of the motor shaft, rad/s."""
        return self.state.speed_rad_s

    @property
    def reported_demand_nm(self) -> float:
        """Torque demand as the drive reports it, N·m."""
        return self.lies.last(Feedback.DEMAND, self.control.demand_nm)

    @property
    def reported_angle_rad(self) -> float:
        """Angle of the motor shaft as the drive's sensor counts it and the drive reports it, rad."""
        return self.lies.angle_rad(self.state.angle_rad)

    def step(self, dt_s: float) -> None:
        """Advance by ``dt_s`` (at most the control period, see `steps`)."""
        if dt_s != self._dt_s:
            self._prepare(dt_s)
        sensor, ripple, load, speed_noise, torque_noise = next(self._normals)
        disturbance, lies = self._disturbance, self.lies
        speed, angle = self.state.speed_rad_s, self.state.angle_rad
        offset = disturbance.sensor_sd_rad_s * sensor
        scale = self._speed_scale
        measured = scale * lies.measured(speed, offset, dt_s) if lies.of_sensor else scale * speed + offset
        demand = self.control.step(measured, dt_s)
        if self.control.regulation is Regulation.OFF:
            torque = believed = self._lagged_nm = 0.0
        else:
            self._lagged_nm += self._torque_gain * (demand - self._lagged_nm)
            torque = believed = self._lagged_nm + disturbance.torque_sd_nm * ripple
            if lies.of_stage:
                torque, believed = lies.torque(torque, stopping=self.control.regulation is Regulation.STOP)
            torque /= self._torque_scale
        self.torque_nm = torque
        at_motor = disturbance.wander(load)
        if self._bottom_load is None:
            self.state = state = self._move(self.state, torque, dt_s, at_motor)
        else:
            at_bit = self._bottom_load.wander(dt_s, cast(LoadedState, self.state).bottom_speed_rad_s)
            self.state = state = self._move(self.state, torque, dt_s, at_motor, at_bit)
        mean = 0.5 * scale * (speed + state.speed_rad_s) + offset
        if lies.of_sensor:
            mean = measured
            lies.turned(state.angle_rad - angle, dt_s)
        self.reporting.step(mean, believed, speed_noise, torque_noise)
        if lies.of_values:
            lies.told(Feedback.DEMAND, self.control.demand_nm, dt_s)
            lies.told(Feedback.POSITION, lies.counted_rad(state.angle_rad), dt_s)

    def steps(self, duration_s: float) -> tuple[int, float]:
        """Return the number and length, s, of equal steps that make up ``duration_s``, none longer than the control
        period.
        """
        if duration_s != self._divided_s:
            count = max(1, -int(-duration_s / self.params.drive.control_period_s * (1.0 - 1e-9) // 1))
            self._divided_s, self._division = duration_s, (count, duration_s / count)
        return self._division

    def lose_load(self, share: float) -> None:
        """Scripted: disconnect the load. A rigid shaft with this share of the motor end's inertia and
        friction is left.
        """
        motor, before = self.params.plant, self.state
        left = RigidParams(
            inertia_kg_m2=share * motor.inertia_kg_m2,
            viscous_nm_s_rad=share * motor.viscous_nm_s_rad,
            coulomb_nm=share * motor.coulomb_nm,
            harmonics=motor.harmonics,
        )
        self.state = RigidState(before.speed_rad_s, before.angle_rad)
        self._bottom_load = None
        self._move = build(left).step

    def _prepare(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._torque_gain = lag_gain(dt_s, self.params.drive.torque_lag_s)
        self._disturbance.prepare(dt_s)
        self.reporting.prepare(dt_s)
        self.control.prepare(dt_s)
