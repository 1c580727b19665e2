"""What the simulated drive's parameters start with.

A rig decides what a profile leaves open. Rated torque and name plate are the rig's, consistent with each other (P =
T·ω, after rounding to their registers); a filter tells the lag that the drive has, and the drive has the lag that it
tells; whatever the profile requires of a hand-set parameter is set, and a watchdog that is set by hand is; everything
else is at its documented default.
"""

from math import inf, pi
from typing import Protocol

from profiles.errors import TdhilError
from profiles.modbus import ModbusProfile, Parameter
from sim_bus.modbus.codec import Layout
from sim_bus.modbus.requirement import meets, value_that_meets
from sim_bus.params import RigParams
from sim_bus.reporting import RPM

QUICK_STOP_RAD_S2 = 3.0
_FEWEST_POWER_COUNTS = 400
"""A name plate's power is told to a fraction of a percent."""
_NEAR_ENOUGH = 0.02
_TIME_OUT_S = 0.5
"""Of a watchdog that the host can't set."""


class Store(Protocol):
    """What is filled: `sim_bus.modbus.parameters.Parameters`."""

    def put(self, name: str, value: float) -> None: ...
    def value(self, name: str) -> float: ...
    def in_unit(self, si: float, unit: str) -> float: ...


def start(store: Store, profile: ModbusProfile, rig: RigParams) -> float:
    """Gives every parameter its first value; returns the rated speed, rpm. TdhilError where the rig doesn't fit."""
    plate = profile.name_plate
    torque_names = {name for name in (profile.rated_torque, plate and plate.torque) if name}
    rated_rpm = _fitting_rated_rpm(profile, rig)
    # What multiplies others comes before them.
    for parameter in sorted(profile.parameters, key=lambda one: (one.times is not None, one.name not in torque_names)):
        name = parameter.name
        if name in torque_names:
            _put_exactly(store, profile, name, rig.drive.rated_torque_nm)
        elif plate is not None and name == plate.speed:
            _put_exactly(store, profile, name, rated_rpm)
        elif plate is None or name != plate.power:
            store.put(name, _initial(store, profile, rig, parameter, rated_rpm))
    if plate is not None:
        store.put(plate.power, store.value(plate.torque) * store.value(plate.speed) * RPM / 1000.0)
    return rated_rpm


def _put_exactly(store: Store, profile: ModbusProfile, name: str, value: float) -> None:
    store.put(name, value)
    told = store.value(name)
    if abs(told - value) > _NEAR_ENOUGH * value:
        raise TdhilError(
            f"{profile.parameter(name).title} can't tell {value:g}: the nearest is {told:g}",
            where=f"profile {profile.name}, parameter {name}",
            next_step="Simulate a rig that fits this drive (--plant: drive.rated_torque_nm, drive.speed_limit_rpm)",
        )


def _fitting_rated_rpm(profile: ModbusProfile, rig: RigParams) -> float:
    """The speed limit, or what lets the registers of the name plate tell power and speed."""
    rpm = rig.drive.speed_limit_rpm
    if profile.name_plate is None:
        return rpm
    power, speed = profile.parameter(profile.name_plate.power), profile.parameter(profile.name_plate.speed)
    kw_per_rpm = rig.drive.rated_torque_nm * RPM / 1000.0
    if power.register_ is not None:
        rpm = max(rpm, _FEWEST_POWER_COUNTS * power.per_lsb / kw_per_rpm)
        rpm = min(rpm, Layout(0, power.register_.type).highest * power.per_lsb / kw_per_rpm)
    if speed.register_ is not None and speed.times is None:
        rpm = min(rpm, Layout(0, speed.register_.type).highest * speed.per_lsb)
    return rpm


def _initial(store: Store, profile: ModbusProfile, rig: RigParams, parameter: Parameter, rated_rpm: float) -> float:
    lag_s = _lag_s(profile, rig, parameter.name)
    if lag_s is not None:
        wanted = lag_s if parameter.unit != "hz" else 1.0 / (2.0 * pi * lag_s) if lag_s else inf
    elif parameter.name == profile.watchdog.parameter and parameter.set_to is None:
        wanted = _TIME_OUT_S
    elif parameter.default is not None:
        wanted = parameter.default
    else:
        wanted = _of_rig(store, rig, parameter, rated_rpm)
    require = parameter.require
    return wanted if require is None or meets(wanted, require) else value_that_meets(require)


def _lag_s(profile: ModbusProfile, rig: RigParams, name: str) -> float | None:
    """The rig's lag, for the first filter parameter of each signal; none for further ones."""
    for signal, lag_s in (("speed", rig.reporting.speed_lag_s), ("torque", rig.reporting.torque_lag_s)):
        names = [one.parameter for one in profile.filters if one.signal == signal and one.parameter]
        if name in names:
            return lag_s if name == names[0] else 0.0
    return None


def _of_rig(store: Store, rig: RigParams, parameter: Parameter, rated_rpm: float) -> float:
    drive = rig.drive
    kind = parameter.register_.type if parameter.register_ is not None else "i32"
    sign = -1.0 if kind[0] == "i" else 1.0
    match parameter.set_to:
        case "speed_limit":
            return drive.speed_limit_rpm
        case "speed_limit_reverse":
            return sign * drive.speed_limit_rpm
        case "torque_limit":
            return store.in_unit(drive.torque_limit_nm, parameter.unit)
        case "torque_limit_reverse":
            return sign * store.in_unit(drive.torque_limit_nm, parameter.unit)
        case "quick_stop_deceleration":
            return QUICK_STOP_RAD_S2 / RPM
        case "quick_stop_time":
            from_rpm = store.value(parameter.times) if parameter.times is not None else rated_rpm
            return from_rpm * RPM / QUICK_STOP_RAD_S2
    by_unit = {"rpm": rated_rpm, "nm": drive.rated_torque_nm, "rated": 1.0,
               "kw": drive.rated_torque_nm * rated_rpm * RPM / 1000.0}
    return by_unit.get(parameter.unit, 0.0)
