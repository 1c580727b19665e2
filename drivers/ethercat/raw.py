"""Single EtherCAT datagrams on a raw socket of Linux, for what must not disturb a running segment.

pysoem's start sets every slave of the segment to INIT, also those that another master drives. So tdhil first looks at
the AL states with these datagrams, and `tdhil stop` reaches a drive through them without changing its AL state.

::

    Ethernet ─ EtherCAT header ─ command, index, address, offset, length, IRQ ─ data ─ working counter

Source: ETG.1000.4, frame structure and commands.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import time

from drivers.errors import CommunicationLost, PreflightRefused
from drivers.ethercat.station import AL_STATUS, OP, Station, not_answered
from profiles import MessageCode

ETHERCAT = 0x88A4
"""Type of an Ethernet frame."""
APRD, APWR, BRD = 1, 2, 7
"""Commands: read and write by position, read from all slaves."""
ANSWER_S, TRIES = 0.05, 5
"""Waiting time for a frame that comes back, s, and number of attempts."""
_HEADER, _DATAGRAM = struct.Struct("<6s6s2s"), struct.Struct("<BBHHHH")
_LEAST = 60
"""Bytes of the shortest Ethernet frame without its checksum."""


class RawSegment:
    """The slaves at one network interface."""

    def __init__(self, interface: str) -> None:
        self.interface = interface
        self._index = 0
        try:
            self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERCAT))
        except (AttributeError, PermissionError, OSError) as error:
            raise unusable(interface, error) from error
        try:
            self._socket.bind((interface, 0))
        except OSError as error:
            self._socket.close()
            raise unusable(interface, error) from error

    def exchange(self, command: int, address: int, offset: int, data: bytes) -> tuple[bytes, int]:
        """Send one datagram. Return its data and its working counter. Raises CommunicationLost without an answer."""
        for _ in range(TRIES):
            self._index = (self._index + 1) & 0xFF
            self._send(command, address, offset, data)
            found = self._await(command, len(data))
            if found is not None:
                return found
        raise not_answered("no frame comes back", self.interface)

    def _send(self, command: int, address: int, offset: int, data: bytes) -> None:
        datagram = _DATAGRAM.pack(command, self._index, address & 0xFFFF, offset, len(data), 0) + data + bytes(2)
        frame = _HEADER.pack(b"\xff" * 6, b"\x02\x00\x00\x00\x00\x01", ETHERCAT.to_bytes(2, "big"))
        frame += (len(datagram) | 1 << 12).to_bytes(2, "little") + datagram
        try:
            self._socket.send(frame.ljust(_LEAST, b"\0"))
        except OSError as error:
            raise not_answered(f"the interface takes no frames ({error.strerror})", self.interface) from error

    def _await(self, command: int, size: int) -> tuple[bytes, int] | None:
        """Return data and working counter of our datagram; frames of other masters are skipped."""
        end_s = time.monotonic() + ANSWER_S
        begin = _HEADER.size + 2 + _DATAGRAM.size
        while (left_s := end_s - time.monotonic()) > 0.0:
            self._socket.settimeout(left_s)
            with contextlib.suppress(TimeoutError):
                frame = self._socket.recv(2048)
                ours = frame[_HEADER.size + 2 : _HEADER.size + 4] == bytes((command, self._index))
                if ours and len(frame) >= begin + size + 2:
                    return frame[begin : begin + size], int.from_bytes(frame[begin + size : begin + size + 2], "little")
        return None

    def stations(self) -> list[Station]:
        """Return the slaves by their position; none if none answers."""
        with contextlib.suppress(CommunicationLost):
            return [RawStation(self, position) for position in range(self.exchange(BRD, 0, AL_STATUS, bytes(2))[1])]
        return []

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class RawStation(Station):
    """One slave by its position, 0 is the first."""

    def __init__(self, segment: RawSegment, position: int) -> None:
        self._segment, self._position = segment, position
        self.place = f"{segment.interface}, position {position}"

    def read(self, offset: int, size: int) -> bytes:
        data, counter = self._segment.exchange(APRD, -self._position, offset, bytes(size))
        if counter != 1:
            raise not_answered("the slave does not answer", self.place)
        return data

    def write(self, offset: int, data: bytes) -> None:
        if self._segment.exchange(APWR, -self._position, offset, data)[1] != 1:
            raise not_answered(f"the slave does not take {offset:04X}h", self.place)


def refuse_driven(segment: RawSegment) -> int:
    """Refuse a segment on which a slave is in OP: another master drives it. Nothing is written. Return the number of
    slaves.

    A host that died leaves SAFE-OP behind, where a slave takes no setpoints. Raises PreflightRefused.
    """
    stations = segment.stations()
    for station in stations:
        found = station.al_status()
        if found.state == OP:
            raise PreflightRefused(
                f"the slave is in {found.text}: another master drives this segment", where=station.place,
                next_step="Stop that master. Nothing was written: tdhil would set all slaves to INIT",
                entry=MessageCode.ANOTHER_MASTER,
            )
    return len(stations)


def unusable(interface: str, error: Exception) -> PreflightRefused:
    """Return the error for an interface that can't be opened."""
    text = str(getattr(error, "strerror", None) or error)
    step = "List the interfaces: ip link. Set it up: sudo ip link set NAME up"
    if isinstance(error, PermissionError):
        step = "EtherCAT needs raw sockets: start as root, or: sudo setcap cap_net_raw+ep on a copy of the interpreter"
    elif isinstance(error, AttributeError):
        text, step = "this system has no raw sockets", "EtherCAT needs Linux"
    return PreflightRefused(f"the interface can't be opened ({text})", where=interface, next_step=step,
                            entry=MessageCode.BUS_UNUSABLE)
