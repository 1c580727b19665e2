"""EtherCAT master by hand over the pure function of the simulated drive: struct only, no code of either side."""

import struct

from profiles.ethercat import EthercatProfile
from sim_bus.ethercat import Simulator
from sim_bus.params import RigParams
from tests.rigs import QUIET_RIG

APRD, APWR, APRW, FPRD, FPWR, FPRW, BRD, BWR, BRW, LRD, LWR, LRW, ARMW, FRMW = range(1, 15)
STATION = 0x1001
INIT, PREOP, SAFEOP, OP = 1, 2, 4, 8


class SdoAbort(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08X}")
        self.code = code


def datagram(command: int, address: tuple[int, int] | int, data: bytes, more: bool = False) -> bytes:
    where = struct.pack("<I", address) if isinstance(address, int) else struct.pack("<HH", *address)
    return bytes((command, 7)) + where + struct.pack("<HH", len(data) | more << 15, 0) + data + b"\0\0"


def frame(*datagrams: bytes) -> bytes:
    body = b"".join(datagrams)
    return (b"\xff" * 6 + b"\x01" * 6 + b"\x88\xa4" + struct.pack("<H", len(body) | 0x1000) + body).ljust(60, b"\0")


class Host:
    """Host with the clock ``now_s``; a frame takes no time."""

    def __init__(self, *faults: str, stepped: bool = True, rig: RigParams = QUIET_RIG, alias: int = 0,
                 profile: EthercatProfile | None = None) -> None:
        from sim_bus.ethercat import parse_all

        self.simulator = Simulator(rig, stepped=stepped, faults=parse_all(faults), alias=alias, profile=profile)
        self.slave = self.simulator.slave
        self.now_s = 1.0
        self.counter = 0

    def ask(self, command: int, address: tuple[int, int] | int, data: bytes) -> tuple[bytes, int]:
        """Return data and working counter of the reply to one datagram; None, 0 for a lost frame."""
        answer = self.simulator.answer(frame(datagram(command, address, data)), self.now_s)
        if not answer:
            return b"", 0
        return answer[26:26 + len(data)], int.from_bytes(answer[26 + len(data):28 + len(data)], "little")

    def read(self, register: int, size: int = 2) -> int:
        data, counter = self.ask(FPRD, (STATION, register), bytes(size))
        assert counter == 1
        return int.from_bytes(data, "little")

    def write(self, register: int, value: int, size: int = 2) -> int:
        return self.ask(FPWR, (STATION, register), value.to_bytes(size, "little"))[1]

    def sii(self, word: int) -> int:
        self.ask(FPWR, (STATION, 0x0502), struct.pack("<HI", 0x0100, word))
        assert not self.read(0x0502) & 0x8000
        return self.read(0x0508, 4)

    # -- states

    def state(self, wanted: int) -> tuple[int, int]:
        """Return AL status and code after a request."""
        self.write(0x0120, wanted)
        return self.read(0x0130), self.read(0x0134)

    def preop(self) -> "Host":
        assert self.ask(APWR, (0, 0x0010), struct.pack("<H", STATION))[1] == 1
        for number, control in enumerate((0x26, 0x22)):
            self.ask(FPWR, (STATION, 0x0800 + 8 * number), struct.pack("<HHBBBB", 0x1000 + 128 * number, 128, control,
                                                                      0, 1, 0))
        assert self.state(PREOP) == (PREOP, 0)
        return self

    def map(self, outputs: tuple[int, ...], inputs: tuple[int, ...]) -> "Host":
        for assign, pdo, entries in ((0x1C12, 0x1600, outputs), (0x1C13, 0x1A00, inputs)):
            self.download(assign, 0, 0, 1)
            self.download(pdo, 0, 0, 1)
            for number, entry in enumerate(entries, 1):
                self.download(pdo, number, entry, 4)
            self.download(pdo, 0, len(entries), 1)
            self.download(assign, 1, pdo, 2)
            self.download(assign, 0, 1, 1)
        return self

    def safeop(self, outputs: int = 10, inputs: int = 14) -> "Host":
        """Enter SAFEOP. Outputs and inputs share the logical addresses from 0, as with one LRW."""
        for number, (start, size, control) in enumerate(((0x1200, outputs, 0x64), (0x1400, inputs, 0x20)), 2):
            self.ask(FPWR, (STATION, 0x0800 + 8 * number), struct.pack("<HHBBBB", start, size, control, 0, 1, 0))
        for number, (start, size, kind) in enumerate(((0x1200, outputs, 2), (0x1400, inputs, 1))):
            unit = struct.pack("<IHBBHBBB3x", 0, size, 0, 7, start, 0, kind, 1)
            self.ask(FPWR, (STATION, 0x0600 + 16 * number), unit)
        self.size, self.outputs = max(outputs, inputs), outputs
        assert self.state(SAFEOP) == (SAFEOP, 0)
        return self

    def op(self) -> "Host":
        self.write(0x0120, OP)
        self.cycle(bytes(self.outputs))
        assert self.read(0x0130) == OP
        return self

    def cycle(self, outputs: bytes) -> tuple[bytes, int]:
        return self.ask(LRW, 0, outputs.ljust(self.size, b"\0"))

    # -- SDO

    def mailbox(self, content: bytes) -> bytes:
        self.counter = self.counter % 7 + 1
        head = struct.pack("<HHBB", len(content), 0, 0, 3 | self.counter << 4)
        assert self.ask(FPWR, (STATION, 0x1000), (head + content).ljust(128, b"\0"))[1] == 1
        return self.answer()

    def answer(self) -> bytes:
        while True:
            data, counter = self.ask(FPRD, (STATION, 0x1080), bytes(128))
            if not counter:
                return b""
            if data[7] >> 4 != 1:        # no emergency
                return data[6:6 + int.from_bytes(data[:2], "little")]

    def sdo(self, request: bytes) -> bytes:
        answer = self.mailbox(b"\x00\x20" + request)
        assert answer, "no answer"
        if answer[2] == 0x80:
            raise SdoAbort(int.from_bytes(answer[6:10], "little"))
        return answer[2:]

    def upload(self, index: int, sub: int = 0) -> bytes:
        answer = self.sdo(struct.pack("<BHB4x", 0x40, index, sub))
        if answer[0] & 2:
            return answer[4:8 - (answer[0] >> 2 & 3)]
        size, data, toggle = int.from_bytes(answer[4:8], "little"), answer[8:], 0
        while len(data) < size:
            answer = self.sdo(bytes((0x60 | toggle,)) + bytes(7))
            assert answer[0] & 0xF0 == toggle
            data += answer[1:len(answer) - (answer[0] >> 1 & 7)]
            assert bool(answer[0] & 1) is (len(data) == size)
            toggle ^= 0x10
        return data

    def number(self, index: int, sub: int = 0) -> int:
        return int.from_bytes(self.upload(index, sub), "little", signed=True)

    def download(self, index: int, sub: int, value: int, size: int) -> None:
        data = (value & (1 << 8 * size) - 1).to_bytes(4, "little")
        assert self.sdo(struct.pack("<BHB", 0x23 | 4 - size << 2, index, sub) + data)[0] == 0x60

    def download_text(self, index: int, sub: int, text: bytes) -> None:
        first, rest, toggle = text[:110], text[110:], 0
        self.sdo(struct.pack("<BHBI", 0x21, index, sub, len(text)) + first)
        while rest:
            now, rest = rest[:119], rest[119:]
            fill = max(0, 7 - len(now))
            answer = self.sdo(bytes((toggle | fill << 1 | (not rest),)) + now + bytes(fill))
            assert answer[0] == 0x20 | toggle
            toggle ^= 0x10

    def refused(self, index: int, sub: int, value: int, size: int) -> int:
        try:
            self.download(index, sub, value, size)
        except SdoAbort as error:
            return error.code
        return 0


def running(*faults: str, period_us: int = 4000, stepped: bool = True, rig: RigParams = QUIET_RIG) -> Host:
    """Return a host with drive in OPERATIONAL; outputs 6040 6060 gap 6071 60FF, inputs 6041 6061 gap 6077 606C 6064."""
    host = Host(*faults, stepped=stepped, rig=rig).preop()
    host.download(0x5FFE, 3, period_us, 4)
    return host.safeop().op()


def outputs(word: int, mode: int, torque: int = 0, speed: int = 0) -> bytes:
    return struct.pack("<HbxhI", word, mode, torque, speed & 0xFFFFFFFF)


def inputs(data: bytes) -> tuple[int, int, int, int, int]:
    """Return statusword, mode, torque in ‰, speed in 0.1 rpm, and position."""
    return struct.unpack_from("<HbxhiI", data)


def enabled(host: Host, mode: int) -> Host:
    for word in (0x06, 0x07, 0x0F, 0x0F):
        data, counter = host.cycle(outputs(word, mode))
    assert counter == 3
    assert inputs(data)[0] & 0x6F == 0x27
    return host
