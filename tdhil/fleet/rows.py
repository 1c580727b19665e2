"""One row for each log: flat, typed, with units in the names. A table of any kind consists of these rows."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Final

from tdhil.errors import NothingRecorded
from tdhil.recording import ABORTED
from tdhil.version import __version__

ROW_FORMAT: Final = 4
"""Format number. It grows when a column gets another meaning; `row_key` notices a new column by itself."""

UNREAD: Final = "unread"
"""Verdict of a log without any result; `error_kind` states the reason."""


@dataclass(frozen=True)
class FleetSettings:
    """Settings for every log; None: as in each run (`tdhil.identify`)."""

    model: str | None = None
    confidence: float | None = None
    tolerance: float | None = None

    def asked(self) -> dict[str, Any]:
        """Return the given settings, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def _at(*places: str) -> Any:
    """Declare a column by its places in the result document, such as ``inertia_kg_m2.low``. The first place with a
    value counts.
    """
    return field(default=None, metadata={"places": places})


@dataclass(frozen=True)
class FleetRow:
    """Result of one log. SI at the motor shaft; ``low`` to ``high`` is the interval at ``confidence``.

    For the inertia ``low`` to ``high`` is the repeatability on this drive; ``low_total`` to ``high_total`` include the
    torque scale with its standard uncertainty ``torque_scale_rel_sd`` (a share). ``torque_calibration`` is the date of
    the calibration that it comes from, ``torque_calibration_factor`` its factor. ``stored_…`` is the result that the
    run left in its log; ``changed``: this result differs from it. The result of an aborted run uses the data before the
    abort: ``aborted_stage`` is the stage that was aborted, ``aborted_by`` the kind of error that ended it. ``complete``
    is False if the log ended before the run. None: unknown, or absent. No field depends on the machine, the process or
    the time of the calculation.
    """

    log: str
    verdict: str
    reason: str | None = _at("reason")
    error_kind: str | None = None
    error_text: str | None = None
    rig: str | None = _at("rig.name")    # the file's name identifies no rig: every folder may have a rig.yaml
    date: str | None = _at("date")
    inertia_kg_m2: float | None = _at("inertia_kg_m2.value")
    inertia_low_kg_m2: float | None = _at("inertia_kg_m2.low")
    inertia_high_kg_m2: float | None = _at("inertia_kg_m2.high")
    inertia_low_total_kg_m2: float | None = _at("inertia_kg_m2.low_total")
    inertia_high_total_kg_m2: float | None = _at("inertia_kg_m2.high_total")
    inertia_scope: str | None = _at("inertia_scope")     # bodies to which J refers, `tdhil.report.InertiaScope`
    confidence: float | None = _at("inertia_kg_m2.confidence")
    torque_scale_rel_sd: float | None = None
    torque_calibration: str | None = _at("torque_calibration.date")
    torque_calibration_factor: float | None = _at("torque_calibration.factor")
    gear_ratio: float | None = _at("gear_ratio")
    viscous_nm_s_rad: float | None = _at("viscous_nm_s_rad.value")
    viscous_low_nm_s_rad: float | None = _at("viscous_nm_s_rad.low")
    viscous_high_nm_s_rad: float | None = _at("viscous_nm_s_rad.high")
    coulomb_nm: float | None = _at("coulomb_nm.value")
    coulomb_low_nm: float | None = _at("coulomb_nm.low")
    coulomb_high_nm: float | None = _at("coulomb_nm.high")
    speed_lag_s: float | None = _at("speed_lag_s.value")
    speed_lag_low_s: float | None = _at("speed_lag_s.low")
    speed_lag_high_s: float | None = _at("speed_lag_s.high")
    torque_lag_s: float | None = _at("torque_lag_s.value")
    torque_lag_low_s: float | None = _at("torque_lag_s.low")
    torque_lag_high_s: float | None = _at("torque_lag_s.high")
    skew_s: float | None = _at("skew_s.value")
    skew_low_s: float | None = _at("skew_s.low")
    skew_high_s: float | None = _at("skew_s.high")
    load_inertia_kg_m2: float | None = _at("compliant.load_inertia_kg_m2.value")
    load_inertia_low_kg_m2: float | None = _at("compliant.load_inertia_kg_m2.low")
    load_inertia_high_kg_m2: float | None = _at("compliant.load_inertia_kg_m2.high")
    stiffness_nm_rad: float | None = _at("compliant.stiffness_nm_rad.value")
    stiffness_low_nm_rad: float | None = _at("compliant.stiffness_nm_rad.low")
    stiffness_high_nm_rad: float | None = _at("compliant.stiffness_nm_rad.high")
    resonance_hz: float | None = _at("compliant.resonance_hz.value")
    resonance_low_hz: float | None = _at("compliant.resonance_hz.low")
    resonance_high_hz: float | None = _at("compliant.resonance_hz.high")
    paper_inertia_kg_m2: float | None = _at("paper.inertia_kg_m2")
    second_opinion_kg_m2: float | None = _at("second_opinions.0.inertia_kg_m2.value")
    second_opinion_agrees: bool | None = _at("second_opinions.0.agrees")
    residual_p_value: float | None = _at("residual.p_value")
    model: str | None = _at("model")
    warnings: str | None = None
    excitation: str | None = None
    mode: str | None = None
    duration_s: float | None = None
    samples: int | None = None
    periods_used: int | None = _at("periods_used")
    complete: bool | None = _at("complete")
    aborted_stage: str | None = None
    aborted_by: str | None = _at("ended.kind")
    simulated: bool | None = _at("simulated")
    rehearsed_faults: str | None = None      # faults scripted in the simulated drive: not part of the rig's history
    drive_name: str | None = _at("drive.name")
    drive_vendor: int | None = _at("drive.vendor")
    drive_product: int | None = _at("drive.product")
    drive_revision: int | None = _at("drive.revision")
    drive_serial: int | None = _at("drive.serial")
    profile: str | None = _at("profile.name")
    connection: str | None = _at("connection")
    operator: str | None = _at("operator")
    note: str | None = _at("note")
    stored_verdict: str | None = None
    stored_inertia_kg_m2: float | None = None
    changed: bool | None = None
    recorded_by: str | None = _at("recorded_by")
    tdhil: str = __version__
    settings: str = "{}"
    sha256: str | None = None
    size_bytes: int | None = None

    @property
    def failed(self) -> bool:
        """True for the row of a log without a result."""
        return self.error_kind is not None

    @property
    def no_motion(self) -> bool:
        """True for the log of a run that ended before anything moved."""
        return self.error_kind == NothingRecorded.__name__

    @property
    def part_text(self) -> str | None:
        """Part of the run on which the result is based, in words; None for the whole run."""
        if self.aborted_stage is not None or self.aborted_by is not None:
            stage = f" in stage {self.aborted_stage}" if self.aborted_stage is not None else ""
            return f"aborted{stage}" + (f" ({self.aborted_by})" if self.aborted_by is not None else "")
        return "log cut short" if self.complete is False and not self.failed else None


