r"""A drill string that isn't there, on a top drive that is: string, bit and controller in a host, cycle by cycle. Pure.

::

    reported speed ──► observer ──► ω when the next torque acts ──┬──► controller ──► T ──┐
                                                                  └──► string, bit ──► τ ─┴─► T − τ ──► drive

Everything here is at the main shaft of the machine that is meant (its J, B and F_c), at its speeds and in its time. The
rig that turns may be another one: its torque is ``κ (T − τ)`` with κ = J_rig i/J, i = ω_motor/ω_main, so that the same
speeds come at the same times, plus what its own friction takes more than the meant one's. Where the rig is the machine
itself κ = 1/i, and nothing is added.

**Observer.** The reported speed is old by the lag τ_w that `identify` found. With y the report, d a torque that nobody
knows of, and F the rig's known friction,

    J dω/dt = T − F(ω) + d        τ_w dy/dt = ω − y        dd/dt = 0

is followed by the report through three equal poles (`RotorObserver`), exactly sampled; then ω is carried on by the
torque that is under way to the moment at which the next one acts. d is used for that and is never compensated: what
the real rotor does otherwise than the believed one, it also does to the virtual string.

**Energy.** String and bit take ∫ τ ω dt by their own speed, and ∫ τ y dt by the speed that is reported; what the first
is ahead of the second was put into the shaft by the loop's own errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import exp, expm1, inf, pi

import numpy as np

from tdhil.soft_torque.controller import SpeedController, TopDrive
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.simulation import LONGEST_TICK_S, RPM, SLIDING_BLUR_RAD_S, Array, PipeSimulation, grid_of


class VirtualString:
    """String and bit below a top whose speed is measured; armed to begin with.

    Raises ValueError where the string has no bit.
    """

    def __init__(self, string: DrillString, longest_tick_s: float = LONGEST_TICK_S) -> None:
        if string.bit is None:
            raise ValueError("no bit is stated")
        self._string, self._static_nm = string, string.bit.static_nm
        self._grid = grid_of(string, longest_tick_s)
        self.arm()

    def arm(self) -> None:
        """Put the string at rest, twisted to the point at which the bit is about to break away."""
        self._pipe = PipeSimulation((self._string,), (self._grid,))
        self._pipe.wind_up(np.array([self._static_nm]))
        self._into_tick_s = self._travel_rad = self._top_rad_s = 0.0

    @property
    def bit_rad_s(self) -> float:
        """Speed of the bit; 0 while it sticks."""
        return float(self._pipe.bit_rad_s[0])

    @property
    def torque_nm(self) -> float:
        """τ that the string takes from the top, now."""
        return float(self._pipe.top_torque(np.array([self._top_rad_s]))[0])

    def begin(self, top_rad_s: float) -> None:
        """Turn the top at this speed from now on."""
        self._top_rad_s = top_rad_s

    def release(self) -> None:
        """The bit comes off bottom: its dry friction is gone."""
        self._pipe.release()

    def step(self, top_rad_s: float, dt_s: float) -> float:
        """Move on while the top's speed goes, evenly, to ``top_rad_s``; τ then."""
        tick_s, impedance = self._grid.tick_s, self._grid.impedance_nm_s_rad[0]
        slope, left_s = (top_rad_s - self._top_rad_s) / dt_s, dt_s
        while left_s > 0.0:
            piece_s = min(left_s, tick_s - self._into_tick_s)
            after = self._top_rad_s + slope * piece_s
            self._travel_rad += 0.5 * (self._top_rad_s + after) * piece_s
            self._top_rad_s = after
            self._into_tick_s += piece_s
            left_s -= piece_s
            if tick_s - self._into_tick_s <= 1e-9 * tick_s:
                self._pipe.tick(2.0 * impedance * self._travel_rad / tick_s - self._pipe.at_top())
                self._into_tick_s = self._travel_rad = 0.0
        self._top_rad_s = top_rad_s
        return self.torque_nm


