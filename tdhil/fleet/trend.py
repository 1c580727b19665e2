"""One rig over time, and a comparison of some runs: changes in rows and results, as plain data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from profiles.quantities import printed_ends, printed_interval
from tdhil.errors import UsageError
from tdhil.fleet.change_detection import LEAST, Difference, Measured, difference, history
from tdhil.fleet.rows import FleetRow, FleetSettings, counted, row_of

_GOOD: Final = ("valid", "valid_wide")
_SHOWN: Final = 5       # number of logs that a note names


@dataclass(frozen=True)
class Quantity:
    """Column of the table that the trend follows. ``scaled``: the torque scale multiplies it."""

    name: str
    column: str
    low: str
    high: str
    unit: str
    scaled: bool


INERTIA_COLUMN: Final = "inertia_kg_m2"
QUANTITIES: Final = (
    Quantity("inertia", INERTIA_COLUMN, "inertia_low_kg_m2", "inertia_high_kg_m2", "kg·m²", True),
    Quantity("viscous friction", "viscous_nm_s_rad", "viscous_low_nm_s_rad", "viscous_high_nm_s_rad", "N·m·s/rad",
             True),
    Quantity("Coulomb friction", "coulomb_nm", "coulomb_low_nm", "coulomb_high_nm", "N·m", True),
    Quantity("lag of the reported speed", "speed_lag_s", "speed_lag_low_s", "speed_lag_high_s", "s", False),
    Quantity("lag of the reported torque", "torque_lag_s", "torque_lag_low_s", "torque_lag_high_s", "s", False),
)


def measured(row: FleetRow, quantity: Quantity, time: float = 0.0) -> Measured | None:
    """Return a row's value with its repeatability; None if the row has no value."""
    value, low, high = (getattr(row, name) for name in (quantity.column, quantity.low, quantity.high))
    if value is None or low is None or high is None or not low < high:
        return None
    # Friction and lags have the confidence of the run's own settings, like J.
    scale = (row.torque_scale_rel_sd or 0.0) if quantity.scaled else 0.0
    return Measured(value, low, high, row.confidence or 0.95, scale, scale_of(row), time)


def drive_of(row: FleetRow) -> str | None:
    """Return the drive whose torque scale applies. Without a serial number it is the rig's, by name and profile.

    A simulated drive is never the physical one, whatever identity it shows.
    """
    simulated = "simulated " if row.simulated else ""
    if row.drive_serial:
        return f"{simulated}{row.drive_vendor}:{row.drive_product}:{row.drive_serial}"
    named = (row.rig, row.drive_name, row.profile)
    return None if row.rig is None else f"assumed {simulated}" + "|".join(str(one) for one in named)


def series_of(row: FleetRow) -> tuple[str | None, str | None]:
    """Return the drive and its profile. Within one name, only runs with the same drive and profile are one series.

    Another profile may read the torque in another unit, and its lags may differ.
    """
    return drive_of(row), row.profile


def calibration_of(row: FleetRow) -> str:
    """Return the date and the factor of the torque calibration; '' without one. The factor is what the runs share: two
    calibrations from the same logs have one date. A row of an earlier version has no factor.
    """
    factor = row.torque_calibration_factor
    return f"{row.torque_calibration or ''}{'' if factor is None else f' factor {factor!r}'}"


def scale_of(row: FleetRow) -> str | None:
    """Return the torque scale: the drive, and its torque calibration. Between two scales it does not cancel."""
    drive, calibration = drive_of(row), calibration_of(row)
    return f"{drive} calibrated {calibration}" if drive is not None and calibration else drive


def _calibration_text(row: FleetRow) -> str | None:
    day = (row.torque_calibration or "")[:10]
    return f"{day} (factor {row.torque_calibration_factor:.6g})" if row.torque_calibration_factor else day or None


def history_rows(rows: Sequence[FleetRow], *, rehearsals: bool = False) -> tuple[list[FleetRow], list[str]]:
    """Return the rows that count in the history of their rig, and how many are left out, in words.

    This is the one rule of `tdhil trend` and of the service. Left out are: rehearsals, unless ``rehearsals``; logs
    without a valid result; results from a part of a run. What ended a run early, such as a fault, may have begun within
    its data. The operator may have stopped it because of what the data show. Such results differ by selection, and the
    intervals do not cover that.
    """
    real = [row for row in rows if rehearsals or row.rehearsed_faults is None]
    standing = [row for row in real if row.verdict in _GOOD]
    rehearsed, without = len(rows) - len(real), len(real) - len(standing)
    parts = [f"{row.log}: {row.part_text}" for row in standing if row.part_text is not None]
    shown = ", ".join(parts[:_SHOWN]) + (f", and {len(parts) - _SHOWN} more" if len(parts) > _SHOWN else "")
    return [row for row in standing if row.part_text is None], [text for count, text in (
        (rehearsed, rehearsals_left_out(rehearsed)),
        (without, f"{without} of {counted(len(real), 'log')} without a result that stands: left out"),
        (len(parts), f"{counted(len(parts), 'result')} from a part of the run ({shown}): left out")) if count]


