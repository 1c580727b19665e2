"""Gains of the simulated drive's speed loop, in the units of a profile's ``speed_controller``."""

from math import pi

from profiles import SpeedControllerParameters
from sim_bus.params import DriveParams


def speed_loop_settings(
    parameters: SpeedControllerParameters | None, drive: DriveParams, rated_rpm: float
) -> dict[str, float]:
    """Return the value of each parameter that shows a gain, by its name, in the unit of the profile.

    ``rated_rpm``: the speed that is 100 %. An integral time of 0 means no integral part.
    """
    if parameters is None:
        return {}
    gain, integral = drive.speed_gain_nm_s_rad, drive.speed_integral_gain_nm_rad
    time_s, filter_s = (gain / integral if integral else 0.0), drive.speed_filter_s
    rated_speed_rad_s = rated_rpm * 2.0 * pi / 60.0
    shown = {
        "gain": {"percent_per_percent": gain * rated_speed_rad_s / drive.rated_torque_nm}.get(
            parameters.gain.unit, gain),
        "integral": {"nm_rad": integral, "ms": 1000.0 * time_s}.get(parameters.integral.unit, time_s),
    }
    if parameters.filter is not None:
        cut_off_hz = 1.0 / (2.0 * pi * filter_s) if filter_s else 0.0
        shown["filter"] = {"hz": cut_off_hz, "ms": 1000.0 * filter_s}.get(parameters.filter.unit, filter_s)
    return {name: shown[part] for part, name in parameters.read_from().items()}
