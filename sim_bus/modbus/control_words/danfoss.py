"""Danfoss FC profile: CTW and STW (VLT programming guides, "control word according to FC profile").

Control word::

    2 0 = DC brake (here: the ramp) · 3 0 = coast · 4 0 = quick stop · 6 1 = start, 0 = ramp stop
    7 fault reset, rising · 10 the word counts · 15 reversing

Status word::

    0 control ready · 1 drive ready · 2 not coasting · 3 trip · 7 warning · 8 at the reference
    9 bus control · 10 no limit acts · 11 in operation

The available sources name the registers but not these bits. The bits are as in all editions of the guides (run is
047Ch, stop 043Ch, running shows 0F07h); check them in the manual of the drive. DC braking, jog, hold and the choice of
set-ups are not simulated.
"""

from sim_bus.cia402 import State
from sim_bus.modbus.control_words.base import StartStop


class DanfossWords(StartStop):
    """FC 302 and its relatives."""

    def obey(self, before: int, word: int) -> None:
        self.listens = bool(word & 0x0400)
        if not self.listens:
            self.word = before
            return
        self.select(word)
        self.reversed = bool(word & 0x8000)
        if word & ~before & 0x0080:
            self.reset()
        if not word & 0x0008:
            self.coast()
        elif not word & 0x0010:
            self.quick_stop()
        elif word & 0x0040 and word & 0x0004:
            self.run()
        else:
            self.ramp_stop()

    def status(self) -> int:
        control = self.application.inverter.control
        bits = {
            0: True,
            1: not self.faulted,
            2: bool(self.word & 0x0008) and not self.faulted,
            3: self.faulted,
            7: self.application.warning,
            8: self.at_setpoint,
            9: True,
            10: not control.limited,
            11: self.state in {State.ENABLED, State.QUICK_STOP},
        }
        return sum(1 << number for number, bit in bits.items() if bit)
