"""The one stop sequence, for every cause and for the normal end.

1. Quick stop under the drive's speed control; where the profile says that a quick stop does not decelerate from
   torque mode, speed mode at zero first.
2. Wait for standstill, by status word and by speed. The reported speed lags, so it must stay at zero for longer than
   the largest plausible lag. The time depends on the torque limit and on torsional vibration: the stop waits as long
   as the shaft becomes slower.
3. With a drill string, bring trapped torque down under speed control, on the rig's ramp (`string_release`). A drive may
   end a quick stop by switching its torque off, so the release comes first: the shaft is brought to standstill in speed
   mode, at the rate of the quick stop, and yields from there. A drive that does not follow gets the quick stop at once.
   It then holds the string, and is not disabled.
4. Disable, and confirm: torque off by status word, and the shaft at standstill without it.

The stop judges the shaft of the motor. A string below may go on swinging once the torque at the top has been quiet for
half a swing (`string_release.QUIET_S`). The motor does not follow, since its friction holds.

If the cycle brings no feedback any more (a drive that restarted, a foreign NMT command, lost frames), the stop reads
the drive by single requests. It does so too if the feedback reports a turning shaft after the time of the stop, and a
poll contradicts it (`FeedbackPolls`).

If the shaft goes on turning in spite of the quick stop (another master commands it, or the drive does not brake), the
stop ends the host's sign of life, so that the drive's own watchdog acts. It goes on watching the shaft.

A turning shaft is not disabled from here, but in two cases: the shaft accelerates against the quick stop, or its speed
is not believed above a drill string and it has run out without torque (decision 0024). If the drive can't be reached,
its own watchdog must act, and the report says so. No exception on the way, an interrupt included, skips a step.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from drivers import (
    Command,
    CommandRejected,
    Drive,
    Mode,
    Polled,
    Positioned,
    PowerState,
    RemovesTorque,
    Sample,
    StopNotConfirmed,
    StopsFeeding,
)
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.guard import kept_within
from tdhil.runner.observer import RUN_OUT_S, Signal
from tdhil.runner.settings import ControlAssumptions, MachineLimits
from tdhil.runner.standstill import NO_TORQUE, Standstill
from tdhil.runner.string_release import MEAN_S, StringRelease, StringReleaseLimits

# ---------------------------------------------------------------------------------------------------------------------
# Single polls of a drive (`drivers.drive.Polled`) for a stop without feedback of the cycle, or none to believe.
#
# A poll feeds what supervises the host. So it must not go on for ever at a shaft that is not slowing down: such a one
# is left to the drive's own watchdog, which wants silence (`Slowing`).


AFTER_S = 0.2
"""Without cyclic feedback for so long, the drive is polled."""

EVERY_S, MOST_S = 0.1, 0.4
"""Between two polls; twice as long after each that brought nothing, up to the second."""

SLOWING_S, SLOWER = 1.0, 0.98
"""Under polls alone the shaft must have lost so much of its speed each second."""


class FeedbackPolls:
    """Knows when a poll is due. ``only``: the cyclic feedback is not believed any more."""

    def __init__(self, drive: Drive, period_s: float) -> None:
        self._drive = drive if isinstance(drive, Polled) else None
        self._period_s = period_s
        self._missing_s = 0.0
        self._due_s = AFTER_S
        self._pause_s = EVERY_S
        self.only = False
        self.answered = 0

    @property
    def standing(self) -> bool:
        """Do polls stand in for the cycle's feedback at present?"""
        return self.only or self._missing_s > 0.0

    def heard(self) -> None:
        """The cycle brought feedback."""
        self._missing_s, self._due_s, self._pause_s = 0.0, AFTER_S, EVERY_S

    def missed(self) -> Sample | None:
        """A cycle has brought none: the drive's answer, where a poll was due and was answered. May raise."""
        self._missing_s += self._period_s
        if self._drive is None or self._missing_s < self._due_s - 1e-9:
            return None
        self._due_s = self._missing_s + self._pause_s
        self._pause_s = min(MOST_S, 2.0 * self._pause_s)
        return self.ask()

    def ask(self) -> Sample | None:
        """Poll now; None without an answer. May raise."""
        sample = self._drive.poll() if self._drive is not None else None
        if sample is not None:
            self.answered += 1
            self._due_s, self._pause_s = self._missing_s + EVERY_S, EVERY_S
        return sample


