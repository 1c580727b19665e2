"""The one stop sequence, for every cause and for the normal end.

1. Quick stop under the drive's speed control. If the profile states that a quick stop does not decelerate the shaft
   from torque mode, the stop commands speed mode at zero speed first. If the drive stays in torque mode, the stop
   brings the torque to zero there, and friction stops the shaft. With a drill string the torque falls on the rig's
   ramp, which releases the trapped torque. The quick stop follows only if the shaft is not seen at standstill.
2. Wait for standstill, by status word and by speed. The reported speed lags, so it must stay at zero for longer than
   the largest plausible lag. The time depends on the torque limit and on torsional vibration: the stop waits as long
   as the shaft becomes slower.
3. With a drill string, release the trapped torque under speed control, on the rig's ramp (`string_release`). A drive
   may end a quick stop by switching its torque off, so the release comes first: the shaft is brought to standstill in
   speed mode, at the rate of the quick stop, and yields from there. If the drive does not follow, the stop requests the
   quick stop at once. The drive then holds the string, and is not disabled.
4. Disable, and confirm: torque off by status word, and the shaft at standstill without it.

Standstill means standstill of the motor shaft. A string below may continue to oscillate after the torque at the top has
been quiet for half a period (`string_release.QUIET_S`). The motor does not follow, because its friction holds it.

If the cycle brings no feedback any more (a drive that restarted, a foreign NMT command, lost frames), the stop reads
the drive by single requests. It also does so if the feedback still reports a turning shaft when the time of the stop
is over, and a poll contradicts it (`FeedbackPolls`).

If the shaft continues to turn after the quick stop (another master commands it, or the drive does not brake), the host
stops feeding the drive's watchdog, so that the watchdog acts. The stop continues to watch the shaft.

The stop removes the torque of a turning shaft in two cases only: the shaft accelerates against the quick stop; or, with
a drill string and a speed that is not believed, friction has had time to stop it without torque (decision 0024). If the
drive can't be reached, its own watchdog must act, and the report states it. No exception or interrupt skips a step.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from drivers import (
    Command,
    CommandRejected,
    Mode,
    ModeNotConfirmed,
    Polled,
    Positioned,
    PowerState,
    RemovesTorque,
    Sample,
    StopNotConfirmed,
    StopsFeeding,
)
from profiles.quantities import in_nm
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.feedback_polls import SLOWING_S, FeedbackPolls, Slowing
from tdhil.runner.guard import kept_within
from tdhil.runner.observer import FASTER_SHARE, RUN_OUT_S, Signal
from tdhil.runner.settings import ControlAssumptions, MachineLimits
from tdhil.runner.standstill import NO_TORQUE, CountsOfNoise, Standstill, standstill_speed
from tdhil.runner.string_release import MEAN_S, StringRelease, StringReleaseLimits

# ---------------------------------------------------------------------------------------------------------------------
# Longest wait for standstill: the time of the ramp, and beyond it as long as the shaft keeps becoming slower. Pure.
#
# A heavy shaft at its torque limit takes J ω / T instead of the ramp's time, and a shaft with a string oscillates while
# it slows down. So the highest speed of a block of 5 s is compared with that of all blocks before. If no block is lower
# by 1 % for two blocks, the wait ends.


BLOCK_S = 5.0             # s; block whose highest speed is compared
BLOCKS = 2.0              # blocks without a lower speed that end the wait
SLOWER_SHARE = 0.99       # of the least peak so far: a block below it is slower
LONGEST_S = 300.0         # s; longest wait


class StopTimeout:
    """Longest wait for standstill. Call `see` for every sample and `wait` for every cycle without one, until `over`."""

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
        """Return whether the wait ends: the ramp's time is over and two blocks were no slower, or after LONGEST_S."""
        no_gain_s = self.waited_s - self._gained_s
        return self.waited_s > LONGEST_S or (self.waited_s > self._enough_s and no_gain_s > BLOCKS * BLOCK_S)

    def ends(self, coasts_s: float) -> bool:
        """Return whether the wait ends for a shaft that may coast for ``coasts_s`` more, s."""
        return self.over and (coasts_s <= 0.0 or self.waited_s > LONGEST_S)

    def wait(self, period_s: float) -> None:
        """Count a cycle."""
        self.waited_s += period_s
        self._block_s += period_s
        if self._block_s < BLOCK_S:
            return
        # At standstill a lower peak is noise only, and does not extend the wait.
        if self._at_rest_rad_s < self._peak < SLOWER_SHARE * self._best:
            self._best, self._gained_s = self._peak, self.waited_s
        self._block_s = self._peak = 0.0

    def see(self, speed_rad_s: float, period_s: float) -> None:
        """Count a cycle with this reported speed, rad/s."""
        self._peak = max(self._peak, abs(speed_rad_s))
        self.wait(period_s)


