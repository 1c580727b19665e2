"""The observer: compares the drive's reports with each other in every cycle, and finds the one that does not fit. Pure.

No report is believed alone. The reports of speed, torque and angle belong to one shaft, so its balance of momentum
holds between any two instants s and t:

    J (ω_t − ω_s) = ∫ (T − T_f) dt                        T_f: friction, or the torque of a drill string

What is reported lags. For a first-order lag the true value is ω = z + τ_w dz/dt, and the true impulse is
∫T = ∫z_T + τ_T Δz_T. With both time constants anywhere between zero and the longest plausible one, the imbalance of the
reports must lie in an interval:

    J Δz − ∫ (z_T − T_f) dt  ∈  τ_T ΔT − J τ_w Δα ± noise                                              (1)

Every quantity enters with its bounds: J and T_f as known so far, the acceleration α from the slope of the reported
speed and from the torque, rounding and noise of the reports. (1) is tested over several windows. A report contradicts
the others if (1) fails for each J within its bounds, twice in a row. The bounds are worst cases and not standard
deviations, so the rate of false alarms is set by what the bounds leave out; `benchmarks/healthy_runs.py` counts it.

A second test needs no window. A reported speed is an average of true speeds with weights that are not negative, so its
slope lies between the least and the greatest acceleration that torque and load allow, whatever the lag:

    (T_min − T_f)/J_min  ≤  dz/dt  ≤  (T_max + T_f)/J_min                                              (2)

In torque mode T_min and T_max are those of the commanded and the reported torque, in speed mode those of the reported
torque with a margin for what its lag hides.

The position is compared with the way by the reported speed: ∫ω dt = ∫z dt + τ_w Δz, from the moment on at which
stage 2 has confirmed the unit of speed. In torque mode the mean reported torque is compared with the mean commanded
torque.

What the observer knows grows with the run. Before the shaft has moved it knows nothing. From the first ramp on it knows
how large friction can be at most. From the end of stage 2 it knows J and friction with their uncertainty. A torque
scale that is wrong in every report, and a speed scale that is wrong from the start where no position is reported,
contradict nothing: no observer can find them.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from drivers import Command, Mode, PositionReading, PowerState, Sample, Unwrapped
from tdhil.runner.excitation import RigGuess
from tdhil.runner.settings import ControlAssumptions, MachineLimits

POINT_S = 0.04
"""Time between two points of the comparison, s; a slow line has one for each cycle."""

WINDOWS_S = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Windows of (1), s. Short ones find a jump; long ones find a report that no longer follows. The longest is for the
time before J is known: over it friction that bends adds up to more than a known J leaves open."""

SLOPE_S = 0.12
"""Time over which a slope of the reported speed is taken, s: three points."""

AROUND_S = 0.25
"""Slope and torque at an end of a window are bounded by what they are within this time of it, s: a dead time hides what
comes later."""

LONGEST_GAP_S = 0.2
"""Feedback that was missing for longer begins the comparison anew, s."""

BEYOND_LIMIT = 1.25
"""A reported torque beyond this multiple of the torque limit is false: the drive holds the limit but for ripple."""

AT_LIMIT_SHARE = 0.9
"""Share of the torque limit from which on the torque counts as being at it."""

STRAINED_S, STRAINED_SHARE = 5.0, 0.1
"""Time for which the torque may stay at its limit while the reported speed is within this share of the speed limit of
the commanded one. A speed control that has its speed needs no such torque."""

UNANSWERED_S, UNANSWERED_SHARE = 8.0, 0.05
"""In a stop, a reported speed that changes by no more than this share under a braking torque at its limit, for so long,
answers nothing: a shaft that slow would take minutes to stop."""

FLAT_S, FLAT_LIMIT_S, FLAT_LAGS = 1.0, 1.5, 3.0
"""A reported speed that stays within its own noise is lost, if meanwhile the torque that is commanded in torque mode
should have moved it for so long beyond so many lags, or if the torque stands at its limit for the second time: nothing
controls the speed then, and only a load that equals the limit to the last newton metre would keep it."""

FLAT_MOVES, YIELD_MOVES = 12.0, 3.0
"""How many times its noise a speed must have been moved, by the bounds of J and of the string's impedance; and how fast
a shaft must have been told to yield. A string that swings keeps a healthy speed within its noise against 5.6 times that
(`benchmarks/healthy_runs.py`)."""

YIELD_S, YIELD_STILL, YIELD_LEFT, SMOOTH_S, YIELD_STANDS = 4.0, 1.0, 0.05, 0.4, 0.25
"""A wound-up shaft that is told to yield follows, since the string pulls it. A reported speed that stays within this
share of the range of the commanded speed, or within its own noise, does not; asked once the commanded one is beyond so
many times the speed of standstill in the mean over so long, of means over the next, s, and the reported one is slower
than the last share of it."""

HELD_S = 1.5
"""A shaft that moved before and is reported to stand still for so long, in spite of a speed setpoint and a torque at
its limit, is held or not seen."""

IN_A_ROW = 2
"""Points at which a test must fail, one after the other."""

NOISE_SDS = 6.0
"""Standard deviations of the reported speed that count as its noise."""

FRICTION_SHARE, FRICTION_LIMIT_SHARE = 0.3, 0.03
"""Uncertainty of friction: this share of it, and this share of the torque limit. Two levels of stage 2 and a straight
line through them are all that is known; friction that bends differs by so much within the window of speed."""

SLOW_FRICTION = 2.0
"""Below `SLOW_SHARE` of the speed limit friction may be so many times as large (Stribeck effect), or half of it; …"""
BREAKAWAY = 1.3
"""… but no larger than this multiple of the torque under which the shaft first moved."""
SLOW_SHARE = 0.15

STILL_SHARE = 0.01
"""Share of the speed limit below which a shaft may stand still: static friction then takes any torque up to its own."""

LEARN_SHARE, LEARN_S = 0.03, 0.5
"""Before stage 2 ends, the inertia has an upper bound once the speed changed by this share of its limit in so long."""

LEVEL_S, LEVEL_SHARE = 1.0, 0.01
"""A first level is steady once the speed stayed within this share of the limit for so long."""

LEVEL_FRICTION = 0.25
"""Uncertainty of the friction at the first level, as a share of it; away from it friction may grow or fall with the
square of the speed."""

FRICTION_LEVELS = 1.3
"""Friction on the way to the first level is at most so many times the friction there."""

RISING = 1.2
"""Factor on the mean torque under which the speed rose: friction is no more than that there."""

UNLEARNED = 1.5
"""Factor on what was learned before stage 2 ended."""

STIFFEST_STRING_S = 8.0
"""Characteristic impedance of a string of unknown pipe: at most the torque limit divided by this many rad/s. A pipe of
3.5 to 6.6 inches has a make-up torque of 60 to 120 rad/s times its impedance."""

LOAD_RANGE, LOAD_BEFORE_S = 1.0, 10.0
"""The torque of a string stays within this multiple of its range, about the middle, over so long before a window, s: a
swing of a long string."""

LIGHTEST_SHARE = 0.5
"""The motor's own share of the inertia at least, where part of the load hangs on a shaft that twists."""

LIGHTER_SHARE = 0.02
"""An imbalance that this share of the inertia explains may be a lost load."""

STEEPEST = 0.9
"""Factor on the acceleration of (2). Its inertia is far below the likeliest one; above a noisy bit a healthy shaft
reaches 0.6 of the bound, elsewhere 0.3 (`benchmarks/healthy_runs.py`)."""
HIDDEN_SHARE = 0.25
"""In speed mode the drive may command torques that are too short for the lag of their report: this share of the limit
beyond what is reported."""
MEMORY_S = 3.0
"""A reported slope remembers the torque of so long, s: six of the longest plausible lags."""

ANGLE_SHARE = 0.1
"""Tolerance of the angle against the reported speed, as `speed_check.TOLERANCE`."""
STALE_S = 1.0
"""A position that has not come for so long tells nothing of now, s."""
MOVED_RAD = 0.5
"""A position that moved so far shows that the shaft turns, and not that a string or a coupling winds up."""
ANGLE_WINDOW_S = (0.5, 2.0)
"""Least and longest window of that comparison, s."""

TORQUE_SHARE, TORQUE_LIMIT_SHARE, TORQUE_WINDOW_S = 0.25, 0.05, 4.0
"""Reported and commanded torque may differ by this share of the command and of the torque limit, in the mean over so
many seconds of torque mode. The verdict compares them with a coverage interval; this bound ends a run early."""

