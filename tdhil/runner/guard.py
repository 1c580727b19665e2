"""The guard over every command and every sample. Pure: it looks, and raises.

In torque mode it does not wait for the edge of the speed window to be crossed. What is reported is old: with a
reporting lag τ and a reaction time t_r the shaft will have reached, before anything the host does can act,

    ω_pred = ω_reported + T_net / J_min · (t_r + τ_max)        T_net = T − T_c sgn ω − B ω

and it is ω_pred that must stay below the window's upper end (a quantum of speed at 250 Hz is already 2.6 rad/s², so
differentiating the reported speed instead would see nothing but noise). t_r is what was assumed of loop and drive, and
three periods of a slow loop. Downwards ω_pred goes through standstill only where the torque overcomes the friction that
then holds the shaft, and the shaft must not turn backwards (where it may: not faster than the limit). Between there and
the window's lower end nothing comes to harm: that end is held by the reported speed.

In speed mode it is the following error that is held, as motion controllers do, by a window and a time. What the shaft
may be late by is not taken for an error: the window lies about all that the reference was over the longest plausible
lag, and a shaft that comes nearer, however slowly a heavy one may at its torque limit, is waited for. A torque offset
moves the shaft away from its reference on purpose: while one may be commanded, the speed window is held instead, at
both ends.
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
from tdhil.runner.excitation import MotionLimits, RigGuess
from tdhil.runner.observer import AT_LIMIT_SHARE, Observer, Signal
from tdhil.runner.settings import ControlAssumptions, MachineLimits

LONGEST_AGE_S = 0.25
"""Feedback may be missing for this long at most; the drive goes on by itself meanwhile, at what it was last told."""

LIMITED_S = 0.5
"""In torque mode the drive's internal limit may act for so long: a torque that is not the commanded one moves the shaft
to where nobody planned (row 33)."""

MODE_LOST_S, MODE_SWITCH_S, MODE_CYCLES = 0.25, 1.0, 15
"""The drive may display another mode than the commanded one for so long, and for so many cycles: since it was seen in
it, and from a switch on (`Bench.switch_mode` gives up sooner). The display comes every few cycles only, may be lost,
and a mode that somebody changed is asked for again meanwhile."""

FOLLOW_SHARE, FOLLOW_S, FOLLOW_STRING_S = 0.05, 5.0, 10.0
"""In speed mode the shaft may stay away from its reference by this share of the speed limit; by more for so long, if it
comes no nearer. With a drill string on it it may swing meanwhile."""

NEARER_SHARE = 0.02
"""Of the speed limit, that the shaft must come nearer by within that time."""

FOLLOW_MEAN_S, FOLLOW_BLOCK_S = 0.5, 0.1
"""What is compared is the mean reported speed over the first, with the reference in blocks of the second."""

LIGHTEN = (
    "Lift the bit off bottom, take weight off it, or turn faster (limits.speed_min_rad_s); a wider speed window leaves"
    " it more room"
)
"""What helps a shaft that a drill string under load disturbs."""

PACE_S, LATE_SHARE = 2.0, 0.2
"""A loop that was late in this share of its cycles over this time can't hold its rate (row 8)."""


def kept_within(setpoint: float, least: float, most: float) -> float:
    """What a stage commands instead of a setpoint beyond its limits. NaN stays NaN, which the guard rejects.

    Of two numbers that don't compare, `min` and `max` give the first: the setpoint has to stand there, or a limit would
    be commanded for what is no number.
    """
    return max(min(setpoint, most), least)


