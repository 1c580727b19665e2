"""Lines of the simulated drive: a TCP port, a serial device, or a pseudo terminal that it creates itself."""

import os
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from struct import Struct
from typing import Generic, NamedTuple, Protocol, TypeVar

from profiles import MessageCode, TdhilError
from sim_bus.modbus.codec import DriveReply

# ---------------------------------------------------------------------------------------------------------------------
# Modbus frames around PDUs, as the drive sees them. Pure.
#
# ::
#
#     TCP   transaction:2 protocol:2 = 0  length:2  unit:1  PDU          (messaging guide, section 3.1.3)
#     RTU   unit:1  PDU  CRC:2, low byte first                            (serial line guide, section 2.5.1)
#
# The end of an RTU frame is known from its function code; for an unknown code, from a CRC that fits. Silence clears the
# rest of a broken frame. The code is written for the drive alone; the host has its own.


_MBAP = Struct(">HHHB")
_LONGEST_TCP = 260
_LONGEST_RTU = 256
_SILENCE_S = 0.05
"""Silence that ends a frame, s. A pty has no bit rate, and a host may be delayed between two bytes, so it is much
longer than the 1.75 ms of a line."""
_FIXED = dict.fromkeys((1, 2, 3, 4, 5, 6, 8), 8)
_COUNTED = {15: (6, 9), 16: (6, 9), 23: (10, 13)}
"""function: (position of its byte count, length without the counted bytes)."""


class ReceivedRequest(NamedTuple):
    """Unit, PDU, and the transaction id that the reply repeats. ``connection`` distinguishes clients."""

    unit: int
    pdu: bytes
    transaction: int = 0
    connection: int = 0


class NotModbus(Exception):
    """Error for a peer that does not use Modbus."""


def tcp_requests(buffer: bytearray) -> Iterator[ReceivedRequest]:
    """Take whole frames off ``buffer`` and yield them. Raises NotModbus for other data."""
    while len(buffer) >= _MBAP.size:
        transaction, protocol, length, unit = _MBAP.unpack_from(buffer)
        if protocol or not 2 <= length <= _LONGEST_TCP - 6:
            raise NotModbus
        if len(buffer) < 6 + length:
            return
        pdu = bytes(buffer[_MBAP.size : 6 + length])
        del buffer[: 6 + length]
        yield ReceivedRequest(unit, pdu, transaction)


def tcp_reply(request: ReceivedRequest, pdu: bytes, wrong_bits: int = 0) -> bytes:
    """Return the frame of a reply; ``wrong_bits``: bits of its transaction id that are inverted."""
    return _MBAP.pack(request.transaction ^ wrong_bits, 0, len(pdu) + 1, request.unit) + pdu