FROZEN_S, FROZEN_SHARE = 0.5, 0.1
"""Speed and torque that stay the same to the last bit for so long, while the setpoint moves by this share of its limit,
are repeated and not measured (row 19)."""

BEFORE_S, KEPT_SHARE, FALL, RAMP_SLACK = 2.0, 0.9, 2.0, 1.2
"""A speed that kept this share of what it was so long before a contradiction had not fallen, and falls under a quick
stop by no more than this multiple of its rate; the last factor is that of a ramp that is on its way already."""

ALIVE_S = 1.0
"""After a contradiction a speed is followed anew once the longest lag has passed so many times, …"""
ALIVE_LAGS = 3.0
ALIVE_SHARE = 0.25
"""… if it has kept this share of itself by then, and comes down no faster than this share of the quick stop's time. A
lost encoder shows zero by then."""

UNSEEN_SHARE = 0.1
"""Least friction, as a share of the torque that was applied, of a shaft whose motion nobody has seen."""
UNSEEN_MOST_S = 60.0
"""A shaft whose motion nobody has seen is given so long to run out at most, s."""

RUN_OUT_SHARE, RUN_OUT_MOST_S = 0.5, 240.0
"""Least friction, as a share of what stage 2 found, of a shaft that runs out without torque; and how long it gets at
most, s, or where no friction is known."""

BLIND_MOST_S = 5.0
"""Standstill is watched for so long beyond the lags at most, so that friction stops what the reports can hide, s."""

PUSHING_S, PUSHING_SHARE = 1.0, 0.1
"""A torque that pushes on for so long after a quick stop, past every reporting lag, drives the shaft: this share of the
torque limit, where the reported speed is not believed or never showed a motion."""
DOUBTED_SHARE = 0.5
"""With a report in doubt, this share of the torque limit is more than a quick stop takes in the direction of motion."""
DOUBTED_REST_SHARE = 0.1
"""Share of the speed that counts as standstill, for a report that was in doubt and may have a wrong scale."""
IMPULSE_SHARE = 0.3
"""Uncertainty of the speed by impulse, as a share of the speed at which the stop began."""
FASTER_SHARE, FASTER_S, FASTER_BRAKED_S = 0.1, 0.4, 1.0
"""Of the speed limit, by which a shaft must have become faster under a quick stop, and for how long, s; the last while
the reported torque brakes it. A slipping encoder may report a higher speed for a moment."""
INVERTED_S, INVERTED_SHARE = 2.0, 0.3
"""Over so long a speed that rises as the reported torque of the opposite sign accounts for, within this share and the
bounds of J, shows an inverted polarity."""


class Signal(Enum):
    """A report of the drive."""

    SPEED = "reported speed"
    TORQUE = "reported torque"
    ANGLE = "reported position"
    ALL = "feedback"


@dataclass(frozen=True)
class Contradiction:
    """What does not fit: the first of a run stays. ``what`` is a sentence with values, ``helps`` the next step."""

    signals: frozenset[Signal]
    what: str
    helps: str
    time_s: float
    lighter: bool = False              # a smaller inertia explains it: a part of the load may be lost


class _Point:
    """Means over one block of cycles, with integrals up to its middle. Units: s, rad/s, N·m, N·m·s, rad."""

    __slots__ = (
        "friction_high", "friction_low", "impulse", "load_high", "load_low", "rough", "slope", "slope_high",
        "slope_low", "speed", "still", "time_s", "torque", "torque_high", "torque_least", "torque_low", "torque_most",
    )

    time_s: float
    speed: float
    still: float
    torque: float
    impulse: float
    rough: float
    friction_low: float
    friction_high: float
    slope: float
    slope_low: float
    slope_high: float
    torque_low: float
    torque_high: float
    torque_least: float
    torque_most: float
    load_low: float
    load_high: float


