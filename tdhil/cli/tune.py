"""`tdhil tune`: from a result's J to a speed controller that damps the drill string; numbers only, nothing moves."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from math import sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles import load_profile
from profiles.quantities import RPM, TIME, TORQUE
from tdhil.cli.arguments import add_option, amount, share
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from profiles import Profile
    from tdhil.report import TunedFor
    from tdhil.soft_torque import DrillString, DriveSetting, Moved, SpeedController, TuneCase, Tuning

    Ends = tuple[Moved, Moved]

IDENTIFIED = ("inertia_kg_m2", "viscous_nm_s_rad", "coulomb_nm", "speed_lag_s", "torque_lag_s", "gear_ratio")
"""Of the result, that `tdhil evaluate` needs to know of the rig."""
ASSUMED_LAGS_S = (0.020, 0.010, 0.003)
"""Speed filter, torque loop and sampling of an inverter in vector control: of that order, not measured."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of tune."""
    parser.add_argument("result", type=Path, metavar="result.json|run.mcap",
                        help="what tdhil identify --json wrote, or the log of a run")
    parser.add_argument("--string", type=Path, metavar="string.yaml",
                        help="drill string, bottom and bit (docs/soft_torque.md); without it, k and J_L as the result "
                        "has them, of a shaft that was identified as compliant")
    parser.add_argument("--impedance", type=Path, metavar="z.json|z.mcap",
                        help="what identify --impedance measured: the drive's present gains beside the others, and its "
                        "inner lags")
    parser.add_argument("--loop", choices=("drive", "bus"), default="drive",
                        help="where the speed loop runs: in the drive (default), or in a host over the bus")
    parser.add_argument("--inner-lags", type=amount(TIME), nargs="+", metavar="S",
                        help="time constants inside the drive's speed loop (default 0.02 0.01 0.003, assumed)")
    parser.add_argument("--phase-margin", type=float, default=60.0, metavar="DEG", help="of the stiff controller (60)")
    parser.add_argument("--a", type=float, metavar="A", help="softness, P = ζ/a (default: the one that damps most)")
    parser.add_argument("--compensate", type=share, metavar="SHARE",
                        help="of J that the controller gives back (default: what damps most, with a reserve)")
    parser.add_argument("--profile", metavar="NAME", help="of the drive, for its parameters (default: the result's)")
    parser.add_argument("--rated-torque", type=amount(TORQUE), metavar="NM", help="of the motor, for gains in %%")
    parser.add_argument("--rated-speed", type=amount(RPM), metavar="RPM", help="of the motor, for gains in %%")
    parser.add_argument("--no-simulation", action="store_true", help="without critical speeds, which take a minute")
    add_option(parser, OPTION["json"])
    parser.add_argument("--report", type=Path, metavar="FILE", help="with pictures: tune.html, or tune.pdf")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Read, tune, print."""
    from tdhil.report import (
        PlainConsole,
        check_report_path,
        print_tuning,
        showcase_of,
        stderr_console,
        tuning_document,
        write_tuning_report,
    )
    from tdhil.soft_torque import Search, tune

    _check(namespace)
    if namespace.report is not None:
        check_report_path(namespace.report, namespace.result)
    result = read_result(namespace.result)
    case, lags_from = case_of(result, namespace)
    name = namespace.profile or (result.get("profile") or {}).get("name")
    profile = load_profile(str(name)) if name is not None else None
    told = stderr_console()

    def tell(text: str) -> None:
        told.print(f"tune: {text} …", style="dim", markup=False)

    tuning = tune(case, None if namespace.no_simulation else Search(), tell)
    tuned_for = _tuned_for(result, namespace, tuning, lags_from, profile)
    document = tuning_document(tuning, tuned_for)
    if namespace.json:
        print_json(document)
    else:
        print_tuning(document, PlainConsole())
    if namespace.report is not None:
        written = write_tuning_report(document, showcase_of(tuning), namespace.report)
        told.print(f"report: {written}", markup=False, soft_wrap=True)
    return int(ExitCode.OK)


def _check(namespace: argparse.Namespace) -> None:
    for name, low, high, wanted in (
        ("phase_margin", 20.0, 85.0, "from 20 to 85 degrees"),
        ("a", 0.01, 10.0, "from 0.01 to 10"),
        ("compensate", 0.0, 1.0, "a share from 0 to 1"),
        ("rated_torque", 1e-6, 1e9, "a positive number of N·m"),
        ("rated_speed", 1e-3, 1e6, "a positive number of rpm"),
    ):
        value = getattr(namespace, name)
        if value is not None and not low <= value <= high:
            raise UsageError(f"{value:g}: must be {wanted}", where=f"--{name.replace('_', '-')}")
    for lag in namespace.inner_lags or ():
        if not 0.0 <= lag <= 5.0:
            raise UsageError(f"{lag:g}: must be a time from 0 to 5 s", where="--inner-lags")


def read_result(path: Path) -> Mapping[str, Any]:
    """The result's document: as --json wrote it, or identified again from the log."""
    from tdhil.session import is_log

    if not path.is_file():
        raise UsageError("there is no such file", where=str(path),
                         next_step="Name a result.json of tdhil identify --json, or a run.mcap")
    if is_log(path):
        from tdhil.api import identify, read

        return identify(read(path)).document
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"is neither a log nor JSON ({str(error)[:80]})", where=str(path),
                         next_step="Name a result.json of tdhil identify --json, or a run.mcap") from None
    if not isinstance(document, dict) or not {"inertia_kg_m2", "gear_ratio", "verdict"} <= document.keys():
        raise UsageError("is JSON, but no result of tdhil identify", where=str(path),
                         next_step="tdhil identify … --json > result.json")
    return document