def rehearsals_left_out(count: int) -> str:
    """Return the note on this number of rehearsals."""
    return f"{counted(count, 'rehearsal')} of faults on the simulated drive: left out"


def trend_document(rows: Sequence[FleetRow], rig: str | None = None, *, rehearsals: bool = False) -> dict[str, Any]:
    """Return a rig's results over time, as ``tdhil trend --json`` prints them. Raises UsageError for an unknown rig.

    None: the one rig in the table; with several rigs a UsageError lists them. `history_rows` states which rows count.
    The torque scale cancels in differences of one drive.
    """
    known = sorted({row.rig for row in rows if row.rig is not None})
    if rig is None and len(known) == 1:
        rig = known[0]
    mine = [row for row in rows if row.rig == rig and rig is not None]
    if not mine:
        shown = ", ".join(known[:12]) + (", …" if len(known) > 12 else "")
        what = "the table is of several rigs, and none is named" if rig is None else f"no log is of a rig {rig!r}"
        raise UsageError(what if known else "no log is of a rig that has a name", where="--rig",
                         next_step=f"There are: {shown}" if known else "No log in the table names its rig: `name:` in "
                         "rig.yaml does, or `rig:` in the .yaml beside a trace")
    standing, notes = history_rows(mine, rehearsals=rehearsals)
    kept = sorted(((time_s, row) for row in standing if (time_s := _time_s(row)) is not None),
                  key=lambda one: (one[0], one[1].log))
    if len(standing) > len(kept):
        notes.append(f"{counted(len(standing) - len(kept), 'log')} without a date: left out")
    drives = {drive_of(row) for _, row in kept}
    series = {series_of(row) for _, row in kept}
    if len(series) > 1:         # one series has one bench, one drive and one profile
        newest = series_of(kept[-1][1])
        others = [row for _, row in kept if series_of(row) != newest]
        kept = [(time_s, row) for time_s, row in kept if series_of(row) == newest]
        notes.append(f"{len(series)} drives or profiles under this name: the trend is of the newest"
                     f" ({_drive_text(kept[-1][1])}). Left out: {counted(len(others), 'result')} of"
                     f" {'; '.join(sorted({_drive_text(row) for row in others}))}. Give each rig a name of its own")
        drives = {newest[0]}
    if kept and len(scopes := {row.inertia_scope for _, row in kept}) > 1:
        notes.append(f"the results have {len(scopes)} kinds of J ({', '.join(sorted(map(_scope_text, scopes)))}): the"
                     f" trend of the inertia is of the newest kind, {_scope_text(kept[-1][1].inertia_scope)}. Identify"
                     " all logs with the same --model to follow all of them")
    calibrations = {calibration_of(row): _calibration_text(row) or "none" for _, row in kept}
    if len(calibrations) > 1:
        shown = ", ".join(calibrations[one] for one in sorted(calibrations))
        notes.append(f"runs with different torque calibrations ({shown}): each has a torque scale of its own, which"
                     " stays in their differences")
    if any((one or "assumed").startswith("assumed") for one in drives):
        notes.append("the drive reports no serial number: runs on this rig are taken for runs on one drive")
    return {
        "rig": rig, "logs": len(mine), "results": len(kept), "notes": notes,
        "simulated": any(row.simulated for _, row in kept), "rehearsed_faults": _faults(row for _, row in kept),
        "quantities": [_followed(quantity, kept) for quantity in QUANTITIES],
    }


def _faults(rows: Iterable[FleetRow]) -> list[str]:
    """Return the rehearsed faults of these rows, each once."""
    return list(dict.fromkeys(row.rehearsed_faults for row in rows if row.rehearsed_faults is not None))


def _scope_text(scope: str | None) -> str:
    from tdhil.report import scope_text

    return scope_text(scope)


def _drive_text(row: FleetRow) -> str:
    serial = f"serial number {row.drive_serial}" if row.drive_serial else "no serial number"
    simulated = "SIMULATED" if row.simulated else None
    return ", ".join(one for one in (row.drive_name, serial, row.profile, simulated) if one)


