"""The CiA 402 objects of the simulated drive and their units: those of our own EDS, or those of a profile.

==========  =======================================================  ======================
606B 606C 60FF 606D 606F   velocities and their windows                0.1 rpm (60A9h)
6083 6084 6085             accelerations                               0.1 rpm/s
6080                       max motor speed                             rpm
6071 6072 6074 6077 60B2 60E0 60E1   torques                           ‰ of 6076h
6064 · 608F                angle · its counts a turn                   increments
6076 · 6075                rated torque · rated current                mN·m · mA
6087                       torque slope                                ‰ of 6076h per second
5FFD                       gains and filter of the speed loop          N·m·s/rad, N·m/rad, s
606E 6070                  times                                       ms
==========  =======================================================  ======================
"""


from collections.abc import Callable
from dataclasses import dataclass
from math import floor, pi

from canopen.objectdictionary import datatypes
from canopen.sdo import SdoAbortedError

from profiles import MessageCode, TdhilError
from profiles.cia402 import Cia402Profile
from sim_bus.cia402 import Application, ApplicationSettings
from sim_bus.inverter import RPM
from sim_bus.objects import ABORT_VALUE, ObjectStore, key_of
from sim_bus.params import DriveParams
from sim_bus.reports import Feedback

# ---------------------------------------------------------------------------------------------------------------------
# Value of one count of each object, in SI at the shaft: of our own EDS, or as in a profile.
#
# The values are computed in revolutions, apart from the drivers' own scaling, so that one error does not hide the
# other.


TURN = 2.0 * pi
"""One revolution in radians."""


@dataclass(frozen=True)
class ObjectUnits:
    """Value of one count of each object: speeds in rad/s, accelerations in rad/s², torques in N·m."""

    velocity: float                # 606Bh 606Ch 60FFh 606Dh 606Fh
    acceleration: float            # 6083h
    deceleration: float            # 6084h
    quick_stop: float              # 6085h
    motor_speed: float             # 6080h
    target_torque: float           # 6071h 6074h
    actual_torque: float           # 6077h, or the profile's object
    max_torque: float              # 6072h 60E0h 60E1h
    torque_slope: float            # 6087h, per second
    rated_torque: float            # 6076h, or the profile's object
    torque_offset: float           # 60B2h


def standard_units(drive: DriveParams) -> ObjectUnits:
    """Return the units of our own EDS: 0.1 rpm, rpm, ‰ of the rated torque, mN·m."""
    tenth_rpm, per_mille = TURN / 600.0, drive.rated_torque_nm / 1000.0
    return ObjectUnits(
        tenth_rpm, tenth_rpm, tenth_rpm, tenth_rpm, TURN / 60.0, per_mille, per_mille, per_mille, per_mille, 0.001,
        per_mille,
    )


def profile_units(drive: DriveParams, profile: Cia402Profile, scales: dict[str, float]) -> ObjectUnits:
    """Return the units of the profile; ``scales`` are the values of the parameters that multiply and divide
    its units.
    """
    usual, speed, torque, offset = standard_units(drive), profile.speed, profile.torque, profile.torque_offset
    turns_per_s = speed.rpm_per_lsb / 60.0
    for name in speed.times:
        turns_per_s *= scales[name]
    for name in speed.over:
        turns_per_s /= scales[name]
    target = torque.rated_per_lsb * drive.rated_torque_nm
    actual = target
    if torque.actual is not None:
        actual = torque.actual.per_lsb * (drive.rated_torque_nm if torque.actual.unit == "rated" else 1.0)

    def turns(rpm: float | None, otherwise: float) -> float:
        return otherwise if rpm is None else TURN * rpm / 60.0

    def share(rated: float | None, otherwise: float) -> float:
        return otherwise if rated is None else rated * drive.rated_torque_nm

    return ObjectUnits(
        velocity=TURN * turns_per_s,
        acceleration=turns(speed.acceleration_rpm_s_per_lsb, usual.acceleration),
        deceleration=turns(speed.deceleration_rpm_s_per_lsb, usual.deceleration),
        quick_stop=turns(profile.quick_stop.deceleration_rpm_s_per_lsb, usual.quick_stop),
        motor_speed=turns(speed.max_motor_speed_rpm_per_lsb, usual.motor_speed),
        target_torque=target,
        actual_torque=actual,
        max_torque=share(torque.max_torque_rated_per_lsb, usual.max_torque),
        torque_slope=share(torque.slope_rated_s_per_lsb, usual.torque_slope),
        rated_torque=torque.rated_torque_nm_per_lsb or usual.rated_torque,
        torque_offset=share(None if offset is None else offset.rated_per_lsb, usual.torque_offset),
    )


