"""The rated torque, which the drive and rig.yaml may both know: one row of the preflight table, whatever the bus."""

from __future__ import annotations

from drivers.preflight import Table


def agreed_rated_torque(table: Table, from_drive_nm: float | None, rig_nm: float | None, where: str) -> float | None:
    """N·m; rig.yaml's, and the drive's where the rig has none. None, and refused, where neither tells.

    ``where`` names the object or the register.
    """
    rated_nm = rig_nm if rig_nm is not None else from_drive_nm
    if rated_nm is None:
        table.row(
            "rated torque", "known", "the drive does not tell", False, where,
            "Give drive_data.rated_torque_nm in rig.yaml (motor name plate)",
        )
    elif from_drive_nm is None:
        table.note("rated torque", f"{rated_nm:g} N·m, from the rig", where)
    else:
        agree = abs(from_drive_nm - rated_nm) <= 0.001 * rated_nm
        table.row(
            "rated torque", f"{rated_nm:g} N·m", f"{from_drive_nm:g} N·m", agree, where,
            "rig.yaml and the drive disagree, and every torque is scaled by it: find out which is right",
        )
    return rated_nm