def _followed(quantity: Quantity, rows: Sequence[tuple[float, FleetRow]]) -> dict[str, Any]:
    if quantity.column == INERTIA_COLUMN and rows:
        rows = [one for one in rows if one[1].inertia_scope == rows[-1][1].inertia_scope]
    points = [(row, one) for time_s, row in rows if (one := measured(row, quantity, time_s)) is not None]
    document: dict[str, Any] = {
        "name": quantity.name, "column": quantity.column, "unit": quantity.unit,
        "points": [{"log": row.log, "date": row.date, "value": one.value, "low": one.low, "high": one.high,
                    "rehearsed_faults": row.rehearsed_faults} for row, one in points],
        "probability": None, "changes": [], "drift": None,
    }
    if len(points) < LEAST:
        return document | {"text": f"{counted(len(points), 'result')}: {LEAST} are needed for a trend"}
    found = history([one for _, one in points])
    document["probability"] = {"none": found.none, "step": found.step, "drift": found.drift}
    document["changes"] = [
        {
            "before": points[change.at - 1][0].log, "after": points[change.at][0].log,
            "before_date": points[change.at - 1][0].date, "after_date": points[change.at][0].date,
            "probability": change.probability, "here": change.here, "change": asdict(change.change),
        }
        for change in found.changes
    ]
    document["drift"] = None if found.drift_change is None else asdict(found.drift_change)
    if not found.changed:
        text = f"no change is named: that there was none is {_probable(found.none)}"
    elif found.drift_change is not None:
        text = (f"drifts by {_change_text(found.drift_change, quantity.unit)} from first to last "
                f"(that there was a change is {_probable(1 - found.none)}, an even drift {_probable(found.drift)})")
    else:
        text = "; ".join(
            f"changed by {_change_text(point.change, quantity.unit)} {_between(one)} "
            f"(that there was a step is {_probable(point.probability)}, at just this place {_probable(point.here)})"
            for point, one in zip(found.changes, document["changes"], strict=True)
        ) or f"changed ({_probable(1 - found.none)}), but where isn't clear"
    return document | {"text": text}


def _probable(share: float) -> str:
    """Return ``93 % probable``. A probability below 1 is never rounded to 100 %."""
    return "over 99.9 % probable" if share > 0.999 else f"{100.0 * share:.3g} % probable"


def _between(change: Mapping[str, Any]) -> str:
    before, after = (change[f"{end}_date"] or change[end] for end in ("before", "after"))
    if before[:10] != after[:10]:
        return f"between {before[:10]} and {after[:10]}"
    from tdhil.report import shown_date

    return f"between {shown_date(before) or before} and {shown_date(after) or after}"


def _change_text(change: Difference, unit: str) -> str:
    if change.relative:
        low, high = printed_ends(100.0 * change.low, 100.0 * change.high, 2)
        return f"{100 * change.change:+.2f} % ({_signed(low)} % to {_signed(high)} %)"
    return f"{change.change:+.4g} ({printed_interval(change.low, change.high, sign=True)}) {unit}"


def _signed(text: str) -> str:
    return text if text.startswith("-") else f"+{text}"


def _time_s(row: FleetRow) -> float | None:
    with suppress(ValueError):
        return None if row.date is None else datetime.fromisoformat(row.date).timestamp()
    return None


# ---------------------------------------------------------------------------------------------------------------------
# Comparison of some runs


@dataclass(frozen=True)
class Compared:
    """One log in a comparison: its row, its result document, and the settings of its run by name."""

    row: FleetRow
    document: Mapping[str, Any]
    settings: Mapping[str, str]


def identified(log: Path, settings: FleetSettings) -> Compared:
    """Identify one log for a comparison. Raises TdhilError."""
    from tdhil.fleet.task import content_hash, read_any
    from tdhil.session import conclude

    record = read_any(log)
    record.require_motion()
    found = conclude(record.recording, record.asked(settings.asked()), str(log), record.assumed).document
    row = row_of(str(log), found, settings=settings, torque_scale_rel_sd=record.recording.torque_scale_rel_sd,
                 sha256=content_hash(log))
    return Compared(row, found, _settings(row, found, record.recording, record.configuration))


