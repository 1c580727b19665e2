"""The bare quick stop of a CiA 402 drive on EtherCAT (`drivers.quick_stop`): controlword 6040h by SDO.

The AL state stays as it is, because leaving OP may let a shaft coast. Setpoints of another master replace the
controlword with the next frame. Then the slave is put into SAFE-OP, where it takes no setpoints of any master.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing

from drivers.cia402 import Cia402Target
from drivers.clock import Clock
from drivers.ethercat.mailbox import CoeObjects, Mailbox
from drivers.ethercat.raw import RawSegment
from drivers.ethercat.segment import open_segment
from drivers.ethercat.station import INIT, OP, SAFE_OP, Station, station_of
from profiles.ethercat import EthercatProfile

BY_SDO_TRIES = 5
"""Attempts by SDO alone; after them the slave is put into SAFE-OP."""


class EthercatTarget(Cia402Target):
    """One slave, for a bare quick stop. ``close`` closes everything that was opened for it."""

    def __init__(self, station: Station, profile: EthercatProfile, clock: Clock, close: Callable[[], None]) -> None:
        self._station = station
        super().__init__(CoeObjects(Mailbox(station, clock)), profile, clock)
        self.close = close

    def enforce(self, attempt: int) -> None:
        """Take the slave out of OP if the quick stop by SDO has no effect."""
        if attempt > BY_SDO_TRIES and self._station.al_status().state == OP and self._station.ask_for(SAFE_OP):
            self._said.append("setpoints of another master reversed the quick stop: the drive was put into SAFE-OP")


def open_target(
    interface: str, position: int, alias: int | None, profile: EthercatProfile, clock: Clock
) -> EthercatTarget:
    """Open one slave for a quick stop. Its AL state stays, unless it is INIT, where no master drives it.

    Raises PreflightRefused, and CommunicationLost if no slave answers.
    """
    with ExitStack() as failed:
        look = failed.enter_context(closing(RawSegment(interface)))
        station = station_of(look.stations(), interface, position, alias)
        if station.al_status().state != INIT:
            failed.pop_all()
            return EthercatTarget(station, profile, clock, look.close)
    segment = open_segment(interface, position, alias)
    return EthercatTarget(segment.station, profile, clock, segment.close)