class Observer:
    """Compares the reports of one drive over one run; `see` takes every cycle, `doubt` says what does not fit."""

    def __init__(
        self,
        limits: MachineLimits,
        period_s: float,
        speed_resolution_rad_s: float,
        torque_resolution_nm: float = 0.0,
        assumptions: ControlAssumptions | None = None,
    ) -> None:
        assumptions = (assumptions or ControlAssumptions()).at_period(period_s)
        self._limits = limits
        self._period_s = period_s
        self._lag_s = assumptions.largest_speed_lag_s
        self._count_rad_s = speed_resolution_rad_s
        self._torque_count_nm = torque_resolution_nm
        self._point_s = max(POINT_S, period_s)
        self._still_rad_s = max(STILL_SHARE * limits.speed_max_rad_s, 3.0 * speed_resolution_rad_s)
        self._knowledge = _Knowledge(limits, self._lag_s)
        self._frozen = _Frozen(limits)
        self._torques = _TorqueMode(limits, self._lag_s)
        self._angles = _Angle(self._lag_s, speed_resolution_rad_s, self._still_rad_s)
        self._turns: Unwrapped | None = None
        self._runaway = _Runaway(limits)
        self._flat = _Flat(limits, self._lag_s)
        self._yielding: deque[tuple[float, float, float]] = deque()
        self._revival: _Revival | None = None
        self._angle_revival: _Revival | None = None
        self._failed = [0] * (len(WINDOWS_S) + 1)
        self.torque_offset_nm = 0.0
        """Reported torque where none flows, N·m."""
        self.swinging_offset_nm = 0.0
        """The largest torque offset that the stage may command in speed mode, N·m."""
        self.doubt: Contradiction | None = None
        self.backwards = False
        """Set by a stage that saw the shaft turn backwards under a forward torque: the sign of a report is inverted."""
        self._time_s = self._block_from_s = -math.inf
        self._speed = self._torque = self._before = 0.0
        self._impulse = self._rough = self._way = self._bent = 0.0
        self._friction_low = self._friction_high = 0.0
        self._cycles, self._sum_speed, self._sum_torque = 0, 0.0, 0.0
        self.demand_nm: float | None = None
        """The demanded torque, where the drive reports one, N·m."""
        self._shows_state = True
        self._way_of = 0               # the integral of speed begins anew with each restart
        self.worst = 0.0
        """The largest imbalance seen, as a share of what (1) allows; for studies."""
        self._unseen_nms = self._held_s = self._strained_s = 0.0
        self._unseen_nm = 0.0
        self._moved = False
        self._restart()

    # -- what is known ---------------------------------------------------------------------------------------

    def position(self, count_rad: float, gap_s: float) -> None:
        """Take what preflight found: one count of the position, and the gap after which its turns are not known, s."""
        self._angles.count_rad, self._angles.gap_s = count_rad, gap_s

    def compare_position(self, ratio: float) -> None:
        """From now on the position must move this many times as far as the reported speed accounts for."""
        self._angles.ratio = ratio
        self._angles.restart()

    def heard_position(self, now_s: float, within_s: float) -> bool:
        """Whether a position came within the last ``within_s``."""
        return now_s - self._angles.heard_s <= within_s

    def know(self, model: RigGuess) -> None:
        """Take J and friction of stage 2, with their uncertainty."""
        before = self._knowledge.words
        if not self._knowledge.know(model):
            self._doubt(
                frozenset({Signal.SPEED, Signal.TORQUE}),
                f"the way up to the first speed and the rest of stage 2 contradict each other: {before}, then"
                f" {self._knowledge.words}",
                "Did the scale of torque or speed change meanwhile, or the load? Check the profile and the encoder",
                self._time_s,
            )
        self._restart()

    @property
    def unseen_s(self) -> float:
        """How long a shaft whose motion was never reported may go on turning without torque, s; 0: motion was seen."""
        if self._moved or self._unseen_nm <= 0.0:
            return 0.0
        return min(UNSEEN_MOST_S, self._unseen_nms / (UNSEEN_SHARE * self._unseen_nm))

    @property
    def blind_s(self) -> float:
        """How long friction takes at most to stop what (1) cannot find, s."""
        return self._knowledge.blind_s(self._still_rad_s)

    @property
    def turned(self) -> bool:
        """Whether the shaft turned when the stop began, or shortly before it."""
        return self.turns(self._runaway.start_rad_s)

    @property
    def run_out_s(self) -> float:
        """How long the shaft turns on at most without torque, s."""
        return self._knowledge.run_out_s(self._runaway.start_rad_s)

    # -- each cycle ------------------------------------------------------------------------------------------

    def see(self, command: Command, sample: Sample) -> None:
        """Take one cycle: what was commanded, and what was reported."""
        self._shows_state = sample.state is not PowerState.UNKNOWN
        if not sample.fresh or not self._shows_state:
            return                     # feedback without a valid state shows nothing of the shaft
        frozen = self._frozen.see(command, sample, self.swinging_offset_nm)
        if frozen is not None and not self._runaway.begun:     # in a stop the setpoint jumps to zero at once
            self._doubt(frozenset({Signal.ALL}), *frozen, sample.time_s)
        speed, torque, now_s = sample.speed_rad_s, sample.torque_nm - self.torque_offset_nm, sample.time_s
        if not (math.isfinite(speed) and math.isfinite(torque)):
            return
        apart_s = now_s - self._time_s
        if not 0.0 < apart_s <= max(LONGEST_GAP_S, 3.0 * self._period_s):
            self._restart()
            self._time_s, self._speed, self._torque = now_s, speed, torque
            self._before = speed
            self._block_from_s = now_s
            if sample.position_rad is not None:
                self._see_angle(sample.position_rad, now_s, speed)
            return
        mean_nm, mean_rad_s = 0.5 * (torque + self._torque), 0.5 * (speed + self._speed)
        self._impulse += mean_nm * apart_s
        self._rough += 0.5 * abs(torque - self._torque) * apart_s
        self._way += mean_rad_s * apart_s
        bent = speed - 2.0 * self._speed + self._before
        self._bent += 0.005 * (min(bent * bent, 100.0 * self._bent + 9.0 * self._count_rad_s**2) - self._bent)
        self._before, self._speed, self._torque, self._time_s = self._speed, speed, torque, now_s
        self._cycles += 1
        self.demand_nm = sample.torque_demand_nm
        self._sum_speed += speed
        self._sum_torque += torque
        if sample.position_rad is not None:
            self._see_angle(sample.position_rad, now_s, speed)
        if now_s - self._block_from_s >= self._point_s - 0.5 * self._period_s:
            self._point(command, sample)

    def see_reading(self, reading: PositionReading) -> None:
        """Take a position that came beside the cycle."""
        if self._turns is None:
            self._turns = Unwrapped(reading.wraps_rad, self._limits.speed_max_rad_s)
            self._angles.restart()
        angle_rad = self._turns.take(reading.time_s, reading.position_rad)
        if angle_rad is None:
            self._angles.restart()
        else:
            self._see_angle(angle_rad, reading.time_s, self._speed)

    def expected(self, apart_rad_s: float, within_rad_s: float, sample: Sample) -> None:
        """Take how far the reported speed is from what a stage's own model of the shaft predicts, rad/s."""
        if sample.fresh and not abs(apart_rad_s) <= within_rad_s:
            self._doubt(
                frozenset({Signal.SPEED, Signal.TORQUE}),
                f"the reported speed does not do what the torque accounts for: it is {sample.speed_rad_s:.2f} rad/s,"
                f" {abs(apart_rad_s):.2f} rad/s away from the prediction (limit {within_rad_s:.2f} rad/s)",
                "Check the encoder and its cable. Check whether the torque is lost or limited, and whether this is the"
                " rig that was identified",
                sample.time_s,
            )

    def turns(self, speed_rad_s: float) -> bool:
        """Whether a reported speed is clearly not zero."""
        return abs(speed_rad_s) > 4.0 * self._still_rad_s

    def unanswered(self, speed_rad_s: float, torque_nm: float, for_s: float, time_s: float) -> None:
        """Take a reported speed that does not change under a braking torque at its limit."""
        self._doubt(
            frozenset({Signal.SPEED}),
            f"the reported speed stays at {speed_rad_s:.2f} rad/s while {torque_nm:.0f} N·m, the torque limit, brake"
            f" the shaft for {for_s:.0f} s",
            "Check the encoder and its cable. Do not rely on the reported speed", time_s,
        )

    # -- standstill ------------------------------------------------------------------------------------------

    def speed_rad_s(self, sample: Sample) -> float:
        """The speed to judge a stop by: of the angle where the reported speed is in doubt and the angle is not."""
        rate = self.rate_rad_s
        return sample.speed_rad_s if rate is None or not self._position_lives else rate

    @property
    def _position_lives(self) -> bool:
        """Whether the position went on after a contradiction, and so may stand in for the speed."""
        return self._angle_revival is not None and self._angle_revival.alive and self.rate_rad_s is not None

    @property
    def moved(self) -> bool:
        """Whether the shaft was ever reported to move."""
        return self._moved

    @property
    def rate_rad_s(self) -> float | None:
        """Speed by the position, rad/s; None where too little has been reported, or nothing of late."""
        return self._angles.rate_rad_s if self.heard_position(self._time_s, STALE_S) else None

    @property
    def comes_down(self) -> bool:
        """Whether a speed in doubt has come down since as a shaft does under a quick stop."""
        seen = (self._revival, self._angle_revival)
        return any(one is not None and one.falling and one.is_fresh(self._time_s) for one in seen)

    @property
    def believable(self) -> bool:
        """Whether a report of standstill counts: nothing contradicts it, or what contradicted it has been refuted."""
        doubt = self.doubt
        if doubt is None or Signal.ALL in doubt.signals or Signal.SPEED not in doubt.signals:
            return True
        if self._position_lives:
            return True
        return self._revival is not None and self._revival.alive and self._balanced

    def rest_rad_s(self, at_rest_rad_s: float) -> float:
        """The speed that counts as standstill, rad/s: less once a report was in doubt, since its scale may be wrong."""
        if self.doubt is None:
            return at_rest_rad_s
        return min(at_rest_rad_s, max(DOUBTED_REST_SHARE * at_rest_rad_s, self._noise_rad_s()))

    def angle_quiet(self, at_rest_rad_s: float) -> bool:
        """Whether the angle moves no faster than this, rad/s; true where no angle is reported."""
        rate = self.rate_rad_s
        return rate is None or abs(rate) <= at_rest_rad_s + self._angles.blur_rad_s

    @property
    def _balanced(self) -> bool:
        """Whether the torque at reported standstill is too small to keep the shaft turning against its friction."""
        points = self._points
        if self._limits.winds_up or not points:
            return True
        return abs(points[-1].torque) <= 0.5 * self._knowledge.breakaway_low_nm + 5.0 * self._torque_count_nm

    # -- a stop that does not stop -----------------------------------------------------------------------------

    def begin_stop(self) -> None:
        """A quick stop was asked for: from now on the shaft must become slower."""
        self._runaway.begin(self._earlier_rad_s())

    def shows_s(self, at_rest_rad_s: float, torque_nm: float) -> float:
        """How long a shaft that is disabled must be seen at rest, s; ``torque_nm``: what held it before.

        A torque like that of friction may have kept the shaft turning, by a speed signal that is off by so much.
        Without it the reported speed then leaves standstill at friction's rate.
        """
        return self._knowledge.shows_s(at_rest_rad_s, torque_nm)

    def runs_away(self, sample: Sample) -> str:
        """How the shaft accelerates against the quick stop, seen in two independent ways; empty: it does not."""
        return self._runaway.seen(self, sample) if self._shows_state else ""

    # -- inside ----------------------------------------------------------------------------------------------

    def _restart(self) -> None:
        """Forget the samples, keep what is known."""
        self._points: deque[_Point] = deque(maxlen=2 + math.ceil((WINDOWS_S[-1] + AROUND_S) / self._point_s))
        self._loads: deque[float] = deque(maxlen=2 + math.ceil(LOAD_BEFORE_S / self._point_s))
        self._time_s = -math.inf
        self._speed = self._torque = self._before = 0.0
        self._impulse = self._rough = self._way = self._bent = 0.0
        self._friction_low = self._friction_high = 0.0
        self._cycles, self._sum_speed, self._sum_torque = 0, 0.0, 0.0
        self._block_from_s = -math.inf
        self._failed = [0] * (len(WINDOWS_S) + 1)
        self._way_of += 1

    def _point(self, command: Command, sample: Sample) -> None:
        block_s = sample.time_s - self._block_from_s
        point = _Point()
        point.time_s = sample.time_s - 0.5 * block_s
        point.speed = self._sum_speed / self._cycles
        point.torque = self._sum_torque / self._cycles
        point.impulse = self._impulse - 0.5 * block_s * point.torque
        point.rough = self._rough
        known = self._knowledge
        self._around(point, command)
        # A late speed still falls when the shaft stands already and its static friction takes any torque.
        point.still = self._still_rad_s + self._lag_s * abs(point.slope)
        low, high = known.friction(point.speed, point.still)
        self._friction_low += low * block_s
        self._friction_high += high * block_s
        point.friction_low = self._friction_low - 0.5 * block_s * low
        point.friction_high = self._friction_high - 0.5 * block_s * high
        self._load(point)
        self._block_from_s, self._cycles, self._sum_speed, self._sum_torque = sample.time_s, 0, 0.0, 0.0
        self._points.append(point)
        known.learn(self._points)
        self._note_unseen(point, sample, block_s)
        if self._revival is not None:
            self._revival.see(point.time_s, point.speed)
        if self._angle_revival is not None and (rate := self._angles.rate_rad_s) is not None:
            self._angle_revival.see(point.time_s, rate)
        self._runaway.see(point, known, self)
        if abs(point.torque) > BEYOND_LIMIT * self._limits.torque_nm:
            self._doubt(
                frozenset({Signal.TORQUE}),
                f"the reported torque of {point.torque:.0f} N·m is beyond the torque limit of"
                f" {self._limits.torque_nm:g} N·m",
                "Check the units of torque in the profile and the rated torque", point.time_s,
            )
        if sample.state in (PowerState.ENABLED, PowerState.QUICK_STOP):
            self._compare(point, sample)
            self._see_held(point, command, block_s)
        if (apart := self._torques.see(command, sample, self.torque_offset_nm, block_s)) is not None:
            self._doubt(frozenset({Signal.TORQUE}), *apart, sample.time_s)

    def _around(self, point: _Point, command: Command) -> None:
        """Slope, and bounds of slope and torque within `AROUND_S`."""
        points = self._points
        point.slope = 0.0
        for before in reversed(points):
            if point.time_s - before.time_s >= SLOPE_S - 0.5 * self._point_s:
                point.slope = (point.speed - before.speed) / (point.time_s - before.time_s)
                break
        slopes, torques = [point.slope], [point.torque]
        if command.mode is Mode.TORQUE:
            torques.append(command.torque_nm)
        for before in reversed(points):
            if point.time_s - before.time_s > AROUND_S + 0.5 * self._point_s:
                break
            slopes.append(before.slope)
            torques.append(before.torque)
        point.slope_low, point.slope_high = min(slopes), max(slopes)
        point.torque_low, point.torque_high = min(torques), max(torques)
        limit_nm = self._limits.torque_nm
        # In speed mode the torque may have moved faster than its report shows: by a quarter of the limit.
        hidden_nm = HIDDEN_SHARE * limit_nm
        point.torque_least = max(-limit_nm, min(torques) - hidden_nm)
        point.torque_most = min(limit_nm, max(torques) + hidden_nm)
        if command.mode is Mode.TORQUE:
            point.torque_least, point.torque_most = min(torques[:2]), max(torques[:2])

    def _load(self, point: _Point) -> None:
        """Bounds of what a drill string takes, from the torque of the time before, less what accelerated the shaft."""
        point.load_low = point.load_high = 0.0
        if not self._limits.winds_up:
            return
        accelerating_nm = self._knowledge.likely_inertia * point.slope if self._knowledge.known else 0.0
        self._loads.append(point.torque - accelerating_nm)
        middle = 0.5 * (max(self._loads) + min(self._loads))
        half = LOAD_RANGE * (max(self._loads) - min(self._loads))
        margin = half + FRICTION_LIMIT_SHARE * self._limits.torque_nm
        point.load_low, point.load_high = middle - margin, middle + margin

    def _note_unseen(self, point: _Point, sample: Sample, block_s: float) -> None:
        if self._moved:
            return
        if abs(point.speed) > 2.0 * self._still_rad_s or self._angles.moved:
            self._moved = True
            self._knowledge.breakaway_nm = max(self._unseen_nm, abs(point.torque))
            self._points.clear()       # what held the shaft before is not known
            self._points.append(point)
        elif sample.state is PowerState.ENABLED:
            self._unseen_nms += abs(point.torque) * block_s
            self._unseen_nm = max(self._unseen_nm, abs(point.torque))

    def _see_held(self, point: _Point, command: Command, block_s: float) -> None:
        """Standstill is reported in spite of a speed setpoint and all the torque there is, of a shaft that moved."""
        asked = command.mode is Mode.SPEED and abs(command.speed_rad_s) > 4.0 * self._still_rad_s
        strained = abs(point.torque) >= AT_LIMIT_SHARE * self._limits.torque_nm
        self._see_strained(point, command, strained, block_s)
        self._see_flat(point, command, strained)
        self._see_yielding(point, command)
        held = self._moved and asked and strained and abs(point.speed) <= self._still_rad_s
        self._held_s = self._held_s + block_s if held else 0.0
        if self._held_s >= HELD_S:
            self._doubt(
                frozenset({Signal.SPEED}),
                f"the drive reports standstill for {self._held_s:.1f} s while {point.torque:.0f} N·m, its torque limit,"
                f" act and {command.speed_rad_s:.2f} rad/s are commanded",
                "Is the shaft held (brake, stuck pipe), or is the speed signal lost? Look at the shaft", point.time_s,
            )

    def _see_strained(self, point: _Point, command: Command, strained: bool, block_s: float) -> None:
        """The torque stays at its limit although the reported speed is the commanded one: nothing asks for it."""
        apart = abs(point.speed - command.speed_rad_s)
        near = command.mode is Mode.SPEED and apart <= STRAINED_SHARE * self._limits.speed_max_rad_s
        near = near and self._limits.winds_up and not self._knowledge.known        # else (1) shows it
        self._strained_s = self._strained_s + block_s if strained and near and self.turns(point.speed) else 0.0
        if self._strained_s >= STRAINED_S:
            self._doubt(
                frozenset({Signal.SPEED, Signal.TORQUE}),
                f"the torque has been at its limit for {STRAINED_S:g} s ({point.torque:.0f} N·m) while the reported"
                f" speed stays at {point.speed:.2f} rad/s, near the commanded {command.speed_rad_s:.2f} rad/s",
                "Check the encoder and its cable. Is the load as large as the torque limit?", point.time_s,
            )

    def _see_flat(self, point: _Point, command: Command, strained: bool) -> None:
        """Above a string (1) bounds too little: a speed that does not answer shows by staying the same."""
        if not self._limits.winds_up:
            return
        noise = 2.0 * self._noise_rad_s()
        for_s = self._flat.see(point, command, noise, strained, self._knowledge)
        if for_s > 0.0 and self.turns(point.speed):
            self._doubt(
                frozenset({Signal.SPEED}),
                f"the reported speed has stayed at {point.speed:.2f} rad/s to within its noise for {for_s:.1f} s, while"
                f" the torque went to {point.torque:.0f} N·m, which moves this shaft",
                "Check the encoder and its cable. Is the load as large as the torque limit?", point.time_s,
            )

    def _see_yielding(self, point: _Point, command: Command) -> None:
        """In a stop above a string: whether the shaft goes the way that it is told to yield."""
        seen = self._yielding
        if not (self._runaway.begun and self._limits.winds_up and command.mode is Mode.SPEED):
            seen.clear()
            return
        seen.append((point.time_s, command.speed_rad_s, point.speed))
        while point.time_s - seen[0][0] > YIELD_S:
            seen.popleft()
        if point.time_s - seen[0][0] < YIELD_S - 2.0 * self._point_s:
            return
        # What was told last has not been answered yet, and what changes from cycle to cycle is torque noise.
        until_s = point.time_s - 2.0 * self._lag_s
        told = _means([(time_s, one) for time_s, one, _ in seen if time_s <= until_s], SMOOTH_S)
        went = [one for _, _, one in seen]
        mean = math.fsum(abs(one) for one in told) / max(1, len(told))
        told_range, went_range = max(told) - min(told), max(went) - min(went)
        noise = max(self._noise_rad_s(), YIELD_LEFT * told_range)
        clear = max(YIELD_STILL * self._still_rad_s, YIELD_MOVES * noise)
        stands = math.fsum(abs(one) for one in went) / len(went) <= YIELD_STANDS * mean
        if stands and mean > clear and went_range <= noise:
            self._doubt(
                frozenset({Signal.SPEED}),
                f"the shaft is told to yield to the drill string, with {min(told):.2f} to {max(told):.2f} rad/s within"
                f" {YIELD_S:g} s, and the reported speed stays at {point.speed:.2f} rad/s",
                "Check the encoder and its cable. Is the shaft held by a brake?", point.time_s,
            )

    def _noise_rad_s(self) -> float:
        """Noise of a point's speed, rad/s."""
        per_point = max(1.0, self._point_s / self._period_s)
        return NOISE_SDS * math.sqrt(self._bent / 6.0 / per_point) + self._count_rad_s

    def _compare(self, now: _Point, sample: Sample) -> None:
        known = self._knowledge
        if not known.testable:
            return
        if known.inertia_low > 0.0 and self._test(0, self._too_steep(now)):
            before = min(self._points, key=lambda one: abs(now.time_s - SLOPE_S - one.time_s))
            self._doubt_balance(now, before, lighter=True)
        points, around = self._points, math.ceil(AROUND_S / self._point_s)
        last = len(points) - 1
        for number, window_s in enumerate(WINDOWS_S[:-1] if known.known else WINDOWS_S, 1):
            back = max(around, round(window_s / self._point_s))
            if back > last:
                break
            start, after = points[last - back], points[min(last, last - back + around)]
            share = self._imbalance(start, after, now, (known.inertia_low, known.inertia_high))
            self.worst = max(self.worst, share)
            lightest = (LIGHTER_SHARE * known.inertia_low,)
            if self._test(number, share):
                lighter = self._imbalance(start, after, now, lightest) <= 1.0
                self._doubt_balance(now, start, lighter=lighter)

    def _test(self, number: int, share: float) -> bool:
        """Count a test that failed; whether it has failed often enough."""
        self._failed[number] = self._failed[number] + 1 if share > 1.0 else 0
        return self._failed[number] >= IN_A_ROW

    def _too_steep(self, now: _Point) -> float:
        """Slope of the reported speed over what (2) allows."""
        known, limits, points = self._knowledge, self._limits, self._points
        recent = [point for point in points if now.time_s - point.time_s <= MEMORY_S]
        if now.time_s - points[0].time_s < MEMORY_S:
            least_nm, most_nm = -limits.torque_nm, limits.torque_nm
        else:
            least_nm = min(point.torque_least for point in recent)
            most_nm = max(point.torque_most for point in recent)
        fastest = max(abs(point.speed) for point in recent)
        if limits.winds_up:            # a string; its rough inertia has a wide interval already
            load_low, load_high = recent[0].load_low, recent[0].load_high
            lightest = known.inertia_low
        else:
            load_high = known.friction(fastest, 0.0)[1]
            load_low, lightest = -load_high, LIGHTEST_SHARE * known.inertia_low
        most_nm = most_nm - load_low if now.slope > 0.0 else load_high - least_nm
        most = STEEPEST * max(0.0, most_nm) / lightest
        return abs(now.slope) / (most + 2.0 * self._noise_rad_s() / SLOPE_S)

    def _imbalance(self, start: _Point, after: _Point, now: _Point, inertias: tuple[float, ...]) -> float:
        """Imbalance of (1) over what it allows, for the J that explains most; (1) is linear in J, so bounds will do."""
        known, lag_s = self._knowledge, self._lag_s
        change = now.speed - start.speed
        impulse = now.impulse - start.impulse
        window_s = now.time_s - start.time_s
        friction_low, friction_high = now.friction_low - start.friction_low, now.friction_high - start.friction_high
        if self._limits.winds_up:
            swing = known.string_nm_s_rad * (abs(change) + abs(now.slope_high - now.slope_low) * lag_s) * window_s
            friction_low, friction_high = start.load_low * window_s - swing, start.load_high * window_s + swing
        rough = now.rough - start.rough + self._torque_count_nm * window_s
        noise = self._noise_rad_s()
        surplus_low, surplus_high = known.surplus(now)
        was_surplus_low, was_surplus_high = known.surplus(after)
        opposed, was_opposed = now.torque_high - surplus_high, after.torque_high - was_surplus_high
        too_low = too_high = math.inf
        for inertia in inertias:
            imbalance = inertia * change - impulse
            # Torque that accelerates the shaft, N·m, at both ends: by the slope, and by the torque less friction.
            rate_low = min(inertia * now.slope_low, surplus_low)
            rate_high = max(inertia * now.slope_high, surplus_high)
            from_low = min(inertia * after.slope_low, was_surplus_low)
            from_high = max(inertia * after.slope_high, was_surplus_high)
            torque_low = min(now.torque_low, inertia * now.slope_low + opposed)
            torque_high = max(now.torque_high, inertia * now.slope_high + opposed)
            was_low = min(after.torque_low, inertia * after.slope_low + was_opposed)
            was_high = max(after.torque_high, inertia * after.slope_high + was_opposed)
            faster, slower = max(0.0, rate_high - from_low), min(0.0, rate_low - from_high)
            more, less = max(0.0, torque_high - was_low), min(0.0, torque_low - was_high)
            room = rough + inertia * noise
            below = room + lag_s * (faster - less)
            above = room + lag_s * (more - slower)
            too_low = min(too_low, -(imbalance + friction_high) / below)
            too_high = min(too_high, (imbalance + friction_low) / above)
        return max(too_low, too_high)

    def _earlier_rad_s(self) -> float:
        """The reported speed of `BEFORE_S` ago, rad/s: what a contradiction hides has hardly begun then."""
        return next((point.speed for point in self._points if self._time_s - point.time_s <= BEFORE_S), 0.0)

    def _see_angle(self, position_rad: float, now_s: float, speed_rad_s: float) -> None:
        # A position that comes while the cycle brings nothing has no way by the reported speed to be compared with.
        covered = now_s - self._time_s <= max(0.1, 2.0 * self._period_s)
        way = _Way(self._way_of if covered else -1, self._way, speed_rad_s)
        apart = self._angles.see(position_rad, now_s, way, self._noise_rad_s())
        if apart is not None and self._frozen.repeats_s(now_s) >= 0.4 * FROZEN_S and self._angles.repeats:
            self._doubt(frozenset({Signal.ALL}), *self._frozen.words("and the position with them"), now_s)
        elif apart is not None:
            self._doubt(
                frozenset({Signal.SPEED, Signal.ANGLE}), apart,
                "Check the encoder, its cable, and the units of 606Ch and 6064h (or of the registers)", now_s,
            )

    def _doubt_balance(self, now: _Point, start: _Point, *, lighter: bool) -> None:
        """A smaller inertia explains a speed that grows with the torque, and not one that is gone."""
        lighter = lighter and abs(now.speed) > abs(start.speed) and now.speed * max(start.torque, now.torque) > 0.0
        went = (
            f"within {now.time_s - start.time_s:.2g} s the reported speed went from {start.speed:.2f} to"
            f" {now.speed:.2f} rad/s at {start.torque:.1f} to {now.torque:.1f} N·m"
        )
        if lighter:
            what = f"the speed changes faster than this shaft ({self._knowledge.words}) allows: {went}"
            helps = "Was the load lost? Check the coupling, and the encoder and its cable"
        else:
            what = (
                f"reported speed and torque contradict each other: {went}, which this shaft ({self._knowledge.words})"
                " does not do"
            )
            helps = (
                "Check the encoder and its cable, and whether a brake or a changed torque scale acts. Do not rely on"
                " the reported speed"
            )
        self._doubt(frozenset({Signal.SPEED, Signal.TORQUE}), what, helps, now.time_s, lighter=lighter)

    def _doubt(
        self, signals: frozenset[Signal], what: str, helps: str, time_s: float, *, lighter: bool = False
    ) -> None:
        if self.doubt is not None:
            return
        self.doubt = Contradiction(signals, what, helps, time_s, lighter)
        slope, still = self._limits.quick_stop_rad_s2, self._still_rad_s
        recent = [point for point in self._points if time_s - point.time_s <= BEFORE_S]
        steady = True
        if recent:
            fastest = max(recent, key=lambda point: abs(point.speed))
            braked = RAMP_SLACK * slope * (recent[-1].time_s - fastest.time_s) if self._runaway.begun else 0.0
            steady = abs(recent[-1].speed) >= KEPT_SHARE * abs(fastest.speed) - braked
        self._revival = _Revival(steady, time_s + max(ALIVE_S, ALIVE_LAGS * self._lag_s), slope, still)
        self._angle_revival = _Revival(steady, time_s + ALIVE_S, slope, still + self._angles.blur_rad_s)


