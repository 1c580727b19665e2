"""The simulated drive's parameters: what each counts in, and what it does. What they start with: `starting`."""

from math import inf, pi

from profiles.modbus import ModbusProfile, Parameter
from sim_bus.modbus.codec import Layout
from sim_bus.modbus.requirement import meets
from sim_bus.modbus.starting import QUICK_STOP_RAD_S2, start
from sim_bus.modbus.wrong_maps import Wrong, something_else
from sim_bus.params import RigParams
from sim_bus.reporting import RPM

_BEYOND = 1e12
"""More than any register holds; finite."""


class Parameters:
    """Numbers as they stand in the drive's registers, and their values."""

    def __init__(self, profile: ModbusProfile, rig: RigParams, wrongs: tuple[Wrong, ...] = ()) -> None:
        self._profile = profile
        self._rig = rig
        self._by_name = {parameter.name: parameter for parameter in profile.parameters}
        self._by_role: dict[str, Parameter] = {one.set_to: one for one in profile.parameters if one.set_to}
        self._stored: dict[str, float] = {}        # counts; of a parameter without register its value
        self._acting: dict[str, float] = {}        # what still acts where another is stored: until a restart
        self._tenths = any(wrong.kind == "scale_10" for wrong in wrongs)
        self._other = {wrong.of for wrong in wrongs if wrong.kind == "reads_back_something_else"}
        self.not_kept = set[str]()                 # of these no writing is
        self.keeps = not any(wrong.kind == "write_not_applied" for wrong in wrongs)
        self.rated_rpm = start(self, profile, rig)

    # -- counts and values ---------------------------------------------------------------------------------

    def scale(self, per_lsb: float, unit: str, times: str | None, *, echo: bool = False) -> float:
        """Units for one count of a register; what echoes a setpoint counts in units of its own, right or not there."""
        tenth = 0.1 if self._tenths and unit != "none" and not echo else 1.0
        return per_lsb * tenth * (self.value(times) if times is not None else 1.0)

    def value(self, name: str) -> float:
        """In the parameter's unit."""
        parameter = self._by_name[name]
        acting = self._acting.get(name, self._stored[name])
        return acting if parameter.register_ is None else acting * self._scale_of(parameter)

    @property
    def untold(self) -> dict[str, float]:
        """Values of the parameters that can't be read over the bus."""
        return {name: value for name, value in self._stored.items() if self._by_name[name].register_ is None}

    def number(self, name: str) -> int:
        """What its register reads."""
        stored = round(self._stored[name])
        return something_else(stored) if name in self._other else stored

    def write(self, name: str, number: int) -> None:
        """What the host wrote there; kept unless the drive has that wrong."""
        if not self.keeps or name in self.not_kept:
            return
        if not self._by_name[name].writable_in_operation:
            self._acting.setdefault(name, self._stored[name])
        self._stored[name] = number

    def put(self, name: str, value: float) -> None:
        """Sets the value as closely as the register can."""
        parameter = self._by_name[name]
        if parameter.register_ is None:
            self._stored[name] = value
        else:
            counts = min(max(value / self._scale_of(parameter), -_BEYOND), _BEYOND)
            self._stored[name] = Layout(0, parameter.register_.type).saturated(counts)

    def _scale_of(self, parameter: Parameter) -> float:
        # The time of a ramp names the speed at its upper end, which doesn't multiply it.
        times = None if parameter.set_to in {"quick_stop_time", "ramp_up_time"} else parameter.times
        return self.scale(parameter.per_lsb, parameter.unit, times)

    # -- what they mean ------------------------------------------------------------------------------------

    @property
    def rated_torque_nm(self) -> float:
        """100 % torque, as the drive tells it; the rig's where it can't."""
        name = self._profile.rated_torque
        return self.value(name) if name is not None else self._rig.drive.rated_torque_nm

    def si(self, value: float, unit: str) -> float:
        """rad/s, rad/s², N·m or s of a value in a profile's unit."""
        if unit in {"rpm", "rpm_s"}:
            return value * RPM
        return value * self.rated_torque_nm if unit == "rated" else value

    def in_unit(self, si: float, unit: str) -> float:
        """The other way."""
        return si / self.si(1.0, unit)

    def met(self, name: str | None) -> bool:
        """The parameter reads as required; True where nothing is."""
        require = self._by_name[name].require if name is not None else None
        return require is None or name is None or meets(self.value(name), require)

    def quick_stop_rad_s2(self) -> float:
        """The deceleration that the parameters give; 0 in either of them: as hard as the torque limit lets."""
        parameter = self._by_role.get("quick_stop_deceleration")
        if parameter is not None:
            return self.value(parameter.name) * RPM or inf
        parameter = self._by_role.get("quick_stop_time")
        if parameter is None:
            return QUICK_STOP_RAD_S2
        time_s = self.value(parameter.name)
        return self.reference_rpm(parameter) * RPM / time_s if time_s else inf

    def limit_nm(self, role: str) -> float:
        """A torque limit's magnitude, never above what the rig's inverter has."""
        most = self._rig.drive.torque_limit_nm
        parameter = self._by_role.get(role) or self._by_role.get("torque_limit")
        return most if parameter is None else min(most, abs(self.si(self.value(parameter.name), parameter.unit)))

    def speed_limit_rad_s(self) -> float:
        """Forwards, never above the rig's; the simulated loops have one limit for both directions."""
        most = self._rig.drive.speed_limit_rpm * RPM
        parameter = self._by_role.get("speed_limit")
        return most if parameter is None else min(most, abs(self.si(self.value(parameter.name), parameter.unit)))

    def reference_rpm(self, parameter: Parameter) -> float:
        """The speed that a quick-stop time starts from."""
        return self.value(parameter.times) if parameter.times is not None else self.rated_rpm


def reporting_lag_s(profile: ModbusProfile, parameters: Parameters, signal: str) -> float | None:
    """The smoothing that the drive itself tells or documents for a signal; None where the profile says nothing."""
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
