r"""Virtual drill string on a real top drive: the host simulates string, bit and controller, cycle by cycle.

This module only computes; it has no bus and no clock.

::

    reported speed ──► observer ──► ω when the next torque acts ──┬──► controller ──► T ──┐
                                                                  └──► string, bit ──► τ ─┴─► T − τ ──► drive

All quantities are at the main shaft of the intended machine (with its J, B and F_c), at its speeds and in its time. The
rig may be another machine. Its torque is ``κ (T − τ)`` with κ = J_rig i/J and i = ω_motor/ω_main, so the rig has the
same speeds at the same times. The difference between the rig's friction and the intended machine's is added. If the
rig is the intended machine, κ = 1/i, and nothing is added. J_rig is in the drive's own N·m, in which it is commanded:
after a torque calibration with factor c it is J/c, so that κ contains 1/c.

**Observer.** The reported speed lags by the time constant τ_w that `identify` found. y is the reported speed, d an
unknown torque, and F the known friction of the rig. The model is

    J dω/dt = T − F(ω) + d        τ_w dy/dt = ω − y        dd/dt = 0

The reports correct this model with three equal poles (`RotorObserver`), in exact discrete time. Then ω is predicted,
with the torque that acts now, for the moment at which the next torque acts. d is used for this prediction only and is
never compensated. A difference between the real rotor and its model therefore acts on the virtual string, too.

**Energy.** String and bit take the energy ∫ τ ω dt at the observed speed, and ∫ τ y dt at the reported speed. The
difference is the energy that the loop's own errors put into the shaft.
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
    """Simulation of string and bit below a top with a given speed. The initial state is that of `arm`.

    Raises ValueError if the string has no bit.
    """

    def __init__(self, string: DrillString, longest_tick_s: float = LONGEST_TICK_S) -> None:
        if string.bit is None:
            raise ValueError("no bit is stated")
        self._string, self._static_nm = string, string.bit.static_nm
        self._grid = grid_of(string, longest_tick_s)
        self.arm()

    def arm(self) -> None:
        """Set the string to standstill, twisted so far that the bit is about to break away."""
        self._pipe = PipeSimulation((self._string,), (self._grid,))
        self._pipe.wind_up(np.array([self._static_nm]))
        self._into_tick_s = self._travel_rad = self._top_rad_s = 0.0

    @property
    def bit_rad_s(self) -> float:
        """Speed of the bit, rad/s; 0 while it sticks."""
        return float(self._pipe.bit_rad_s[0])

    @property
    def torque_nm(self) -> float:
        """Torque τ that the string takes from the top now, N·m."""
        return float(self._pipe.top_torque(np.array([self._top_rad_s]))[0])

    def begin(self, top_rad_s: float) -> None:
        """Set the speed of the top from now on, rad/s."""
        self._top_rad_s = top_rad_s

    def release(self) -> None:
        """Remove the dry friction of the bit, as when it is lifted off bottom."""
        self._pipe.release()

    def step(self, top_rad_s: float, dt_s: float) -> float:
        """Advance by ``dt_s``, while the top's speed changes linearly to ``top_rad_s``. Return τ at the end, N·m."""
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
# Controller in the host: T = H [P (Ω − ω) + I ∫(Ω − ω) + J_c dω/dt], computed once in each cycle.


class HostController:
    """Speed controller in the host, with the lags H that the loop shall have.

    Each torque waits for half a cycle on average. The lags are shortened by this time.
    """

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
        """Set the state to steady rotation at that speed, rad/s, with that torque, N·m."""
        self._integral_nm = torque_nm
        self._error_rad_s = self._slope_rad_s2 = 0.0
        self._speed_rad_s = speed_rad_s
        for lag in self._lags:
            lag.before = lag.after = torque_nm

    def shift(self, torque_nm: float) -> None:
        """Add this torque, N·m, to the integral and to the outputs of the lags."""
        self._integral_nm += torque_nm
        for lag in self._lags:
            lag.before += torque_nm
            lag.after += torque_nm

    def step(self, set_rad_s: float, speed_rad_s: float) -> float:
        """Return the torque of the next cycle, N·m. Signals change linearly from cycle to cycle."""
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
    """First-order lag 1/(1 + τ s), exact for a signal that changes linearly from cycle to cycle."""

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
"""Time constant, s, with which the unknown torque is assigned to the integral of the drive's own speed loop."""
OBSERVER_SHARE = 2.0
"""Poles of the observer, as a multiple of 1/τ_w."""
SLOWEST_RAD_S, FASTEST_RAD_S = 3.0, 10.0
"""Limits of the observer's poles, rad/s. A further limit is a quarter of the cycle's Nyquist frequency."""


