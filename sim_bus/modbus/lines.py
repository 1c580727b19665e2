"""What the simulated drive listens on: a TCP port, a serial device, or a pseudo terminal that it makes itself."""

import os
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Protocol

from profiles.errors import TdhilError
from sim_bus.modbus.framing import NotModbus, Request, RtuReceiver, rtu_reply, tcp_reply, tcp_requests
from sim_bus.modbus.late import Late
from sim_bus.modbus.reply import Reply

_CLIENTS = 16
_SEND_TIMEOUT_S = 1.0
_AT_ONCE = struct.pack("ii", 1, 0)
"""SO_LINGER: closing sends a reset."""
Serve = Callable[[Request], Reply]
"""A request → what comes back."""


class Listener(Protocol):
    """A line on which requests come."""

    @property
    def reached_by(self) -> str:
        """For the ready line."""

    def sources(self) -> list[int]:
        """File descriptors to wait for."""

    def ready(self, source: int, serve: Serve) -> None:
        """One of them has something."""

    def send_late(self) -> None:
        """Replies that were held back and are due."""

    def close(self) -> None:
        """Gives everything back; safe to repeat."""


class TcpListener:
    """Modbus TCP, several hosts at a time."""

    def __init__(self, host: str, port: int) -> None:
        try:
            self._server = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        except (OSError, OverflowError) as error:
            raise TdhilError(
                f"can't listen: {getattr(error, 'strerror', None) or error}", where=f"--tcp {host}:{port}",
                next_step="Take another port (0 takes any free one), or end what listens there",
            ) from error
        self._clients: dict[int, tuple[socket.socket, bytearray, int]] = {}
        self._accepted = 0             # so many clients so far: the last one's number
        self._silent: list[socket.socket] = []     # half open: never looked at again
        self._late: Late[socket.socket] = Late()

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
                    self._let_go(source, reset=reply.connection == "reset")
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
            with suppress(OSError):            # it has gone: so is the reply
                client.sendall(frame)

    def close(self) -> None:
        for client in [*self._silent, *(client for client, _, _ in self._clients.values())]:
            client.close()
        self._silent.clear()
        self._clients.clear()
        self._server.close()

    def _let_go(self, source: int, *, reset: bool) -> None:
        """A connection dies: by a reset, or in silence and without an end."""
        client, _, _ = self._clients.pop(source)
        if reset:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
            client.close()
        else:
            self._silent.append(client)

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
    """Modbus RTU on a terminal: a serial device, or without one a pseudo terminal whose other end hosts open."""

    def __init__(self, device: str | None, *, baud: int, parity: str, stop_bits: int) -> None:
        self._slave = -1
        try:
            import termios
            import tty
        except ImportError as error:
            raise TdhilError(
                "this system has no serial lines that a program can be at the far end of", where="--rtu",
                next_step="Use --tcp",
            ) from error
        try:
            if device is None:
                self._fd, self._slave = os.openpty()       # kept open, or reading fails whenever no host is there
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
            ) from error
        os.set_blocking(self._fd, False)
        self._receiver = RtuReceiver()
        self._late: Late[int] = Late()

    def sources(self) -> list[int]:
        return [self._fd]

    def ready(self, source: int, serve: Serve) -> None:
        try:
            data = os.read(source, 4096)
        except BlockingIOError:
            return
        except OSError as error:
            raise TdhilError(f"the line has gone: {error.strerror}", where=self.reached_by) from error
        for request in self._requests(data):
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

    def _requests(self, data: bytes) -> Iterator[Request]:
        return self._receiver.feed(data, time.monotonic())


def _write(fd: int, frame: bytes) -> None:
    with suppress(BlockingIOError):            # nobody reads: the reply is lost, as on a line
        os.write(fd, frame)


def _set_line(fd: int, baud: int, parity: str, stop_bits: int) -> None:
    """Raw, eight bits, at the given rate; termios.error where the device can't."""
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
