"""A torque calibration from recordings: check that they are of one drive, complete and rigid, and combine them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tdhil.errors import UsageError
from tdhil.file_hash import sha256_of
from tdhil.session.conclusion import conclude
from tdhil.session.run_record import RunRecord
from tdhil.session.stored_calibration import drive_identity, drive_settings, refuse_rehearsal, without_calibration

if TYPE_CHECKING:
    from tdhil.calibration import RunPlan, TorqueCalibration, TorquePairs
    from tdhil.estimation import Identification
    from tdhil.recording import Recording

ASSUMED_BODY_REL_SD = 0.002
"""Assumed relative standard uncertainty of a body: a turned disc, diameter known to 0.05 % and mass to 0.1 %."""
SETTINGS_ALIKE = 1e-6
"""Largest relative difference at which the drive's settings in two logs count as equal."""


@dataclass(frozen=True)
class CalibrationRun:
    """A recording with the body that was on the shaft. ``added_kg_m2``: its inertia as stated, at the ``at`` shaft.

    ``added_sd_kg_m2``: its standard uncertainty; None if not stated.
    """

    record: RunRecord
    added_kg_m2: float
    added_sd_kg_m2: float | None = None


@dataclass(frozen=True)
class CalibrationFound:
    """A calibration with data for document and report. ``identified``: result of each run by itself."""

    calibration: TorqueCalibration
    runs: tuple[CalibrationRun, ...]
    identified: tuple[Identification, ...]
    at: str
    confidence: float
    together: bool
    warnings: tuple[str, ...]


def _names(runs: Sequence[CalibrationRun]) -> list[str]:
    """Return a short name of each run's log: the file, or the folder if all files have the same name, or both."""
    paths = [Path(run.record.log) for run in runs]
    for names in ([path.name for path in paths], [path.parent.name for path in paths]):
        if len(set(names)) == len(names):
            return names
    return [f"{path.parent.name}/{path.name}" for path in paths]


def find_calibration(runs: Sequence[CalibrationRun], at: str, confidence: float = 0.95) -> CalibrationFound:
    """Return the result of all runs together. ``at``: shaft to which the bodies' inertia refers, motor or main.

    Raises UsageError for recordings that can't belong together, and NothingRecorded for one without motion.
    """
    from tdhil.calibration import BodyRun, CalibrationCase, calibrate_torque

    _require_comparable(runs)
    ratio = runs[0].record.recording.gear_ratio
    square = ratio**2 if at == "main" else 1.0
    identified = []
    for run in runs:
        run.record.require_motion()
        identified.append(conclude(run.record.recording, without_calibration(run.record.configuration), run.record.log)
                          .identification)
    warnings = []
    if any(run.added_kg_m2 and run.added_sd_kg_m2 is None for run in runs):
        warnings.append("state the standard uncertainty of the body: it is not given, and"
                        f" {100 * ASSUMED_BODY_REL_SD:.1f} % of its inertia is assumed")
    if any(not drive_identity(run.record.configuration) for run in runs):
        warnings.append("a trace does not name its drive: whether all are of the same drive was not checked")
    refusal = _refusal(runs, identified)
    if refusal is not None:
        return CalibrationFound(refusal, tuple(runs), tuple(identified), at, confidence, False, tuple(warnings))
    values, covariance, known, dof, sharing, together = _joint([run.record.recording for run in runs], identified)
    if not together:
        warnings.append("the runs were not fitted together, since not all of them have a periodic excitation and a"
                        " rigid shaft with straight friction: the intervals are wider than necessary")
    noise = np.sqrt(np.maximum(np.diag(known), 0.0)) / values
    bodies = tuple(
        BodyRun(name, run.added_kg_m2 / square, _sd(run) / square, float(share))
        for name, run, share in zip(_names(runs), runs, noise, strict=True)
    )
    case = CalibrationCase(
        bodies, values, covariance, known, dof, sharing, _unlike(runs, identified),
        max(run.record.recording.torque_scale_rel_sd for run in runs), ratio, confidence,
        _reading_rel_sd(runs, identified) if together else 0.0)
    found = calibrate_torque(case)
    return CalibrationFound(found, tuple(runs), tuple(identified), at, confidence, together,
                            (*found.warnings, *warnings))


def document_of_calibration(found: CalibrationFound) -> dict[str, Any]:
    """Return the document of a calibration: the result with its runs, the drive, and the date of the last run."""
    from tdhil.report import calibration_document

    first = found.runs[0].record
    runs = tuple(
        {"log": run.record.log, "name": name, "sha256": sha256_of(Path(run.record.log)),
         "date": run.record.configuration.get("started"), "added_kg_m2": run.added_kg_m2,
         "added_sd_kg_m2": run.added_sd_kg_m2}
        for name, run in zip(_names(found.runs), found.runs, strict=True)
    )
    dates = [str(run["date"]) for run in runs if run["date"]]
    return calibration_document(
        found.calibration, runs, drive_identity(first.configuration),
        drive_settings(first.configuration, first.recording),
        date=max(dates) if dates else datetime.now().astimezone().isoformat(timespec="seconds"), at=found.at,
        confidence=found.confidence, simulated=first.recording.simulated, warnings=found.warnings,
    )