# ---------------------------------------------------------------------------------------------------------------------
# The controller as a host runs it: T = H [P (Ω − ω) + I ∫(Ω − ω) + J_c dω/dt], a cycle at a time.


class HostController:
    """Lags H are those that are meant to be in the loop; a cycle's own half, in which a torque waits, is taken off."""

    def __init__(self, law: SpeedController, inner_lags_s: tuple[float, ...], period_s: float) -> None:
        lags = sorted(inner_lags_s)
        waits_s = 0.5 * period_s
        while lags and waits_s > 0.0:
            off = min(lags[-1], waits_s)
            lags[-1], waits_s = lags[-1] - off, waits_s - off
            lags = sorted(lag for lag in lags if lag > 0.0)
        self._law, self._period_s = law, period_s
        self._lags = [_Lag(lag, period_s) for lag in lags]
        self._keeps = exp(-period_s / law.derivative_filter_s)
        self.begin(0.0, 0.0)

    def begin(self, speed_rad_s: float, torque_nm: float) -> None:
        """Steady rotation at the set speed, with that torque."""
        self._integral_nm = torque_nm
        self._error_rad_s = self._slope_rad_s2 = 0.0
        self._speed_rad_s = speed_rad_s
        for lag in self._lags:
            lag.before = lag.after = torque_nm

    def shift(self, torque_nm: float) -> None:
        """Add this torque from now on."""
        self._integral_nm += torque_nm
        for lag in self._lags:
            lag.before += torque_nm
            lag.after += torque_nm

    def step(self, set_rad_s: float, speed_rad_s: float) -> float:
        """The torque of the next cycle; everything goes evenly from cycle to cycle."""
        law, error = self._law, set_rad_s - speed_rad_s
        self._integral_nm += 0.5 * law.integral_nm_rad * (error + self._error_rad_s) * self._period_s
        slope = (speed_rad_s - self._speed_rad_s) / self._period_s
        self._slope_rad_s2 += (1.0 - self._keeps) * (slope - self._slope_rad_s2)
        self._error_rad_s, self._speed_rad_s = error, speed_rad_s
        torque = law.gain_nm_s_rad * error + self._integral_nm + law.compensated_kg_m2 * self._slope_rad_s2
        for lag in self._lags:
            torque = lag.step(torque)
        return torque


class _Lag:
    """1/(1 + τ s) for what goes evenly from cycle to cycle: exact."""

    def __init__(self, lag_s: float, period_s: float) -> None:
        self._keeps = exp(-period_s / lag_s)
        share = lag_s / period_s * -expm1(-period_s / lag_s)
        self._now, self._then = 1.0 - share, share - self._keeps
        self.before = self.after = 0.0

    def step(self, value: float) -> float:
        self.after = self._keeps * self.after + self._now * value + self._then * self.before
        self.before = value
        return self.after


# ---------------------------------------------------------------------------------------------------------------------

DRIFT_S = 10.0
"""Over which an unknown torque is taken for one of the drive's own integral, in its own loop."""
OBSERVER_SHARE = 2.0
"""The observer's poles lie at this share of 1/τ_w …"""
SLOWEST_RAD_S, FASTEST_RAD_S = 3.0, 10.0
"""… within these, and below a quarter of what a cycle can follow."""


@dataclass(frozen=True)
class IdentifiedRig:
    """The machine that turns, at the motor's shaft, as `identify` found it."""

    inertia_kg_m2: float
    viscous_nm_s_rad: float
    coulomb_nm: float
    speed_lag_s: float
    gear_ratio: float = 1.0


