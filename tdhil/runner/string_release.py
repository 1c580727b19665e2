"""Release of a drill string's trapped torque: the speed with which the motor yields. Pure.

A twisted string turns back if the motor does not hold it. So the motor holds it under speed control, and yields:

    ω = −(T − T_ref)/Z        T_ref falls from the trapped torque to zero on the rig's ramp

with T the reported torque of the drive. The host only ever *yields*: ω and T have opposite signs, or ω is zero, so no
work is done on the string. It turns backwards no further than its own twist takes it, is never driven that way, and the
torque ends at zero instead of becoming negative. So the release never unscrews a tool joint, and
``allow_reverse: false`` does not forbid it. The same law damps an oscillating string: it takes energy away.

Z is the torque limit over half the speed limit, which suits a long string. A short and stiff one would respond to a
late report with an oscillation: whenever the torque changes its sign faster than any string oscillates, Z is doubled.
The mean torque shows this, and the torque of single cycles where the loop oscillates within a few of them. Single
cycles count only while the reported speed or position moves, too. A loop whose sensor is lost oscillates beside a speed
of zero: a doubled Z would calm the torque, and the turning shaft would pass for one at rest
(`benchmarks/lying_reports.py`, number 746). A lag of the speed hides a fast motion, and the position shows it
(`benchmarks/healthy_runs.py`, seed 1713).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

SPEED_SHARE = 0.1
"""Yielding is never faster than this share of the speed limit."""

IMPEDANCE_SPEED_SHARE = 0.5   # of the speed limit, at which the impedance takes the torque limit
RESIDUAL_SHARE, RESIDUAL_QUANTA = 0.02, 5.0
"""Torque counts as zero when its mean is below this share of the torque limit, or this many quanta of its report."""

MEAN_S = 0.5
"""Averaging time of the reported torque, s; it removes the noise."""

QUIET_S = 6.0
"""Time for which torque and speed must be quiet, s: half a period of a string with a period of 12 s."""

FASTEST_SWING_S = 2.0     # s; a shorter half period is not the string's, but the loop's own
HARD_SHARE = 0.1
"""Share of the torque limit beyond which the torque of a single cycle has a sign. Noise stays below it. A loop that is
unstable within a few cycles exceeds it, and the mean hides its oscillation (`benchmarks/healthy_runs.py`, seed 435: a
report every 65 ms, and ±8,000 N·m with a period of four cycles)."""

STIFFEST = 64.0           # largest multiple of the impedance at the beginning
TRAVEL_RAD = 250.0
"""Longest travel of the release, rad: about 40 turns. No string holds more twist below its make-up torque."""

EXTRA_S = 90.0
"""Time beyond the ramp for an oscillating string, s."""


@dataclass(frozen=True)
class StringReleaseLimits:
    """Limits of the release at the motor shaft; ``ramp_nm_s`` as in rig.yaml."""

    torque_nm: float
    speed_rad_s: float
    ramp_nm_s: float
    torque_resolution_nm: float
    torque_offset_nm: float = 0.0      # reported torque at zero torque

    @property
    def residual_nm(self) -> float:
        """Return the torque below which it counts as zero, N·m."""
        return max(RESIDUAL_SHARE * self.torque_nm, RESIDUAL_QUANTA * self.torque_resolution_nm)


class _Alternation:
    """Detects a torque that changes its sign within ``fastest_s``. A torque up to ``small_nm`` has no sign."""

    def __init__(self, small_nm: float, fastest_s: float) -> None:
        self._small_nm = small_nm
        self._fastest_s = fastest_s
        self._side = 0.0
        self._since_side_s = 0.0

    def changes(self, torque_nm: float, period_s: float) -> bool:
        """Add the torque of one cycle, N·m. Return whether its sign changed too fast."""
        self._since_side_s += period_s
        side = math.copysign(1.0, torque_nm)
        if abs(torque_nm) <= self._small_nm or side == self._side:
            return False
        fast = self._side != 0.0 and self._since_side_s < self._fastest_s
        self._side, self._since_side_s = side, 0.0
        return fast


class _Impedance:
    """Z, N·m·s/rad: the torque limit over half the speed limit, doubled when the torque oscillates faster than a
    string.

    An oscillation with half a period below ``fastest_s`` comes from the loop itself.
    """

    def __init__(self, torque_limit_nm: float, speed_limit_rad_s: float, residual_nm: float, fastest_s: float) -> None:
        self.nm_s_rad = torque_limit_nm / (IMPEDANCE_SPEED_SHARE * speed_limit_rad_s)
        self._stiffest = STIFFEST * self.nm_s_rad
        self._of_mean = _Alternation(residual_nm, fastest_s)
        self._of_cycles = _Alternation(HARD_SHARE * torque_limit_nm, MEAN_S)

    def watch(self, mean_nm: float, period_s: float, torque_nm: float = 0.0) -> None:
        """Update the impedance with the mean torque and the torque of one cycle, N·m."""
        of_mean = self._of_mean.changes(mean_nm, period_s)
        if self._of_cycles.changes(torque_nm, period_s) or of_mean:
            self.nm_s_rad = min(2.0 * self.nm_s_rad, self._stiffest)


class StringRelease:
    """Receives every fresh sample; returns the yielding speed, and reports when the torque is released."""

    def __init__(self, limits: StringReleaseLimits, at_rest_rad_s: float, period_s: float) -> None:
        self._limits = limits
        self._at_rest_rad_s = at_rest_rad_s
        self._period_s = period_s
        self._fastest_rad_s = SPEED_SHARE * limits.speed_rad_s
        self._impedance = _Impedance(limits.torque_nm, limits.speed_rad_s, limits.residual_nm, FASTEST_SWING_S)
        self._recent: deque[float] = deque(maxlen=max(1, round(MEAN_S / period_s)))
        self._reference_nm: float | None = None
        self._quiet_s = 0.0
        self._still_s = math.inf       # since the speed was above rest, or the position changed
        self._position_rad: float | None = None
        self._time_s = 0.0
        self.trapped_nm = 0.0
        """Torque at the beginning, signed, N·m."""
        self.travel_rad = 0.0
        """Commanded travel of the yielding shaft, signed, rad."""

    @property
    def torque_nm(self) -> float:
        """Return the mean held torque, N·m."""
        return math.fsum(self._recent) / len(self._recent) if self._recent else 0.0

    @property
    def longest_s(self) -> float:
        """Return the longest duration of the release, s."""
        return 2.0 * abs(self.trapped_nm) / self._limits.ramp_nm_s + EXTRA_S

    @property
    def done(self) -> bool:
        """Return whether the torque is released and has been quiet for long enough."""
        return self._quiet_s >= QUIET_S

    @property
    def failed(self) -> bool:
        """Return whether its limits in time or travel are reached."""
        return self._time_s > self.longest_s or abs(self.travel_rad) > TRAVEL_RAD

    def step(
        self, torque_nm: float, speed_rad_s: float, position_rad: float | None = None, *, noise: bool = False,
    ) -> float:
        """Return the next speed setpoint, rad/s, from the last report; a value that is not finite counts as missing.

        ``position_rad``: position of the cycle, if the drive reports one. ``noise``: a speed above standstill is noise.
        """
        self._time_s += self._period_s
        if not (math.isfinite(torque_nm) and math.isfinite(speed_rad_s)):
            self._quiet_s = 0.0
            return 0.0
        torque_nm -= self._limits.torque_offset_nm
        self._recent.append(torque_nm)
        held_nm = self.torque_nm
        if self._reference_nm is None:
            self._reference_nm, self.trapped_nm = abs(held_nm), held_nm
        self._reference_nm = max(0.0, self._reference_nm - self._limits.ramp_nm_s * self._period_s)
        still = abs(speed_rad_s) <= self._at_rest_rad_s
        turned = None not in (position_rad, self._position_rad) and position_rad != self._position_rad
        self._position_rad = position_rad
        self._still_s = self._still_s + self._period_s if still and not turned else 0.0
        calm = abs(held_nm) <= self._limits.residual_nm and (still or noise)
        self._quiet_s = self._quiet_s + self._period_s if calm else 0.0
        self._impedance.watch(held_nm, self._period_s, torque_nm if self._still_s < MEAN_S else 0.0)
        # The ramp belongs to the side on which the torque was trapped; torque of the other sign is released at once.
        same_side = torque_nm * self.trapped_nm > 0.0
        excess_nm = max(0.0, abs(torque_nm) - (self._reference_nm if same_side else 0.0))
        speed = -math.copysign(min(self._fastest_rad_s, excess_nm / self._impedance.nm_s_rad), torque_nm)
        self.travel_rad += speed * self._period_s
        return speed


MEAN_TORQUE_S = 8.0
"""Averaging time of the mean torque, s: longer than the period of most strings."""

SMOOTH_S = 0.2
"""Smoothing time of the torque, s: a loop with late reports then stays stable for any gain of the drive."""


class SwingDamper:
    """Receives every sample of a turning string; returns the next speed setpoint, ω₀ − (T − T̄)/Z, within bounds.

    T̄ is the mean torque of the last `MEAN_TORQUE_S`, so friction and bit do not change the mean speed. The bounds:
    a tenth of the speed limit in both directions, forward, and below the speed limit.
    """

    def __init__(self, torque_limit_nm: float, speed_limit_rad_s: float, target_rad_s: float, period_s: float) -> None:
        self._target_rad_s = target_rad_s
        self._most_rad_s = SPEED_SHARE * speed_limit_rad_s
        self._highest_rad_s = (1.0 - 0.5 * SPEED_SHARE) * speed_limit_rad_s
        residual_nm = RESIDUAL_SHARE * torque_limit_nm
        self._impedance = _Impedance(torque_limit_nm, speed_limit_rad_s, residual_nm, LOOP_SWING_S)
        self._period_s = period_s
        self._seen = 0
        self._mean_nm = self._smooth_nm = 0.0

    def step(self, torque_nm: float) -> float:
        """Return the speed setpoint, rad/s; a torque that is not finite counts as missing."""
        if not math.isfinite(torque_nm):
            return self._bounded(0.0)
        if self._seen == 0:
            self._mean_nm = self._smooth_nm = torque_nm
        self._seen += 1
        self._mean_nm += max(1.0 / self._seen, self._period_s / MEAN_TORQUE_S) * (torque_nm - self._mean_nm)
        self._smooth_nm += self._period_s / (self._period_s + SMOOTH_S) * (torque_nm - self._smooth_nm)
        swing_nm = self._smooth_nm - self._mean_nm
        self._impedance.watch(swing_nm, self._period_s)
        return self._bounded(-swing_nm / self._impedance.nm_s_rad)

    def _bounded(self, deviation_rad_s: float) -> float:
        speed = self._target_rad_s + max(-self._most_rad_s, min(self._most_rad_s, deviation_rad_s))
        return max(0.0, min(max(self._target_rad_s, self._highest_rad_s), speed))


LOOP_SWING_S = 0.5
"""Shortest half period of a string's lowest mode, s; only that mode is damped."""