class Slowing:
    """Test of a shaft that must lose speed: to `SLOWER` of it within ``within_s``."""

    def __init__(self, at_rest_rad_s: float, within_s: float = SLOWING_S) -> None:
        self._at_rest_rad_s = at_rest_rad_s
        self._within_s = within_s
        self._since_s: float | None = None
        self._speed_rad_s = math.inf

    def reset(self) -> None:
        """Begin anew with the next sample."""
        self._since_s = None

    def see(self, time_s: float, speed_rad_s: float) -> bool:
        """False once a shaft that turns has not got slower for so long."""
        speed_rad_s = abs(speed_rad_s)
        if self._since_s is None or speed_rad_s <= max(self._at_rest_rad_s, SLOWER * self._speed_rad_s):
            self._since_s, self._speed_rad_s = time_s, speed_rad_s
        return time_s - self._since_s < self._within_s


# ---------------------------------------------------------------------------------------------------------------------
# How long a stop is waited for: by the ramp, and beyond it for as long as the shaft keeps getting slower. Pure.
#
# A heavy shaft at its torque limit takes J ω / T instead of the ramp's time, and one on a string swings on the way
# down: the highest speed of each block of 5 s must be lower than ever before by 1 %, or patience ends after two more
# blocks.


BLOCK_S = 5.0             # s; block whose highest speed is compared
BLOCKS = 2.0              # blocks without a lower speed that end the wait
SLOWER_SHARE = 0.99       # of the least peak so far: a block below it is slower
LONGEST_S = 300.0         # s; longest wait


class StopTimeout:
    """``see`` every sample and ``wait`` every cycle without one; ``over`` says when to give up."""

    def __init__(self, enough_s: float, at_rest_rad_s: float) -> None:
        self._enough_s = enough_s
        self._at_rest_rad_s = at_rest_rad_s
        self._block_s = 0.0
        self._peak = 0.0
        self._best = math.inf
        self._gained_s = 0.0
        self.waited_s = 0.0

    @property
    def over(self) -> bool:
        """Long enough, and no slower for two blocks; or longer than any stop may take."""
        no_gain_s = self.waited_s - self._gained_s
        return self.waited_s > LONGEST_S or (self.waited_s > self._enough_s and no_gain_s > BLOCKS * BLOCK_S)

    def wait(self, period_s: float) -> None:
        """A cycle has gone by."""
        self.waited_s += period_s
        self._block_s += period_s
        if self._block_s < BLOCK_S:
            return
        # A shaft that hardly moves gets no slower by noise alone.
        if self._at_rest_rad_s < self._peak < SLOWER_SHARE * self._best:
            self._best, self._gained_s = self._peak, self.waited_s
        self._block_s = self._peak = 0.0

    def see(self, speed_rad_s: float, period_s: float) -> None:
        """A cycle has gone by, and showed this speed."""
        self._peak = max(self._peak, abs(speed_rad_s))
        self.wait(period_s)


# ---------------------------------------------------------------------------------------------------------------------

AT_REST_SHARE = 0.005
"""Standstill is a speed below this share of the speed limit, or three quanta if that is more."""

LONGEST_GAP_S, LONGEST_GAP_CYCLES = 0.2, 3
"""Standstill must have been watched without a longer gap in the feedback than both; on a slow line a frame may go."""

POLLED_GAP_S = 0.6
"""The longest gap while polls stand in for the cycle: two polls without an answer, with the pauses after them, on a
computer that is late. One swing of a drill string lasts longer."""

SILENT_S, SILENT_CYCLES = 1.0, 25
"""After so long, and so many cycles, without any feedback the drive can't be reached: its watchdog stops the shaft."""

MODE_S = 0.5
"""The drive may take so long to change to speed mode."""

REST_AFTER_S = 10.0
"""A shaft that begins to turn once its torque is off gets so long to come to rest by itself."""

