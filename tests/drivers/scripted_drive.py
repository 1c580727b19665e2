"""Scripted drive without a plant: a fake bus in fake time, an SDO server and PDOs typed by hand.

It uses neither the driver's codec nor canopen nor the simulator. A test sets its faults.
"""

import struct
import sys
from collections.abc import Callable

import can

from tests.drivers.power_machine import PowerMachine

MARKER = b"tdhil simulated drive"
SDO_HEAD = struct.Struct("<BHB")
RPDO1, TPDO1, TPDO2 = struct.Struct("<Hhi"), struct.Struct("<Hhi"), struct.Struct("<bh")


class FakeTime:
    """Replacement of the module `time` in the driver's files: it advances by waits only."""

    CLOCK_BOOTTIME, CLOCK_MONOTONIC_RAW = 7, 4

    def __init__(self) -> None:
        self.now_s = 1000.0

    def clock_gettime(self, clock: int) -> float:
        assert clock == (self.CLOCK_MONOTONIC_RAW if sys.platform == "darwin" else self.CLOCK_BOOTTIME)
        return self.now_s

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += max(0.0, duration_s)


class ScriptedBus:
    """Bus with the interface of python-can's BusABC. Frames arrive when they are due; waiting advances the time."""

    channel_info = "scripted bus"

    def __init__(self, time: FakeTime) -> None:
        self.time = time
        self.sent: list[tuple[int, bytes]] = []
        self.inbox: list[tuple[float, can.Message]] = []
        self.on_send: Callable[[int, bytes], None] = lambda identifier, data: None
        self.send_error: BaseException | None = None
        self.receive_error: BaseException | None = None
        self.closed = False

    def put(self, identifier: int, data: bytes, after_s: float = 0.0, **flags: bool) -> None:
        flags.setdefault("is_extended_id", False)
        message = can.Message(arbitration_id=identifier, data=data, **flags)
        self.inbox.append((self.time.now_s + after_s, message))
        self.inbox.sort(key=lambda entry: entry[0])

    def send(self, message: can.Message) -> None:
        if self.send_error is not None:
            raise self.send_error
        self.sent.append((message.arbitration_id, bytes(message.data)))
        self.on_send(message.arbitration_id, bytes(message.data))

    def recv(self, timeout: float = 0.0) -> can.Message | None:
        if self.receive_error is not None:
            raise self.receive_error
        # At least a nanosecond, as a real wait. Less could vanish in the sum, and time would not advance.
        until_s = self.time.now_s + (max(timeout, 1e-9) if timeout > 0.0 else 0.0)
        if self.inbox and self.inbox[0][0] <= until_s:
            due_s, message = self.inbox.pop(0)
            self.time.now_s = max(self.time.now_s, due_s)
            return message
        self.time.now_s = until_s
        return None

    def shutdown(self) -> None:
        self.closed = True

    def of(self, identifier: int) -> list[bytes]:
        """Return all data sent with one identifier."""
        return [data for known, data in self.sent if known == identifier]


def u(value: int, size: int) -> bytes:
    return value.to_bytes(size, "little", signed=value < 0)


