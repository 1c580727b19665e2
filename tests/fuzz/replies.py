"""Hostile replies of a drive or another node to the drivers. Scripts are bytes.

CAN: records of 12 bytes, ``after u8, kind u8, identifier u8, length u8, data 8``. A record acts after this number of
host frames: it sends a foreign frame, or changes, drops or duplicates a reply.
Modbus: ``request u8, cut u8`` and the bytes on the line.
"""

import contextlib
import math
import socket
import sys
import time
import types
from collections.abc import Iterator
from typing import Any

import drivers.canopen.drive
from drivers.clock import MonotonicClock
from drivers.drive import Command, DriveLimits, Mode
from drivers.errors import TdhilError
from profiles.library import load_canopen_profile
from tests.drivers.scripted_drive import FakeTime, ScriptedBus, ScriptedDrive

IDENTIFIERS = (0x000, 0x080, 0x081, 0x181, 0x281, 0x381, 0x581, 0x601, 0x701, 0x77F, 0x7E5, 0x182)
LIMITS = DriveLimits(10.0, 400.0, 2.0, 0.5)
_profile = load_canopen_profile("generic/cia402")


class Script:
    """Script whose records act one after the other, each at its time."""

    def __init__(self, data: bytes, bus: ScriptedBus) -> None:
        self._records = [data[start:start + 12].ljust(12, b"\0") for start in range(0, len(data), 12)]
        self._bus = bus
        self._left = self._records[0][0] if self._records else 0
        self._answer = bus.on_send
        bus.on_send = self._on_send

    def _on_send(self, identifier: int, data: bytes) -> None:
        before = len(self._bus.inbox)
        self._answer(identifier, data)
        self._left -= 1
        while self._records and self._left < 0:
            self._act(self._records.pop(0), before)
            self._left = self._records[0][0] if self._records else 0

    def _act(self, record: bytes, before: int) -> None:
        kind, chosen, length, data = record[1], record[2], record[3] % 9, record[4:]
        answers = self._bus.inbox[before:]
        if kind % 8 < 3 or not answers:
            flags = {"is_extended_id": kind == 128, "is_remote_frame": kind == 129, "is_error_frame": kind == 130}
            body = b"" if kind == 129 else data[:length]
            self._bus.put(IDENTIFIERS[chosen % len(IDENTIFIERS)], body, 0.0001 * (chosen % 4), **flags)
        elif kind % 8 == 3:
            del self._bus.inbox[before:]
        elif kind % 8 == 4:
            for due_s, message in answers:
                self._bus.put(message.arbitration_id, bytes(message.data), due_s - self._bus.time.now_s)
        elif kind % 8 == 7:
            for _, message in answers:
                del message.data[length:]
        else:                              # other values, after the header of the reply or of the script
            for _, message in answers:
                head = 4 if kind % 8 == 5 else 0
                message.data[head:] = bytes(one ^ data[k] for k, one in enumerate(message.data) if k >= head)
                if kind % 8 == 6 and message.arbitration_id == 0x581:
                    message.data[0] = data[0]


@contextlib.contextmanager
def fake_time() -> Iterator[FakeTime]:
    fake = FakeTime()
    with contextlib.ExitStack() as stack:
        for name, module in list(sys.modules.items()):
            if name.split(".")[0] == "drivers" and getattr(module, "time", None) is time:
                stack.callback(setattr, module, "time", time)
                module.time = fake         # type: ignore[attr-defined]
        yield fake


def can_session(script: bytes) -> None:
    """Run a whole driver session with a hostile drive. Raise the first TdhilError after the stop."""
    first: TdhilError | None = None

    def attempt(step: Any, *arguments: Any) -> Any:
        nonlocal first
        try:
            return step(*arguments)
        except TdhilError as error:
            assert str(error).strip() and "\n" not in str(error), repr(str(error))
            first = first or error

    with fake_time() as now:
        bus = ScriptedBus(now)
        ScriptedDrive(bus)
        Script(script, bus)
        begun_s = now.now_s
        drive = drivers.canopen.drive.CanopenDrive(bus, _profile, MonotonicClock(), node=1)
        attempt(drive.connect)
        ready = first is None and attempt(drive.preflight, LIMITS)
        if ready:
            attempt(drive.enable, Mode.SPEED)
            for cycle in range(20):
                if cycle == 12:
                    drive.quick_stop()
                if cycle == 16:
                    drive.disable()
                sample = attempt(drive.exchange, Command(Mode.SPEED, 1.0, 0.0))
                assert sample is None or all(
                    math.isfinite(one) for one in (sample.time_s, sample.speed_rad_s, sample.torque_nm, sample.age_s))
        left = drive.close()
        assert bus.closed
        assert all("\n" not in line for line in left)
        assert now.now_s - begun_s < 600.0, "it took more than ten minutes of fake time"
    if first is not None:
        raise first


