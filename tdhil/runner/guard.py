"""The guard over every command and every sample. Pure: it checks, and raises.

In torque mode it does not wait until the speed leaves its window, because reports are old. With a reporting lag τ and a
reaction time t_r the shaft will have reached, before any action of the host can take effect,

    ω_pred = ω_reported + T_net / J_min · (t_r + τ_max)        T_net = T − T_c sgn ω − B ω

and ω_pred must stay below the window's upper end. (A quantum of speed at 250 Hz is already 2.6 rad/s², so the
derivative of the reported speed would be noise only.) t_r is the assumed reaction time of loop and drive, plus three
periods of a slow loop. Downwards ω_pred passes through standstill only if the torque exceeds the friction that then
holds the shaft. The shaft must not turn backwards (with allow_reverse: not faster than the limit). Speeds between
there and the window's lower end do no harm, so the lower end is checked with the reported speed.

In speed mode the guard checks the following error, as motion controllers do, by a window and a time. A plausible lag is
no error: the window covers all values of the reference over the longest plausible lag. The guard waits as long as the
shaft comes nearer, because a heavy shaft at its torque limit is slow. A torque offset moves the shaft away from its
reference on purpose: while one may be commanded, the speed window is checked instead, at both ends.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from drivers import (
    LOWER_THE_RATE,
    Command,
    CommandRejected,
    CommunicationLost,
    Counters,
    DriveFault,
    LimitHit,
    Mode,
    ModeNotConfirmed,
    PowerState,
    ReportsContradict,
    Sample,
)
from profiles import MessageCode
from profiles.quantities import in_nm
from tdhil.runner.excitation import MotionLimits, RigGuess
from tdhil.runner.observer import AT_LIMIT_SHARE, Contradiction, Observer, Signal
from tdhil.runner.settings import ControlAssumptions, MachineLimits

LONGEST_AGE_S = 0.25
"""Longest time without feedback, s. Meanwhile the drive continues with the last setpoint."""

LIMITED_S = 0.5
"""Longest time for which the drive's internal limit may act in torque mode, s. While it acts, the torque is not the
commanded one, and the motion is not the planned one (row 33)."""

MODE_LOST_S, MODE_SWITCH_S, MODE_CYCLES = 0.25, 1.0, 15
"""Longest times, s, for which the drive may display another mode than the commanded one, and least number of cycles:
after it has displayed the mode, and after a switch (`Bench.switch_mode` gives up sooner). The display comes only every
few cycles and may be lost. Meanwhile the commanded mode is requested again."""

FOLLOW_SHARE, FOLLOW_S, FOLLOW_STRING_S = 0.05, 5.0, 10.0
"""Permitted following error in speed mode, as a share of the speed limit. A larger one is permitted for this
long, s, if it comes no nearer; longer with a drill string, which may oscillate."""

NEARER_SHARE = 0.02
"""Share of the speed limit by which the shaft must come nearer within that time."""

FOLLOW_MEAN_S, FOLLOW_BLOCK_S = 0.5, 0.1
"""Averaging time of the compared reported speed, and block length of the reference, s."""

LIGHTEN = (
    "Lift the bit off bottom, reduce the weight on bit, or turn faster (limits.speed_min_rad_s). A wider speed window"
    " also helps"
)
"""Advice for a shaft that a drill string under load disturbs."""

PACE_S, LATE_SHARE = 2.0, 0.2
"""Time window, s, and share of late cycles above which a loop counts as too slow (row 8)."""


def kept_within(setpoint: float, least: float, most: float) -> float:
    """Return the setpoint within its limits. NaN stays NaN, which the guard rejects.

    If two numbers do not compare, `min` and `max` return the first. So the setpoint has to be first; otherwise NaN
    would become a limit.
    """
    return max(min(setpoint, most), least)


def _at(sample: Sample) -> str:
    """Return the place of a limit that was exceeded, for the message."""
    return f"guard at {sample.time_s:.3f} s"


def _leads(sample: Sample, command: Command, predicted_rad_s: float) -> str:
    """Return the prediction of the speed in words."""
    return (
        f"{sample.speed_rad_s:.3f} rad/s reported and {in_nm(command.torque_nm)} lead to {predicted_rad_s:.3f} rad/s"
    )


class Guard:
    """Guard of the machine's limits in one run.

    The stages set ``model``, ``expected``, ``no_braking`` and ``torque_offset_nm``.
    """

    def __init__(
        self,
        limits: MachineLimits,
        period_s: float,
        speed_resolution_rad_s: float,
        torque_resolution_nm: float,
        assumptions: ControlAssumptions | None = None,
    ) -> None:
        assumptions = (assumptions or ControlAssumptions()).at_period(period_s)
        self._limits = limits
        self._horizon_s = assumptions.reaction_s + assumptions.largest_speed_lag_s
        self._smallest_share = assumptions.smallest_inertia_share
        # Noise and quantisation near zero do not count as reverse rotation.
        self._speed_noise_rad_s = 5.0 * speed_resolution_rad_s
        self._reverse_rad_s = max(self._speed_noise_rad_s, 0.02 * limits.noise_scale_rad_s)
        # The reported torque is noisy and may overshoot. The commanded torque is checked exactly.
        self._torque_seen_nm = 1.25 * limits.torque_nm + 10.0 * torque_resolution_nm
        # Half of the drive's watchdog time, but at least three lost frames.
        self._stale_limit = max(3, math.ceil(min(LONGEST_AGE_S, 0.5 * limits.watchdog_s) / period_s))
        self._stale = 0
        self.observer = Observer(limits, period_s, speed_resolution_rad_s, torque_resolution_nm, assumptions)
        self._limited_since_s: float | None = None
        self._mode: _ModeShown | None = None
        self._following = _Following(limits, period_s, speed_resolution_rad_s, assumptions)
        self._pace_cycles, self._rate_hz = max(10, round(PACE_S / period_s)), round(1.0 / period_s, 6)
        self._pace_from = Counters()
        self._pace_left = 0                # cycles before the next check
        self._started_s: float | None = None
        self.expected: PowerState | None = None
        self.model: RigGuess | None = None
        self.no_braking = ""
        """Why torque below zero is not allowed in torque mode; empty: it is allowed. The Runner sets it."""
        self.to_brake = ""
        """Advice how to allow braking torque."""
        self.disturbed = ""
        """Description of a lasting disturbance by a drill string under load; empty: none. It is used in messages only,
        the limits stay the same."""
        self.torque_offset_nm = 0.0
        """Largest permitted torque offset in either direction, N·m; 0: none. Set by the stage that uses it."""
        self.reckoning = False
        """True while a computation beside the loop may make it late: then lateness alone does not stop the run."""
        self.host_late: Callable[[], str] = lambda: ""
        """Lateness of this computer in words, if it is late (`drivers.clock.how_late`)."""

    def know(self, model: RigGuess) -> None:
        """Take stage 2's rough model, for the prediction of speed and for the observer."""
        self.model = model
        self.observer.know(model)

    def allow_torque_offset(self, largest_nm: float) -> None:
        """Permit a torque offset of up to ``largest_nm`` in speed mode, in either direction."""
        self.torque_offset_nm = self.observer.swinging_offset_nm = largest_nm

    def check_command(self, command: Command) -> None:
        """Raise CommandRejected for a setpoint that must not reach the bus, LimitHit for a braking torque before it is
        allowed.
        """
        speed, torque, offset = command.speed_rad_s, command.torque_nm, command.torque_offset_nm
        if not (math.isfinite(speed) and math.isfinite(torque) and math.isfinite(offset)):
            raise CommandRejected(
                f"setpoint is not finite (speed {speed}, torque {torque}, torque offset {offset})", where="guard"
            )
        if offset != 0.0 and (command.mode is not Mode.SPEED or abs(offset) > self.torque_offset_nm * (1.0 + 1e-9)):
            raise CommandRejected(
                f"torque offset {in_nm(offset)} in {command.mode.value} mode is above the limit of this stage,"
                f" {self.torque_offset_nm:g} N·m in speed mode",
                where="guard",
            )
        if abs(torque) > self._limits.torque_nm * (1.0 + 1e-9):
            raise CommandRejected(
                f"torque setpoint {in_nm(torque)} is above the limit of {self._limits.torque_nm:g} N·m", where="guard"
            )
        if self.no_braking and command.mode is Mode.TORQUE and torque < 0.0:
            raise LimitHit(
                f"a braking torque of {in_nm(-torque)} was not sent: {self.no_braking}",
                where="guard",
                next_step=self.to_brake,
                entry=MessageCode.BRAKING_HELD_BACK,
            )
        lowest = -self._limits.speed_max_rad_s if self._limits.allow_reverse else 0.0
        if not lowest <= speed <= self._limits.speed_max_rad_s:
            raise CommandRejected(
                f"speed setpoint {speed:.3f} rad/s is outside {lowest:g} to {self._limits.speed_max_rad_s:g} rad/s",
                where="guard",
            )

    def start_clock(self, time_s: float) -> None:
        """Start the time limit."""
        self._started_s = time_s

    def left_s(self, time_s: float) -> float:
        """Return the remaining time of the time limit, s."""
        return self._limits.time_s - (0.0 if self._started_s is None else time_s - self._started_s)

    def pace_is_due(self) -> bool:
        """Return whether `check_pace` is due in this cycle, so that counters are collected only when needed."""
        self._pace_left -= 1
        return self._pace_left <= 0 or self.reckoning

    def check_pace(self, counters: Counters) -> None:
        """Raise CommunicationLost if the loop is late too often: then its setpoints are late, too."""
        if self.reckoning:
            self._pace_from, self._pace_left = counters, self._pace_cycles
            return
        before = self._pace_from
        cycles = counters.cycles - before.cycles
        if cycles < self._pace_cycles:
            self._pace_left = self._pace_cycles - cycles
            return
        self._pace_from, self._pace_left = counters, self._pace_cycles
        late = counters.overruns - before.overruns
        if late > LATE_SHARE * cycles:
            words = self.host_late()
            raise CommunicationLost(
                f"the control loop was late in {late} of {cycles} cycles (limit {100 * LATE_SHARE:.0f} %)"
                + (f": {words}" if words else ""),
                where="host",
                next_step=f"{LOWER_THE_RATE} below {self._rate_hz:g}",
                entry=MessageCode.HOST_LATE,
            )

    def check_sample(self, command: Command, sample: Sample) -> None:
        """Check a sample. Raises CommunicationLost, DriveFault or LimitHit."""
        self.observer.see(command, sample)
        if sample.fresh:
            self._stale = 0
        else:
            self._check_age(sample)
        if self.expected is not None and sample.state is not self.expected:
            raise DriveFault(
                f"the drive left the state '{self.expected.value}' and reports '{sample.state.value}'",
                where=f"statusword {sample.status:04X}h at {sample.time_s:.3f} s",
                next_step="Read the drive's fault list. Possible causes are STO, a fault or a second master",
                entry=MessageCode.STATE_LEFT,
            )
        if not (math.isfinite(sample.speed_rad_s) and math.isfinite(sample.torque_nm)):
            raise DriveFault(
                f"the feedback is not finite (speed {sample.speed_rad_s}, torque {sample.torque_nm})",
                where=_at(sample),
                next_step="Check word order and scaling in the profile",
                entry=MessageCode.FEEDBACK_NOT_FINITE,
            )
        self._check_speed(sample)
        if abs(sample.torque_nm) > self._torque_seen_nm:
            raise LimitHit(
                f"torque {in_nm(sample.torque_nm)} is above the limit of {self._limits.torque_nm:g} N·m",
                where=_at(sample),
                stops=True, next_step="Lower the amplitude. Check that rig.yaml has the drive's rated torque",
                entry=MessageCode.TORQUE_LIMIT,
            )
        if self.left_s(sample.time_s) < 0.0:
            raise LimitHit(
                f"the run has taken longer than the limit of {self._limits.time_s:g} s",
                where=_at(sample),
                stops=True, next_step="Raise limits.time_s in rig.yaml or request fewer periods",
                entry=MessageCode.TIME_LIMIT,
            )
        self._check_mode(command, sample)
        if self.observer.doubt is not None:
            self._raise_doubt(self.observer.doubt, sample)
        in_torque_mode = command.mode is Mode.TORQUE
        if not (in_torque_mode and sample.limit_active):
            self._limited_since_s = None
        elif self._limited_since_s is None:
            self._limited_since_s = sample.time_s
        elif sample.time_s - self._limited_since_s >= LIMITED_S:
            raise LimitHit(
                f"the drive's internal limit has been active in torque mode for the limit of {LIMITED_S:g} s:"
                " its torque is not the commanded one",
                where=f"statusword {sample.status:04X}h, bit 11, at {sample.time_s:.3f} s",
                stops=True, next_step="Check on its panel which limit acts",
                entry=MessageCode.SETPOINT_NOT_FOLLOWED,
            )
        if self.expected is PowerState.ENABLED and not in_torque_mode and not self.torque_offset_nm > 0.0:
            self._check_following(command, sample)
        else:
            self._following.reset()
            if self.torque_offset_nm > 0.0 and not in_torque_mode:
                self._check_lower_end(sample)
        if in_torque_mode and self.model is not None:
            self._check_window(self.model, command, sample)

    @property
    def least_torque_nm(self) -> float:
        """Return the least torque that a stage may command in torque mode. A control loop is limited to it."""
        return 0.0 if self.no_braking else -self._limits.torque_nm

    @staticmethod
    def foresight_s(assumptions: ControlAssumptions) -> float:
        """Return the prediction time of the guard, s: a plan keeps free this time multiplied by its acceleration."""
        return (assumptions.reaction_s + assumptions.largest_speed_lag_s) / assumptions.smallest_inertia_share

    @staticmethod
    def room(limits: MachineLimits, assumptions: ControlAssumptions, free_rad_s: float = 0.0) -> MotionLimits:
        """Return the part of the limits that a plan may use; ``free_rad_s`` stays free at both ends of the window."""
        low, high = limits.speed_min_rad_s + free_rad_s, limits.speed_max_rad_s - free_rad_s
        return MotionLimits(low, high, limits.torque_nm, Guard.foresight_s(assumptions))

    def predicted_speed(self, model: RigGuess, torque_nm: float, speed_rad_s: float) -> float:
        """Return the speed that the shaft may reach, rad/s, before a reaction of the host takes effect."""
        inertia = self._smallest_share * model.inertia_kg_m2
        direction = math.copysign(1.0, speed_rad_s or torque_nm)
        rate = (torque_nm - direction * model.coulomb_nm - model.viscous_nm_s_rad * speed_rad_s) / inertia
        ahead = speed_rad_s + rate * self._horizon_s
        if ahead * direction >= 0.0:
            return ahead
        # The predicted speed passes through standstill; friction then opposes the remaining torque.
        push_nm = torque_nm + direction * model.coulomb_nm
        left_s = self._horizon_s + speed_rad_s / rate
        return push_nm / inertia * left_s if push_nm * direction < 0.0 else 0.0

    def _check_speed(self, sample: Sample) -> None:
        limits, speed_rad_s = self._limits, sample.speed_rad_s
        if speed_rad_s > limits.speed_max_rad_s or (limits.allow_reverse and speed_rad_s < -limits.speed_max_rad_s):
            raise LimitHit(
                self._besides(
                    f"speed {speed_rad_s:.3f} rad/s is above the limit of {limits.speed_max_rad_s:g} rad/s"
                ),
                where=_at(sample),
                stops=True, next_step=self._helps(
                    "Check whether the load was lost, and limits.speed_max_rad_s in rig.yaml"),
                entry=MessageCode.SPEED_LIMIT,
            )
        if not limits.allow_reverse and speed_rad_s < -self._reverse_rad_s:
            raise LimitHit(
                f"the shaft turns backwards ({speed_rad_s:.3f} rad/s) and allow_reverse is false",
                where=_at(sample),
                stops=True, next_step=self._helps(
                    "Lower the amplitude or raise the offset. Check whether the load drives the shaft back"),
                entry=MessageCode.TURNED_BACKWARDS,
            )

    def _check_window(self, model: RigGuess, command: Command, sample: Sample) -> None:
        limits, speed_rad_s = self._limits, sample.speed_rad_s
        predicted = self.predicted_speed(model, command.torque_nm, speed_rad_s)
        lowest = -limits.speed_max_rad_s if limits.allow_reverse else -self._reverse_rad_s
        if predicted > limits.speed_max_rad_s:
            raise LimitHit(
                self._besides(
                    f"the speed is about to leave its window: {_leads(sample, command, predicted)}, above"
                    f" {limits.speed_max_rad_s:g} rad/s"
                ),
                where=_at(sample),
                stops=True, next_step=self._helps("Lower the amplitude or the offset"),
                entry=MessageCode.SPEED_LIMIT,
            )
        if predicted < lowest:
            raise LimitHit(
                self._besides(f"the shaft is about to turn backwards: {_leads(sample, command, predicted)}"),
                where=_at(sample),
                stops=True, next_step=self._helps("Lower the amplitude or raise the offset"),
                entry=MessageCode.TURNED_BACKWARDS,
            )
        self._check_lower_end(sample)

    def _check_lower_end(self, sample: Sample) -> None:
        limits, speed_rad_s = self._limits, sample.speed_rad_s
        if speed_rad_s < limits.speed_min_rad_s - self._speed_noise_rad_s:
            raise LimitHit(
                self._besides(
                    f"the speed has left its window: {speed_rad_s:.3f} rad/s is below {limits.speed_min_rad_s:g} rad/s"
                ),
                where=_at(sample),
                stops=True, next_step=self._helps(
                    "Lower the amplitude or raise the offset. Check whether the load increased"),
                entry=MessageCode.SPEED_LIMIT,
            )

    def _besides(self, what: str) -> str:
        return f"{what}; {self.disturbed}" if self.disturbed else what

    def _helps(self, usual: str) -> str:
        return LIGHTEN if self.disturbed else usual

    def _check_age(self, sample: Sample) -> None:
        self._stale += 1
        if self._stale >= self._stale_limit:
            late, missing = self.host_late(), f"no feedback for {self._stale} cycles, which is the limit"
            raise CommunicationLost(
                f"{missing}. {late}" if late else missing,
                where=f"host, and {_at(sample)}" if late else _at(sample),
                next_step=f"{LOWER_THE_RATE} below {self._rate_hz:g}"
                if late
                else "The drive's own watchdog stops the shaft. Check the drive's supply and the bus",
                entry=MessageCode.FEEDBACK_LOST,
            )

    def _raise_doubt(self, doubt: Contradiction, sample: Sample) -> None:
        """Raise the contradiction that the observer found.

        CommunicationLost for feedback that repeats, LimitHit for a shaft that became lighter, else ReportsContradict.
        """
        if Signal.ALL in doubt.signals:
            raise CommunicationLost(doubt.what, where=_at(sample), next_step=doubt.helps,
                                    entry=MessageCode.FEEDBACK_REPEATS)
        if doubt.lighter:
            raise LimitHit(doubt.what, where=_at(sample), stops=True, next_step=doubt.helps,
                           entry=MessageCode.SHAFT_CHANGED)
        raise ReportsContradict(doubt.what, where=_at(sample), stops=True, next_step=doubt.helps)

    def _check_mode(self, command: Command, sample: Sample) -> None:
        if self.expected is not PowerState.ENABLED:
            self._mode = None
            return
        if self._mode is None:
            self._mode = _ModeShown()
        if sample.fresh and not self._mode.see(command.mode, sample):
            shown = "an unknown mode" if sample.mode is None else f"{sample.mode.value} mode"
            raise ModeNotConfirmed(
                f"the drive left its mode: {command.mode.value} mode is commanded, but it displays {shown}",
                where=f"mode display (6061h in CiA 402) at {sample.time_s:.3f} s",
                stops=True, next_step="Check whether another master, a tool or a parameter changed it",
            )

    def torque_words(self, torque_nm: float, limit_active: bool, disturbed: bool = False) -> tuple[str, str]:
        """Return two texts: the torque compared with its limit, and advice for a shaft that does not reach its speed.

        ``disturbed``: a drill string under load prevents that.
        """
        limit_nm = self._limits.torque_nm
        if limit_active or abs(torque_nm) >= AT_LIMIT_SHARE * limit_nm:
            by = "the drive's internal limit acts" if limit_active else f"at its limit of {limit_nm:g} N·m"
            return (
                f"torque {in_nm(torque_nm)}, {by}",
                "Check whether a brake or the load holds the shaft. If not, and if the machine allows it, raise the"
                " torque limit (limits.torque_nm in rig.yaml, and the drive's own)",
            )
        if disturbed or self.disturbed:
            return f"torque {in_nm(torque_nm)}, not at its limit of {limit_nm:g} N·m", LIGHTEN
        return (
            f"torque {in_nm(torque_nm)}, not at its limit of {limit_nm:g} N·m",
            "Check whether the drive takes its speed setpoint from elsewhere (panel, another master), applies its own"
            " speed limit or ramp, or uses another unit of speed than the profile. If not, its speed loop is too soft",
        )

    def _check_following(self, command: Command, sample: Sample) -> None:
        following = self._following
        if sample.fresh and not following.see(command.speed_rad_s, sample):
            torque, helps = self.torque_words(following.torque_nm, sample.limit_active)
            raise LimitHit(
                f"the speed does not follow: {command.speed_rad_s:.3f} rad/s commanded,"
                f" {following.speed_rad_s:.3f} rad/s reported, deviating since {following.since_s:.1f} s and no nearer"
                f" for {following.within_s:g} s; {torque}",
                where=_at(sample),
                stops=True, next_step=helps,
                entry=MessageCode.SETPOINT_NOT_FOLLOWED,
            )


