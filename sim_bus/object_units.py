"""What one count of each of the drive's objects is, in SI at the shaft; by itself, or as a profile says.

Worked out in revolutions, apart from the drivers' own scaling, so that one mistake doesn't hide the other.
"""

from dataclasses import dataclass
from math import pi

from profiles.canopen import CanopenProfile
from sim_bus.params import DriveParams

TURN = 2.0 * pi
"""One revolution in radians."""


@dataclass(frozen=True)
class ObjectUnits:
    """Speeds in rad/s, accelerations in rad/s², torques in N·m, for one count each."""

    velocity: float                # 606Bh 606Ch 60FFh 606Dh 606Fh
    acceleration: float            # 6083h
    deceleration: float            # 6084h
    quick_stop: float              # 6085h
    motor_speed: float             # 6080h
    target_torque: float           # 6071h 6074h
    actual_torque: float           # 6077h, or where the profile has it
    max_torque: float              # 6072h 60E0h 60E1h
    torque_slope: float            # 6087h, per second
    rated_torque: float            # 6076h, or where the profile has it


def standard_units(drive: DriveParams) -> ObjectUnits:
    """Of our own EDS: 0.1 rpm, rpm, ‰ of the rated torque, mN·m."""
    tenth_rpm, per_mille = TURN / 600.0, drive.rated_torque_nm / 1000.0
    return ObjectUnits(
        tenth_rpm, tenth_rpm, tenth_rpm, tenth_rpm, TURN / 60.0, per_mille, per_mille, per_mille, per_mille, 0.001,
    )


def profile_units(drive: DriveParams, profile: CanopenProfile, scales: dict[str, float]) -> ObjectUnits:
    """As the profile says; ``scales`` are the values of the parameters it multiplies and divides by."""
    usual, speed, torque = standard_units(drive), profile.speed, profile.torque
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
    )
