"""Acceptance: comparison of expected and identified values, judged by the interval. Pure: it reads the document.

A quantity passes if its whole interval lies within the tolerance, and fails if its interval and the tolerance have no
value in common. Otherwise the data do not decide. An interval with a coverage of less than 95 % decides nothing: a
smaller confidence would make each quantity pass.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from math import sqrt
from typing import Any, Final

from profiles import MessageCode, with_code
from profiles.quantities import plain_number
from tdhil.config import ACCEPTED_QUANTITIES, Expectation
from tdhil.report.inertia_scope import InertiaScope, scope_text
from tdhil.report.intervals import coverage_of, rounded, with_interval

Part = Mapping[str, Any]
_WITH_TORQUE: Final = ("inertia", "viscous", "coulomb")
"""Quantities that are proportional to the torque scale."""
_INERTIAS: Final = ("inertia", "motor-inertia")
_SETTINGS: Final = ("torque-limit",)
"""Settings in the N·m of the drive, which the document has in calibrated N·m."""


_MORE: Final = 4
"""Most digits that a text of an acceptance may have beyond the usual ones."""
LEAST_COVERAGE: Final = 0.95
"""Least coverage of an interval that decides on an acceptance."""


class AcceptanceVerdict(StrEnum):
    """Verdict on one expected value, or on all."""

    PASS = "pass"
    FAIL = "fail"
    CANNOT_TELL = "cannot tell"


@dataclass(frozen=True)
class Accepted:
    """One expected value, and the identified one; None if it was not identified."""

    name: str
    label: str
    unit: str
    expected: float | str
    tolerance: float
    value: float | str | None
    low: float | None
    high: float | None
    verdict: AcceptanceVerdict
    text: str


def acceptance_of(expected: Sequence[Expectation], document: Part) -> dict[str, Any] | None:
    """Return the verdict on all expected values as plain data; None without any."""
    if not expected:
        return None
    rows = tuple(_judged(one, document) for one in expected)
    found = {one.verdict for one in rows}
    worst = next(one for one in (AcceptanceVerdict.FAIL, AcceptanceVerdict.CANNOT_TELL, AcceptanceVerdict.PASS)
                 if one in found)
    code = MessageCode.ACCEPTANCE_FAILED.code if worst is AcceptanceVerdict.FAIL else ""
    return {"verdict": worst.value, "code": code, "off": list(_causes(rows)), "quantities": [
        {**asdict(one), "verdict": one.verdict.value} for one in rows]}


def acceptance_rows(acceptance: Part | None) -> list[tuple[str, str]]:
    """Return the acceptance as names and texts."""
    if acceptance is None:
        return []
    return [("acceptance", acceptance["verdict"]), *((one["label"], one["text"]) for one in acceptance["quantities"]),
            *(("deviation", with_code(one, acceptance["code"])) for one in acceptance["off"])]


SIGNATURE_LINE: Final = "______________________________"
"""Line to sign on, of every page that a person signs."""


def signature_rows(acceptance: Part) -> list[tuple[str, str]]:
    """Return the line to sign on, as names and texts. A signature of the service (``signature``) stands above it."""
    signed = acceptance.get("signature")
    if not isinstance(signed, Mapping):
        return [("accepted by", f"name, date, signature: {SIGNATURE_LINE}")]
    at = str(signed["at"])                 # ISO 8601 in UTC, to the millisecond
    rows = [("signed by", f"{signed['name']} ({signed['role']}, account {signed['by']})"),
            ("date", f"{at[:10]} {at[11:19]} UTC"),
            ("signed verdict", str(signed["verdict"])), ("remark", str(signed["remark"]) or "none"),
            ("SHA-256 of the log", str(signed["log_sha256"]))]
    if signed.get("problem"):
        rows.append(("signature not valid", str(signed["problem"])))
    return [*rows, ("signature", SIGNATURE_LINE)]


def _judged(expected: Expectation, document: Part) -> Accepted:
    quantity = ACCEPTED_QUANTITIES[expected.name]
    if quantity.unit is None:
        found = _at(quantity.at, document)
        verdict = AcceptanceVerdict.CANNOT_TELL if found is None else (
            AcceptanceVerdict.PASS if str(found).casefold() == expected.text.casefold() else AcceptanceVerdict.FAIL)
        seen = "not reported" if found is None else f"found {found}"
        return Accepted(expected.name, quantity.label, "", expected.text, 0.0, None if found is None else str(found),
                        None, None, verdict, f"{verdict}: expected {expected.text}, {seen}")
    value, low, high = _identified(expected.name, _at(quantity.at, document), document)
    how = "identified"
    if value is None and quantity.reported:
        value, low, high = _identified(expected.name, _at(quantity.reported, document), document)
        how = "reported by the drive"
    more, unit = 0, quantity.unit.symbol
    if value is None or low is None or high is None:
        verdict, seen = AcceptanceVerdict.CANNOT_TELL, "not identified"
    else:
        verdict = _by_interval(expected.value, expected.tolerance, low, high)
        # the least digits with which the printed numbers give this verdict
        more = next((one for one in range(_MORE) if verdict is _by_interval(*(
            float(text) for text in (*_shown(expected, one), *_ends(value, low, high, one))))), _MORE)
        other, scope = "", document.get("inertia_scope")          # none: a refusal
        if expected.name in _INERTIAS and scope is not None:
            # With a string the expected J is that of the motor's side, as for ``motor-inertia``. Else it is that of
            # all that turns.
            has_string = (document.get("rig") or {}).get("load") == "string"
            own = InertiaScope.MOTOR_SIDE if has_string or expected.name != "inertia" else InertiaScope.MOTOR_AND_LOAD
            if scope != own:
                advice = "; expect motor-inertia instead" if scope == InertiaScope.MOTOR_SIDE else ""
                other = f", which is {scope_text(scope)}, not {scope_text(own)}{advice}"
        coverage = coverage_of(document)
        if low < high and coverage is not None and coverage < LEAST_COVERAGE:
            other += f", an interval with a coverage of {100.0 * coverage:g} %; acceptance needs 95 % or more"
        verdict = AcceptanceVerdict.CANNOT_TELL if other else verdict
        seen = f"{how} {with_interval(value, low, high, unit, more)}{other}"
    wanted = "expected {} ± {} ".format(*_shown(expected, more)) + unit
    return Accepted(expected.name, quantity.label, unit, expected.value, expected.tolerance,
                    value, low, high, verdict, f"{verdict}: {wanted}, {seen}")


def _by_interval(expected: float, tolerance: float, low: float, high: float) -> AcceptanceVerdict:
    least, most = expected - tolerance, expected + tolerance
    if least <= low and high <= most:
        return AcceptanceVerdict.PASS
    return AcceptanceVerdict.FAIL if high < least or most < low else AcceptanceVerdict.CANNOT_TELL


def _shown(expected: Expectation, more: int) -> tuple[str, str]:
    return plain_number(expected.value, 5 + more), plain_number(expected.tolerance, 5 + more)


def _ends(value: float, low: float, high: float, more: int) -> tuple[str, str]:
    return rounded(value, low, high, more)[1:] if low < high else (plain_number(value, 5 + more),) * 2


def _at(place: Iterable[str], document: Part) -> Any:
    """Return what stands at this place of the document; None for nothing."""
    part: Any = document
    for key in place:
        part = part.get(key) if isinstance(part, Mapping) else None
    return part


def _identified(name: str, part: Any, document: Part) -> tuple[float | None, float | None, float | None]:
    """Return value and interval. Those of J and friction include the torque scale; a read value, a limit, is exact."""
    scale, calibration = 1.0, document.get("torque_calibration")
    if name in _SETTINGS and isinstance(calibration, Mapping):
        # The torque limit is a setting of the drive or of rig.yaml, in the N·m of the drive. If a calibration was
        # applied, the document has it in calibrated N·m, the scale in which saturation is judged. A correct setting
        # must not fail by κ. The gains need no factor: no calibration is applied to a run that measures the drive's
        # impedance.
        scale = 1.0 / float(calibration["factor"])
    if isinstance(part, int | float) and not isinstance(part, bool):
        return scale * part, scale * part, scale * part
    if not isinstance(part, Mapping):
        return None, None, None
    total = "_total" if name in _WITH_TORQUE or name in _INERTIAS else ""
    value, low, high = (part.get(key) for key in ("value", f"low{total}", f"high{total}"))
    if value is None or low is None or high is None:
        return value, low, high
    return scale * value, scale * low, scale * high


def _causes(rows: Sequence[Accepted]) -> Iterable[str]:
    """Yield the deviations in words. One common factor of all quantities with torque is one cause: the torque scale."""
    failed = [one for one in rows if one.verdict is AcceptanceVerdict.FAIL and one.value is not None]
    named = {one.name for one in failed}
    ratios = {one.name: _ratio(one) for one in rows if one.name in _WITH_TORQUE and one.value is not None}
    if len(ratios) == len(_WITH_TORQUE) and {"inertia", "coulomb"} <= named:
        # equal within their intervals; a ratio with a very wide interval is no proof
        (first, half), *others = ratios.values()
        if all(abs(ratio - first) <= sqrt(width**2 + half**2) and width < abs(ratio - 1.0) + half
               for ratio, width in others):
            yield (f"all values that come from the torque are {ratios['inertia'][0]:.3g} times the expected ones: "
                   "another torque scale, another rated torque, or another drive")
            failed = [one for one in failed if one.name not in _WITH_TORQUE]
    for one in failed:
        if isinstance(one.expected, str) or isinstance(one.value, str):
            yield f"the {one.label} is {one.value}, not {one.expected}{_HINTS[one.name]}"
            continue
        assert one.value is not None
        ratio = f"{one.value / one.expected:.3g} times the expected value" if one.expected else f"{one.value:.3g}"
        yield f"the {one.label} is {ratio}{_HINTS.get(one.name, '')}"


_HINTS: Final = {
    "inertia": ": another body turns with the shaft, or another gear",
    "coulomb": ": bearings, seals, brake or a constant load",
    "viscous": ": lubrication, temperature or fan",
    "speed-lag": ": the speed filter of the drive has another setting",
    "torque-lag": ": the torque filter of the drive has another setting",
    "gain": ": the speed controller of the drive has another gain",
    "integral-gain": ": the speed controller of the drive has another integral time",
    "drive-serial": ": another drive",
    "drive-name": ": another drive",
    "profile": ": another profile was chosen",
    "torque-limit": ": the drive or rig.yaml has another torque limit",
}


def _ratio(one: Accepted) -> tuple[float, float]:
    """Return identified over expected, and the half-width of its interval."""
    if isinstance(one.expected, str) or isinstance(one.value, str) or not one.expected or one.value is None or (
            one.low is None or one.high is None):
        return 0.0, float("inf")
    return one.value / one.expected, 0.5 * (one.high - one.low) / abs(one.expected)