class _Knowledge:
    """Bounds of inertia and friction, as far as they are known.

    First comes the torque under which the shaft became faster: friction is no more than that. Then the first steady
    level, whose mean torque is the friction there, with the ramp that led to it: both give bounds of the inertia. In
    the end stage 2's rough model.
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
        """The largest torque before the shaft first moved, N·m: static friction is no more."""
        self.inertia_low, self.inertia_high = 0.0, math.inf
        self.string_nm_s_rad = limits.wave_impedance_nm_s_rad or (
            limits.torque_nm / STIFFEST_STRING_S
        )

    def know(self, model: RigGuess) -> bool:
        """Take stage 2's rough model; whether it agrees with what the first ramp showed.

        A part of the load may hang on a shaft that twists, so J may seem smaller.
        """
        self._model = model
        error = model.inertia_rel_error
        least = min(1.0 - min(error, 0.75), 1.0 - FRICTION_SHARE)
        learned_low, learned_high = LIGHTEST_SHARE * self.inertia_low, self.inertia_high
        self.inertia_low = least * model.inertia_kg_m2
        self.inertia_high = (1.0 + error) * model.inertia_kg_m2
        return self.inertia_high >= learned_low and self.inertia_low <= learned_high

    @property
    def known(self) -> bool:
        """Whether J and friction come from stage 2."""
        return self._model is not None

    @property
    def testable(self) -> bool:
        """Whether (1) says anything: with a string only once J is known."""
        return self.known or (self._friction_most > 0.0 and math.isfinite(self.inertia_high))

    @property
    def likely_inertia(self) -> float:
        """Stage 2's estimate, kg·m²; before it the upper bound."""
        return self.inertia_high if self._model is None else self._model.inertia_kg_m2

    @property
    def words(self) -> str:
        """The bounds, for people."""
        if self.inertia_low == 0.0:
            return f"J up to {self.inertia_high:.3g} kg·m²"
        return f"J {self.inertia_low:.3g} to {self.inertia_high:.3g} kg·m²"

    @property
    def breakaway_low_nm(self) -> float:
        """The least torque that keeps the shaft turning slowly, N·m; before stage 2 ends by what moved it first."""
        if self._model is None:
            return self.breakaway_nm / SLOW_FRICTION
        return (1.0 - FRICTION_SHARE) * self._model.coulomb_nm

    @property
    def pushing_nm(self) -> float:
        """More torque than friction takes within the speed limit, N·m."""
        return self.friction(self._limits.speed_max_rad_s, 0.0)[1]

    def friction(self, speed_rad_s: float, still_rad_s: float) -> tuple[float, float]:
        """Least and greatest torque that opposes the motion, N·m; at standstill it has either sign."""
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

    def surplus(self, point: _Point) -> tuple[float, float]:
        """Torque that is left to accelerate the shaft, N·m, least and greatest, with the likeliest friction."""
        low, high = self.friction(point.speed, point.still)
        if abs(point.speed) <= point.still:
            return tuple(one - max(low, min(high, one)) for one in (point.torque_low, point.torque_high))  # type: ignore[return-value]
        usual = 0.5 * (low + high)
        return point.torque_low - usual, point.torque_high - usual

    def learn(self, points: deque[_Point]) -> None:
        """Take what the points so far show, before stage 2 ends; above a string they show nothing."""
        done = self._model is not None or self._level is not None
        if done or self._limits.winds_up or self.breakaway_nm <= 0.0 or len(points) < 3:
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

    def _see_level(self, points: deque[_Point]) -> None:
        """A first steady level behind a ramp: its friction, and the inertia that the ramp leaves."""
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

    def run_out_s(self, speed_rad_s: float) -> float:
        """How long friction alone takes at most from this speed to standstill, s.

        From J dω/dt = −s (T_c + B ω): t = J/(s B) ln(1 + B ω/T_c), with s = `RUN_OUT_SHARE`.
        """
        model, speed = self._model, abs(speed_rad_s)
        if model is None or model.coulomb_nm <= 0.0:
            return RUN_OUT_MOST_S
        ratio = model.viscous_nm_s_rad * speed / model.coulomb_nm
        # ln(1 + x)/x: 1 without viscous friction
        by_viscous = math.log1p(ratio) / ratio if ratio > 1e-6 else 1.0
        took_s = self.inertia_high * speed / (RUN_OUT_SHARE * model.coulomb_nm) * by_viscous
        return min(RUN_OUT_MOST_S, took_s)

    def shows_s(self, at_rest_rad_s: float, torque_nm: float) -> float:
        """See `Observer.shows_s`."""
        model = self._model
        if model is None or self._limits.winds_up or abs(torque_nm) <= 0.5 * self.breakaway_low_nm:
            return 0.0
        return 2.0 * at_rest_rad_s * self.inertia_high / (RUN_OUT_SHARE * model.coulomb_nm)

    def blind_s(self, still_rad_s: float) -> float:
        """How long friction takes at most to stop what (1) cannot find, s."""
        model = self._model
        if model is None or self._limits.winds_up or self.breakaway_low_nm <= 0.0:
            return 0.0
        # A lag hides lag·ΔT of impulse; while a shaft comes to rest the torque changes by about its friction.
        hidden_nms = self._lag_s * 2.0 * model.steady_torque_nm(self._limits.speed_min_rad_s)
        return min(BLIND_MOST_S, hidden_nms / self.breakaway_low_nm)