@dataclass(frozen=True)
class IdentifiedRig:
    """The rig that turns, as `identify` found it, at the motor shaft: J and friction in the drive's own N·m.

    ``torque_factor``: true torque over torque in the drive's own N·m, of a torque calibration that the drive does not
    know; 1 without one. The speed controller of the intended machine and the string are in true N·m.
    """

    inertia_kg_m2: float
    viscous_nm_s_rad: float
    coulomb_nm: float
    speed_lag_s: float
    gear_ratio: float = 1.0
    torque_factor: float = 1.0

    @property
    def main_shaft_inertia_kg_m2(self) -> float:
        """True J at the main shaft."""
        return self.torque_factor * self.inertia_kg_m2 * self.gear_ratio**2


class RotorObserver:
    """Observer of the rotor's present speed, from the commanded torques and the delayed reported speeds."""

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
        # Ackermann's formula for the error before a report. Its output matrix is C A.
        seen = np.array([0.0, 1.0, 0.0]) @ self._move
        wanted = np.linalg.matrix_power(self._move - exp(-pole * period_s) * np.eye(3), 3)
        visible = np.stack([seen, seen @ self._move, seen @ self._move @ self._move])
        self._gain = wanted @ np.linalg.solve(visible, np.array([0.0, 0.0, 1.0]))
        self._dry_nm = drive.coulomb_nm
        self._state: Array = np.zeros(3)
        self.innovation_rad_s = 0.0

    def begin(self, speed_rad_s: float) -> None:
        """Set the state to steady rotation at that speed, rad/s."""
        self._state = np.array([speed_rad_s, speed_rad_s, 0.0])
        self.innovation_rad_s = 0.0

    @property
    def speed_rad_s(self) -> float:
        """Estimated speed ω at the last report, rad/s."""
        return float(self._state[0])

    @property
    def unknown_nm(self) -> float:
        """Estimated unknown torque d, N·m."""
        return float(self._state[2])

    def _carried(self, torque_nm: float) -> Array:
        net = torque_nm - self._dry_nm * min(1.0, max(-1.0, self._state[0] / SLIDING_BLUR_RAD_S))
        moved: Array = self._move @ self._state + self._push * net
        return moved

    def see(self, torque_nm: float, reported_rad_s: float | None) -> None:
        """Advance by one cycle with that torque, N·m, and correct by the report at its end (None: no report)."""
        self._state = self._carried(torque_nm)
        if reported_rad_s is not None:
            self.innovation_rad_s = reported_rad_s - float(self._state[1])
            self._state = self._state + self._gain * self.innovation_rad_s

    def less_unknown(self, torque_nm: float) -> None:
        """Subtract this torque, N·m, from the unknown torque, because it is known now."""
        self._state[2] -= torque_nm

    def ahead(self, torque_nm: float) -> float:
        """Return the predicted speed ω after one more cycle with that torque, rad/s."""
        return float(self._carried(torque_nm)[0])


# ---------------------------------------------------------------------------------------------------------------------
# Program of an evaluation. The string is twisted until the bit is about to break away. Its torque is faded in against
# the same torque of the drive. Then the string is released with the top at full set speed. `tune` computes its *cure*
# speed from the same state. At the first set speed the bit must stick and slip. From there, one ramp of the set speed
# goes up until the bit turns, which brackets the critical speed. The result of a ramp alone scatters by one stick,
# 3 rpm, and with a stiff loop the oscillation continues up to 20 rpm above the cure speed. Therefore trials at steady
# set speeds follow. Each begins with the bit about to break away. They halve the bracket down to 1 rpm.


