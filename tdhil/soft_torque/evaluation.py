"""Virtual string on a real drive: checks before the run, the program of set speeds, and the evaluation of its log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from math import inf, pi
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from profiles import MessageCode, TdhilError
from tdhil.soft_torque.controller import SpeedController, TopDrive
from tdhil.soft_torque.critical_speed import CALM_INTEGRAL_TIMES, longest_integral_time_s
from tdhil.soft_torque.disturbed_cure import TRIALS, DisturbedTrials, disturbed_trials
from tdhil.soft_torque.drill_string import DrillString, StringTolerance
from tdhil.soft_torque.simulation import LONGEST_TICK_S, RPM, Array, Begin, simulate
from tdhil.soft_torque.tuned_figures import lowest_modes_below_hz, string_modes_hz
from tdhil.soft_torque.uncertainty import Interval
from tdhil.soft_torque.virtual_string import COLUMNS, IdentifiedRig, Phase, SpeedProgram

LOWEST_RATE_HZ = 20.0
MOST_CROSSOVER = 0.35
"""Largest P/(J − J_c) times the cycle time. A faster controller oscillates because of the cycle time alone."""
MOST_LAG_S, MOST_LAG_ERROR_S = 0.5, 0.05
"""Largest lag of the reported speed and its largest error, s. Above them, the measured damping may come from the
observer instead of the string."""
LEAST_DRAG_NM_S_RAD_M = 0.001
"""Least drag of the virtual mud, per metre. It takes up the energy that the loop's own errors put into the string."""

BELOW_RPM = (12.0, 10.0, 8.0, 6.0, 4.0)
"""Distances of the first set speed below the predicted critical speed, rpm. The bit shall stick at this speed. The
first distance that the rig's limits allow is used."""
ABOVE_RPM, ABOVE_SHARE = 20.0, 0.2
"""Distance of the ramp's end above the critical speed, rpm and share. The larger of both is used."""
ROOM_SHARE = 0.8
"""Share of the torque limit that the program may need. The rest is for noise and for the observer's corrections."""
TOLERANCE_RPM, TOLERANCE_DAMPING = 3.0, 0.03
"""Distance from the predicted interval that still counts as predicted, rpm and damping ratio. Virtual strings on
simulated drives came as near as this to real strings."""


OWN_LOOP_FADE_S, OWN_LOOP_ARMED_S = 15.0, 12.0
SAME_INERTIA = 0.15
"""Largest relative difference between the rig's inertia and the inertia of the tuning, with the drive's own loop."""


class EvaluationRefused(TdhilError):
    """Refusal before motion: a virtual string on this rig would not be correct, or the rig's limits exclude it."""

    entry = MessageCode.VIRTUAL_STRING_REFUSED

    exit_code = 4


@dataclass(frozen=True)
class Prediction:
    """Figures that `tune` predicts, at the main shaft."""

    kind: str
    cure_rpm: Interval
    least_damping: Interval
    string_modes_hz: tuple[float, ...]
    cure_open: bool = False
    """True: the critical speed has no upper end, because it is above the highest speed that `tune` tried on some draws.
    The end of ``cure_rpm`` is then its value."""

    @property
    def cure_words(self) -> str:
        """Return the interval of the critical speed, rpm, in words."""
        return f"{self.cure_rpm.low:.0f} {'or more' if self.cure_open else f'to {self.cure_rpm.high:.0f}'}"


@dataclass(frozen=True)
class RigWindow:
    """Limits of the rig at the motor: speed, torque, and the look-ahead time of its guard."""

    lowest_rad_s: float
    highest_rad_s: float
    torque_nm: float
    foresight_s: float


