"""Identification of any recording: ramps, steps, pulses, coasting, a trace from a drive's own tool.

1. Was there motion, and torque that caused it?  2. Which stretches does the equation hold in?  3. What do they say,
seen through smooth windows at the frequencies that stand clear of the noise?  4. Is that a number?
"""

import math
from dataclasses import replace
from typing import NoReturn

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.case import Case, Finding, ModelWords
from tdhil.estimation.data_checks import AT_LIMIT, LIMIT_SHARE
from tdhil.estimation.frequency_domain import (
    LAG_BOUND_S,
    SKEW_BOUND_S,
    GaussianPrior,
    lag_priors,
    shaft_model,
    simultaneous,
    torque_scale_line,
)
from tdhil.estimation.result import DOUBT_P, Estimate, Options, Refusal, Refused
from tdhil.estimation.samples import Samples, left_out_warnings, log_warnings
from tdhil.estimation.time_domain.equation import SKEW, SPEED_LAG, TORQUE_LAG
from tdhil.estimation.time_domain.signal_faults import refuse_faulty_signals
from tdhil.estimation.time_domain.solve import ScaleChange, Solved, solve
from tdhil.estimation.time_domain.stick_slip import refuse_stick_slip
from tdhil.estimation.time_domain.windows import OneWayStretch, joined, measure, place_windows, runs, thinned
from tdhil.recording import FloatArray, Recording

# ---------------------------------------------------------------------------------------------------------------------
# Kind of motion in a recording, in words, so that a refusal names the missing part.


_STEADY_SHARE = 0.05       # of the speed: with less excursion the speed is constant
_IDLE_SHARE = 0.02         # of the torque's span: a smaller torque counts as none
_FLAT_SHARE = 0.01        # largest share of samples on a plateau
_LIVELY = 1.5             # quanta; least median step between neighbours, from which noise is visible
_BESIDE = 20              # samples on either side of a plateau
_ALIKE = 8                # equal samples in a row that noise would not produce
_TURNS = 2                 # changes of acceleration in one ramp
_BLOCKS = 60              # blocks over which a signal is averaged

ADVICE = (
    "change the speed quickly and often, up and down, and record the torque all the time. Use steps or ramps of "
    "different steepness between several speeds, or a multisine about two mean speeds"
)


def check_signals(recording: Recording, samples: Samples) -> None:
    """Raise Refused if nothing moves, nothing drives the motion, or a limit shaped the signals."""
    speed, torque = samples.speed_rad_s, samples.torque_nm
    if np.ptp(speed) <= 2.0 * recording.speed_resolution_rad_s or np.ptp(speed) == 0.0:
        raise Refused("the speed did not change", ADVICE, entry=MessageCode.NO_EXCITATION)
    if np.ptp(torque) <= 2.0 * recording.torque_resolution_nm or np.ptp(torque) == 0.0:
        raise Refused("the torque did not change. Coasting gives only the ratio of inertia and friction",
                      "move the shaft by the drive's torque, and record this torque", entry=MessageCode.NO_EXCITATION)
    advice = "use less amplitude, or more torque if the machine allows it"
    flagged = float(np.mean(recording.limited))
    if flagged > LIMIT_SHARE:
        raise Refused(f"the drive was at an internal limit for {100 * flagged:.1f} % of the record", advice,
                      entry=MessageCode.SIGNAL_CLIPPED)
    limit = recording.torque_limit_nm
    if limit is not None and limit > 0.0:
        at_limit = float(np.mean(np.abs(torque + recording.torque_offset_nm) >= AT_LIMIT * limit))
        if at_limit > LIMIT_SHARE:
            raise Refused(f"the torque was at its limit of {limit:g} N·m for {100 * at_limit:.1f} % of the record",
                          advice, entry=MessageCode.SIGNAL_CLIPPED)
    for name, signal, quantum in (("torque", torque, recording.torque_resolution_nm),
                                  ("speed", speed, recording.speed_resolution_rad_s)):
        share = cut_off(signal, quantum)
        if share is not None:
            raise Refused(f"the {name} is cut off flat for {100 * share:.1f} % of the record", advice,
                          entry=MessageCode.SIGNAL_CLIPPED)