class RotorObserver:
    """The rotor's speed now, from torques that were commanded and speeds that were reported late."""

    def __init__(self, drive: TopDrive, speed_lag_s: float, period_s: float) -> None:
        from scipy.linalg import expm

        lag_s = max(speed_lag_s, 1e-3)
        pole = min(max(OBSERVER_SHARE / lag_s, SLOWEST_RAD_S), FASTEST_RAD_S, 0.25 * 2.0 * pi / (2.0 * period_s))
        law = np.zeros((4, 4))             # ω, y, d and the torque
        law[0] = [-drive.viscous_nm_s_rad / drive.inertia_kg_m2, 0.0, *[1.0 / drive.inertia_kg_m2] * 2]
        law[1, :2] = 1.0 / lag_s, -1.0 / lag_s
        self._law, self._expm = law, expm
        step = expm(law * period_s)[:3]
        self._period_s = period_s
        self._move, self._push = step[:, :3], step[:, 3]
        # Ackermann's formula for the errors before a report, of which C A is seen.
        seen = np.array([0.0, 1.0, 0.0]) @ self._move
        wanted = np.linalg.matrix_power(self._move - exp(-pole * period_s) * np.eye(3), 3)
        visible = np.stack([seen, seen @ self._move, seen @ self._move @ self._move])
        self._gain = wanted @ np.linalg.solve(visible, np.array([0.0, 0.0, 1.0]))
        self._dry_nm = drive.coulomb_nm
        self._state: Array = np.zeros(3)
        self.innovation_rad_s = 0.0

    def begin(self, speed_rad_s: float) -> None:
        """Steady rotation at that speed."""
        self._state = np.array([speed_rad_s, speed_rad_s, 0.0])
        self.innovation_rad_s = 0.0

    @property
    def speed_rad_s(self) -> float:
        """ω at the last report."""
        return float(self._state[0])

    @property
    def unknown_nm(self) -> float:
        """D, the torque that nobody told of."""
        return float(self._state[2])

    def _carried(self, torque_nm: float) -> Array:
        net = torque_nm - self._dry_nm * min(1.0, max(-1.0, self._state[0] / SLIDING_BLUR_RAD_S))
        moved: Array = self._move @ self._state + self._push * net
        return moved

    def see(self, torque_nm: float, reported_rad_s: float | None) -> None:
        """A cycle with that torque has gone by; what was reported at its end, None: nothing."""
        self._state = self._carried(torque_nm)
        if reported_rad_s is not None:
            self.innovation_rad_s = reported_rad_s - float(self._state[1])
            self._state = self._state + self._gain * self.innovation_rad_s

    def less_unknown(self, torque_nm: float) -> None:
        """Take this much of the unknown torque as known from now on."""
        self._state[2] -= torque_nm

    def ahead(self, torque_nm: float) -> float:
        """ω one cycle on, with the torque that is under way."""
        return float(self._carried(torque_nm)[0])


# ---------------------------------------------------------------------------------------------------------------------
# What is done with it. The string is wound up to where the bit is about to break away, its torque faded in against as
# much of the drive's, and let go, the top at full set speed: that is how `tune` tells its *cure*. At a first speed the
# bit must stick and slip; from there one ramp of the set speed goes up until it turns, which brackets the critical
# speed. A ramp alone scatters by one stick, 3 rpm, and a stiff loop carries its swing 20 rpm beyond its cure: so trials
# at steady set speeds follow, each from the bit about to break away, and halve the bracket down to 1 rpm.


class Phase(IntEnum):
    """Phase of the course."""

    MOVE = 0           # to a set speed, without string
    ARM = 1            # the wound-up string's torque is faded in
    HOLD = 2           # the bit shall stick and slip
    RAMP = 3
    STEADY = 4         # it turns
    RELEASED = 5       # the bit is off bottom, and what swings decays
    FADE_OUT = 6
    TRIAL = 7          # does it end turning, at this set speed?
    DONE = 8


