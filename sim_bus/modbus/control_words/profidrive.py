"""PROFIdrive and ABB Drives words: the same OFF1, OFF2, OFF3 state machine with small differences.

Control word (SINAMICS list manual, function diagram 9342; ABB Drives profile)::

    0 OFF1, 0 = down the ramp, then ready        1 OFF2, 0 = coast          2 OFF3, 0 = quick stop
    3 enable operation, 0 = coast, switched on   4 5 6 ramp generator       7 fault reset, rising
    10 the bus has control                       11 ABB: EXT2, here torque; PROFIdrive: direction reversal

After OFF2 and OFF3 switching on is inhibited: OFF1 must be 0 before it may be 1. PROFIdrive ignores the whole word
while bit 10 is 0, ABB all but the three OFF bits.

Status word (function diagram 9352)::

    0 ready to switch on · 1 ready · 2 operation enabled · 3 fault · 4 no OFF2 · 5 no OFF3 · 6 switching on inhibited
    7 alarm · 8 at the setpoint · 9 remote · 10 above the limit, here never
    PROFIdrive 11 no limit acts · 13 motor not too hot · 14 forwards · 15 power unit not overloaded
    ABB        11 EXT2 · 12 run enable from outside

The sources do not define bits 1 and 2 while the drive brakes. Here bit 2 is cleared with the setpoint, which no longer
acts; bit 1 is cleared on ABB (OFF1 active) and stays set on PROFIdrive. Bits 4 to 6 of the control word are ignored,
because no ramp is simulated.
"""

from sim_bus.cia402 import DeviceCommand, State
from sim_bus.modbus.control_words.base import ControlWords

_OFF1, _OFF2, _OFF3, _ENABLE, _RESET, _BUS = 0x0001, 0x0002, 0x0004, 0x0008, 0x0080, 0x0400
_EXT2 = 0x0800


class ProfidriveWords(ControlWords):
    """SINAMICS."""

    def obey(self, before: int, word: int) -> None:
        self.listens = bool(word & _BUS)
        if not self.listens:
            self.word = before                 # the last command stays active
            return
        self.select(word)
        self._off_bits(before, word)

    def _off_bits(self, before: int, word: int) -> None:
        reset = bool(word & ~before & _RESET)
        if not word & _OFF2:
            self.order(DeviceCommand.DISABLE_VOLTAGE, reset=reset)
        elif not word & _OFF3:
            self.order(DeviceCommand.QUICK_STOP, reset=reset)
        elif not word & _OFF1:
            self.order(DeviceCommand.SHUTDOWN, reset=reset)
        else:
            self.order(DeviceCommand.ENABLE if word & _ENABLE else DeviceCommand.SWITCH_ON, reset=reset)

    def status(self) -> int:
        control = self.application.inverter.control
        return (
            self.common(ready_while_braking=True)
            | (0x0800 if not control.limited else 0)
            | 0x2000
            | (0x4000 if not self.backwards else 0)
            | 0x8000
        )

    def common(self, *, ready_while_braking: bool) -> int:
        """Return bits 0 to 9."""
        state = self.state
        switched_on = state in {State.SWITCHED_ON, State.ENABLED, State.QUICK_STOP}
        braking = state is State.QUICK_STOP or self.application.stopping
        bits = (
            switched_on or state is State.READY,
            switched_on and (ready_while_braking or not braking),
            self.follows,
            self.faulted,
            self.word & _OFF2,
            self.word & _OFF3 and state is not State.QUICK_STOP,
            state is State.SWITCH_ON_DISABLED,
            self.application.warning,
            self.at_setpoint,
            True,
        )
        return sum(1 << number for number, bit in enumerate(bits) if bit)


class AbbWords(ProfidriveWords):
    """ACS880, ACS580 in the ABB Drives profile."""

    def obey(self, before: int, word: int) -> None:
        self.listens = bool(word & _BUS)
        if self.listens:
            if self.wiring.torque_bits == _EXT2:       # the user has assigned torque to EXT2
                self.select(word)
            self._off_bits(before, word)
        elif word & (_OFF1 | _OFF2 | _OFF3) != _OFF1 | _OFF2 | _OFF3:
            self.word = before & ~(_OFF1 | _OFF2 | _OFF3) | word & (_OFF1 | _OFF2 | _OFF3)
            self._off_bits(before, self.word & ~_RESET)
        else:
            self.word = before

    def status(self) -> int:
        return self.common(ready_while_braking=False) | (0x0800 if self.word & _EXT2 else 0) | 0x1000