@dataclass(frozen=True)
class EvaluationCase:
    """String, intended machine, controller and identified rig of one evaluation. The rig's limits are not included."""

    string: DrillString
    meant: TopDrive
    """Intended machine: the machine for which the gains are made."""
    law: SpeedController
    rig: IdentifiedRig
    prediction: Prediction
    speed_lag_error_s: float = 0.0
    """Half-width of the lag's 95 % interval, s."""
    own_loop: bool = False
    """True: the drive's own speed loop runs these gains, and the string's torque enters as a torque offset."""

    @property
    def mode(self) -> Literal["speed", "torque"]:
        """Return the drive's mode in stage 5."""
        return "speed" if self.own_loop else "torque"

    @property
    def motion(self) -> str:
        """Return the motion of stage 5, for the confirmation."""
        return f"virtual drill string with stick-slip of its bit, in {self.mode} mode"

    @property
    def torque_offset(self) -> bool:
        """Return whether stage 5 writes the drive's torque offset."""
        return self.own_loop

    @property
    def scale(self) -> float:
        """Factor κ from the intended machine's torque at its main shaft to the rig's torque in the drive's own N·m."""
        return self.rig.inertia_kg_m2 * self.rig.gear_ratio / self.meant.inertia_kg_m2

    def plain(self) -> dict[str, Any]:
        """Return the mapping for the run's configuration; infinite numbers are None."""
        found = asdict(self)
        bit = found["string"]["bit"]
        if bit is not None and bit["stribeck_speed_rad_s"] == inf:
            bit["stribeck_speed_rad_s"] = None
        return found


def check_virtual_string(case: EvaluationCase, period_s: float) -> None:
    """Check the bit, the mud's drag, the cycle rate, the rig's inertia and the lag of the reported speed.

    Raises EvaluationRefused if one of them would make the virtual string incorrect.
    """
    rate_hz, law = 1.0 / period_s, case.law
    if case.string.bit is None:
        raise EvaluationRefused("no bit is stated, so there is no stick-slip to evaluate", where="string.yaml, bottom",
                                next_step="State the friction of the bit: coulomb_nm, static_nm, stribeck_speed_rad_s")
    if any(line.drag_nm_s_rad_m < LEAST_DRAG_NM_S_RAD_M for line in case.string.lines):
        raise EvaluationRefused(
            f"a virtual string needs a drag of {LEAST_DRAG_NM_S_RAD_M:g} N·m·s/rad per metre or more in every section, "
            "to damp the energy of the loop's own errors",
            where="string.yaml, drag_nm_s_rad_m", next_step="Leave the key out: the default of 0.005 is that of mud")
    quickest = law.gain_nm_s_rad / (case.meant.inertia_kg_m2 - law.compensated_kg_m2) * period_s
    if rate_hz < LOWEST_RATE_HZ * (1.0 - 1e-9) or quickest > MOST_CROSSOVER:
        needed = max(LOWEST_RATE_HZ, rate_hz * quickest / MOST_CROSSOVER)
        raise EvaluationRefused(
            f"{rate_hz:.3g} cycles a second are too few for these gains: the sampled loop itself would oscillate",
            where="--rate", next_step=f"This controller needs {needed:.3g} cycles a second or more")
    if case.own_loop and abs(case.rig.main_shaft_inertia_kg_m2 / case.meant.inertia_kg_m2 - 1.0) > SAME_INERTIA:
        raise EvaluationRefused(
            f"the rig has {case.rig.main_shaft_inertia_kg_m2:.4g} kg·m² at the main shaft, "
            f"and the gains are for {case.meant.inertia_kg_m2:.4g}",
            where="--own-loop", next_step="Tune for this rig, or leave --own-loop out: tdhil then scales the torque")
    if case.rig.speed_lag_s > MOST_LAG_S or case.speed_lag_error_s > MOST_LAG_ERROR_S:
        raise EvaluationRefused(
            f"the reported speed lags by {case.rig.speed_lag_s:.3g} ± {case.speed_lag_error_s:.2g} s; the "
            f"observer corrects at most {MOST_LAG_S:g} s, known to ±{MOST_LAG_ERROR_S:g} s",
            where="speed_lag_s of the result", next_step="Lower the drive's filter of the reported speed, or identify "
            "again with a multisine, for longer")