@dataclass(frozen=True)
class SpeedProgram:
    """Speeds are of the main shaft."""

    start_rad_s: float
    """At which the bit must stick and slip."""
    highest_rad_s: float
    """No set speed goes beyond."""
    ramp_rad_s2: float = 0.5 * RPM
    move_rad_s2: float = 2.0 * RPM
    settle_s: float = 4.0
    fade_s: float = 5.0
    armed_s: float = 0.0
    """Of the whole torque before the string is let go, for a loop that has to make up for it by itself."""
    hold_s: float = 20.0
    calm_s: float = 15.0
    """Without sticking for so long, the bit turns."""
    steady_s: float = 20.0
    released_s: float = 15.0
    trial_s: float = 60.0
    """A bit that sticks after it does not turn."""
    resolution_rad_s: float = 1.0 * RPM
    most_trials: int = 8
    peak_nm: float = inf
    """Of the torque that moves the rotor, as simulated: no 5 s of it may have as much rms."""

    @property
    def longest_s(self) -> float:
        """Duration of the whole program, if every trial takes its full time, s."""
        span = self.highest_rad_s - self.start_rad_s
        around = 2.0 * self.fade_s + self.armed_s + self.settle_s
        once = self.hold_s + span / self.ramp_rad_s2 + self.steady_s + self.released_s + around
        return once + self.most_trials * (self.trial_s + around + 0.5 * span / self.move_rad_s2)


class ProgramCourse:
    """Position in the program. In every cycle it takes whether the bit stands still."""

    def __init__(self, program: SpeedProgram, period_s: float) -> None:
        self._program, self._period_s = program, period_s
        self._time_s = self._phase_s = self._stuck_s = 0.0
        self._target_rad_s = program.start_rad_s
        self._sticks_at, self._turns_at = program.start_rad_s, 0.0     # 0: nothing has turned yet
        self._trials = 0
        self._first = True
        self.phase = Phase.MOVE
        self.set_rad_s = program.start_rad_s
        self.slope_rad_s2 = 0.0
        """Of the set speed while it is moved without a string."""
        self.share = 0.0
        """Of the string's torque that acts."""

    def step(self, stuck: bool) -> Phase | None:
        """A cycle on; the phase that begins with it."""
        before = self.phase
        self._time_s += self._period_s
        self._phase_s += self._period_s
        if stuck:
            self._stuck_s = self._time_s
        self.slope_rad_s2 = 0.0
        if step := _STEPS.get(self.phase):
            step(self)
        if self.phase is before:
            return None
        self._phase_s = 0.0
        self._stuck_s = self._time_s
        return self.phase

    def end(self) -> None:
        """Fade out from wherever it is, and be done."""
        self._trials = self._program.most_trials
        if self.phase is not Phase.DONE:
            self.phase, self._phase_s = Phase.FADE_OUT, (1.0 - self.share) * self._program.fade_s

    @property
    def _calm(self) -> bool:
        return self._time_s - self._stuck_s >= self._program.calm_s

    def _move(self) -> None:
        step = self._program.move_rad_s2 * self._period_s
        left = self._target_rad_s - self.set_rad_s
        if left:
            moved = min(step, max(-step, left))
            self.set_rad_s += moved
            self.slope_rad_s2 = moved / self._period_s
            self._phase_s = 0.0
        elif self._phase_s >= self._program.settle_s:
            self.phase = Phase.ARM

    def _arm(self) -> None:
        self.share = min(1.0, self._phase_s / self._program.fade_s)
        if self._phase_s >= self._program.fade_s + self._program.armed_s:
            self.phase = Phase.HOLD if self._first else Phase.TRIAL

    def _hold(self) -> None:
        if self._phase_s >= self._program.hold_s:
            self.phase = Phase.RAMP if self._time_s - self._stuck_s < 0.5 * self._program.hold_s else Phase.FADE_OUT
            self._first = False
            if self.phase is Phase.FADE_OUT:
                self._trials = self._program.most_trials      # it does not even stick: nothing is left to look for

    def _ramp(self) -> None:
        program = self._program
        self.set_rad_s = min(program.highest_rad_s, self.set_rad_s + program.ramp_rad_s2 * self._period_s)
        if self._calm or self.set_rad_s >= program.highest_rad_s:
            stuck_for_s = self._time_s - self._stuck_s
            at = self.set_rad_s - program.ramp_rad_s2 * stuck_for_s
            self._target_rad_s = max(program.start_rad_s + program.resolution_rad_s, at)
            self.phase = Phase.STEADY if self._calm else Phase.FADE_OUT

    def _steady(self) -> None:
        if self._phase_s >= self._program.steady_s:
            self.phase = Phase.RELEASED

    def _released(self) -> None:
        if self._phase_s >= self._program.released_s:
            self.phase = Phase.FADE_OUT

    def _trial(self) -> None:
        over = self._phase_s >= self._program.trial_s
        if not (self._calm or over):
            return
        program = self._program
        self._trials += 1
        if self._calm:
            self._turns_at = self.set_rad_s
        else:
            self._sticks_at = self.set_rad_s
        if self._turns_at:
            self._target_rad_s = 0.5 * (self._sticks_at + self._turns_at)
            if self._turns_at - self._sticks_at <= program.resolution_rad_s:
                self._trials = program.most_trials
        elif self._sticks_at >= program.highest_rad_s:
            self._trials = program.most_trials
        else:
            self._target_rad_s = min(program.highest_rad_s, self._sticks_at + 6.0 * program.resolution_rad_s)
        self.phase = Phase.FADE_OUT

    def _fade_out(self) -> None:
        self.share = max(0.0, 1.0 - self._phase_s / self._program.fade_s)
        if self.share == 0.0:
            self.phase = Phase.DONE if self._trials >= self._program.most_trials else Phase.MOVE


