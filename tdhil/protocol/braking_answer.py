"""What a shaft answers to a braking torque: slower, faster or nothing. Pure; fed with one sample a cycle.

The reported speed decides, since it is the shaft itself: whichever comes first, half of the expected change downwards
or as much upwards. Reported torque and torque demand are quicker: should either clearly rise, it is over at once. That
they fall proves nothing about the shaft, and is no condition.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import Enum

import numpy as np

from drivers.drive import Sample
from tdhil.protocol.braking_pulse import Pulse
from tdhil.run.stages.steady import trace

MEAN_S = 0.05
"""What is looked at is a mean over this time, or one sample where that is longer."""

SPEED_SHARE, TORQUE_SHARE = 0.5, 0.3
"""Of the expected change, that counts as one."""

NOISE_SD, NOISE_QUANTA = 3.0, 1.5
"""Standard deviations, or quanta, that don't count as a change."""


class Answer(Enum):
    """Which way the shaft went."""

    SLOWER = "slower"
    FASTER = "faster"


def speed_noise_rad_s(steady: Sequence[Sample], resolution_rad_s: float) -> float:
    """What counts as noise of the reported speed, rad/s, from samples of steady rotation."""
    return max(NOISE_SD * float(trace(steady).speed_rad_s.std()), NOISE_QUANTA * resolution_rad_s)


class Listener:
    """Compares what comes with the steady rotation before; ``why`` says in words what was seen last."""

    def __init__(self, pulse: Pulse, steady: Sequence[Sample], period_s: float) -> None:
        before = trace(steady)
        self.before_rad_s = self.speed_rad_s = float(before.speed_rad_s.mean())
        self.before_nm = self.torque_nm = self.lowest_nm = float(before.torque_nm.mean())
        self._pulse = pulse
        self._change_rad_s = SPEED_SHARE * pulse.slowing_rad_s
        change_nm = TORQUE_SHARE * (pulse.flowing_nm - pulse.torque_nm)
        self._rise_nm = max(change_nm, NOISE_SD * float(before.torque_nm.std()))
        self._demand_rise_nm = change_nm
        self._recent: deque[tuple[float, float]] = deque(maxlen=max(1, round(MEAN_S / period_s)))
        self.why = ""

    def hear(self, sample: Sample) -> Answer | None:
        """None as long as it isn't clear."""
        if not sample.fresh:
            return None
        self._recent.append((sample.speed_rad_s, sample.torque_nm))
        self.speed_rad_s, self.torque_nm = (float(mean) for mean in np.mean(self._recent, axis=0))
        self.lowest_nm = min(self.lowest_nm, self.torque_nm)
        full = len(self._recent) == self._recent.maxlen
        self.why = f"the speed went from {self.before_rad_s:.3f} to {self.speed_rad_s:.3f} rad/s"
        if full and self.speed_rad_s >= self.before_rad_s + self._change_rad_s:
            return Answer.FASTER
        if full and self.torque_nm >= self.before_nm + self._rise_nm:
            self.why = f"the reported torque went from {self.before_nm:.1f} to {self.torque_nm:.1f} N·m"
            return Answer.FASTER
        demand = sample.torque_demand_nm
        if demand is not None and demand >= self._pulse.flowing_nm + self._demand_rise_nm:
            self.why = f"the drive's torque demand went from {self._pulse.flowing_nm:.1f} to {demand:.1f} N·m"
            return Answer.FASTER
        if full and self.speed_rad_s <= self.before_rad_s - self._change_rad_s:
            return Answer.SLOWER
        return None