COLUMNS: Final[Mapping[str, type]] = {
    one.name: next(kind for kind in (bool, int, float, str) if str(one.type).startswith(kind.__name__))
    for one in fields(FleetRow)
}
"""Type of each column. All columns except log, verdict and settings may be empty."""


PLACES: Final[Mapping[str, tuple[str, ...]]] = {
    one.name: one.metadata["places"] for one in fields(FleetRow) if "places" in one.metadata
}
"""Places in the result document of the columns that are copied unchanged."""


def counted(count: int, noun: str) -> str:
    """Return "1 log", "2 logs"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def row_key(sha256: str, settings: FleetSettings) -> str:
    """Return the key of a result: the file's content, the version of tdhil, the columns, and the settings."""
    columns = {name: PLACES.get(name, ()) for name in COLUMNS}
    text = json.dumps([ROW_FORMAT, columns, __version__, sha256, settings.asked()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def row_from_json(content: Mapping[str, Any]) -> FleetRow:
    """Return a row from the output of `dataclasses.asdict`. Raises ValueError for anything else."""
    if not set(content) <= set(COLUMNS) or not {"log", "verdict"} <= set(content):
        raise ValueError("not a row of a fleet's table")
    for name, value in content.items():
        kind = COLUMNS[name]
        if value is not None and type(value) is not kind and not (kind is float and type(value) is int):
            raise ValueError(f"{name}: {value!r:.40} is no {kind.__name__}")
    typed: dict[str, Any] = {
        name: float(value) if COLUMNS[name] is float and value is not None else value
        for name, value in content.items()
    }
    return FleetRow(**typed)


def row_of(
    log: str,
    document: Mapping[str, Any],
    *,
    settings: FleetSettings,
    stored: Mapping[str, Any] | None = None,
    **facts: Any,
) -> FleetRow:
    """Return the row of a result document (``tdhil replay --json``). ``stored``: the document that the run left in its
    log.

    ``facts``: other fields by name, such as ``sha256`` and ``torque_scale_rel_sd``.
    """
    found: dict[str, Any] = {name: _find(document, places) for name, places in PLACES.items()} | {
        "warnings": "\n".join(document.get("warnings") or ()) or None,
        "aborted_stage": next((one["name"] for one in document.get("stages") or () if one["outcome"] == ABORTED), None),
        "rehearsed_faults": ", ".join(document.get("rehearsed_faults") or ()) or None,
    }
    calibration = document.get("torque_calibration")
    if isinstance(calibration, Mapping):
        facts |= {"torque_scale_rel_sd": calibration.get("rel_sd")}
    if isinstance(used := document.get("torque_scale_rel_sd"), float):      # wider if the torque signals differ
        facts |= {"torque_scale_rel_sd": used}
    was = _stored(stored)
    verdict, value = document["verdict"], found["inertia_kg_m2"]
    changed = None
    if was:         # the verdict, or the number by more than the rounding of another processor
        changed = was[0] != verdict or (was[1] is None) != (value is None) or (
            was[1] is not None and not math.isclose(was[1], value, rel_tol=1e-8))
    known: dict[str, Any] = found | facts | {
        "stored_verdict": was[0] if was else None,
        "stored_inertia_kg_m2": was[1] if was else None,
        "changed": changed,
    }
    return row_from_json(
        {"log": log, "verdict": verdict, "settings": json.dumps(settings.asked(), sort_keys=True)} | known
    )


def _find(document: Mapping[str, Any], places: tuple[str, ...]) -> Any:
    """Return the first value that is not empty, else the last one; None if a place does not exist."""
    value: Any = None
    for place in places:
        value = document
        for name in place.split("."):
            if isinstance(value, Mapping):
                value = value.get(name)
            elif isinstance(value, list):
                value = value[int(name)] if name.isdecimal() and int(name) < len(value) else None
            else:
                value = None
        if value:
            break
    return value


def failure_row(log: str, kind: str, text: str, settings: FleetSettings, **facts: Any) -> FleetRow:
    """Return the row of a log without a result. ``kind``: class of the error; ``text``: its message."""
    return FleetRow(
        log=log, verdict=UNREAD, error_kind=kind, error_text=" ".join(text.split())[:1000],
        settings=json.dumps(settings.asked(), sort_keys=True), **facts,
    )


def _stored(document: Mapping[str, Any] | None) -> tuple[str, float | None] | None:
    """Return verdict and inertia of the run's own result. The log's content is untrusted."""
    if not isinstance(document, Mapping) or not isinstance(document.get("verdict"), str):
        return None
    inertia = document.get("inertia_kg_m2")
    value = inertia.get("value") if isinstance(inertia, Mapping) else None
    number = float(value) if isinstance(value, int | float) and math.isfinite(value) else None
    return document["verdict"][:40], number