# ---------------------------------------------------------------------------------------------------------------------

LONGEST_GAP_S, LONGEST_GAP_CYCLES = 0.2, 3
"""Longest gap in the feedback at standstill, s and cycles (the longer one counts); a slow line may lose a frame."""

POLLED_GAP_S = 0.6
"""Longest gap while polls replace the cycle's feedback, s: two polls without an answer, with the pauses after them, on
a computer that is late. One oscillation of a drill string lasts longer."""

SILENT_S, SILENT_CYCLES = 1.0, 25
"""Time, s, and cycles without any feedback after which the drive can't be reached: its watchdog stops the shaft."""

MODE_S = 0.5
"""Longest time of the drive to change to speed mode, s."""

REST_AFTER_S = 10.0
"""Time for a shaft that begins to turn when its torque is off to come to rest by itself, s."""

UNMOVED_S, UNMOVED_STRING_S, UNMOVED_RAMP_SHARE = 3.0, 10.0, 0.1
"""Time without slowing down after the quick stop, s, after which the drive's watchdog is left to act; longer with a
string, which may oscillate. The third value is a share of the ramp's time from the highest speed, used if longer."""

MOST_INTERRUPTIONS = 5
"""Largest number of attempts: the sequence starts again after an exception of its own. Repeated requests do no harm."""

POSITION_EVERY_S = 0.25
"""Interval of reading a position that does not come with the cycle, while standstill is watched, s."""

TORQUE_BACK_S = 0.2
"""Duration of zero torque before a quick stop whose speed signal is in doubt, s: some cycles, and the drive's own
torque ramp."""

TORQUE_FALLS_S = 0.5
"""Time within which the torque of a turning shaft is brought to zero before it runs out, s."""

TORQUE_GONE_S = 2.0
"""Time after which the reported torque must have followed zero torque, s."""

REPEAT_S = 1.0
"""Interval of repeating the quick stop while the drive shows no valid state, s."""

_DENIED = (": the reported speed was zero, but the drive's status did not show standstill. The drive's speed threshold "
           "of standstill may be below the noise of its speed")

_STOPPING = (PowerState.QUICK_STOP, *NO_TORQUE)
_REST = Command(Mode.SPEED, 0.0, 0.0)
_NO_TORQUE_ASKED = Command(Mode.TORQUE, 0.0, 0.0)


@dataclass(frozen=True)
class QuickStopKind:
    """Quick stop of the drive: whether it brakes in torque mode, and whether the torque is off at its end."""

    in_torque_mode: bool
    ends_off: bool = False


@dataclass(frozen=True)
class StopReport:
    """Result of the stop. ``confirmed``: the shaft was seen at standstill, and the drive is disabled."""

    confirmed: bool
    at_rest_s: float | None            # control time at which the shaft was seen at rest
    disabled: bool
    trouble: tuple[str, ...] = ()
    trapped_nm: float = 0.0            # torque of a drill string at standstill, before its release; signed
    stayed_in_torque_mode: bool = False    # speed mode was needed for the stop, and not confirmed
    beside: tuple[str, ...] = ()       # errors of log, observer and display meanwhile, each once
    torque_removed: bool = False       # the drive was disabled before the shaft was seen at standstill


