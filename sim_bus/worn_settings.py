"""The manufacturer's settings of a worn profile: their objects, what they stand at, and what those that limit do.

A simulated drive is delivered ready: what a profile requires to be set by hand is set. `Settings.spoil` undoes one.
"""

from math import isfinite

from canopen.objectdictionary import datatypes

from profiles.canopen import CanopenProfile
from profiles.canopen_parameter import Parameter
from sim_bus.canopen.objects import ObjectStore, key_of
from sim_bus.cia402 import Application
from sim_bus.object_units import TURN

DATA_TYPES = {
    "u8": datatypes.UNSIGNED8, "u16": datatypes.UNSIGNED16, "u32": datatypes.UNSIGNED32, "i8": datatypes.INTEGER8,
    "i16": datatypes.INTEGER16, "i32": datatypes.INTEGER32, "f32": datatypes.REAL32,
}
_USUAL_COUNTS = 10_000.0
"""A limit stands at about so many counts where the profile doesn't know the constant that scales it."""

_USUAL_ENCODER = 4096.0
"""Counts a turn, where the profile divides by a resolution that it doesn't know."""


class WornSettings:
    """``raw`` is what stands in each object; `scales` what that means."""

    def __init__(self, profile: CanopenProfile, application: Application) -> None:
        self._profile = profile
        self._application = application
        self.raw: dict[str, float] = {}
        for one in profile.parameters:
            if one.set_to is None:
                self.raw[one.name] = self._delivered(one)
        for one in profile.parameters:
            if one.set_to is not None and one.from_speed is None:
                self.raw[one.name] = self._limit(one) / self._unit(one)
        for one in profile.parameters:
            if one.from_speed is not None:
                ramp_rpm_s = 60.0 * application.settings.quick_stop_rad_s2 / TURN
                self.raw[one.name] = self.value(one.from_speed) / ramp_rpm_s / self._unit(one)
        for one in profile.parameters:
            if one.type != "f32":
                self.raw[one.name] = float(round(self.raw[one.name]))

    def scales(self) -> dict[str, float]:
        """Every setting in its unit, but for limits."""
        return {one.name: self.value(one.name) for one in self._profile.parameters if one.set_to is None}

    def value(self, name: str) -> float:
        """In its unit."""
        one = self._profile.parameter(name)
        raw = self.raw[name]
        return float(2 ** int(raw)) if one.scale == "power_of_two" else raw * self._unit(one)

    def bind(self, store: ObjectStore) -> None:
        """Puts the objects into the store."""
        for one in self._profile.parameters:
            key = key_of(one.index, one.sub)
            store.add(one.index, one.sub, DATA_TYPES[one.type], writable=True, mappable=False, name=one.name)
            start = self.raw[one.name]
            store.set_default(one.index, one.sub, start if one.type == "f32" else int(start))
            if one.type == "f32":
                store.float_hooks[key] = self._hook(one.name)
            else:
                store.hooks[key] = self._hook(one.name)

    def _hook(self, name: str) -> "_Write":
        return _Write(self, name)

    def write(self, name: str, raw: float) -> None:
        """A new value, and everything that hangs on it."""
        self.raw[name] = raw
        limits, settings = self._application.inverter.control.limits, self._application.settings
        rated_nm = self._application.inverter.params.drive.rated_torque_nm
        for one in self._profile.parameters:
            if one.set_to is None or one.name not in self.raw:
                continue
            value = self.value(one.name)
            torque_nm = abs(value) * (1.0 if one.unit == "nm" else rated_nm)
            if one.set_to == "torque_limit":
                limits.torque_forward_nm = torque_nm
                if not any(other.set_to == "torque_limit_reverse" for other in self._profile.parameters):
                    limits.torque_reverse_nm = torque_nm
            elif one.set_to == "torque_limit_reverse":
                limits.torque_reverse_nm = torque_nm
            elif one.set_to == "speed_limit":
                limits.speed_rad_s = TURN * value / 60.0
            elif one.set_to == "quick_stop_deceleration":
                settings.quick_stop_rad_s2 = TURN * value / 60.0
            elif one.from_speed is not None and value > 0.0 and isfinite(value):
                settings.quick_stop_rad_s2 = TURN * self.value(one.from_speed) / 60.0 / value

    def _unit(self, one: Parameter) -> float:
        return one.per_lsb if one.times is None else one.per_lsb * self.value(one.times)

    def _delivered(self, one: Parameter) -> float:
        """What stands in the object: what is required, else the factory's, else what suits the simulated machine."""
        wanted = one.require
        if wanted is not None:
            value = wanted.equals if wanted.equals is not None else wanted.one_of[0] if wanted.one_of else one.default
            value = 0.0 if value is None else value
            value = max(value, wanted.at_least if wanted.at_least is not None else value)
            value = min(value, wanted.at_most if wanted.at_most is not None else value)
            counts = value / self._unit(one)
            if counts and wanted.at_least is None:
                return counts
        for user in self._profile.parameters:
            if user.times == one.name and not one.default:
                return self._limit(user) / (user.per_lsb * one.per_lsb * _USUAL_COUNTS)
        value = one.default or 0.0
        if not value and one.name in (*self._profile.speed.times, *self._profile.speed.over):
            value = _USUAL_ENCODER if one.name in self._profile.speed.over else 1.0
        if one.require is not None and one.require.at_least is not None:
            value = max(value, one.require.at_least)
        return value if one.scale == "power_of_two" else value / self._unit(one)

    def _limit(self, one: Parameter) -> float:
        """The simulated machine's own limit, in the parameter's unit."""
        drive = self._application.inverter.params.drive
        torque = drive.torque_limit_nm if one.unit == "nm" else drive.torque_limit_nm / drive.rated_torque_nm
        return {
            "torque_limit": torque, "torque_limit_reverse": -torque, "speed_limit": drive.speed_limit_rpm,
            "speed_limit_reverse": -drive.speed_limit_rpm,
            "quick_stop_deceleration": 60.0 * self._application.settings.quick_stop_rad_s2 / TURN,
        }.get(one.set_to or "", 1.0)


class _Write:
    """A write hook of one setting."""

    def __init__(self, settings: WornSettings, name: str) -> None:
        self._settings, self._name = settings, name

    def __call__(self, raw: float) -> None:
        self._settings.write(self._name, raw)