_STEPS = {
    Phase.MOVE: ProgramCourse._move, Phase.ARM: ProgramCourse._arm, Phase.HOLD: ProgramCourse._hold,
    Phase.RAMP: ProgramCourse._ramp,
    Phase.STEADY: ProgramCourse._steady, Phase.RELEASED: ProgramCourse._released,
    Phase.FADE_OUT: ProgramCourse._fade_out,
    Phase.TRIAL: ProgramCourse._trial,
}


# ---------------------------------------------------------------------------------------------------------------------

COLUMNS = (
    "time_s", "phase", "set_rad_s", "top_rad_s", "innovation_rad_s", "string_nm", "drive_nm", "share", "bit_rad_s",
    "unknown_nm", "put_in_j", "clamped",
)
"""Of a cycle, at the meant machine's main shaft: ``top_rad_s`` as observed and carried on, ``share`` of the string's
torque that acts, ``put_in_j`` of energy by the loop's errors, ``clamped`` 1 where the torque limit cut it."""


class HostLoop:
    """String, controller and observer at one cycle: report in, torque out; ``row`` is what the log keeps of it.

    ``own_loop``: the controller is the drive's; what goes out is the string's torque alone, as a torque offset beside
    `set_rad_s`, and the law is what the observer takes the drive's own torque for.
    """

    def __init__(
        self, string: DrillString, meant: TopDrive, law: SpeedController, rig: IdentifiedRig, program: SpeedProgram,
        period_s: float, torque_limit_nm: float, own_loop: bool = False,
    ) -> None:
        self._meant, self._rig, self._period_s, self._own_loop = meant, rig, period_s, own_loop
        self.scale = 1.0 / rig.gear_ratio if own_loop else rig.inertia_kg_m2 * rig.gear_ratio / meant.inertia_kg_m2
        """κ, from the meant machine's torque to the rig's."""
        self._limit_nm = torque_limit_nm
        self._own = TopDrive(rig.inertia_kg_m2 * rig.gear_ratio / self.scale,
                             rig.viscous_nm_s_rad * rig.gear_ratio / self.scale, rig.coulomb_nm / self.scale)
        self._same = own_loop or abs(self.scale * rig.gear_ratio - 1.0) < 1e-9
        self._observer = RotorObserver(self._own, rig.speed_lag_s, period_s)
        self._string = VirtualString(string)
        self._controller = HostController(law, meant.inner_lags_s, period_s)
        self._course = ProgramCourse(program, period_s)
        self._torque_nm = self._acted_nm = 0.0     # acts until the next one does, and the one before; main shaft
        self._share = 0.0
        self._put_in_j = self._net_nm = 0.0
        self._clamped = self._cut = False
        self.row: tuple[float, ...] = ()

    @property
    def phase(self) -> Phase:
        """Present phase of the program."""
        return self._course.phase

    @property
    def set_rad_s(self) -> float:
        """The set speed, of the main shaft."""
        return self._course.set_rad_s

    @property
    def innovation_rad_s(self) -> float:
        """Difference of the last report from the expected one, at the main shaft."""
        return self._observer.innovation_rad_s

    @property
    def net_nm(self) -> float:
        """That moves the meant rotor: of its drive, less the string's."""
        return self._net_nm

    @property
    def put_in_j(self) -> float:
        """Energy that the loop's errors put into the intended shaft, J."""
        return self._put_in_j

    @property
    def clamped(self) -> bool:
        """Did the torque limit cut the last torque?"""
        return self._clamped

    def cut(self) -> None:
        """A torque limit acts: fade the string out, and be done. Every row from now on says so."""
        self._cut = True
        self._course.end()

    def begin(self, reported_rad_s: float, torque_nm: float) -> None:
        """Steady rotation at the program's start with that torque of the motor."""
        speed = reported_rad_s / self._rig.gear_ratio
        self._torque_nm = self._acted_nm = torque_nm / self.scale
        self._observer.begin(speed)
        self._controller.begin(speed, self._torque_nm - self._more_friction(speed))

    def _more_friction(self, speed: float) -> float:
        """That the rig has more than the meant machine, N·m at its main shaft."""
        if self._same:
            return 0.0
        own, meant = self._own, self._meant
        sign = min(1.0, max(-1.0, speed / SLIDING_BLUR_RAD_S))
        viscous, dry = own.viscous_nm_s_rad - meant.viscous_nm_s_rad, own.coulomb_nm - meant.coulomb_nm
        return viscous * speed + dry * sign

    def step(self, time_s: float, reported_rad_s: float | None) -> float:
        """The motor's torque for the next cycle, N·m, after this cycle's report (None: it brought none)."""
        period_s, course, string = self._period_s, self._course, self._string
        seen = None if reported_rad_s is None else reported_rad_s / self._rig.gear_ratio
        self._observer.see(self._acted_nm, seen)
        speed = self._observer.ahead(self._torque_nm)
        begun = course.step(string.bit_rad_s == 0.0)
        if begun is Phase.ARM:
            string.arm()
        elif begun in (Phase.HOLD, Phase.TRIAL):
            string.begin(speed)
        elif begun is Phase.RELEASED:
            string.release()
        if course.phase not in (Phase.MOVE, Phase.ARM, Phase.DONE):
            string.step(speed, period_s)
        string_nm = string.torque_nm
        share = course.share
        if self._own_loop:
            # The drive's integral runs on counts of the set speed that ours doesn't see: they drift apart, slowly.
            drifted_nm = self._observer.unknown_nm * period_s / DRIFT_S
            self._controller.shift(drifted_nm)
            self._observer.less_unknown(drifted_nm)
        else:
            # What comes in or goes is met by as much of the drive's: no controller under test has to make up for it.
            self._controller.shift((share - self._share) * string_nm)
        self._share = share
        drive_nm = self._controller.step(course.set_rad_s, speed)
        moving_nm = self._meant.inertia_kg_m2 * course.slope_rad_s2
        self._put_in_j -= share * string_nm * self._observer.innovation_rad_s * period_s
        by_drive_nm = drive_nm + (0.0 if self._own_loop else moving_nm)
        self._net_nm = by_drive_nm - share * string_nm
        others_nm = by_drive_nm if self._own_loop else 0.0      # of what acts, that isn't ours to command
        wanted = self.scale * (self._net_nm - others_nm + self._more_friction(speed))
        torque = min(max(wanted, -self._limit_nm), self._limit_nm)     # NaN stays NaN, for the guard
        self._acted_nm, self._torque_nm = self._torque_nm, torque / self.scale + others_nm
        self._clamped = self._cut or torque != wanted
        self.row = (
            time_s, float(course.phase), course.set_rad_s, speed, self._observer.innovation_rad_s, string_nm, drive_nm,
            share, string.bit_rad_s, self._observer.unknown_nm, self._put_in_j, float(self._clamped),
        )
        return torque