# -- Modbus -----------------------------------------------------------------------------------------------------------


class Port:
    """Port with the interface of pyserial's Serial. Its bytes are available at once; then time passes."""

    def __init__(self, said: bytes, clock: "TickingClock") -> None:
        self._said, self._clock = said, clock
        self._asked = False

    @property
    def in_waiting(self) -> int:
        return len(self._said) if self._asked else 0

    def write(self, data: bytes) -> None:
        self._asked = True

    def read(self, count: int) -> bytes:
        part, self._said = (self._said[:count], self._said[count:]) if self._asked else (b"", self._said)
        if not part:
            self._clock.wait_until(self._clock.now_s() + 0.005)
        return part

    def reset_output_buffer(self) -> None:
        pass

    def close(self) -> None:
        pass


class TickingClock:
    """Clock that advances by a microsecond with each reading, so that no loop is endless."""

    stepped = False

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self) -> float:
        self._now_s += 1e-6
        return self._now_s

    def wait_until(self, time_s: float) -> float:
        self._now_s = max(self._now_s, time_s)
        return 0.0


def modbus_requests() -> tuple[bytes, ...]:
    from drivers.modbus import pdu

    return (pdu.read(3, 0, 2), pdu.read(4, 100, 125), pdu.write_one(5, 7),
            pdu.write_many(9, (1, 2, 3)), pdu.read_write(0, 3, 10, (1, 2)))


def modbus_replies(script: bytes) -> None:
    """Send one request over each link, with replies of the script. Raise the last TdhilError."""
    from drivers.modbus import pdu

    known = modbus_requests()
    request = known[script[0] % len(known)] if script else known[0]
    said = script[2:]
    errors: list[TdhilError] = []
    pdu.reply_length(said)
    framed = script[1:2] == b"\1"
    for step in (lambda: pdu.words_of(request, said, "register 0"), lambda: _over_rtu(request, said, framed),
                 lambda: _over_tcp(request, said)):
        try:
            words = step()
            assert all(0 <= word <= 0xFFFF for word in words)
        except TdhilError as error:
            assert str(error).strip() and "\n" not in str(error), repr(str(error))
            errors.append(error)
    if len(errors) == 3:                   # it is no valid reply on any line
        raise errors[-1]


def _over_rtu(request: bytes, said: bytes, framed: bool) -> tuple[int, ...]:
    from drivers.modbus import pdu, rtu

    clock = TickingClock()
    if framed:                             # content of a valid frame
        body = b"\x01" + said[:250]
        said = body + rtu.FramerRTU.compute_CRC(body).to_bytes(2, "big")
    fake = types.ModuleType("serial")
    fake.Serial = lambda *_, **__: Port(said, clock)       # type: ignore[attr-defined]
    former = sys.modules.get("serial")
    sys.modules["serial"] = fake
    try:
        link = rtu.RtuLink("fake", clock)
    finally:
        if former is None:
            del sys.modules["serial"]
        else:
            sys.modules["serial"] = former
    try:
        reply = link.transact(1, request, 0.1)
        return pdu.words_of(request, reply.pdu, "register 0")
    finally:
        link.close()


def _over_tcp(request: bytes, said: bytes) -> tuple[int, ...]:
    from drivers.modbus import pdu, tcp

    ours, theirs = socket.socketpair()

    class Link(tcp.TcpLink):
        def _connect(self) -> socket.socket:
            return ours

    with theirs:
        link = Link("fake", 502, TickingClock())
        theirs.sendall(said)
        theirs.shutdown(socket.SHUT_WR)
        try:
            reply = link.transact(1, request, 0.1)
            return pdu.words_of(request, reply.pdu, "register 0")
        finally:
            link.close()