class Phase(IntEnum):
    """Phase of the program."""

    MOVE = 0           # the set speed moves, without string
    ARM = 1            # the torque of the twisted string is faded in
    HOLD = 2           # the bit shall stick and slip
    RAMP = 3           # the set speed rises until the bit turns
    STEADY = 4         # the bit turns
    RELEASED = 5       # the bit is off bottom, and the oscillation decays
    FADE_OUT = 6       # the torque of the string is faded out
    TRIAL = 7          # steady set speed: does the bit turn in the end?
    DONE = 8


@dataclass(frozen=True)
class SpeedProgram:
    """Program of set speeds, at the main shaft."""

    start_rad_s: float
    """First set speed. The bit must stick and slip there."""
    highest_rad_s: float
    """Highest set speed."""
    ramp_rad_s2: float = 0.5 * RPM
    """Slope of the set speed in the phase RAMP."""
    move_rad_s2: float = 2.0 * RPM
    """Slope of the set speed in the phase MOVE."""
    settle_s: float = 4.0
    """Time at a new set speed before the string's torque is faded in."""
    fade_s: float = 5.0
    """Time of fading in or out."""
    armed_s: float = 0.0
    """Time with the whole torque before the string is released, for a loop that must balance this torque itself."""
    hold_s: float = 20.0
    calm_s: float = 15.0
    """The bit counts as turning if it does not stick for this time."""
    steady_s: float = 20.0
    released_s: float = 15.0
    trial_s: float = 60.0
    """Longest time of a trial. The bit counts as sticking if it does not turn by then."""
    resolution_rad_s: float = 1.0 * RPM
    """Width of the bracket of the critical speed at which the trials end."""
    most_trials: int = 8
    peak_nm: float = inf
    """Peak of the torque that moves the rotor, from the simulation. The rms over any 5 s must stay below it."""

    @property
    def longest_s(self) -> float:
        """Duration of the whole program, if every trial takes its full time, s."""
        span = self.highest_rad_s - self.start_rad_s
        around = 2.0 * self.fade_s + self.armed_s + self.settle_s
        once = self.hold_s + span / self.ramp_rad_s2 + self.steady_s + self.released_s + around
        return once + self.most_trials * (self.trial_s + around + 0.5 * span / self.move_rad_s2)


class ProgramCourse:
    """State of the program. Each cycle, `step` gets the information whether the bit stands still."""

    def __init__(self, program: SpeedProgram, period_s: float) -> None:
        self._program, self._period_s = program, period_s
        self._time_s = self._phase_s = self._stuck_s = 0.0
        self._target_rad_s = program.start_rad_s
        self._sticks_at, self._turns_at = program.start_rad_s, 0.0     # 0: the bit has not turned in a trial yet
        self._trials = 0
        self._first = True
        self.phase = Phase.MOVE
        self.set_rad_s = program.start_rad_s
        self.slope_rad_s2 = 0.0
        """Slope of the set speed while it moves without a string, rad/s²."""
        self.share = 0.0
        """Share of the string's torque that acts."""

    def step(self, stuck: bool) -> Phase | None:
        """Advance by one cycle. Return the phase that begins with it, or None if the phase continues."""
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
        """End the program: fade the string's torque out from its present share."""
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
                self._trials = self._program.most_trials      # without stick-slip there is no critical speed to find

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
"""Columns of the log, one row for each cycle, at the main shaft of the intended machine. ``top_rad_s``: observed and
predicted speed of the top. ``share``: share of the string's torque that acts. ``put_in_j``: energy from the loop's own
errors. ``clamped``: 1 if the torque limit acted."""


