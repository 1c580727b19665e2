"""Modbus over TCP: one socket, one request at a time, checked transaction ids.

pymodbus makes the frames. Its synchronous client is not used, for three reasons. It reconnects by itself before a
request, which an enabled drive must not see. It reports a foreign transaction id as silence. It takes up to twice its
time-out (`ModbusBaseSyncClient.execute`, `TransactionManager.sync_get_response`, 3.16).

TCP must not deliver old data to the drive. So requests are not queued behind a dead connection, and closing discards
the queue: no old setpoint arrives when the cable is connected again.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import struct
import sys
from collections import deque
from typing import NoReturn

from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU

from drivers.clock import Clock
from drivers.errors import PreflightRefused
from drivers.modbus.link import Reply
from drivers.modbus.pdu import BadReply, LinkLost, NoReply, answers
from profiles import MessageCode

CONNECT_S = 3.0
DEAD_AFTER_MS = 1000
"""The connection ends if the peer does not acknowledge data for this time, ms (TCP_USER_TIMEOUT, if available)."""
HEADER = struct.Struct(">HHHB")
"""Transaction id, protocol id, length of what follows, unit (Modbus Messaging on TCP/IP, section 3.1.3)."""
_AT_ONCE = struct.pack("hh" if sys.platform == "win32" else "ii", 1, 0)
MOST_RENEWED, RENEWED_WITHIN_S = 3, 10.0
"""Most reconnections because of a foreign reply within this time, s; after that the reply is only dropped."""
REMEMBERED = 64
"""Number of remembered ids of earlier requests: replies to them are late or duplicated, not foreign."""


class TcpLink:
    """A connection to ``host``; opens it at once. Raises PreflightRefused if that fails."""

    def __init__(self, host: str, port: int, clock: Clock, *, connect_s: float = CONNECT_S) -> None:
        self.clock = clock
        self.description = f"{host}:{port}"
        self.late = 0
        self._address = (host, port)
        self._connect_s = connect_s
        self._framer = FramerSocket(DecodePDU(False))
        self._given_up: deque[int] = deque(maxlen=REMEMBERED)
        self._answered: deque[int] = deque(maxlen=REMEMBERED)
        self._buffer = b""
        self._transaction = 0
        self._renew = False
        self._opening: socket.socket | None = None      # a new connection that is not open yet
        self._renewed_s: deque[float] = deque(maxlen=MOST_RENEWED)
        self._family, self._peer = socket.AF_INET, ()
        try:
            self._socket: socket.socket | None = self._connect()
        except OSError as error:
            raise self._unreachable(error) from error

    def transact(self, unit: int, pdu: bytes, timeout_s: float) -> Reply:
        """Send one request and return its reply. A connection that was reset stays lost; nothing is sent twice."""
        deadline_s = self.clock.now_s() + timeout_s
        if self._renew:
            self._reconnect(timeout_s)
        if self._socket is None:
            self._lost("the connection is gone")
        while self._untaken():
            # The peer has not acknowledged the previous request. Another request would only wait behind it.
            if self.clock.now_s() >= deadline_s:
                raise self._silent(timeout_s, "the connection accepts no data: half open, or the cable is unplugged")
            self._read(0.005)
        self._transaction = self._transaction % 0xFFFF + 1
        sent_s = self.clock.now_s()
        try:
            self._socket.settimeout(timeout_s)
            self._socket.sendall(self._framer.encode(pdu, unit, self._transaction))
        except TimeoutError as error:
            raise self._silent(timeout_s, "the connection accepts no data") from error
        except OSError as error:
            self._lost(str(error), error)
        while True:
            frame = self._frame()
            if frame is not None and self._accepts(frame, unit, pdu):
                self._answered.append(self._transaction)
                return Reply(frame[HEADER.size :], sent_s, self.clock.now_s())
            if frame is None:
                left_s = deadline_s - self.clock.now_s()
                if left_s <= 0.0:
                    self._given_up.append(self._transaction)
                    raise self._silent(timeout_s, f"no reply within {timeout_s:.3g} s")
                self._read(left_s)

    def close(self) -> None:
        """Close at once and discard unacknowledged data."""
        self._drop()
        if self._opening is not None:
            self._opening.close()
        self._opening, self._renew = None, False

    def _drop(self) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
            self._socket.close()
        self._socket = None

    # -- replies ---------------------------------------------------------------------------------------------

    def _frame(self) -> bytes | None:
        """Return the next whole received frame. Raises BadReply if the data is not a frame."""
        if len(self._buffer) < HEADER.size:
            return None
        _, protocol, length, _ = HEADER.unpack_from(self._buffer)
        if protocol != 0 or not 2 <= length <= 254:
            raise self._untrusted(f"the received bytes are not a Modbus frame: {self._buffer[:16].hex(' ')}")
        end = HEADER.size - 1 + length
        if len(self._buffer) < end:
            return None
        frame, self._buffer = self._buffer[:end], self._buffer[end:]
        return frame

    def _accepts(self, frame: bytes, unit: int, pdu: bytes) -> bool:
        """Return whether this is the reply. A late one is dropped; anything else raises BadReply."""
        transaction, _, _, sender = HEADER.unpack_from(frame)
        if transaction in self._given_up:
            self._given_up.remove(transaction)
            self.late += 1
            return False
        if transaction != self._transaction:
            since_s = self.clock.now_s() - RENEWED_WITHIN_S
            if transaction in self._answered or sum(at_s >= since_s for at_s in self._renewed_s) >= MOST_RENEWED:
                self.late += 1         # duplicated, or foreign once too often: dropped, the connection is not renewed
                return False
            raise self._untrusted(f"a reply with transaction id {transaction}, not {self._transaction}")
        if sender != unit:
            raise self._bad(f"a reply of unit {sender}, not {unit}")
        if not answers(pdu, frame[HEADER.size :]):
            raise self._bad(f"a reply of function {frame[HEADER.size]} to a request of function {pdu[0]}")
        return True

    def _read(self, timeout_s: float) -> None:
        """Read received data, or wait for it. Raises LinkLost at the end of the connection."""
        if self._socket is None:
            self._lost("the connection is gone")
        try:
            self._socket.settimeout(timeout_s)
            data = self._socket.recv(4096)
        except (TimeoutError, BlockingIOError):
            return
        except OSError as error:
            self._lost(str(error), error)
        if not data:
            self._lost("the drive closed the connection")
        self._buffer += data

    # -- the connection --------------------------------------------------------------------------------------

    def _connect(self) -> socket.socket:
        connection = socket.create_connection(self._address, timeout=self._connect_s)
        self._family, self._peer = connection.family, connection.getpeername()
        return self._prepared(connection)

    @staticmethod
    def _prepared(connection: socket.socket) -> socket.socket:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, DEAD_AFTER_MS)
        return connection

    def _reconnect(self, timeout_s: float) -> None:
        """Reconnect after a frame that can't be ours, because later data on this connection can't be trusted either.

        It takes at most the reply's time: NoReply is raised while the new connection is not open, and the next call
        continues.
        """
        now_s = self.clock.now_s()
        if self._opening is None:
            self._drop()
            self._buffer = b""
            self._given_up.clear()
            self._answered.clear()
            self._renewed_s.append(now_s)
            self._opening = socket.socket(self._family, socket.SOCK_STREAM)
            self._opening.setblocking(False)
            code = self._opening.connect_ex(self._peer)
            if code not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
                self._lost(f"it could not be opened again: {os.strerror(code)}")
        _, opened, failed = select.select([], [self._opening], [self._opening], timeout_s)
        code = self._opening.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if code or (failed and not opened):
            self._lost(f"it could not be opened again: {os.strerror(code)}")
        if opened:
            self._socket, self._opening, self._renew = self._prepared(self._opening), None, False
        elif now_s - self._renewed_s[-1] > self._connect_s:
            self._lost("it could not be opened again: no answer")
        else:
            raise self._silent(timeout_s, "a reply to another request came, and the new connection is not open yet")

    def _untaken(self) -> bool:
        """Return whether the other end has not acknowledged all sent data. Known on Linux only."""
        if not sys.platform.startswith("linux") or self._socket is None:
            return False
        import fcntl
        import termios

        try:
            waiting = fcntl.ioctl(self._socket, termios.TIOCOUTQ, bytes(4))
        except OSError:
            return False
        return bool(struct.unpack("i", waiting)[0])

    def _silent(self, timeout_s: float, what: str) -> NoReply:
        step = "Check cable and drive, and whether another master uses the drive's only connection"
        return NoReply(what, where=self.description, next_step=step)

    def _bad(self, what: str) -> BadReply:
        step = "Check for a gateway or a second master on the way to the drive, and the unit number (--unit)"
        return BadReply(what, where=self.description, next_step=step)

    def _untrusted(self, what: str) -> BadReply:
        self._renew = True
        return self._bad(what)

    def _lost(self, what: str, error: Exception | None = None) -> NoReturn:
        self.close()
        raise LinkLost(
            f"the connection to the drive is lost: {what}",
            where=self.description,
            next_step="Check cable and supply. The drive's own watchdog stops the shaft. Then start again",
        ) from error

    def _unreachable(self, error: OSError) -> PreflightRefused:
        host, port = self._address
        if isinstance(error, ConnectionRefusedError):
            what, step = "nothing listens there", f"Enable Modbus TCP at the drive, and check that its port is {port}?"
        elif isinstance(error, socket.gaierror):
            what, step = f"no such host: {error.strerror}", "Give the drive's address with --host, such as 192.0.2.10"
        elif isinstance(error, TimeoutError) or error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH):
            what = "no answer to the connection"
            step = f"Check cable and address: is this computer in the drive's network? Try: ping {host}"
        else:
            what, step = str(error), "Check address and port"
        return PreflightRefused(f"can't connect: {what}", where=self.description, next_step=step,
                                entry=MessageCode.NO_DRIVE_FOUND)
