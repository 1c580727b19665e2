"""Host by hand: raw frames and struct only, without code of the room `drivers`."""

import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import can
import pytest

from sim_bus.canopen.simulator import EmbeddedSimulator
from sim_bus.params import RigParams
from tests.rigs import QUIET_RIG

SIZES = {1: ("B", 0x2F), 2: ("H", 0x2B), 4: ("I", 0x23)}


class SdoAbort(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08X}")
        self.code = code


class Host:
    """Host of node 1; frames other than the awaited reply are kept in ``heard``."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus
        self.heard: list[tuple[int, bytes]] = []

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def wait(self, can_id: int, timeout_s: float = 60.0) -> bytes:
        while True:
            message = self.bus.recv(timeout_s)
            assert message is not None, f"no frame {can_id:03X}"
            if message.arbitration_id == can_id:
                return bytes(message.data)
            self.heard.append((message.arbitration_id, bytes(message.data)))

    def write(self, index: int, sub: int, value: int, size: int) -> None:
        _, command = SIZES[size]
        data = (value & (1 << 8 * size) - 1).to_bytes(4, "little")
        self.send(0x601, struct.pack("<BHB", command, index, sub) + data)
        answer = self.wait(0x581)
        if answer[0] == 0x80:
            raise SdoAbort(struct.unpack_from("<I", answer, 4)[0])
        assert answer[0] == 0x60

    def read(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        self.send(0x601, struct.pack("<BHB4x", 0x40, index, sub))
        answer = self.wait(0x581)
        if answer[0] == 0x80:
            raise SdoAbort(struct.unpack_from("<I", answer, 4)[0])
        assert answer[0] & 0xE2 == 0x42
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little", signed=signed)

    def refused(self, index: int, sub: int, value: int, size: int) -> int:
        """Return the abort code, or 0 if it is accepted."""
        try:
            self.write(index, sub, value, size)
        except SdoAbort as abort:
            return abort.code
        return 0

    def nmt(self, command: int, node: int = 1) -> None:
        self.send(0x000, bytes([command, node]))

    def emcy(self) -> list[int]:
        """Return the error codes of the EMCYs so far, after all frames on the way have arrived."""
        self.read(0x1000)
        return [struct.unpack_from("<H", data)[0] for can_id, data in self.heard if can_id == 0x081]

    def remap(self, transmission: int = 1) -> None:
        """Map RPDO1: 6040 6071 60FF, TPDO1: 6041 6077 606C."""
        for communication, mapping, cob, entries in (
            (0x1400, 0x1600, 0x201, (0x60400010, 0x60710010, 0x60FF0020)),
            (0x1800, 0x1A00, 0x40000181, (0x60410010, 0x60770010, 0x606C0020)),
        ):
            self.write(communication, 1, cob | 1 << 31, 4)
            self.write(mapping, 0, 0, 1)
            for number, entry in enumerate(entries, 1):
                self.write(mapping, number, entry, 4)
            self.write(mapping, 0, len(entries), 1)
            self.write(communication, 2, transmission, 1)
            self.write(communication, 1, cob, 4)

    def set_up(self, mode: int = 9, period_us: int = 10_000) -> None:
        self.remap()
        self.write(0x1006, 0, period_us, 4)
        self.write(0x6060, 0, mode, 1)
        self.nmt(1)

    def cycle(self, controlword: int = 0x0F, torque: int = 0, velocity: int = 0,
              times: int = 1) -> tuple[int, int, int]:
        """Run RPDO, SYNC and TPDO; return (statusword, torque ‰, velocity 0.1 rpm) of the last cycle."""
        answer = b""
        for _ in range(times):
            self.send(0x201, struct.pack("<Hhi", controlword, torque, velocity))
            self.send(0x080)
            answer = self.wait(0x181)
        status, actual, speed = struct.unpack("<Hhi", answer)
        return status, actual, speed

    def enable(self, torque: int = 0, velocity: int = 0) -> None:
        for word in (0x06, 0x07, 0x0F):
            self.cycle(word, torque, velocity)
        assert self.cycle(0x0F, torque, velocity)[0] & 0x6F == 0x27


Bench = tuple[EmbeddedSimulator, Host]


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    """Open an embedded simulator (by default without noise and lags) and a host on its channel."""
    with ExitStack() as stack:

        def open_bench(params: RigParams = QUIET_RIG, **options: object) -> Bench:
            simulated = EmbeddedSimulator(params, **options)  # type: ignore[arg-type]
            bus = stack.enter_context(can.Bus(interface="virtual", channel=simulated.channel))
            stack.enter_context(simulated)
            host = Host(bus)
            assert host.wait(0x701) == b"\0"      # boot-up
            return simulated, host

        yield open_bench