# ---------------------------------------------------------------------------------------------------------------------

SPEED_LOOP_INDEX = 0x5FFD
"""Record with the gains of the speed loop (REAL32, ro), which only the simulated drive has: P, I, speed filter."""


def rated_torque_counts(rated_torque_nm: float, per_count_nm: float) -> int:
    """Return the value of 6076h (UNSIGNED32) for a rated torque. Raises TdhilError if the object cannot hold it."""
    counts, most = round(rated_torque_nm / per_count_nm), (1 << 32) - 1
    if counts > most:
        raise TdhilError(
            f"6076h cannot hold the rated torque of {rated_torque_nm:g} N·m: it counts {per_count_nm:g} N·m, and ends"
            f" at {most * per_count_nm:.0f} N·m",
            where="--plant: drive.rated_torque_nm",
            next_step="Simulate a rig that fits this drive, or take another profile",
            entry=MessageCode.SIMULATOR_UNUSABLE,
        )
    return counts


def clamped(value: float, bits: int) -> int:
    """Return the nearest integer that a signed field of ``bits`` can hold."""
    counts, top = round(value), (1 << bits - 1) - 1
    return counts if -top <= counts <= top else max(-top - 1, min(top, counts))


def wrapped(counts: float, bits: int = 32, *, signed: bool = True) -> int:
    """Return the counter in a field of ``bits``, which starts over when it is full."""
    seen = floor(counts) % (1 << bits)
    return seen - (1 << bits) if signed and seen >> (bits - 1) else seen


def counts_per_turn(store: ObjectStore) -> float:
    """Return the counts of a turn by 608Fh, after the profile was applied; it may bring an encoder of its own."""
    return store.default(key_of(0x608F, 1)) / max(1, store.default(key_of(0x608F, 2)))


