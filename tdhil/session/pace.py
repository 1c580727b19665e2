"""Measurement of whether this computer sustains a cycle rate with the embedded simulator by the clock.

Nothing moves.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

from drivers import Command, DriveLimits, Mode, Paced
from tdhil.buses import Connection
from tdhil.config import Rig, RunOptions, require_limits, simulated_default_rig
from tdhil.runner import WARM_UP
from tdhil.session.open_drive import opened_drive, plan_peer
from tdhil.session.task import suited

if TYPE_CHECKING:
    from tdhil.buses import PeerPlan

MEASURED_S: Final = 1.5
"""Length of the measurement, s: a page waits for it."""


@dataclass(frozen=True)
class PaceMeasured:
    """Result of the measurement. A cycle counts as late if it begins late by half a period or more."""

    rate_hz: float
    cycles: int
    late: int
    worst_s: float

    @property
    def holds(self) -> bool:
        """Return whether no cycle was late."""
        return self.late == 0

    @property
    def text(self) -> str:
        """Return the result as sentences for a page."""
        half_ms = 500.0 / self.rate_hz
        seen = (f"{self.late} of {self.cycles} cycles were late by half a period ({half_ms:.3g} ms) or more; the"
                f" longest delay was {1e3 * self.worst_s:.2g} ms")
        if self.holds:
            return f"This computer sustains {self.rate_hz:g} cycles per second: {seen}."
        return (f"This computer does not sustain {self.rate_hz:g} cycles per second now: {seen}. A run by the clock "
                "may end because it is late. End other programs, or run in stepped time.")

    def plain(self) -> dict[str, Any]:
        """Return the result as plain data."""
        return {**asdict(self), "holds": self.holds, "text": self.text}


def measure_pace(options: RunOptions, connection: Connection, rig: Rig | None) -> PaceMeasured:
    """Run cycles of the disabled embedded drive by the clock. ``options`` request a simulated rig in real time."""
    peer: PeerPlan = plan_peer(options, connection)
    limits = require_limits(simulated_default_rig(suited(rig, peer.plant)))
    data = None if rig is None else rig.drive_data
    late_s: list[float] = []
    with opened_drive(peer, options, connection, data, lambda _frame: None, None) as drive:
        drive.connect()
        drive.preflight(DriveLimits(limits.speed_max_rad_s, limits.torque_nm, limits.quick_stop_rad_s2,
                                    limits.watchdog_s, accept_no_watchdog=True, accept_shared_watchdog=True))
        period_s = drive.period_s
        if isinstance(drive, Paced):
            drive.set_rate(1.0 / period_s, measuring=True)
        count = max(1, round(MEASURED_S / period_s))
        before_s = time.monotonic()
        for number in range(-WARM_UP, count):
            drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
            now_s = time.monotonic()
            began_late_s = drive.began_late_s if isinstance(drive, Paced) else now_s - before_s - period_s
            before_s = now_s
            if number >= 0:
                late_s.append(max(0.0, began_late_s))
    return PaceMeasured(1.0 / period_s, count, sum(one >= 0.5 * period_s for one in late_s), max(late_s))
