"""What one count of speed and torque means on this drive: from the drive where it has it, else from the rig."""

from __future__ import annotations

from drivers.canopen.sdo import Objects, name
from drivers.cia402.objects import RPM, Units
from drivers.cia402.parameters import Settings
from drivers.cia402.values import decode_value
from drivers.errors import ObjectRefused
from drivers.preflight import Table
from drivers.rated_torque import agreed_rated_torque
from profiles.canopen import CanopenProfile

SI_UNIT_VELOCITY = 0x60A9


def find_units(
    table: Table, objects: Objects, profile: CanopenProfile, rated_torque_nm: float | None
) -> tuple[Units, float]:
    """Scaling of speed and torque; and the rated torque, N·m."""
    where = name(profile.torque.rated.index, profile.torque.rated.sub)
    agreed_nm = agreed_rated_torque(table, _told(objects, profile), rated_torque_nm, where)
    rated_nm = 1.0 if agreed_nm is None else agreed_nm       # refused, and the rows after it still want a scale
    speed = speed_unit(table, objects, profile)
    target = profile.torque.rated_per_lsb * rated_nm
    actual = profile.torque.actual
    if actual is None:
        return Units(speed, target), rated_nm
    return Units(speed, actual.per_lsb * (rated_nm if actual.unit == "rated" else 1.0), target), rated_nm


def _told(objects: Objects, profile: CanopenProfile) -> float | None:
    """The rated torque that the drive tells, N·m; None where it doesn't, or says 0."""
    place, per_lsb = profile.torque.rated, profile.torque.rated_torque_nm_per_lsb
    if per_lsb is None:
        return None
    try:
        raw = decode_value(place.type, objects.read_bytes(place.index, place.sub), name(place.index, place.sub))
    except ObjectRefused:
        return None
    return raw * per_lsb if raw > 0.0 else None


def speed_unit(table: Table, objects: Objects, profile: CanopenProfile) -> float:
    """Rad/s for one count. A drive whose unit can be set is believed only where it reads back what it is set to."""
    speed = profile.speed
    if speed.si_unit is not None:
        wanted = speed.si_unit

        def same() -> tuple[str, bool]:
            found = objects.read(SI_UNIT_VELOCITY)
            return f"{found:08X}h", found == wanted

        table.attempt(
            "unit of speed", f"{wanted:08X}h", name(SI_UNIT_VELOCITY), same,
            f"Every speed would be scaled wrongly: set 60A9h to {wanted:08X}h, as profile {profile.name} has it",
        )
    per_lsb = speed.rpm_per_lsb * RPM
    if not (speed.times or speed.over):
        return per_lsb
    settings = Settings(objects, profile)
    found = per_lsb

    def work() -> tuple[str, bool]:
        nonlocal found
        product = per_lsb
        for scale in speed.times:
            product *= _nonzero(settings.value(scale), scale)
        for scale in speed.over:
            product /= _nonzero(settings.value(scale), scale)
        found = product
        return f"{product / RPM:.6g} rpm for one count", True

    scales = [profile.parameter(scale) for scale in (*speed.times, *speed.over)]
    table.attempt(
        "unit of speed", "known", ", ".join(name(one.index, one.sub) for one in scales), work,
        "Without it no speed can be scaled. " + " ".join(dict.fromkeys(one.advice for one in scales if one.advice)),
    )
    return found


def _nonzero(value: float, scale: str) -> float:
    if value <= 0.0:
        raise ObjectRefused(f"{scale} reads {value:g}")
    return value
