"""The power states of a drive from its profile, pure: status word in, control word out."""

from __future__ import annotations

import math
from collections import deque

from drivers.drive import Mode, PowerRequest, PowerState
from profiles.modbus import Bits, Control, StatusState

# ---------------------------------------------------------------------------------------------------------------------
# Standstill from the reported speed, for drives whose status word does not show it.


STILL_S = 0.2
LEAST_SAMPLES = 5
MOST_GAPS = 2
"""Number of successive lost replies that do not reset the detection. A shaft can't start and stop within this time."""
STILL_COUNTS, STILL_SHARE = 5, 0.005
"""Noise of a standstill in each sample: this number of counts, or this share of the speed limit if that is more."""
MEAN_COUNTS, MEAN_SHARE = 1, 0.001
"""Limit of the mean: number of counts, or share of the speed limit. The mean of noise is small; that of a creeping
shaft is not."""


class ZeroSpeed:
    """Detects standstill: the speed stays at zero for `STILL_S` and `LEAST_SAMPLES` samples without a longer gap."""

    def __init__(self, count_rad_s: float, limit_rad_s: float, period_s: float) -> None:
        self._peak_rad_s = max(STILL_COUNTS * count_rad_s, STILL_SHARE * limit_rad_s)
        self._mean_rad_s = max(MEAN_COUNTS * count_rad_s, MEAN_SHARE * limit_rad_s)
        self._gaps = 0
        self._last: deque[float] = deque(maxlen=max(LEAST_SAMPLES, math.ceil(STILL_S / period_s)))

    def gap(self) -> None:
        """Count a cycle without data. After more than `MOST_GAPS` in a row the earlier samples are discarded."""
        self._gaps += 1
        if self._gaps > MOST_GAPS:
            self._last.clear()

    def near(self, speed_rad_s: float) -> bool:
        """Return whether this sample is within the noise of a standstill."""
        return abs(speed_rad_s) <= self._peak_rad_s

    def add(self, speed_rad_s: float) -> bool:
        """Add a sample. Return whether the shaft is at standstill."""
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
    "fault_reaction": PowerState.FAULT_REACTION,
}
_UNDER_POWER = (PowerState.ENABLED, PowerState.QUICK_STOP, PowerState.FAULT_REACTION, PowerState.NOT_READY,
                PowerState.UNKNOWN)


_ALL_ONES = 0xFFFF


def seen(bits: Bits | None, status: int) -> bool:
    """Return whether the status word shows these bits; False if the profile names none."""
    return bits is not None and status & bits.mask == bits.value


def decode(control: Control, status: int) -> StatusState | None:
    """Return the first matching state of the profile's list; None without a match, and for FFFFh.

    No drive sets all bits at once: it would be enabled and in fault. A gateway without its drive does.
    """
    if status & _ALL_ONES == _ALL_ONES:
        return None
    return next((state for state in control.states if status & state.mask == state.value), None)


def decode_after(control: Control, status: int) -> StatusState | None:
    """Return the state of a drive that has been enabled: from then on 0000h is not a state either.

    In each family some bit is set in any state of such a drive (remote, no coast stop, ready). In the CiA 402 family
    the drive can't return to not ready to switch on, for any value of the word's other bits.
    """
    state = decode(control, status)
    over = state is not None and control.family == "cia402" and state.means == "not_ready"
    return None if over or status & _ALL_ONES == 0 else state


def power_state(state: StatusState | None) -> PowerState:
    """Return the state as callers above the driver see it."""
    return PowerState.UNKNOWN if state is None else _POWER[state.means]


def controlword_towards(
    control: Control, state: StatusState | None, wish: PowerRequest, mode: Mode, *, reverse: bool = False,
    turning: bool = False, removes_torque: bool = False
) -> int:
    """Return the control word that brings the drive one step nearer to ``wish``.

    It never resets a fault, never ends a quick stop by enabling, and never disables a shaft that turns under power;
    such a shaft is braked. The same holds for a drive without a valid state: zeros from a gateway, or an unknown
    pattern, do not prove that it is off. ``removes_torque``: the torque is removed at once, even
    of such a shaft, with the word for a coast if the drive has one.
    """
    mode_bits = control.torque_bits if mode is Mode.TORQUE else control.speed_bits
    if removes_torque and control.coast is not None:
        return control.coast | mode_bits
    power = power_state(state)
    under_power = power in _UNDER_POWER
    if wish is PowerRequest.ENABLED:
        if power in (PowerState.QUICK_STOP, PowerState.FAULT_REACTION):
            word = control.quick_stop
        elif state is not None and state.onward is not None and power is not PowerState.FAULT:
            word = state.onward
        else:
            word = control.off
    elif wish is PowerRequest.QUICK_STOP:
        # Also while it is only ready: some drives show that while they still brake, and `off` would let them coast.
        word = control.quick_stop if under_power or power is PowerState.READY else control.off
    else:
        word = control.quick_stop if under_power and turning and not removes_torque else control.off
    word |= mode_bits
    if reverse and control.reverse_bits is not None:
        word |= control.reverse_bits
    return word
