"""Inputs of both purposes of `tdhil tune`: a result, the drive's own impedance, and the common options."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping
from math import sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from profiles import load_profile
from tdhil.errors import MessageCode, TdhilError, UsageError
from tdhil.file_kind import PAGE, PDF, YAML, kind_of

if TYPE_CHECKING:
    from profiles import Profile, SpeedControllerParameters
    from tdhil.soft_torque import Interval
    from tdhil.speed_loop import PiGains


COVERAGE: Final = 0.95
"""Coverage of the intervals from which a tuning is made."""
_IDENTIFY_J: Final = "Identify again with a motion that identifies J"
_A_RESULT: Final = "Name a result.json of tdhil identify --json, or a run.mcap"


def require_result(path: Path) -> None:
    """Raise UsageError if the file does not exist."""
    if not path.is_file():
        raise UsageError("this file does not exist", where=str(path),
                         next_step=_A_RESULT, entry=MessageCode.FILE_NOT_FOUND)


def read_result(path: Path) -> Mapping[str, Any]:
    """Return the document of a result: read from --json, or identified again from the log. Its intervals are of 95 %.

    Raises UsageError for a file of another kind, and for a JSON document with intervals of another coverage: all
    tuning draws from intervals of 95 %.
    """
    from tdhil.report import coverage_of
    from tdhil.session import is_log

    require_result(path)
    kind = kind_of(path)
    if kind in (PAGE, PDF, YAML):
        raise UsageError(f"is {kind}, not a result of tdhil", where=str(path), next_step=_A_RESULT,
                         entry=MessageCode.WRONG_KIND_OF_FILE)
    if is_log(path):
        from tdhil.api import identify, read

        return identify(read(path), confidence=COVERAGE).document
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        what = f"is damaged JSON ({str(error)[:80]})" if kind else "is neither a log nor JSON"
        raise UsageError(what, where=str(path), next_step=_A_RESULT, entry=MessageCode.WRONG_KIND_OF_FILE) from None
    if not isinstance(document, dict) or not {"inertia_kg_m2", "gear_ratio", "verdict"} <= document.keys():
        raise UsageError("is JSON, but not a result of tdhil identify", where=str(path),
                         next_step="Write one with: tdhil identify --json > result.json",
                         entry=MessageCode.WRONG_KIND_OF_FILE)
    stated = coverage_of(document)
    if stated is not None and abs(stated - COVERAGE) > 1e-9:
        raise UsageError(f"its intervals have a coverage of {100.0 * stated:g} %, and 95 % is needed", where=str(path),
                         next_step="Name the log instead, or write it again: tdhil replay run.mcap --confidence 0.95"
                         " --json > result.json", entry=MessageCode.WRONG_KIND_OF_FILE)
    return document


def calibration_factor(result: Mapping[str, Any]) -> float:
    """Return κ of the torque calibration of a result: true torque over torque in the drive's own N·m; 1 without one."""
    found = result.get("torque_calibration")
    factor = found.get("factor") if isinstance(found, dict) else None
    return float(factor) if isinstance(factor, int | float) and is_number(factor) and factor > 0.0 else 1.0


