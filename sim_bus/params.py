"""All settings of the simulated rig; ``plant.yaml`` may replace each of them.

The defaults are a field-like rig: they reproduce the paper's four field slopes with one inertia. A noise, lag or
quantum of 0 switches that effect off.
"""

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from profiles import NonNegative, Positive, Validated, refuse_if
from sim_bus.plant import AnyPlantParams
from sim_bus.plant import Params as PlantParams

SCALES = (0.1, 10.0)
"""Smallest and largest ratio of a drive's own unit to the true one."""


class DriveParams(Validated):
    """The inverter's own ratings and loops."""

    rated_torque_nm: Positive = 1000.0
    rated_current_a: Positive = 200.0
    torque_limit_nm: Positive = 400.0
    speed_limit_rpm: Positive = 200.0
    quick_stop_rad_s2: Positive = 3.0
    """Deceleration of a quick stop as set at the drive, rad/s². A host may write another one where the drive takes it.
    A Modbus drive has that of its registers.
    """
    speed_gain_nm_s_rad: NonNegative = 300.0
    speed_integral_gain_nm_rad: NonNegative = 300.0
    speed_filter_s: NonNegative = 0.02
    reference_filter_s: NonNegative = 0.0
    """First-order filter of the speed setpoint, before the speed loop."""
    torque_lag_s: NonNegative = 0.01
    control_period_s: float = Field(default=0.002, gt=0.0, le=0.01)
    """Longest step of control and plant, s."""


class ReportingParams(Validated):
    """Processing of speed and torque between the drive's inside and its bus."""

    speed_lag_s: NonNegative = 0.40
    torque_lag_s: NonNegative = 0.15
    speed_noise_rad_s: NonNegative = 0.003
    torque_noise_nm: NonNegative = 2.0
    speed_quantum_rpm: NonNegative = 0.1
    torque_quantum_permille: NonNegative = 1.0
    """Resolution of the torque, ‰ of rated torque."""
    torque_scale: float = Field(default=1.0, ge=SCALES[0], le=SCALES[1])
    """Torque in the drive's own unit over true torque. Commanded, demanded and reported torque share it."""
    speed_scale: float = Field(default=1.0, ge=SCALES[0], le=SCALES[1])
    """Speed in the drive's own unit over true speed, commanded and reported. The position counts true turns."""


class NoiseParams(Validated):
    """Standard deviations of the disturbances; those of white noise are for a plant step of 2 ms."""

    speed_sensor_rad_s: NonNegative = 0.02
    torque_nm: NonNegative = 10.0
    load_nm: NonNegative = 3.0
    load_correlation_s: Positive = 0.5
    bottom_load_nm: NonNegative = 0.0
    """Random load at the bit of a string, N·m."""
    bottom_correlation_s: Positive = 0.5


class RigParams(Validated):
    """The simulated rig."""

    plant: AnyPlantParams = PlantParams()
    drive: DriveParams = DriveParams()
    reporting: ReportingParams = ReportingParams()
    noise: NoiseParams = NoiseParams()

    @model_validator(mode="after")
    def _has_a_bottom(self) -> Self:
        rigid = isinstance(self.plant, PlantParams) and self.noise.bottom_load_nm > 0.0
        refuse_if([("noise.bottom_load_nm", "needs a plant with a bottom: kind two_mass or string")] * rigid)
        return self

    def with_scales(
        self, torque_scale: float | None, speed_scale: float | None, added_inertia_kg_m2: float | None
    ) -> Self:
        """Return the rig with these values, each checked by the model of its section; None: as before."""
        told = {"torque_scale": torque_scale, "speed_scale": speed_scale}
        scales = {name: value for name, value in told.items() if value is not None}
        body = {} if added_inertia_kg_m2 is None else {"added_inertia_kg_m2": added_inertia_kg_m2}
        return self.model_copy(update={
            "reporting": self.reporting.model_copy(update=scales), "plant": self.plant.model_copy(update=body),
        })


QUIET = NoiseParams(speed_sensor_rad_s=0.0, torque_nm=0.0, load_nm=0.0)
"""Noise parameters without any disturbance."""

FAITHFUL = ReportingParams(
    speed_lag_s=0.0, torque_lag_s=0.0, speed_noise_rad_s=0.0, torque_noise_nm=0.0,
    speed_quantum_rpm=0.0, torque_quantum_permille=0.0,
)
"""Reporting parameters without any error: the reports are the true values."""


def load_rig(path: Path) -> RigParams:
    """Read ``plant.yaml``. Raises `profiles.errors.DataFileError` with every problem and its line."""
    from profiles import load_model

    return load_model(path, RigParams)
