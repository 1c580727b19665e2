"""The drive's inside with the shaft on it: measure, regulate, lag, disturb, move, report; one call per step.

::

    speed ω ──+ sensor noise──► control ──demand──► lag 10 ms ──+ noise──► torque ──► plant ──► ω
                                                                   │                     │
                                                        reporting: lags, noise, quanta ◄─┘

Owns no clock and no thread: whoever calls `step` says how much time goes by.
"""

import numpy as np

from sim_bus.control import Controller, Regulation
from sim_bus.noise import Disturbance, normals
from sim_bus.params import RigParams
from sim_bus.plant.kinds import MotorState, build
from sim_bus.plant.rigid import Params as RigidParams
from sim_bus.plant.rigid import State as RigidState
from sim_bus.reporting import Reporting, lag_gain


class Inverter:
    """Control, power stage and shaft of one simulated drive."""

    __slots__ = (
        "_disturbance", "_dt_s", "_lagged_nm", "_move", "_normals", "_torque_gain", "control", "params", "reporting",
        "state", "torque_nm",
    )

    def __init__(self, params: RigParams, rng: np.random.Generator) -> None:
        self.params = params
        self.control = Controller(params.drive)
        self.reporting = Reporting(params)
        plant = build(params.plant)
        self.state: MotorState = plant.rest()
        self._move = plant.step
        self.torque_nm = 0.0
        """True torque on the shaft during the last step."""
        self._disturbance = Disturbance(params.noise)
        self._normals = normals(rng)
        self._lagged_nm = 0.0
        self._dt_s = 0.0
        self._torque_gain = 1.0

    @property
    def speed_rad_s(self) -> float:
        """The motor shaft's true speed."""
        return self.state.speed_rad_s

    def step(self, dt_s: float) -> None:
        """Everything moves on by ``dt_s`` (at most the control period, see `steps`)."""
        if dt_s != self._dt_s:
            self._prepare(dt_s)
        sensor, ripple, load, speed_noise, torque_noise = next(self._normals)
        disturbance = self._disturbance
        speed = self.state.speed_rad_s
        offset = disturbance.sensor_sd_rad_s * sensor
        demand = self.control.step(speed + offset, dt_s)
        if self.control.regulation is Regulation.OFF:
            torque = self._lagged_nm = 0.0
        else:
            self._lagged_nm += self._torque_gain * (demand - self._lagged_nm)
            torque = self._lagged_nm + disturbance.torque_sd_nm * ripple
        self.torque_nm = torque
        self.state = state = self._move(self.state, torque, dt_s, disturbance.wander(load))
        self.reporting.step(0.5 * (speed + state.speed_rad_s) + offset, torque, speed_noise, torque_noise)

    def steps(self, duration_s: float) -> tuple[int, float]:
        """How many equal steps, none longer than the control period, make up ``duration_s``."""
        count = max(1, -int(-duration_s / self.params.drive.control_period_s * (1.0 - 1e-9) // 1))
        return count, duration_s / count

    def lose_load(self, share: float) -> None:
        """Scripted: what hangs on the motor comes off; a rigid shaft with this share of the motor end's is left."""
        motor, before = self.params.plant, self.state
        left = RigidParams(
            inertia_kg_m2=share * motor.inertia_kg_m2,
            viscous_nm_s_rad=share * motor.viscous_nm_s_rad,
            coulomb_nm=share * motor.coulomb_nm,
        )
        self.state = RigidState(before.speed_rad_s, before.angle_rad)
        self._move = build(left).step

    def _prepare(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._torque_gain = lag_gain(dt_s, self.params.drive.torque_lag_s)
        self._disturbance.prepare(dt_s)
        self.reporting.prepare(dt_s)
        self.control.prepare(dt_s)