def find_plan(
    record: RunRecord, wanted: float, added_sd_share: float = ASSUMED_BODY_REL_SD, sizes: Sequence[float] = ()
) -> tuple[float, float, tuple[RunPlan, ...]]:
    """Return J (kg·m², in the drive's unit), minutes of stage 5, and suitable bodies. Raises UsageError without J."""
    from tdhil.calibration import plan_bodies
    from tdhil.estimation import Refused, identify_together

    record.require_motion()
    try:
        alone = identify_together([record.recording])
    except Refused as refused:
        advice = refused.refusal.advice
        raise UsageError(f"gives no plan: {refused.refusal.reason}", where=record.log,
                         next_step=advice[:1].upper() + advice[1:]) from None
    value = float(alone.inertia_kg_m2[0])
    excitation = record.recording.excitation
    segments = () if excitation is None else excitation.segments
    minutes = sum(one.end_s - one.start_s for one in segments) / 60.0
    noise = math.sqrt(float(alone.covariance_known_filters[0, 0])) / value
    return value, minutes, plan_bodies(value, noise, minutes, wanted, added_sd_share, sizes=sizes)


def _sd(run: CalibrationRun) -> float:
    return ASSUMED_BODY_REL_SD * run.added_kg_m2 if run.added_sd_kg_m2 is None else run.added_sd_kg_m2


def _require_comparable(runs: Sequence[CalibrationRun]) -> None:
    """Raise UsageError unless these are different recordings of one drive, with different bodies."""
    if len(runs) < 2:
        raise UsageError("one log is not enough: one without the body and one with it are needed",
                         next_step="tdhil calibrate torque without.mcap with.mcap --added 55")
    if len({run.added_kg_m2 for run in runs}) < 2:
        raise UsageError("all runs have the same body", next_step="Give the inertia of the body: --added 55")
    seen: dict[str, str] = {}
    for run in runs:
        refuse_rehearsal(run.record)
        digest = sha256_of(Path(run.record.log))
        if digest in seen:
            raise UsageError(f"is the same recording as {seen[digest]}", where=run.record.log,
                             next_step="Name the log of each run once")
        seen[digest] = run.record.log
    first = runs[0].record
    for run in runs[1:]:
        for what, of in (("drive", drive_identity), ("settings", drive_settings)):
            ours, theirs = (of(one.configuration, one.recording) for one in (first, run.record))
            for name in ours.keys() & theirs.keys():
                if _differ(ours[name], theirs[name]):
                    raise UsageError(
                        f"is not of the same {'drive' if what == 'drive' else 'drive with the same settings'}:"
                        f" {name} is {theirs[name]}, and {ours[name]} in {first.log}",
                        where=run.record.log, next_step="Calibrate each drive by its own two runs",
                    )
        if run.record.recording.simulated != first.recording.simulated:
            raise UsageError("one of the two runs is simulated, the other is not", where=run.record.log,
                             next_step="Calibrate each drive by its own two runs")


def _differ(a: Any, b: Any) -> bool:
    if isinstance(a, int | float) and isinstance(b, int | float):
        return abs(a - b) > SETTINGS_ALIKE * max(abs(a), abs(b))
    return bool(a != b) and a is not None and b is not None


def _refusal(runs: Sequence[CalibrationRun], identified: Sequence[Identification]) -> TorqueCalibration | None:
    """Return the refusal of a run that can't be used, by name; None if all can be used."""
    from tdhil.calibration import TorqueCalibration
    from tdhil.estimation import Verdict
    from tdhil.recording import aborted_stage

    for name, run, found in zip(_names(runs), runs, identified, strict=True):
        verdict, reason, advice = Verdict.NOT_IDENTIFIABLE, "", "run it again, and calibrate with the new log"
        stage = aborted_stage(run.record.recording)
        if stage is not None:
            reason = f"it was {stage.aborted_text}"
        elif not run.record.recording.complete:
            reason = "its log ends before the run did"
        elif found.inertia is None:
            verdict, reason, advice = found.verdict, f"it has no J: {found.reason}", found.advice or advice
        elif found.verdict not in (Verdict.VALID, Verdict.VALID_WIDE):
            verdict, reason, advice = found.verdict, found.reason, found.advice or advice
        elif found.compliant is not None:
            verdict = Verdict.MODEL_REJECTED
            reason = f"the shaft is not rigid in it (model {found.model}): the body does not turn as one with the motor"
            advice = "bolt the body tight to the motor's shaft, and run it again"
        if reason:
            return TorqueCalibration(verdict, f"the log {name} can't be used: {reason}", advice)
    return None


