"""Observer: evaluates every cycle, and compares its reports. Pure."""

from __future__ import annotations

import math
from collections import deque

from drivers import STANDSTILL_ANGLE_RAD_S, Command, Mode, PositionReading, PowerState, Sample, Unwrapped
from profiles.quantities import in_nm
from tdhil.runner.excitation import RigGuess
from tdhil.runner.observer.contradiction import Contradiction, Signal
from tdhil.runner.observer.left_operation import LeftOperation
from tdhil.runner.observer.momentum_balance import HIDDEN_SHARE, WINDOWS_S, MomentumBalance
from tdhil.runner.observer.points import AROUND_S, POINT_S, SLOPE_S, STALE_S, Point
from tdhil.runner.observer.position_way import PositionWay, Way
from tdhil.runner.observer.repeated_feedback import FROZEN_S, RepeatedFeedback
from tdhil.runner.observer.revival import ALIVE_LAGS, ALIVE_S, BEFORE_S, KEPT_SHARE, RAMP_SLACK, Revival
from tdhil.runner.observer.runaway import Belief, Runaway
from tdhil.runner.observer.shaft_bounds import FRICTION_LIMIT_SHARE, RUN_OUT_S, ShaftBounds
from tdhil.runner.observer.torque_following import TorqueFollowing
from tdhil.runner.observer.unanswered_torque import STANDSTILLS, PointInRun, rules
from tdhil.runner.settings import ControlAssumptions, MachineLimits

LONGEST_GAP_S = 0.2
"""Longest gap in the feedback, s; after a longer one the comparison starts again."""

BEYOND_LIMIT = 1.25
"""Multiple of the torque limit beyond which a reported torque is false: the drive keeps the limit, except for
ripple.
"""

NOISE_SDS = 6.0
"""Standard deviations that count as the noise of the reported speed."""

STILL_SHARE = 0.01
"""Share of the speed limit below which a shaft may stand still; static friction then balances any torque up to its
own.
"""

LOAD_RANGE, LOAD_BEFORE_S = 1.0, 10.0
"""Assumed bound of a string's load: the multiple of its range about the middle, and the time before a window for
this range, s: one oscillation of a long string."""

LOAD_LAGS = 2.0
"""Time before the load of a string is known after a restart, in lags. The torque steps at the end of a stage, and the
speed shows this a lag later. A load from these points alone was 6,000 N·m instead of 2,500, and ended a healthy run
(`benchmarks/healthy_runs.py`, seed 318)."""

UNSEEN_SHARE = 0.1
"""Least friction of a shaft without any reported motion, as a share of the applied torque."""

UNSEEN_MOST_S = 60.0
"""Longest run-out time of a shaft without any reported motion, s."""

DOUBTED_REST_SHARE = 0.1
"""Share of the standstill speed that is used after a contradiction, because the scale of the report may be wrong."""

POWER_LOSS_S = 0.5
"""Time before the drive removed its torque, s, in which a shaft that turned still turns afterwards. A stop waits for
longer at standstill before it disables the drive."""