class ScriptedDrive:
    """Drive with node number 1. Objects are bytes; `refuse_read`, `refuse_write` map (index, sub) to an abort code."""

    def __init__(self, bus: ScriptedBus, *, marker: bool = True) -> None:
        self.bus = bus
        bus.on_send = self.on_frame
        self.machine = PowerMachine()
        self.objects: dict[tuple[int, int], bytes] = _generic_objects()
        if marker:
            self.objects |= {(0x5FFE, 1): MARKER, (0x5FFE, 2): u(1, 1)}
        self.refuse_read: dict[tuple[int, int], int] = {}
        self.refuse_write: dict[tuple[int, int], int] = {}
        self.deaf_to: set[tuple[int, int]] = set()          # accepted, but not stored
        self.writes: list[tuple[int, int, bytes]] = []
        self.setpoints: list[tuple[int, int, int]] = []     # controlword, torque, speed at each SYNC
        self.operational = False
        self.silent = False
        self.syncs = 0
        self.feedback: Callable[[int], tuple[int, int]] = lambda cycle: (cycle, 1000 * cycle)   # torque, speed
        self.answer_sync: Callable[[int], list[tuple[float, bytes]]] = self.usual_feedback
        self.before_answer: Callable[[bytes], None] = lambda request: None
        self._rest = b""
        self._toggle = 0
        self._latched = (0, 0, 0)

    def value(self, index: int, sub: int = 0) -> int:
        return int.from_bytes(self.objects[index, sub], "little")

    def on_frame(self, identifier: int, data: bytes) -> None:
        if self.silent:
            return
        if identifier == 0x601:
            self._sdo(data)
        elif identifier == 0x000 and data[1] in (0, 1):
            self.operational = data[0] == 1
        elif identifier == 0x201 and self.operational:
            self._latched = RPDO1.unpack(data)
        elif identifier == 0x301 and self.operational:
            self._set_mode(data)
        elif identifier == 0x080 and self.operational:
            self._sync()

    # -- PDOs ----------------------------------------------------------------------------------------------

    def tpdo(self, cycle: int) -> bytes:
        return TPDO1.pack(self.machine.status | 0x1200, *self.feedback(cycle))

    def usual_feedback(self, cycle: int) -> list[tuple[float, bytes]]:
        """Return (delay, data) of each TPDO1 that follows this SYNC."""
        return [(0.0002, self.tpdo(cycle))]

    def _sync(self) -> None:
        self.syncs += 1
        self.setpoints.append(self._latched)
        self.machine.step()
        self.machine.obey(self._latched[0])
        for delay_s, data in self.answer_sync(self.syncs):
            self.bus.put(0x181, data, delay_s)
        if self.syncs % 5 == 0:
            self.bus.put(0x281, TPDO2.pack(self.value(0x6061), 7), 0.0003)

    def _set_mode(self, data: bytes) -> None:
        self.objects[0x6060, 0] = data
        if (0x6061, 0) not in self.deaf_to:
            self.objects[0x6061, 0] = data

    # -- SDO server (CiA 301, expedited both ways, segmented upload) -----------------------------------------

    def _sdo(self, request: bytes) -> None:
        self.before_answer(request)
        answer = self._answer(request)
        if answer is not None:
            self.bus.put(0x581, answer.ljust(8, b"\0"), 0.0005)

    def _answer(self, request: bytes) -> bytes | None:
        command, index, sub = SDO_HEAD.unpack_from(request)
        key = (index, sub)
        if command & 0xE0 == 0x40:
            if key not in self.objects or key in self.refuse_read:
                return _abort(key, self.refuse_read.get(key, 0x06020000))
            data = self.machine.status.to_bytes(2, "little") if key == (0x6041, 0) else self.objects[key]
            if len(data) <= 4:
                return SDO_HEAD.pack(0x43 | (4 - len(data)) << 2, *key) + data
            self._rest, self._toggle = data, 0
            return SDO_HEAD.pack(0x41, *key) + u(len(data), 4)
        if command & 0xE0 == 0x60:
            part, self._rest = self._rest[:7], self._rest[7:]
            head = self._toggle | (7 - len(part)) << 1 | (not self._rest)
            self._toggle ^= 0x10
            return bytes([head]) + part
        if command & 0xE3 == 0x23:
            return self._download(key, request[4 : 8 - (command >> 2 & 3)])
        return None

    def _download(self, key: tuple[int, int], data: bytes) -> bytes:
        self.writes.append((*key, data))
        if key not in self.objects or key in self.refuse_write:
            return _abort(key, self.refuse_write.get(key, 0x06020000))
        if len(data) != len(self.objects[key]):
            return _abort(key, 0x06070010)
        if key not in self.deaf_to:
            self.objects[key] = data
            if key == (0x6060, 0) and (0x6061, 0) not in self.deaf_to:
                self.objects[0x6061, 0] = data
            if key == (0x6040, 0):
                self.machine.obey(int.from_bytes(data, "little"))
        return SDO_HEAD.pack(0x60, *key)


def _abort(key: tuple[int, int], code: int) -> bytes:
    return SDO_HEAD.pack(0x80, *key) + u(code, 4)


def _generic_objects() -> dict[tuple[int, int], bytes]:
    objects = {
        (0x1000, 0): u(0x00020192, 4), (0x1006, 0): u(0, 4), (0x1008, 0): b"scripted",
        (0x1016, 1): u(0, 4), (0x1017, 0): u(0, 2),
        (0x1018, 1): u(0x11, 4), (0x1018, 2): u(0x22, 4), (0x1018, 3): u(0x33, 4), (0x1018, 4): u(0x44, 4),
        (0x6007, 0): u(1, 2), (0x603F, 0): u(0x7305, 2), (0x6040, 0): u(0, 2), (0x6041, 0): u(0, 2),
        (0x605A, 0): u(2, 2), (0x6060, 0): u(3, 1), (0x6061, 0): u(3, 1), (0x6071, 0): u(5, 2), (0x6072, 0): u(900, 2),
        (0x6074, 0): u(0, 2), (0x6076, 0): u(1_000_000, 4), (0x6080, 0): u(100, 4), (0x6085, 0): u(50, 4),
        (0x60FF, 0): u(5, 4), (0x6502, 0): u(1 << 2 | 1 << 3 | 1 << 8 | 1 << 9, 4), (0x605E, 0): u(2, 2),
        (0x60C2, 1): u(1, 1), (0x60C2, 2): u(-3, 1),
    }
    for number in range(2):
        for communication, mapping in ((0x1400, 0x1600), (0x1800, 0x1A00)):
            identifier = 0x80000001 | (0x200 if communication == 0x1400 else 0x180) + 0x100 * number
            objects[communication + number, 1] = u(identifier, 4)
            objects[communication + number, 2] = u(255, 1)
            objects[mapping + number, 0] = u(1, 1)
            objects |= {(mapping + number, sub): u(0x60400010 if sub == 1 else 0, 4) for sub in range(1, 9)}
    return objects


