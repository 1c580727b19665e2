"""Result as one JSON document, equal for a live run and for its replay."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from profiles import CodedText, MessageCode, entry_of, with_code
from tdhil.calibration import CalibrationUnusable, StoredCalibration
from tdhil.config import STATED, expectations_in
from tdhil.estimation import Estimate, FrequencyResponse, Identification, InertiaEstimate, Options, with_total
from tdhil.recording import REHEARSAL, Recording, aborted_stage
from tdhil.report.acceptance import acceptance_of
from tdhil.report.inertia_scope import scope_of
from tdhil.version import __version__

SIMULATED = "SIMULATED"
NO_REAL_SHAFT = "drive and rig are simulated, no real shaft turned"
"""Explanation of `SIMULATED` on a page."""
UPLOADED = "UPLOADED"
"""Mark of a recording that was uploaded to the service, which did not make the run itself."""


def uploaded_of(run: Mapping[str, Any]) -> dict[str, str] | None:
    """Return the source of an uploaded recording: name and SHA-256 of the file, who uploaded it and when, and the rig
    as this person stated it. None for a run that the service or the command line made.
    """
    found = run.get("uploaded")
    if not isinstance(found, Mapping):
        return None
    return {name: text_of(found.get(name)) or "" for name in ("file", "sha256", "by", "at", "rig")}


def uploaded_rows(uploaded: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Return the source of an uploaded recording as names and texts."""
    if uploaded is None:
        return []
    return [("uploaded file", uploaded["file"]), ("its SHA-256", uploaded["sha256"]),
            ("uploaded by", f"{uploaded['by']}, {uploaded['at']}"), ("rig, as stated", uploaded["rig"] or "none")]


def rehearsed_faults(run: Mapping[str, Any]) -> list[str]:
    """Return the faults that were scripted in this run, as the user wrote them; ``run``: the log's configuration."""
    found = run.get("faults")
    return [str(one)[:200] for one in found] if isinstance(found, list | tuple) else []