def _means(values: list[tuple[float, float]], over_s: float) -> list[float]:
    """Means of (time, value) over so long each, s."""
    blocks: dict[int, list[float]] = {}
    for time_s, value in values:
        blocks.setdefault(math.floor((time_s - values[0][0]) / over_s), []).append(value)
    return [math.fsum(block) / len(block) for block in blocks.values()]


class _Flat:
    """A reported speed that stays the same, and the torque meanwhile. `MachineLimits.winds_up` only."""

    def __init__(self, limits: MachineLimits, lag_s: float) -> None:
        self._limits = limits
        self._lag_s = lag_s
        self._since_s: float | None = None
        self._low = self._high = self._least = self._most = self._began = self._moved = self._seen_s = 0.0
        self._strained_s = 0.0

    def see(self, point: _Point, command: Command, noise_rad_s: float, strained: bool, known: _Knowledge) -> float:
        """Take one point; for how long the speed has not answered, s; 0: it may well have."""
        torque = command.torque_nm if command.mode is Mode.TORQUE else point.torque
        low, high = min(self._low, point.speed), max(self._high, point.speed)
        if self._since_s is None or high - low > noise_rad_s:
            self._since_s = self._seen_s = point.time_s
            self._low = self._high = point.speed
            self._least = self._most = self._began = torque
            self._moved = self._strained_s = 0.0
            return 0.0
        took_s, self._seen_s = point.time_s - self._seen_s, point.time_s
        self._low, self._high = low, high
        self._least, self._most = min(self._least, torque), max(self._most, torque)
        self._strained_s = self._strained_s + took_s if strained else 0.0
        for_s = point.time_s - self._since_s
        if command.mode is Mode.SPEED:
            self._began, self._least, self._most, self._moved = torque, torque, torque, 0.0
            return for_s if self._strained_s >= FLAT_LIMIT_S else 0.0
        self._moved += took_s * (torque - self._began)
        if not known.known or for_s < FLAT_S + FLAT_LAGS * self._lag_s:
            return 0.0
        moves = FLAT_MOVES * noise_rad_s
        by_inertia = abs(self._moved) / known.inertia_high
        by_string = (self._most - self._least) / known.string_nm_s_rad
        return for_s if min(by_inertia, by_string) >= moves else 0.0


