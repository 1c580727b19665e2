"""Delta MS300, C2000 (communication address list in the user manual's appendix).

Command 2000h: bits 1..0 are 01 stop, 10 run, 00 nothing (11 jog is not simulated); bits 5..4 are 01 forwards, 10
backwards, 11 change. 2002h: bit 0 external fault, bit 1 reset, rising.

Status, by register: 2101h bits 1..0 00 stopped, 01 slowing down, 10 standing by, 11 running; 4..3 direction, 00
forwards and 11 backwards; 8 frequency and 10 operation come from the bus. It has no fault bit: 2100h has the code (58 =
CE10, the time-out; else 49, external fault). 2226h bits 1..0 01 forwards, 10 backwards; 3..2 01 ready, 10 fault; 4
output on; 5 alarm. The stop is the ramp stop. A quick stop is the same, at the rate of the quick-stop parameter.
"""

from sim_bus.cia402 import State
from sim_bus.modbus.control_words.base import Extra, StartStop

_EXTERNAL_FAULT = 49
_COMMUNICATION = 58


class DeltaWords(StartStop):
    """Run and stop by code."""

    _second = 0

    def obey(self, before: int, word: int) -> None:
        if self.wiring.torque_bits:
            self.select(word)
        direction = word >> 4 & 3
        if direction:
            self.reversed = {1: False, 2: True, 3: not self.reversed}[direction]
        if word & 3 == 2:
            self.run()
        elif word & 3 == 1:
            self.application.settings.decel_rad_s2 = self.application.settings.quick_stop_rad_s2
            self.ramp_stop()

    def extras(self) -> dict[int, Extra]:
        def second(word: int) -> None:
            before, self._second = self._second, word
            if word & 1:
                self.application.fault()
            elif word & ~before & 2:
                self.reset()

        return {0x2002: Extra(lambda: self._second, second), 0x2100: Extra(self._code)}

    def _code(self) -> int:
        if not self.faulted:
            return 0
        return _COMMUNICATION if self.application.warning else _EXTERNAL_FAULT

    def status(self) -> int:
        energised = self.state in {State.ENABLED, State.QUICK_STOP}
        address = self.wiring.status_address
        if address == 0x2100:
            return self._code()
        if address == 0x2226:
            return (2 if self.backwards else 1) | (8 if self.faulted else 4) | energised << 4 \
                | self.application.warning << 5
        if self.follows:
            run = 3
        elif energised:
            run = 1
        else:
            run = 2 if self.state in {State.READY, State.SWITCHED_ON} else 0
        return run | (0x18 if self.backwards else 0) | 0x0500
