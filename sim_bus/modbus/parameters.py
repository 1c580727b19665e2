"""The simulated drive's parameters: their units and effects. `start` sets their initial values."""


from __future__ import annotations

from math import inf, pi

from profiles import MessageCode, Require, TdhilError
from profiles.modbus import ModbusProfile, Parameter
from sim_bus.inverter import RPM
from sim_bus.modbus.codec import RegisterLayout
from sim_bus.modbus.wrong_maps import Wrong, something_else
from sim_bus.params import RigParams
from sim_bus.speed_controller import speed_loop_settings

# ---------------------------------------------------------------------------------------------------------------------
# Required value of a parameter: check, and a value that meets it.


def meets(value: float, require: Require) -> bool:
    """Return whether the value is as required."""
    near = 1e-9 * max(1.0, abs(value))
    return (
        (require.equals is None or abs(value - require.equals) <= near)
        and (require.one_of is None or any(abs(value - one) <= near for one in require.one_of))
        and (require.at_least is None or value >= require.at_least - near)
        and (require.at_most is None or value <= require.at_most + near)
    )


def value_that_meets(require: Require) -> float:
    """Return a value that meets the requirement."""
    if require.equals is not None:
        return require.equals
    choices = require.one_of or tuple(one for one in (require.at_least, require.at_most) if one is not None)
    return next((one for one in choices if meets(one, require)), choices[0])


# ---------------------------------------------------------------------------------------------------------------------
# Initial values of the simulated drive's parameters.
#
# The rig determines values that a profile leaves open. Rated torque and name plate are the rig's, consistent with each
# other (P = T·ω, after rounding to their registers). A filter parameter and the drive's lag agree. A parameter that the
# profile requires to be set by hand is set, as is a watchdog that is set by hand. Every other parameter has its
# documented default.


QUICK_STOP_RAD_S2 = 3.0
_FEWEST_POWER_COUNTS = 400
"""Least counts of a name plate's power: its resolution is a fraction of a percent."""
_NEAR_ENOUGH = 0.02
_TIME_OUT_S = 0.5
"""Time-out of a watchdog that the host can't set, s."""


def start(store: ParameterStore, profile: ModbusProfile, rig: RigParams) -> float:
    """Set the initial value of every parameter. Return the rated speed, rpm. Raises TdhilError if the rig
    doesn't fit.
    """
    plate = profile.name_plate
    torque_names = {name for name in (profile.rated_torque, plate and plate.torque) if name}
    rated_rpm = _fitting_rated_rpm(profile, rig)
    gains = speed_loop_settings(profile.speed_controller, rig.drive, rated_rpm)
    # Parameters that multiply others come first.
    for parameter in sorted(profile.parameters, key=lambda one: (one.times is not None, one.name not in torque_names)):
        name = parameter.name
        if name in torque_names:
            _put_exactly(store, profile, name, rig.drive.rated_torque_nm)
        elif name in gains:
            store.put(name, gains[name])
        elif plate is not None and name == plate.speed:
            _put_exactly(store, profile, name, rated_rpm)
        elif plate is None or name != plate.power:
            store.put(name, _initial(store, profile, rig, parameter, rated_rpm))
    if plate is not None:
        store.put(plate.power, store.value(plate.torque) * store.value(plate.speed) * RPM / 1000.0)
    return rated_rpm


def _put_exactly(store: ParameterStore, profile: ModbusProfile, name: str, value: float) -> None:
    store.put(name, value)
    told = store.value(name)
    if abs(told - value) > _NEAR_ENOUGH * value:
        raise TdhilError(
            f"{profile.parameter(name).title} can't tell {value:g}: the nearest is {told:g}",
            where=f"profile {profile.name}, parameter {name}",
            next_step="Simulate a rig that fits this drive (--plant: drive.rated_torque_nm, drive.speed_limit_rpm)",
            entry=MessageCode.SIMULATOR_UNUSABLE,
        )


def _fitting_rated_rpm(profile: ModbusProfile, rig: RigParams) -> float:
    """Return the speed limit, rpm, changed so that the name plate's registers can hold power and speed."""
    rpm = rig.drive.speed_limit_rpm
    if profile.name_plate is None:
        return rpm
    power, speed = profile.parameter(profile.name_plate.power), profile.parameter(profile.name_plate.speed)
    kw_per_rpm = rig.drive.rated_torque_nm * RPM / 1000.0
    if power.register_ is not None:
        rpm = max(rpm, _FEWEST_POWER_COUNTS * power.per_lsb / kw_per_rpm)
        rpm = min(rpm, RegisterLayout(0, power.register_.type).highest * power.per_lsb / kw_per_rpm)
    if speed.register_ is not None and speed.times is None:
        rpm = min(rpm, RegisterLayout(0, speed.register_.type).highest * speed.per_lsb)
    return rpm