UNMOVED_S, UNMOVED_STRING_S, UNMOVED_RAMP_SHARE = 3.0, 10.0, 0.1
"""A shaft that got no slower for so long after the quick stop is left to the drive's watchdog; one with a string may
swing meanwhile. On a long ramp this share of it, from the highest speed, if that is more."""

MOST_INTERRUPTIONS = 5
"""The sequence begins anew after an exception of its own so many times; a request made twice does no harm."""

POSITION_EVERY_S = 0.25
"""Interval of reading a position that does not come with the cycle, while standstill is watched, s."""

TORQUE_BACK_S = 0.2
"""Before a quick stop whose speed signal is in doubt, zero torque is commanded for so long, s: some cycles, and the
drive's own torque ramp."""

TORQUE_FALLS_S = 0.5
"""Before a shaft runs out, the torque that it turned under goes to zero within this time, s."""

TORQUE_GONE_S = 2.0
"""The reported torque must have followed zero torque after so long, s."""

REPEAT_S = 1.0
"""Interval of repeating the quick stop while the drive shows no valid state, s."""

_STOPPING = (PowerState.QUICK_STOP, *NO_TORQUE)
_REST = Command(Mode.SPEED, 0.0, 0.0)
_NO_TORQUE_ASKED = Command(Mode.TORQUE, 0.0, 0.0)


@dataclass(frozen=True)
class StopReport:
    """How the stop went. ``confirmed``: seen at rest and disabled."""

    confirmed: bool
    at_rest_s: float | None            # control time at which the shaft was seen at rest
    disabled: bool
    trouble: tuple[str, ...] = ()
    trapped_nm: float = 0.0            # torque of a drill string at standstill, before its release; signed