class RtuReceiver:
    """Receiver of RTU bytes that yields requests."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._heard_s = 0.0

    def feed(self, data: bytes, now_s: float) -> Iterator[ReceivedRequest]:
        """Take received bytes and yield the requests. ``now_s``: time of any clock that doesn't go back."""
        if now_s - self._heard_s > _SILENCE_S:
            self._buffer.clear()
        self._heard_s = now_s
        self._buffer += data
        while len(self._buffer) >= 4:
            length = self._length()
            if length == 0:
                return
            frame, self._buffer = self._buffer[:length], self._buffer[length:]
            if crc(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
                self._buffer.clear()        # out of step: silence shows where the next frame begins
                return
            yield ReceivedRequest(frame[0], bytes(frame[1:-2]))

    def _length(self) -> int:
        """Return the length of the frame at the beginning; 0 while it is incomplete."""
        buffer = self._buffer
        function = buffer[1]
        if function in _FIXED:
            length = _FIXED[function]
        elif function in _COUNTED:
            at, fixed = _COUNTED[function]
            length = fixed + buffer[at] if len(buffer) > at else _LONGEST_RTU
        elif crc(buffer[:-2]) == int.from_bytes(buffer[-2:], "little") or len(buffer) >= _LONGEST_RTU:
            length = len(buffer)
        else:
            return 0
        return length if len(buffer) >= length else 0


def rtu_reply(request: ReceivedRequest, pdu: bytes, wrong_bits: int = 0) -> bytes:
    """Return the frame of a reply; ``wrong_bits``: bits of its CRC that are inverted."""
    body = bytes((request.unit,)) + pdu
    return body + (crc(body) ^ wrong_bits).to_bytes(2, "little")


def crc(data: bytes | bytearray) -> int:
    """Return the CRC-16 of the serial line guide: polynomial A001h, reflected, initial value FFFFh."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value


# ---------------------------------------------------------------------------------------------------------------------
# Frames that a scripted fault delays, in real time.


To = TypeVar("To")


class LateQueue(Generic[To]):
    """Delayed frames with their receivers."""

    def __init__(self) -> None:
        self._held: list[tuple[float, To, bytes]] = []

    def put(self, to: To, frame: bytes, late_s: float) -> None:
        """Add a frame that is due ``late_s`` from now."""
        self._held.append((time.monotonic() + late_s, to, frame))

    def due(self) -> list[tuple[To, bytes]]:
        """Return the data that is due now, in order."""
        if not self._held:
            return []
        now_s = time.monotonic()
        due = [(to, frame) for at_s, to, frame in self._held if at_s <= now_s]
        self._held = [one for one in self._held if one[0] > now_s]
        return due


# ---------------------------------------------------------------------------------------------------------------------

_CLIENTS = 16
_SEND_TIMEOUT_S = 1.0
_AT_ONCE = struct.pack("ii", 1, 0)
"""SO_LINGER setting with which closing sends a reset."""
Serve = Callable[[ReceivedRequest], DriveReply]
"""Function: request → reply."""


class RequestListener(Protocol):
    """A line on which requests arrive."""

    @property
    def reached_by(self) -> str:
        """Return the address for the ready line."""

    def sources(self) -> list[int]:
        """Return the file descriptors to wait for."""

    def ready(self, source: int, serve: Serve) -> None:
        """Handle data on one of these descriptors."""

    def send_late(self) -> None:
        """Send the delayed replies that are due."""

    def close(self) -> None:
        """Close the line; safe to repeat."""


class TcpListener:
    """Modbus TCP for several hosts at a time."""

    def __init__(self, host: str, port: int) -> None:
        try:
            self._server = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        except (OSError, OverflowError) as error:
            raise TdhilError(
                f"can't listen: {getattr(error, 'strerror', None) or error}", where=f"--tcp {host}:{port}",
                next_step="Take another port (0 takes any free one), or end what listens there",
                entry=MessageCode.SIMULATOR_UNUSABLE,
            ) from error
        self._clients: dict[int, tuple[socket.socket, bytearray, int]] = {}
        self._accepted = 0             # number of clients so far
        self._silent: list[socket.socket] = []     # half-open connections: never read again
        self._late: LateQueue[socket.socket] = LateQueue()

    @property
    def reached_by(self) -> str:
        host, port = self._server.getsockname()[:2]
        return f"tcp {host}:{port}"

    def sources(self) -> list[int]:
        return [self._server.fileno(), *self._clients]

    def ready(self, source: int, serve: Serve) -> None:
        if source == self._server.fileno():
            self._accept()
            return
        client, buffer, number = self._clients[source]
        try:
            data = client.recv(4096)
            if not data:
                raise ConnectionResetError
            buffer += data
            for request in tcp_requests(buffer):
                reply = serve(request._replace(connection=number))
                if reply.connection:
                    self._clients.pop(source)
                    if reply.connection == "reset":
                        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
                        client.close()
                    else:                                  # the connection ends without any message
                        self._silent.append(client)
                    return
                if reply.pdu is not None and not reply.crc_bits:
                    frame = tcp_reply(request, reply.pdu, reply.transaction_bits)
                    if reply.late_s:
                        self._late.put(client, frame, reply.late_s)
                    else:
                        client.sendall(frame)
        except (OSError, NotModbus):
            self._clients.pop(source)[0].close()

    def send_late(self) -> None:
        for client, frame in self._late.due():
            with suppress(OSError):            # the client has gone, so the reply is lost
                client.sendall(frame)

    def close(self) -> None:
        for client in [*self._silent, *(client for client, _, _ in self._clients.values())]:
            client.close()
        self._silent.clear()
        self._clients.clear()
        self._server.close()

    def _accept(self) -> None:
        with suppress(OSError):
            client, _ = self._server.accept()
            if len(self._clients) >= _CLIENTS:
                client.close()
                return
            client.settimeout(_SEND_TIMEOUT_S)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._accepted += 1
            self._clients[client.fileno()] = (client, bytearray(), self._accepted)


class RtuListener:
    """Modbus RTU on a terminal: a serial device, or a pseudo terminal whose other end hosts open."""

    def __init__(self, device: str | None, *, baud: int, parity: str, stop_bits: int) -> None:
        self._slave = -1
        try:
            import termios
            import tty
        except ImportError as error:
            raise TdhilError(
                "this system has no serial lines that a program can be at the far end of", where="--rtu",
                next_step="Use --tcp",
                entry=MessageCode.SIMULATOR_UNUSABLE,
            ) from error
        try:
            if device is None:
                self._fd, self._slave = os.openpty()       # kept open, or reading fails while there is no host
                tty.setraw(self._slave)
                self.reached_by = f"rtu {os.ttyname(self._slave)}"
            else:
                self._fd = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                _set_line(self._fd, baud, parity, stop_bits)
                self.reached_by = f"rtu {device} {baud} 8{parity}{stop_bits}"
        except (OSError, termios.error) as error:
            reason = error.strerror if isinstance(error, OSError) else error.args[-1]
            raise TdhilError(
                f"can't open: {reason}", where=f"--rtu {device or ''}".rstrip(),
                next_step="Name a serial device that you may write to, or none to get a pseudo terminal",
                entry=MessageCode.SIMULATOR_UNUSABLE,
            ) from error
        os.set_blocking(self._fd, False)
        self._receiver = RtuReceiver()
        self._late: LateQueue[int] = LateQueue()

    def sources(self) -> list[int]:
        return [self._fd]

    def ready(self, source: int, serve: Serve) -> None:
        try:
            data = os.read(source, 4096)
        except BlockingIOError:
            return
        except OSError as error:
            raise TdhilError(f"the line has gone: {error.strerror}", where=self.reached_by,
                             entry=MessageCode.SIMULATOR_UNUSABLE) from error
        for request in self._receiver.feed(data, time.monotonic()):
            reply = serve(request)
            if reply.pdu is not None:
                frame = rtu_reply(request, reply.pdu, reply.crc_bits)
                if reply.late_s:
                    self._late.put(source, frame, reply.late_s)
                else:
                    _write(source, frame)

    def send_late(self) -> None:
        for source, frame in self._late.due():
            _write(source, frame)

    def close(self) -> None:
        for fd in (self._fd, self._slave):
            if fd >= 0:
                os.close(fd)
        self._fd = self._slave = -1


def _write(fd: int, frame: bytes) -> None:
    with suppress(BlockingIOError):            # no reader: the reply is lost, as on a line
        os.write(fd, frame)


def _set_line(fd: int, baud: int, parity: str, stop_bits: int) -> None:
    """Set a raw line with eight bits at the given rate. Raises termios.error if the device does not support it."""
    import termios
    import tty

    tty.setraw(fd)
    rate = getattr(termios, f"B{baud}", None)
    if rate is None:
        raise termios.error(0, f"{baud} baud is no rate of this system")
    attributes = termios.tcgetattr(fd)
    flags = attributes[2] & ~(termios.PARENB | termios.PARODD | termios.CSTOPB | termios.CSIZE)
    flags |= termios.CS8 | termios.CLOCAL | termios.CREAD
    flags |= {"N": 0, "E": termios.PARENB, "O": termios.PARENB | termios.PARODD}[parity]
    attributes[2] = flags | (termios.CSTOPB if stop_bits == 2 else 0)
    attributes[4] = attributes[5] = rate
    termios.tcsetattr(fd, termios.TCSANOW, attributes)