def refuse_open(
    samples: Samples, found: tuple[OneWayStretch, ...], beyond: str, recording: Recording
) -> NoReturn:
    """Raise Refused for an open inertia, with the motion of the recording, or the fault of a signal, and the motion
    that would determine J.

    ``beyond``: the report whose lag is longer than the bound, "" for none.
    """
    if not found:
        raise Refused("the shaft never turned one way long enough without holes in the record", ADVICE,
                      entry=MessageCode.NO_EXCITATION)
    speed = _blocks(samples.speed_rad_s)
    torque = _blocks(samples.torque_nm)
    middle = float(np.max(np.abs(speed)))
    if np.ptp(speed) <= _STEADY_SHARE * middle:
        raise Refused("the speed was constant. The torque then shows friction, not inertia",
                       ADVICE, entry=MessageCode.NO_EXCITATION)
    scatter = float(np.median(np.abs(np.diff(samples.torque_nm)))) + 1e-300
    moving = np.abs(speed) > _STEADY_SHARE * middle
    span = float(np.ptp(torque))
    if span <= 5.0 * scatter or np.mean(np.abs(torque[moving]) <= _IDLE_SHARE * span + scatter) > 0.5:
        raise Refused("the torque was zero for most of the motion. Coasting gives only the ratio of inertia and "
                      "friction",
                       f"move the shaft by the drive's torque. {ADVICE[:1].upper()}{ADVICE[1:]}",
                      entry=MessageCode.NO_EXCITATION)
    rates = np.diff(speed)
    fast = rates[np.abs(rates) > 0.25 * float(np.max(np.abs(rates)))]
    if np.count_nonzero(np.diff(np.sign(fast))) < _TURNS:
        raise Refused("one change of speed does not separate inertia, friction and the lags of the reported "
                      "signals", ADVICE, entry=MessageCode.NO_EXCITATION)
    refuse_long_lag(beyond)
    refuse_faulty_signals(samples, recording.speed_resolution_rad_s, recording.torque_resolution_nm)
    raise Refused("torque and speed do not separate the inertia from friction, noise and the lags of the "
                  "reported signals", ADVICE)


def refuse_long_lag(report: str) -> None:
    """Raise Refused if the lag of a report, "speed" or "torque", is longer than the bound; "" for none."""
    if report:
        other = "speed" if report == "torque" else "torque"
        raise Refused(
            f"the reported {report} lags the {other} by more than {LAG_BOUND_S:g} s, which is the longest lag that "
            "tdhil considers unless a lag is stated",
            f"state the filter of the reported {report} (--{report}-lag, --{report}-lag-sd), or record the {report} "
            "without a filter",
        )


def _blocks(signal: FloatArray) -> FloatArray:
    """Return means over at most `_BLOCKS` parts of equal length."""
    return np.array([float(np.mean(part)) for part in np.array_split(signal, min(_BLOCKS, len(signal)))])


def cut_off(signal: FloatArray, quantum: float) -> float | None:
    """Return the share of samples at one extreme, in longer runs than noise allows; None without such runs, or at
    standstill.

    The noise is measured beside the plateaus: a recording whose ramps climb many steps a sample may have no noise at
    steady speed, and then a plateau is a steady speed.
    """
    for extreme in (float(signal.max()), float(signal.min())):
        if abs(extreme) <= quantum:
            continue
        at = signal == extreme
        share = float(np.mean(at))
        there = np.concatenate([[False], at, [False]])
        edges = np.flatnonzero(there[1:] != there[:-1]).reshape(-1, 2)
        plateaus = edges[edges[:, 1] - edges[:, 0] >= _ALIKE]
        if not (share > _FLAT_SHARE and len(plateaus)):
            continue
        # Scatter beside the plateaus, by second differences: a ramp has none; for white noise they are √3 of the first
        # differences. Samples at the extreme are left out.
        beside = np.zeros(len(signal), dtype=np.bool_)
        for begin, end in plateaus.tolist():
            beside[max(begin - _BESIDE, 0) : end + _BESIDE] = True
        clear = beside & ~at
        whole = np.flatnonzero(clear[:-2] & clear[1:-1] & clear[2:])
        wobble = np.abs(signal[whole] - 2.0 * signal[whole + 1] + signal[whole + 2])
        if len(whole) and float(np.median(wobble)) > math.sqrt(3.0) * _LIVELY * quantum:
            return share
    return None


