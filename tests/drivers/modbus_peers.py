"""Peer of a Modbus line, by hand: a thread behind a loopback socket or a pty with the replies of a test.

``behave(number, request)`` gets the number of the request (from 0) and its bytes on the line. It returns
the reaction: bytes are sent, numbers (seconds) and events are waited for, functions called. RESET and CLOSE end the
connection.
"""

import contextlib
import os
import select
import socket
import struct
import threading
import time
import tty

RESET, CLOSE = "reset", "close"
HANGS_S = 60.0


def crc(data):
    """CRC-16/MODBUS, bit by bit (Modbus over serial line V1.02, appendix B)."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return struct.pack("<H", value)


def rtu(unit, pdu):
    frame = bytes((unit,)) + pdu
    return frame + crc(frame)


def tcp(transaction, unit, pdu):
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


class Peer(threading.Thread):
    """Peer that runs until the context ends."""

    def __init__(self, behave):
        super().__init__(daemon=True)
        self.behave = behave
        self.requests = []
        self.over = threading.Event()

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *error):
        self.over.set()
        self.join(5.0)
        self.end()

    def act(self, request, send):
        number = len(self.requests)
        self.requests.append(request)
        for what in self.behave(number, request):
            if isinstance(what, bytes):
                send(what)
            elif isinstance(what, float):
                time.sleep(what)
            elif isinstance(what, threading.Event):
                assert what.wait(HANGS_S)
            elif callable(what):
                what()
            else:
                return what
        return None


class TcpPeer(Peer):
    """Server on a free port of the loopback for one connection after the other."""

    def __init__(self, behave):
        super().__init__(behave)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.settimeout(0.02)
        self.port = self.listener.getsockname()[1]
        self.connections = 0

    def run(self):
        while not self.over.is_set():
            with contextlib.suppress(OSError):
                connection, _ = self.listener.accept()
                self.connections += 1
                with connection:
                    self.serve(connection)

    def serve(self, connection):
        connection.settimeout(0.02)
        buffer = b""
        while not self.over.is_set():
            try:
                data = connection.recv(1000)
            except TimeoutError:
                continue
            if not data:
                return
            buffer += data
            while len(buffer) >= 6 and len(buffer) >= (end := 6 + struct.unpack_from(">H", buffer, 4)[0]):
                request, buffer = buffer[:end], buffer[end:]
                ending = self.act(request, connection.sendall)
                if ending == RESET:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                if ending is not None:
                    return

    def end(self):
        self.listener.close()


class SerialPeer(Peer):
    """Master side of a pty; ``device`` is the other one. The CRC separates requests."""

    def __init__(self, behave):
        super().__init__(behave)
        self.master, self.slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        self.device = os.ttyname(self.slave)

    def run(self):
        buffer = b""
        while not self.over.is_set():
            if select.select([self.master], [], [], 0.02)[0]:
                buffer += os.read(self.master, 1000)
            while end := next((end for end in range(4, len(buffer) + 1)
                               if crc(buffer[:end - 2]) == buffer[end - 2:end]), 0):
                request, buffer = buffer[:end], buffer[end:]
                if self.act(request, lambda data: os.write(self.master, data)) is not None:
                    return

    def end(self):
        for end in (self.master, self.slave):
            with contextlib.suppress(OSError):
                os.close(end)