def _settings(row: FleetRow, document: Mapping[str, Any], recording: Any, run: Mapping[str, Any]) -> dict[str, str]:
    from tdhil.config import OPTION
    from tdhil.report import shown_date

    rig = document.get("rig") or {}
    excitation, prior = recording.excitation, recording.lag_prior
    segments = () if excitation is None else excitation.segments
    limits = rig.get("limits") or {}
    identify = run.get("identify")
    asked = identify if isinstance(identify, Mapping) else {}
    found: dict[str, Any] = {
        "date": shown_date(row.date) or row.date,
        "rig": row.rig,
        "load": rig.get("load"),
        "drive": row.drive_name,
        "serial number": row.drive_serial,
        "revision": None if row.drive_revision is None else f"{row.drive_revision:X}h",
        "profile": row.profile,
        "connection": row.connection,
        "excitation": None if excitation is None else f"{excitation.kind}, {excitation.mode} mode",
        "lines, Hz": ", ".join(sorted({" ".join(f"{hertz:.4g}" for hertz in one.lines_hz) for one in segments})),
        "mean speeds, rad/s": ", ".join(f"{one.offset_rad_s:.3g}" for one in segments),
        "periods used": row.periods_used,
        "cycles, Hz": (document.get("cycle") or {}).get("rate_hz"),
        "gear": recording.gear_ratio,
        "standard uncertainty of the torque scale": row.torque_scale_rel_sd,
        "torque calibration": _calibration_text(row),
        "torque limit, N·m": recording.torque_limit_nm,
        "speed window, rad/s": f"{limits['speed_min_rad_s']:g} to {limits['speed_max_rad_s']:g}"
        if {"speed_min_rad_s", "speed_max_rad_s"} <= set(limits) else None,
        "stated lag of the reported speed, s": prior.speed_lag_s,
        "stated lag of the reported torque, s": prior.torque_lag_s,
        "model": row.model,
        **{name: asked.get(name, OPTION[name].default) for name in ("confidence", "tolerance")},
        "recorded by": row.recorded_by,
        "simulated": "yes" if row.simulated else "no",
        "rehearsed faults": row.rehearsed_faults,
        "run": row.part_text or "whole",
    }
    return {name: "–" if value in (None, "") else f"{value:.6g}" if isinstance(value, float) else str(value)
            for name, value in found.items()}


def compare_document(runs: Sequence[Compared]) -> dict[str, Any]:
    """Return the settings of the runs with marked differences, the differences from the first run, and the apparent
    inertia at each spectral line.

    ``tdhil compare --json`` prints this document. For each quantity a sentence states whether it differs.
    """
    first, *others = runs
    return {
        "logs": [run.row.log for run in runs],
        "simulated": any(run.row.simulated for run in runs), "rehearsed_faults": _faults(run.row for run in runs),
        "results": [asdict(run.row) for run in runs],
        "settings": [
            {"name": name, "values": [run.settings[name] for run in runs],
             "differs": len({run.settings[name] for run in runs}) > 1}
            for name in first.settings
        ],
        "differences": [_differences(first.row, other.row) for other in others],
        "apparent_inertia": [
            [{"hertz": line["hertz"], **line["apparent_inertia_kg_m2"]} for line in run.document.get("lines") or ()]
            for run in runs
        ],
        "friction": [
            [{"speed_rad_s": point["speed_rad_s"], **point["torque_nm"]}
             for point in run.document.get("friction_curve") or ()]
            for run in runs
        ],
    }


def _differences(first: FleetRow, other: FleetRow) -> dict[str, Any]:
    found: dict[str, Any] = {"from": first.log, "to": other.log, "quantities": []}
    for quantity in QUANTITIES:
        before, after = measured(first, quantity), measured(other, quantity)
        if before is None or after is None or (
                quantity.column == INERTIA_COLUMN and first.inertia_scope != other.inertia_scope):
            continue
        change = difference(before, after)
        found["quantities"].append({
            "name": quantity.name, "column": quantity.column, "unit": quantity.unit, **asdict(change),
            "differs": change.differs,
        })
    inertia = next((one for one in found["quantities"] if one["column"] == INERTIA_COLUMN), None)
    if None not in (first.inertia_kg_m2, other.inertia_kg_m2) and first.inertia_scope != other.inertia_scope:
        text = (f"the inertias can't be compared: {first.log} has {_scope_text(first.inertia_scope)}, and {other.log}"
                f" has {_scope_text(other.inertia_scope)}. Compare them with the same --model")
    elif inertia is None:
        without = first if first.inertia_kg_m2 is None else other
        text = f"the inertia can't be compared: {without.log} has no result that stands ({without.verdict})"
    else:
        change = Difference(**{name: inertia[name] for name in Difference.__dataclass_fields__})
        scale = "the same drive: its torque scale cancels" if change.shared_scale else (
            "two torque calibrations: the scale of each is in it"
            if calibration_of(first) != calibration_of(other)
            else "two drives: the torque scale of each is in it")
        if change.shared_scale and not (first.drive_serial and other.drive_serial):
            scale = "no serial numbers: taken for one drive, whose torque scale cancels"
        says = "differ" if change.differs else "do not differ significantly"
        parts = "".join(f"; {row.log}: {row.part_text}" for row in (first, other) if row.part_text is not None)
        size = f"{_change_text(change, 'kg·m²')} at {100 * change.confidence:.0f} %"
        text = f"the inertias {says}: {size}; {scale}{parts}"
    return found | {"text": text}