class _Frozen:
    """Feedback that repeats its last values, as a gateway does."""

    def __init__(self, limits: MachineLimits) -> None:
        self._limits = limits
        self._seen: tuple[float, float] | None = None
        self._mode: Mode | None = None
        self._since_s = self._lowest = self._highest = 0.0

    def see(self, command: Command, sample: Sample, offset_nm: float) -> tuple[str, str] | None:
        """What happened and what helps, once it has lasted; None else."""
        seen, torque_mode = (sample.speed_rad_s, sample.torque_nm), command.mode is Mode.TORQUE
        with_offset = offset_nm > 0.0 and not torque_mode
        setpoint = command.torque_nm if torque_mode else command.speed_rad_s
        limit = self._limits.torque_nm if torque_mode else self._limits.speed_max_rad_s
        if with_offset:
            setpoint, limit = command.torque_offset_nm, offset_nm
        if seen != self._seen or command.mode is not self._mode or sample.limit_active:
            self._seen, self._mode, self._since_s = seen, command.mode, sample.time_s
            self._lowest = self._highest = setpoint
            return None
        self._lowest, self._highest = min(self._lowest, setpoint), max(self._highest, setpoint)
        if self._highest - self._lowest <= FROZEN_SHARE * limit or self.repeats_s(sample.time_s) < FROZEN_S:
            return None
        return self.words("while the setpoint moved")

    def repeats_s(self, now_s: float) -> float:
        """For how long speed and torque have not changed, s."""
        return 0.0 if self._seen is None else now_s - self._since_s

    def words(self, besides: str) -> tuple[str, str]:
        """What happened, and what helps."""
        speed_rad_s, torque_nm = self._seen or (math.nan, math.nan)
        return (
            f"the feedback has been frozen at {speed_rad_s:.3f} rad/s and {torque_nm:.1f} N·m for {FROZEN_S:g} s,"
            f" {besides}",
            "Does a gateway repeat old values? Check the bus and the drive; is the shaft locked?",
        )