class Observer:
    """Comparison of one drive's reports over one run; `see` evaluates every cycle, `doubt` is the contradiction."""

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
        self._bounds = ShaftBounds(limits, self._lag_s)
        self._frozen = RepeatedFeedback(limits, assumptions.reaction_s)
        self._torques = TorqueFollowing(limits, self._lag_s)
        self._angles = PositionWay(self._lag_s, speed_resolution_rad_s, self._still_rad_s)
        self._turns: Unwrapped | None = None
        self._zero: Unwrapped | None = None
        self._runaway = Runaway(limits, self._still_rad_s)
        self._balance = MomentumBalance(limits, self._lag_s, self._point_s, torque_resolution_nm)
        self._rules = rules(limits, self._still_rad_s, self._lag_s, self._point_s)
        self._revival: Revival | None = None
        self._angle_revival: Revival | None = None
        self._ramp: Revival | None = None          # speed since the begin of a quick stop that ends with the torque off
        self.torque_offset_nm = 0.0
        """Reported torque without any torque, N·m."""
        self.swinging_offset_nm = 0.0
        """Largest torque offset that the stage may command in speed mode, N·m."""
        self.doubt: Contradiction | None = None
        self.backwards = False
        """Set by a stage in which the shaft turned backwards on a forward command: the sign of a report is
        inverted.
        """
        self._gap_s = max(LONGEST_GAP_S, 3.0 * period_s)
        self._block_s = self._point_s - 0.5 * period_s
        self._time_s = self._block_from_s = -math.inf
        self._speed = self._torque = self._before = 0.0
        self._impulse = self._rough = self._way = self._bent = 0.0
        self._friction_low = self._friction_high = 0.0
        self._cycles, self._sum_speed, self._sum_torque = 0, 0.0, 0.0
        self.demand_nm: float | None = None
        """Demanded torque, N·m, if the drive reports one."""
        self._shows_state = True
        self._way_of = 0               # the integral of speed restarts with each gap
        self._unseen_nms = 0.0
        self._unseen_nm = 0.0
        self._moved = False
        self._powered = False
        self._left: LeftOperation | None = None
        self._restart()

    # -- knowledge of the shaft and the drive -------------------------------------------------------------------

    def position(self, count_rad: float, gap_s: float) -> None:
        """Set the results of preflight: one count of the position, rad, and the longest gap without a lost turn, s."""
        self._angles.count_rad, self._angles.gap_s = count_rad, gap_s

    def compare_position(self, ratio: float) -> None:
        """Start to compare the position: it must change by ``ratio`` times the integral of the reported speed."""
        self._angles.ratio = ratio
        self._angles.restart()

    def heard_position(self, now_s: float, within_s: float) -> bool:
        """Return whether a position was received within the last ``within_s``."""
        return now_s - self._angles.heard_s <= within_s

    def know(self, model: RigGuess) -> None:
        """Set J and friction of stage 2, with their uncertainty."""
        before = self._bounds.words
        if not self._bounds.know(model):
            self._doubt(
                frozenset({Signal.SPEED, Signal.TORQUE}),
                f"the way up to the first speed and the rest of stage 2 contradict each other: {before}, then"
                f" {self._bounds.words}",
                "Did the scale of torque or speed change meanwhile, or the load? Check the profile and the encoder",
                self._time_s,
            )
        self._restart()

    @property
    def unseen_s(self) -> float:
        """Longest time, s, that a shaft without reported motion may continue to turn without torque; 0: motion was
        reported.
        """
        if self._moved or self._unseen_nm <= 0.0:
            return 0.0
        if self._limits.has_drill_string:          # the string continues to turn the shaft long after its torque is off
            return RUN_OUT_S
        return min(UNSEEN_MOST_S, self._unseen_nms / (UNSEEN_SHARE * self._unseen_nm))

    @property
    def blind_s(self) -> float:
        """Longest time in which friction stops a motion that (1) cannot detect, s."""
        return self._bounds.blind_s(self._still_rad_s)

    @property
    def turned(self) -> bool:
        """True if the shaft turned when the stop began, or shortly before it."""
        return self.turns(self._runaway.start_rad_s)

    # -- each cycle ------------------------------------------------------------------------------------------

    def see(self, command: Command, sample: Sample) -> None:
        """Evaluate one cycle: the command and the reports."""
        self._shows_state = sample.state is not PowerState.UNKNOWN
        if not sample.fresh or not self._shows_state:
            return                     # feedback without a valid state gives no information on the shaft
        frozen = self._frozen.see(command, sample, self.swinging_offset_nm)
        if frozen is not None and not self._runaway.begun:     # during a stop the setpoint jumps to zero at once
            self._doubt(frozenset({Signal.ALL}), *frozen, sample.time_s)
        speed, torque, now_s = sample.speed_rad_s, sample.torque_nm - self.torque_offset_nm, sample.time_s
        if not (math.isfinite(speed) and math.isfinite(torque)):
            return
        apart_s = now_s - self._time_s
        if not 0.0 < apart_s <= self._gap_s:
            self._restart()
            self._time_s, self._speed, self._torque = now_s, speed, torque
            self._before = speed
            self._block_from_s = now_s
            if sample.position_rad is not None:
                self._see_angle(sample.position_rad, now_s, speed)
            return
        was_speed, was_torque, was_bent = self._speed, self._torque, self._bent
        mean_nm, mean_rad_s = 0.5 * (torque + was_torque), 0.5 * (speed + was_speed)
        self._impulse += mean_nm * apart_s
        self._rough += 0.5 * abs(torque - was_torque) * apart_s
        self._way += mean_rad_s * apart_s
        bent = speed - 2.0 * was_speed + self._before
        self._bent = was_bent + 0.005 * (min(bent * bent, 100.0 * was_bent + 9.0 * self._count_rad_s**2) - was_bent)
        self._before, self._speed, self._torque, self._time_s = was_speed, speed, torque, now_s
        self._cycles += 1
        self.demand_nm = sample.torque_demand_nm
        self._sum_speed += speed
        self._sum_torque += torque
        if sample.position_rad is not None:
            self._see_angle(sample.position_rad, now_s, speed)
        if now_s - self._block_from_s >= self._block_s:
            self._point(command, sample)

    def see_reading(self, reading: PositionReading) -> None:
        """Evaluate a position that was read outside of the cycle."""
        if self._turns is None:
            self._turns = Unwrapped(reading.wraps_rad, self._limits.speed_max_rad_s)
            self._angles.restart()
        angle_rad = self._turns.take(reading.time_s, reading.position_rad)
        if angle_rad is None:
            self._angles.restart()
        else:
            self._see_angle(angle_rad, reading.time_s, self._speed, self._turns)

    def expected(self, apart_rad_s: float, within_rad_s: float, sample: Sample) -> None:
        """Compare: a contradiction follows if the speed differs from a stage's own model by more than
        ``within_rad_s``.
        """
        if sample.fresh and not abs(apart_rad_s) <= within_rad_s:
            self._doubt(
                frozenset({Signal.SPEED, Signal.TORQUE}),
                f"the reported speed contradicts the torque: it is {sample.speed_rad_s:.2f} rad/s,"
                f" {abs(apart_rad_s):.2f} rad/s away from the prediction (limit {within_rad_s:.2f} rad/s)",
                "Check the encoder and its cable. Check whether the torque is lost or limited, and whether this is the"
                " rig that was identified",
                sample.time_s,
            )

    def sensor_fault(self, what: str, time_s: float) -> None:
        """Doubt the speed while J is not known: the drive reports a fault of its sensor.

        A speed that then falls as under a quick stop is believed again (`Revival`). Without any reported motion
        `unseen_s` gives the time instead. Once J is known the momentum balance shows whether the speed is lost.
        """
        if self._moved and not self._bounds.known:
            self._doubt(
                frozenset({Signal.SPEED}), f"the drive reports a fault of its speed sensor: {what}",
                "Check the encoder and its cable", time_s,
            )

    def turns(self, speed_rad_s: float) -> bool:
        """Return whether a reported speed is clearly not zero."""
        return abs(speed_rad_s) > STANDSTILLS * self._still_rad_s

    # -- standstill ------------------------------------------------------------------------------------------

    def speed_rad_s(self, sample: Sample) -> float:
        """Return the speed for the decision on a stop: from the position, if only the reported speed is in doubt."""
        rate = self.rate_rad_s
        return sample.speed_rad_s if rate is None or not self._position_lives else rate

    @property
    def _position_lives(self) -> bool:
        """True if the position continued after a contradiction, and so may replace the speed."""
        return self._angle_revival is not None and self._angle_revival.alive and self.rate_rad_s is not None

    @property
    def moved(self) -> bool:
        """True if any motion of the shaft was reported."""
        return self._moved

    @property
    def rate_rad_s(self) -> float | None:
        """Speed from the position, rad/s; None with too few positions, or without a recent one."""
        return self._angles.rate_rad_s if self.heard_position(self._time_s, STALE_S) else None

    @property
    def comes_down(self) -> bool:
        """True if a speed in doubt has decreased since then as a shaft does under a quick stop."""
        seen = (self._revival, self._angle_revival)
        return any(one is not None and one.falling and one.is_fresh(self._time_s) for one in seen)

    @property
    def reports_trusted(self) -> bool:
        """True if a report of standstill counts: there is no contradiction, or it has been refuted."""
        doubt = self.doubt
        if doubt is None or Signal.ALL in doubt.signals or Signal.SPEED not in doubt.signals:
            return True
        if self._position_lives:
            return True
        followed = self._revival is not None and (self._revival.alive or self._braked)
        return followed and self._balanced

    def rest_rad_s(self, at_rest_rad_s: float) -> float:
        """Return the speed that counts as standstill, rad/s; a lower one after a contradiction, as the scale may be
        wrong.
        """
        if self.doubt is None:
            return at_rest_rad_s
        return min(at_rest_rad_s, max(DOUBTED_REST_SHARE * at_rest_rad_s, self._noise_rad_s()))

    def angle_quiet(self, at_rest_rad_s: float) -> bool:
        """Return whether the position moves no faster than this, rad/s; True without a position.

        A position is finer than a coarse report of the speed: at most `STANDSTILL_ANGLE_RAD_S` counts as rest.
        """
        rate = self.rate_rad_s
        return rate is None or abs(rate) <= min(at_rest_rad_s, STANDSTILL_ANGLE_RAD_S) + self._angles.blur_rad_s

    def angle_stands(self, at_rest_rad_s: float) -> bool:
        """Return whether there is a position that resolves this speed, rad/s, and shows standstill."""
        fine = self.rate_rad_s is not None and self._angles.blur_rad_s <= at_rest_rad_s
        return fine and self.angle_quiet(at_rest_rad_s)

    @property
    def _braked(self) -> bool:
        """Return whether the reported torque stopped the shaft after the drive left operation.

        A drive that has lost its speed signal does not brake with it: the torque then drives the shaft on.
        """
        return self._left is not None and self._left.braked(self._bounds.inertia_high)

    @property
    def _balanced(self) -> bool:
        """Return whether the torque at reported standstill is too small to turn the shaft against its friction."""
        points = self._points
        if self._limits.has_drill_string or not points:
            return True
        return abs(points[-1].torque) <= 0.5 * self._bounds.breakaway_low_nm + 5.0 * self._torque_count_nm

    # -- a stop that has no effect ------------------------------------------------------------------------------

    def begin_stop(self, *, ends_off: bool = False) -> None:
        """Note that a quick stop was requested: the shaft must decelerate from now on.

        ``ends_off``: the drive removes its torque itself at the end of its quick stop.
        """
        if ends_off and self._ramp is None:
            self._ramp = Revival(True, math.inf, self._limits.quick_stop_rad_s2, self._still_rad_s)
        # the speed before the effect of a contradiction
        earlier = (point.speed for point in self._points if self._time_s - point.time_s <= BEFORE_S)
        self._runaway.begin(next(earlier, 0.0))

    def shows_s(self, at_rest_rad_s: float, torque_nm: float) -> float:
        """Return the time for which a disabled shaft must show standstill, s; ``torque_nm``: torque that held it
        before.

        A torque as large as friction may have kept the shaft turning, if the speed signal is wrong. Without this torque
        the reported speed then leaves standstill at the rate of friction.
        """
        return self._bounds.shows_s(at_rest_rad_s, torque_nm)

    @property
    def coasts_s(self) -> float:
        """Longest time for which the shaft may still turn after the drive left operation in motion, s; 0 if it did not.

        The lag of the report hides a speed that was lost at the same moment: it falls nearly as a shaft that coasts.
        """
        left = self._left
        if left is None or self._braked:
            return 0.0
        return max(0.0, left.time_s + self._bounds.coasts_s(left.speed_rad_s) - self._time_s)

    def runs_away(self, sample: Sample) -> str:
        """Return the evidence that the shaft accelerates against the quick stop, in two independent ways; '' without
        it.
        """
        return self._runaway.seen(self._belief, sample) if self._shows_state else ""

    # -- internal -----------------------------------------------------------------------------------------------

    def _restart(self) -> None:
        """Discard the samples, but keep the bounds."""
        self._points: deque[Point] = deque(maxlen=2 + math.ceil((WINDOWS_S[-1] + AROUND_S) / self._point_s))
        self._loads: deque[float] = deque(maxlen=2 + math.ceil(LOAD_BEFORE_S / self._point_s))
        self._time_s = -math.inf
        self._speed = self._torque = self._before = 0.0
        self._impulse = self._rough = self._way = self._bent = 0.0
        self._friction_low = self._friction_high = 0.0
        self._cycles, self._sum_speed, self._sum_torque = 0, 0.0, 0.0
        self._block_from_s = -math.inf
        self._balance.restart()
        self._way_of += 1

    def _point(self, command: Command, sample: Sample) -> None:
        block_s = sample.time_s - self._block_from_s
        point = Point()
        point.time_s = sample.time_s - 0.5 * block_s
        point.speed = self._sum_speed / self._cycles
        point.torque = self._sum_torque / self._cycles
        point.impulse = self._impulse - 0.5 * block_s * point.torque
        point.rough = self._rough
        known = self._bounds
        self._around(point, command)
        # a lagging speed still falls after the shaft stopped, when its static friction balances any torque
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
        if not self._moved and (abs(point.speed) > 2.0 * self._still_rad_s or self._angles.moved):
            self._moved = True
            known.breakaway_nm = max(self._unseen_nm, abs(point.torque))
            self._points.clear()       # the torque that held the shaft before is unknown
            self._points.append(point)
        elif not self._moved and sample.state is PowerState.ENABLED:
            self._unseen_nms += abs(point.torque) * block_s
            self._unseen_nm = max(self._unseen_nm, abs(point.torque))
        for followed in (self._revival, self._ramp):
            if followed is not None:
                followed.see(point.time_s, point.speed)
        if self._angle_revival is not None and (rate := self._angles.rate_rad_s) is not None:
            self._angle_revival.see(point.time_s, rate)
        self._contradict(self._runaway.unanswered(point))
        if self._runaway.begun:
            self._runaway.see(point, known, self._belief)
        if abs(point.torque) > BEYOND_LIMIT * self._limits.torque_nm:
            self._doubt(
                frozenset({Signal.TORQUE}),
                f"the reported torque of {in_nm(point.torque)} is beyond the torque limit of"
                f" {self._limits.torque_nm:g} N·m",
                "Check the units of torque in the profile and the rated torque", point.time_s,
            )
        if self._left is not None:
            self._left.see(point, turns=self.turns(point.speed))
        if sample.state in (PowerState.ENABLED, PowerState.QUICK_STOP):
            self._powered = True
            self._compare(point, command, block_s)
        elif self._left_operation_in_motion(point, sample.state) or sample.state is PowerState.FAULT_REACTION:
            self._contradict(self._balance.see(self._points, known, self._noise_rad_s()))
        if (apart := self._torques.see(command, sample, self.torque_offset_nm, block_s)) is not None:
            self._doubt(frozenset({Signal.TORQUE}), *apart, sample.time_s)

    def _around(self, point: Point, command: Command) -> None:
        """Set the slope, and the bounds of slope and torque within `AROUND_S`."""
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
        # in speed mode the torque may change faster than its report shows: by a quarter of the limit
        hidden_nm = HIDDEN_SHARE * limit_nm
        point.torque_least = max(-limit_nm, min(torques) - hidden_nm)
        point.torque_most = min(limit_nm, max(torques) + hidden_nm)
        if command.mode is Mode.TORQUE:
            point.torque_least, point.torque_most = min(torques[:2]), max(torques[:2])

    def _load(self, point: Point) -> None:
        """Set the bounds of a drill string's load, from the earlier torque less the accelerating part."""
        point.load_low = point.load_high = 0.0
        if not self._limits.has_drill_string:
            return
        accelerating_nm = self._bounds.likely_inertia * point.slope if self._bounds.known else 0.0
        self._loads.append(point.torque - accelerating_nm)
        if len(self._loads) * self._point_s < LOAD_LAGS * self._lag_s:
            point.load_low, point.load_high = -math.inf, math.inf
            return
        middle = 0.5 * (max(self._loads) + min(self._loads))
        half = LOAD_RANGE * (max(self._loads) - min(self._loads))
        margin = half + FRICTION_LIMIT_SHARE * self._limits.torque_nm
        point.load_low, point.load_high = middle - margin, middle + margin

    def _left_operation_in_motion(self, point: Point, state: PowerState) -> bool:
        """Return whether the drive left operation by itself while the shaft turned: it removed its torque, or brakes
        after a fault.

        A drive whose sensor failed with it, or that reports no speed without torque, shows zero at once, or falls to it
        with its lag. While J is not known, the speed is in doubt until it falls gradually after every lag has ended
        (`Revival`), or has been braked by the reported torque. A fault reaction counts from its beginning: at its end
        the lagging speed has little left to fall. The end of a quick stop that removes the torque is no such case.
        """
        now_s = point.time_s
        if self._powered:
            self._powered = False
            recent = (one.speed for one in self._points if now_s - one.time_s <= POWER_LOSS_S)
            if any(map(self.turns, recent)) and (self._bounds.known or not self._at_end_of_ramp(point, state)):
                self._left = LeftOperation(self._points[-1])
                if not self._bounds.known:
                    self._contradict(Contradiction(
                        frozenset({Signal.SPEED}), "the drive left operation while the shaft turned, and the inertia is"
                        " not known yet", "Look at the shaft: the drive may report no speed without torque", now_s,
                        lag_hides=True))
        return self._left is not None

    def _at_end_of_ramp(self, point: Point, state: PowerState) -> bool:
        """Return whether a quick stop that ends with the torque off has brought the speed down along its ramp.

        The lag of the report hides the last part of the ramp. A trip in that part whose speed signal is lost with it is
        not told from the end: without a fault, and within the lag, it would turn the shaft at `quick_stop_rad_s2` times
        the lag at most.
        """
        ramp = self._ramp
        if ramp is None or state is not PowerState.OFF or not (ramp.falling or ramp.alive):
            return False
        hidden_rad_s = RAMP_SLACK * self._limits.quick_stop_rad_s2 * self._lag_s
        return abs(point.speed) <= hidden_rad_s + 2.0 * self._still_rad_s

    def _compare(self, point: Point, command: Command, block_s: float) -> None:
        """Test the momentum balance, and whether the speed responds to the torque."""
        noise_rad_s = self._noise_rad_s()
        self._contradict(self._balance.see(self._points, self._bounds, noise_rad_s))
        now = PointInRun(
            point, command, block_s, self._points, self._bounds, noise_rad_s, self._moved, self._runaway.begun
        )
        for rule in self._rules:
            self._contradict(rule.see(now))

    @property
    def _belief(self) -> Belief:
        return Belief(self.doubt, self.reports_trusted, self.comes_down, self._moved, self.rate_rad_s, self.demand_nm)

    def _noise_rad_s(self) -> float:
        """Return the noise of a point's speed, rad/s."""
        per_point = max(1.0, self._point_s / self._period_s)
        return NOISE_SDS * math.sqrt(self._bent / 6.0 / per_point) + self._count_rad_s

    def _see_angle(
        self, position_rad: float, now_s: float, speed_rad_s: float, zero: Unwrapped | None = None
    ) -> None:
        """Compare a position. ``zero``: the counter of positions that were read; None for the driver's own."""
        if zero is not self._zero:
            if self.heard_position(now_s, STALE_S):
                return                 # positions with another zero still come
            self._zero = zero
            self._angles.restart()
        # a position without a cycle cannot be compared, because the integral of the reported speed is missing
        covered = now_s - self._time_s <= max(0.1, 2.0 * self._period_s)
        way = Way(self._way_of if covered else -1, self._way, speed_rad_s)
        apart = self._angles.see(position_rad, now_s, way, self._noise_rad_s())
        if apart is not None and self._frozen.repeats_s(now_s) >= 0.4 * FROZEN_S and self._angles.repeats:
            self._doubt(frozenset({Signal.ALL}), *self._frozen.words("and the position with them"), now_s)
        elif apart is not None:
            self._doubt(
                frozenset({Signal.SPEED, Signal.ANGLE}), apart,
                "Check the encoder, its cable, and the units of 606Ch and 6064h (or of the registers). If the drive"
                " filters the reported speed, state its lag as drive_data.speed_lag_s", now_s,
            )

    def _doubt(self, signals: frozenset[Signal], what: str, helps: str, time_s: float) -> None:
        self._contradict(Contradiction(signals, what, helps, time_s))

    def _contradict(self, found: Contradiction | None) -> None:
        """Store a contradiction; the first one of a run is not replaced."""
        if found is None or self.doubt is not None:
            return
        self.doubt, time_s = found, found.time_s
        slope, still = self._limits.quick_stop_rad_s2, self._still_rad_s
        recent = [point for point in self._points if time_s - point.time_s <= BEFORE_S]
        steady = not found.lag_hides
        if recent:
            fastest = max(recent, key=lambda point: abs(point.speed))
            braked = RAMP_SLACK * slope * (recent[-1].time_s - fastest.time_s) if self._runaway.begun else 0.0
            steady = steady and abs(recent[-1].speed) >= KEPT_SHARE * abs(fastest.speed) - braked
        self._revival = Revival(steady, time_s + max(ALIVE_S, ALIVE_LAGS * self._lag_s), slope, still)
        self._angle_revival = Revival(steady, time_s + ALIVE_S, slope, still + self._angles.blur_rad_s)
