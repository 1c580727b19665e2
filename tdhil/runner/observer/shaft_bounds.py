"""Bounds of the moment of inertia and of friction from the run so far. Pure."""

from __future__ import annotations

import math
from collections import deque

from tdhil.runner.excitation import RigGuess
from tdhil.runner.observer.points import Point
from tdhil.runner.settings import MachineLimits

FRICTION_SHARE, FRICTION_LIMIT_SHARE = 0.3, 0.03
"""Uncertainty of friction: this share of it, and this share of the torque limit. Only two levels of stage 2 and a
straight line through them are known; nonlinear friction differs by this much within the window of speed."""

SLOW_FRICTION = 2.0
"""Factor by which friction below `SLOW_SHARE` of the speed limit may be larger (Stribeck effect) or smaller."""

BREAKAWAY = 1.3
"""Largest friction at low speed, as a multiple of the torque under which the shaft first moved."""

SLOW_SHARE = 0.15         # of the speed limit, for `SLOW_FRICTION`

LEARN_SHARE, LEARN_S = 0.03, 0.5
"""Least change of speed, as a share of its limit, and its time, s, for an upper bound of the inertia before stage 2
ends.
"""

LEVEL_S, LEVEL_SHARE = 1.0, 0.01
"""Steadiness of the first level: time, s, within which the speed stays within this share of its limit."""

LEVEL_FRICTION = 0.25
"""Relative uncertainty of the friction at the first level. At other speeds friction may rise or fall with the square
of the speed."""

FRICTION_LEVELS = 1.3
"""Largest friction on the way to the first level, as a multiple of the friction there."""

RISING = 1.2
"""Factor on the mean torque under which the speed rose; friction is at most this product."""

UNLEARNED = 1.5
"""Factor on the bounds learned before stage 2 ended."""

LEARNED_MARGIN = 1.1
"""Least ratio of stage 2's estimate to the lower bound. On 17 random healthy rigs it was 1.3 or more, and 1.05 if
the scale of speed doubled after the first ramp (`benchmarks/healthy_runs.py`)."""

STIFFEST_STRING_S = 8.0
"""Largest characteristic impedance of a string of unknown pipe: the torque limit divided by this many rad/s. A pipe
of 3.5 to 6.6 inches has a make-up torque of 60 to 120 rad/s times its impedance."""

RUN_OUT_SHARE = 0.5
"""Least friction of a shaft without torque, as a share of stage 2's result."""

RUN_OUT_S = 240.0
"""Longest run-out time above a drill string that cannot be braked, s. Friction alone stops the shaft sooner, but the
string turns it to and fro: after 190 s a simulated rig had 1.2 rad/s (`benchmarks/lying_reports.py`)."""

BLIND_MOST_S = 5.0
"""Longest time, beyond the lags, for which standstill is monitored, s: friction then stops any motion that the
reports can hide.
"""