class ApplicationObjects:
    """Connection of an application's quantities with the objects of a store. ``setters``: direct write functions for
    RPDOs.
    """

    def __init__(self, store: ObjectStore, application: Application, units: ObjectUnits | None = None) -> None:
        self._application = application
        drive = application.inverter.params.drive
        self._units = units or standard_units(drive)
        self._usual = standard_units(drive)
        self._store = store
        self.setters: dict[int, Callable[[int], None]] = {
            key_of(0x6040): application.write_controlword,
            key_of(0x6060): self._mode_by_pdo,
            key_of(0x6071): self._set_target_torque,
            key_of(0x60B2): self._set_torque_offset,
            key_of(0x60FF): self._set_target_velocity,
            key_of(0x6042): self._set_target_velocity,
        }
        # These defaults depend on the rig. The drive's own limits are also the highest values that may be written.
        torque = min(65535, round(drive.torque_limit_nm / self._units.max_torque))
        speed = max(1, round(drive.speed_limit_rpm * RPM / self._units.motor_speed))
        store.set_default(0x6075, 0, round(1000.0 * drive.rated_current_a))
        store.set_default(0x6076, 0, rated_torque_counts(drive.rated_torque_nm, self._units.rated_torque))
        store.set_default(0x6072, 0, torque)
        store.set_default(0x6080, 0, speed)
        store.set_default(0x606F, 0, round(application.settings.standstill_rad_s / self._usual.velocity))
        store.variable(0x6072, 0).max = torque
        store.variable(0x6080, 0).max = speed
        self._bind_process_data()
        self._bind_settings()
        self._bind_limits()
        gains = (drive.speed_gain_nm_s_rad, drive.speed_integral_gain_nm_rad, drive.speed_filter_s)
        for sub, value in enumerate(gains, 1):       # for a host that reads the gains of the speed loop
            store.add(SPEED_LOOP_INDEX, sub, datatypes.REAL32, writable=False, mappable=False,
                      name=f"Speed loop {sub}", default=value)

    def _bind_process_data(self) -> None:
        application, store = self._application, self._store
        live, hooks = store.live, store.hooks
        inverter, reporting, word = application.inverter, application.inverter.reporting, application.inverter.lies.word
        units = self._units
        velocity, target, actual = units.velocity, units.target_torque, units.actual_torque
        live[key_of(0x6040)] = lambda: application.controlword
        live[key_of(0x6041)] = word(Feedback.STATUS, application.statusword, 0xFFFF)
        live[key_of(0x6060)] = live[key_of(0x6061)] = lambda: application.mode.value
        live[key_of(0x606B)] = self._velocity_demand
        live[key_of(0x606C)] = word(Feedback.SPEED, lambda: clamped(reporting.speed_rad_s / velocity, 32))
        live[key_of(0x6064)] = word(
            Feedback.POSITION, lambda: wrapped(inverter.reported_angle_rad / TURN * counts_per_turn(store)))
        live[key_of(0x6074)] = word(Feedback.DEMAND, lambda: clamped(inverter.reported_demand_nm / target, 16))
        live[key_of(0x6077)] = word(Feedback.TORQUE, lambda: clamped(reporting.torque_nm / actual, 16))
        live[key_of(0x6071)] = lambda: clamped(application.target_torque_nm / target, 16)
        live[key_of(0x60B2)] = lambda: clamped(application.torque_offset_nm / units.torque_offset, 16)
        live[key_of(0x60FF)] = lambda: clamped(application.target_speed_rad_s / velocity, 32)
        live[key_of(0x6042)] = lambda: clamped(application.target_speed_rad_s / velocity, 16)
        live[key_of(0x6044)] = word(Feedback.SPEED, lambda: clamped(reporting.speed_rad_s / velocity, 16))
        hooks.update(self.setters)
        hooks[key_of(0x6060)] = self._mode_by_sdo

    def _bind_settings(self) -> None:
        units, usual = self._units, self._usual
        self._setting(0x6007, "connection_option", {0, 1, 2, 3})
        self._setting(0x605A, "quick_stop_option", {0, 1, 2, 3, 5, 6, 7})
        self._setting(0x605B, "shutdown_option", {0, 1})
        self._setting(0x605C, "disable_option", {0, 1})
        self._setting(0x605D, "halt_option", {1, 2, 3})
        self._setting(0x605E, "fault_option", {0, 1, 2, 3})
        self._scaled(0x606D, "window_rad_s", units.velocity, usual.velocity)
        self._scaled(0x606E, "window_s", 0.001, 0.001)
        self._scaled(0x606F, "standstill_rad_s", units.velocity, usual.velocity)
        self._scaled(0x6070, "standstill_s", 0.001, 0.001)
        self._scaled(0x6083, "accel_rad_s2", units.acceleration, usual.acceleration)
        self._scaled(0x6084, "decel_rad_s2", units.deceleration, usual.deceleration)
        self._scaled(0x6085, "quick_stop_rad_s2", units.quick_stop, usual.quick_stop)
        self._scaled(0x6087, "torque_slope_nm_s", units.torque_slope, usual.torque_slope)

    def _bind_limits(self) -> None:
        """Connect the limits: 6072h limits the torque in both directions, 60E0h and 60E1h in one each,
        6080h the speed.
        """
        store, limits, unit = self._store, self._application.inverter.control.limits, self._units.max_torque
        speed_unit = self._units.motor_speed
        present = {0x6072: 65535, 0x60E0: 65535, 0x60E1: 65535}

        def torque(index: int) -> Callable[[int], None]:
            def write(value: int) -> None:
                present[index] = value
                limits.torque_forward_nm = unit * min(present[0x6072], present[0x60E0])
                limits.torque_reverse_nm = unit * min(present[0x6072], present[0x60E1])

            return write

        def speed(value: int) -> None:
            limits.speed_rad_s = value * speed_unit

        for index in present:
            store.hooks[key_of(index)] = torque(index)
        store.hooks[key_of(0x6080)] = speed

    def _setting(self, index: int, name: str, allowed: set[int]) -> None:
        settings: ApplicationSettings = self._application.settings

        def write(value: int) -> None:
            if value not in allowed:
                raise SdoAbortedError(ABORT_VALUE)
            setattr(settings, name, value)

        self._store.hooks[key_of(index)] = write

    def _scaled(self, index: int, name: str, unit: float, usual: float) -> None:
        """Connect one rate or window. Its default is that of our own EDS, converted to the unit, at least 1 count."""
        settings: ApplicationSettings = self._application.settings
        if unit != usual:
            counts = self._store.default(key_of(index)) * usual / unit
            self._store.set_default(index, 0, max(1, min(0xFFFF, round(counts))))
        self._store.hooks[key_of(index)] = lambda value: setattr(settings, name, value * unit)

    def _velocity_demand(self) -> int:
        control = self._application.inverter.control
        return clamped(control.speed_reference_rad_s / self._units.velocity, 32)

    def _mode_by_sdo(self, code: int) -> None:
        if not self._application.set_mode(code):
            raise SdoAbortedError(ABORT_VALUE)

    def _mode_by_pdo(self, code: int) -> None:
        self._application.set_mode(code)      # an unsupported code is ignored: 6061h still shows the old one

    def _set_target_torque(self, counts: int) -> None:
        self._application.target_torque_nm = counts * self._units.target_torque

    def _set_torque_offset(self, counts: int) -> None:
        self._application.torque_offset_nm = counts * self._units.torque_offset

    def _set_target_velocity(self, counts: int) -> None:
        self._application.target_speed_rad_s = counts * self._units.velocity