class _ModeShown:
    """Compares the mode that the drive displays with the commanded one."""

    def __init__(self) -> None:
        self._commanded: Mode | None = None
        self._seen = False                 # the commanded mode was displayed since it was commanded
        self._other: tuple[float, int] | None = None   # another mode: displayed since, s, and in how many cycles

    def see(self, commanded: Mode, sample: Sample) -> bool:
        """Return False once another mode has been displayed for too long."""
        if commanded is not self._commanded:
            self._commanded, self._seen, self._other = commanded, False, None
        if sample.mode is commanded:
            self._seen, self._other = True, None
            return True
        since_s, cycles = self._other or (sample.time_s, 0)
        self._other = since_s, cycles + 1
        allowed_s = MODE_LOST_S if self._seen else MODE_SWITCH_S
        return cycles < MODE_CYCLES or sample.time_s - since_s < allowed_s


class _Following:
    """Compares the reported speed with the reference of speed mode."""

    def __init__(
        self, limits: MachineLimits, period_s: float, speed_resolution_rad_s: float, assumptions: ControlAssumptions
    ) -> None:
        self._window_rad_s = max(FOLLOW_SHARE * limits.speed_max_rad_s, 5.0 * speed_resolution_rad_s)
        self._nearer_rad_s = max(NEARER_SHARE * limits.speed_max_rad_s, 2.0 * speed_resolution_rad_s)
        reach_s = assumptions.reaction_s + 3.0 * assumptions.largest_speed_lag_s + FOLLOW_MEAN_S
        self.within_s = FOLLOW_STRING_S if limits.has_drill_string else FOLLOW_S
        self._blocks: deque[_Block] = deque(maxlen=1 + math.ceil(reach_s / max(FOLLOW_BLOCK_S, period_s)))
        recent = max(1, round(FOLLOW_MEAN_S / period_s))
        self._speeds: deque[float] = deque(maxlen=recent)
        self._torques: deque[float] = deque(maxlen=recent)
        self._start()

    def reset(self) -> None:
        """Start again with the next sample."""
        if self._blocks:
            self._blocks.clear()
            self._start()

    def _start(self) -> None:
        self._side = 0.0                   # side of the reference on which the shaft is; 0: within the window
        self._anchor_rad_s = self._anchor_s = self.since_s = 0.0

    @property
    def speed_rad_s(self) -> float:
        """Return the mean reported speed, rad/s."""
        return math.fsum(self._speeds) / len(self._speeds)

    @property
    def torque_nm(self) -> float:
        """Return the mean reported torque, N·m."""
        return math.fsum(self._torques) / len(self._torques)

    def see(self, reference_rad_s: float, sample: Sample) -> bool:
        """Return False once the shaft has been away from its reference for too long without coming nearer."""
        now_s = sample.time_s
        if not self._blocks or now_s - self._blocks[-1].start_s >= FOLLOW_BLOCK_S:
            self._blocks.append(_Block(now_s, reference_rad_s))
        else:
            self._blocks[-1].widen(reference_rad_s)
        self._speeds.append(sample.speed_rad_s)
        self._torques.append(sample.torque_nm)
        speed_rad_s, latest, window_rad_s = self.speed_rad_s, self._blocks[-1], self._window_rad_s
        if latest.lowest - window_rad_s <= speed_rad_s and speed_rad_s - latest.highest <= window_rad_s:
            side = 0.0           # the usual case; earlier blocks only widen it
        elif speed_rad_s < min(block.lowest for block in self._blocks) - window_rad_s:
            side = 1.0
        else:
            side = -1.0 if speed_rad_s - max(block.highest for block in self._blocks) > window_rad_s else 0.0
        if side != self._side:
            self._side, self._anchor_rad_s, self._anchor_s, self.since_s = side, speed_rad_s, now_s, now_s
        elif side * (speed_rad_s - self._anchor_rad_s) >= self._nearer_rad_s:
            self._anchor_rad_s, self._anchor_s = speed_rad_s, now_s
        return side == 0.0 or now_s - self._anchor_s < self.within_s


class _Block:
    """Range of the reference from ``start_s`` on."""

    def __init__(self, start_s: float, reference_rad_s: float) -> None:
        self.start_s = start_s
        self.lowest = self.highest = reference_rad_s

    def widen(self, reference_rad_s: float) -> None:
        self.lowest, self.highest = min(self.lowest, reference_rad_s), max(self.highest, reference_rad_s)
