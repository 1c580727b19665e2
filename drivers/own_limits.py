"""The drive's own limits stay as tight as they were found, unless the operator accepts a wider one by name.

These limits were set for the motor, the gear, or an earlier test; and a host that dies leaves its own values. So a
torque or speed limit is lowered to rig.yaml's and never raised, and a quick-stop ramp is made steeper and never
gentler. If the drive is tighter, its limit stays and the run keeps within it (`Preflight.kept_torque_nm`,
`Preflight.kept_speed_rad_s`); a quick stop that brakes harder stays too.

This also holds for a simulated drive, whose factory limits are wide.
"""

from __future__ import annotations

from collections.abc import Collection

from drivers.drive import Check, Outcome
from drivers.preflight import PreflightTable

WIDER_FLAG = "--accept-wider-limit"
TORQUE, SPEED, QUICK_STOP = "torque", "speed", "quick-stop"
NAMES = (TORQUE, SPEED, QUICK_STOP)
LIMIT_SET_BY = {
    "torque_limit": TORQUE, "torque_limit_reverse": TORQUE, "speed_limit": SPEED, "speed_limit_reverse": SPEED,
    "quick_stop_time": QUICK_STOP, "quick_stop_deceleration": QUICK_STOP,
}
"""`set_to` of a profile's parameter → the limit that it sets."""
TITLES = {
    "torque_limit": "torque limit", "torque_limit_reverse": "torque limit, reverse", "speed_limit": "speed limit",
    "speed_limit_reverse": "speed limit, reverse", "quick_stop_time": "quick-stop ramp",
    "quick_stop_deceleration": "quick-stop ramp",
}
"""`set_to` of a profile's parameter → title of its row in preflight."""
NOT_KEPT = "The drive did not keep the value. Check whether it is locked or its range is narrower"
FLOAT_ROUNDING = 1e-6
"""Relative difference below which two values count as equal: above the rounding of a 32-bit float, 6e-8."""


class OwnLimits:
    """Decision for each limit. ``kept``: the tightest limit that stayed, by name, N·m, rad/s or rad/s²."""

    def __init__(self, accepted: Collection[str]) -> None:
        self._accepted = frozenset(accepted)
        self.kept: dict[str, float] = {}

    def stays(self, limit: str, wanted: float, found: float) -> bool:
        """Return whether the limit ``found`` in the drive is tighter and must stay. Both in one unit, with any sign."""
        return self.wider(limit, wanted, found) and limit not in self._accepted

    def keep(
        self, table: PreflightTable, limit: str, title: str, wanted: str, found: str, found_si: float, where: str
    ) -> None:
        """Add the row of a limit that stays."""
        self.kept[limit] = min(abs(found_si), self.kept.get(limit, abs(found_si)))
        effect = "the drive brakes harder" if limit == QUICK_STOP else "the run keeps within it"
        text = f"{found}, kept: tighter than rig.yaml's, {effect}"
        hint = f"To set the limit of rig.yaml, add {WIDER_FLAG} {limit}"
        table.checks.append(Check(title, wanted, text, Outcome.NOTE, where, hint))

    def written(
        self, table: PreflightTable, limit: str, title: str, wanted: str, now: str, before: str, good: bool, where: str,
        mend: str = NOT_KEPT, *, wider: bool = False,
    ) -> bool:
        """Add the row of a written limit, with its former value. Return whether it reads back as wanted."""
        changed = "" if before == now else f" (was {before})"
        if wider and good:
            text = f"{now} (was {before}: wider, accepted by {WIDER_FLAG} {limit})"
            table.checks.append(Check(title, wanted, text, Outcome.NOTE, where))
            return True
        return table.row(title, wanted, now + changed, good, where, mend)

    @staticmethod
    def wider(limit: str, wanted: float, found: float) -> bool:
        """Return whether writing ``wanted`` over ``found`` would widen the drive's own limit."""
        wanted, found = abs(wanted), abs(found)
        if limit == QUICK_STOP:
            return wanted < found * (1.0 - FLOAT_ROUNDING)
        return wanted > found * (1.0 + FLOAT_ROUNDING)
