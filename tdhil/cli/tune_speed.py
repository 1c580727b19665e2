"""`tdhil tune speed`: P, I and a notch for the drive's own speed loop, from a result. Numbers only, nothing moves."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from profiles import CodedText
from profiles.quantities import FREQUENCY, INERTIA, RPM, TIME, TORQUE
from tdhil.cli.arguments import PICTURES, add_option, amount, require_target
from tdhil.cli.report_file import ReportFile, add_head_options, add_report_option
from tdhil.cli.results import print_json
from tdhil.cli.tune_inputs import (
    REPORTED_FILTER,
    bounded_estimate,
    calibration_factor,
    check_inner_lags,
    check_limits,
    check_present,
    ends_of,
    in_drive_torque,
    inertia_to_tune_for,
    inertia_warnings,
    is_number,
    measured_where,
    own_impedance,
    positive_number,
    present_gains,
    profile_for,
    read_impedance,
    read_result,
    reported_filter,
    require_result,
    speed_controller_of,
)
from tdhil.config import OPTION
from tdhil.errors import ExitCode, MessageCode, UsageError

if TYPE_CHECKING:
    from profiles import Profile
    from tdhil.report import LoopTunedFor
    from tdhil.speed_loop import LoopDesign, MeasuredShaft, Range, UncertainPlant

ASSUMED_LAGS_S = (0.020, 0.010)
"""Speed filter and torque loop of an inverter in vector control, s: typical, not measured."""
ASSUMED_DEAD_TIME_S = 0.003
"""Assumed dead time, s: one and a half control periods of 2 ms."""
STATED_TOLERANCE, ASSUMED_TOLERANCE = 0.1, 0.5
"""Relative half-width of the interval of a stated and of an assumed lag, and of a stated inertia of the motor side."""
_NO_INERTIA_OF_MOTOR = "the inertia of the motor alone is not known, and the worst case does not contain it"


class LoopLags(NamedTuple):
    """Lags inside the drive's speed loop."""

    lags_s: tuple[Range, ...]
    dead_time_s: Range
    source: str = ""
    sum_s: Range | None = None
    """Sum of all, if it is known better than each."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of tune speed."""
    parser.add_argument("result", type=Path, metavar="result.json|run.mcap",
                        help="result of tdhil identify --json, or the log of a run")
    parser.add_argument("--bandwidth", type=amount(FREQUENCY), metavar="HZ",
                        help="frequency up to which the speed follows within 3 dB (default: the largest that keeps "
                        "the margins)")
    parser.add_argument("--phase-margin", type=float, default=45.0, metavar="DEG",
                        help="phase margin in the worst case of all intervals (default 45)")
    parser.add_argument("--gain-margin", type=float, default=8.0, metavar="DB",
                        help="gain margin in the worst case of all intervals (default 8)")
    parser.add_argument("--impedance", type=Path, metavar="z.json|z.mcap",
                        help="result of identify --impedance: the lags of the drive's speed loop and its present gains "
                        "(default: the measured impedance that the result itself contains)")
    parser.add_argument("--motor-inertia", type=amount(INERTIA), metavar="J",
                        help="inertia of the motor side, kg·m² at the motor shaft, known to ±10 %%: the motor turns "
                        "alone while a backlash is open (default: from the result, if that determines it)")
    parser.add_argument("--inner-lags", type=amount(TIME), nargs="+", metavar="S",
                        help="time constants inside the drive's speed loop, the speed filter first (default 0.02 "
                        "0.01, assumed)")
    parser.add_argument("--dead-time", type=amount(TIME), metavar="S",
                        help="dead time of sampling and computing (default 0.003, assumed)")
    parser.add_argument("--present", type=float, nargs=2, metavar=("P", "I"),
                        help="gains in the drive now, N·m·s/rad and N·m/rad at the motor shaft, for comparison "
                        "(default: as measured by --impedance, or as the drive reported them before the run)")
    parser.add_argument("--no-notch", action="store_true", help="use no notch filter; not every drive has one")
    parser.add_argument("--profile", metavar="NAME",
                        help="profile of the drive, for its parameters (default: the result's)")
    parser.add_argument("--rated-torque", type=amount(TORQUE), metavar="NM",
                        help="rated torque of the motor, for gains in %%")
    parser.add_argument("--rated-speed", type=amount(RPM), metavar="RPM",
                        help="rated speed of the motor, for gains in %%")
    add_option(parser, OPTION["json"])
    parser.add_argument("--plot", type=Path, metavar="FILE",
                        help="loop, sensitivity and step response as tune.png, tune.svg or tune.pdf")
    add_report_option(parser, "tune")
    add_head_options(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Read, tune, print."""
    from tdhil.report import (
        PlainConsole,
        loop_document,
        loop_report,
        print_loop_tuning,
        require_extra,
        save_loop_picture,
        stderr_console,
        working,
    )
    from tdhil.speed_loop import SpeedLoopCase, design_speed_loop

    _check(namespace)
    report = ReportFile.of_files(namespace, namespace.result)
    if namespace.plot is not None:
        require_extra("--plot")
        require_target("--plot", namespace.plot, [namespace.result], "the result")
    with working("reading the result …"):        # a log is identified again, which takes seconds
        result = in_drive_torque(read_result(namespace.result))
        measured = (own_impedance(result, namespace.result) if namespace.impedance is None
                    else read_impedance(namespace.impedance, result))
    if measured is not None and namespace.dead_time is not None and not namespace.inner_lags:
        raise UsageError("the measured impedance in the result states all lags, dead time included",
                         where="--dead-time", next_step="State --inner-lags too, or leave --dead-time out",
                         entry=MessageCode.VALUE_NOT_ALLOWED)
    lags = lags_in(namespace.inner_lags, namespace.dead_time, None if namespace.inner_lags else measured,
                   reported_filter(result), measured_where(namespace))
    plant, gap_from = with_open_gap(plant_of(result, lags, namespace.result), result, namespace.motor_inertia)
    present, present_from = present_gains(namespace, measured, result)
    case = SpeedLoopCase(plant, namespace.phase_margin, namespace.gain_margin, namespace.bandwidth, present,
                         not namespace.no_notch)
    design = design_speed_loop(case)
    tuned_for = _tuned_for(result, namespace, design, profile_for(namespace, result))
    tuned_for = replace(tuned_for, lags_from=lags.source, present_from=present_from, gap_from=gap_from)
    document = loop_document(design, shaft_in(result), tuned_for)
    if namespace.json:
        print_json(document)
    else:
        print_loop_tuning(document, PlainConsole())
    if namespace.plot is not None:
        save_loop_picture(document, namespace.plot)
        stderr_console().print(f"plot: {namespace.plot}", markup=False, soft_wrap=True)
    if report is not None:
        report.write(loop_report(document), (result,))
    return int(ExitCode.OK)


def _check(namespace: argparse.Namespace) -> None:
    """Check the options and that the files exist. Raises UsageError."""
    check_limits(namespace, (
        ("bandwidth", 1e-4, 1e4, "from 0.0001 to 10000 Hz"),
        ("phase_margin", 20.0, 80.0, "from 20 to 80 degrees"),
        ("gain_margin", 3.0, 40.0, "from 3 to 40 dB"),
        ("dead_time", 0.0, 1.0, "a time from 0 to 1 s"),
    ))
    check_present(namespace)
    if namespace.impedance is not None and (namespace.present or namespace.inner_lags or namespace.dead_time):
        raise UsageError("states lags and present gains, and another option states them too", where="--impedance",
                         next_step="Leave out --present, --inner-lags and --dead-time, or --impedance",
                         entry=MessageCode.VALUE_NOT_ALLOWED)
    check_inner_lags(namespace)
    if namespace.plot is not None and namespace.plot.suffix.lower() not in PICTURES:
        raise UsageError(f"ends in none of {', '.join(PICTURES)}", where=f"--plot {namespace.plot}",
                         next_step="Such as --plot tune.png", entry=MessageCode.VALUE_NOT_ALLOWED)
    require_result(namespace.result)
    if namespace.impedance is not None:
        require_result(namespace.impedance)


def lags_in(
    stated: Sequence[float] | None, dead_time_s: float | None, measured: Mapping[str, Any] | None,
    reported: tuple[float, bool] | None = None, measured_from: str = "",
) -> LoopLags:
    """Return the lags of the drive's speed loop and their source. Raises UsageError if all are 0.

    ``reported``: filter of the loop as the drive reports it (`reported_filter`); it replaces an assumed one.
    ``measured_from``: source of ``measured``.
    """
    from tdhil.speed_loop import Range

    if measured is not None:
        # --impedance measures the sum better than its parts, and models all of it as first-order lags: a part of it may
        # be dead time
        together = _range_or_none(measured.get("inner_lag_s"))
        dead = Range(0.0, 0.0, 0.0 if together is None else ASSUMED_DEAD_TIME_S * (1.0 + ASSUMED_TOLERANCE))
        found = LoopLags(tuple(_range(ends_of(measured[key])) for key in ("speed_filter_s", "torque_lag_s")), dead,
                         measured_from, together)
    else:
        lags = tuple(_open_by(lag, STATED_TOLERANCE) for lag in stated or ()) or tuple(
            _open_by(lag, ASSUMED_TOLERANCE) for lag in ASSUMED_LAGS_S)
        dead = (_open_by(ASSUMED_DEAD_TIME_S, ASSUMED_TOLERANCE) if dead_time_s is None
                else _open_by(dead_time_s, STATED_TOLERANCE))
        said = "assumed, not measured" if not stated else (
            "as stated" if dead_time_s is not None else "as stated; the dead time is assumed")
        if reported is not None and not stated:
            filter_s, verified = reported
            lags = (_open_by(filter_s, STATED_TOLERANCE if verified else ASSUMED_TOLERANCE), *lags[1:])
            said = REPORTED_FILTER
        found = LoopLags(lags, dead, said)
    if not any(lag.value for lag in found.lags_s) and not dead.value:
        raise UsageError("there is no lag in the drive's loop, so nothing limits its gains", where="--inner-lags",
                         next_step="State the filter of its speed, its torque loop and its sampling",
                         entry=MessageCode.LAGS_MISSING)
    return found


def plant_of(result: Mapping[str, Any], lags: LoopLags, path: Path) -> UncertainPlant:
    """Return the loop as known from the result, at the motor shaft. Raises LoopTuningRefused without J of
    the motor alone.
    """
    from tdhil.speed_loop import LoopTuningRefused, Range, UncertainPlant

    positive_number(result, "gear_ratio", path)
    low, value, high = inertia_to_tune_for(result, path, LoopTuningRefused)
    damping = _range_or_none(result.get("viscous_nm_s_rad")) or Range(0.0, 0.0, 0.0)
    shaft = result.get("compliant")
    if not isinstance(shaft, dict):
        return UncertainPlant(Range(value, low, high), damping, lags.lags_s, lags.dead_time_s, lag_sum_s=lags.sum_s)
    swings = [bounded_estimate(shaft.get(key)) for key in ("antiresonance_hz", "resonance_hz")]
    if swings[0] is None or swings[1] is None:
        raise LoopTuningRefused("the shaft is compliant, but its antiresonance or resonance is open", where=str(path),
                                next_step="Identify again with excited frequencies on both sides of the resonance",
                                entry=MessageCode.NO_INERTIA_TO_TUNE)
    return UncertainPlant(
        Range(value, low, high), damping, lags.lags_s, lags.dead_time_s, _range(swings[0]), _range(swings[1]),
        _range_or_none(shaft.get("damping_nm_s_rad")) or Range(0.0, 0.0, 0.0), lag_sum_s=lags.sum_s)


def with_open_gap(
    plant: UncertainPlant, result: Mapping[str, Any], motor_kg_m2: float | None
) -> tuple[UncertainPlant, str | None]:
    """Return the plant with the motor side that turns alone while a backlash is open, and the source of its inertia.

    The source is None without backlash. Without an inertia, it states that. Raises UsageError if it exceeds J.
    """
    from tdhil.speed_loop import Range

    total = plant.inertia_kg_m2
    if motor_kg_m2 is not None:
        found = _open_by(motor_kg_m2 / calibration_factor(result), STATED_TOLERANCE)
        if not 0.0 < found.value <= total.high:
            raise UsageError(f"{motor_kg_m2:g}: must be above 0 and at most J of {total.high:.4g} kg·m²",
                             where="--motor-inertia", entry=MessageCode.VALUE_NOT_ALLOWED)
        return replace(plant, gap_kg_m2=found), "as stated (--motor-inertia)"
    plays = result.get("backlash")
    if not plays:
        return plant, None
    if plant.resonance_hz is not None:
        return replace(plant, gap_kg_m2=total), "J of the motor side"
    # the motor sees J_L/J of the play
    seen = [tuple(bounded_estimate(one.get(key)) for key in ("at_motor_rad", "play_rad")) for one in plays]
    shares = [(part[1] / whole[1], part[2] / whole[0]) for part, whole in seen if part and whole]
    value, high = (max((one[k] for one in shares), default=1.0) for k in range(2))
    if len(shares) < len(plays) or high >= 1.0:
        return plant, _NO_INERTIA_OF_MOTOR
    gap = Range(total.value * (1.0 - value), total.low * (1.0 - high), total.high)
    return replace(plant, gap_kg_m2=gap), "from the play and the part of it that the motor shows"


def _open_by(value: float, tolerance: float) -> Range:
    from tdhil.speed_loop import Range

    return Range(value, value * (1.0 - tolerance), value * (1.0 + tolerance))


def _has_value(part: Any) -> bool:
    return isinstance(part, dict) and is_number(part.get("value"))


def _range_or_none(part: Any) -> Range | None:
    """Return an estimate with its ends, each at least 0; None if the result does not have it."""
    return _range(ends_of(part)) if isinstance(part, dict) and _has_value(part) else None


def _range(ends: tuple[float, float, float]) -> Range:
    from tdhil.speed_loop import Range

    low, value, high = ends
    return Range(value, low, high)


def shaft_in(result: Mapping[str, Any]) -> MeasuredShaft | None:
    """Return the measured response of the shaft itself; None if the result has no response or no lags."""
    from tdhil.speed_loop import measured_shaft

    response = result.get("frequency_response")
    if not isinstance(response, dict) or not all(_has_value(result.get(key)) for key in
                                                 ("speed_lag_s", "torque_lag_s")):
        return None
    hertz, reported, halves = [], [], []
    for line in response["lines"]:
        size, phase = line["magnitude"], float(line["phase_rad"]["value"])
        hertz.append(float(line["hertz"]))
        reported.append(float(size["value"]) * complex(math.cos(phase), math.sin(phase)))
        halves.append(math.inf if size["high"] is None else float(size["value"]) / float(size["low"]) - 1.0)
    skew = result.get("skew_s")
    return measured_shaft(hertz, reported, halves, float(result["speed_lag_s"]["value"]),
                          float(result["torque_lag_s"]["value"]),
                          float(skew["value"]) if isinstance(skew, dict) and _has_value(skew) else 0.0)


def _tuned_for(
    result: Mapping[str, Any], namespace: argparse.Namespace, design: LoopDesign, profile: Profile | None
) -> LoopTunedFor:
    from tdhil.estimation import unexplained_distortion
    from tdhil.report import LoopTunedFor
    from tdhil.soft_torque import SpeedController, drive_settings, notch_settings

    settings = {}
    warnings = inertia_warnings(result)
    if (factor := calibration_factor(result)) != 1.0:
        warnings.append(f"The result has a torque calibration (factor {factor:.4g}), which the drive does not know. J, "
                        "friction, P and I are therefore in the drive's own N·m: true values divided by this factor.")
    parameters = speed_controller_of(profile, result)
    if profile is not None and parameters is not None:
        for row in design.rows:
            law = SpeedController(row.gains.gain_nm_s_rad, row.gains.integral_nm_rad)
            settings[row.kind] = drive_settings(parameters, law, namespace.rated_torque, namespace.rated_speed)
            if row.gains.notch is not None:
                settings[row.kind] += notch_settings(parameters.notch, row.gains.notch.quantities())
        if parameters.note:
            warnings.append(f"{profile.name}: {parameters.note}")
    distortion = (result.get("frequency_response") or {}).get("distortion") or {}
    if unexplained_distortion(bool(distortion.get("detected")), result.get("warning_codes") or ()):
        warnings.append(CodedText(
            "The frequency response shows nonlinear distortion that the result does not explain. The margins are those "
            "of a linear shaft. Look for the cause with tdhil frf, and start with half of P.",
            MessageCode.LOOP_DISTORTED))
    return LoopTunedFor(str(namespace.result), bool(result.get("simulated")), str(result.get("model")),
                        None if profile is None else profile.name, float(result["gear_ratio"]), settings=settings,
                        notch_named=parameters is not None and bool(parameters.notch), warnings=tuple(warnings),
                        reported_speed_lag_s=_range_or_none(result.get("speed_lag_s")),
                        coulomb_nm=_range_or_none(result.get("coulomb_nm")),
                        rehearsed_faults=tuple(result.get("rehearsed_faults") or ()))