def rehearsal_of(run: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the verdict on the rehearsed faults in the log's configuration; None without a readable one."""
    found = run.get("rehearsal")
    if not isinstance(found, Mapping) or not isinstance(found.get("faults"), list | tuple):
        return None
    rows = [one for one in found["faults"] if isinstance(one, Mapping)]
    return {
        "verdict": text_of(found.get("verdict")) or "inconclusive",
        "seen": text_of(found.get("seen")) or "",
        "faults": [
            {name: text_of(one.get(name)) or "" for name in ("fault", "required", "verdict")}
            | {"row": _count(one.get("row")), "codes": [_count(code) for code in one.get("codes") or ()]}
            for one in rows
        ],
    }


def rehearsal_rows(rehearsal: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Return the verdict on the rehearsed faults as names and texts."""
    if rehearsal is None:
        return []
    required = [
        f"{one['fault']}: {one['verdict']}. Required ({'row ' + str(one['row']) if one['row'] else 'any fault'}, exit"
        f" {', '.join(map(str, one['codes']))}): {one['required']}" for one in rehearsal["faults"]
    ]
    return [("rehearsal", rehearsal["verdict"]), *(("fault", one) for one in required), ("seen", rehearsal["seen"])]


def marks(document: Mapping[str, Any]) -> str:
    """Return the suffix of a title, '' for a run on a real drive: simulated, rehearsal of a fault, uploaded."""
    found = [SIMULATED] if document["simulated"] else []
    found += [REHEARSAL] if document["simulated"] and document.get("rehearsed_faults") else []
    found += [UPLOADED] if document.get("uploaded") else []
    return " · ".join(found)


def banner(document: Mapping[str, Any]) -> str:
    """Return the marks of a report with their meaning, '' without a mark."""
    if not (found := marks(document)):
        return ""
    said = [NO_REAL_SHAFT] if document["simulated"] else []
    if faults := ", ".join(document.get("rehearsed_faults") or ()):
        said.append(f"rehearsed: {faults}. The history of the rig does not include this result")
    if document.get("uploaded"):
        said.append("tdhil serve did not make this recording. It was uploaded, and no history of a rig includes it")
    return f"{found}: {'; '.join(said)}"


def speed_loop_present_of(run: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the gains of the drive's own speed loop as read before motion; None if the drive reported none.

    P, I and the filter are in SI at the motor shaft, None if unknown. ``settings`` has what was read. A log is not
    trusted.
    """
    found = _mapping(run.get("speed_loop_present"))
    if found is None:
        return None
    settings = {}
    for part in ("gain", "integral", "filter"):
        read = _mapping(found.get(part))
        if read is not None:
            texts = {name: text_of(read.get(name)) or "" for name in ("title", "where", "unit", "confidence")}
            settings[part] = texts | {name: _positive(read.get(name)) for name in ("raw", "value")}
    numbers = {name: _positive(found.get(name)) for name in ("gain_nm_s_rad", "integral_nm_rad", "filter_s")}
    return numbers | {"settings": settings} if settings else None


def run_facts(
    recording: Recording, run: Mapping[str, Any], log: str, warnings: Sequence[str] = ()
) -> dict[str, Any]:
    """Return what the document of a run with a virtual string or with steps states of the run itself.

    The first warning is that the run was aborted: its result uses the data recorded before.
    """
    stage = aborted_stage(recording)
    if stage is not None:
        warnings = (CodedText(f"the run was {stage.aborted_text}. The result uses the data recorded before",
                              MessageCode.RUN_ENDED_EARLY), *warnings)
    return {
        "warnings": list(warnings),
        "warning_codes": codes_of(warnings),
        "gear_ratio": recording.gear_ratio,
        "simulated": recording.simulated,
        "rehearsed_faults": rehearsed_faults(run),
        "rehearsal": rehearsal_of(run),
        "complete": recording.complete,
        **provenance(run),
        "log": log,
        "cycle": run.get("cycle"),
        "stages": [
            {"name": stage.name, "outcome": stage.outcome, "duration_s": stage.end_s - stage.start_s}
            for stage in recording.stages
        ],
        "tdhil": __version__,
    }


def result_document(
    identification: Identification, recording: Recording, run: Mapping[str, Any], log: str, *, calibrated: bool = True
) -> dict[str, Any]:
    """Return plain data for `json.dumps`. ``run`` is the log's configuration; everything else is SI at the motor shaft.

    ``calibrated``: the torque calibration in the log, if there is one, was applied to ``recording``.
    Numbers that are not finite become null, because JSON has no NaN.
    """
    found, squared = identification, recording.gear_ratio * recording.gear_ratio
    document: dict[str, Any] = {
        "verdict": found.verdict.value,
        "model": found.model,
        "reason": found.reason,
        "advice": found.advice,
        "calibration_advised": found.calibration_advised,
        "code": found.entry.code,
        "inertia_kg_m2": _inertia(found.inertia),
        "inertia_scope": None if (scope := scope_of(found, recording)) is None else scope.value,
        "inertia_main_shaft_kg_m2": None if found.inertia is None else {     # J·i² with i = ω_motor/ω_main
            name: getattr(found.inertia, name) * squared for name in ("value", "low_total", "high_total", "low", "high")
        },
        "gear_ratio": recording.gear_ratio,
        "reference_inertia_kg_m2": run.get("reference_inertia_kg_m2"),
        "torque_limit_nm": recording.torque_limit_nm,
        "viscous_nm_s_rad": _scaled(found.viscous_nm_s_rad, found, recording),
        "coulomb_nm": _scaled(found.coulomb_nm, found, recording),
        "speed_lag_s": _estimate(found.speed_lag_s),
        "torque_lag_s": _estimate(found.torque_lag_s),
        "skew_s": _estimate(found.skew_s),
        "paper": None,
        "residual": None if found.residual is None else asdict(found.residual),
        "budget": [asdict(line) for line in found.budget],
        "second_opinions": [asdict(opinion) for opinion in found.second_opinions],
        "friction_curve": [asdict(point) for point in found.friction_curve],
        "harmonics": None if found.harmonics is None else [asdict(one) for one in found.harmonics],
        "least_harmonics": None if found.least_harmonics is None else [asdict(one) for one in found.least_harmonics],
        "backlash": None if found.backlash is None else [asdict(one) for one in found.backlash],
        "backlash_motion": None if found.backlash_motion is None else asdict(found.backlash_motion),
        "compliant": None if (shaft := found.compliant) is None else {
            "motor_inertia_kg_m2": None if found.inertia is None else {     # the result's own inertia, J_r
                name: getattr(found.inertia, name) for name in ("value", "low_total", "high_total", "low", "high")
            },
            "load_inertia_kg_m2": _scaled(shaft.load_inertia, found, recording),
            "total_inertia_kg_m2": _scaled(shaft.total_inertia, found, recording),
            "stiffness_nm_rad": _scaled(shaft.stiffness_nm_rad, found, recording),
            "damping_nm_s_rad": _scaled(shaft.damping_nm_s_rad, found, recording),
            "resonance_hz": _estimate(shaft.resonance_hz),
            "antiresonance_hz": _estimate(shaft.antiresonance_hz),
            "covariance": None if shaft.covariance is None else asdict(shaft.covariance),
        },
        "impedance": None if found.impedance is None else asdict(found.impedance) | {
            "verdict": found.impedance.verdict.value
        },
        "speed_loop_present": speed_loop_present_of(run),
        "torque_ratios": [asdict(ratio) for ratio in found.torque_ratios],
        "torque_scale_rel_sd": found.torque_scale_rel_sd,
        "lines": [asdict(line) for line in found.lines],
        "frequency_response": _response(found.frequency_response),
        "periods_used": found.periods_used,
        "samples_used": found.samples_used,
        "warnings": list(found.warnings),
        "warning_codes": codes_of(found.warnings),
        "simulated": recording.simulated,
        "rehearsed_faults": rehearsed_faults(run),
        "rehearsal": rehearsal_of(run),
        "uploaded": uploaded_of(run),
        "complete": recording.complete,
        "ended": _mapping(run.get("ended")),
        **provenance(run),
        "torque_calibration": _calibration(run.get("torque_calibration")) if calibrated else None,
        "log": log,
        "cycles": run.get("counters"),
        "cycle": run.get("cycle"),
        "stages": [
            {"name": stage.name, "outcome": stage.outcome, "duration_s": stage.end_s - stage.start_s}
            | ({"detail": stage.detail} if stage.detail else {})
            for stage in recording.stages
        ],
        "tdhil": __version__,
    }
    if found.paper is not None:
        document["paper"] = asdict(found.paper.stepped) | {"raw_rate": asdict(found.paper.raw_rate)}
    document["acceptance"] = acceptance_of(expectations_in(run), document)
    cleaned = only_finite(document)
    assert isinstance(cleaned, dict)
    return cleaned


def _response(found: FrequencyResponse | None) -> dict[str, Any] | None:
    """Return the frequency response, with magnitude and phase of T/ω beside those of ω/T."""
    if found is None:
        return None
    document = asdict(found)
    for row, line in zip(document["lines"], found.lines, strict=True):
        row["impedance_magnitude"] = asdict(line.impedance_magnitude)
        row["impedance_phase_rad"] = asdict(line.impedance_phase_rad)
    return document


def _calibration(stored: Any) -> dict[str, Any] | None:
    """Return factor and date of the torque calibration in the log; None without a calibration."""
    if stored is None:
        return None
    try:
        found = StoredCalibration.of(stored)
    except CalibrationUnusable:
        return None
    return {"factor": found.factor, "low": found.low, "high": found.high, "rel_sd": found.rel_sd, "date": found.date}


def coded_reason(reason: str, document: Mapping[str, Any]) -> str:
    """Return the reason of a verdict with its code; a valid result has no code to look up."""
    code = str(document.get("code", ""))
    return with_code(reason, "" if code == MessageCode.VALID.code else code)


def codes_of(warnings: Sequence[str]) -> list[str]:
    """Return the code of each warning; that of `RESULT_WARNING` for a plain text."""
    return [entry_of(one, MessageCode.RESULT_WARNING).code for one in warnings]


def coded_warnings(document: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the warnings of a result for display, with their codes; an older document may have none of both."""
    codes = [str(code) for code in document.get("warning_codes", ())]
    warnings = [str(one) for one in document.get("warnings", ())]
    return tuple(map(with_code, warnings, codes + [""] * (len(warnings) - len(codes))))


def provenance(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return date, place, customer, operator and drive of the run; None for data that the log lacks. A log is not
    trusted.
    """
    bench, drive, profile = (_mapping(run.get(name)) or {} for name in ("bench", "identity", "profile"))
    limits = _mapping(bench.get("limits")) or {}
    numbers = ("vendor", "product", "revision", "serial")
    identity = {"name": text_of(drive.get("name"))} | {name: _count(drive.get(name)) for name in numbers}
    rig = {
        "name": text_of(bench.get("name")),
        "file": text_of(run.get("rig_file")),
        "load": text_of((_mapping(bench.get("load")) or {"kind": bench.get("load")}).get("kind")),
        "limits": {str(name): value for name, value in limits.items() if isinstance(value, int | float)},
    }
    return {
        "date": text_of(run.get("started")),
        **{name: text_of(run.get(name)) for name in STATED},
        "rig": rig if bench else None,
        "drive": identity if drive else None,
        "profile": {name: text_of(profile.get(name)) or "" for name in ("name", "title")} if profile else None,
        "connection": _connection(run),
        "recorded_by": text_of(run.get("tdhil")),
    }


def _connection(run: Mapping[str, Any]) -> str | None:
    """Return the connection to the drive: ``canopen, interface socketcan, channel can0``."""
    found = [text for text in (text_of(run.get("drive")),) if text]
    for name, row in (_mapping(run.get("bus")) or {}).items():
        value = row.get("value") if isinstance(row, Mapping) else None
        if value not in (None, "", "-", [], {}):
            found.append(f"{name} {text_of(str(value))}")
    return "embedded simulator" if run.get("embedded_simulator") is True else ", ".join(found) or None


def text_of(value: object) -> str | None:
    """Return a text of a log or a drive for display: one line of printable characters."""
    if not isinstance(value, str) or not value.strip():
        return None
    return " ".join("".join(sign if sign.isprintable() else " " for sign in value).split())[:500]


def _mapping(value: object) -> dict[str, Any] | None:
    return {str(name): part for name, part in value.items()} if isinstance(value, Mapping) else None


def _count(value: object) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else 0


def _positive(value: object) -> float | None:
    """Return a finite number of at least 0; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) and value >= 0.0 else None


def _inertia(inertia: InertiaEstimate | None) -> dict[str, Any] | None:
    """Return the interval to quote first (torque scale included), then the repeatability on this drive."""
    if inertia is None:
        return None
    found = asdict(inertia)
    total = 0.5 * (inertia.high_total - inertia.low_total) / inertia.value
    repeatability = 0.5 * (inertia.high - inertia.low) / inertia.value
    first = {name: found.pop(name) for name in ("value", "low_total", "high_total")}
    return first | {"half_width_total_rel": total} | found | {"repeatability_rel": repeatability}


def _scaled(estimate: Estimate | None, found: Identification, recording: Recording) -> dict[str, float] | None:
    """Return an estimate that is proportional to the torque: ``low_total`` to ``high_total`` include its scale, like J.

    A friction that cannot be negative has no negative end.
    """
    if estimate is None:
        return None
    confidence = Options().confidence if found.inertia is None else found.inertia.confidence
    scale = recording.torque_scale_rel_sd if found.torque_scale_rel_sd is None else found.torque_scale_rel_sd
    total = with_total(estimate, scale, confidence, ())
    low = total.low_total if estimate.low < 0.0 else max(total.low_total, 0.0)
    return asdict(estimate) | {"low_total": low, "high_total": total.high_total}


def _estimate(estimate: Any) -> dict[str, float] | None:
    return None if estimate is None else asdict(estimate)


def only_finite(value: Any) -> Any:
    """Return plain data with null for each number that JSON cannot represent."""
    if isinstance(value, dict):
        return {key: only_finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [only_finite(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