def program_for(case: EvaluationCase, window: RigWindow) -> SpeedProgram:
    """Return the program for this rig. Raises EvaluationRefused if it exceeds the speed window or the torque limit."""
    cure, ratio = case.prediction.cure_rpm, case.rig.gear_ratio
    ends = cure.high + max(ABOVE_RPM, ABOVE_SHARE * cure.high)
    below = [cure.low - one for one in BELOW_RPM if cure.low - one > 0.0]
    speeds = np.array([[*below, cure.high, ends]]) * RPM
    trace = simulate(case.string, [(case.meant, case.law)], Begin("stuck", speeds), speeds, 1.0, 24.0, 0.02,
                     2.0 * LONGEST_TICK_S)
    # A bit that breaks away at the end of the ramp, or in a trial, gives the largest acceleration.
    hardest = float(np.abs(np.gradient(trace.top_rad_s[:, 0, -1] * ratio, trace.time_s)).max())
    top = trace.top_rad_s[:, 0, :-1] * ratio
    rate = np.gradient(top, trace.time_s, axis=0)
    ahead = top + window.foresight_s * rate
    highest = np.maximum(top, ahead).max(axis=0)
    backwards = ahead.min(axis=0) < -0.01 * window.highest_rad_s
    bearable = [k for k in range(len(below)) if top[:, k].min() > window.lowest_rad_s and not backwards[k]]
    if not bearable:
        # the lowest speed at the best of the set speeds at which the bit shall stick; 0: at each of them the top is
        # about to turn backwards
        lowest_rad_s = max((float(top[:, k].min()) for k in range(len(below)) if not backwards[k]), default=0.0)
        if lowest_rad_s <= 0.0:
            raise EvaluationRefused(
                f"a top drive of {case.meant.inertia_kg_m2:.4g} kg·m² at the main shaft is light beside this string "
                f"and bit: with the {case.prediction.kind} controller it would be about to turn back before the bit "
                "turns",
                where="--use", next_step="Take a stiffer one; or tune for a heavier machine, with its own result, and "
                "name this rig's by --result: the string's torques are scaled to it")
        raise EvaluationRefused(
            f"the top falls to {lowest_rad_s / ratio / RPM:.1f} rpm before the bit turns; this window begins at "
            f"{window.lowest_rad_s / ratio / RPM:.1f} rpm", where="limits.speed_min_rad_s",
            next_step=f"Set it to {0.95 * lowest_rad_s:.2g} rad/s or less, or take a stiffer controller (--use)")
    room = window.highest_rad_s - float(highest[-1]) + cure.high * RPM * ratio
    if room < (cure.high + TOLERANCE_RPM) * RPM * ratio:
        raise EvaluationRefused(
            f"the top reaches {highest[-1]:.3g} rad/s at the motor when the bit begins to turn; the window ends "
            f"at {window.highest_rad_s:.3g} rad/s", where="limits.speed_max_rad_s",
            next_step="Raise it, if machine and drive allow")
    friction = case.rig.coulomb_nm + case.rig.viscous_nm_s_rad * float(highest[-1])
    peak_nm = max(hardest, float(np.abs(rate).max())) * case.rig.inertia_kg_m2 + friction
    if peak_nm > ROOM_SHARE * window.torque_nm:
        raise EvaluationRefused(
            f"the virtual string takes up to {peak_nm:.3g} N·m of the motor, and its limit is "
            f"{window.torque_nm:.3g} N·m: it would be cut off", where="limits.torque_nm",
            next_step="Raise it, if machine and drive allow, or take a softer controller (--use)")
    # Torque that moves the intended rotor, including the first second, in which the bit breaks away.
    moving_nm = case.meant.inertia_kg_m2 * float(np.abs(rate).max()) / ratio
    slow_s = min(case.law.integral_time_s, longest_integral_time_s(string_modes_hz(case.string)[0]))
    calm_s = max(SpeedProgram.calm_s, CALM_INTEGRAL_TIMES * slow_s)      # as in the prediction
    program = SpeedProgram(below[bearable[0]] * RPM, min(ends * RPM, room / ratio), peak_nm=moving_nm, calm_s=calm_s,
                           trial_s=max(SpeedProgram.trial_s, 2.0 * calm_s))
    if case.own_loop:      # the drive's own loop has to balance the string's torque itself
        program = replace(program, fade_s=OWN_LOOP_FADE_S, armed_s=OWN_LOOP_ARMED_S, settle_s=OWN_LOOP_ARMED_S)
    return program


