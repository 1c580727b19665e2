"""`tdhil tune soft-torque`: a speed controller that damps the drill string, from a result's J. Nothing moves."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles.quantities import RPM, TIME, TORQUE
from tdhil.cli.arguments import add_option, amount, share
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
    estimated,
    inertia_to_tune_for,
    inertia_warnings,
    is_number,
    measured_lags,
    positive_number,
    present_gains,
    profile_for,
    read_bit_noise,
    read_impedance,
    read_result,
    reported_filter,
    require_result,
    speed_controller_of,
)
from tdhil.config import OPTION
from tdhil.errors import ExitCode, MessageCode, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console

    from profiles import Profile, SpeedControllerParameters
    from tdhil.report import TunedFor
    from tdhil.soft_torque import (
        DrillString,
        DriveSetting,
        Interval,
        Moved,
        RequiredMargins,
        SpeedController,
        TuneCase,
        Tuning,
    )

    Ends = tuple[Moved, Moved]

IDENTIFIED = ("inertia_kg_m2", "viscous_nm_s_rad", "coulomb_nm", "speed_lag_s", "torque_lag_s", "gear_ratio",
              "torque_calibration")
"""Keys of the result that `tdhil evaluate` needs."""
DEAD_TIME_PERIODS = 10.0
"""Reserve of dead time, in control periods."""
STATED_LAG_TOLERANCE, ASSUMED_LAG_TOLERANCE = 0.1, 0.5
"""Relative uncertainty of each lag that was not measured."""
MOST_DEPTHS = 60
"""Most depths of one schedule: each takes some seconds."""
IDENTIFIED_DRAWS, IDENTIFIED_SEED = 20, 3
MOST_IMPEDANCE_SPREAD = 0.15
"""Largest relative half-width of ζ for which an identified pipe counts as known."""
ASSUMED_LAGS_S = (0.020, 0.010, 0.003)
"""Speed filter, torque loop and sampling of an inverter in vector control, s: typical, not measured."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of tune soft-torque."""
    parser.add_argument("result", type=Path, metavar="result.json|run.mcap",
                        help="result of tdhil identify --json, or the log of a run")
    parser.add_argument("--string", type=Path, metavar="string.yaml",
                        help="drill string, bottom and bit (reference/string.md); without it, k and J_L of the result "
                             "are used, for a shaft that was identified as compliant")
    parser.add_argument("--impedance", type=Path, metavar="z.json|z.mcap",
                        help="result of identify --impedance: adds the drive's present gains for comparison, and its "
                        "inner lags")
    parser.add_argument("--bit-noise", type=Path, metavar="severity.json",
                        help="result of tdhil severity --json on a record of steady drilling: the bit's random torque, "
                             "instead of bottom.noise_nm of string.yaml")
    parser.add_argument("--loop", choices=("drive", "bus"), default="drive",
                        help="place of the speed loop: in the drive (default), or in a host over the bus")
    parser.add_argument("--inner-lags", type=amount(TIME), nargs="+", metavar="S",
                        help="time constants inside the drive's speed loop (default 0.02 0.01 0.003, assumed)")
    parser.add_argument("--present", type=float, nargs=2, metavar=("P", "I"),
                        help="gains in the drive now, N·m·s/rad and N·m/rad at the motor shaft, for comparison "
                             "(default: as measured by --impedance, or as the drive reported them before the run)")
    parser.add_argument("--phase-margin", type=float, default=60.0, metavar="DEG",
                        help="phase margin of the stiff controller (default 60)")
    parser.add_argument("--margins", nargs=3, metavar=("DEG", "DB", "S"),
                        help="phase margin, gain margin and dead-time reserve that every sampled machine and string "
                        "keeps (default 30 6 and ten control periods: 20ms for a loop in the drive)")
    parser.add_argument("--a", type=float, metavar="A",
                        help="softness, P = ζ/a (default: the one with the lowest critical speed)")
    parser.add_argument("--compensate", type=share, metavar="SHARE",
                        help="share of J to compensate (default: the one with the lowest critical speed)")
    parser.add_argument("--profile", metavar="NAME",
                        help="profile of the drive, for its parameters (default: the result's)")
    parser.add_argument("--rated-torque", type=amount(TORQUE), metavar="NM",
                        help="rated torque of the motor, for gains in %%")
    parser.add_argument("--rated-speed", type=amount(RPM), metavar="RPM",
                        help="rated speed of the motor, for gains in %%")
    parser.add_argument("--depths", type=depths, metavar="FROM:TO:STEP",
                        help="gains over the depth of the well, m: the topmost section of string.yaml gets longer, "
                        "for example 500:6000:250")
    parser.add_argument("--map", action="store_true",
                        help="add the operator's map of set speed and bit torque, as --report does (needs the bit in "
                        "string.yaml)")
    parser.add_argument("--no-simulation", action="store_true",
                        help="omit the critical speeds (tdhil evaluate needs them)")
    add_option(parser, OPTION["json"])
    add_report_option(parser, "tune")
    add_head_options(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Read, tune, print."""
    from tdhil.report import (
        PlainConsole,
        map_document,
        print_tuning,
        showcase_of,
        stderr_console,
        tuning_document,
        tuning_report,
    )
    from tdhil.soft_torque import Search, operator_map, tune

    _check(namespace)
    _check_files(namespace)
    report = ReportFile.of_files(namespace, namespace.result)
    stderr = stderr_console()
    with _progress(stderr, "reading the result"):          # a log is identified again, which takes seconds
        result = read_result(namespace.result)
    case, sources = case_of(result, namespace)
    profile = profile_for(namespace, result)
    with _progress(stderr, "tuning") as progress:
        tuning = tune(case, None if namespace.no_simulation else Search(), progress)
        tuned_for = _tuned_for(result, namespace, tuning, sources, profile)
        document = tuning_document(tuning, tuned_for)
        if namespace.depths is not None:
            parameters = speed_controller_of(profile, result) if namespace.loop == "drive" else None
            document["schedule"] = _schedule(case, namespace, tuned_for.gear_ratio, parameters,
                                              calibration_factor(result), progress)
        if report is not None or namespace.map:
            progress("the operator's map: set speed and bit torque")
            found = operator_map(tuning)
            document["map"] = None if found is None else map_document(found)
    if namespace.json:
        print_json(document)
        if namespace.no_simulation:
            stderr.print("tune: tdhil evaluate does not accept this file: --no-simulation omits the critical speeds",
                       style="yellow", markup=False, soft_wrap=True)
    else:
        print_tuning(document, PlainConsole())
    if report is not None:
        report.write(tuning_report(document, showcase_of(tuning)), (result,))
    return int(ExitCode.OK)


@contextmanager
def _progress(stderr: Console, text: str) -> Iterator[Callable[[str], None]]:
    """Yield a function that prints each step, one line each; at a terminal the present step also has a moving sign."""
    def line(step: str) -> None:
        stderr.print(f"tune: {step} …", style="dim", markup=False)

    if not stderr.is_terminal:
        yield line
        return
    from rich.markup import escape

    with stderr.status(escape(f"tune: {text} …")) as status:
        def step(what: str) -> None:
            line(what)
            status.update(escape(f"tune: {what} …"))

        yield step


def _check(namespace: argparse.Namespace) -> None:
    from tdhil.soft_torque import SOFTNESS_RANGE

    check_limits(namespace, (
        ("phase_margin", 20.0, 85.0, "from 20 to 85 degrees"),
        ("a", *SOFTNESS_RANGE, "from {:g} to {:g}".format(*SOFTNESS_RANGE)),
        ("compensate", 0.0, 1.0, "a share from 0 to 1"),
    ))
    check_present(namespace)
    if namespace.present is not None and namespace.impedance is not None:
        raise UsageError("--present and --impedance both state the present gains", where="--present",
                         next_step="Leave one of them out", entry=MessageCode.VALUE_NOT_ALLOWED)
    if namespace.depths is not None and namespace.string is None:
        raise UsageError("--depths needs the string: its topmost section gets longer", where="--depths",
                         next_step="--string string.yaml", entry=MessageCode.STRING_MISSING)
    if namespace.bit_noise is not None and namespace.string is None:
        raise UsageError("--bit-noise needs the string with its bit", where="--bit-noise",
                         next_step="--string string.yaml", entry=MessageCode.STRING_MISSING)
    if namespace.map and namespace.string is None:
        raise UsageError("the map needs the bit of string.yaml", where="--map", next_step="--string string.yaml",
                         entry=MessageCode.STRING_MISSING)
    if namespace.map and namespace.no_simulation:
        raise UsageError("the map is simulated, and --no-simulation omits simulations", where="--map",
                         next_step="Leave --no-simulation out", entry=MessageCode.VALUE_NOT_ALLOWED)
    check_inner_lags(namespace)


def _check_files(namespace: argparse.Namespace) -> None:
    """Check every file of the command before any of them is used. Raises UsageError, DataFileError."""
    from tdhil.soft_torque import load_string

    require_result(namespace.result)
    if namespace.string is not None:
        string = load_string(namespace.string)
        if namespace.map and string.bit is None:
            raise UsageError("no bit is stated in string.yaml, so there is no bit torque to map", where="--map",
                             next_step="State bottom.coulomb_nm in string.yaml", entry=MessageCode.STRING_MISSING)
    if namespace.impedance is not None:
        require_result(namespace.impedance)
    if namespace.bit_noise is not None:
        read_bit_noise(namespace.bit_noise)


def depths(text: str) -> tuple[float, ...]:
    """Return the depths of FROM:TO:STEP in m, both ends included."""
    try:
        begin, end, step = (float(part) for part in text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text[:40]}: is not FROM:TO:STEP, for example 500:6000:250") from None
    if not (0.0 < begin < end <= 20_000.0 and 0.0 < step <= end - begin):
        raise argparse.ArgumentTypeError(f"{text[:40]}: FROM must be below TO, both up to 20000 m, and STEP not larger "
                                         "than their difference")
    found = [begin]
    while found[-1] + step < end - 1e-9:
        found.append(found[-1] + step)
    if len(found) + 1 > MOST_DEPTHS:
        raise argparse.ArgumentTypeError(f"{text[:40]}: has {len(found) + 1} depths; at most {MOST_DEPTHS}")
    return (*found, end)


def _schedule(
    case: TuneCase, namespace: argparse.Namespace, ratio: float, parameters: SpeedControllerParameters | None,
    factor: float, progress: Callable[[str], None],
) -> dict[str, Any]:
    """Return gains over depth: soft ones, which any drive accepts, or compensated ones with --compensate."""
    from tdhil.report import schedule_document
    from tdhil.soft_torque import at_depth, drive_settings, schedule

    try:
        at_depth(case.string, namespace.depths[0])
    except ValueError as error:
        raise UsageError(str(error), where="--depths", next_step="Begin deeper than that",
                         entry=MessageCode.VALUE_NOT_ALLOWED) from None
    found = schedule(case, namespace.depths, "compensated" if namespace.compensate else "soft",
                     simulated=not namespace.no_simulation, report=progress)

    def settings(law: SpeedController) -> Sequence[DriveSetting]:
        if parameters is None:
            return ()
        return drive_settings(parameters, _in_drive(law, factor), namespace.rated_torque, namespace.rated_speed)

    return schedule_document(found, ratio, settings)


@dataclass(frozen=True)
class InputSources:
    """Sources of the lags in the loop and of the present gains. ``present``: None if no gains are known."""

    lags: str
    present: str | None


def case_of(result: Mapping[str, Any], namespace: argparse.Namespace) -> tuple[TuneCase, InputSources]:
    """Return the case at the main shaft, and the sources of its inputs. Raises TuningRefused without J."""
    from tdhil.soft_torque import Interval, SpeedController, TopDrive, TuneCase, TuningRefused, with_noise

    measured = None if namespace.impedance is None else read_impedance(namespace.impedance, result)
    advice = {} if not result.get("impedance") else {
        "next_step": "It is from a measurement of the drive's own impedance: name a result with J, and this one with "
        f"--impedance {namespace.result}"}
    at_motor = inertia_to_tune_for(result, namespace.result, TuningRefused, **advice)
    square = positive_number(result, "gear_ratio", namespace.result) ** 2
    low, value, high = (square * one for one in at_motor)
    found = string_for(result, namespace, square**0.5)
    string = found.string
    if namespace.bit_noise is not None:
        if string.bit is None:
            raise UsageError("no bit is stated in string.yaml, so its random torque has no effect", where="--bit-noise",
                             next_step="State bottom.coulomb_nm in string.yaml", entry=MessageCode.STRING_MISSING)
        string = with_noise(string, *read_bit_noise(namespace.bit_noise))
    lags, of_lags, lags_from = _lags(result, namespace, measured)
    drive = TopDrive(value, square * estimated(result, "viscous_nm_s_rad"),
                     square**0.5 * estimated(result, "coulomb_nm"), lags)
    # the gains in the drive are in its own N·m, all else is in true N·m
    factor = calibration_factor(result)
    present, of_present = (None, ()) if measured is None else _present(measured, factor * square)
    gains, present_from = present_gains(namespace, measured, result)
    if namespace.loop == "bus" and namespace.present is None and measured is None:
        gains, present_from = None, None         # gains that the drive reports do not act on this loop
    if gains is not None and measured is None:
        present = SpeedController(factor * square * gains.gain_nm_s_rad, factor * square * gains.integral_nm_rad)
    case = TuneCase(string, drive, Interval(value, low, high), namespace.phase_margin, namespace.a,
                    namespace.compensate, present, (*found.ends, *of_lags, *of_present), found.inertia_alone_share,
                    required=_required(result, namespace), string_draws=found.draws, inertia_draws=found.inertia_draws,
                    lag_tolerance=_lag_tolerance(namespace))
    return case, InputSources(lags_from, present_from)


def _required(result: Mapping[str, Any], namespace: argparse.Namespace) -> RequiredMargins:
    """Return the requested margins, or the usual ones: ten control periods of dead time."""
    from tdhil.estimation import CONTROL_PERIOD_S
    from tdhil.soft_torque import RequiredMargins

    if namespace.margins is not None:
        try:
            degrees, decibels = (float(one) for one in namespace.margins[:2])
            seconds = amount(TIME)(namespace.margins[2])
        except (ValueError, argparse.ArgumentTypeError) as error:
            raise UsageError(str(error), where="--margins", next_step="For example --margins 30 6 20ms",
                             entry=MessageCode.VALUE_NOT_ALLOWED) from None
        if not (0.0 <= degrees <= 90.0 and 0.0 <= decibels <= 40.0 and 0.0 <= seconds <= 10.0):
            raise UsageError("must be 0 to 90 degrees, 0 to 40 dB and 0 to 10 s", where="--margins",
                             entry=MessageCode.VALUE_NOT_ALLOWED)
        return RequiredMargins(degrees, decibels, seconds)
    period: Any = (result.get("cycle") or {}).get("period_s")
    control_s = float(period) if namespace.loop == "bus" and is_number(period) else CONTROL_PERIOD_S
    return RequiredMargins(dead_time_s=DEAD_TIME_PERIODS * control_s)


@dataclass(frozen=True)
class StringOfTuning:
    """String with its uncertainty, at the main shaft.

    ``ends``: both ends of each value, or of each independent axis of the covariance of J and string. ``draws``: random
    draws; ``inertia_draws``: J of each. J has no draws and its whole half-width (``inertia_alone_share`` 1) if the
    string comes from its file, or if the result does not state the covariance.
    """

    string: DrillString
    ends: tuple[Ends, ...] = ()
    draws: tuple[DrillString, ...] = ()
    inertia_draws: tuple[float, ...] = ()
    inertia_alone_share: float = 1.0


def string_for(result: Mapping[str, Any], namespace: argparse.Namespace, ratio: float) -> StringOfTuning:
    """Return the string with its uncertainty.

    The string comes from its file. Without a file it is identified: a pipe if k, f and J_L together show one, else a
    spring with a mass.
    """
    from tdhil.soft_torque import Moved, identified_string, independent_axes, load_string, spring_and_mass

    if namespace.string is not None:
        return StringOfTuning(load_string(namespace.string))
    shaft = result.get("compliant") or {}
    spring, swing = (bounded_estimate(shaft.get(key)) for key in ("stiffness_nm_rad", "antiresonance_hz"))
    if spring is None or swing is None:
        why = ("does not determine the spring's stiffness or load" if shaft else "is of a rigid shaft")
        raise UsageError(f"--string is missing, and the result {why}", where=str(namespace.result),
                         next_step="--string string.yaml (reference/string.md) describes the pipe and its load",
                         entry=MessageCode.STRING_MISSING)
    loss = bounded_estimate(shaft.get("damping_nm_s_rad")) or (0.0, 0.0, 0.0)
    load = bounded_estimate(shaft.get("load_inertia_kg_m2")) if result.get("model") == "string" else None
    values = [spring, swing, loss, *([load] if load is not None else [])]
    name = f"k and J_L as identified ({result.get('model')})"
    joint = _joint(result, values)
    drawn, inertias = _drawn(values, joint)

    def pipe(k: float, hertz: float, damping: float, inertia: float) -> DrillString | None:
        return identified_string(ratio**2 * k, hertz, ratio**2 * inertia, ratio**2 * damping, name)

    def string(numbers: Sequence[float]) -> DrillString:
        found = pipe(*numbers) if len(numbers) == 4 else None
        return found or spring_and_mass(ratio**2 * numbers[0], numbers[1], ratio**2 * numbers[2], name)

    middle = [one[1] for one in values]
    if load is not None and not _known_pipe(drawn, pipe):
        values, middle = values[:3], middle[:3]

    def moved(at: int, end: int) -> DrillString:
        return string([*middle[:at], values[at][end], *middle[at + 1 :]])

    draws = tuple(string(one[: len(values)]) for one in drawn)
    if joint is None:
        ends = tuple((Moved(string=moved(at, 0)), Moved(string=moved(at, 2))) for at in range(len(values)))
        return StringOfTuning(string(middle), ends, draws)
    order = [*range(1, len(values) + 1), 0]                # J last: its own axis moves only J
    spread, correlation = [joint[0][at] for at in order], joint[1][order][:, order]
    *axes, of_inertia = independent_axes(spread, correlation)

    def along(end: NDArray[np.float64]) -> Moved:
        return Moved(string=string([max(1e-12, float(one)) for one in end[:-1]]),
                     inertia_kg_m2=ratio**2 * float(end[-1]))

    rest, whole = (float(one) - spread[-1].value for one in (of_inertia[1][-1], spread[-1].high))
    return StringOfTuning(string(middle), tuple((along(low), along(high)) for low, high in axes), draws,
                          tuple(ratio**2 * one for one in inertias), rest / whole if whole > 0.0 else 1.0)


def _joint(
    result: Mapping[str, Any], values: Sequence[tuple[float, float, float]]
) -> tuple[list[Interval], NDArray[np.float64]] | None:
    """Return the intervals of J, k, f, c and J_L at the motor and their correlation; None without a covariance.

    (low, value, high) of ``values`` are the 95 % intervals of k, f, c and J_L. The torque scale multiplies J, k, c and
    J_L alike.
    """
    import numpy as np

    from tdhil.soft_torque import Interval

    correlation = _correlation(result.get("compliant") or {}, len(values))
    inertia = result.get("inertia_kg_m2")
    parts = inertia if isinstance(inertia, Mapping) else {}
    total = bounded_estimate({"low": parts.get("low_total"), "value": parts.get("value"),
                              "high": parts.get("high_total")})
    if correlation is None or total is None:
        return None
    fit = np.array([bounded_estimate(inertia) or total, *values], dtype=float)
    half = 0.5 * (fit[:, 2] - fit[:, 0])
    scale_rel = sqrt(max(0.0, (0.5 * (total[2] - total[0])) ** 2 - half[0] ** 2)) / total[1]
    by_scale = scale_rel * fit[:, 1] * np.array([1.0, *_SCALED[: len(values)]])
    whole = np.maximum(np.hypot(half, by_scale), 1e-300)
    both = correlation * np.outer(half / whole, half / whole) + np.outer(by_scale / whole, by_scale / whole)
    np.fill_diagonal(both, 1.0)
    spread = [Interval(value, value - float(np.hypot(value - low, more)), value + float(np.hypot(high - value, more)))
              for (low, value, high), more in zip(fit.tolist(), by_scale.tolist(), strict=True)]
    return spread, both


def _drawn(
    values: Sequence[tuple[float, float, float]], joint: tuple[list[Interval], NDArray[np.float64]] | None
) -> tuple[list[list[float]], list[float]]:
    """Return random draws of k, f, c and J_L (as many as ``values`` has), and J of each draw, all at the motor.

    With ``joint`` all are drawn jointly. Without it each is an independent normal draw, and J has no draws.
    """
    import numpy as np

    from tdhil.soft_torque import joint_draws

    if joint is None:
        random = np.random.default_rng(IDENTIFIED_SEED)
        return [[max(1e-12, value + z / 1.96 * (high - value if z > 0.0 else value - low))
                 for (low, value, high), z in zip(values, random.standard_normal(len(values)), strict=True)]
                for _ in range(IDENTIFIED_DRAWS)], []
    spread, both = joint
    drawn = np.maximum(joint_draws(spread, both, count=IDENTIFIED_DRAWS, seed=IDENTIFIED_SEED), 1e-12)
    return drawn[:, 1:].tolist(), drawn[:, 0].tolist()


_DRAWN = ("inertia_kg_m2", "stiffness_nm_rad", "antiresonance_hz", "damping_nm_s_rad", "load_inertia_kg_m2")
"""Quantities of a draw in the covariance of a result: J, then those of the string in their order."""
_SCALED = (1.0, 0.0, 1.0, 1.0)
"""Power of the torque scale in k, f, c and J_L."""


def _correlation(shaft: Mapping[str, Any], count: int) -> NDArray[np.float64] | None:
    """Return the correlation of J and of ``count`` quantities of the string; None if the result does not state it.

    A quantity that the covariance does not have, or that has no variance, is independent.
    """
    import numpy as np

    stated = shaft.get("covariance")
    if not isinstance(stated, Mapping):
        return None
    try:
        names = [str(one) for one in stated["quantities"]]
        matrix = np.array(stated["matrix"], dtype=float)
    except (KeyError, TypeError, ValueError):
        return None
    if matrix.shape != (len(names), len(names)) or not np.all(np.isfinite(matrix)):
        return None
    found = np.eye(count + 1)
    at = [names.index(name) if name in names else -1 for name in _DRAWN[: count + 1]]
    for row, one in enumerate(at):
        for column, other in enumerate(at):
            size = matrix[one, one] * matrix[other, other]
            if row != column and min(one, other) >= 0 and size > 0.0:
                found[row, column] = np.clip(0.5 * (matrix[one, other] + matrix[other, one]) / sqrt(size), -1.0, 1.0)
    sizes, axes = np.linalg.eigh(found)      # rounding of the file must not make it indefinite
    nearest: NDArray[np.float64] = axes * np.maximum(sizes, 1e-9) @ axes.T
    return nearest


def _known_pipe(drawn: Sequence[Sequence[float]], pipe: Callable[..., DrillString | None]) -> bool:
    """Return whether every draw of k, f and J_L is a pipe, and all have about the same ζ."""
    import numpy as np

    found = [pipe(*one) for one in drawn]
    known = [one.impedance_nm_s_rad for one in found if one is not None]
    return len(known) == len(found) and 1.96 * float(np.std(known)) <= MOST_IMPEDANCE_SPREAD * float(np.mean(known))


def _in_drive(law: SpeedController, factor: float) -> SpeedController:
    """Return a controller in the drive's own N·m. ``factor``: true torque over the drive's (`calibration_factor`)."""
    return replace(law, gain_nm_s_rad=law.gain_nm_s_rad / factor, integral_nm_rad=law.integral_nm_rad / factor,
                   compensated_kg_m2=law.compensated_kg_m2 / factor)


def _present(measured: Mapping[str, Any], square: float) -> tuple[SpeedController, tuple[Ends, ...]]:
    """Return the present controller of the drive, and both ends of each gain."""
    from tdhil.soft_torque import Moved, SpeedController

    gain, integral = ((ends_of(measured[key], square)) for key in ("gain_nm_s_rad", "integral_nm_rad"))
    law = SpeedController(gain[1], integral[1])
    return law, (
        (Moved(present=SpeedController(gain[0], integral[1])), Moved(present=SpeedController(gain[2], integral[1]))),
        (Moved(present=SpeedController(gain[1], integral[0])), Moved(present=SpeedController(gain[1], integral[2]))),
    )


def _lags(
    result: Mapping[str, Any], namespace: argparse.Namespace, measured: Mapping[str, Any] | None
) -> tuple[tuple[float, ...], tuple[Ends, ...], str]:
    """Return the time constants in the loop, both ends of their intervals, and their source."""
    inner = list(namespace.inner_lags or ASSUMED_LAGS_S)
    axes: list[list[float]] = []
    said = "as stated" if namespace.inner_lags else "assumed, not measured"
    if (reported := reported_filter(result)) is not None and not namespace.inner_lags:
        inner[0], said = reported[0], REPORTED_FILTER
    if measured is not None and not namespace.inner_lags:
        inner, axes = measured_lags(measured)
        said = "as measured (--impedance)"
    if namespace.loop == "drive":
        if not any(inner):
            raise UsageError("there is no lag in the drive's loop, so nothing limits its gains", where="--inner-lags",
                             next_step="State the filter of its speed, its torque loop and its sampling",
                             entry=MessageCode.LAGS_MISSING)
        return _moved_lags(inner, axes, said)
    reported = result.get("speed_lag_s")
    if not isinstance(reported, dict) or not is_number(reported.get("value")):
        raise UsageError("the result has no lag of the reported speed", where="--loop bus",
                         next_step="Identify with a multisine, which identifies it", entry=MessageCode.LAGS_MISSING)
    period: Any = (result.get("cycle") or {}).get("period_s")
    waiting = 1.5 * float(period) if is_number(period) else 0.0
    low, late, high = ends_of(reported)
    # the drive's own speed filter, the first of the inner lags, is not part of a loop over the bus
    tolerance = _lag_tolerance(namespace)
    rest = [sqrt(sum(axis[k] ** 2 for axis in axes)) if axes else tolerance * inner[k] for k in range(1, len(inner))]
    others = [[0.0, 0.0, *(half if k == at else 0.0 for k in range(len(rest)))] for at, half in enumerate(rest)]
    return _moved_lags(
        [late, waiting, *inner[1:]], [[0.5 * (high - low), 0.0, *(0.0 for _ in inner[1:])], *others],
        f"the reported speed's lag as identified and a cycle and a half; the rest {said}")


def _lag_tolerance(namespace: argparse.Namespace) -> float:
    """Return the relative uncertainty of each lag that was not measured."""
    return STATED_LAG_TOLERANCE if namespace.inner_lags else ASSUMED_LAG_TOLERANCE


def _moved_lags(
    lags: list[float], axes: list[list[float]], said: str
) -> tuple[tuple[float, ...], tuple[Ends, ...], str]:
    from tdhil.soft_torque import Moved

    kept = [lag > 0.0 or any(axis[k] for axis in axes) for k, lag in enumerate(lags)]

    def at(axis: list[float], sign: float) -> tuple[float, ...]:
        # a lag of 0 with an interval stays: the draws move it
        moved = [max(0.0, lag + sign * one) for lag, one in zip(lags, axis, strict=True)]
        return tuple(lag for lag, stays in zip(moved, kept, strict=True) if stays)

    ends = tuple((Moved(inner_lags_s=at(axis, -1.0)), Moved(inner_lags_s=at(axis, 1.0))) for axis in axes if any(axis))
    return at([0.0] * len(lags), 1.0), ends, said


def _tuned_for(
    result: Mapping[str, Any], namespace: argparse.Namespace, tuning: Tuning, sources: InputSources,
    profile: Profile | None,
) -> TunedFor:
    from tdhil.report import TunedFor
    from tdhil.soft_torque import drive_settings

    settings: dict[str, tuple[DriveSetting, ...]] = {}
    warnings, factor = inertia_warnings(result), calibration_factor(result)
    ratio = float(result["gear_ratio"])
    if profile is not None and namespace.loop == "drive":
        parameters = speed_controller_of(profile, result)
        for one in tuning.tuned:
            if one.controller is not None and parameters is not None:
                at_motor = _in_drive(one.controller.at_shaft(ratio), factor)
                settings[one.kind] = drive_settings(parameters, at_motor, namespace.rated_torque, namespace.rated_speed)
        if parameters is not None and parameters.note:
            warnings.append(f"{profile.name}: {parameters.note}")
        if any(one.compensated_share for one in tuning.tuned):
            warnings.append("Inertia compensation needs feedback of the measured acceleration in the drive. Few drives "
                            "have it. Feed-forward of the setpoint's acceleration does not replace it.")
    if factor != 1.0:
        warnings.append(f"The result has a torque calibration (factor {factor:.4g}), which the drive does not know. P "
                        "and I in the table are in true N·m. " + (
                            "The values for the drive's parameters are divided by this factor: type in these."
                            if settings else "Divide P, I and J_c by this factor before you type them in."))
        lost = sorted({one.title for every in settings.values() for one in every if one.value is None})
        if lost:
            warnings.append(f"{', '.join(lost)}: tdhil has no value to type in. Divide P and I of the table by "
                            f"{factor:.4g}, then convert them to the parameter's unit by the drive's manual.")
    if tuning.case.present is None and sources.present is not None:
        warnings.append(f"The drive's own gains were not compared: {sources.present}. State them with --present, or "
                        "measure them with --impedance.")
    if namespace.bit_noise is not None and (bit := tuning.case.string.bit) is not None:
        warnings.append(f"The bit noise of {bit.noise_nm:.0f} N·m rms is that of the record in "
                        f"{namespace.bit_noise.name}. It is valid for the bit, formation and weight on bit there.")
    assumed = not namespace.inner_lags and namespace.impedance is None
    if assumed:
        warnings.append("The lags inside the loop are assumed. They limit the gains and how much of J can be "
                        "compensated. State them with --inner-lags.")
    if namespace.string is None and not tuning.case.inertia_draws:
        warnings.append("The result does not state the covariance of J, k, f and J_L, so tdhil draws them "
                        "independently of each other. Run tdhil replay on the log to get the covariance.")
    if namespace.string is None and not tuning.case.string.supposed:
        warnings.append(f"The string is the uniform pipe that has the identified k, f and J_L: ζ = "
                        f"{tuning.case.string.impedance_nm_s_rad:.4g} N·m·s/rad. State the bit in a string.yaml for "
                        "critical speeds.")
    elif namespace.string is None:
        warnings.append("|r|, a and the modes above the lowest one assume a spring with a tenth of the mass of its "
                        "load and a damping ratio of at least 0.01. Describe the pipe in a string.yaml for better "
                        "values, and the bit for critical speeds.")
    elif tuning.case.string.bit is None:
        warnings.append("No bit is stated in string.yaml. The critical speeds need the bit.")
    return TunedFor(str(namespace.result), bool(result.get("simulated")),
                    None if profile is None else profile.name, ratio, namespace.loop, sources.lags, sources.present,
                    settings, tuple(warnings), {key: result.get(key) for key in IDENTIFIED},
                    tuple(result.get("rehearsed_faults") or ()), assumed)