class StopSequence:
    """Runs once; a second call gives the first one's report. ``watched``: the drive's own watchdog is armed."""

    def __init__(
        self,
        loop: ControlLoop,
        limits: MachineLimits,
        speed_resolution_rad_s: float,
        quick_stop_in_torque_mode: bool,
        assumptions: ControlAssumptions | None = None,
        *,
        torque_resolution_nm: float = 0.0,
        torque_offset_nm: float = 0.0,
        watched: bool = True,
    ) -> None:
        assumptions = assumptions or ControlAssumptions()
        self._loop = loop
        self._limits = limits
        self._at_rest_rad_s = max(3.0 * speed_resolution_rad_s, AT_REST_SHARE * limits.speed_max_rad_s)
        self._longest_gap_s = max(LONGEST_GAP_S, LONGEST_GAP_CYCLES * loop.period_s)
        self._settle_s = 3.0 * assumptions.largest_speed_lag_s
        # The ramp from the highest speed, with as much again for a drive at its torque limit, and the settling.
        ramp_s = limits.speed_max_rad_s / limits.quick_stop_rad_s2
        self._enough_s = 3.0 * ramp_s + 2.0 * self._settle_s + 1.0
        self._quick_stop_in_torque_mode = quick_stop_in_torque_mode
        self._watched = watched
        self._string = None
        if limits.winds_up:
            self._string = StringReleaseLimits(
                torque_nm=limits.torque_nm,
                speed_rad_s=limits.speed_max_rad_s,
                ramp_nm_s=limits.torque_ramp_nm_s,
                torque_resolution_nm=torque_resolution_nm,
                torque_offset_nm=torque_offset_nm,
            )
        self._held: deque[float] = deque(maxlen=loop.cycles(MEAN_S))
        self._trapped_nm = self._held_at_rest_nm = 0.0
        self._position_due_s = self._repeat_due_s = -math.inf
        self._torque_removed = False
        self._trouble: list[str] = []
        self._polls = FeedbackPolls(loop.drive, loop.period_s)
        self._slowing = Slowing(self._at_rest_rad_s)
        self._unmoved_s = max(
            UNMOVED_STRING_S if self._string is not None else UNMOVED_S, UNMOVED_RAMP_SHARE * ramp_s
        )
        self._fed = True
        self._silent = 0
        self._enough_silent = max(SILENT_CYCLES, loop.cycles(SILENT_S))
        self._running = False
        self._report: StopReport | None = None

    def run(self) -> StopReport:
        """Bring the shaft to rest and disable. Never raises; what went wrong is in the report."""
        if self._running:
            return StopReport(False, None, False, ("the stop sequence is under way already",))
        self._running = True
        for _ in range(MOST_INTERRUPTIONS):
            if self._report is not None:
                break
            try:
                self._report = self._sequence()
            except BaseException as error:  # an interrupt must not end it either: from the beginning, then
                self._note(error)
        self._running = False
        return self._report or StopReport(False, None, False, tuple(self._trouble))

    def _sequence(self) -> StopReport:
        self._loop.guard.expected = None
        self._loop.guard.observer.begin_stop()
        if self._loop.guard.observer.backwards or self._never_moved:
            coasted = self._coasted()
            if coasted is not None:
                return coasted
        elif self._string is not None and not self._speed_doubted and self._slow_down():
            self._release(self._string)
        if self._string is not None and self._speed_doubted:
            ran_out = self._run_out(self._string)
            if ran_out is not None:
                return ran_out
        at_rest_s = self._decelerate()
        disabled, stays = self._torque_removed, False
        if at_rest_s is not None and not self._wound_up():
            disabled = self._disable(self._loop.drive.disable)
            stays = disabled and self._stays_at_rest()
        return StopReport(stays, at_rest_s, disabled, tuple(self._trouble), self._trapped_nm)

    # -- with a drill string -----------------------------------------------------------------------------------

    def _slow_down(self) -> bool:
        """Speed mode, ramped to zero: whether the drive followed, and so holds the shaft under speed control now."""
        speed = self._begins_at()
        came_from, step = math.copysign(1.0, speed), self._limits.quick_stop_rad_s2 * self._loop.period_s
        patience = StopTimeout(self._enough_s, self._at_rest_rad_s)
        since_s = 0.0
        while not patience.over:
            speed = math.copysign(max(0.0, abs(speed) - step), came_from)
            sample = self._exchange(Command(Mode.SPEED, speed, 0.0))
            since_s += self._loop.period_s
            if sample is None:
                if self._silent >= self._enough_silent:
                    return False
                patience.wait(self._loop.period_s)
                continue
            regulated = sample.mode is Mode.SPEED
            if sample.state is not PowerState.ENABLED or (not regulated and since_s > MODE_S) or self._speed_doubted:
                return False
            self._ask_position(sample.time_s)
            if self._loop.guard.observer.runs_away(sample):
                return False
            patience.see(sample.speed_rad_s, self._loop.period_s)
            if regulated and speed == 0.0 and sample.speed_rad_s * came_from <= self._at_rest_rad_s:
                return True
        self._trouble.append("the shaft did not follow speed mode to standstill; quick stop instead")
        return False

    def _begins_at(self) -> float:
        """The speed that the ramp begins at: a single wrong report, or one beyond the limit, must not be followed."""
        seen = [one.speed_rad_s for one in (self._loop.last, self._loop.before) if one is not None]
        speed = min((one for one in seen if math.isfinite(one)), key=abs, default=0.0)
        most = self._limits.speed_max_rad_s
        return kept_within(speed, -most, most)

    def _release(self, string: StringReleaseLimits) -> None:
        """Yield to the trapped torque until nothing is left or the bounds are reached."""
        going = StringRelease(string, self._at_rest_rad_s, self._loop.period_s)
        command = _REST
        while not (going.done or going.failed or self._speed_doubted):
            sample = self._exchange(command)
            if sample is None:
                command = _REST
                if self._silent >= self._enough_silent:
                    return
                continue
            if sample.state is not PowerState.ENABLED or sample.mode is not Mode.SPEED:
                self._trouble.append(f"the drive shows '{sample.state.value}' during the release of trapped torque")
                break
            self._ask_position(sample.time_s)
            if self._loop.guard.observer.runs_away(sample):
                break
            command = Command(Mode.SPEED, going.step(sample.torque_nm, sample.speed_rad_s), 0.0)
        self._trapped_nm = going.trapped_nm
        if going.failed:
            self._trouble.append(
                f"trapped torque did not come down: {going.trapped_nm:.0f} N·m at first, {going.torque_nm:.0f} N·m"
                f" after {going.travel_rad:.1f} rad"
            )

    def _run_out(self, string: StringReleaseLimits) -> StopReport | None:
        """Bring the torque to zero in torque mode and wait until friction has stopped the shaft; then remove it.

        Speed control by a speed that is not believed would drive the shaft on, and so would the drive's watchdog, which
        brakes by the same signal. A speed that is believed again has shown how fast the shaft is, and not with which
        sign: the shaft stays without torque until it is at rest. None where the drive does not follow torque mode: then
        the quick stop has to do.
        """
        last = self._loop.last
        if last is None or last.state is not PowerState.ENABLED:
            return None
        observer = self._loop.guard.observer
        torque_nm = kept_within(last.torque_nm - string.torque_offset_nm, -string.torque_nm, string.torque_nm)
        # What flows while the shaft turns accelerates it and holds nothing: it goes at once.
        quick_nm_s = abs(torque_nm) / TORQUE_FALLS_S if observer.turned else 0.0
        step_nm = max(string.ramp_nm_s, quick_nm_s) * self._loop.period_s
        waited_s = without_s = 0.0
        while without_s < RUN_OUT_S:
            torque_nm = math.copysign(max(0.0, abs(torque_nm) - step_nm), torque_nm)
            sample = self._exchange(Command(Mode.TORQUE, 0.0, torque_nm))
            waited_s += self._loop.period_s
            if torque_nm == 0.0:
                without_s += self._loop.period_s
            if sample is None:
                if self._silent >= self._enough_silent:
                    return None
                continue
            other_mode = sample.mode is not Mode.TORQUE and waited_s > MODE_S
            if sample.state is not PowerState.ENABLED or other_mode:
                return None
            held_nm = abs(sample.torque_nm - string.torque_offset_nm)
            if not self._speed_doubted:
                return self._coasted()
            if without_s > TORQUE_GONE_S and held_nm > 2.0 * string.residual_nm:
                return None
        why = f" ({observer.doubt.what})" if observer.doubt is not None else ""
        self._trouble.append(
            f"torque removed: the reported speed is not believed{why}. The drive gave no torque for {without_s:.0f} s,"
            " in which friction stops the shaft; standstill was not seen"
        )
        self._remove_torque(_NO_TORQUE_ASKED)
        return StopReport(False, None, self._torque_removed, tuple(self._trouble), self._trapped_nm)

    def _wound_up(self) -> bool:
        """Return whether the drive holds a torque that disabling would release at once."""
        last = self._loop.last
        if self._string is None or not self._held or last is None or last.state in NO_TORQUE:
            return False
        held_nm = math.fsum(self._held) / len(self._held) - self._string.torque_offset_nm
        if abs(held_nm) <= 2.0 * self._string.residual_nm:
            return False
        self._trouble.append(
            f"the drill string still holds {held_nm:.0f} N·m: the drive was not disabled and holds the shaft at rest"
        )
        return True

    # -- with any load -----------------------------------------------------------------------------------------

    def _decelerate(self) -> float | None:
        if self._speed_doubted and self._string is None:
            self._take_torque_back()
        if not self._quick_stop_in_torque_mode:
            for _ in range(self._loop.cycles(MODE_S)):
                sample = self._exchange(_REST)
                if sample is not None and sample.mode is Mode.SPEED:
                    break
        asked = self._ask(self._loop.drive.quick_stop)
        at_rest_s = self._see_rest(asked)
        if at_rest_s is None and self._silent < self._enough_silent and self._contradicted():
            at_rest_s = self._see_rest(asked)
        return at_rest_s

    def _coast(self) -> float | None:
        """Give no torque in torque mode until the shaft is at rest: None where the drive does not do it.

        For a shaft that speed control would drive on: the sign of a report is inverted, which does not matter for
        standstill, or no motion has ever been reported.
        """
        rest = Standstill(self._loop.guard.observer, self._at_rest_rad_s, self._settle_s, self._longest_gap_s)
        patience = StopTimeout(self._enough_s + rest.settle_s, self._at_rest_rad_s)
        while not patience.over:
            sample = self._exchange(_NO_TORQUE_ASKED)
            if sample is None:
                if self._silent >= self._enough_silent:
                    return None
                patience.wait(self._loop.period_s)
                continue
            self._ask_position(sample.time_s)
            torque_mode = sample.mode is Mode.TORQUE and sample.state is PowerState.ENABLED
            if not torque_mode or self._loop.guard.observer.runs_away(sample):
                return None
            patience.see(sample.speed_rad_s, self._loop.period_s)
            if rest.see(sample, without_torque=True):
                return sample.time_s
        return None

    def _coasted(self) -> StopReport | None:
        """Coast to rest, then disable; None where the drive does not coast."""
        at_rest_s = self._coast()
        if at_rest_s is None:
            return None
        disabled = self._remove_torque(_NO_TORQUE_ASKED)
        stays = disabled and self._stays_at_rest()
        return StopReport(stays, at_rest_s, disabled, tuple(self._trouble), self._trapped_nm)

    def _take_torque_back(self) -> None:
        """Command zero torque in torque mode first.

        Speed control would go on holding the torque that flows, with a speed signal that does not answer.
        """
        last = self._loop.last
        if last is None or last.mode is not Mode.TORQUE or last.state is not PowerState.ENABLED:
            return
        for _ in range(self._loop.cycles(TORQUE_BACK_S)):
            self._exchange(Command(Mode.TORQUE, 0.0, 0.0))

    @property
    def _never_moved(self) -> bool:
        """Above a string: torque was given, and no motion reported. Speed control could drive an unseen shaft on."""
        observer, last = self._loop.guard.observer, self._loop.last
        in_torque = last is not None and last.mode is Mode.TORQUE and last.state is PowerState.ENABLED
        return self._string is not None and in_torque and observer.unseen_s > 0.0

    @property
    def _speed_doubted(self) -> bool:
        """Return whether the drive's speed control cannot be relied on: its report of speed contradicts another."""
        return not self._loop.guard.observer.believable

    def _see_rest(self, asked: bool) -> float | None:
        observer = self._loop.guard.observer
        rest = Standstill(observer, self._at_rest_rad_s, self._settle_s, self._longest_gap_s)
        patience = StopTimeout(self._enough_s + rest.settle_s - self._settle_s, self._at_rest_rad_s)
        braking = Slowing(self._at_rest_rad_s, self._unmoved_s)
        while not patience.over:
            asked = asked or self._ask(self._loop.drive.quick_stop)
            sample = self._exchange(_REST, or_poll=True)
            if sample is None:
                if self._silent >= self._enough_silent:
                    self._trouble.append("no feedback from the drive any more")
                    return None
                patience.wait(self._loop.period_s)
                continue
            self._ask_position(sample.time_s)
            if sample.state not in _STOPPING and sample.time_s >= self._repeat_due_s:
                self._repeat_due_s, asked = sample.time_s + REPEAT_S, False
            if self._removes_torque(sample):
                return None
            speed_rad_s = observer.speed_rad_s(sample)
            if not self._gets_slower(sample):
                return None
            patience.see(speed_rad_s, self._loop.period_s)
            if not braking.see(sample.time_s, speed_rad_s) and self._leave_to_watchdog(sample):
                patience = StopTimeout(self._enough_s + self._limits.watchdog_s, self._at_rest_rad_s)
            if rest.see(sample, POLLED_GAP_S if self._polls.standing else 0.0) and self._poll_agrees(rest):
                self._held_at_rest_nm = math.fsum(self._held) / len(self._held)
                return sample.time_s
        if observer.doubt is not None and not observer.believable:
            self._trouble.append(
                f"standstill cannot be confirmed: {observer.doubt.what}. The drive was not disabled"
            )
        elif patience.waited_s:
            self._trouble.append(
                f"the shaft was not seen at rest within {patience.waited_s:.1f} s of the quick stop"
            )
        return None

    def _ask_position(self, now_s: float) -> None:
        """A position that does not come with the cycle: one question beside it, now and then."""
        drive = self._loop.drive
        coming = self._loop.guard.observer.heard_position(now_s, 2.0 * POSITION_EVERY_S)
        if coming or now_s < self._position_due_s or not isinstance(drive, Positioned) or not self._fed:
            return
        self._position_due_s = now_s + POSITION_EVERY_S
        try:
            reading = drive.read_position()
        except BaseException as error:  # whatever it is, the stop goes on
            self._note(error)
            return
        if reading is not None:
            self._loop.guard.observer.see_reading(reading)

    def _poll_agrees(self, rest: Standstill) -> bool:
        """Before the drive is disabled, a single request must show standstill too, where the drive answers it."""
        drive = self._loop.drive
        if self._polls.standing or not isinstance(drive, Polled):
            return True
        try:
            sample = drive.poll()
        except BaseException as error:  # whatever it is, the stop goes on
            self._note(error)
            return True
        if sample is None or rest.quiet(sample):
            return True
        self._trouble.append(
            f"the cycle reports standstill, a single request {sample.speed_rad_s:.3f} rad/s: the drive was not disabled"
        )
        return False

    def _removes_torque(self, sample: Sample) -> bool:
        """Switch the torque of a shaft off that accelerates against the quick stop.

        See `docs/decisions` for when that is done above a drill string.
        """
        how = self._loop.guard.observer.runs_away(sample)
        if not how:
            return False
        self._trouble.append(
            f"torque removed: the shaft accelerates against the quick stop ({how}). It runs out without a brake"
        )
        self._remove_torque()
        return True

    def _remove_torque(self, command: Command = _REST) -> bool:
        drive = self._loop.drive
        request = drive.remove_torque if isinstance(drive, RemovesTorque) else drive.disable
        self._torque_removed = self._disable(request, command)
        return self._torque_removed

    def _leave_to_watchdog(self, sample: Sample) -> bool:
        """Once: from now on the drive's own watchdog hears nothing more. Whether that was done now."""
        drive = self._loop.drive
        # The drive's watchdog brakes by the same speed signal: with that in doubt the torque is watched from here.
        doubt = self._loop.guard.observer.doubt
        if doubt is not None and Signal.ALL not in doubt.signals:
            return False
        if not (self._fed and self._watched and isinstance(drive, StopsFeeding)):
            return False
        try:
            drive.stop_feeding()
        except CommandRejected as error:   # it would not help: another client feeds the watchdog, too
            self._fed = False
            self._note(error)
            return False
        except BaseException as error:  # whatever it is, the stop goes on
            self._note(error)
            return False
        self._fed = False
        self._trouble.append(
            f"the shaft goes on turning at {sample.speed_rad_s:.3f} rad/s in spite of the quick stop: the host's sign"
            " of life was ended, so that the drive's own watchdog acts"
        )
        return True

    def _disable(self, request: Callable[[], None], command: Command = _REST) -> bool:
        asked = self._ask(request)
        for _ in range(self._loop.cycles(3.0)):
            asked = asked or self._ask(request)
            sample = self._exchange(command, or_poll=True)
            if sample is not None and sample.state in (PowerState.OFF, PowerState.FAULT):
                return True
            if self._silent >= self._enough_silent:
                break
        self._trouble.append("the drive did not confirm that it is disabled")
        return False

    def _stays_at_rest(self) -> bool:
        """Nothing turns the shaft now that nothing holds it; it was seen at rest before."""
        quiet_s, told, heard_s = 0.0, False, self._loop.now_s
        enough_s = max(self._settle_s, min(0.8 * REST_AFTER_S, self._loop.guard.observer.shows_s(
            self._at_rest_rad_s, self._held_at_rest_nm)))
        for _ in range(self._loop.cycles(REST_AFTER_S)):
            sample = self._exchange(_REST, or_poll=True)
            if sample is None:
                if self._silent >= self._enough_silent:
                    self._trouble.append("nothing was heard of the drive once it was disabled")
                    return True
                continue
            # Polls are further apart than cycles are; a longer gap shows nothing.
            apart_s = sample.time_s - heard_s if self._polls.standing else 0.0
            quiet_s += max(self._loop.period_s, min(self._longest_gap_s, apart_s))
            heard_s = sample.time_s
            if not abs(self._loop.guard.observer.speed_rad_s(sample)) <= self._at_rest_rad_s:
                quiet_s = 0.0
                if not told:
                    told = True
                    self._trouble.append(
                        f"the shaft began to turn ({sample.speed_rad_s:.3f} rad/s) once its torque was off:"
                        " is torque trapped in the load, or does a weight hang on it?"
                    )
            elif quiet_s >= enough_s:
                return True
        return False

    def _ask(self, request: Callable[[], None]) -> bool:
        """Return whether the drive took a request; one that fails is made again in the next cycle."""
        try:
            request()
        except BaseException as error:  # whatever it is, the stop goes on
            self._note(error)
            return False
        return True

    def _note(self, error: BaseException) -> None:
        if len(self._trouble) < 20:
            self._trouble.append(str(error) or type(error).__name__)

    def _exchange(self, command: Command, *, or_poll: bool = False) -> Sample | None:
        """One cycle's feedback; where there is none, a poll's, if that may be taken and one is due."""
        sample: Sample | None = None
        try:
            sample = self._loop.stop_cycle(command)
        except BaseException as error:  # whatever it is, the stop goes on
            self._note(error)
        if sample is None or not sample.fresh or (or_poll and self._polls.only):
            sample = self._poll() if or_poll else None
            if sample is not None:
                self._loop.guard.observer.see(command, sample)
        else:
            self._polls.heard()
            self._slowing.reset()
        if sample is None:
            self._silent += 1
            return None
        self._silent = 0
        self._loop.last = sample
        self._held.append(sample.torque_nm)
        return sample

    # -- polls beside the cycle --------------------------------------------------------------------------------

    def _poll(self) -> Sample | None:
        try:
            sample = self._polls.missed()
        except BaseException as error:  # whatever it is, the stop goes on
            self._note(error)
            return None
        if sample is not None and self._polls.answered == 1:
            self._held.clear()             # what was held before the gap tells nothing of now
            self._trouble.append("the cycle brings no feedback: the drive was asked one question at a time instead")
        return sample

    def _contradicted(self) -> bool:
        """Compare a poll with the feedback of the cycle. If they differ, only polls are believed from now on."""
        told = self._loop.last
        try:
            sample = self._polls.ask()
        except BaseException as error:  # whatever it is, the stop goes on
            self._note(error)
            return False
        if sample is None or told is None:
            return False
        rest = self._at_rest_rad_s
        other_state = sample.state in _STOPPING and told.state not in _STOPPING
        self._polls.only = other_state or (abs(sample.speed_rad_s) <= rest and not abs(told.speed_rad_s) <= rest)
        if self._polls.only:
            self._held.clear()
            self._trouble.append(
                f"the cycle's feedback tells of {told.speed_rad_s:.3f} rad/s, and a look at the drive of"
                f" {sample.speed_rad_s:.3f} rad/s: the cycle's is not believed any more"
            )
        return self._polls.only

    def _gets_slower(self, sample: Sample) -> bool:
        """A shaft that polls alone show, and that goes on turning, is left to the drive's own watchdog, if armed."""
        if not (self._watched and self._polls.standing) or self._slowing.see(sample.time_s, sample.speed_rad_s):
            return True
        self._trouble.append(
            f"the shaft goes on turning at {sample.speed_rad_s:.3f} rad/s without feedback of the cycle: the drive is"
            " left alone, so that its own watchdog acts"
        )
        return False


def not_confirmed(report: StopReport) -> StopNotConfirmed:
    """The loudest error there is."""
    return StopNotConfirmed(
        "the stop was NOT confirmed: " + (report.trouble[-1] if report.trouble else "no standstill seen"),
        where="stop sequence",
        next_step="Use the hard-wired emergency stop now. The drive's own watchdog stops the shaft if it was armed",
    )