# ---------------------------------------------------------------------------------------------------------------------
# Evaluation of the rows of a log.


class EvaluationOutcome(StrEnum):
    """Verdict of an evaluation."""

    AS_PREDICTED = "as_predicted"
    DIFFERS = "differs"
    NOT_FOUND = "not_found"
    """No critical speed was found: the bit did not stick, or never turned."""
    INVALID = "invalid"
    """The motion was not that of the string: the torque limit acted, the rig is not the identified one, or the drive's
    torque signals contradict each other."""


@dataclass(frozen=True)
class Trial:
    """Result of one trial at a steady set speed. It starts with the bit about to break away."""

    set_rpm: float
    turns: bool


@dataclass(frozen=True)
class Evaluation:
    """Result of an evaluation. Speeds and torques are those of the intended machine's main shaft."""

    outcome: EvaluationOutcome
    why: str
    critical_rpm: Interval | None
    """Lowest set speed from which a bit that is about to break away turns in the end, with its bracket (the *cure* of
    `tune`)."""
    ramp_rpm: float | None
    """Set speed of the ramp at which the bit stood still for the last time."""
    trials: tuple[Trial, ...]
    sticking_rms_nm: float | None
    """Root mean square of the drive's torque about its mean during stick-slip, N·m."""
    turning_rms_nm: float | None
    """Root mean square of the drive's torque about its mean over the last 10 s of steady rotation, N·m."""
    damping: float | None
    """Least damping ratio of the string's lowest modes, from the decay after the bit is released."""
    damping_interval: Interval | None
    """Damping ratio with its 95 % interval. Contributions: noise of the decay, choice of its window, and the unknown
    torque of the observer."""
    damped_hz: float | None
    """Frequency of the least damped mode."""
    clamped_cycles: int
    """Number of cycles in which the torque limit acted."""
    innovation_rms_rad_s: float
    unknown_rms_nm: float
    """Root mean square of the unknown torque that the observer estimates, N·m."""
    put_in_j: float
    """Largest energy that the loop's own errors put into the shaft, J."""

    @property
    def damping_compared(self) -> bool:
        """Return whether the damping is known well enough to be compared with the prediction."""
        seen = self.damping_interval
        return seen is not None and seen.high - seen.low <= OPEN_DAMPING


FOREIGN_SHARE = 0.1
"""Largest unknown torque, as a share of the torque that moves the shaft. Above it, the rig is not the identified
one."""


