"""Yaskawa A1000, GA700 (MEMOBUS data table, appendix C.9 of the A1000 technical manual).

Operation command 0001h::

    0 run forwards, or run · 1 run backwards, or backwards (H5-12 = 0, or 1)
    2 external fault · 3 fault reset, rising · 4 and up multi-function inputs

Without bit 0 or 1 the drive stops down its ramp. A fast stop over the bus is a multi-function input that the user has
assigned. So any quick stop here is the ramp stop, at the rate of the quick-stop parameter.

Status, by register: 002Ch 0 run · 1 zero speed · 2 speed agree · 6 ready · 14 fault · 15 communication time-out, from
the available sources. From memory, to be checked in the manual: 0020h 0 run · 1 backwards · 2 ready · 3 fault; 004Bh
(U1-12) 0 run · 1 zero speed · 2 backwards · 4 speed agree · 5 ready · 6 alarm · 7 fault.
"""

from sim_bus.cia402 import State
from sim_bus.modbus.control_words.base import StartStop


class YaskawaWords(StartStop):
    """Run and stop by level, direction by bit."""

    def obey(self, before: int, word: int) -> None:
        self.select(word)
        self.reversed = bool(word & 2)
        if word & ~before & 8 and not word & 3:      # no reset during a run command
            self.reset()
        if word & 4:
            self.application.fault()
        elif word & 1 if self.wiring.reverse_bits else word & 3 in {1, 2}:
            self.run()
        else:
            self.ramp_stop()

    def ramp_stop(self) -> None:
        # One deceleration for all stops: that of the quick stop.
        self.application.settings.decel_rad_s2 = self.application.settings.quick_stop_rad_s2
        super().ramp_stop()

    def status(self) -> int:
        running = self.state in {State.ENABLED, State.QUICK_STOP}
        ready = self.state in {State.READY, State.SWITCHED_ON, State.SWITCH_ON_DISABLED} or running
        standing, agree = self.application.standstill, self.at_setpoint
        if self.wiring.status_address == 0x0020:
            bits = {0: running, 1: self.backwards, 2: ready, 3: self.faulted}
        elif self.wiring.status_address == 0x004B:
            bits = {0: running, 1: standing, 2: self.backwards, 4: agree, 5: ready, 6: self.application.warning,
                    7: self.faulted}
        else:
            bits = {0: running, 1: standing, 2: agree, 6: ready, 14: self.faulted, 15: self.application.warning}
        return sum(1 << number for number, bit in bits.items() if bit)
