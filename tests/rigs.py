"""Rig of the tests, declared once: its limits for each reader, its files, its plant.

It is the rig of the simulated drive: 0.5 to 10 rad/s, 400 N·m, 15 minutes. A test states only its differences.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivers.drive import DriveLimits
from sim_bus.params import FAITHFUL, QUIET, RigParams
from tdhil.config.rig import Rig, load_rig
from tdhil.runner.settings import MachineLimits

NUMBERS = {
    "speed_min_rad_s": 0.5, "speed_max_rad_s": 10.0, "torque_nm": 400.0, "time_s": 900.0, "quick_stop_rad_s2": 2.0,
    "watchdog_s": 0.5, "probe_torque_nm": 200.0, "probe_travel_rad": 3.0,
}
"""Limits by their keys in rig.yaml, SI at the motor shaft."""

LIMITS = MachineLimits(**NUMBERS)
"""Limits for the runner."""

DRIVE_LIMITS = DriveLimits(LIMITS.speed_max_rad_s, LIMITS.torque_nm, LIMITS.quick_stop_rad_s2, LIMITS.watchdog_s)
"""Limits for a drive."""

QUIET_RIG = RigParams(noise=QUIET, reporting=FAITHFUL)
"""Simulated drive and shaft without noise, lag and rounding."""

STRING = "load: string\nmake_up_torque_nm: 29000\ntorque_ramp_nm_s: 400\n"
"""Keys of rig.yaml for a drill string on the shaft."""


@dataclass(frozen=True, kw_only=True)
class FieldRig:
    """Shaft and disturbances of that rig for the benches without a simulated drive; noises as standard deviations."""

    inertia: float = 104.0
    viscous: float = 8.0
    coulomb: float = 60.0
    torque_lag: float = 0.010        # lag of the motor torque
    load_sd: float = 3.0             # Ornstein-Uhlenbeck load disturbance
    load_time: float = 0.5
    ripple_sd: float = 10.0          # motor torque, white per step
    sensor_sd: float = 0.02          # speed sensor, white per step
    speed_noise: float = 0.003       # of the report
    torque_noise: float = 2.0
    speed_quantum: float = 0.0105
    torque_quantum: float = 1.0


def limits_text(**changes: object) -> str:
    """Return the section `limits` of a rig.yaml, a line for each key. A key that is None is left out."""
    lines = [f"  {key}: {value}\n" for key, value in {**NUMBERS, **changes}.items() if value is not None]
    return "".join(["limits:\n", *lines])


PATIENT_S = 5.0
"""Watchdog time for real time on a busy computer, where a loop may pause for half of it."""
PATIENT_LIMITS = limits_text(watchdog_s=PATIENT_S)


def rig_file(folder: Path, *parts: str, name: str = "rig.yaml") -> Path:
    """Write a rig.yaml of these parts, and return its path."""
    path = folder / name
    path.write_text("".join(parts), encoding="utf-8")
    return path


def loaded_rig(folder: Path, *parts: str) -> Rig:
    """Return the rig of a rig.yaml of these parts. Raises DataFileError as its reader does."""
    return load_rig(rig_file(folder, *parts))


def plant_file(folder: Path, *parts: str) -> Path:
    """Write a plant.yaml of these parts, and return its path."""
    return rig_file(folder, *parts, name="plant.yaml")