def evaluate(rows: Array, case: EvaluationCase, program: SpeedProgram, contradiction: str = "") -> Evaluation:
    """Return the evaluation of a run's log. Raises ValueError for a log without rows.

    ``contradiction``: description of a contradiction between the drive's torque signals. If it is not empty, the
    verdict is invalid.
    """
    if not len(rows):
        raise ValueError("the virtual string was never turned")
    column = {name: rows[:, number] for number, name in enumerate(COLUMNS)}
    phase, set_rad_s, stuck = column["phase"], column["set_rad_s"], column["bit_rad_s"] == 0.0
    period_s = float(np.median(np.diff(column["time_s"]))) if len(rows) > 1 else 1.0
    trials = _trials(rows, program, period_s)
    sticks = [one.set_rpm for one in trials if not one.turns]
    turns = [one.set_rpm for one in trials if one.turns]
    holding = phase == Phase.HOLD
    did_stick = bool(stuck[holding][len(stuck[holding]) // 2 :].any())
    lower = max([one for one in sticks if not turns or one < min(turns)], default=program.start_rad_s / RPM)
    critical = Interval(min(turns), lower, min(turns)) if turns and did_stick else None
    on_ramp = (phase == Phase.RAMP) & stuck
    ramp = float(set_rad_s[on_ramp][-1]) / RPM if on_ramp.any() else None
    steady = phase == Phase.STEADY
    decay = _decay_with_interval(rows[phase == Phase.RELEASED], case, period_s)
    coupled = column["share"] == 1.0
    net = column["drive_nm"] - column["share"] * column["string_nm"]
    unknown = float(np.sqrt(np.mean(column["unknown_nm"][coupled] ** 2))) if coupled.any() else 0.0
    clamped = int(column["clamped"].sum())
    foreign = unknown / max(1e-9, float(np.sqrt(np.mean(net[coupled] ** 2)))) if coupled.any() else 0.0
    reached = float(set_rad_s.max())
    disturbed, cure = None, case.prediction.cure_rpm
    # the bracket of the critical speed does not meet the predicted interval
    highest = inf if case.prediction.cure_open else cure.high
    if critical is not None and max(cure.low - critical.value, critical.low - highest) > TOLERANCE_RPM:
        disturbed = disturbed_trials(case.string, case.meant, case.law, program, cure, column["unknown_nm"][coupled],
                                     period_s)
    outcome, why = _verdict(case, program, clamped, (unknown, foreign), did_stick, critical, decay, reached,
                            disturbed)
    if contradiction:
        outcome, why = EvaluationOutcome.INVALID, contradiction
    return Evaluation(
        outcome, why, critical, ramp, trials, _rms(column["drive_nm"][holding]),
        _rms(column["drive_nm"][steady][-round(10.0 / period_s) :]), None if decay is None else decay[0].value,
        None if decay is None else decay[0], None if decay is None else decay[1],
        clamped, _rms(column["innovation_rad_s"]) or 0.0, unknown,
        float(column["put_in_j"].max()),
    )


def _verdict(
    case: EvaluationCase, program: SpeedProgram, clamped: int, unknown: tuple[float, float], did_stick: bool,
    critical: Interval | None, decay: tuple[Interval, float] | None, reached: float, disturbed: DisturbedTrials | None,
) -> tuple[EvaluationOutcome, str]:
    """Return the verdict with its reason.

    ``unknown``: torque that was not commanded, in N·m rms and as a share of the torque that moved the shaft.
    ``disturbed``: simulated trials under the unknown torque, for a critical speed that is not near the prediction.
    """
    damping = case.prediction.least_damping
    unknown_nm, foreign = unknown
    if clamped:
        return EvaluationOutcome.INVALID, f"the torque limit acted on the virtual string's torque in {clamped} cycles"
    if foreign > FOREIGN_SHARE:
        return EvaluationOutcome.INVALID, (
            f"{unknown_nm:.0f} N·m rms of torque that was not commanded, {100.0 * foreign:.0f} % of the "
            "torque that moved the shaft: " + ("the drive has other gains, or " if case.own_loop else "")
            + "inertia, friction or lags are not those of the result")
    if not did_stick:
        return EvaluationOutcome.NOT_FOUND, "the bit did not stick and slip at the first set speed"
    if critical is None:
        if reached < program.highest_rad_s - 0.5 * RPM:
            return (EvaluationOutcome.NOT_FOUND,
                    f"the run ended at {reached / RPM:.0f} rpm, before a bit that was stuck kept turning")
        return EvaluationOutcome.NOT_FOUND, "a stuck bit did not keep turning at any set speed, up to the highest one"
    words = f"critical speed {critical.value:.1f} rpm, predicted {case.prediction.cure_words}"
    if disturbed is not None:
        words += (f"; under the {unknown_nm:.0f} N·m rms of torque that was not commanded, the bit turns in "
                  f"{disturbed.turning_at(critical.value)} of {TRIALS} simulated trials at the first speed, and in "
                  f"{disturbed.turning_at(critical.low)} at {critical.low:.1f} rpm")
    if disturbed is not None and disturbed.distance_rpm(critical) > TOLERANCE_RPM:
        return EvaluationOutcome.DIFFERS, words
    if decay is None:
        return EvaluationOutcome.AS_PREDICTED, f"{words}; no damping was found in the decay"
    seen = decay[0]
    of_damping = f"damping {seen.value:.3f} ({seen.low:.3f} to {seen.high:.3f})"
    if seen.low > damping.high + TOLERANCE_DAMPING or seen.high < damping.low - TOLERANCE_DAMPING:
        return EvaluationOutcome.DIFFERS, (
            f"{of_damping}, predicted {damping.low:.3f} to {damping.high:.3f}; {words}")
    if seen.high - seen.low > OPEN_DAMPING:
        words += f"; {of_damping} is too uncertain to compare"
    return EvaluationOutcome.AS_PREDICTED, words


def _rms(values: Array) -> float | None:
    return float(np.std(values)) if len(values) else None


def _trials(rows: Array, program: SpeedProgram, period_s: float) -> tuple[Trial, ...]:
    at = np.flatnonzero(rows[:, COLUMNS.index("phase")] == Phase.TRIAL)
    if not len(at):
        return ()
    found = []
    for one in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
        still = np.flatnonzero(rows[one, COLUMNS.index("bit_rad_s")] == 0.0)
        calm_s = (len(one) - 1 - (int(still[-1]) if len(still) else 0)) * period_s
        whole = len(one) * period_s >= min(program.calm_s, program.trial_s) - 2.0 * period_s
        if whole:
            found.append(Trial(float(rows[one[0], COLUMNS.index("set_rad_s")]) / RPM,
                               calm_s >= program.calm_s - 3.0 * period_s))
    return tuple(found)


DECAY_EVERY_S, DECAY_ORDER = 0.1, 9
LEAST_DECAY_S = 8.0
RESAMPLES, RESAMPLING_SEED = 24, 5
"""Number of resampled decays, each made from the fitted decay and its residuals, and the seed of their random numbers.
They show how far the residuals move the result."""
NOISE_K = 3.0
"""Half-width of the interval in standard deviations of the resamples. Two are for 95 %. One more accounts for a fit of
few oscillations, which takes part of the noise into its modes (decays of known damping in noise,
tests/soft_torque/test_evaluation.py)."""
LEAST_ENERGY = 0.1
"""Least energy of a mode, as a share of the strongest of the lowest modes. A fit to noise gives modes with less."""
OPEN_DAMPING = 0.25
"""Width of the interval above which a damping is not compared with a prediction."""


def _decay_with_interval(rows: Array, case: EvaluationCase, period_s: float) -> tuple[Interval, float] | None:
    """Return (damping with its 95 % interval, frequency in Hz) of the least damped of the lowest modes, or None.

    The interval is the root of the sum of squares of three contributions. Noise: the fitted decay plus its residuals,
    shifted in time and with either sign, is fitted again. Window: the decay is fitted again without its first half
    second, its first second, or its last fifth. Unknown torque: if it is a share f of the net torque and in phase with
    the speed, it changes the damping ratio by f/2.
    """
    found = _decay(rows, case, period_s)
    if found is None:
        return None
    value, hertz, fitted, residual, poles, every_s = found
    random = np.random.default_rng(RESAMPLING_SEED)
    count = len(residual)
    freedom = max(1, count - 3 * len(poles) - 1)
    again = []
    for _ in range(RESAMPLES):
        moved = np.roll(residual, int(random.integers(count))) * random.choice((-1.0, 1.0))
        values = fitted + moved * np.sqrt(count / freedom)
        least = _least(_fitted(poles, values, every_s), values, every_s, case)
        if least is not None:
            again.append(least[0])
    noise = NOISE_K * float(np.sqrt(np.mean((np.array(again) - value) ** 2))) if again else inf
    values = fitted + residual
    cuts = [values[round(0.5 / every_s) :], values[round(1.0 / every_s) :], values[: round(0.8 * count)]]
    windows = [least[0] for cut in cuts if (least := _least(_fitted(poles, cut, every_s), cut, every_s, case))
               is not None]
    moved_by = max((abs(one - value) for one in windows), default=0.0)
    column = {name: rows[:, number] for number, name in enumerate(COLUMNS)}
    net = float(np.std(column["drive_nm"] - column["share"] * column["string_nm"]))
    unknown = float(np.sqrt(np.mean(column["unknown_nm"] ** 2))) / net if net > 0.0 else 0.0
    half = float(np.sqrt(noise**2 + moved_by**2 + (0.5 * min(1.0, unknown)) ** 2))
    return Interval(float(value), float(max(-1.0, value - half)), float(min(1.0, value + half))), hertz


def _decay(
    rows: Array, case: EvaluationCase, period_s: float
) -> tuple[float, float, Array, Array, NDArray[np.complex128], float] | None:
    """Return (damping, frequency in Hz, fitted decay, residual, poles, time step in s) of the top's speed, or None.

    ``rows`` are those after the release of the bit. The method is a matrix pencil (Hua and Sarkar 1990). The windows of
    the signal span the exponentials that it contains, here a constant and four pairs. The step from one window to the
    next gives the poles. For two poles close together, the damping scatters by 0.015, because the method does not fit
    the signal as a whole. Therefore these poles are only the start of a least-squares fit.
    """
    each = max(1, round(DECAY_EVERY_S / period_s))
    speed = rows[:, COLUMNS.index("top_rad_s")]
    count = len(speed) // each
    if count * each * period_s < LEAST_DECAY_S:
        return None
    means = speed[: count * each].reshape(count, each).mean(axis=1)
    width = count // 3
    windows = np.lib.stride_tricks.sliding_window_view(means, width + 1)
    basis = np.linalg.svd(windows, full_matrices=False)[2][:DECAY_ORDER]
    steps = np.linalg.eigvals(np.linalg.pinv(basis[:, :-1].T) @ basis[:, 1:].T).astype(np.complex128)
    every_s = each * period_s
    proposed = np.asarray(np.log(steps[np.abs(steps) > 1e-6]) / every_s, dtype=np.complex128)
    poles = _fitted(proposed, means, every_s)
    least = _least(poles, means, every_s, case)
    if least is None:
        return None
    time_s: Array = np.asarray(every_s * np.arange(count), dtype=np.float64)
    fitted = _design(poles, time_s, 5.0 / (count * every_s)) @ _sizes(poles, means, every_s)
    return float(least[0]), float(least[1]), fitted, means - fitted, poles, every_s


def _least(
    poles: NDArray[np.complex128], values: Array, every_s: float, case: EvaluationCase
) -> tuple[float, float] | None:
    """Return (damping, frequency in Hz) of the least damped pole among the lowest modes with enough energy, or None."""
    held = case.prediction.string_modes_hz
    highest = lowest_modes_below_hz(held)
    if not len(poles):
        return None
    time_s: Array = np.asarray(every_s * np.arange(len(values)), dtype=np.float64)
    design, sizes = _design(poles, time_s, 5.0 / time_s[-1]), _sizes(poles, values, every_s)
    energy = [float(np.sum((design[:, k] @ sizes[k]) ** 2))
              for k in ([1 + at, 1 + len(poles) + at] for at in range(len(poles)))]
    swinging = [
        (-float(pole.real) / abs(pole), abs(pole) / (2.0 * pi), own) for pole, own in zip(poles, energy, strict=True)
        if pole.imag > 0.0 and 0.4 * held[0] <= abs(pole) / (2.0 * pi) <= highest
    ]
    most = max((own for *_, own in swinging), default=0.0)
    return min(((damping, hertz) for damping, hertz, own in swinging if own >= LEAST_ENERGY * most), default=None)


def _design(poles: NDArray[np.complex128], time_s: Array, most_growth: float) -> Array:
    """Return the design matrix: a constant, and both phases of every exponential. The growth is limited."""
    wave = np.exp(np.multiply.outer(time_s, np.minimum(poles.real, most_growth) + 1j * poles.imag))
    found: Array = np.column_stack([np.ones_like(time_s), wave.real, wave.imag])
    return found


def _sizes(poles: NDArray[np.complex128], values: Array, every_s: float) -> Array:
    time_s: Array = np.asarray(every_s * np.arange(len(values)), dtype=np.float64)
    design = _design(poles, time_s, 5.0 / time_s[-1])
    found: Array = np.asarray(np.linalg.lstsq(design, values, rcond=None)[0], dtype=np.float64)
    return found


def _fitted(poles: NDArray[np.complex128], values: Array, every_s: float) -> NDArray[np.complex128]:
    """Return the complex pairs of poles, fitted to ``values`` by least squares.

    Amplitudes and the constant follow linearly in each step.
    """
    from scipy.optimize import least_squares

    time_s: Array = np.asarray(every_s * np.arange(len(values)), dtype=np.float64)
    most_growth = 5.0 / time_s[-1]            # limits growing exponentials, so that none overflows
    pairs = poles[poles.imag > 0.0]
    if not len(pairs):
        return pairs

    def left(parts: Array) -> Array:
        design = _design(parts[0::2] + 1j * parts[1::2], time_s, most_growth)
        error: Array = design @ np.linalg.lstsq(design, values, rcond=None)[0] - values
        return error

    start = np.column_stack([pairs.real, pairs.imag]).ravel()
    found = least_squares(left, start, x_scale=np.repeat(np.abs(pairs), 2), max_nfev=100).x
    fitted: NDArray[np.complex128] = found[0::2] + 1j * found[1::2]
    return fitted


def _tolerance(plain: Mapping[str, Any] | None) -> StringTolerance:
    """Return the tolerances that a log contains. A log without tolerances gets the default ones."""
    values: dict[str, Any] = {name: tuple(one) if isinstance(one, list) else one
                              for name, one in (plain or {}).items()}
    return StringTolerance(**values)


def case_of(plain: Mapping[str, Any]) -> EvaluationCase:
    """Return the case from the mapping that `EvaluationCase.plain` made.

    Raises KeyError or TypeError if keys are missing or unknown.
    """
    from tdhil.soft_torque.drill_string import BitFriction, WaveLine

    string, bit = plain["string"], plain["string"]["bit"]
    if bit is not None and bit["stribeck_speed_rad_s"] is None:
        bit = {**bit, "stribeck_speed_rad_s": inf}
    prediction = plain["prediction"]
    return EvaluationCase(
        DrillString(tuple(WaveLine(**line) for line in string["lines"]), string["bottom_inertia_kg_m2"],
                    string["bottom_viscous_nm_s_rad"], None if bit is None else BitFriction(**bit), string["name"],
                    _tolerance(string.get("tolerance"))),
        TopDrive(**{**plain["meant"], "inner_lags_s": tuple(plain["meant"]["inner_lags_s"])}),
        SpeedController(**plain["law"]),
        IdentifiedRig(**plain["rig"]),
        Prediction(prediction["kind"], Interval(**prediction["cure_rpm"]), Interval(**prediction["least_damping"]),
                   tuple(prediction["string_modes_hz"]), bool(prediction.get("cure_open", False))),
        plain["speed_lag_error_s"],
        bool(plain.get("own_loop", False)),
    )
