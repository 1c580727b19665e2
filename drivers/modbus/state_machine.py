"""The power states of a drive as its profile tells them, pure: status word in, control word out."""

from __future__ import annotations

import math
from collections import deque

from drivers.drive import Mode, PowerRequest, PowerState
from profiles.modbus import Bits, Control, StatusState

# ---------------------------------------------------------------------------------------------------------------------
# Standstill told from the reported speed, for drives whose status word doesn't tell.


STILL_S = 0.2
LEAST_SAMPLES = 5
MOST_GAPS = 2
"""Single lost replies of a noisy line in a row, which unsay nothing: no shaft gets up and comes to rest meanwhile."""
COUNTS, SHARE = 5, 0.005
"""No sample beyond so many counts, or this share of the speed limit if that is more …"""
MEAN_COUNTS, MEAN_SHARE = 1, 0.001
"""… and their mean within this: noise averages out, a shaft that still creeps doesn't."""


class ZeroSpeed:
    """At rest once the speed has stayed at zero for `STILL_S` and `LEAST_SAMPLES` samples without a longer gap."""

    def __init__(self, count_rad_s: float, limit_rad_s: float, period_s: float) -> None:
        self._peak_rad_s = max(COUNTS * count_rad_s, SHARE * limit_rad_s)
        self._mean_rad_s = max(MEAN_COUNTS * count_rad_s, MEAN_SHARE * limit_rad_s)
        self._gaps = 0
        self._last: deque[float] = deque(maxlen=max(LEAST_SAMPLES, math.ceil(STILL_S / period_s)))

    def gap(self) -> None:
        """A cycle brought nothing. After some of these in a row what was seen before them no longer counts."""
        self._gaps += 1
        if self._gaps > MOST_GAPS:
            self._last.clear()

    def near(self, speed_rad_s: float) -> bool:
        """Is this one sample no more than the noise of a shaft at rest?"""
        return abs(speed_rad_s) <= self._peak_rad_s

    def add(self, speed_rad_s: float) -> bool:
        """One more sample; whether the shaft is at rest."""
        last, self._gaps = self._last, 0
        last.append(speed_rad_s)
        if len(last) < (last.maxlen or 0) or not self.near(speed_rad_s):
            return False
        return max(map(abs, last)) <= self._peak_rad_s and abs(sum(last)) <= self._mean_rad_s * len(last)


# ---------------------------------------------------------------------------------------------------------------------

_POWER = {
    "not_ready": PowerState.NOT_READY,
    "off": PowerState.OFF,
    "ready": PowerState.READY,
    "enabled": PowerState.ENABLED,
    "quick_stop": PowerState.QUICK_STOP,
    "fault": PowerState.FAULT,
}


_ALL_ONES = 0xFFFF


def seen(bits: Bits | None, status: int) -> bool:
    """Does the status word show these bits? False where the profile names none."""
    return bits is not None and status & bits.mask == bits.value


def decode(control: Control, status: int) -> StatusState | None:
    """The first state of the profile's list that fits; None where none does, and for FFFFh.

    No drive shows all bits at once: it would be enabled and in fault. A gateway without its drive does.
    """
    if status & _ALL_ONES == _ALL_ONES:
        return None
    return next((state for state in control.states if status & state.mask == state.value), None)


def decode_after(control: Control, status: int) -> StatusState | None:
    """The same of a drive that has been enabled: from then on 0000h is no state either.

    Of the words of each family some bit is set in any state of such a drive (remote, no coast stop, ready). In those of
    CiA 402 not ready to switch on is over for good, with whatever else in the word.
    """
    state = decode(control, status)
    over = state is not None and control.family == "cia402" and state.means == "not_ready"
    return None if over or status & _ALL_ONES == 0 else state


def power_state(state: StatusState | None) -> PowerState:
    """What callers above the driver see of it."""
    return PowerState.UNKNOWN if state is None else _POWER[state.means]


def controlword_towards(
    control: Control, state: StatusState | None, wish: PowerRequest, mode: Mode, *, reverse: bool = False,
    turning: bool = False
) -> int:
    """The control word that brings the drive one step nearer to the wish.

    A fault is never reset here, a quick stop never ended by enabling again, and a shaft that turns under power is
    never disabled: it is braked instead. So is one whose drive shows no state at all, or none yet: the zeros of a
    gateway, or a pattern that the profile doesn't know, are no proof that it is off.
    """
    power = power_state(state)
    under_power = power in (PowerState.ENABLED, PowerState.QUICK_STOP, PowerState.NOT_READY, PowerState.UNKNOWN)
    if wish is PowerRequest.ENABLED:
        if power is PowerState.QUICK_STOP:
            word = control.quick_stop
        elif state is not None and state.onward is not None and power is not PowerState.FAULT:
            word = state.onward
        else:
            word = control.off
    elif wish is PowerRequest.QUICK_STOP:
        # Also while it is merely ready: some drives show that while they still brake, and `off` would let them coast.
        word = control.quick_stop if under_power or power is PowerState.READY else control.off
    else:
        word = control.quick_stop if under_power and turning else control.off
    word |= control.torque_bits if mode is Mode.TORQUE else control.speed_bits
    if reverse and control.reverse_bits is not None:
        word |= control.reverse_bits
    return word
