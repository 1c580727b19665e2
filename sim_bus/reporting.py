"""What the drive says about itself: a first-order lag on speed and on torque, noise, then a quantum.

The lag dy/dt = (x − y)/τ is exact for an input constant over the step: y ← y + (1 − e^(−h/τ)) (x − y).
Torque is constant over a step; of the speed the step's mean is taken.
"""

from math import expm1, pi

from sim_bus.params import RigParams

RPM = 2.0 * pi / 60.0
"""rad/s."""


def lag_gain(dt_s: float, lag_s: float) -> float:
    """1 − e^(−h/τ); 1 where there is no lag."""
    return -expm1(-dt_s / lag_s) if lag_s > 0.0 else 1.0


class Reporting:
    """Reported speed and torque, renewed with every step and held in between."""

    __slots__ = (
        "_params", "_speed_gain", "_speed_lagged", "_speed_quantum", "_torque_gain", "_torque_lagged",
        "_torque_quantum", "speed_rad_s", "speed_scale", "torque_nm", "torque_scale",
    )

    def __init__(self, rig: RigParams) -> None:
        self._params = rig.reporting
        self._speed_quantum = rig.reporting.speed_quantum_rpm * RPM
        self._torque_quantum = rig.reporting.torque_quantum_permille * rig.drive.rated_torque_nm / 1000.0
        self._speed_lagged = 0.0
        self._torque_lagged = 0.0
        self.speed_rad_s = 0.0
        self.torque_nm = 0.0
        self.speed_scale = self.torque_scale = 1.0
        """Scripted: what is reported is multiplied by these."""
        self.prepare(rig.drive.control_period_s)

    def prepare(self, dt_s: float) -> None:
        """Fits the lags to a step of ``dt_s``."""
        self._speed_gain = lag_gain(dt_s, self._params.speed_lag_s)
        self._torque_gain = lag_gain(dt_s, self._params.torque_lag_s)

    def step(self, speed_rad_s: float, torque_nm: float, speed_normal: float, torque_normal: float) -> None:
        """One step with the measured mean speed and the torque of that step, and two standard normals."""
        params = self._params
        self._speed_lagged = speed = self._speed_lagged + self._speed_gain * (speed_rad_s - self._speed_lagged)
        self._torque_lagged = torque = self._torque_lagged + self._torque_gain * (torque_nm - self._torque_lagged)
        speed = self.speed_scale * (speed + params.speed_noise_rad_s * speed_normal)
        torque = self.torque_scale * (torque + params.torque_noise_nm * torque_normal)
        quantum = self._speed_quantum
        self.speed_rad_s = round(speed / quantum) * quantum if quantum else speed
        quantum = self._torque_quantum
        self.torque_nm = round(torque / quantum) * quantum if quantum else torque
