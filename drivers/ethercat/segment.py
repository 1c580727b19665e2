"""pysoem's master on one network interface (SOEM), with one slave of it as the drive.

It starts the segment, maps the process data, sets the clocks and exchanges the cyclic frame. AL states, SDO and the
watchdog go through the registers (`drivers.ethercat.station`), in the same way as without pysoem.
"""

from __future__ import annotations

from contextlib import closing
from typing import Any

from drivers.errors import PreflightRefused
from drivers.ethercat.raw import RawSegment, refuse_driven, unusable
from drivers.ethercat.station import Station, not_answered, station_of
from profiles import MessageCode

FRAME_US, START_TRIES = 20_000, 3
"""Time after which SOEM repeats a frame of the start, µs, and attempts to find the slaves. SOEM's default of 2 ms is
too short for a busy computer."""


class SoemStation(Station):
    """One slave's registers, through pysoem."""

    def __init__(self, slave: Any, place: str) -> None:
        self._slave, self.place = slave, place

    def read(self, offset: int, size: int) -> bytes:
        try:
            return bytes(self._slave._fprd(offset, size, self.wait_us))
        except Exception as error:                     # pysoem's WkcError has no common base with anything
            raise not_answered("the slave does not answer", self.place) from error

    def write(self, offset: int, data: bytes) -> None:
        try:
            self._slave._fpwr(offset, data, self.wait_us)
        except Exception as error:
            raise not_answered(f"the slave does not take {offset:04X}h", self.place) from error


class EthercatSegment:
    """The slaves of one interface, in PRE-OP, and the one at ``position`` or with the configured station ``alias``.

    Raises PreflightRefused if there is none. `close` closes the interface.
    """

    def __init__(self, master: Any, interface: str, position: int = 0, alias: int | None = None) -> None:
        self.master, self.interface = master, interface
        self._mapped = self._closed = False
        if all(master.config_init() <= 0 for _ in range(START_TRIES)):
            raise PreflightRefused("no EtherCAT slave answers", where=interface,
                                   next_step="Check the cable, the port (IN of the drive) and the supply of the drive",
                                   entry=MessageCode.NO_DRIVE_FOUND)
        self.stations: list[Station] = [SoemStation(slave, f"{interface}, position {number}")
                         for number, slave in enumerate(master.slaves)]
        self.station = station_of(self.stations, interface, position, alias)
        self.position = self.stations.index(self.station)
        self.slave = master.slaves[self.position]

    def map(self, outputs: int, inputs: int) -> None:
        """Map the process data once, for images of these lengths in bytes. No AL state changes.

        Raises PreflightRefused.
        """
        if self._mapped:
            return
        self.master.manual_state_change = 1            # only our slave leaves PRE-OP
        try:
            self.master.config_map()
        except Exception as error:                     # pysoem's ConfigMapError lists errors of the mailbox
            said = ", ".join(str(getattr(one, "desc", one)) for one in getattr(error, "error_list", [error]))
            raise PreflightRefused(f"the process data can't be mapped ({said})", where=self.station.place,
                                   entry=MessageCode.PDO_NOT_POSSIBLE) from error
        found = len(self.slave.output), len(self.slave.input)
        if found != (outputs, inputs):
            raise PreflightRefused(
                f"the process data have {found[0]} and {found[1]} bytes where {outputs} and {inputs} were mapped",
                where=self.station.place, entry=MessageCode.PDO_NOT_POSSIBLE,
            )
        self._mapped = True

    def close(self) -> None:
        """Close the interface, once: SOEM would close another file of this program the second time."""
        if not self._closed:
            self._closed = True
            self.master.close()


def open_segment(interface: str, position: int = 0, alias: int | None = None) -> EthercatSegment:
    """Check the AL states, then open an interface with pysoem. A segment that another master drives is left unchanged.

    Raises PreflightRefused, also without the package pysoem.
    """
    with closing(RawSegment(interface)) as look:
        refuse_driven(look)
    try:
        import pysoem
    except ImportError as error:
        raise PreflightRefused("EtherCAT needs the package pysoem", where="pysoem",
                               next_step="Install it in the clone of tdhil: pip install '.[ethercat]'",
                               entry=MessageCode.PREFLIGHT_REFUSED) from error
    pysoem.settings.timeouts.ret = FRAME_US
    master = pysoem.Master()
    try:
        master.open(interface)
    except (ConnectionError, OSError) as error:
        raise unusable(interface, error) from error
    try:
        return EthercatSegment(master, interface, position, alias)
    except BaseException:
        master.close()
        raise