def _joint(recordings: Sequence[Recording], identified: Sequence[Identification]) -> tuple[Any, ...]:
    """Return J of each run, covariance, covariance with known filters, degrees of freedom, the test, and whether the
    runs were fitted together.
    """
    from tdhil.estimation import Refused, identify_together, normal_quantile

    # the joint fit has first-order lags and straight friction only
    if all(found.model == "rigid+lags" and not found.harmonics and not found.backlash for found in identified):
        try:
            fit = identify_together(recordings)
        except Refused:
            pass
        else:
            return (fit.inertia_kg_m2, fit.covariance, fit.covariance_known_filters, fit.degrees_of_freedom,
                    fit.sharing, True)
    answered = [found.inertia for found in identified if found.inertia is not None]
    values = np.array([one.value for one in answered])
    sds = np.array([
        max(one.high - one.value, one.value - one.low) / normal_quantile(one.confidence) for one in answered
    ])
    return values, np.diag(sds**2), np.diag(sds**2), 50.0, None, False


def _reading_rel_sd(runs: Sequence[CalibrationRun], identified: Sequence[Identification]) -> float:
    """Return the relative standard uncertainty of J that reading in step with a speed setpoint adds to all runs alike;
    rectangular. The joint fit does not know it.
    """
    from tdhil.estimation import worst_share

    shares = [worst_share(stepped, 0.0 if found.torque_lag_s is None else max(found.torque_lag_s.low, 0.0))
              for run, found in zip(runs, identified, strict=True)
              if (stepped := run.record.recording.stepped_setpoint) is not None]
    return max(shares, default=0.0) / math.sqrt(3.0)


def _unlike(runs: Sequence[CalibrationRun], identified: Sequence[Identification]) -> str:
    """Return the largest difference between the runs, in words: the lag of a report that changed."""
    found = []
    for name, text in (("speed_lag_s", "lag of the reported speed"), ("torque_lag_s", "lag of the reported torque"),
                       ("skew_s", "time offset between speed and torque")):
        parts = [getattr(one, name) for one in identified]
        known = [part for part in parts if part is not None and part.finite]
        if len(known) < len(parts):
            continue
        low, high = (pick(known, key=lambda part: part.value) for pick in (min, max))
        width = 0.5 * math.hypot(high.high - high.low, low.high - low.low) or 1e-9
        found.append(((high.value - low.value) / width,
                      f": the {text} is {known[0].value:.3f} s in {_names(runs)[0]} and"
                      f" {max(known[1:], key=lambda one: abs(one.value - known[0].value)).value:.3f} s in another run"))
    return max(found)[1] if found else ""


PAIR_COLUMNS = ("reported_nm", "reported_sd_nm", "reference_nm", "reference_sd_nm")
_DIRECTION = "direction"
_LARGEST_NM = 1e9


def read_pairs(path: Path) -> TorquePairs:
    """Return pairs of reference and reported torque from a CSV. Raises UsageError with the line of a wrong value."""
    import csv

    from tdhil.calibration import TorquePairs

    shape = "Such as: reported_nm,reported_sd_nm,reference_nm,reference_sd_nm,direction"
    if not path.is_file():
        raise UsageError("there is no such file", where=str(path), next_step=shape)
    rows, directions = [], []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            missing = [name for name in (*PAIR_COLUMNS, _DIRECTION) if name not in (reader.fieldnames or ())]
            if missing:
                raise UsageError(f"has no column {', '.join(missing)}", where=str(path), next_step=shape)
            for row in reader:
                where = f"{path}:{reader.line_num}"
                rows.append([_number(row[name], name, where) for name in PAIR_COLUMNS])
                direction = str(row[_DIRECTION]).strip().lower()
                if direction not in ("up", "down"):
                    raise UsageError(f"direction {direction[:20]!r} is neither up nor down", where=where)
                directions.append(direction)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"can't be read ({error})", where=str(path), next_step=shape) from None
    if len({tuple(row) for row in rows}) < len(PAIR_COLUMNS) - 1:
        raise UsageError("holds fewer than three different pairs", where=str(path), next_step="Measure at more torques")
    reported, reported_sd, reference, reference_sd = np.array(rows).T
    return TorquePairs(reported, reported_sd, reference, reference_sd, tuple(directions))


def _number(text: object, name: str, where: str) -> float:
    try:
        value = float(str(text))
    except ValueError:
        value = math.nan
    if not abs(value) <= _LARGEST_NM:
        raise UsageError(f"{name} is no number: {str(text)[:20]!r}", where=where)
    if name.endswith("_sd_nm") and value <= 0.0:
        raise UsageError(f"{name} is {value:g}: must be above 0", where=where)
    return value
