"""A simulated CiA 402 drive with a profile, on any bus: its identity, its objects and missing objects, its units.

Entries that the profile does not state stay as in our own EDS. The marker object stays too: a simulated drive shows
that it is simulated.
"""

from math import isfinite, nan

from canopen.objectdictionary import datatypes

from profiles.cia402 import Cia402Profile, Parameter
from sim_bus.application_objects import (
    SPEED_LOOP_INDEX,
    TURN,
    ObjectUnits,
    clamped,
    counts_per_turn,
    profile_units,
    wrapped,
)
from sim_bus.cia402 import Application, OperationMode
from sim_bus.objects import ObjectStore, key_of
from sim_bus.reports import Feedback
from sim_bus.speed_controller import speed_loop_settings

# ---------------------------------------------------------------------------------------------------------------------
# Manufacturer's settings of an emulated profile: their objects, initial values, and the effect of those that limit.
#
# The initial values include the settings that the profile requires to be set by hand.


DATA_TYPES = {
    "u8": datatypes.UNSIGNED8, "u16": datatypes.UNSIGNED16, "u32": datatypes.UNSIGNED32, "i8": datatypes.INTEGER8,
    "i16": datatypes.INTEGER16, "i32": datatypes.INTEGER32, "f32": datatypes.REAL32,
}
_USUAL_COUNTS = 10_000.0
"""Approximate initial value of a limit, counts, if the profile does not state the constant that scales it."""

_USUAL_ENCODER = 4096.0
"""Counts of a turn, if the profile divides by a resolution that it does not state."""


class WornSettings:
    """Manufacturer's settings. ``raw``: value in each object, counts. `scales`: values in their units."""

    def __init__(self, profile: Cia402Profile, application: Application) -> None:
        self._profile = profile
        self._application = application
        self.raw: dict[str, float] = {}
        drive = application.inverter.params.drive
        self._speed_loop = speed_loop_settings(profile.speed_controller, drive, drive.speed_limit_rpm)
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
        """Return every setting in its unit, except limits."""
        return {one.name: self.value(one.name) for one in self._profile.parameters if one.set_to is None}

    def value(self, name: str) -> float:
        """Return the value in its unit."""
        one = self._profile.parameter(name)
        raw = self.raw[name]
        return float(2 ** int(raw)) if one.scale == "power_of_two" else raw * self._unit(one)

    def bind(self, store: ObjectStore) -> None:
        """Add the objects to the store."""
        for one in self._profile.parameters:
            key = key_of(one.index, one.sub)
            store.add(one.index, one.sub, DATA_TYPES[one.type], writable=one.name not in self._speed_loop,
                      mappable=False, name=one.name)
            start = self.raw[one.name]
            store.set_default(one.index, one.sub, start if one.type == "f32" else int(start))
            if one.type == "f32":
                store.float_hooks[key] = self._hook(one.name)
            else:
                store.hooks[key] = self._hook(one.name)

    def _hook(self, name: str) -> "_Write":
        return _Write(self, name)

    def write(self, name: str, raw: float) -> None:
        """Store a new value, and update everything that depends on it."""
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
        """Return the object's initial value: as required, else the factory's, else one that suits the simulated
        machine.
        """
        if one.name in self._speed_loop:
            return self._speed_loop[one.name] / self._unit(one)
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
        """Return the simulated machine's own limit, in the parameter's unit."""
        drive = self._application.inverter.params.drive
        torque = drive.torque_limit_nm if one.unit == "nm" else drive.torque_limit_nm / drive.rated_torque_nm
        return {
            "torque_limit": torque, "torque_limit_reverse": -torque, "speed_limit": drive.speed_limit_rpm,
            "speed_limit_reverse": -drive.speed_limit_rpm,
            "quick_stop_deceleration": 60.0 * self._application.settings.quick_stop_rad_s2 / TURN,
        }.get(one.set_to or "", 1.0)


class _Write:
    """Write hook of one setting."""

    def __init__(self, settings: WornSettings, name: str) -> None:
        self._settings, self._name = settings, name

    def __call__(self, raw: float) -> None:
        self._settings.write(self._name, raw)