class _TorqueMode:
    """Mean reported torque beside mean commanded torque, in torque mode."""

    def __init__(self, limits: MachineLimits, lag_s: float) -> None:
        self._limits = limits
        self._lag_s = lag_s
        self._reset()

    def _reset(self) -> None:
        self._blocks: deque[tuple[float, float, float]] = deque()
        self._seconds = 0.0

    def see(self, command: Command, sample: Sample, offset_nm: float, block_s: float) -> tuple[str, str] | None:
        """What happened and what helps, where they differ; None else."""
        enabled = sample.state is PowerState.ENABLED
        if command.mode is not Mode.TORQUE or sample.mode is not Mode.TORQUE or sample.limit_active or not enabled:
            self._reset()
            return None
        self._blocks.append((block_s, command.torque_nm, sample.torque_nm - offset_nm))
        self._seconds += block_s
        if self._seconds < TORQUE_WINDOW_S:
            return None
        while self._seconds - self._blocks[0][0] >= TORQUE_WINDOW_S:
            self._seconds -= self._blocks.popleft()[0]
        commanded = math.fsum(part * one for part, one, _ in self._blocks) / self._seconds
        reported = math.fsum(part * one for part, _, one in self._blocks) / self._seconds
        values = [one for _, one, _ in self._blocks]
        size = math.fsum(part * abs(one) for part, one, _ in self._blocks) / self._seconds
        late = self._lag_s * (max(values) - min(values)) / self._seconds
        if abs(reported - commanded) <= TORQUE_SHARE * size + TORQUE_LIMIT_SHARE * self._limits.torque_nm + late:
            return None
        demand = sample.torque_demand_nm
        demanded = "" if demand is None else f", the demanded torque {demand:.1f} N·m"
        return (
            f"the reported torque contradicts the commanded torque: over {self._seconds:.1f} s of torque mode"
            f" {commanded:.1f} N·m were commanded in the mean and {reported:.1f} N·m reported{demanded}",
            "Check the units of torque in the profile (per_lsb of 6071h and 6077h) and the rated torque. J is wrong by"
            " as much as the reported torque",
        )


class _Way(NamedTuple):
    """Way by the reported speed, rad, of which stretch without a gap, and the speed at its end, rad/s."""

    stretch: int
    way_rad: float
    speed_rad_s: float


class _Angle:
    """The reported angle beside the way by the reported speed."""

    def __init__(self, lag_s: float, count_rad_s: float, still_rad_s: float) -> None:
        self._lag_s = lag_s
        self._still_rad_s = still_rad_s
        self._count_rad_s = count_rad_s
        self.count_rad, self.gap_s = 0.0, math.inf
        self.ratio: float | None = None
        self.heard_s = -math.inf
        self.moved = False
        self.restart()

    def restart(self) -> None:
        self._seen: deque[tuple[float, float, _Way]] = deque()
        self._apart = 0

    @property
    def rate_rad_s(self) -> float | None:
        """Speed by the angle over the last half second, rad/s; None where too little has been reported."""
        if len(self._seen) < 2:
            return None
        last = self._seen[-1]
        first = next((one for one in self._seen if last[0] - one[0] <= 1.01 * ANGLE_WINDOW_S[0]), last)
        took_s = last[0] - first[0]
        return (last[1] - first[1]) / took_s if took_s >= 0.4 * ANGLE_WINDOW_S[0] else None

    @property
    def repeats(self) -> bool:
        """Whether the last two positions are the same."""
        return len(self._seen) >= 2 and self._seen[-1][1] == self._seen[-2][1]

    @property
    def blur_rad_s(self) -> float:
        """What a count of the angle leaves open of that speed, rad/s."""
        return self.count_rad / ANGLE_WINDOW_S[0]

    def see(self, position_rad: float, time_s: float, way: _Way, noise_rad_s: float) -> str | None:
        """In words, how the angle contradicts the speed; None: it does not."""
        seen = self._seen
        if seen and time_s <= seen[-1][0]:
            return None
        if time_s - self.heard_s > self.gap_s:
            self.restart()
            seen = self._seen
        self.heard_s = time_s
        seen.append((time_s, position_rad, way))
        self.moved = self.moved or abs(position_rad - seen[0][1]) > max(10.0 * self.count_rad, MOVED_RAD)
        while time_s - seen[0][0] > ANGLE_WINDOW_S[1]:
            seen.popleft()
        first = seen[0]
        took_s = time_s - first[0]
        if took_s < ANGLE_WINDOW_S[0] or self.ratio is None or way.stretch < 0 or way.stretch != first[2].stretch:
            return None
        turned, reported = position_rad - first[1], self.ratio * (way.way_rad - first[2].way_rad)
        speeds = [one[2].speed_rad_s for one in seen]
        late = abs(self.ratio) * self._lag_s * (max(speeds) - min(speeds))
        allowed = (
            late + 2.0 * self.count_rad + ANGLE_SHARE * max(abs(turned), abs(reported))
            + took_s * (0.5 * self._count_rad_s + 0.1 * noise_rad_s + self._still_rad_s)
        )
        self._apart = self._apart + 1 if abs(turned - reported) > allowed else 0
        if self._apart < IN_A_ROW:
            return None
        return (
            f"reported position and reported speed contradict each other: within {took_s:.1f} s the position moved by"
            f" {turned:.2f} rad, and the reported speed accounts for {reported:.2f} rad"
        )


class _Revival:
    """Whether a speed lives after a contradiction: it comes down as a shaft does under a quick stop.

    Either it had not fallen before the contradiction, and falls no faster than twice the quick stop's rate. Or it still
    turns at ``from_s``, when every lag has run out, and comes down gradually from there. A lost signal falls at once, a
    frozen one never.
    """

    def __init__(self, steady: bool, from_s: float, stop_rad_s2: float, still_rad_s: float) -> None:
        self._from_s = from_s
        self._stop_rad_s2 = stop_rad_s2
        self._still_rad_s = still_rad_s
        self._first: tuple[float, float] | None = None         # time, speed
        self._start: tuple[float, float] | None = None         # time, speed at ``from_s``
        self._last: deque[tuple[float, float]] = deque(maxlen=4)
        self._steady = steady          # it had not fallen before the contradiction, but along the stop's ramp
        self.alive = False
        self.falling = False
        """Whether the speed comes down as under a quick stop, so far."""

    def see(self, time_s: float, speed_rad_s: float) -> None:
        """Take one point."""
        speed = abs(speed_rad_s)
        if self._first is None:
            self._first = time_s, speed
        self._last.append((time_s, speed))
        fell, took_s = self._last[0][1] - speed, time_s - self._last[0][0]
        if fell > FALL * self._stop_rad_s2 * took_s + 2.0 * self._still_rad_s:
            self._steady = False
        first_s, first = self._first
        braked = ALIVE_SHARE * self._stop_rad_s2 * (time_s - first_s - ALIVE_S)
        turned = first > 4.0 * self._still_rad_s       # a signal that shows zero from the first does not come down
        self.falling = self._steady and turned and speed <= max(first - braked, 0.0) + 2.0 * self._still_rad_s
        if self._start is None and time_s >= self._from_s:
            self._start = time_s, speed if speed >= ALIVE_SHARE * self._first[1] else 0.0
        if self.alive or speed > 2.0 * self._still_rad_s:
            return
        self.alive = (self._steady and self._came_down(self._first, time_s)) or (
            self._start is not None and self._came_down(self._start, time_s)
        )

    def is_fresh(self, now_s: float) -> bool:
        """Whether the signal still comes."""
        return bool(self._last) and now_s - self._last[-1][0] <= STALE_S

    def _came_down(self, since: tuple[float, float], now_s: float) -> bool:
        start_s, start = since
        return start > 4.0 * self._still_rad_s and now_s - start_s >= ALIVE_SHARE * start / self._stop_rad_s2


