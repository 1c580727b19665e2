"""The drive's own limits stay as tight as they were found, unless the operator takes a wider one by name.

Somebody set the drive for its motor, its gear, or for a test before this one; and a host that dies leaves behind what
it wrote. So a torque or speed limit is lowered to rig.yaml's unasked and never raised, and a quick stop's ramp is made
steeper and never gentler. Where the drive is tighter, its limit stays and the run keeps within it
(`Preflight.kept_torque_nm`, `Preflight.kept_speed_rad_s`); a quick stop that brakes harder just stays.

A simulated drive is no exception: it leaves its factory as wide as it goes.
"""

from __future__ import annotations

from collections.abc import Collection

from drivers.drive import Check, Outcome
from drivers.preflight import PreflightTable

WIDER_FLAG = "--accept-wider-limit"
TORQUE, SPEED, QUICK_STOP = "torque", "speed", "quick-stop"
NAMES = (TORQUE, SPEED, QUICK_STOP)
_SLACK = 1e-6
"""Of a value: what a 32-bit float or half a count of rounding may differ by without being wider."""


class OwnLimits:
    """Decides limit by limit, and keeps what stayed: ``kept`` by name, N·m, rad/s or rad/s², the tightest of each."""

    def __init__(self, accepted: Collection[str]) -> None:
        self._accepted = frozenset(accepted)
        self.kept: dict[str, float] = {}

    def stays(self, limit: str, wanted: float, found: float) -> bool:
        """Is the one ``found`` in the drive tighter, and not to be touched? Both in one unit, whatever their sign."""
        return self.wider(limit, wanted, found) and limit not in self._accepted

    def keep(
        self, table: PreflightTable, limit: str, title: str, wanted: str, found: str, found_si: float, where: str
    ) -> None:
        """The row of one that stays."""
        self.kept[limit] = min(abs(found_si), self.kept.get(limit, abs(found_si)))
        effect = "it brakes harder" if limit == QUICK_STOP else "the run keeps within it"
        text = f"{found}, kept: tighter than rig.yaml's, {effect}"
        table.checks.append(Check(title, wanted, text, Outcome.NOTE, where, f"{WIDER_FLAG} {limit} sets rig.yaml's"))

    def written(
        self, table: PreflightTable, limit: str, title: str, wanted: str, now: str, before: str, good: bool, where: str,
        mend: str = "", *, wider: bool = False,
    ) -> bool:
        """The row of one that was written, with what stood there before; whether it reads back as wanted."""
        changed = "" if before == now else f" (was {before})"
        if wider and good:
            text = f"{now} (was {before}: wider, accepted by {WIDER_FLAG} {limit})"
            table.checks.append(Check(title, wanted, text, Outcome.NOTE, where))
            return True
        return table.row(title, wanted, now + changed, good, where, mend)

    @staticmethod
    def wider(limit: str, wanted: float, found: float) -> bool:
        """Would writing ``wanted`` over ``found`` widen the drive's own limit?"""
        wanted, found = abs(wanted), abs(found)
        if limit == QUICK_STOP:
            return wanted < found * (1.0 - _SLACK)
        return wanted > found * (1.0 + _SLACK)