# ---------------------------------------------------------------------------------------------------------------------

_REACTIONS = {"none": 0, "fault_reaction": 1, "coast": 2, "quick_stop": 3}
"""Value of 6007h for each reaction."""
_QUICK_STOP_RAMP = 2
_CYCLIC_SYNCHRONOUS = {OperationMode.CYCLIC_VELOCITY, OperationMode.CYCLIC_TORQUE}


class WornProfile:
    """Emulation of a profile. It is made before the objects are connected, for the units; `apply` then adds and removes
    objects.
    """

    def __init__(self, profile: Cia402Profile, application: Application) -> None:
        self.profile = profile
        self._application = application
        self.settings = WornSettings(profile, application)
        self.units: ObjectUnits = profile_units(application.inverter.params.drive, profile, self.settings.scales())
        wanted = (*profile.modes.speed, *profile.modes.torque)
        application.modes = frozenset(OperationMode(code) for code in wanted if code in list(OperationMode))
        application.mode = application.first_mode

    def apply(self, store: ObjectStore) -> None:
        """Apply all of the profile that does not depend on the bus."""
        self._remove(store)
        self._identify(store)
        self._reaction(store)
        self._torque(store)
        self._speed(store)
        self._position(store)
        self._filters(store)
        self.settings.bind(store)

    def _remove(self, store: ObjectStore) -> None:
        profile = self.profile
        torque, speed, stop = profile.torque, profile.speed, profile.quick_stop
        present: dict[int, bool] = {
            SPEED_LOOP_INDEX: False,       # comes back with the settings of a profile that names it
            0x6007: profile.watchdog.reaction_index == 0x6007,
            0x605A: stop.option_code is not None,
            0x6064: profile.position is not None,
            0x608F: profile.position is not None,
            0x6071: bool(profile.modes.torque),
            0x6072: torque.max_torque_rated_per_lsb is not None,
            0x6074: torque.has_demand,
            0x6075: torque.max_torque_rated_per_lsb is not None,
            0x6076: torque.rated_torque_nm_per_lsb is not None and torque.rated.index == 0x6076,
            0x6077: torque.actual is None,
            0x6080: speed.max_motor_speed_rpm_per_lsb is not None,
            0x6083: speed.acceleration_rpm_s_per_lsb is not None,
            0x6084: speed.deceleration_rpm_s_per_lsb is not None,
            0x6085: stop.deceleration_rpm_s_per_lsb is not None,
            0x6087: torque.slope_rated_s_per_lsb is not None,
            0x60A9: speed.si_unit is not None,
            0x60B2: profile.torque_offset is not None and profile.torque_offset.index == 0x60B2,
            0x60C2: not _CYCLIC_SYNCHRONOUS.isdisjoint(self._application.modes),
            0x60E0: torque.max_torque_rated_per_lsb is not None,
            0x60E1: torque.max_torque_rated_per_lsb is not None,
        }
        for index, there in present.items():
            if not there:
                store.remove(index)
        settings = self._application.settings
        if not present[0x6083]:        # no ramp object: a speed setpoint acts at once
            settings.accel_rad_s2 = settings.decel_rad_s2 = float("inf")
        if stop.option_code is None:
            settings.quick_stop_option = _QUICK_STOP_RAMP + (4 if stop.ends == "quick_stop" else 0)
        settings.torque_quick_stop = stop.decelerates_in_torque_mode
        if not profile.modes.mapped:
            store.variable(0x6060, 0).pdo_mappable = False

    def _identify(self, store: ObjectStore) -> None:
        identity = self.profile.identity
        for sub, value in ((1, identity.vendor), (2, identity.product), (3, identity.revision)):
            if value is not None:
                store.set_default(0x1018, sub, value)
        store.set_default(0x1008, 0, self.profile.name)
        store.set_default(0x6502, 0, sum(1 << mode.value - 1 for mode in self._application.modes))

    def _reaction(self, store: ObjectStore) -> None:
        """Add the object that chooses the reaction to a lost host, or set the reaction that the drive always has."""
        watchdog = self.profile.watchdog
        settings, reaction = self._application.settings, _REACTIONS[watchdog.reaction]
        place, wanted = watchdog.reaction_index, watchdog.reaction_value
        if place is None:
            settings.connection_option = reaction
        elif place != 0x6007:
            sub = watchdog.reaction_sub
            store.add(place, sub, datatypes.INTEGER16, writable=True, mappable=False, name="Reaction")
            store.set_default(place, sub, 0)

            def choose(value: int) -> None:
                settings.connection_option = reaction if value == wanted else 0

            store.hooks[key_of(place, sub)] = choose

    def _torque(self, store: ObjectStore) -> None:
        torque, drive = self.profile.torque, self._application.inverter.params.drive
        place = torque.rated
        if torque.rated_torque_nm_per_lsb is not None and place.index != 0x6076:
            store.add(
                place.index, place.sub, DATA_TYPES[place.type], writable=True, mappable=False, name="Rated torque"
            )
            counts = drive.rated_torque_nm / self.units.rated_torque
            store.set_default(place.index, place.sub, counts if place.type == "f32" else round(counts))
        actual = torque.actual
        if actual is not None:
            store.add(
                actual.index, actual.sub, DATA_TYPES[actual.type], writable=False, mappable=True, name="Torque actual"
            )
            inverter, unit = self._application.inverter, self.units.actual_torque
            reporting = inverter.reporting
            key = key_of(actual.index, actual.sub)
            if actual.type == "f32":
                store.live[key] = inverter.lies.word(Feedback.TORQUE, lambda: reporting.torque_nm / unit, nan)
            else:
                bits = int(actual.type[1:])
                store.live[key] = inverter.lies.word(
                    Feedback.TORQUE, lambda: clamped(reporting.torque_nm / unit, bits))

    def _speed(self, store: ObjectStore) -> None:
        if self.profile.speed.vl:
            for index in (0x606B, 0x606C, 0x606D, 0x606F, 0x60FF):
                store.remove(index)
            for index, writable, name in ((0x6042, True, "vl target velocity"), (0x6044, False, "vl velocity actual")):
                key = key_of(index)
                live, hook = store.live[key], store.hooks.get(key)
                store.add(index, 0, datatypes.INTEGER16, writable=writable, mappable=True, name=name)
                store.live[key] = live
                if hook is not None:
                    store.hooks[key] = hook
        if self.profile.speed.si_unit is not None:
            store.set_default(0x60A9, 0, self.profile.speed.si_unit)

    def _position(self, store: ObjectStore) -> None:
        """Add the angle in the profile's object, in its counts. The standard's 6064h exists already."""
        position, inverter = self.profile.position, self._application.inverter
        if position is None or (position.counts_per_turn is None and position.index == 0x6064):
            return
        store.add(
            position.index, position.sub, DATA_TYPES[position.type], writable=False, mappable=True, name="Angle"
        )

        def counts() -> float:
            turned = inverter.reported_angle_rad / TURN * (position.counts_per_turn or counts_per_turn(store))
            if position.wrap_counts is not None:
                turned %= position.wrap_counts
            if position.type == "f32":
                return turned
            return wrapped(turned, int(position.type[1:]), signed=position.type[0] == "i")

        ones = {"f": nan, "i": -1.0, "u": 2.0 ** int(position.type[1:]) - 1.0}[position.type[0]]
        store.live[key_of(position.index, position.sub)] = inverter.lies.word(Feedback.POSITION, counts, ones)

    def _filters(self, store: ObjectStore) -> None:
        """Set the filters of the simulated machine's reports, in the objects of the profile's drive."""
        reporting = self._application.inverter.params.reporting
        for entry in self.profile.filters:
            lag_s = reporting.speed_lag_s if entry.signal == "speed" else reporting.torque_lag_s
            told = lag_s
            if entry.quantity == "cutoff_hz":
                told = 1.0 / (6.283185307179586 * lag_s) if lag_s else 0.0
            store.add(
                entry.index, entry.sub, DATA_TYPES[entry.type], writable=True, mappable=False,
                name=f"{entry.signal} filter",
            )
            counts = told / entry.per_lsb
            store.set_default(entry.index, entry.sub, counts if entry.type == "f32" else round(counts))