# ---------------------------------------------------------------------------------------------------------------------

MODEL = "rigid+lags (time domain)"
_HIDDEN_S = 2.5        # s before a stop: the reported speed may outlast the motion by so long
_LEAST_SKEW_SD_S = 1e-4   # s; least standard uncertainty of a stated time offset
_WIDE = {
    "noise": "change the speed more often or by more, or record for longer",
    "friction model": "run at more speeds, which determine the friction",
}


def recorded(case: Case) -> Case:
    """Return the case with the warnings about its recording."""
    recording = case.recording
    warnings = (*case.warnings, *log_warnings(recording), *left_out_warnings(recording))
    # pulses and coasting of this program have steady speed between them; a foreign trace need not
    return replace(case, warnings=warnings, sound=recording.excitation is not None)


def identify_record(case: Case) -> Finding:
    """Identify a rigid shaft from a recording without periodic excitation. Raises Refused if J stays open.

    Stick-slip is refused by name: friction is not constant if the shaft sticks. The intervals from such recordings miss
    the true inertia more often than stated, for any result of the residual test.
    """
    if not shaft_model(case.options.model).lags:
        raise Refused(
            "the acceleration regression assumes unfiltered signals. Without periodic excitation tdhil cannot "
            "test this",
            "identify with the rigid model, which includes reporting lags",
        )
    check_signals(case.recording, case.samples)
    refuse_stick_slip(case.samples, case.recording.speed_resolution_rad_s, case.recording.torque_resolution_nm)
    few = thinned(case.samples)
    found = _runs(few, case.recording)
    solved, conditions = _solved(case.recording, few, found, case.options)
    if solved is None or _is_open(solved.inertia):
        refuse_open(few, found, "" if solved is None else solved.beyond, case.recording)
    refuse_long_lag(solved.beyond)
    inside = sum(run.length_s for run in found) / float(few.time_s[-1] - few.time_s[0])
    used = min(case.samples_used, round(inside * case.samples_used))
    finding = finding_of(solved, case)
    return replace(finding, conditions=(*finding.conditions, *conditions), samples_used=used)


def _runs(samples: Samples, recording: Recording) -> tuple[OneWayStretch, ...]:
    """Return the stretches that turn. If a machine stops every few seconds, the wait before a stop is shorter."""
    found: tuple[OneWayStretch, ...] = ()
    for hidden in (_HIDDEN_S, 0.4 * _HIDDEN_S, 0.1 * _HIDDEN_S):
        found = runs(samples, recording.speed_resolution_rad_s, hidden)
        moving = sum(run.length_s for run in runs(samples, recording.speed_resolution_rad_s, 0.0))
        if sum(run.length_s for run in found) >= 0.5 * moving:
            break
    return found


def _solved(recording: Recording, samples: Samples, found: tuple[OneWayStretch, ...],
    options: Options) -> tuple[Solved | None, tuple[str, ...]]:
    """Solve with the stated lags. If both are stated and J stays open, take the signals as simultaneous.

    The second value is the condition of J that follows from this.
    """
    placed = place_windows(found)
    if not placed:
        return None, ()
    bins = joined([measure(window) for window in placed])
    span = float(np.ptp(samples.torque_nm))
    known = lag_priors(recording.lag_prior, SPEED_LAG, TORQUE_LAG)
    choices: list[tuple[GaussianPrior, ...]] = [known]
    if len(known) == 2:
        choices.append((*known, GaussianPrior(SKEW, 0.0, max(recording.lag_prior.skew_sd_s, _LEAST_SKEW_SD_S))))
    solved = None
    for priors in choices:
        try:
            solved = solve(bins, placed, priors, span, options.confidence)
        except (np.linalg.LinAlgError, FloatingPointError, ValueError, OverflowError):
            solved = None
        if solved is not None and not _is_open(solved.inertia):
            return solved, simultaneous(priors, SKEW)
    return solved, ()


