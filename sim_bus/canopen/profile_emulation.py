"""A simulated drive wears a profile: its identity, the objects it has and has not, its units, its watchdog.

What the profile doesn't say stays as in our own EDS. The marker object stays too: a drive that is simulated says so.
"""

from collections.abc import Callable

from canopen.objectdictionary import datatypes

from profiles.canopen import CanopenProfile
from profiles.simulator_marker import MARKER_INDEX
from sim_bus.canopen.application_objects import clamped, counts_per_turn, wrapped
from sim_bus.canopen.objects import ObjectStore, key_of
from sim_bus.cia402 import Application, Mode
from sim_bus.node_guarding import LifeGuard
from sim_bus.object_units import TURN, ObjectUnits, profile_units
from sim_bus.worn_settings import DATA_TYPES, WornSettings

_REACTIONS = {"none": 0, "fault_reaction": 1, "coast": 2, "quick_stop": 3}
"""What 6007h would say for each."""
_QUICK_STOP_RAMP = 2


class WornProfile:
    """Made before the objects are bound, for the units; `dress` is called after, for what comes and goes."""

    def __init__(self, profile: CanopenProfile, application: Application) -> None:
        self.profile = profile
        self._application = application
        self.settings = WornSettings(profile, application)
        self.units: ObjectUnits = profile_units(application.inverter.params.drive, profile, self.settings.scales())
        wanted = (*profile.modes.speed, *profile.modes.torque)
        application.modes = frozenset(Mode(code) for code in wanted if code in list(Mode))
        application.mode = application.first_mode

    def dress(self, store: ObjectStore, guard: LifeGuard, set_period: Callable[[int], None]) -> None:
        """Everything at once."""
        self._remove(store)
        self._identify(store)
        self._watchdog(store, guard)
        self._torque(store)
        self._speed(store)
        self._position(store)
        self._filters(store)
        self.settings.bind(store)
        if not self.profile.cyclic.has_period:
            store.add(MARKER_INDEX, 3, datatypes.UNSIGNED32, writable=True, mappable=False, name="Stepped period")
            store.set_default(MARKER_INDEX, 3, 0)
            store.values[key_of(MARKER_INDEX, 3)] = 0
            store.hooks[key_of(MARKER_INDEX, 3)] = set_period
        _unmap_what_is_gone(store)

    def _remove(self, store: ObjectStore) -> None:
        profile = self.profile
        torque, speed, stop = profile.torque, profile.speed, profile.quick_stop
        present: dict[int, bool] = {
            0x1006: profile.cyclic.has_period,
            0x1016: profile.watchdog.kind == "heartbeat" and profile.watchdog.consumer_index == 0x1016,
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
            0x60E0: torque.max_torque_rated_per_lsb is not None,
            0x60E1: torque.max_torque_rated_per_lsb is not None,
        }
        for index, there in present.items():
            if not there:
                store.remove(index)
        settings = self._application.settings
        if not present[0x6083]:        # no ramp that the host could know of: a speed setpoint acts at once
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

    def _watchdog(self, store: ObjectStore, guard: LifeGuard) -> None:
        watchdog = self.profile.watchdog
        if watchdog.kind == "node_guarding":
            for index, kind, hook in (
                (0x100C, datatypes.UNSIGNED16, guard.set_guard), (0x100D, datatypes.UNSIGNED8, guard.set_factor),
            ):
                store.add(index, 0, kind, writable=True, mappable=False, name=f"Guarding {index:04X}")
                store.set_default(index, 0, 0)
                store.hooks[key_of(index)] = hook
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
            reporting, unit = self._application.inverter.reporting, self.units.actual_torque
            key = key_of(actual.index, actual.sub)
            if actual.type == "f32":
                store.live[key] = lambda: reporting.torque_nm / unit
            else:
                bits = int(actual.type[1:])
                store.live[key] = lambda: clamped(reporting.torque_nm / unit, bits)

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
        """The angle in the profile's object, in its counts; the standard's 6064h is there already."""
        position, inverter = self.profile.position, self._application.inverter
        if position is None or (position.counts_per_turn is None and position.index == 0x6064):
            return
        store.add(
            position.index, position.sub, DATA_TYPES[position.type], writable=False, mappable=True, name="Angle"
        )

        def counts() -> float:
            turned = inverter.state.angle_rad / TURN * (position.counts_per_turn or counts_per_turn(store))
            if position.wrap_counts is not None:
                turned %= position.wrap_counts
            if position.type == "f32":
                return turned
            return wrapped(turned, int(position.type[1:]), signed=position.type[0] == "i")

        store.live[key_of(position.index, position.sub)] = counts

    def _filters(self, store: ObjectStore) -> None:
        """What smooths the reports of the simulated machine, as the profile's drive would tell it."""
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


def _unmap_what_is_gone(store: ObjectStore) -> None:
    """A PDO whose default mapping names an object that isn't there is delivered empty."""
    for area in (0x1600, 0x1A00):
        for mapping in range(area, area + 4):
            entries = [store.default(key_of(mapping, 1 + number)) for number in range(8)]
            if any(entry and entry >> 16 not in store.object_dictionary for entry in entries):
                for sub in range(9):
                    store.set_default(mapping, sub, 0)