def case_of(result: Mapping[str, Any], namespace: argparse.Namespace) -> tuple[TuneCase, str]:
    """All at the main shaft, and where the lags come from. Raises TuningRefused where the result has no J."""
    from tdhil.soft_torque import Interval, TopDrive, TuneCase, TuningRefused

    measured = None if namespace.impedance is None else _impedance(namespace.impedance, result)
    inertia = result["inertia_kg_m2"]
    stands = result["verdict"] in ("valid", "valid_wide") and isinstance(inertia, dict)
    if not stands or not all(_is_number(inertia.get(key)) for key in ("value", "low_total", "high_total")):
        raise TuningRefused(
            f"the result has no J to tune for ({result['verdict']})", where=str(namespace.result),
            next_step="Identify again with a motion that tells it" if not result.get("impedance") else
            "It is of a run that measured the drive's own impedance: name the result of one that tells J, and this "
            f"one as --impedance {namespace.result}")
    square = _positive(result, "gear_ratio", namespace) ** 2
    low, value, high = (square * float(inertia[key]) for key in ("low_total", "value", "high_total"))
    if not 0.0 < low <= value <= high:
        raise TuningRefused("J's interval reaches down to nothing", where=str(namespace.result),
                            next_step="Identify again, for longer")
    string, of_string = _string(result, namespace, square**0.5)
    lags, of_lags, lags_from = _lags(result, namespace, measured)
    drive = TopDrive(value, square * _estimate(result, "viscous_nm_s_rad"),
                     square**0.5 * _estimate(result, "coulomb_nm"), lags)
    present, of_present = (None, ()) if measured is None else _present(measured, square)
    case = TuneCase(string, drive, Interval(value, low, high), namespace.phase_margin, namespace.a,
                    namespace.compensate, present, (*of_string, *of_lags, *of_present))
    return case, lags_from


def _string(
    result: Mapping[str, Any], namespace: argparse.Namespace, ratio: float
) -> tuple[DrillString, tuple[Ends, ...]]:
    """As its file has it; or a spring with a mass, as identified, and both ends of what is open of that."""
    from tdhil.soft_torque import Moved, load_string, spring_and_mass

    if namespace.string is not None:
        return load_string(namespace.string), ()
    shaft = result.get("compliant") or {}
    spring, swing = (_three(shaft.get(key)) for key in ("stiffness_nm_rad", "antiresonance_hz"))
    if spring is None or swing is None:
        why = ("leaves the spring's stiffness or its swing open" if shaft else "is of a rigid shaft")
        raise UsageError(f"--string is missing, and the result {why}", where=str(namespace.result),
                         next_step="--string string.yaml (docs/soft_torque.md) names the pipe and what hangs on it")
    loss = _three(shaft.get("damping_nm_s_rad")) or (0.0, 0.0, 0.0)
    values = [(one[0], one[1], one[2]) for one in (spring, swing, loss)]

    def string(*ends: int) -> DrillString:
        k, hertz, damping = (values[at][end] for at, end in enumerate(ends))
        return spring_and_mass(ratio**2 * k, hertz, ratio**2 * damping,
                               f"k and J_L as identified ({result.get('model')})")

    moved = ((0, 1, 1), (2, 1, 1)), ((1, 0, 1), (1, 2, 1)), ((1, 1, 0), (1, 1, 2))
    return string(1, 1, 1), tuple((Moved(string=string(*low)), Moved(string=string(*high))) for low, high in moved)