def _initial(
    store: ParameterStore, profile: ModbusProfile, rig: RigParams, parameter: Parameter, rated_rpm: float
) -> float:
    lag_s = _lag_s(profile, rig, parameter.name)
    if lag_s is not None:
        wanted = lag_s if parameter.unit != "hz" else 1.0 / (2.0 * pi * lag_s) if lag_s else inf
    elif parameter.name == profile.watchdog.parameter and parameter.set_to is None:
        wanted = _TIME_OUT_S
    elif parameter.default is not None:
        wanted = parameter.default
    else:
        drive, signed = rig.drive, parameter.register_ is None or parameter.register_.type[0] == "i"
        sign = -1.0 if signed else 1.0
        match parameter.set_to:
            case "speed_limit":
                wanted = drive.speed_limit_rpm
            case "speed_limit_reverse":
                wanted = sign * drive.speed_limit_rpm
            case "torque_limit":
                wanted = store.in_unit(drive.torque_limit_nm, parameter.unit)
            case "torque_limit_reverse":
                wanted = sign * store.in_unit(drive.torque_limit_nm, parameter.unit)
            case "quick_stop_deceleration":
                wanted = QUICK_STOP_RAD_S2 / RPM
            case "quick_stop_time":
                from_rpm = store.value(parameter.times) if parameter.times is not None else rated_rpm
                wanted = from_rpm * RPM / QUICK_STOP_RAD_S2
            case _:
                by_unit = {"rpm": rated_rpm, "nm": drive.rated_torque_nm, "rated": 1.0,
                           "kw": drive.rated_torque_nm * rated_rpm * RPM / 1000.0}
                wanted = by_unit.get(parameter.unit, 0.0)
    require = parameter.require
    return wanted if require is None or meets(wanted, require) else value_that_meets(require)


def _lag_s(profile: ModbusProfile, rig: RigParams, name: str) -> float | None:
    """Return the rig's lag, s, for the first filter parameter of each signal; 0 for further ones, None for other
    parameters.
    """
    for signal, lag_s in (("speed", rig.reporting.speed_lag_s), ("torque", rig.reporting.torque_lag_s)):
        names = [one.parameter for one in profile.filters if one.signal == signal and one.parameter]
        if name in names:
            return lag_s if name == names[0] else 0.0
    return None


# ---------------------------------------------------------------------------------------------------------------------

_BEYOND = 1e12
"""A finite number that is larger than any register holds."""