class HostLoop:
    """String, controller and observer in one loop. Each cycle takes a report and returns a torque.

    ``row`` has the values of the last cycle for the log. ``own_loop``: the controller is that of the drive. Then the
    output is only the string's torque, as a torque offset beside `set_rad_s`, and the observer uses ``law`` as a model
    of the drive's own torque.
    """

    def __init__(
        self, string: DrillString, meant: TopDrive, law: SpeedController, rig: IdentifiedRig, program: SpeedProgram,
        period_s: float, torque_limit_nm: float, own_loop: bool = False,
    ) -> None:
        self._meant, self._rig, self._period_s, self._own_loop = meant, rig, period_s, own_loop
        self.scale = (1.0 / (rig.gear_ratio * rig.torque_factor) if own_loop
                      else rig.inertia_kg_m2 * rig.gear_ratio / meant.inertia_kg_m2)
        """Factor κ from the intended machine's torque to the rig's torque in the drive's own N·m."""
        self._limit_nm = torque_limit_nm
        self._own = TopDrive(rig.inertia_kg_m2 * rig.gear_ratio / self.scale,
                             rig.viscous_nm_s_rad * rig.gear_ratio / self.scale, rig.coulomb_nm / self.scale)
        self._same = own_loop or abs(self.scale * rig.gear_ratio - 1.0) < 1e-9
        self._observer = RotorObserver(self._own, rig.speed_lag_s, period_s)
        self._string = VirtualString(string)
        self._controller = HostController(law, meant.inner_lags_s, period_s)
        self._course = ProgramCourse(program, period_s)
        self._torque_nm = self._acted_nm = 0.0     # torque that acts now, and the one before it; main shaft
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
        """Set speed of the main shaft, rad/s."""
        return self._course.set_rad_s

    @property
    def innovation_rad_s(self) -> float:
        """Innovation: last reported speed less the expected one, at the main shaft, rad/s."""
        return self._observer.innovation_rad_s

    @property
    def net_nm(self) -> float:
        """Torque that moves the intended rotor: that of its drive less that of the string, N·m."""
        return self._net_nm

    @property
    def put_in_j(self) -> float:
        """Energy that the loop's errors put into the intended shaft, J."""
        return self._put_in_j

    @property
    def clamped(self) -> bool:
        """True: a torque limit acted in the last cycle."""
        return self._clamped

    def cut(self) -> None:
        """End the program because a torque limit acts: fade the string out. All further rows have ``clamped`` = 1."""
        self._cut = True
        self._course.end()

    def begin(self, reported_rad_s: float, torque_nm: float) -> None:
        """Set the state to steady rotation at the program's start, with that torque of the motor, N·m."""
        speed = reported_rad_s / self._rig.gear_ratio
        self._torque_nm = self._acted_nm = torque_nm / self.scale
        self._observer.begin(speed)
        self._controller.begin(speed, self._torque_nm - self._more_friction(speed))

    def _more_friction(self, speed: float) -> float:
        """Return the rig's friction less that of the intended machine, N·m at its main shaft."""
        if self._same:
            return 0.0
        own, meant = self._own, self._meant
        sign = min(1.0, max(-1.0, speed / SLIDING_BLUR_RAD_S))
        viscous, dry = own.viscous_nm_s_rad - meant.viscous_nm_s_rad, own.coulomb_nm - meant.coulomb_nm
        return viscous * speed + dry * sign

    def step(self, time_s: float, reported_rad_s: float | None) -> float:
        """Return the motor's torque for the next cycle, N·m, after this cycle's report (None: no report)."""
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
            # The drive integrates a rounded set speed, the host an exact one. So the two integrals slowly drift apart.
            drifted_nm = self._observer.unknown_nm * period_s / DRIFT_S
            self._controller.shift(drifted_nm)
            self._observer.less_unknown(drifted_nm)
        else:
            # The drive's torque changes with the faded torque. The controller under test need not balance it.
            self._controller.shift((share - self._share) * string_nm)
        self._share = share
        drive_nm = self._controller.step(course.set_rad_s, speed)
        moving_nm = self._meant.inertia_kg_m2 * course.slope_rad_s2
        self._put_in_j -= share * string_nm * self._observer.innovation_rad_s * period_s
        by_drive_nm = drive_nm + (0.0 if self._own_loop else moving_nm)
        self._net_nm = by_drive_nm - share * string_nm
        others_nm = by_drive_nm if self._own_loop else 0.0      # torque that the host does not command
        wanted = self.scale * (self._net_nm - others_nm + self._more_friction(speed))
        torque = min(max(wanted, -self._limit_nm), self._limit_nm)     # NaN stays NaN, for the guard
        self._acted_nm, self._torque_nm = self._torque_nm, torque / self.scale + others_nm
        self._clamped = self._cut or torque != wanted
        self.row = (
            time_s, float(course.phase), course.set_rad_s, speed, self._observer.innovation_rad_s, string_nm, drive_nm,
            share, string.bit_rad_s, self._observer.unknown_nm, self._put_in_j, float(self._clamped),
        )
        return torque