class StopSequence:
    """Stop sequence of one run; it runs once, and later calls return its report. ``watched``: the watchdog is armed."""

    def __init__(
        self,
        loop: ControlLoop,
        limits: MachineLimits,
        speed_resolution_rad_s: float,
        quick_stop: QuickStopKind,
        assumptions: ControlAssumptions | None = None,
        *,
        torque_resolution_nm: float = 0.0,
        torque_offset_nm: float = 0.0,
        watched: bool = True,
    ) -> None:
        assumptions = assumptions or ControlAssumptions()
        self._loop = loop
        self._limits = limits
        self._at_rest_rad_s = standstill_speed(limits, speed_resolution_rad_s)
        self._longest_gap_s = max(LONGEST_GAP_S, LONGEST_GAP_CYCLES * loop.period_s)
        self._settle_s = 3.0 * assumptions.largest_speed_lag_s
        # Three times the ramp from the highest speed, for a drive at its torque limit, and the settling.
        ramp_s = limits.speed_max_rad_s / limits.quick_stop_rad_s2
        self._enough_s = 3.0 * ramp_s + 2.0 * self._settle_s + 1.0
        self._quick_stop = quick_stop
        self._watched = watched
        self._string = None
        if limits.has_drill_string:
            self._string = StringReleaseLimits(
                torque_nm=limits.torque_nm,
                speed_rad_s=limits.speed_max_rad_s,
                ramp_nm_s=limits.torque_ramp_nm_s,
                torque_resolution_nm=torque_resolution_nm,
                torque_offset_nm=torque_offset_nm,
            )
        self._held: deque[float] = deque(maxlen=loop.cycles(MEAN_S))
        self._trapped_nm = self._held_at_rest_nm = 0.0
        self._position_due_s = self._position_read_s = self._repeat_due_s = -math.inf
        self._torque_removed = self._stayed_in_torque_mode = self._disagreed = False
        self._trouble: list[str] = []
        self._polls = FeedbackPolls(loop.drive, loop.period_s)
        self._slowing = Slowing(self._at_rest_rad_s, max(SLOWING_S, UNMOVED_RAMP_SHARE * ramp_s))
        self._unmoved_s = max(
            UNMOVED_STRING_S if self._string is not None else UNMOVED_S, UNMOVED_RAMP_SHARE * ramp_s
        )
        self._fed = True
        self._silent = 0
        self._enough_silent = max(SILENT_CYCLES, loop.cycles(SILENT_S))
        self._running = False
        self._report: StopReport | None = None

    def run(self) -> StopReport:
        """Bring the shaft to standstill and disable the drive. Never raises: errors are in the report."""
        if self._running:
            return StopReport(False, None, False, ("the stop sequence is under way already",))
        self._running = True
        for _ in range(MOST_INTERRUPTIONS):
            if self._report is not None:
                break
            try:
                self._report = self._sequence()
            except BaseException as error:  # an interrupt must not end the stop either: start again
                self._note(error)
        self._running = False
        return self._report or StopReport(False, None, False, tuple(self._trouble))

    def _sequence(self) -> StopReport:
        self._loop.guard.expected = None
        self._loop.guard.observer.begin_stop(ends_off=self._quick_stop.ends_off)
        backwards = self._loop.guard.observer.backwards
        if backwards and self._string is None and not self._in_torque_mode and self._remove_torque():
            self._trouble.append("torque removed: the shaft turned backwards on a forward command, so the drive's speed"
                                 " control may accelerate it. Friction stops it")
            return self._coasted(released=True) or self._ended(False, None, True)
        if (backwards and self._in_torque_mode) or self._never_moved:
            coasted = self._coasted()
            if coasted is not None:
                return coasted
        elif self._string is not None and not self._speed_doubted and self._slow_down():
            self._release(self._string)
        if self._string is not None and self._speed_doubted:
            ran_out = self._run_out(self._string)
            if ran_out is not None:
                return ran_out
        braked = self._brake_in_torque_mode()
        if braked is not None:
            return braked
        at_rest_s = self._decelerate()
        disabled, stays = self._torque_removed, False
        if at_rest_s is not None and not self._wound_up():
            disabled = self._disable(self._loop.drive.disable)
            stays = disabled and self._stays_at_rest()
        return self._ended(stays, at_rest_s, disabled)

    def _ended(self, confirmed: bool, at_rest_s: float | None, disabled: bool) -> StopReport:
        return StopReport(confirmed, at_rest_s, disabled, tuple(self._trouble), self._trapped_nm,
                          self._stayed_in_torque_mode, tuple(self._loop.stop_side_troubles), self._torque_removed)

    # -- with a drill string -----------------------------------------------------------------------------------

    def _slow_down(self) -> bool:
        """Ramp to zero in speed mode. Return whether the drive followed and holds the shaft under speed control."""
        speed = self._begins_at()
        came_from, step = math.copysign(1.0, speed), self._limits.quick_stop_rad_s2 * self._loop.period_s
        patience = StopTimeout(self._enough_s, self._at_rest_rad_s)
        since_s, held_nm = 0.0, self._torque_held_nm()
        while not patience.over:
            speed = math.copysign(max(0.0, abs(speed) - step), came_from)
            sample = self._exchange(Command(Mode.SPEED, speed, held_nm))
            since_s += self._loop.period_s
            if sample is None:
                if self._silent >= self._enough_silent:
                    return False
                patience.wait(self._loop.period_s)
                continue
            regulated = sample.mode is Mode.SPEED
            if regulated:
                held_nm = 0.0
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

    def _torque_held_nm(self) -> float:
        """Return the torque in torque mode, N·m; else 0. The setpoint keeps it until the drive shows speed mode, so
        that a drive that switches late does not drop the torque of the string.
        """
        last = self._loop.last
        if last is None or last.mode is not Mode.TORQUE or not math.isfinite(last.torque_nm):
            return 0.0
        return kept_within(last.torque_nm, -self._limits.torque_nm, self._limits.torque_nm)

    def _begins_at(self) -> float:
        """Return the ramp's first speed, rad/s: a single wrong report, or one above the limit, must not be followed."""
        seen = [one.speed_rad_s for one in (self._loop.last, self._loop.before) if one is not None]
        speed = min((one for one in seen if math.isfinite(one)), key=abs, default=0.0)
        most = self._limits.speed_max_rad_s
        return kept_within(speed, -most, most)

    def _release(self, string: StringReleaseLimits) -> None:
        """Yield to the trapped torque until it is released or the limits of the release are reached."""
        going = StringRelease(string, self._at_rest_rad_s, self._loop.period_s)
        noise = CountsOfNoise(self._loop.guard.observer, self._at_rest_rad_s)
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
            explained = noise.explains(sample.speed_rad_s, quiet=abs(sample.speed_rad_s) <= self._at_rest_rad_s)
            if not explained:
                noise.restart()
            speed = going.step(sample.torque_nm, sample.speed_rad_s, sample.position_rad, noise=explained)
            command = Command(Mode.SPEED, speed, 0.0)
        self._trapped_nm = going.trapped_nm
        if going.failed and abs(going.torque_nm) > string.residual_nm:
            self._trouble.append(
                f"trapped torque did not come down: {in_nm(going.trapped_nm)} at first, {in_nm(going.torque_nm)}"
                f" after {going.travel_rad:.1f} rad"
            )

    def _run_out(self, string: StringReleaseLimits) -> StopReport | None:
        """Bring the torque to zero in torque mode, give friction the time to stop the shaft, then remove the torque.

        Speed control with a speed that is not believed could accelerate the shaft. So could the drive's watchdog, which
        brakes with the same signal. If the speed is believed again, its magnitude is known, but not its sign: the shaft
        stays without torque until standstill. Returns None if the drive does not follow torque mode: then only the
        quick stop is left.
        """
        last = self._loop.last
        if last is None or last.state is not PowerState.ENABLED:
            return None
        observer = self._loop.guard.observer
        torque_nm = kept_within(last.torque_nm - string.torque_offset_nm, -string.torque_nm, string.torque_nm)
        # While the shaft turns, the flowing torque accelerates it and holds nothing: bring it to zero quickly.
        quick_nm_s = abs(torque_nm) / TORQUE_FALLS_S if observer.turned else 0.0
        step_nm = max(string.ramp_nm_s, quick_nm_s) * self._loop.period_s
        waited_s = without_s = 0.0
        while without_s < RUN_OUT_S:
            torque_nm = math.copysign(max(0.0, abs(torque_nm) - step_nm), torque_nm)
            sample = self._exchange(Command(Mode.TORQUE, 0.0, torque_nm))
            waited_s += self._loop.period_s
            if torque_nm == 0.0:
                if without_s == 0.0:
                    self._held.clear()         # a mean of zero torque alone, for a report with noise
                without_s += self._loop.period_s
            if sample is None:
                if self._silent >= self._enough_silent:
                    return None
                continue
            other_mode = sample.mode is not Mode.TORQUE and waited_s > MODE_S
            if sample.state is not PowerState.ENABLED or other_mode:
                return None
            if not self._speed_doubted:
                return self._coasted()
            held_nm = self._mean_torque_nm - string.torque_offset_nm
            if without_s > TORQUE_GONE_S and abs(held_nm) > 2.0 * string.residual_nm:
                self._trouble.append(
                    f"the drive still reports {in_nm(held_nm)} {without_s:.1f} s after zero torque was commanded: quick"
                    " stop instead")
                return None
        why = f" ({observer.doubt.what})" if observer.doubt is not None else ""
        self._trouble.append(
            f"torque removed: the reported speed is not believed{why}. The drive gave no torque for {without_s:.0f} s,"
            " in which friction stops the shaft; standstill was not seen"
        )
        self._remove_torque(_NO_TORQUE_ASKED)
        return self._ended(False, None, self._torque_removed)

    def _ramp_torque_down(self, string: StringReleaseLimits) -> bool:
        """Bring the torque to zero in torque mode. Return whether the drive followed, with a speed that is believed.

        The torque falls on the rig's ramp: the shaft slows down to standstill, and yields to the string from there. If
        the shaft becomes faster, the torque accelerates it, and falls within `TORQUE_FALLS_S`.
        """
        observer, begins_rad_s = self._loop.guard.observer, self._begins_at()
        torque_nm = self._torque_held_nm() - string.torque_offset_nm
        sign, nm_s = math.copysign(1.0, torque_nm), string.ramp_nm_s
        quick_nm_s = max(nm_s, abs(torque_nm) / TORQUE_FALLS_S)
        highest_rad_s = min(
            string.speed_rad_s, max(0.0, sign * begins_rad_s) + FASTER_SHARE * string.speed_rad_s)
        turns = True
        while torque_nm != 0.0:
            torque_nm = sign * max(0.0, abs(torque_nm) - nm_s * self._loop.period_s)
            sample = self._exchange(Command(Mode.TORQUE, 0.0, torque_nm))
            if sample is None:
                if self._silent >= self._enough_silent:
                    return False
                continue
            if sample.state is not PowerState.ENABLED or sample.mode is not Mode.TORQUE or self._speed_doubted:
                return False
            self._ask_position(sample.time_s)
            speed_rad_s = sign * observer.speed_rad_s(sample)
            if speed_rad_s > highest_rad_s or observer.runs_away(sample):
                nm_s = quick_nm_s
            if turns and speed_rad_s <= self._at_rest_rad_s:
                turns, self._trapped_nm = False, torque_nm
        return True

    def _wound_up(self) -> bool:
        """Return whether the drive holds a torque that disabling would release at once."""
        last = self._loop.last
        if self._string is None or not self._held or last is None or last.state in NO_TORQUE:
            return False
        held_nm = self._mean_torque_nm - self._string.torque_offset_nm
        if abs(held_nm) <= 2.0 * self._string.residual_nm:
            return False
        self._trouble.append(
            f"the drill string still holds {in_nm(held_nm)}: the drive was not disabled and holds the shaft"
        )
        return True

    # -- with any load -----------------------------------------------------------------------------------------

    def _brake_in_torque_mode(self) -> StopReport | None:
        """Stop a drive that stays in torque mode, where its quick stop may not brake. Return None if the quick stop is
        next: it brakes there, the drive left torque mode, or standstill was not seen.
        """
        string = self._string
        if self._speed_doubted and string is None and self._in_torque_mode:
            # With a speed signal that does not respond, speed control would continue to hold the flowing torque.
            for _ in range(self._loop.cycles(TORQUE_BACK_S)):
                self._exchange(Command(Mode.TORQUE, 0.0, 0.0))
        if self._quick_stop.in_torque_mode:
            return None
        # With a string and a believed speed, `_slow_down` has given the drive its time.
        waited = string is not None and not self._speed_doubted and self._in_torque_mode
        if not waited and self._reaches_speed_mode():
            return None
        if string is not None and self._speed_doubted:     # `_run_out` has tried it
            return None
        if self._silent >= self._loop.cycles(MODE_S):      # no feedback shows the mode; the quick stop's polls may
            return None
        self._stayed_in_torque_mode = True
        self._trouble.append(
            f"the drive stayed in torque mode: it did not confirm speed mode within {MODE_S:.1f} s. Its profile does"
            " not state that a quick stop brakes there, so the torque was brought to zero, for friction to stop the"
            " shaft"
        )
        stopped = self._coasted() if string is None or self._ramp_torque_down(string) else None
        if stopped is None:
            self._trouble.append(
                "standstill was not seen at zero torque in torque mode: quick stop instead, which may not brake. Keep"
                " the hard-wired emergency stop in reach"
            )
        return stopped

    def _reaches_speed_mode(self) -> bool:
        """Command speed mode at zero speed. Return False if the drive is still in torque mode after `MODE_S`."""
        for _ in range(self._loop.cycles(MODE_S)):
            sample = self._exchange(_REST)
            if sample is not None and sample.mode is Mode.SPEED:
                return True
        return not self._in_torque_mode

    def _decelerate(self) -> float | None:
        # silence before the quick stop says nothing of the drive's answers to polls, which begin with it
        self._silent = 0
        asked = self._ask(self._loop.drive.quick_stop)
        at_rest_s = self._see_rest(asked)
        if at_rest_s is None and self._silent < self._enough_silent and self._contradicted():
            at_rest_s = self._see_rest(asked)
        return at_rest_s

    def _coast(self, released: bool) -> float | None:
        """Command zero torque in torque mode until standstill. Return its control time, s; None if it is not reached.

        ``released``: the torque is removed already, and no mode is requested.

        Used if speed control could accelerate the shaft: the sign of a report is inverted, which does not matter for
        standstill, or no motion has ever been reported.
        """
        rest = Standstill(self._loop.guard.observer, self._at_rest_rad_s, self._settle_s, self._longest_gap_s)
        patience = StopTimeout(self._enough_s + rest.settle_s, self._at_rest_rad_s)
        while not patience.over:
            sample = self._exchange(_REST if released else _NO_TORQUE_ASKED)
            if sample is None:
                if self._silent >= self._enough_silent:
                    return None
                patience.wait(self._loop.period_s)
                continue
            self._ask_position(sample.time_s)
            torque_mode = sample.mode is Mode.TORQUE and sample.state is PowerState.ENABLED
            if not (released or torque_mode) or self._loop.guard.observer.runs_away(sample):
                return None
            patience.see(sample.speed_rad_s, self._loop.period_s)
            if rest.see(sample, without_torque=True):
                return sample.time_s
        return None

    def _coasted(self, *, released: bool = False) -> StopReport | None:
        """Coast to standstill, then disable the drive. Return None if the shaft does not coast to standstill."""
        at_rest_s = self._coast(released)
        if at_rest_s is None:
            return None
        disabled = released or self._remove_torque(_NO_TORQUE_ASKED)
        stays = disabled and self._stays_at_rest()
        return self._ended(stays, at_rest_s, disabled)

    @property
    def _mean_torque_nm(self) -> float:
        """Mean of the last reported torques, N·m; 0 without one."""
        return math.fsum(self._held) / max(1, len(self._held))

    @property
    def _never_moved(self) -> bool:
        """Return whether, above a string, torque caused no reported motion: speed control could drive the shaft."""
        return self._string is not None and self._in_torque_mode and self._loop.guard.observer.unseen_s > 0.0

    @property
    def _in_torque_mode(self) -> bool:
        """Return whether the drive was last seen enabled in torque mode."""
        last = self._loop.last
        return last is not None and last.mode is Mode.TORQUE and last.state is PowerState.ENABLED

    @property
    def _speed_doubted(self) -> bool:
        """Return whether the drive's speed control is unreliable: its reported speed contradicts another report."""
        return not self._loop.guard.observer.reports_trusted

    def _see_rest(self, asked: bool) -> float | None:
        observer = self._loop.guard.observer
        rest = Standstill(observer, self._at_rest_rad_s, self._settle_s, self._longest_gap_s)
        patience = StopTimeout(self._enough_s + rest.settle_s - self._settle_s, self._at_rest_rad_s)
        braking = Slowing(self._at_rest_rad_s, self._unmoved_s)
        while not patience.ends(observer.coasts_s):
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
                self._held_at_rest_nm = self._mean_torque_nm
                return sample.time_s
        if observer.doubt is not None and not observer.reports_trusted:
            self._trouble.append(
                f"standstill cannot be confirmed: {observer.doubt.what}. The drive was not disabled"
            )
        elif patience.waited_s:
            self._trouble.append(
                f"standstill was not observed within {patience.waited_s:.1f} s of the quick stop"
                + (_DENIED if rest.denied else "")
            )
        return None

    def _ask_position(self, now_s: float) -> None:
        """Read the position by a single request at intervals, if it does not come with the cycle."""
        drive, newer_s = self._loop.drive, math.nextafter(now_s - self._position_read_s, 0.0)
        coming = self._loop.guard.observer.heard_position(now_s, min(2.0 * POSITION_EVERY_S, newer_s))
        if coming or now_s < self._position_due_s or not isinstance(drive, Positioned) or not self._fed:
            return
        self._position_due_s = now_s + POSITION_EVERY_S
        try:
            reading = drive.read_position()
        except BaseException as error:  # any error: the stop continues
            self._note(error)
            return
        if reading is not None:
            self._position_read_s = reading.time_s
            self._loop.guard.observer.see_reading(reading)

    def _poll_agrees(self, rest: Standstill) -> bool:
        """Return whether a single request shows standstill too, before the drive is disabled; True if not answered."""
        drive = self._loop.drive
        if self._polls.standing or not isinstance(drive, Polled):
            return True
        try:
            sample = drive.poll()
        except BaseException as error:  # any error: the stop continues
            self._note(error)
            return True
        if sample is None or rest.quiet(sample):
            return True
        rest.restart()                 # asked again after as long a standstill, not in each cycle
        if not self._disagreed:
            self._trouble.append(
                f"the cycle reports standstill, a single request {sample.speed_rad_s:.3f} rad/s: the drive is not"
                " disabled before both agree")
        self._disagreed = True
        return False

    def _removes_torque(self, sample: Sample) -> bool:
        """Remove the torque of a shaft that accelerates against the quick stop. Return whether that was done.

        `docs/decisions` states when that is done above a drill string.
        """
        how = self._loop.guard.observer.runs_away(sample)
        if not how:
            return False
        why = f"the shaft accelerates against the quick stop ({how})"
        if self._remove_torque():
            self._trouble.append(f"torque removed: {why}. It runs out without a brake")
        else:
            self._trouble.append(f"{why}, and the drive does not confirm that its torque is off")
        return True

    def _remove_torque(self, command: Command = _REST) -> bool:
        drive = self._loop.drive
        request = drive.remove_torque if isinstance(drive, RemovesTorque) else drive.disable
        self._torque_removed = self._disable(request, command)
        return self._torque_removed

    def _leave_to_watchdog(self, sample: Sample) -> bool:
        """Stop feeding the drive's watchdog, once, so that it acts. Return whether this call did it."""
        drive = self._loop.drive
        # The drive's watchdog brakes with the same speed signal. If this is in doubt, the stop watches the torque.
        doubt = self._loop.guard.observer.doubt
        if doubt is not None and Signal.ALL not in doubt.signals:
            return False
        if not (self._fed and self._watched and isinstance(drive, StopsFeeding)):
            return False
        try:
            drive.stop_feeding()
        except CommandRejected as error:   # silence would not help: another client feeds the watchdog, too
            self._fed = False
            self._note(error)
            return False
        except BaseException as error:  # any error: the stop continues
            self._note(error)
            return False
        self._fed = False
        # Some drives are not read until their watchdog acts, because reading feeds it.
        self._enough_silent = max(self._enough_silent, self._loop.cycles(self._limits.watchdog_s + SILENT_S))
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
        """Return whether the shaft stays at standstill without torque. Without feedback it counts as staying there."""
        quiet_s, turned, heard_s, observer = 0.0, False, self._loop.now_s, self._loop.guard.observer
        noise = CountsOfNoise(observer, self._at_rest_rad_s)
        enough_s = max(self._settle_s, min(0.8 * REST_AFTER_S, observer.shows_s(
            self._at_rest_rad_s, self._held_at_rest_nm)))
        for _ in range(self._loop.cycles(REST_AFTER_S)):
            sample = self._exchange(_REST, or_poll=True)
            if sample is None:
                if self._silent >= self._enough_silent:
                    self._trouble.append("the drive sent no feedback after it was disabled")
                    return True
                continue
            self._ask_position(sample.time_s)
            # Polls are further apart than cycles. Of a longer gap only the longest permitted one counts.
            apart_s = sample.time_s - heard_s if self._polls.standing else 0.0
            quiet_s += max(self._loop.period_s, min(self._longest_gap_s, apart_s))
            heard_s = sample.time_s
            speed_rad_s = observer.speed_rad_s(sample)
            stands, by_position_rad_s = observer.angle_quiet(self._at_rest_rad_s), observer.rate_rad_s or 0.0
            if not (noise.explains(speed_rad_s, quiet=abs(speed_rad_s) <= self._at_rest_rad_s) and stands):
                quiet_s = 0.0
                noise.restart()
                if not turned:
                    turned = True
                    seen_rad_s, by = (sample.speed_rad_s, "") if stands else (by_position_rad_s, " by its position")
                    self._trouble.append(
                        f"the shaft began to turn ({seen_rad_s:.3f} rad/s{by}) once its torque was off:"
                        " is torque trapped in the load, or does a weight hang on it?"
                    )
            elif quiet_s >= enough_s:
                return True
        return False

    def _ask(self, request: Callable[[], None]) -> bool:
        """Return whether the drive accepted a request. A request that fails is repeated in the next cycle."""
        try:
            request()
        except BaseException as error:  # any error: the stop continues
            self._note(error)
            return False
        return True

    def _note(self, error: BaseException) -> None:
        if len(self._trouble) < 20:
            self._trouble.append(str(error) or type(error).__name__)

    def _exchange(self, command: Command, *, or_poll: bool = False) -> Sample | None:
        """Run one cycle. Return its feedback; without it the answer to a poll, if permitted and due; else None."""
        sample: Sample | None = None
        try:
            sample = self._loop.stop_cycle(command)
        except BaseException as error:  # any error: the stop continues
            self._note(error)
        if sample is None or not sample.fresh or (or_poll and self._polls.only):
            sample = self._poll() if or_poll else None
            if sample is not None:
                try:
                    self._loop.guard.observer.see(command, sample)
                except Exception as error:      # the stop continues
                    self._note(error)
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
        except BaseException as error:  # any error: the stop continues
            self._note(error)
            return None
        if sample is not None and self._polls.answered == 1:
            self._held.clear()             # the torque held before the gap is out of date
            self._trouble.append("no cyclic feedback arrived: the drive was polled instead")
        return sample

    def _contradicted(self) -> bool:
        """Return whether a poll contradicts the feedback of the cycle. Then only polls count from now on."""
        cyclic = self._loop.last
        try:
            sample = self._polls.ask()
        except BaseException as error:  # any error: the stop continues
            self._note(error)
            return False
        if sample is None or cyclic is None:
            return False
        rest = self._at_rest_rad_s
        other_state = sample.state in _STOPPING and cyclic.state not in _STOPPING
        self._polls.only = other_state or (abs(sample.speed_rad_s) <= rest and not abs(cyclic.speed_rad_s) <= rest)
        if self._polls.only:
            self._held.clear()
            self._trouble.append(
                f"the cyclic feedback reports {cyclic.speed_rad_s:.3f} rad/s, a poll {sample.speed_rad_s:.3f} rad/s:"
                " the cyclic feedback no longer counts"
            )
        return self._polls.only

    def _gets_slower(self, sample: Sample) -> bool:
        """Return False if only polls, which feed an armed watchdog, show the shaft and it does not slow down.

        A drive without torque has no watchdog that acts: its shaft is watched as it runs out.
        """
        feeding = self._watched and self._fed and self._polls.standing and sample.state not in NO_TORQUE
        if not feeding or self._slowing.see(sample.time_s, sample.speed_rad_s):
            return True
        self._trouble.append(
            f"the shaft goes on turning at {sample.speed_rad_s:.3f} rad/s without feedback of the cycle: the drive is"
            " left alone, so that its own watchdog acts"
        )
        return False


def mode_not_left() -> ModeNotConfirmed:
    """Return the error for a run without another cause whose drive stayed in torque mode at the stop."""
    return ModeNotConfirmed(
        f"the drive stayed in torque mode at the stop: it did not confirm speed mode within {MODE_S:.1f} s. The torque"
        " was brought to zero first, because the profile does not state that a quick stop brakes there",
        where="stop sequence",
        next_step="Check in the drive's manual whether the mode may change while enabled. tdhil replay of the log gives"
        " the result",
    )


def not_confirmed(report: StopReport) -> StopNotConfirmed:
    """Return the error for a stop that was not confirmed."""
    return StopNotConfirmed(
        "the stop was NOT confirmed: " + (report.trouble[-1] if report.trouble else "no standstill seen"),
        where="stop sequence",
        next_step="Use the hard-wired emergency stop now. Do not rely on the drive's watchdog",
    )