class Guard:
    """Holds the machine's limits over one run.

    ``model``, ``expected``, ``no_braking`` and ``torque_offset_nm`` are set as the stages learn.
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
        # Noise and quantisation about zero are no reverse rotation.
        self._speed_noise_rad_s = 5.0 * speed_resolution_rad_s
        self._reverse_rad_s = max(self._speed_noise_rad_s, 0.02 * limits.speed_max_rad_s)
        # The reported torque is noisy and may overshoot; what was commanded is held exactly.
        self._torque_seen_nm = 1.25 * limits.torque_nm + 10.0 * torque_resolution_nm
        # Half of what the drive's watchdog grants the host, and never on account of two lost frames.
        self._stale_limit = max(3, math.ceil(min(LONGEST_AGE_S, 0.5 * limits.watchdog_s) / period_s))
        self._stale = 0
        self.observer = Observer(limits, period_s, speed_resolution_rad_s, torque_resolution_nm, assumptions)
        self._limited_since_s: float | None = None
        self._mode = _ModeShown()
        self._following = _Following(limits, period_s, speed_resolution_rad_s, assumptions)
        self._pace_cycles = max(10, round(PACE_S / period_s))
        self._pace_from = Counters()
        self._pace_left = 0                # so many cycles, at least, before there is something to see
        self._started_s: float | None = None
        self.expected: PowerState | None = None
        self.model: RigGuess | None = None
        self.no_braking = ""
        """Why no torque below zero may be commanded in torque mode; empty: it may. Set by whoever runs the stages."""
        self.to_brake = ""
        """What would change that."""
        self.disturbed = ""
        """What a drill string under load does to the shaft, in words, where it gets no calmer; empty: nothing. Limits
        stay as they are: it is for the message of whoever meets one."""
        self.torque_offset_nm = 0.0
        """The largest torque offset that may be commanded, either way; 0: none. Set by the stage that uses one."""
        self.reckoning = False
        """Arithmetic goes on beside the loop and makes it late: that alone is no reason to stop."""
        self.host_late: Callable[[], str] = lambda: ""
        """How late this computer has been, in words, where it doesn't keep up (`drivers.clock.how_late`)."""

    def know(self, model: RigGuess) -> None:
        """Take stage 2's rough model, for the prediction of speed and for the observer."""
        self.model = model
        self.observer.know(model)

    def allow_torque_offset(self, largest_nm: float) -> None:
        """Let the stage command a torque offset of up to ``largest_nm`` in speed mode, either way."""
        self.torque_offset_nm = self.observer.swinging_offset_nm = largest_nm

    def check_command(self, command: Command) -> None:
        """Raise CommandRejected for a setpoint that must not reach the bus, LimitHit for a braking torque too soon."""
        speed, torque, offset = command.speed_rad_s, command.torque_nm, command.torque_offset_nm
        if not (math.isfinite(speed) and math.isfinite(torque) and math.isfinite(offset)):
            raise CommandRejected(
                f"setpoint is not finite (speed {speed}, torque {torque}, torque offset {offset})", where="guard"
            )
        if offset != 0.0 and (command.mode is not Mode.SPEED or abs(offset) > self.torque_offset_nm * (1.0 + 1e-9)):
            raise CommandRejected(
                f"torque offset {offset:.1f} N·m in {command.mode.value} mode is beyond what this stage may command:"
                f" {self.torque_offset_nm:g} N·m, in speed mode",
                where="guard",
            )
        if abs(torque) > self._limits.torque_nm * (1.0 + 1e-9):
            raise CommandRejected(
                f"torque setpoint {torque:.1f} N·m is beyond the limit of {self._limits.torque_nm:g} N·m", where="guard"
            )
        if self.no_braking and command.mode is Mode.TORQUE and torque < 0.0:
            raise LimitHit(
                f"a braking torque of {-torque:.1f} N·m is held back: {self.no_braking}",
                where="guard",
                next_step=self.to_brake,
            )
        lowest = -self._limits.speed_max_rad_s if self._limits.allow_reverse else 0.0
        if not lowest <= speed <= self._limits.speed_max_rad_s:
            raise CommandRejected(
                f"speed setpoint {speed:.3f} rad/s is outside {lowest:g} to {self._limits.speed_max_rad_s:g} rad/s",
                where="guard",
            )

    def start_clock(self, time_s: float) -> None:
        """The time limit counts from here."""
        self._started_s = time_s

    def left_s(self, time_s: float) -> float:
        """What the time limit leaves, s."""
        return self._limits.time_s - (0.0 if self._started_s is None else time_s - self._started_s)

    def pace_is_due(self) -> bool:
        """Is `check_pace` to be called in this cycle? Counters aren't put together for nothing."""
        self._pace_left -= 1
        return self._pace_left <= 0 or self.reckoning

    def check_pace(self, counters: Counters) -> None:
        """Raise CommunicationLost when the loop is late again and again: its setpoints then come too late as well."""
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
                f"the control loop was late in {late} of {cycles} cycles" + (f": {words}" if words else ""),
                where="host",
                next_step=f"{LOWER_THE_RATE}; or end what else keeps this computer busy",
            )

    def check_sample(self, command: Command, sample: Sample) -> None:
        """Raise what the sample shows: CommunicationLost, DriveFault or LimitHit."""
        self.observer.see(command, sample)
        where = f"guard at {sample.time_s:.3f} s"
        self._check_age(sample, where)
        if self.expected is not None and sample.state is not self.expected:
            raise DriveFault(
                f"the drive left the state '{self.expected.value}' and shows '{sample.state.value}'",
                where=f"statusword {sample.status:04X}h at {sample.time_s:.3f} s",
                next_step="Look into the drive's fault list; STO, a fault or a second master may have done it",
            )
        if not (math.isfinite(sample.speed_rad_s) and math.isfinite(sample.torque_nm)):
            raise DriveFault(
                f"the feedback is not finite (speed {sample.speed_rad_s}, torque {sample.torque_nm})",
                where=where,
                next_step="Do word order and scaling in the profile fit this drive?",
            )
        self._check_speed(sample.speed_rad_s, where)
        if abs(sample.torque_nm) > self._torque_seen_nm:
            raise LimitHit(
                f"torque {sample.torque_nm:.1f} N·m is beyond the limit of {self._limits.torque_nm:g} N·m",
                where=where,
                next_step="The shaft was stopped. Does the drive's rated torque match rig.yaml?",
            )
        if self.left_s(sample.time_s) < 0.0:
            raise LimitHit(
                f"the run has taken longer than {self._limits.time_s:g} s",
                where=where,
                next_step="Raise limits.time_s in rig.yaml or ask for fewer periods",
            )
        self._check_mode(command, sample)
        self._check_reports(where)
        self._check_limited(command, sample)
        if self.torque_offset_nm > 0.0 and command.mode is Mode.SPEED:
            self._following.reset()
            self._check_lower_end(sample.speed_rad_s, where)
        else:
            self._check_following(command, sample, where)
        if command.mode is Mode.TORQUE and self.model is not None:
            self._check_window(self.model, command, sample.speed_rad_s, where)

    @property
    def least_torque_nm(self) -> float:
        """What a stage may command at least in torque mode: a slow loop that would ask for less asks for this."""
        return 0.0 if self.no_braking else -self._limits.torque_nm

    @staticmethod
    def foresight_s(assumptions: ControlAssumptions) -> float:
        """What a plan must keep free: the guard adds this times the acceleration to the speed."""
        return (assumptions.reaction_s + assumptions.largest_speed_lag_s) / assumptions.smallest_inertia_share

    @staticmethod
    def room(limits: MachineLimits, assumptions: ControlAssumptions, free_rad_s: float = 0.0) -> MotionLimits:
        """What a plan may use of the limits; ``free_rad_s`` stays free at either end of the speed window."""
        low, high = limits.speed_min_rad_s + free_rad_s, limits.speed_max_rad_s - free_rad_s
        return MotionLimits(low, high, limits.torque_nm, Guard.foresight_s(assumptions))

    def predicted_speed(self, model: RigGuess, torque_nm: float, speed_rad_s: float) -> float:
        """Where the shaft may be, rad/s, before the host can act on what it now sees."""
        inertia = self._smallest_share * model.inertia_kg_m2
        direction = math.copysign(1.0, speed_rad_s or torque_nm)
        rate = (torque_nm - direction * model.coulomb_nm - model.viscous_nm_s_rad * speed_rad_s) / inertia
        ahead = speed_rad_s + rate * self._horizon_s
        if ahead * direction >= 0.0:
            return ahead
        # Through standstill, from where friction holds against what pushes on.
        push_nm = torque_nm + direction * model.coulomb_nm
        left_s = self._horizon_s + speed_rad_s / rate
        return push_nm / inertia * left_s if push_nm * direction < 0.0 else 0.0

    def _check_speed(self, speed_rad_s: float, where: str) -> None:
        limits = self._limits
        if speed_rad_s > limits.speed_max_rad_s or (limits.allow_reverse and speed_rad_s < -limits.speed_max_rad_s):
            raise LimitHit(
                self._besides(
                    f"speed {speed_rad_s:.3f} rad/s is beyond the limit of {limits.speed_max_rad_s:g} rad/s"
                ),
                where=where,
                next_step="The shaft was stopped. "
                + self._helps("Was the load lost? Check limits.speed_max_rad_s in rig.yaml"),
            )
        if not limits.allow_reverse and speed_rad_s < -self._reverse_rad_s:
            raise LimitHit(
                f"the shaft turns backwards ({speed_rad_s:.3f} rad/s) and allow_reverse is false",
                where=where,
                next_step="The shaft was stopped. Reverse rotation backs off tool joints",
            )

    def _check_window(self, model: RigGuess, command: Command, speed_rad_s: float, where: str) -> None:
        limits = self._limits
        predicted = self.predicted_speed(model, command.torque_nm, speed_rad_s)
        lowest = -limits.speed_max_rad_s if limits.allow_reverse else -self._reverse_rad_s
        leads = f"{speed_rad_s:.3f} rad/s reported and {command.torque_nm:.1f} N·m lead to {predicted:.3f} rad/s"
        if predicted > limits.speed_max_rad_s:
            raise LimitHit(
                self._besides(
                    f"the speed is about to leave its window: {leads}, beyond {limits.speed_max_rad_s:g} rad/s"
                ),
                where=where,
                next_step=f"The shaft was stopped. {self._helps('Lower the amplitude or the offset')}",
            )
        if predicted < lowest:
            raise LimitHit(
                self._besides(f"the shaft is about to turn backwards: {leads}"),
                where=where,
                next_step=f"The shaft was stopped. {self._helps('Lower the amplitude or raise the offset')}",
            )
        self._check_lower_end(speed_rad_s, where)

    def _check_lower_end(self, speed_rad_s: float, where: str) -> None:
        limits = self._limits
        if speed_rad_s < limits.speed_min_rad_s - self._speed_noise_rad_s:
            raise LimitHit(
                self._besides(
                    f"the speed has left its window: {speed_rad_s:.3f} rad/s is below {limits.speed_min_rad_s:g} rad/s"
                ),
                where=where,
                next_step="The shaft was stopped. "
                + self._helps("Lower the amplitude or raise the offset; did the load grow?"),
            )

    def _besides(self, what: str) -> str:
        return f"{what}; {self.disturbed}" if self.disturbed else what

    def _helps(self, usual: str) -> str:
        return LIGHTEN if self.disturbed else usual

    def _check_age(self, sample: Sample, where: str) -> None:
        if sample.fresh:
            self._stale = 0
            return
        self._stale += 1
        if self._stale >= self._stale_limit:
            late, missing = self.host_late(), f"no feedback for {self._stale} cycles"
            raise CommunicationLost(
                f"{late}; {missing}" if late else missing,
                where=f"host, and {where}" if late else where,
                next_step=LOWER_THE_RATE
                if late
                else "Check the drive's supply and the bus; the drive's own watchdog stops the shaft",
            )

    def _check_reports(self, where: str) -> None:
        """Raise what the observer found.

        CommunicationLost for feedback that repeats, LimitHit for a shaft that became lighter, ReportsContradict else.
        """
        doubt = self.observer.doubt
        if doubt is None:
            return
        if Signal.ALL in doubt.signals:
            raise CommunicationLost(doubt.what, where=where, next_step=doubt.helps)
        if doubt.lighter:
            raise LimitHit(doubt.what, where=where, next_step=f"The shaft was stopped. {doubt.helps}")
        raise ReportsContradict(doubt.what, where=where, next_step=f"The shaft was stopped. {doubt.helps}")

    def _check_mode(self, command: Command, sample: Sample) -> None:
        if self.expected is not PowerState.ENABLED:
            self._mode = _ModeShown()
        elif sample.fresh and not self._mode.see(command.mode, sample):
            shown = "none of those that it was prepared for" if sample.mode is None else f"{sample.mode.value} mode"
            raise ModeNotConfirmed(
                f"the drive lost its mode: {command.mode.value} mode is commanded, and it displays {shown}",
                where=f"mode display (6061h in CiA 402) at {sample.time_s:.3f} s",
                next_step="The shaft was stopped. Did a second master, a tool or a parameter of the drive change it?",
            )

    def torque_told(self, torque_nm: float, limit_active: bool, disturbed: bool = False) -> tuple[str, str]:
        """How a torque stands to its limit, and what would help a shaft that does not get its speed with it.

        ``disturbed``: a drill string under load keeps it from that.
        """
        limit_nm = self._limits.torque_nm
        if limit_active or abs(torque_nm) >= AT_LIMIT_SHARE * limit_nm:
            by = "the drive's internal limit acts" if limit_active else f"at its limit of {limit_nm:g} N·m"
            return (
                f"torque {torque_nm:.1f} N·m, {by}",
                "Does a brake or the load hold the shaft? Else it needs a higher torque limit (limits.torque_nm in"
                " rig.yaml, and the drive's own)",
            )
        if disturbed or self.disturbed:
            return f"torque {torque_nm:.1f} N·m, not at its limit of {limit_nm:g} N·m", LIGHTEN
        return (
            f"torque {torque_nm:.1f} N·m, not at its limit of {limit_nm:g} N·m",
            "Does the drive take its speed from elsewhere (panel, another master), hold a speed limit or a ramp of its"
            " own, or count speed in another unit than the profile says? Else its speed loop is tuned too softly",
        )

    def _check_following(self, command: Command, sample: Sample, where: str) -> None:
        following = self._following
        if self.expected is not PowerState.ENABLED or command.mode is not Mode.SPEED:
            following.reset()
        elif sample.fresh and not following.see(command.speed_rad_s, sample):
            torque, helps = self.torque_told(following.torque_nm, sample.limit_active)
            raise LimitHit(
                f"the speed does not follow: {command.speed_rad_s:.3f} rad/s commanded,"
                f" {following.speed_rad_s:.3f} rad/s reported, apart since {following.since_s:.1f} s and no nearer for"
                f" {following.within_s:g} s; {torque}",
                where=where,
                next_step=f"The shaft was stopped. {helps}",
            )

    def _check_limited(self, command: Command, sample: Sample) -> None:
        if command.mode is not Mode.TORQUE or not sample.limit_active:
            self._limited_since_s = None
        elif self._limited_since_s is None:
            self._limited_since_s = sample.time_s
        elif sample.time_s - self._limited_since_s >= LIMITED_S:
            raise LimitHit(
                f"the drive's internal limit has been active in torque mode for {LIMITED_S:g} s:"
                " its torque is not the commanded one",
                where=f"statusword {sample.status:04X}h, bit 11, at {sample.time_s:.3f} s",
                next_step="Which limit of the drive acts (torque, current, speed, voltage)? Look at its panel",
            )