class _Runaway:
    """Acceleration against a quick stop."""

    def __init__(self, limits: MachineLimits) -> None:
        self._limits = limits
        self.begun = False
        self._slowest_rad_s = self._slowest_angle_rad_s = math.inf
        self._before: _Point | None = None
        self.start_rad_s = 0.0
        self._by_impulse_rad_s: float | None = None
        self._pushing_s = self._pushed_nm = 0.0
        self._apart_nm_s = self._took_s = 0.0
        self._for_s = self._unanswered_s = self._unanswered_rad_s = 0.0
        self._speed_above_s = self._angle_above_s = 0.0
        self._seen_s: float | None = None
        self._recent: deque[_Point] = deque()
        self._inverted = self._brakes = False

    def begin(self, speed_rad_s: float) -> None:
        """A quick stop was asked for, from this speed."""
        self.begun = True
        self.start_rad_s = speed_rad_s

    def see(self, point: _Point, known: _Knowledge, observer: Observer) -> None:
        """Take one point of a stop."""
        if not self.begun:
            return
        before, self._before = self._before, point
        if before is None or point.time_s <= before.time_s:
            self._by_impulse_rad_s = self.start_rad_s if math.isfinite(known.inertia_high) else None
            return
        self._for_s += point.time_s - before.time_s
        if self._for_s >= PUSHING_S:
            self._slowest_rad_s = min(self._slowest_rad_s, abs(point.speed))
        self._see_unanswered(point, observer, point.time_s - before.time_s)
        self._see_inverted(point, known)
        took_s = point.time_s - before.time_s
        if self._by_impulse_rad_s is not None:
            # What a string takes is not known well enough for more than a torque near its limit.
            counts = not self._limits.winds_up or abs(point.torque) >= DOUBTED_SHARE * self._limits.torque_nm
            held = abs(point.speed) <= point.still and abs(point.torque) <= known.friction(0.0, point.still)[1]
            counts = counts and not (held and observer.believable)     # static friction takes it
            self._by_impulse_rad_s += counts * (point.impulse - before.impulse) / known.likely_inertia
        # What pushes in the direction of the last motion, beyond all friction. Of a shaft that was never seen to move
        # nothing is known: any torque pushes.
        least = known.pushing_nm
        if observer.doubt is not None:
            least = min(least, DOUBTED_SHARE * self._limits.torque_nm)
        if not observer.believable:
            least = PUSHING_SHARE * self._limits.torque_nm
        elif not observer.moved:       # a little torque may be left over that static friction holds
            least = DOUBTED_SHARE * (self._limits.probe_torque_nm or self._limits.torque_nm)
        turning = observer.rate_rad_s if observer.rate_rad_s and observer.doubt is not None else self.start_rad_s
        if self._limits.winds_up and observer.believable:
            turning = point.speed      # the string may have turned it back
        forward = 1.0 if turning >= 0.0 else -1.0
        pushes = (forward * point.torque if observer.moved else abs(point.torque)) > least
        self._pushing_s = self._pushing_s + took_s if pushes else 0.0
        self._pushed_nm = point.torque
        self._brakes = -forward * point.torque > least
        self._apart_nm_s += took_s * abs(point.torque - observer.demand_nm) if observer.demand_nm is not None else 0.0
        self._took_s += took_s

    def _see_inverted(self, point: _Point, known: _Knowledge) -> None:
        """The speed rises as the reported torque would have it with the opposite sign."""
        recent = self._recent
        recent.append(point)
        while point.time_s - recent[0].time_s > INVERTED_S:
            recent.popleft()
        start, self._inverted = recent[0], False
        window_s = point.time_s - start.time_s
        change = abs(point.speed) - abs(start.speed)
        least = FASTER_SHARE * self._limits.speed_max_rad_s
        if self._limits.winds_up or not known.known or window_s < 0.9 * INVERTED_S or change < least:
            return
        forward = math.copysign(1.0, point.speed)
        pushed_nms = -forward * (point.impulse - start.impulse)
        usual_nm = 0.5 * math.fsum(known.friction(point.speed, 0.0))
        expected_nms = pushed_nms - forward * usual_nm * window_s
        least_nms, most_nms = known.inertia_low * change, known.inertia_high * change
        slack_nms = INVERTED_SHARE * abs(pushed_nms)
        self._inverted = least_nms - slack_nms <= expected_nms <= most_nms + slack_nms

    def _see_unanswered(self, point: _Point, observer: Observer, took_s: float) -> None:
        """A torque at its limit opposes the reported speed, which does not change."""
        braking_nm = -point.torque * math.copysign(1.0, point.speed)
        opposes = braking_nm >= AT_LIMIT_SHARE * self._limits.torque_nm
        changed = abs(point.speed - self._unanswered_rad_s) > UNANSWERED_SHARE * abs(point.speed)
        if changed or not opposes or not observer.turns(point.speed):
            self._unanswered_s, self._unanswered_rad_s = 0.0, point.speed
            return
        self._unanswered_s += took_s
        if self._unanswered_s >= UNANSWERED_S:
            observer.unanswered(point.speed, point.torque, self._unanswered_s, point.time_s)

    def seen(self, observer: Observer, sample: Sample) -> str:
        """In words, where two ways agree."""
        if not self.begun or self._for_s < PUSHING_S:
            return ""
        limit = self._limits.speed_max_rad_s
        more = FASTER_SHARE * limit
        if self._limits.winds_up:
            # A string that is let go turns back. Its torque is taken away only from a shaft that is beyond its limit.
            self._slowest_rad_s = self._slowest_angle_rad_s = limit
        faster = more + max(self._slowest_rad_s, IMPULSE_SHARE * abs(self.start_rad_s))
        doubt = observer.doubt
        # Of a shaft that became lighter the inertia is not known any more, but its speed is followed.
        lighter = doubt is not None and doubt.lighter
        in_vain = (not observer.believable and not lighter and not observer.comes_down) or (
            not observer.moved and not self._limits.winds_up
        )
        by_speed = by_position = ""
        took_s = 0.0 if self._seen_s is None else min(sample.time_s - self._seen_s, STALE_S)
        self._seen_s = sample.time_s
        above = observer.believable and abs(sample.speed_rad_s) > faster
        self._speed_above_s = self._speed_above_s + took_s if above else 0.0
        enough_s = FASTER_BRAKED_S if self._brakes else FASTER_S
        if in_vain:
            by_speed = "the reported speed does not follow the torque"
        elif self._speed_above_s >= enough_s:
            by_speed = f"the reported speed rose to {sample.speed_rad_s:.2f} rad/s"
        rate = observer.rate_rad_s
        if rate is not None:
            self._slowest_angle_rad_s = min(self._slowest_angle_rad_s, abs(rate))
            above = abs(rate) > more + max(self._slowest_angle_rad_s, IMPULSE_SHARE * abs(self.start_rad_s))
            self._angle_above_s = self._angle_above_s + took_s if above else 0.0
            if self._angle_above_s >= enough_s:
                by_position = f"the position moves at {rate:.2f} rad/s"
        by_torque = "" if lighter else self._by_torque(observer.believable, more)
        # The speed of a shaft that became lighter is followed; so it is where only the sign of the torque is wrong.
        if lighter and self._inverted and abs(sample.speed_rad_s) > limit:
            by_speed = by_speed or f"the reported speed rose to {sample.speed_rad_s:.2f} rad/s"
            by_torque = "it rises as the reported torque with the opposite sign accounts for"
        ways = [one for one in (by_speed, by_position, by_torque) if one]
        return "; ".join(ways) if len(ways) >= 2 else ""

    def _by_torque(self, believable: bool, more_rad_s: float) -> str:
        """What the torque alone shows; one that does not follow the demanded one accounts for nothing."""
        if self._apart_nm_s > TORQUE_SHARE * self._limits.torque_nm * self._took_s:
            return ""
        if self._unanswered_s >= UNANSWERED_S:
            return f"{self._pushed_nm:.0f} N·m for {self._unanswered_s:.0f} s have stopped any such shaft"
        # Above a string the stop begins with a ramp of the setpoint, which may push: until that has ended.
        ramp_s = self._limits.speed_max_rad_s / self._limits.quick_stop_rad_s2
        pushes = not self._limits.winds_up or (believable and self._for_s >= ramp_s)
        if self._pushing_s >= PUSHING_S and pushes:
            return f"{self._pushed_nm:.0f} N·m push the shaft on"
        by_impulse = self._by_impulse_rad_s
        if by_impulse is not None and self._beyond(by_impulse, more_rad_s, believable):
            return f"the torque since the quick stop accounts for {by_impulse:.2f} rad/s"
        return ""

    def _beyond(self, by_impulse_rad_s: float, more_rad_s: float, believable: bool) -> bool:
        """Whether torque alone takes the shaft past its speed limit or, with a speed in doubt, clearly past zero."""
        start = abs(self.start_rad_s)
        forward = by_impulse_rad_s * (1.0 if self.start_rad_s >= 0.0 else -1.0)
        if believable or self._limits.winds_up:
            return abs(by_impulse_rad_s) > max(start, self._limits.speed_max_rad_s) + more_rad_s
        slack = IMPULSE_SHARE * start + more_rad_s
        return forward > start + slack or forward < -slack