class ShaftBounds:
    """Bounds of inertia and friction, as known so far.

    The first source is the torque under which the shaft accelerated: friction is at most that. The second is the first
    steady level, whose mean torque is the friction there, with the ramp before it: both give bounds of the inertia. The
    last is the rough model of stage 2.
    """

    def __init__(self, limits: MachineLimits, lag_s: float) -> None:
        self._limits = limits
        self._lag_s = lag_s
        self._margin_nm = FRICTION_LIMIT_SHARE * limits.torque_nm
        self._model: RigGuess | None = None
        self._ramp: tuple[float, float, float, float] | None = None    # change, impulse, duration, change of torque
        self._level: tuple[float, float] | None = None                 # speed, friction
        self._friction_most = 0.0
        self.breakaway_nm = 0.0
        """Largest torque before the shaft first moved, N·m; static friction is not larger."""
        self.inertia_low, self.inertia_high = 0.0, math.inf
        self.string_nm_s_rad = limits.wave_impedance_nm_s_rad or (
            limits.torque_nm / STIFFEST_STRING_S
        )

    def know(self, model: RigGuess) -> bool:
        """Set stage 2's rough model, and return whether it agrees with the first ramp.

        For the momentum balance J may be smaller, because a part of the load may hang on a compliant shaft. Two ramps
        give the whole inertia.
        """
        self._model = model
        error = model.inertia_rel_error
        least = min(1.0 - min(error, 0.75), 1.0 - FRICTION_SHARE)
        learned_low, learned_high = LEARNED_MARGIN * self.inertia_low, self.inertia_high
        self.inertia_low = least * model.inertia_kg_m2
        self.inertia_high = (1.0 + error) * model.inertia_kg_m2
        return model.inertia_kg_m2 >= learned_low and self.inertia_low <= learned_high

    @property
    def known(self) -> bool:
        """True if J and friction come from stage 2."""
        return self._model is not None

    @property
    def testable(self) -> bool:
        """True if (1) can be tested; with a string only if J is known."""
        return self.known or (self._friction_most > 0.0 and math.isfinite(self.inertia_high))

    @property
    def likely_inertia(self) -> float:
        """Stage 2's estimate of J, kg·m²; before that its upper bound."""
        return self.inertia_high if self._model is None else self._model.inertia_kg_m2

    @property
    def words(self) -> str:
        """Return the bounds of J as text."""
        if self.inertia_low == 0.0:
            return f"J up to {self.inertia_high:.3g} kg·m²"
        return f"J {self.inertia_low:.3g} to {self.inertia_high:.3g} kg·m²"

    @property
    def breakaway_low_nm(self) -> float:
        """Least torque that keeps the shaft turning slowly, N·m; before stage 2 ends, from the torque that first
        moved it.
        """
        if self._model is None:
            return self.breakaway_nm / SLOW_FRICTION
        return (1.0 - FRICTION_SHARE) * self._model.coulomb_nm

    @property
    def pushing_nm(self) -> float:
        """Torque above all friction within the speed limit, N·m."""
        return self.friction(self._limits.speed_max_rad_s, 0.0)[1]

    def friction(self, speed_rad_s: float, still_rad_s: float) -> tuple[float, float]:
        """Return the least and greatest friction torque against the motion, N·m; at standstill it has either sign."""
        model, speed, limits = self._model, abs(speed_rad_s), self._limits
        if model is not None:
            usual = max(0.0, model.coulomb_nm + model.viscous_nm_s_rad * speed)
            low = (1.0 - FRICTION_SHARE) * usual - self._margin_nm
            high = (1.0 + FRICTION_SHARE) * usual + self._margin_nm
        elif self._level is not None:
            ratio = speed / self._level[0]
            away = LEVEL_FRICTION + (FRICTION_SHARE - LEVEL_FRICTION) * min(1.0, abs(ratio - 1.0))
            low = (1.0 - away) * self._level[1] * min(1.0, ratio**2) - 2.0 * self._margin_nm
            high = (1.0 + away) * self._level[1] * max(1.0, ratio**2) + 2.0 * self._margin_nm
        else:
            low, high = 0.0, max(self._friction_most, BREAKAWAY * self.breakaway_nm) + self._margin_nm
        if self.inertia_low > 0.0 and speed < SLOW_SHARE * limits.speed_max_rad_s:
            low = low / SLOW_FRICTION if low > 0.0 else low
            high = max(high, BREAKAWAY * self.breakaway_nm) if self.breakaway_nm > 0.0 else SLOW_FRICTION * high
        if speed <= still_rad_s:
            return -high, high
        return (low, high) if speed_rad_s > 0.0 else (-high, -low)

    def surplus(self, point: Point) -> tuple[float, float]:
        """Return the least and greatest torque that accelerates the shaft, N·m, for the likeliest friction."""
        low, high = self.friction(point.speed, point.still)
        if abs(point.speed) <= point.still:
            return tuple(one - max(low, min(high, one)) for one in (point.torque_low, point.torque_high))  # type: ignore[return-value]
        usual = 0.5 * (low + high)
        return point.torque_low - usual, point.torque_high - usual

    def learn(self, points: deque[Point]) -> None:
        """Learn bounds from the points before stage 2 ends. Above a string they give none."""
        done = self._model is not None or self._level is not None
        if done or self._limits.has_drill_string or self.breakaway_nm <= 0.0 or len(points) < 3:
            return
        now = points[-1]
        least = LEARN_SHARE * self._limits.speed_max_rad_s
        recent = next((point for point in reversed(points) if now.time_s - point.time_s >= LEARN_S), None)
        if recent is not None and now.speed - recent.speed >= 0.5 * least:
            mean_nm = (now.impulse - recent.impulse) / (now.time_s - recent.time_s)
            self._friction_most = max(self._friction_most, RISING * mean_nm)
        start = points[0]
        took_s, change = now.time_s - start.time_s, now.speed - start.speed
        if took_s >= LEARN_S and change >= least and (self._ramp is None or change > self._ramp[0]):
            self._ramp = change, now.impulse - start.impulse, took_s, abs(now.torque_high - start.torque_low)
            self.inertia_high = UNLEARNED * (self._ramp[1] + self._lag_s * self._ramp[3]) / change
        self._see_level(points)

    def _see_level(self, points: deque[Point]) -> None:
        """Learn the friction of a first steady level after a ramp, and the inertia from the ramp."""
        now = points[-1]
        start = next((point for point in reversed(points) if now.time_s - point.time_s >= LEVEL_S), None)
        near = LEVEL_SHARE * self._limits.speed_max_rad_s
        if start is None or self._ramp is None or now.speed < 0.5 * self._ramp[0]:
            return
        speeds = [point.speed for point in points if point.time_s >= start.time_s]
        if max(speeds) - min(speeds) > near:
            return
        friction = (now.impulse - start.impulse) / (now.time_s - start.time_s)
        torques = [point.torque for point in points if point.time_s >= start.time_s]
        settling = max(torques) - min(torques) > LEVEL_FRICTION * friction + self._margin_nm
        if friction <= 0.0 or settling:
            return
        self._level = now.speed, friction
        change, impulse, took_s, more_nm = self._ramp
        left = impulse - FRICTION_LEVELS * friction * took_s - self._lag_s * more_nm
        self.inertia_low = max(0.0, left) / change / UNLEARNED

    def shows_s(self, at_rest_rad_s: float, torque_nm: float) -> float:
        """Return the time for which a disabled shaft must show standstill, s; see `Observer.shows_s`."""
        model = self._model
        if model is None or self._limits.has_drill_string or abs(torque_nm) <= 0.5 * self.breakaway_low_nm:
            return 0.0
        if model.coulomb_nm <= 0.0:        # case of two levels with a Stribeck effect between them
            return math.inf
        return 2.0 * at_rest_rad_s * self.inertia_high / (RUN_OUT_SHARE * model.coulomb_nm)

    def coasts_s(self, speed_rad_s: float) -> float:
        """Return the longest time for which the shaft turns without torque from this speed, s; 0 above a string, and
        before stage 2 has ended.
        """
        if self._model is None or self._limits.has_drill_string:
            return 0.0
        if self.breakaway_low_nm <= 0.0:
            return RUN_OUT_S
        return min(RUN_OUT_S, self.inertia_high * abs(speed_rad_s) / self.breakaway_low_nm)

    def blind_s(self, still_rad_s: float) -> float:
        """Return the longest time in which friction stops a motion that (1) cannot detect, s."""
        model = self._model
        if model is None or self._limits.has_drill_string or self.breakaway_low_nm <= 0.0:
            return 0.0
        # A lag hides an impulse of lag·ΔT; when a shaft comes to standstill the torque changes by about its friction.
        hidden_nms = self._lag_s * 2.0 * model.steady_torque_nm(self._limits.speed_min_rad_s)
        return min(BLIND_MOST_S, hidden_nms / self.breakaway_low_nm)
