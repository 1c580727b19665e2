"""Fake of the part of pysoem that `drivers.ethercat` uses: one slave controller with CoE, in this thread.

Registers, mailbox and process image are typed by hand from ETG.1000.4 and ETG.1000.6. The drive inside is that
of `memory_bench`. In stepped time each frame with setpoints advances the shaft by 5FFEh:3.
"""

import struct

from profiles import MARKER_INDEX
from tests.drivers.memory_bench import LSB_NM, LSB_RAD_S, MemoryDrive
from tests.rigs import QUIET_RIG

OUT, IN, SIZE = 0x1000, 0x1100, 128
ABORT_NO_OBJECT = 0x06020000


class WkcError(Exception):
    """pysoem's error for a wrong working counter."""


class FakeSlave:
    """One slave of a `FakeMaster`.

    ``latency``: number of datagrams after which the firmware reads AL control. A write before is ignored and kept in
    ``ignored``, as by the ESC of Beckhoff (register 0120h behaves like a mailbox).
    """

    def __init__(self, params=QUIET_RIG, seed=0, *, clocks=False, alias=0, latency=0):
        self.drive = MemoryDrive(params, seed)
        application = self.drive.application
        self.name, self.man, self.id, self.rev = "fake", 1, 2, 3
        self.memory = bytearray(0x2000)
        self.number(0x0004, 8, 1)
        self.number(0x0008, 0x04 if clocks else 0)
        self.number(0x0012, alias)
        self.number(0x0400, 2498)
        self.number(0x0420, 1000)
        self.number(0x0130, 2)
        for manager, (start, size, control) in enumerate(((OUT, SIZE, 0x26), (IN, SIZE, 0x22), (0x1200, 0, 0x64),
                                                          (0x1300, 0, 0x20))):
            struct.pack_into("<HHBBBB", self.memory, 0x0800 + 8 * manager, start, size, control, 0, 1, 0)
        self.drive.data |= {(0x60C2, 1): b"\x01", (0x60C2, 2): b"\xfd", (MARKER_INDEX, 2): b"\0",
                            (MARKER_INDEX, 3): bytes(4), (0x1008, 0): b"objects behind a mailbox"}
        self.objects(0x1C12, 2, [0x1601])
        self.objects(0x1C13, 2, [0x1A01])
        for index, entries in ((0x1600, []), (0x1601, [0x60400010]), (0x1A00, []), (0x1A01, [0x60410010])):
            self.objects(index, 4, entries)
        self.application, self.output, self.input = application, b"", b""
        self.answers, self.heard, self.silent_s = [], [], 0.0
        self.lost, self.dead, self.mute, self.sync0 = 0, False, False, []
        self.segments = b""
        self.latency, self.wanted, self.waits, self.ignored = latency, None, 0, []

    def number(self, offset, value=None, size=2):
        if value is not None:
            self.memory[offset : offset + size] = value.to_bytes(size, "little")
        return int.from_bytes(self.memory[offset : offset + size], "little")

    def objects(self, index, size, entries):
        self.drive.data[index, 0] = bytes((len(entries),))
        for sub in range(1, 9):
            self.drive.data[index, sub] = (entries[sub - 1] if sub <= len(entries) else 0).to_bytes(size, "little")

    @property
    def state(self):
        return self.number(0x0130)

    def fall(self, state, code):
        """Leave the AL state by an error."""
        self.number(0x0130, state | 0x10)
        self.number(0x0134, code)
        if state != 8:
            self.application.abort_connection()

    # -- registers -------------------------------------------------------------------------------------------

    def _fprd(self, address, size, timeout_us=2000):
        if self.dead:
            raise WkcError
        self.firmware()
        self.memory[0x080D] = 8 if self.answers and not self.mute else 0
        if address == 0x1300:
            self.input = self.reported()
            self.memory[0x1300 : 0x1300 + size] = self.input
        if address == IN:
            if not self.answers:
                raise WkcError
            message = self.answers.pop(0)
            self.heard.append((1, message))
            return message.ljust(size, b"\0")
        return bytes(self.memory[address : address + size])

    def _fpwr(self, address, data, timeout_us=2000):
        if self.dead:
            raise WkcError
        self.firmware()
        self.memory[address : address + len(data)] = data
        if address == OUT:
            length, _, kind = struct.unpack_from("<HxxxB", data)[0], None, data[5]
            message = bytes(data[: 6 + length])
            self.heard.append((0, message))
            assert (kind, message[7] >> 4, len(data)) == (3, 2, SIZE)
            self.answer(message[8:])
        if address == 0x0120 and self.wanted is not None:
            self.ignored.append(data[0])
        elif address == 0x0120:
            self.wanted, self.waits = data[0], self.latency
            if not self.latency:
                self.firmware()

    def firmware(self):
        """Let the firmware handle AL control when it is due, and count a datagram otherwise."""
        wanted = self.wanted
        if wanted is None or self.waits:
            self.waits -= wanted is not None
            return
        self.wanted = None
        if wanted & 0x10:
            self.number(0x0130, self.state & 0xF)
            self.number(0x0134, 0)
        elif self.state & 0x10 == 0:
            self.number(0x0130, wanted & 0xF)

    # -- CoE -------------------------------------------------------------------------------------------------

    def answer(self, sdo):
        key = (struct.unpack_from("<H", sdo, 1)[0], sdo[3])
        place = bytes(sdo[1:4])
        try:
            if sdo[0] == 0x40:
                data = self.drive.read(key)
                if len(data) <= 4:
                    self.say(bytes((0x43 | 4 - len(data) << 2,)) + place + data.ljust(4, b"\0"))
                else:                  # in segments of seven bytes at most
                    self.segments = data
                    self.say(b"\x41" + place + len(data).to_bytes(4, "little"))
            elif sdo[0] & 0xE0 == 0x60:
                part, self.segments = self.segments[:7], self.segments[7:]
                last = not self.segments
                self.say(bytes((sdo[0] & 0x10 | 7 - len(part) << 1 | last,)) + part.ljust(7, b"\0"))
            else:
                data = sdo[4 : 8 - (sdo[0] >> 2 & 3)] if sdo[0] & 2 else sdo[8:]
                self.drive.write(key, bytes(data))
                self.say(b"\x60" + place + bytes(4))
        except KeyError:
            self.say(b"\x80" + place + ABORT_NO_OBJECT.to_bytes(4, "little"))

    def say(self, sdo, service=3):
        self.answers.append(struct.pack("<HHBBH", len(sdo) + 2, 0, 0, 3, service << 12) + sdo)

    def emergency(self, code):
        self.say(struct.pack("<HB5x", code, 1), service=1)

    # -- process data ----------------------------------------------------------------------------------------

    def mapped(self, assign):
        found = []
        for number in range(1, 1 + self.drive.data[assign, 0][0]):
            pdo = int.from_bytes(self.drive.data[assign, number], "little")
            found += [self.drive.data[pdo, sub] for sub in range(1, 1 + self.drive.data[pdo, 0][0])]
        return [(one[3] << 8 | one[2], one[1], one[0] // 8) for one in found]

    def length(self, assign):
        return sum(size for _, _, size in self.mapped(assign))

    def reported(self):
        return b"".join(self.drive.read((index, sub))[:size] if index else bytes(size)
                        for index, sub, size in self.mapped(0x1C13))

    def act(self, data):
        at, found = 0, {}
        for index, sub, size in self.mapped(0x1C12):
            found[index, sub] = data[at : at + size]
            at += size
        for key in sorted(found, key=lambda key: key == (0x6040, 0)):
            if key[0]:                 # no gap
                self.drive.write(key, found[key])

    def advance(self, period_s):
        self.application.regulate()
        count, dt_s = self.application.inverter.steps(period_s)
        for _ in range(count):
            self.application.step(dt_s)


class FakeMaster:
    """pysoem's master with these slaves."""

    def __init__(self, *slaves):
        self.present = slaves
        self.slaves, self.manual_state_change, self.closed = [], 0, False
        self.dc_time, self.expected_wkc, self.sent = 0, 0, None
        self.counter = None            # reaction to a wrong working counter
        self.starts, self.misread = 0, []
        """Number of starts, and the sizes that SOEM reads in the next mappings because a frame is lost."""
        self.on_restart = self.after_map = lambda slave: None

    def open(self, ifname):
        self.interface = ifname

    def config_init(self, usetable=False):
        self.slaves = list(self.present)
        self.starts += 1
        for slave in self.slaves:
            slave.number(0x0130, 2)
            slave.memory[0x0600:0x0680] = bytes(0x80)
            slave.output = slave.input = b""
            slave.fmmus = 0
            if self.starts > 1:
                self.on_restart(slave)
        return len(self.slaves)

    def config_map(self):
        """Map as SOEM does: without a start before, the FMMUs of a former mapping stay active."""
        at = 0
        for slave in self.slaves:
            sizes = self.misread.pop(0) if self.misread else (slave.length(0x1C12), slave.length(0x1C13))
            slave.output, slave.input = map(bytes, sizes)
            for manager, size in ((2, sizes[0]), (3, sizes[1])):
                slave.number(0x0802 + 8 * manager, size)
                start = slave.number(0x0800 + 8 * manager)
                if size:
                    struct.pack_into("<IHBBHBBB", slave.memory, 0x0600 + 16 * slave.fmmus, at, size, 0, 7, start, 0,
                                     4 - manager, 1)
                    at, slave.fmmus = at + size, slave.fmmus + 1
            self.after_map(slave)
        self.expected_wkc = 3 * len(self.slaves)
        return 64

    def config_dc(self):
        return True

    def send_processdata(self):
        self.sent = True
        for slave in self.slaves:
            if slave.output:
                slave.heard.append((2, bytes(slave.output)))
        return 1

    def receive_processdata(self, timeout=2000):
        sent, self.sent = self.sent, None
        assert sent
        counter = 0
        for slave in self.slaves:
            if slave.dead:
                continue
            if slave.lost:
                slave.lost -= 1
                continue
            found = slave.reported()
            counter += 1
            if slave.state & 0xF == 8:
                counter += 2
                slave.act(slave.output)
                slave.silent_s = 0.0
            elif slave.state & 0xF == 4:
                counter += 2
            period_s = int.from_bytes(slave.drive.data[MARKER_INDEX, 3], "little") * 1e-6
            if period_s and slave.state & 0xF in (4, 8):
                slave.advance(period_s)
            slave.input = found
            slave.heard.append((3, found))
        return counter if self.counter is None else self.counter

    def close(self):
        self.closed = True


__all__ = ["LSB_NM", "LSB_RAD_S", "FakeMaster", "FakeSlave", "WkcError"]
