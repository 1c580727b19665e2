"""Supervision of a slave during a run: AL state, working counter, emergency messages, watchdog of the process data."""

from __future__ import annotations

from drivers.cia402 import DriveWatch, Objects, arm
from drivers.drive import DriveLimits
from drivers.errors import DriveFault, PreflightRefused
from drivers.ethercat.station import INIT, OP, SM_WATCHDOG, AlStatus, Station
from drivers.preflight import DIES, PreflightTable
from profiles import MessageCode
from profiles.ethercat import EthercatProfile

WATCHDOG_DIVIDER, WATCHDOG_TIME = 0x0400, 0x0420
WATCHDOG_TICK_S = 40e-9
"""Clock period of the divider 0400h, s (25 MHz); the divider counts two periods more."""
OUTPUT_MANAGER, WATCHDOG_TRIGGER = 2, 1 << 6
"""Sync manager of the setpoints, and the bit of its control byte: writing to it triggers the watchdog."""
READ_BACK_S = 0.5
"""Time between two read-backs of the watchdog's registers, s."""


class SlaveWatch(DriveWatch):
    """Supervision of one slave. Its sign of life is a cycle with the right working counter."""

    def silence(self) -> tuple[str, str, str]:
        """Return what is missing."""
        return ("no frame came back with the right working counter", self.place,
                "Check the cable and the drive's supply")

    def on_al_status(self, found: AlStatus) -> None:
        """Handle the AL state of one cycle."""
        if (found.state == OP and not found.error) or not self.expect_operational:
            return
        if found.error and found.code == SM_WATCHDOG:
            self.watchdog_acted(found.text)
        elif found.error:
            self.keep("al", DriveFault(
                f"the drive left OP: {found.text}", where=self.place,
                next_step="See the manual of the drive for this AL status code, then start again",
                entry=MessageCode.STATE_LEFT,
            ))
        elif found.state == INIT:
            self.restarted(", or another master set it to INIT")
        else:
            self.taken_out(found.text)

    def on_emcy(self, data: bytes) -> None:
        """Handle an emergency message.

        Codes A0xxh report a refused change of the AL state (ETG.1000.6); the AL status code states the reason.
        """
        if data[1:2] != b"\xa0":
            super().on_emcy(data)


# ---------------------------------------------------------------------------------------------------------------------
# The watchdog of the process data: each write to sync manager 2 triggers it. Without one for 0420h x (0400h + 2) x 40
# ns, the drive leaves OP with AL status code 001Bh. CiA 402 drives then react as 6007h states.


def watchdog_s(station: Station) -> tuple[float, int]:
    """Return the time of the process data's watchdog, s, and its divider."""
    divider = station.number(WATCHDOG_DIVIDER)
    return station.number(WATCHDOG_TIME) * (divider + 2) * WATCHDOG_TICK_S, divider


class ProcessDataWatchdog:
    """The registers of the watchdog of one slave."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._wanted: tuple[int, int] | None = None
        self._looked_s = 0.0

    def arm(
        self, table: PreflightTable, objects: Objects, profile: EthercatProfile, limits: DriveLimits, period_s: float
    ) -> float:
        """Arm it and read it back (`drivers.cia402.arm`). Return the period at which it is fed, s; 0: none."""

        def armed(tried: PreflightTable, time_ms: int) -> float:
            tried.attempt("watchdog", f"{time_ms} ms", "registers 0400h, 0420h",
                          lambda: self._set(objects, time_ms), DIES)
            return period_s

        return arm(table, objects, profile.watchdog, armed, lambda: not self._station.number(WATCHDOG_TIME),
                   watchdog_s=limits.watchdog_s, period_s=period_s, accept_none=limits.accept_no_watchdog)

    def _set(self, objects: Objects, time_ms: int) -> tuple[str, bool]:
        station = self._station
        step_s = (station.number(WATCHDOG_DIVIDER) + 2) * WATCHDOG_TICK_S
        counts, before = round(time_ms * 1e-3 / step_s), station.read(WATCHDOG_TIME, 2)
        if not 0 < counts <= 0xFFFF:
            raise PreflightRefused(f"its longest time is {0xFFFF * step_s:.3g} s", where="register 0400h",
                                   next_step="Lower limits.watchdog_s", entry=MessageCode.WATCHDOG_NOT_ARMED)
        objects.on_restore(lambda: station.write(WATCHDOG_TIME, before))
        station.write(WATCHDOG_TIME, counts.to_bytes(2, "little"))
        self._wanted = self._read()
        return f"{watchdog_s(station)[0] * 1e3:.6g} ms", self._wanted[1] == counts

    def _read(self) -> tuple[int, int]:
        return self._station.number(WATCHDOG_DIVIDER), self._station.number(WATCHDOG_TIME)

    def check(self) -> None:
        """Refuse a watchdog that the start of the segment has changed, and a sync manager of the setpoints that does
        not trigger it. Raises PreflightRefused.
        """
        if self._wanted is not None and self._read() != self._wanted:
            raise PreflightRefused("the registers 0400h and 0420h of the watchdog have changed since they were written",
                                   where=self._station.place, next_step="Start again",
                                   entry=MessageCode.WATCHDOG_NOT_ARMED)
        if self._wanted is not None and not self._station.sync_manager(OUTPUT_MANAGER)[2] & WATCHDOG_TRIGGER:
            raise PreflightRefused(
                "the setpoints do not trigger the watchdog: bit 6 of register 0814h is 0", where=self._station.place,
                next_step="The drive's SII describes its sync manager 2 so; see its manual for another watchdog",
                entry=MessageCode.WATCHDOG_NOT_ARMED,
            )

    def look(self, now_s: float, watch: DriveWatch) -> None:
        """Read the registers back in motion, every `READ_BACK_S`. Raises CommunicationLost without an answer."""
        if self._wanted is None or now_s - self._looked_s < READ_BACK_S:
            return
        self._looked_s = now_s
        found = self._read()
        if found != self._wanted:
            self._station.write(WATCHDOG_TIME, self._wanted[1].to_bytes(2, "little"))
            watch.interference(
                "the drive's watchdog was changed by another master during the run: registers 0400h, 0420h were "
                f"{self._wanted[0]}, {self._wanted[1]}, and are {found[0]}, {found[1]} now", self._station.place,
                "Find the master or tool on this segment, disconnect it, and start again", kind="changed watchdog",
            )