class ParameterStore:
    """Numbers in the drive's registers, and their values."""

    def __init__(self, profile: ModbusProfile, rig: RigParams, wrongs: tuple[Wrong, ...] = ()) -> None:
        self._profile = profile
        self._rig = rig
        self._by_name = {parameter.name: parameter for parameter in profile.parameters}
        self._by_role: dict[str, Parameter] = {one.set_to: one for one in profile.parameters if one.set_to}
        self._stored: dict[str, float] = {}        # counts; without a register the value
        self._acting: dict[str, float] = {}        # active value until a restart, if another one is stored
        self._tenths = any(wrong.kind == "scale_10" for wrong in wrongs)
        self._other = {wrong.of for wrong in wrongs if wrong.kind == "reads_back_something_else"}
        self.not_kept = set[str]()                 # names of parameters that keep their value
        self.keeps = not any(wrong.kind == "write_not_applied" for wrong in wrongs)
        self.rated_rpm = start(self, profile, rig)

    # -- counts and values ---------------------------------------------------------------------------------

    def scale(self, per_lsb: float, unit: str, times: str | None, *, echo: bool = False) -> float:
        """Return the units for one count of a register. An echo has a unit of its own, which the fault scale_10 does
        not change.
        """
        tenth = 0.1 if self._tenths and unit != "none" and not echo else 1.0
        return per_lsb * tenth * (self.value(times) if times is not None else 1.0)

    def value(self, name: str) -> float:
        """Return the value in the parameter's unit."""
        parameter = self._by_name[name]
        acting = self._acting.get(name, self._stored[name])
        return acting if parameter.register_ is None else acting * self._scale_of(parameter)

    @property
    def untold(self) -> dict[str, float]:
        """Values of the parameters that can't be read over the bus."""
        return {name: value for name, value in self._stored.items() if self._by_name[name].register_ is None}

    def number(self, name: str) -> int:
        """Return the number in its register."""
        stored = round(self._stored[name])
        return something_else(stored) if name in self._other else stored

    def write(self, name: str, number: int) -> None:
        """Take the value written by the host; it is kept unless the drive's map is wrong there."""
        if not self.keeps or name in self.not_kept:
            return
        if not self._by_name[name].writable_in_operation:
            self._acting.setdefault(name, self._stored[name])
        self._stored[name] = number

    def put(self, name: str, value: float) -> None:
        """Set the value as closely as the register permits."""
        parameter = self._by_name[name]
        if parameter.register_ is None:
            self._stored[name] = value
        else:
            counts = min(max(value / self._scale_of(parameter), -_BEYOND), _BEYOND)
            self._stored[name] = RegisterLayout(0, parameter.register_.type).saturated(counts)

    def _scale_of(self, parameter: Parameter) -> float:
        # `times` of a ramp time is the speed at the ramp's upper end, which is no factor.
        times = None if parameter.set_to in {"quick_stop_time", "ramp_up_time"} else parameter.times
        return self.scale(parameter.per_lsb, parameter.unit, times)

    # -- meaning -------------------------------------------------------------------------------------------

    @property
    def rated_torque_nm(self) -> float:
        """100 % torque, N·m, as the drive reports it; the rig's if it does not."""
        name = self._profile.rated_torque
        return self.value(name) if name is not None else self._rig.drive.rated_torque_nm

    def si(self, value: float, unit: str) -> float:
        """Convert a value in a profile's unit to rad/s, rad/s², N·m or s."""
        if unit in {"rpm", "rpm_s"}:
            return value * RPM
        return value * self.rated_torque_nm if unit == "rated" else value

    def in_unit(self, si: float, unit: str) -> float:
        """Convert a value from SI to a profile's unit."""
        return si / self.si(1.0, unit)

    def met(self, name: str | None) -> bool:
        """Return whether the parameter has the required value; True without a requirement."""
        require = self._by_name[name].require if name is not None else None
        return require is None or name is None or meets(self.value(name), require)

    def quick_stop_rad_s2(self) -> float:
        """Return the deceleration by the parameters, rad/s²; inf, at the torque limit, for a parameter of 0."""
        parameter = self._by_role.get("quick_stop_deceleration")
        if parameter is not None:
            return self.value(parameter.name) * RPM or inf
        parameter = self._by_role.get("quick_stop_time")
        if parameter is None:
            return QUICK_STOP_RAD_S2
        time_s = self.value(parameter.name)
        return self.reference_rpm(parameter) * RPM / time_s if time_s else inf

    def limit_nm(self, role: str) -> float:
        """Return the magnitude of a torque limit, N·m, at most that of the rig's inverter."""
        most = self._rig.drive.torque_limit_nm
        parameter = self._by_role.get(role) or self._by_role.get("torque_limit")
        return most if parameter is None else min(most, abs(self.si(self.value(parameter.name), parameter.unit)))

    def speed_limit_rad_s(self) -> float:
        """Return the forward speed limit, rad/s, at most the rig's. The simulated loops have one limit for both
        directions.
        """
        most = self._rig.drive.speed_limit_rpm * RPM
        parameter = self._by_role.get("speed_limit")
        return most if parameter is None else min(most, abs(self.si(self.value(parameter.name), parameter.unit)))

    def reference_rpm(self, parameter: Parameter) -> float:
        """Return the speed from which a quick-stop time counts, rpm."""
        return self.value(parameter.times) if parameter.times is not None else self.rated_rpm


def reporting_lag_s(profile: ModbusProfile, parameters: ParameterStore, signal: str) -> float | None:
    """Return the filter time constant that the drive reports or documents for a signal, s; None if the profile has
    none.
    """
    for one in profile.filters:
        if one.signal != signal:
            continue
        if one.parameter is None:
            return one.documented_s
        value = parameters.value(one.parameter)
        if profile.parameter(one.parameter).unit == "hz":
            return 1.0 / (2.0 * pi * value) if value > 0.0 else 0.0
        return value
    return None