class _ModeShown:
    """The mode that the drive displays beside the commanded one."""

    def __init__(self) -> None:
        self._commanded: Mode | None = None
        self._seen = False                 # in the commanded one, since that was commanded
        self._other_since_s: float | None = None
        self._others = 0

    def see(self, commanded: Mode, sample: Sample) -> bool:
        """False once another one has been displayed for too long."""
        if commanded is not self._commanded:
            self._commanded, self._seen, self._other_since_s = commanded, False, None
        if sample.mode is commanded:
            self._seen, self._other_since_s = True, None
            return True
        if self._other_since_s is None:
            self._other_since_s, self._others = sample.time_s, 0
        self._others += 1
        allowed_s = MODE_LOST_S if self._seen else MODE_SWITCH_S
        return self._others <= MODE_CYCLES or sample.time_s - self._other_since_s < allowed_s


class _Following:
    """The reported speed beside the reference of speed mode."""

    def __init__(
        self, limits: MachineLimits, period_s: float, speed_resolution_rad_s: float, assumptions: ControlAssumptions
    ) -> None:
        self._window_rad_s = max(FOLLOW_SHARE * limits.speed_max_rad_s, 5.0 * speed_resolution_rad_s)
        self._nearer_rad_s = max(NEARER_SHARE * limits.speed_max_rad_s, 2.0 * speed_resolution_rad_s)
        reach_s = assumptions.reaction_s + 3.0 * assumptions.largest_speed_lag_s + FOLLOW_MEAN_S
        self.within_s = FOLLOW_STRING_S if limits.winds_up else FOLLOW_S
        self._blocks: deque[_Block] = deque(maxlen=1 + math.ceil(reach_s / max(FOLLOW_BLOCK_S, period_s)))
        recent = max(1, round(FOLLOW_MEAN_S / period_s))
        self._speeds: deque[float] = deque(maxlen=recent)
        self._torques: deque[float] = deque(maxlen=recent)
        self.reset()

    def reset(self) -> None:
        """What comes next is seen as the first."""
        self._blocks.clear()
        self._side = 0.0                   # of the reference that the shaft is away on; 0: it is not
        self._anchor_rad_s = self._anchor_s = self.since_s = 0.0

    @property
    def speed_rad_s(self) -> float:
        """Mean reported speed."""
        return math.fsum(self._speeds) / len(self._speeds)

    @property
    def torque_nm(self) -> float:
        """Mean reported torque."""
        return math.fsum(self._torques) / len(self._torques)

    def see(self, reference_rad_s: float, sample: Sample) -> bool:
        """False once the shaft has been away from its reference, and come no nearer, for too long."""
        now_s = sample.time_s
        if not self._blocks or now_s - self._blocks[-1].start_s >= FOLLOW_BLOCK_S:
            self._blocks.append(_Block(now_s, reference_rad_s))
        else:
            self._blocks[-1].widen(reference_rad_s)
        self._speeds.append(sample.speed_rad_s)
        self._torques.append(sample.torque_nm)
        speed_rad_s = self.speed_rad_s
        side = self._side_of(speed_rad_s)
        if side != self._side:
            self._side, self._anchor_rad_s, self._anchor_s, self.since_s = side, speed_rad_s, now_s, now_s
        elif side * (speed_rad_s - self._anchor_rad_s) >= self._nearer_rad_s:
            self._anchor_rad_s, self._anchor_s = speed_rad_s, now_s
        return side == 0.0 or now_s - self._anchor_s < self.within_s


    def _side_of(self, speed_rad_s: float) -> float:
        latest, window_rad_s = self._blocks[-1], self._window_rad_s
        if latest.lowest - window_rad_s <= speed_rad_s and speed_rad_s - latest.highest <= window_rad_s:
            return 0.0           # as nearly always; earlier blocks only widen it
        if speed_rad_s < min(block.lowest for block in self._blocks) - window_rad_s:
            return 1.0
        return -1.0 if speed_rad_s - max(block.highest for block in self._blocks) > window_rad_s else 0.0


class _Block:
    """What the reference was from ``start_s`` on."""

    def __init__(self, start_s: float, reference_rad_s: float) -> None:
        self.start_s = start_s
        self.lowest = self.highest = reference_rad_s

    def widen(self, reference_rad_s: float) -> None:
        self.lowest, self.highest = min(self.lowest, reference_rad_s), max(self.highest, reference_rad_s)
