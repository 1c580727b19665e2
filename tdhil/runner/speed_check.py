"""An independent check of the unit of speed, before stage 2 goes to its second mean speed.

One number of the profile scales the reported speed and the setpoint. If this number is ten times too small, the shaft
turns ten times as fast as commanded and reported, and no limit in rad/s holds. So on the way to the first mean speed
tdhil reads the drive's position beside the cycle, if it has one. The ramp continues past `slow_speed`, at which a
tenfold error does no harm, only while the position agrees. At the first mean speed the ratio of both travels is taken
over the whole operating point. Without a position the operator confirms the speed.

Refused: a ratio that differs from one, in either direction, by more than `TOLERANCE` plus the resolution of the speed.
Encoders, gears and slip of good rigs stay within a few per cent; wrong units give factors of 2, 4, 2π, 10 or 60.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from drivers import Command, Mode, Positioned, PositionReading, PreflightRefused, Sample
from profiles import CodedText, MessageCode
from tdhil.config import SPEED_UNIT_TOLERANCE
from tdhil.runner.settings import ControlAssumptions, MachineLimits
from tdhil.runner.task import ConfirmSpeed, Say, refuse_unconfirmed_speed

if TYPE_CHECKING:
    from tdhil.runner.control_loop import ControlLoop

# ---------------------------------------------------------------------------------------------------------------------
# The drive's position compared with its reported speed. Pure.
#
# Over one stretch the true travel of the shaft is the change of the drive's position, and also the integral of its
# reported speed, however unsteady it turns. Their ratio is that of the true unit of speed to the profile's. A lag of
# the reported speed shifts both ends of a stretch by the same travel if both ends are equally fast.


WINDOW_S = 0.25
"""Shortest time over which the speed of the position is taken, s."""
LEAST_WINDOW = 3
"""Least number of readings for the speed of the position."""
SEEN_FASTER = 12.0
"""Largest ratio of true to reported speed at which a position that wraps must still be followed."""
EXACT = 0.03
"""Largest half-width of a usable ratio, as a share of the ratio."""
LEAST_S = 2.0
"""Shortest stretch for a ratio, s."""
STOOD_RAD = 8.2
"""Reported travel, rad, after which an unchanged position counts as frozen (1.3 turns, for counters of turns)."""


class TravelRatio(NamedTuple):
    """Ratio of true to reported travel of a stretch, and its half-width from counts and time."""

    value: float
    half_width: float


@dataclass(frozen=True)
class _AnglePoint:
    time_s: float
    angle_rad: float
    way_rad: float
    half_width_s: float


class Angles:
    """Positions of one drive during one run; `restart` begins a new stretch."""

    def __init__(self) -> None:
        self.where = ""
        self.count_rad: float | None = None        # the smallest observed step: an upper limit of one count
        self.blind = False                         # too few readings for a position that wraps
        self._way_rad = 0.0                        # travel by the reported speed, rad
        self._before: Sample | None = None
        self._last: _AnglePoint | None = None
        self._raw_rad = 0.0
        self._recent: list[_AnglePoint] = []
        self._first: _AnglePoint | None = None          # of this stretch
        self._changed: _AnglePoint | None = None        # first and last change of the count in this stretch
        self._changed_last: _AnglePoint | None = None

    def restart(self) -> None:
        """Begin a new stretch with the next reading. The size of a count stays known."""
        self._first = self._changed = self._changed_last = None
        self.blind = False

    def saw(self, sample: Sample) -> None:
        """Add the reported speed of one cycle."""
        if not sample.fresh:
            return
        if self._before is not None:
            mean = 0.5 * (self._before.speed_rad_s + sample.speed_rad_s)
            self._way_rad += mean * (sample.time_s - self._before.time_s)
        self._before = sample

    def read(self, reading: PositionReading, believed_rad_s: float) -> None:
        """Add one reading; ``believed_rad_s``: speed of the shaft if the unit of speed is right."""
        self.where = reading.where
        last, angle = self._last, reading.position_rad
        if last is not None:
            step = angle - self._raw_rad
            wraps = reading.wraps_rad
            if wraps is not None:
                step -= wraps * round(step / wraps)
                farthest = SEEN_FASTER * abs(believed_rad_s) * (reading.time_s - last.time_s)
                self.blind = self.blind or farthest > 0.5 * wraps
            angle = last.angle_rad + step
            if step != 0.0:
                self.count_rad = abs(step) if self.count_rad is None else min(self.count_rad, abs(step))
        self._raw_rad = reading.position_rad
        way_rad = self._way_rad
        if self._before is not None:       # a late host reads the position after its last sample
            way_rad += self._before.speed_rad_s * (reading.time_s - self._before.time_s)
        point = self._last = _AnglePoint(reading.time_s, angle, way_rad, reading.half_width_s)
        self._recent.append(point)
        while len(self._recent) > LEAST_WINDOW + 1 and point.time_s - self._recent[1].time_s >= WINDOW_S:
            del self._recent[0]
        if self._first is None:
            self._first = point
        elif last is not None and angle != last.angle_rad:
            self._changed = self._changed or point
            self._changed_last = point

    def speed_rad_s(self) -> tuple[float, float] | None:
        """Return the least and most speed (magnitudes) by the latest positions alone; None if it is too early."""
        recent = self._recent
        if self.count_rad is None or len(recent) <= LEAST_WINDOW or self.blind:
            return None
        took_s = recent[-1].time_s - recent[0].time_s
        if took_s < 0.99 * WINDOW_S:
            return None
        turned = abs(recent[-1].angle_rad - recent[0].angle_rad)
        return max(0.0, turned - self.count_rad) / took_s, (turned + self.count_rad) / took_s

    def ratio(self) -> TravelRatio | None:
        """Return the ratio of this stretch; None while it is not known well enough."""
        first, last = self._first, self._last
        if first is None or last is None or self.blind or last.time_s - first.time_s < LEAST_S:
            return None
        way = abs(last.way_rad - first.way_rad)
        count = self.count_rad
        start, end = self._changed, self._changed_last
        if start is None or end is None:
            # No change: the position is frozen if the reported travel exceeds five known counts, or `STOOD_RAD`.
            return TravelRatio(0.0,
                               0.0) if way > (STOOD_RAD if count is None else min(STOOD_RAD, 5.0 * count)) else None
        way_rad = end.way_rad - start.way_rad
        turned = end.angle_rad - start.angle_rad
        spent_s = end.time_s - start.time_s
        if spent_s < 0.9 * LEAST_S or turned == 0.0 or count is None:
            return None
        # At a change the position is known to one count, and to the travel between two readings.
        between = abs(turned) * self._every_s() / spent_s
        half = 2.0 * min(count, between) / abs(turned) + (start.half_width_s + end.half_width_s) / spent_s
        if half > EXACT:
            return None
        if abs(way_rad) < 1e-3 * abs(turned):
            way_rad = 1e-3 * turned
        value = turned / way_rad
        return TravelRatio(value, half * abs(value))

    def _every_s(self) -> float:
        recent = self._recent
        return (recent[-1].time_s - recent[0].time_s) / max(1, len(recent) - 1)


# ---------------------------------------------------------------------------------------------------------------------

TOLERANCE = SPEED_UNIT_TOLERANCE
NOTED = 0.02
"""Difference that is reported: J is wrong by as much if the speed causes it."""
SLOW_SHARE = 0.05
"""Share of the highest speed at which a wrong unit is detected: ten times this speed is half of the limit."""
TOO_FAST = 2.0
"""Factor over the setpoint above which the ramp waits until position and speed are compared."""
FASTEST_SHARE = 0.7
"""Share of the highest speed, by the position. Above it the run is refused without a comparison."""
HARMLESS_SHARE = 0.1      # of the highest speed: a speed below it is never too fast
EVERY_S, EVERY_CYCLES, SELDOM_S = 0.05, 3, 0.25
"""Reading interval of the position, s; on a slower line each third cycle, at most the last value, s."""
LEVEL_EVERY_S = 0.25
"""Reading interval at an operating point, s."""
TIMED_S = 0.02
"""A reading with a larger time uncertainty (s) than this, and than usual, is dropped: the host was late."""
SILENT = 5
"""Missed readings in a row after which the drive counts as without a position."""
SEEN_S = 3.0
"""Averaging time of the speed that the operator confirms, s."""
SETTLED_SHARE, SETTLED_COUNTS, SETTLED_S, SETTLE_S = 0.1, 0.6, 0.5, 10.0
"""Share of the setpoint, and counts, within which the mean reported speed of this time, s, is at the setpoint; and the
longest wait for that, s."""
TURNS_WAITED = 3.2
"""Turns to wait for at the slow speed, for a counter of whole turns."""
LONGEST_WAIT_S = 60.0     # s; longest wait for these turns
BY_POSITION, BY_OPERATOR, BY_NAME, UNSEEN = "position", "operator", "--accept-speed-unit", "nobody"
_WHERE = "unit of speed"
_CHECK = "Check the speed scaling in the profile (unit of the speed's setpoint and of the reported speed)"
_IF_RIGHT = "; if a timed turn shows that the speed is right, correct its position entry (counts per turn)"


@dataclass(frozen=True)
class SpeedWitness:
    """Operator who confirms the speed if there is no position. ``accepted``: the unit was accepted by name."""

    confirm: ConfirmSpeed = refuse_unconfirmed_speed
    simulated: bool = False
    accepted: bool = False
    say: Say = field(default=lambda _text: None)


def slow_speed(limits: MachineLimits, resolution_rad_s: float) -> float:
    """Return the speed of the first check, rad/s: a whole number of seconds per turn, easy to watch."""
    slow = max(SLOW_SHARE * limits.speed_max_rad_s, 5.0 * resolution_rad_s)
    turn_s = 2.0 * math.pi / slow
    return 2.0 * math.pi / math.floor(turn_s) if turn_s >= 4.0 else slow


class _Paused(NamedTuple):
    """Speed at which the ramp waits: until the position follows, or for a full comparison."""

    speed_rad_s: float
    until_compared: bool


class SpeedUnitCheck:
    """Check of the unit of speed in stage 2: `ramp` to the first mean speed, `level` at it, `conclude` after it."""

    def __init__(
        self, loop: ControlLoop, limits: MachineLimits, assumptions: ControlAssumptions, resolution_rad_s: float,
        witness: SpeedWitness,
    ) -> None:
        self._loop = loop
        self._limits = limits
        self._lag_s = 2.0 * assumptions.largest_speed_lag_s
        self._resolution_rad_s = resolution_rad_s
        self._witness = witness
        self._slow_rad_s = slow_speed(limits, resolution_rad_s)
        self._drive: Positioned | None = loop.drive if isinstance(loop.drive, Positioned) else None
        self._angles = Angles()
        self._next_s = -math.inf
        self._every_s = 0.0
        self._silent = 0
        self._usual_half_s = math.inf              # time uncertainty of a reading
        self._highest_rad_s = 0.0                  # highest setpoint so far
        self._recent_rad_s: deque[float] = deque(maxlen=loop.cycles(SETTLED_S))    # reported
        self._done = False
        self._lost = ""                            # why there is no position
        self._watching = False
        self._wraps_rad: float | None = None

    # -- the three parts -------------------------------------------------------------------------------------

    def ramp(self, start_rad_s: float, end_rad_s: float, rate_rad_s2: float) -> None:
        """Ramp to the first mean speed, in speed mode. Raises PreflightRefused for a wrong unit of speed."""
        self._begin()
        loop = self._loop
        if abs(end_rad_s) < self._slow_rad_s:      # too slow to show anything
            self._pause(_Paused(math.copysign(self._slow_rad_s, end_rad_s or 1.0), True))
        steps = max(1, round(abs(end_rad_s - start_rad_s) / rate_rad_s2 / loop.period_s))
        span = end_rad_s - start_rad_s
        passed = False
        for step in range(1, steps + 1):
            wanted = start_rad_s + span * step / steps
            if not self._done and not passed and abs(wanted) > self._slow_rad_s:
                passed = True
                if not self._follows(self._slow_rad_s):
                    self._pause(_Paused(math.copysign(self._slow_rad_s, wanted), self._coarse()))
            self._cycle(wanted)
            if not self._done and self._too_fast(wanted):
                self._pause(_Paused(wanted, True))

    def level(self) -> None:
        """Begin the operating point at the first mean speed: the comparison starts here."""
        self._angles.restart()
        # A wrapping position would be lost if it were read less often.
        low_rad_s, wraps_rad = max(self._highest_rad_s, self._slow_rad_s), self._wraps_rad
        if wraps_rad is None or not 0.5 * wraps_rad < SEEN_FASTER * low_rad_s * LEVEL_EVERY_S:
            self._every_s = max(LEVEL_EVERY_S, self._every_s)

    def conclude(self, command: Command) -> None:
        """Compare after the operating point, before any faster motion. Raises PreflightRefused."""
        if not self._done:
            ratio = self._angles.ratio() if self._watching and not self._lost else None
            if ratio is None:
                self._ask(command)
            else:
                self._judge(ratio, command)
        self._end()

    # -- watching --------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        self._every_s = max(EVERY_S, min(EVERY_CYCLES * self._loop.period_s, SELDOM_S))
        reading = None if self._drive is None else self._read()
        if reading is None:
            self._lost = "the drive reports no position of its shaft"
            if self._witness.simulated or self._witness.accepted:
                self._settle_without()
            return
        self._watching = True
        self._loop.observer = self._observe

    def _end(self) -> None:
        self._done = True
        self._watching = False
        self._loop.observer = None

    def _read(self) -> PositionReading | None:
        assert self._drive is not None
        return self._drive.read_position()

    def _observe(self, command: Command, sample: Sample) -> None:
        """Read the position after every cycle that is due."""
        angles = self._angles
        angles.saw(sample)
        self._highest_rad_s = max(self._highest_rad_s, abs(command.speed_rad_s))
        if self._lost or sample.time_s < self._next_s - 0.5 * self._loop.period_s:
            return
        self._next_s = sample.time_s + self._every_s
        reading = self._read()
        if reading is None:
            self._silent += 1
            if self._silent >= SILENT:
                self._lost = "the drive no longer reports the position of its shaft"
            return
        self._silent = 0
        self._usual_half_s = min(self._usual_half_s, reading.half_width_s)
        if reading.half_width_s > max(TIMED_S, 2.0 * self._usual_half_s):
            return                                 # the time of this reading is too uncertain: use the next one
        angles.read(reading, max(self._highest_rad_s, abs(sample.speed_rad_s)))
        self._wraps_rad = reading.wraps_rad
        seen, fastest = angles.speed_rad_s(), FASTEST_SHARE * self._limits.speed_max_rad_s
        believed = max(abs(command.speed_rad_s), abs(sample.speed_rad_s))
        if seen is None or seen[0] <= fastest or seen[0] <= TOO_FAST * believed:
            return
        self._refuse(
            f"the position of the shaft moves at {seen[0]:.3g} rad/s or more, where {command.speed_rad_s:.3g} rad/s are"
            f" commanded and {sample.speed_rad_s:.3g} rad/s reported: the unit of speed is too small by a factor of"
            f" about {seen[0] / believed:.2g}",
            command,
        )

    def _coarse(self) -> bool:
        """Return whether the position has not moved yet, or moves in steps too large for a speed."""
        count = self._angles.count_rad
        return count is None or count > 0.5 * self._slow_rad_s * WINDOW_S

    def _follows(self, wanted_rad_s: float) -> bool:
        """Return whether the position moves, and no faster than it should."""
        if not self._watching or self._lost or self._angles.blind:
            return False
        seen = self._angles.speed_rad_s()
        return seen is not None and not self._coarse() and seen[1] <= max(
            TOO_FAST * abs(wanted_rad_s), HARMLESS_SHARE * self._limits.speed_max_rad_s
        )

    def _too_fast(self, wanted_rad_s: float) -> bool:
        seen = self._angles.speed_rad_s()
        harmless = HARMLESS_SHARE * self._limits.speed_max_rad_s
        return seen is not None and seen[0] > max(TOO_FAST * abs(wanted_rad_s), harmless)

    # -- waiting, comparing, asking --------------------------------------------------------------------------

    def _cycle(self, speed_rad_s: float) -> Sample:
        sample = self._loop.cycle(Command(Mode.SPEED, speed_rad_s, 0.0))
        self._recent_rad_s.append(sample.speed_rad_s)
        return sample

    def _waited(self, speed_rad_s: float, seconds: float) -> Iterator[None]:
        for _ in range(self._loop.cycles(seconds)):
            self._cycle(speed_rad_s)
            yield

    def _pause(self, paused: _Paused) -> None:
        """Hold a slow speed until position and speed are compared. If that is not possible, ask the operator."""
        speed_rad_s, command = paused.speed_rad_s, Command(Mode.SPEED, paused.speed_rad_s, 0.0)
        if self._watching and not self._lost:
            for _ in self._waited(speed_rad_s, self._lag_s):
                if not paused.until_compared and self._follows(speed_rad_s):
                    return
            self._settle(speed_rad_s)
            self._angles.restart()
            turn_s = 2.0 * math.pi / abs(speed_rad_s)
            longest_s = min(LONGEST_WAIT_S, max(2.0 * self._lag_s + 3.0, TURNS_WAITED * turn_s))
            for _ in self._waited(speed_rad_s, longest_s):
                if self._lost:
                    break
                ratio = self._angles.ratio()
                if ratio is not None:
                    self._judge(ratio, command)
                    return
            if self._too_fast(speed_rad_s):
                self._refuse(f"the position moves too fast for the commanded {speed_rad_s:.3g} rad/s", command)
        self._ask(command)

    def _settle(self, speed_rad_s: float) -> None:
        """Wait until the reported speed is at the setpoint, for `SETTLE_S` at most.

        The sign probe may leave the shaft faster. While it slows down, the lag of the report would count as travel.
        """
        near_rad_s = max(SETTLED_SHARE * abs(speed_rad_s), SETTLED_COUNTS * self._resolution_rad_s)
        for _ in range(self._loop.cycles(SETTLE_S)):
            mean_rad_s = math.fsum(self._recent_rad_s) / len(self._recent_rad_s)
            if self._lost or abs(mean_rad_s - speed_rad_s) <= near_rad_s:
                return
            self._cycle(speed_rad_s)

    def _judge(self, ratio: TravelRatio, command: Command) -> None:
        """Compare the ratio with one. Raises PreflightRefused. For a frozen position ask the operator."""
        value = ratio.value
        if value == 0.0:
            self._lost = f"the position in {self._angles.where} does not move while the drive reports a speed"
            if self._witness.simulated and not self._witness.accepted:
                self._refuse(self._lost, command)
            self._ask(command)
            return
        open_share = 0.5 * self._resolution_rad_s / max(abs(command.speed_rad_s), 1e-9) + ratio.half_width
        off = abs(value - 1.0)
        self._loop.guard.observer.compare_position(value)
        if off > TOLERANCE + open_share:
            self._contradicted(value, command)
        else:
            self._seen(BY_POSITION, value, self._angles.where)
            self._log(f"the travel in {self._angles.where} is {value:.4f} times the integral of the reported speed")
            if off > NOTED + open_share:
                self._witness.say(
                    f"the travel in {self._angles.where} differs by {100.0 * (value - 1.0):+.1f} % from the reported"
                    " speed: if the speed is wrong, J is wrong by as much"
                )
        self._done = True

    def _contradicted(self, value: float, command: Command) -> None:
        """Refuse a wrong unit; if it was accepted by name, only when the second mean speed would be too fast."""
        if value < 0.0:
            what = f"the position moves against the reported speed (ratio {value:.3g}): a sign is inverted"
            step = "Check the sign of speed and position (607Eh, encoder wiring, direction settings)"
        else:
            way = f"too {'small' if value > 1.0 else 'large'} by a factor of {max(value, 1.0 / value):.3g}"
            what = f"the shaft turns {value:.3g} times as fast as the drive reports: the unit of speed is {way}"
            step = _CHECK + _IF_RIGHT
        span = self._limits.speed_max_rad_s - self._limits.speed_min_rad_s
        fastest = abs(value) * (self._limits.speed_min_rad_s + 0.7 * span)
        if not self._witness.accepted or fastest > self._limits.speed_max_rad_s:
            self._refuse(what, command, step)
        self._seen(BY_NAME, value, self._angles.where)
        self._loop.log.learn(speed_unit_accepted=True)
        self._log(f"{what}; the unit was accepted by {BY_NAME}")
        self._witness.say(f"{what}; the unit was accepted by {BY_NAME}")

    def _refuse(self, what: str, command: Command, step: str = _CHECK + _IF_RIGHT) -> NoReturn:
        """Raise PreflightRefused after one more cycle, which first raises a fault of the drive or the host.

        A position that was read after a frozen host woke up, or of a drive that has stopped by itself since its last
        sample, shows nothing about a unit.
        """
        self._loop.observer = None
        self._loop.cycle(command)
        raise PreflightRefused(what, where=f"{_WHERE}, {self._angles.where}", next_step=step,
                               entry=MessageCode.SPEED_UNIT_WRONG)

    def _ask(self, command: Command) -> None:
        """Ask the operator whether the shaft turns as fast as the drive reports. Raises PreflightRefused if not."""
        loop, why = self._loop, self._lost or "the position that the drive reports could not be compared"
        self._lost = why
        if self._witness.accepted or self._witness.simulated:
            self._settle_without()
            return
        loop.hold(command, self._lag_s)
        seen = loop.hold(command, SEEN_S)
        mean_rad_s = sum(sample.speed_rad_s for sample in seen) / len(seen)
        if abs(mean_rad_s) < 0.2 * abs(command.speed_rad_s):
            self._refuse(
                f"the shaft does not follow a speed of {command.speed_rad_s:.3g} rad/s (reported: {mean_rad_s:.3g}"
                f" rad/s), at which its unit would be checked ({why})",
                command,
                f"Check that the drive can hold so low a speed. If its unit is known to be right, add {BY_NAME}",
            )
        self._log(f"{why}: the operator is asked whether the shaft turns at {mean_rad_s:.3f} rad/s")
        loop.quiet = True
        try:
            self._witness.confirm(mean_rad_s, why, lambda: self._again(command))
        finally:
            loop.quiet = False
        self._seen(BY_OPERATOR, None, "")
        self._log(f"the operator saw the shaft turn at {mean_rad_s:.3f} rad/s")
        self._done = True

    def _again(self, command: Command) -> None:
        self._loop.cycle(command)

    def _settle_without(self) -> None:
        """Continue without a check: a simulated drive, or a unit that was accepted by name."""
        accepted = self._witness.accepted
        text = f"{self._lost}: the unit of speed was " + (f"accepted by {BY_NAME}" if accepted else "not checked")
        self._log(text)
        self._witness.say(text)
        self._seen(BY_NAME if accepted else UNSEEN, None, "")
        self._done = True

    def _seen(self, by: str, ratio: float | None, where: str) -> None:
        self._loop.log.configure(speed_unit={"seen_by": by, "ratio": ratio, "where": where})

    def _log(self, text: str) -> None:
        self._loop.log.event(self._loop.now_s, "probe", text)


def speed_warnings(run: Any) -> tuple[str, ...]:
    """Return the warnings for the result, from the log's configuration: the same live and in replay."""
    found = run.get("speed_unit")
    if not isinstance(found, dict):
        return ()
    by, ratio = found.get("seen_by"), found.get("ratio")
    if by == BY_NAME:
        return (CodedText(
            f"the unit of speed was accepted by {BY_NAME} without a check: its error is an error of J",
            MessageCode.SPEED_UNIT_UNSEEN),)
    if isinstance(ratio, int | float) and abs(ratio - 1.0) > NOTED:
        return (
            CodedText(
                f"the drive's position differs by {100.0 * (ratio - 1.0):+.1f} % from its reported speed: if the speed"
                " is wrong, J is wrong by as much",
                MessageCode.SPEED_UNLIKE_ANGLE),
        )
    return ()
