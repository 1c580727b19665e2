r"""Gains as values of the drive's own parameters, if its profile lists them. tdhil does not write them to the drive.

::

    N·m·s/rad             P, at the motor shaft
    A·s/rad               P/K_t, with the motor's torque constant K_t, which no profile knows
    %/%                   P ω_r/T_r: torque in % of rated torque for a speed error in % of rated speed
    integral time         T_I = P/I

A notch has the values of its frequency, its width and depth, or its dampings, whichever the drive has.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi

from profiles import CONTROLLER_UNITS, NotchParameter, SpeedControllerParameters
from tdhil.soft_torque.controller import SpeedController


@dataclass(frozen=True)
class DriveSetting:
    """One parameter of the drive. If its unit or its rated value is unknown, ``value`` is None; ``why`` says which."""

    title: str
    value: float | None
    unit: str
    source: str
    confidence: str
    why: str = ""


def drive_settings(
    parameters: SpeedControllerParameters | None, at_motor: SpeedController,
    rated_torque_nm: float | None = None, rated_speed_rpm: float | None = None,
) -> tuple[DriveSetting, ...]:
    """Return the drive's parameter values for these gains at the motor shaft; () if the profile lists no parameters."""
    if parameters is None:
        return ()
    gain, integral = parameters.gain, parameters.integral
    value: float | None = None
    why, unit = "", CONTROLLER_UNITS.get(gain.unit, "?")
    if gain.unit == "nm_s_rad":
        value = at_motor.gain_nm_s_rad
    elif gain.unit == "a_s_rad":
        why = f"{at_motor.gain_nm_s_rad:.4g} N·m·s/rad divided by the motor's torque constant in N·m/A"
    elif gain.unit == "unknown":
        why = "its unit isn't known: look it up in the manual"
    elif rated_torque_nm is None or rated_speed_rpm is None:
        why = "needs --rated-torque and --rated-speed of the motor's name plate"
    else:
        value = at_motor.gain_nm_s_rad / one_percent_nm_s_rad(rated_torque_nm, rated_speed_rpm)
    proportional = DriveSetting(gain.title, value, unit, gain.source, gain.confidence, why)
    time_s = at_motor.gain_nm_s_rad / at_motor.integral_nm_rad
    number = {"s": time_s, "ms": 1e3 * time_s, "nm_rad": at_motor.integral_nm_rad}.get(integral.unit)
    why = "" if number is not None else "its unit isn't known: look it up in the manual"
    unit = CONTROLLER_UNITS.get(integral.unit, "?")
    return proportional, DriveSetting(integral.title, number, unit, integral.source, integral.confidence, why)


def one_percent_nm_s_rad(rated_torque_nm: float, rated_speed_rpm: float) -> float:
    """Return the gain T_r/ω_r, N·m·s/rad, that is 1 %/%."""
    return rated_torque_nm / (rated_speed_rpm * 2.0 * pi / 60.0)


_NOTCH_UNITS = {"frequency_hz": "Hz", "width_hz": "Hz", "depth_db": "dB"}


def notch_settings(
    parameters: tuple[NotchParameter, ...], values: Mapping[str, float | None]
) -> tuple[DriveSetting, ...]:
    """Return the drive's parameter values for a notch; () if the profile names none.

    ``values``: by `NotchParameter.quantity`; None for a width of −3 dB that a shallow notch does not have.
    """
    return tuple(
        DriveSetting(one.title, values[one.quantity], _NOTCH_UNITS.get(one.quantity, ""), one.source, one.confidence,
                     "" if values[one.quantity] is not None else "the notch is nowhere 3 dB deep")
        for one in parameters)