def _is_open(inertia: Estimate) -> bool:
    """Return whether the interval is too wide to be reported."""
    return not inertia.bounded or inertia.low <= 0.0


def finding_of(solved: Solved, case: Case) -> Finding:
    """Return the finding of a solved recording. Raises Refused if it has no residual test."""
    most = max(solved.budget, key=lambda line: line.half_width_kg_m2).source if solved.budget else ""
    words = ModelWords(
        "a rigid shaft with reporting lags",
        "look for a compliant load, play, or friction that changes with speed or time; try slower motion",
        _WIDE.get(
            most, "state the filters of the drive's reported speed and torque with their uncertainty, or set them equal"
        ),
        "explains the record",
        digits=2,
    )
    if solved.residual is None:
        raise Refused("the record has too few frequencies to test the model that J comes from", ADVICE,
                      entry=MessageCode.TOO_FEW_LINES)
    bare = Finding(model=MODEL, words=words, residual=solved.residual, warnings=_caveats(solved), reject_p=DOUBT_P)
    if bare.rejected:
        return bare
    if solved.scale is not None:
        return bare.taken_back(_scale_changes(solved.scale))
    scale = torque_scale_line(solved.inertia.value, case.recording.torque_scale_rel_sd, case.options.confidence)
    return replace(
        bare,
        inertia=solved.inertia,
        conditions=_conditions(case.recording),
        viscous_nm_s_rad=solved.viscous,
        coulomb_nm=solved.coulomb,
        speed_lag_s=_unless_open(solved.speed_lag_s, LAG_BOUND_S),
        torque_lag_s=_unless_open(solved.torque_lag_s, LAG_BOUND_S),
        skew_s=_unless_open(solved.skew_s, SKEW_BOUND_S),
        budget=(*solved.budget, scale),
    )


def _scale_changes(change: ScaleChange) -> Refusal:
    """Return the contradiction. The scale may be right at any speed, or at none, so that no interval surely covers."""
    share = f"{100 * abs(change.share):.0f} %"
    if change.braking:
        return Refusal(
            f"the torque has another scale in braking than in driving, by {share}",
            "use a torque signal instead of a current, or a record that slows down by friction only",
            entry=MessageCode.MODEL_REJECTED)
    return Refusal(
        f"J differs between low and high speed, by {share} from {change.low_rad_s:.3g} to {change.high_rad_s:.3g} "
        "rad/s: the scale of the torque changes with speed",
        "use a record below base speed, or a torque signal instead of a current",
        entry=MessageCode.MODEL_REJECTED)


def _unless_open(estimate: Estimate, bound: float) -> Estimate | None:
    """Return None for a lag that the record leaves open up to the bound."""
    return None if max(abs(estimate.low), abs(estimate.high)) >= bound * (1.0 - 1e-6) else estimate


def _conditions(recording: Recording) -> tuple[str, ...]:
    conditions = []
    prior = recording.lag_prior
    if lag_priors(prior):
        conditions.append(f"reporting lags as stated{f' by {prior.source}' if prior.source else ''}")
    if prior.speed_lag_s is None or prior.torque_lag_s is None:
        conditions.append(f"reporting lags below {LAG_BOUND_S:g} s")
    return tuple(conditions)


def _caveats(solved: Solved) -> tuple[str, ...]:
    found = []
    if solved.bent:
        found.append(CodedText(
            "friction is not linear in speed. tdhil also fitted a part that grows with the square of the speed",
            MessageCode.FRICTION_NOT_LINEAR))
    if solved.shaped:
        found.append(CodedText(
            "first-order lags do not explain the reported signals. tdhil also fitted the structure of the filters",
            MessageCode.LAGS_NOT_FIRST_ORDER))
    return tuple(found)
