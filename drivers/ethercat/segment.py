"""pysoem's master on one network interface (SOEM), with one slave of it as the drive.

It starts the segment, maps the process data, sets the clocks and exchanges the cyclic frame. AL states, SDO and the
watchdog go through the registers (`drivers.ethercat.station`), in the same way as without pysoem.

SOEM continues its start and its mapping after a lost frame, with zeros in place of what it could not read. So the
result is compared with the slave's registers and with the PDOs that the host has read itself. SOEM can map a segment
only once after its start: a second mapping keeps the place of the inputs and the FMMUs of the first one, and mixes the
process data of both. So a disturbed mapping is repeated from the start of the segment.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from typing import Any

from drivers.errors import CommunicationLost, PreflightRefused
from drivers.ethercat.raw import RawSegment, refuse_driven, unusable
from drivers.ethercat.station import READS, WRITES, Station, not_answered, station_of
from profiles import MessageCode

FRAME_US, STEP_US = 20_000, 500_000
"""Time after which SOEM repeats a frame of the start, µs, and time of one step that repeats its frames: access to the
EEPROM, to the mailbox, and the search for slaves. SOEM's default of 2 ms is too short for a busy computer. Its defaults
for a step are as long as our frame, and permit no repetition."""
START_TRIES, MAP_TRIES = 3, 5
"""Attempts to find the slaves and read their EEPROM, and to map the process data."""
OUTPUTS, INPUTS = 2, 3
"""Sync managers of the process data."""


class SoemStation(Station):
    """One slave's registers, through pysoem. Each start of the master makes new slaves."""

    def __init__(self, master: Any, number: int, place: str) -> None:
        self._master, self._number, self.place = master, number, place

    def read(self, offset: int, size: int) -> bytes:
        try:
            return bytes(self._master.slaves[self._number]._fprd(offset, size, self.wait_us))
        except Exception as error:                     # pysoem's WkcError has no common base with anything
            raise not_answered("the slave does not answer", self.place) from error

    def write(self, offset: int, data: bytes) -> None:
        try:
            self._master.slaves[self._number]._fpwr(offset, data, self.wait_us)
        except Exception as error:
            raise not_answered(f"the slave does not take {offset:04X}h", self.place) from error