def in_drive_torque(result: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the result with J, friction and response in the drive's own N·m, in which its speed controller works.

    The drive knows no calibration: with T = κ T_drive, the equation J ω' = T becomes (J/κ) ω' = T_drive.
    """
    factor = calibration_factor(result)
    if factor == 1.0:
        return result
    found = dict(result)
    for name in ("inertia_kg_m2", "viscous_nm_s_rad", "coulomb_nm"):
        found[name] = _scaled(result.get(name), 1.0 / factor)
    if isinstance(shaft := result.get("compliant"), dict):
        found["compliant"] = {**shaft, "damping_nm_s_rad": _scaled(shaft.get("damping_nm_s_rad"), 1.0 / factor)}
    if isinstance(response := result.get("frequency_response"), dict):
        found["frequency_response"] = {**response, "lines": [
            {**line, "magnitude": _scaled(line["magnitude"], factor)} for line in response["lines"]]}
    return found


def _scaled(part: Any, by: float) -> Any:
    """Return an estimate with its value and ends multiplied."""
    if not isinstance(part, dict):
        return part
    ends = ("value", "low", "high", "low_total", "high_total")
    return {key: one * by if key in ends and is_number(one) else one for key, one in part.items()}


def inertia_to_tune_for(
    result: Mapping[str, Any], path: Path, refused: type[TdhilError], next_step: str = _IDENTIFY_J
) -> tuple[float, float, float]:
    """Return (low, value, high) of J of the motor side, kg·m² at the motor shaft, torque scale included.

    ``next_step``: advice for a result without J. Raises ``refused`` without J, or if J is that of motor and string.
    """
    inertia = result["inertia_kg_m2"]
    stands = result["verdict"] in ("valid", "valid_wide") and isinstance(inertia, dict)
    if not stands or not all(is_number(inertia.get(key)) for key in ("value", "low_total", "high_total")):
        raise refused(f"the result has no J to tune for ({result['verdict']})", where=str(path), next_step=next_step,
                      entry=MessageCode.NO_INERTIA_TO_TUNE)
    low, value, high = (float(inertia[key]) for key in ("low_total", "value", "high_total"))
    if not 0.0 < low <= value <= high:
        raise refused("the interval of J reaches down to zero", where=str(path),
                      next_step="Identify again, for longer", entry=MessageCode.NO_INERTIA_TO_TUNE)
    if MessageCode.STRING_MOVES_WITH_MOTOR.code in (result.get("warning_codes") or ()):
        raise refused(
            f"J of {value:.4g} kg·m² is that of motor and string together, and the gains need J of the motor alone",
            where=str(path), next_step="Disconnect the string and identify again; or identify with excited frequencies "
            "on both sides of the string's resonance (--model two-mass)", entry=MessageCode.NO_INERTIA_TO_TUNE)
    return low, value, high


def inertia_warnings(result: Mapping[str, Any]) -> list[str]:
    """Return a warning if the result does not show whether its J includes a string below the motor."""
    if MessageCode.LOAD_MAY_STAY_BEHIND.code not in (result.get("warning_codes") or ()):
        return []
    return ["the result does not show whether J is that of the motor alone or of motor and string together. The gains"
            " need J of the motor alone: identify with excited frequencies on both sides of the string's resonance"]


def read_impedance(path: Path, result: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the section `impedance` of a result for the same shaft. Raises UsageError and TuningRefused."""
    from tdhil.soft_torque import TuningRefused

    document = read_result(path)
    found = document.get("impedance")
    if not isinstance(found, dict):
        raise UsageError("this run did not measure the drive's own impedance", where=f"--impedance {path}",
                         next_step="tdhil identify --impedance offset … --json > z.json",
                         entry=MessageCode.WRONG_KIND_OF_FILE)
    if found.get("verdict") != "valid":
        raise TuningRefused(f"the drive's own impedance is {found.get('verdict')}: {found.get('reason')}",
                            where=f"--impedance {path}", next_step=str(found.get("advice", "")))
    if bool(document.get("simulated")) != bool(result.get("simulated")):
        kind, other = ("simulated", "real") if document.get("simulated") else ("real", "simulated")
        raise UsageError(f"is of a {kind} drive, and the result is of a {other} one", where=f"--impedance {path}",
                         next_step="Measure both on the same drive; on a real one with --rig",
                         entry=MessageCode.WRONG_KIND_OF_FILE)
    if document["gear_ratio"] != result["gear_ratio"]:
        raise UsageError(f"was measured with a gear ratio of {document['gear_ratio']:g}, and J with "
                         f"{result['gear_ratio']:g}", where=f"--impedance {path}", entry=MessageCode.WRONG_KIND_OF_FILE)
    return _with_numbers(found, f"--impedance {path}")


def _with_numbers(impedance: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    """Return a valid impedance. Raises UsageError without one of its numbers."""
    for key in ("gain_nm_s_rad", "integral_nm_rad", "torque_lag_s", "speed_filter_s"):
        if not isinstance(impedance.get(key), dict) or not is_number(impedance[key].get("value")):
            raise UsageError(f"{key} is not a number", where=where, entry=MessageCode.WRONG_KIND_OF_FILE)
    return impedance


def own_impedance(result: Mapping[str, Any], path: Path) -> Mapping[str, Any] | None:
    """Return the impedance that the result in ``path`` contains; None without a valid one. Raises UsageError."""
    found = result.get("impedance")
    if not isinstance(found, dict) or found.get("verdict") != "valid":
        return None
    return _with_numbers(found, str(path))


REPORTED_FILTER: Final = "the speed filter as the drive reports it; the rest assumed, not measured"
"""Source of the lags of a loop with a reported filter."""


def reported_filter(result: Mapping[str, Any]) -> tuple[float, bool] | None:
    """Return the filter of the drive's speed loop as the drive reports it, s, and whether its entry is verified."""
    found = result.get("speed_loop_present")
    if not isinstance(found, dict) or not is_number(found.get("filter_s")):
        return None
    setting = (found.get("settings") or {}).get("filter") or {}
    return float(found["filter_s"]), setting.get("confidence") == "verified"


def read_bit_noise(path: Path) -> tuple[Interval, float]:
    """Return rms in N·m and correlation time in s of the bit's random torque, from `tdhil severity --json`.

    Of two records, the later one counts. Raises UsageError for another file, TuningRefused if the record does not
    determine it.
    """
    from tdhil.soft_torque import Interval, TuningRefused

    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        found = document["records"][-1]
        noise, why = found["bit_noise"], found["bit_noise_refused"]
        if noise is not None:
            values = [float(noise["rms_nm"][key]) for key in ("value", "low", "high")]
            correlation_s = float(noise["correlation_s"]["value"])
            if not (0.0 < values[1] <= values[0] <= values[2] and 0.0 < correlation_s <= 60.0):
                raise ValueError("rms or correlation time is not positive")
    except (OSError, ValueError, TypeError, KeyError, IndexError) as error:
        raise UsageError(f"is not a result of tdhil severity ({str(error)[:80]})", where=f"--bit-noise {path}",
                         next_step="tdhil severity drilling.csv --result result.json --string string.yaml --json > "
                         "severity.json", entry=MessageCode.WRONG_KIND_OF_FILE) from None
    if noise is None:
        raise TuningRefused(f"the record does not determine the bit noise: {why}", where=f"--bit-noise {path}",
                            next_step="Leave the option out: string.yaml states the noise, or 8 % of coulomb_nm counts")
    return Interval(*values), correlation_s


def measured_lags(measured: Mapping[str, Any]) -> tuple[list[float], list[list[float]]]:
    """Return the lags of speed and torque, and the main axes of their 95 % coverage region.

    Their sum is more certain than each lag: its half-width gives their correlation.
    """
    import numpy as np

    keys = ("speed_filter_s", "torque_lag_s")
    values = [ends_of(measured[key])[1] for key in keys]
    halves = [ends_of(measured[key])[2] - value for key, value in zip(keys, values, strict=True)]
    both = halves[0] * halves[1]
    together = 0.0
    if isinstance(measured.get("inner_lag_s"), dict):
        _, value, high = ends_of(measured["inner_lag_s"])
        together = min(both, max(-both, 0.5 * ((high - value) ** 2 - halves[0] ** 2 - halves[1] ** 2)))
    sizes, axes = np.linalg.eigh(np.array([[halves[0] ** 2, together], [together, halves[1] ** 2]]))
    return values, [(sqrt(max(0.0, size)) * axis).tolist() for size, axis in zip(sizes, axes.T, strict=True)]


def bounded_estimate(part: Any) -> tuple[float, float, float] | None:
    """Return (low, value, high) of an estimate that is bounded and positive; else None."""
    if not isinstance(part, dict) or not all(is_number(part.get(key)) for key in ("low", "value", "high")):
        return None
    low, value, high = (float(part[key]) for key in ("low", "value", "high"))
    return (low, value, high) if 0.0 < low <= value <= high else None


def ends_of(part: Mapping[str, Any], times: float = 1.0) -> tuple[float, float, float]:
    """Return (low, value, high), each at least 0; a missing end is replaced by the value."""
    value = max(0.0, float(part["value"]))
    low, high = (float(part[key]) if is_number(part.get(key)) else value for key in ("low", "high"))
    return times * max(0.0, min(low, value)), times * value, times * max(high, value)


def is_number(value: Any) -> bool:
    """Return whether a value of a JSON document is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def positive_number(result: Mapping[str, Any], key: str, path: Path) -> float:
    """Return a number of the result in ``path``. Raises UsageError if it is not positive."""
    value = result[key]
    if not is_number(value) or value <= 0.0:
        raise UsageError(f"{key} is not a positive number", where=str(path),
                         entry=MessageCode.WRONG_KIND_OF_FILE)
    return float(value)


def estimated(result: Mapping[str, Any], key: str) -> float:
    """Return an estimate; 0 if the result does not have it, or it is negative."""
    part = result.get(key)
    value = part.get("value") if isinstance(part, dict) else None
    return max(0.0, float(value)) if isinstance(value, int | float) else 0.0


def profile_for(namespace: argparse.Namespace, result: Mapping[str, Any]) -> Profile | None:
    """Return the profile of --profile, or else the result's; None if neither names one."""
    name = namespace.profile or (result.get("profile") or {}).get("name")
    return load_profile(str(name)) if name is not None else None


def speed_controller_of(profile: Profile | None, result: Mapping[str, Any]) -> SpeedControllerParameters | None:
    """Return the parameters of the drive's speed controller; None if the profile has none for this drive."""
    found = None if profile is None else profile.speed_controller
    return found if found is not None and found.belongs_to(simulated=bool(result.get("simulated"))) else None


# ---------------------------------------------------------------------------------------------------------------------
# Options of both purposes.


RATED: Final = (
    ("rated_torque", 1e-6, 1e9, "a positive number of N·m"),
    ("rated_speed", 1e-3, 1e6, "a positive number of rpm"),
)
"""Limits of the motor's ratings: attribute, least, greatest, and both in words."""


def check_limits(namespace: argparse.Namespace, limits: Iterable[tuple[str, float, float, str]]) -> None:
    """Check options against their limits and `RATED`. Raises UsageError."""
    for name, low, high, wanted in (*limits, *RATED):
        value = getattr(namespace, name)
        if value is not None and not low <= value <= high:
            raise UsageError(f"{value:g}: must be {wanted}", where=f"--{name.replace('_', '-')}",
                             entry=MessageCode.VALUE_NOT_ALLOWED)


def check_present(namespace: argparse.Namespace) -> None:
    """Check the gains of --present. Raises UsageError."""
    for value in namespace.present or ():
        if not 0.0 < value < 1e9:
            raise UsageError(f"{value:g}: must be a positive number", where="--present",
                             entry=MessageCode.VALUE_NOT_ALLOWED)


def check_inner_lags(namespace: argparse.Namespace) -> None:
    """Check the times of --inner-lags. Raises UsageError."""
    for lag in namespace.inner_lags or ():
        if not 0.0 <= lag <= 5.0:
            raise UsageError(f"{lag:g}: must be a time from 0 to 5 s", where="--inner-lags",
                             entry=MessageCode.VALUE_NOT_ALLOWED)


def measured_where(namespace: argparse.Namespace) -> str:
    """Return where the impedance was measured, as words of its source."""
    return "as measured (--impedance)" if namespace.impedance else "as measured (impedance in the result)"


def present_gains(
    namespace: argparse.Namespace, measured: Mapping[str, Any] | None, result: Mapping[str, Any]
) -> tuple[PiGains | None, str | None]:
    """Return the gains in the drive and their source: typed, measured, or as the drive reported them before the run.

    None without gains; the source then states why, or is None if there is none.
    """
    from tdhil.speed_loop import PiGains

    if namespace.present is not None:
        return PiGains(*namespace.present), "as stated (--present)"
    if measured is not None:
        gain, integral = (ends_of(measured[key])[1] for key in ("gain_nm_s_rad", "integral_nm_rad"))
        return _comparable(gain, integral, measured_where(namespace))
    return _reported_gains(result, namespace.rated_torque, namespace.rated_speed)


def _reported_gains(
    result: Mapping[str, Any], rated_torque_nm: float | None, rated_speed_rpm: float | None
) -> tuple[PiGains | None, str | None]:
    """Return the gains that the drive reported before the run, and their objects or registers."""
    from tdhil.soft_torque import one_percent_nm_s_rad

    found = result.get("speed_loop_present")
    settings = found.get("settings") if isinstance(found, dict) else None
    if not isinstance(found, dict) or not isinstance(settings, dict):
        return None, None
    read = [settings[part] for part in ("gain", "integral") if isinstance(settings.get(part), dict)]
    source = f"reported by the drive ({', '.join(str(one.get('where')) for one in read)})"
    unsure = sorted({str(one.get("confidence")) for one in read} - {"verified"}, reverse=True)
    if unsure:
        source += f", in units that the profile marks as {unsure[0]}"
    if len(read) < 2 or not all(is_number(one.get("value")) for one in read):
        return None, "not known: the drive did not report both gains"
    gain, integral = (float(found[key]) if is_number(found.get(key)) else None
                      for key in ("gain_nm_s_rad", "integral_nm_rad"))
    units = [one.get("unit") for one in read]
    if gain is None and units[0] == "percent_per_percent":
        if rated_torque_nm is None or rated_speed_rpm is None:
            return None, f"{source}; they need --rated-torque and --rated-speed of the motor's name plate"
        gain = read[0]["value"] * one_percent_nm_s_rad(rated_torque_nm, rated_speed_rpm)
        time_s = read[1]["value"] * {"s": 1.0, "ms": 1e-3}.get(str(units[1]), 0.0)
        if integral is None and time_s > 0.0:
            integral = gain / time_s
    if "unknown" in units:
        return None, f"{source}; the profile does not know their units"
    if "a_s_rad" in units:
        return None, f"{source}; P in A·s/rad needs the motor's torque constant. State both with --present"
    return _comparable(float(gain or 0.0), float(integral or 0.0), source)


def _comparable(gain_nm_s_rad: float, integral_nm_rad: float, source: str) -> tuple[PiGains | None, str]:
    """Return the gains and their source; None, and why, without a positive P and I."""
    from tdhil.speed_loop import PiGains

    if gain_nm_s_rad <= 0.0 or integral_nm_rad <= 0.0:
        return None, f"{source}; P or I is 0, and such a loop is not compared"
    return PiGains(gain_nm_s_rad, integral_nm_rad), source
