"""Modbus host by hand: PDUs by struct only, without code of the room `drivers`."""

import struct
from collections.abc import Sequence

from profiles.library import load_modbus_profile
from profiles.modbus import ModbusProfile
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.modbus.wrong_maps import parse
from sim_bus.params import RigParams
from tests.rigs import QUIET_RIG

GENERIC = load_modbus_profile("generic/modbus")


class Refusal(Exception):
    """Exception reply."""

    def __init__(self, code: int) -> None:
        super().__init__(str(code))
        self.code = code


class Host:
    """Host of unit 1 that sends each request after the complete reply to the one before."""

    def __init__(self, drive: EmbeddedModbusDrive) -> None:
        self.drive = drive
        self.now_s = 0.0

    def ask(self, pdu: bytes) -> bytes:
        reply, self.now_s = self.drive.serve(1, pdu, self.now_s)
        assert reply is not None
        if reply[0] & 0x80:
            assert len(reply) == 2 and reply[0] == pdu[0] | 0x80
            raise Refusal(reply[1])
        assert reply[0] == pdu[0]
        return reply[1:]

    def read(self, address: int, count: int = 1, function: int = 3) -> tuple[int, ...]:
        data = self.ask(struct.pack(">BHH", function, address, count))
        assert data[0] == 2 * count == len(data) - 1
        return struct.unpack(f">{count}H", data[1:])

    def number(self, address: int, kind: str = "h") -> int:
        """Return one number, high word first."""
        words = self.read(address, struct.calcsize(">" + kind) // 2)
        return int(struct.unpack(">" + kind, struct.pack(f">{len(words)}H", *words))[0])

    def write(self, address: int, words: Sequence[int]) -> None:
        data = struct.pack(f">BHHB{len(words)}H", 16, address, len(words), 2 * len(words), *words)
        assert self.ask(data) == data[1:5]

    def write_one(self, address: int, word: int) -> None:
        pdu = struct.pack(">BHH", 6, address, word)
        assert self.ask(pdu) == pdu[1:]

    def both(self, read: int, count: int, write: int, words: Sequence[int]) -> tuple[int, ...]:
        data = self.ask(struct.pack(f">BHHHHB{len(words)}H", 23, read, count, write, len(words), 2 * len(words),
                                    *words))
        return struct.unpack(f">{count}H", data[1:])

    def refused(self, pdu: bytes) -> int:
        """Return the code of the exception, or 0 if the request is executed."""
        try:
            self.ask(pdu)
        except Refusal as refusal:
            return refusal.code
        return 0

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s
        self.drive.run_until(self.now_s)


class GenericHost(Host):
    """Host with the map of generic/modbus."""

    def command(self, word: int, rpm: float = 0.0, torque: float = 0.0) -> tuple[int, float, float]:
        """Send a command; return (status, speed in rpm, torque as a share of rated)."""
        data = struct.pack(">Hih", word, round(100 * rpm), round(1000 * torque))
        words = self.both(16, 4, 0, struct.unpack(">4H", data))
        status, speed, actual = struct.unpack(">Hih", struct.pack(">4H", *words))
        return status, speed / 100, actual / 1000

    def enable(self, rpm: float = 0.0) -> None:
        for word in (0x06, 0x07, 0x0F):
            self.command(word, rpm)
        assert self.command(0x0F, rpm)[0] & 0x6F == 0x27

    def cycles(self, duration_s: float, word: int = 0x0F, rpm: float = 0.0, torque: float = 0.0,
               ) -> tuple[int, float, float]:
        """Send the same command every 20 ms; return the last reply."""
        until_s = self.now_s + duration_s
        answer = self.command(word, rpm, torque)
        while self.now_s < until_s:
            self.wait(0.02)
            answer = self.command(word, rpm, torque)
        return answer


def drive(profile: ModbusProfile = GENERIC, params: RigParams = QUIET_RIG, wrongs: Sequence[str] = (),
          **options: object) -> EmbeddedModbusDrive:
    """Return a drive, by default without noise and lags."""
    return EmbeddedModbusDrive(params, profile, wrongs=tuple(map(parse, wrongs)), **options)  # type: ignore[arg-type]