def _three(part: Any) -> tuple[float, float, float] | None:
    """(low, value, high) of an estimate that is bounded and positive."""
    if not isinstance(part, dict) or not all(_is_number(part.get(key)) for key in ("low", "value", "high")):
        return None
    low, value, high = (float(part[key]) for key in ("low", "value", "high"))
    return (low, value, high) if 0.0 < low <= value <= high else None


def _impedance(path: Path, result: Mapping[str, Any]) -> Mapping[str, Any]:
    """The section `impedance` of a result, valid and of the same shaft. Raises UsageError, and TuningRefused."""
    from tdhil.soft_torque import TuningRefused

    document = read_result(path)
    found = document.get("impedance")
    if not isinstance(found, dict):
        raise UsageError("the drive's own impedance wasn't measured there", where=f"--impedance {path}",
                         next_step="tdhil identify --impedance offset … --json > z.json")
    if found.get("verdict") != "valid":
        raise TuningRefused(f"the drive's own impedance is {found.get('verdict')}: {found.get('reason')}",
                            where=f"--impedance {path}", next_step=str(found.get("advice", "")))
    if document["gear_ratio"] != result["gear_ratio"]:
        raise UsageError(f"was measured with a gear ratio of {document['gear_ratio']:g}, and J with "
                         f"{result['gear_ratio']:g}", where=f"--impedance {path}")
    for key in ("gain_nm_s_rad", "integral_nm_rad", "torque_lag_s", "speed_filter_s"):
        if not isinstance(found.get(key), dict) or not _is_number(found[key].get("value")):
            raise UsageError(f"{key} is no number", where=f"--impedance {path}")
    return found


def _present(measured: Mapping[str, Any], square: float) -> tuple[SpeedController, tuple[Ends, ...]]:
    """What stands in the drive, and both ends of each gain."""
    from tdhil.soft_torque import Moved, SpeedController

    gain, integral = ((_ends(measured[key], square)) for key in ("gain_nm_s_rad", "integral_nm_rad"))
    law = SpeedController(gain[1], integral[1])
    return law, (
        (Moved(present=SpeedController(gain[0], integral[1])), Moved(present=SpeedController(gain[2], integral[1]))),
        (Moved(present=SpeedController(gain[1], integral[0])), Moved(present=SpeedController(gain[1], integral[2]))),
    )


def _ends(part: Mapping[str, Any], times: float = 1.0) -> tuple[float, float, float]:
    """(low, value, high), none below 0; an end that isn't there is the value."""
    value = max(0.0, float(part["value"]))
    low, high = (float(part[key]) if _is_number(part.get(key)) else value for key in ("low", "high"))
    return times * max(0.0, min(low, value)), times * value, times * max(high, value)


def _lags(
    result: Mapping[str, Any], namespace: argparse.Namespace, measured: Mapping[str, Any] | None
) -> tuple[tuple[float, ...], tuple[Ends, ...], str]:
    """Time constants in the loop, both ends of what is open of them, and who says so."""
    inner = list(namespace.inner_lags or ASSUMED_LAGS_S)
    axes: list[list[float]] = []
    said = "as stated" if namespace.inner_lags else "assumed: nobody measured them"
    if measured is not None and not namespace.inner_lags:
        inner, axes = _measured_lags(measured)
        said = "as measured (--impedance)"
    if namespace.loop == "drive":
        if not any(inner):
            raise UsageError("no lag at all in the drive's loop: then nothing limits its gains", where="--inner-lags",
                             next_step="State the filter of its speed, its torque loop and its sampling")
        return _moved_lags(inner, axes, said)
    reported = result.get("speed_lag_s")
    if not isinstance(reported, dict) or not _is_number(reported.get("value")):
        raise UsageError("the result doesn't say how late the reported speed is", where="--loop bus",
                         next_step="Identify with a multisine, which tells it")
    period: Any = (result.get("cycle") or {}).get("period_s")
    waiting = 1.5 * float(period) if _is_number(period) else 0.0
    low, late, high = _ends(reported)
    # of a measured loop, the speed that the drive itself sees is no part of it
    rest = [sqrt(sum(axis[k] ** 2 for axis in axes)) for k in range(1, len(inner))] if axes else []
    others = [[0.0, 0.0, *(half if k == at else 0.0 for k in range(len(rest)))] for at, half in enumerate(rest)]
    return _moved_lags(
        [late, waiting, *inner[1:]], [[0.5 * (high - low), 0.0, *(0.0 for _ in inner[1:])], *others],
        f"the reported speed's lag as identified and a cycle and a half; the rest {said}")