class EthercatSegment:
    """The slaves of one interface, in PRE-OP, and the one at ``position`` or with the configured station ``alias``.

    Raises PreflightRefused if there is none. `close` closes the interface.
    """

    def __init__(self, master: Any, interface: str, position: int = 0, alias: int | None = None) -> None:
        self.master, self.interface = master, interface
        self.mapped = self._closed = False
        self.stations: list[Station] = []
        self._begin(position, alias)

    def _begin(self, position: int, alias: int | None) -> None:
        """Find the slaves, read their EEPROM and set them to PRE-OP. Repeat this if frames are lost."""
        self.master.manual_state_change = 0
        for last in (False,) * (START_TRIES - 1) + (True,):
            if self.master.config_init() > 0:
                try:
                    if self._started(position, alias) or last:
                        return
                except CommunicationLost:
                    if last:
                        raise
        raise nothing_answers(self.interface)

    def _started(self, position: int, alias: int | None) -> bool:
        """Take the drive's slave. Return False if its identity or its mailbox was not read from the EEPROM."""
        number_of_slaves = len(self.master.slaves)
        if self.stations and len(self.stations) != number_of_slaves:
            raise PreflightRefused(f"{number_of_slaves} slaves answer, {len(self.stations)} before",
                                   where=self.interface, next_step="Check the cable and the supply of each slave",
                                   entry=MessageCode.PREFLIGHT_REFUSED)
        if not self.stations:
            found: list[Station] = [SoemStation(self.master, number, f"{self.interface}, position {number}")
                                    for number in range(number_of_slaves)]
            self.station = station_of(found, self.interface, position, alias)
            self.position = found.index(self.station)
            self.stations = found
        self.slave = self.master.slaves[self.position]
        return bool(self.slave.man and self.slave.id and all(self.station.sync_manager(one)[1] for one in (0, 1)))

    def map(self, outputs: int, inputs: int, again: Callable[[], None]) -> None:
        """Map the process data once, for images of these lengths in bytes. No AL state changes.

        A mapping that is not the assigned one is repeated: the segment is started anew, and ``again`` assigns the PDOs.
        Raises CommunicationLost or PreflightRefused after `MAP_TRIES`.
        """
        if self.mapped:
            return
        found: list[str] = []
        while len(found) < MAP_TRIES:
            if found:
                self._begin(self.position, None)
                again()
            wrong = self._wrong_map(outputs, inputs)
            if not wrong:
                self.mapped = True
                return
            found.append(wrong)
        what = f"the process data can't be mapped, in {MAP_TRIES} attempts"
        if len(set(found)) == 1:
            raise PreflightRefused(
                f"{what}: {found[0]} each time", where=self.station.place, entry=MessageCode.PDO_NOT_POSSIBLE,
                next_step="Check the cable first. If no frames are lost, the drive's PDOs (1C12h, 1C13h) do not fit "
                "its sync managers; see its manual",
            )
        raise CommunicationLost(
            f"{what}: frames were lost or late ({'; '.join(found)})", where=self.station.place,
            next_step="Check the cable and the load of this computer, then start again",
            entry=MessageCode.COMMUNICATION_LOST,
        )

    def _wrong_map(self, outputs: int, inputs: int) -> str:
        """Map the process data of a segment that was just started. Return what differs from the assigned PDOs."""
        self.master.manual_state_change = 1            # only our slave leaves PRE-OP
        try:
            self.master.config_map()
        except Exception as error:                     # pysoem's ConfigMapError lists errors of the mailbox
            return ", ".join(str(getattr(one, "desc", one)) for one in getattr(error, "error_list", [error]))
        sizes = len(self.slave.output), len(self.slave.input)
        if sizes != (outputs, inputs):
            return f"SOEM read {sizes[0]} and {sizes[1]} bytes where {outputs} and {inputs} are assigned"
        station, wanted = self.station, []
        for manager, length, kind in ((OUTPUTS, outputs, WRITES), (INPUTS, inputs, READS)):
            start, found, _ = station.sync_manager(manager)
            if found != length:
                return f"sync manager {manager} has {found} bytes, not {length}"
            wanted.append((start, length, kind))
        units = [unit for one in self.stations for unit in one.fmmus()]
        ours = [one for one in station.fmmus() if (one.physical, one.length, one.kind) in wanted]
        if len(ours) != len(wanted) or any(sum(one.overlaps(other) for other in units) > 1 for one in ours):
            return "the FMMUs do not map the sync managers 2 and 3 once each"
        return ""

    def close(self) -> None:
        """Close the interface, once: SOEM would close another file of this program the second time."""
        if not self._closed:
            self._closed = True
            self.master.close()


def nothing_answers(interface: str) -> PreflightRefused:
    """Return the error for a segment without slaves."""
    return PreflightRefused("no EtherCAT slave answers", where=interface,
                            next_step="Check the cable, the port (IN of the drive) and the supply of the drive",
                            entry=MessageCode.NO_DRIVE_FOUND)


def open_segment(interface: str, position: int = 0, alias: int | None = None) -> EthercatSegment:
    """Check the AL states, then open an interface with pysoem. A segment that another master drives is left unchanged.

    Raises PreflightRefused, also without the package pysoem.
    """
    with closing(RawSegment(interface)) as look:
        if not refuse_driven(look):                    # a master that can't be seen could drive the segment
            raise nothing_answers(interface)
    try:
        import pysoem
    except ImportError as error:
        raise PreflightRefused("EtherCAT needs the package pysoem", where="pysoem",
                               next_step="Install it in the clone of tdhil: pip install '.[ethercat]'",
                               entry=MessageCode.PREFLIGHT_REFUSED) from error
    times = pysoem.settings.timeouts
    times.ret, times.safe, times.eeprom, times.tx_mailbox = FRAME_US, STEP_US, STEP_US, STEP_US
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
