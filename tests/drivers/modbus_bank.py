"""Modbus drive for tests: a bank of registers with the map of generic/modbus, typed by hand, without a plant.

It uses neither codec. A test sets its faults.
"""

import struct

from tests.drivers.power_machine import PowerMachine

MARKER, MARKER_BLOCK = b"tdhil simulated drive", 0xFDE8
CONTROL, SPEED_SETPOINT, TORQUE_SETPOINT, MODE = 0, 1, 3, 4
STATUS, SPEED, TORQUE, MODE_SHOWN = 16, 17, 19, 20
TIME_OUT = 40


def high_and_low(number):
    return [number >> 16 & 0xFFFF, number & 0xFFFF]


class Bank:
    """Unit 1. An `EmbeddedLink` calls ``serve``; each transaction takes ``takes_s``.

    ``refuse`` maps a function to an exception code, ``refuse_at`` an address. Writes to the addresses ``deaf_to``
    are acknowledged and ignored. ``script`` replaces the next replies; None is no reply.
    """

    def __init__(self, *, marker=True, takes_s=0.0):
        self.takes_s = takes_s
        self.machine = PowerMachine()
        self.words = dict.fromkeys(range(60), 0)
        for address, number in ((32, 80_000), (42, 0x12345678)):
            self.words[address], self.words[address + 1] = high_and_low(number)
        # 16.76 kW at 200 rpm and 800 N·m; limits; reaction 3; -12345; lags of 40 and 15 ms
        self.words |= {34: 1676, 35: 2000, 36: 3000, 37: 0x10000 - 3000, 38: 2000, 39: 30, 41: 3, 44: 0x10000 - 12345,
                       45: 40, 46: 15}
        if marker:
            text = MARKER.ljust(24, b"\0")
            self.words |= {MARKER_BLOCK + k: word for k, word in enumerate(struct.unpack(">12H", text))}
            self.words[MARKER_BLOCK + 12] = 1
        self.refuse, self.refuse_at, self.deaf_to = {}, {}, set()
        self.script = []
        self.silent = False
        self.requests = []
        self.writes = []                # (address, words)
        self.feedback = lambda: (0, 0)  # speed in 0.01 rpm, torque in per mille
        self.on_write = lambda address, words: None
        self.on_show = lambda words: None
        self.remote = True

    def serve(self, unit, pdu, now_s):
        self.requests.append(pdu)
        reply = None if self.silent or unit != 1 else self.answer(pdu)
        if self.script and reply is not None:
            reply = self.script.pop(0)(reply)
        return reply, now_s + self.takes_s

    def answer(self, pdu):
        function = pdu[0]
        if function in self.refuse:
            return bytes((function | 0x80, self.refuse[function]))
        address, count = struct.unpack(">HH", pdu[1:5])
        if function == 6:
            return self._write(function, address, [count]) or pdu
        if function == 16:
            return self._write(function, address, struct.unpack(f">{count}H", pdu[6:])) or pdu[:5]
        if function == 23:
            to, amount = struct.unpack(">HH", pdu[5:9])
            refused = self._write(function, to, struct.unpack(f">{amount}H", pdu[10:]))
            if refused:
                return refused
        elif function != 3:
            return bytes((function | 0x80, 1))
        self.machine.step()
        self.show()
        wanted = range(address, address + count)
        code = next((self.refuse_at[one] for one in wanted if one in self.refuse_at), None)
        if code is None and any(one not in self.words for one in wanted):
            code = 2
        if code is not None:
            return bytes((function | 0x80, code))
        return struct.pack(f">BB{count}H", function, 2 * count, *(self.words[one] for one in wanted))

    def _write(self, function, address, words):
        self.writes.append((address, list(words)))
        for at, word in enumerate(words, address):
            if at in self.refuse_at:
                return bytes((function | 0x80, self.refuse_at[at]))
            if at not in self.words or STATUS <= at <= MODE_SHOWN:
                return bytes((function | 0x80, 2))
            if at not in self.deaf_to:
                self.words[at] = word
        if address == CONTROL and CONTROL not in self.deaf_to:
            self.machine.obey(self.words[CONTROL])
        self.on_write(address, words)
        return None

    def show(self):
        """Show status, feedback, mode and the echoes of both setpoints, from the present values of the bank."""
        words = self.words
        speed, torque = self.feedback()
        words[STATUS] = self.machine.status & ~0x0A00 | (0x0200 if self.remote else 0)
        words[SPEED], words[SPEED + 1] = high_and_low(speed)
        words[TORQUE] = torque & 0xFFFF
        words[MODE_SHOWN] = words[MODE]
        wanted_speed = struct.unpack(">i", struct.pack(">HH", words[1], words[2]))[0]
        wanted_torque = struct.unpack(">h", struct.pack(">H", words[3]))[0]
        words[48], words[49] = high_and_low(wanted_speed * 10)              # 0.001 rpm
        self.on_show(words)
        words[50], words[51] = high_and_low(wanted_torque * 80)             # 0.01 N·m of 800