def _measured_lags(measured: Mapping[str, Any]) -> tuple[list[float], list[list[float]]]:
    """Of the speed, of the torque; and the main axes of what is open of them, as far as 95 % goes along each.

    Their sum is known better than either: from its half-width follows how both hang together.
    """
    import numpy as np

    keys = ("speed_filter_s", "torque_lag_s")
    values = [_ends(measured[key])[1] for key in keys]
    halves = [_ends(measured[key])[2] - value for key, value in zip(keys, values, strict=True)]
    both = halves[0] * halves[1]
    together = 0.0
    if isinstance(measured.get("inner_lag_s"), dict):
        _, value, high = _ends(measured["inner_lag_s"])
        together = min(both, max(-both, 0.5 * ((high - value) ** 2 - halves[0] ** 2 - halves[1] ** 2)))
    sizes, axes = np.linalg.eigh(np.array([[halves[0] ** 2, together], [together, halves[1] ** 2]]))
    return values, [(sqrt(max(0.0, size)) * axis).tolist() for size, axis in zip(sizes, axes.T, strict=True)]


def _moved_lags(
    lags: list[float], axes: list[list[float]], said: str
) -> tuple[tuple[float, ...], tuple[Ends, ...], str]:
    from tdhil.soft_torque import Moved

    def at(axis: list[float], sign: float) -> tuple[float, ...]:
        moved = (lag + sign * one for lag, one in zip(lags, axis, strict=True))
        return tuple(lag for lag in moved if lag > 0.0)

    ends = tuple((Moved(inner_lags_s=at(axis, -1.0)), Moved(inner_lags_s=at(axis, 1.0))) for axis in axes if any(axis))
    return at([0.0] * len(lags), 1.0), ends, said


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _positive(result: Mapping[str, Any], key: str, namespace: argparse.Namespace) -> float:
    value = result[key]
    if not _is_number(value) or value <= 0.0:
        raise UsageError(f"{key} is no positive number", where=str(namespace.result))
    return float(value)


def _estimate(result: Mapping[str, Any], key: str) -> float:
    """0 where the result doesn't have it, or has it negative."""
    part = result.get(key)
    value = part.get("value") if isinstance(part, dict) else None
    return max(0.0, float(value)) if isinstance(value, int | float) else 0.0


def _tuned_for(
    result: Mapping[str, Any], namespace: argparse.Namespace, tuning: Tuning, lags_from: str, profile: Profile | None
) -> TunedFor:
    from tdhil.report import TunedFor
    from tdhil.soft_torque import drive_settings

    settings: dict[str, tuple[DriveSetting, ...]] = {}
    warnings = []
    ratio = float(result["gear_ratio"])
    if profile is not None and namespace.loop == "drive":
        parameters = profile.speed_controller
        for one in tuning.tuned:
            if one.controller is not None and parameters is not None:
                at_motor = one.controller.at_shaft(ratio)
                settings[one.kind] = drive_settings(parameters, at_motor, namespace.rated_torque, namespace.rated_speed)
        if parameters is not None and parameters.note:
            warnings.append(f"{profile.name}: {parameters.note}")
        if any(one.compensated_share for one in tuning.tuned):
            warnings.append("inertia compensation needs the derivative of the measured speed in the drive; few drives "
                            "have it, and a feed-forward of the set speed's acceleration is not it")
    if not namespace.inner_lags and namespace.impedance is None:
        warnings.append("the lags inside the loop are assumed; they decide how much of J can be compensated: state "
                        "them with --inner-lags")
    if namespace.string is None:
        warnings.append("|r|, a and what swings above the lowest mode rest on a spring that is taken to weigh a tenth "
                        "of its load, and to damp by 0.01 at the least: name the pipe in a string.yaml for them, and "
                        "the bit for critical speeds")
    elif tuning.case.string.bit is None:
        warnings.append("no bit is stated in string.yaml: critical speeds need one")
    return TunedFor(str(namespace.result), bool(result.get("simulated")),
                    None if profile is None else profile.name, ratio, namespace.loop, lags_from,
                    settings, tuple(warnings), {key: result.get(key) for key in IDENTIFIED})
