"""Reading and identification of an uploaded recording, in the worker process and its folder.

A trace in CSV is also written as a log of tdhil. So motion, samples, replays and comparisons of the run read one kind
of file. The trace itself is kept as it was received.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tdhil.config import ASKED_AGAIN, OF_A_TRACE, STATED
from tdhil.errors import ExitCode, LogError, TdhilError, UsageError
from tdhil.service.run_state import Told, request_wrong
from tdhil.service.store import LOG, read_json, write_json
from tdhil.service.upload_request import columns_wrong
from tdhil.service.uploads import MOTION, TRACE

if TYPE_CHECKING:
    from tdhil.recording import FloatArray, Recording, TraceSurvey
    from tdhil.session import RunRecord

PLOTTED: Final = 800
"""Number of stretches in the plot of a preview; each has the smallest and the largest value."""


def read_marked() -> RunRecord:
    """Return the record of the run in the present folder, with the source of its upload. Raises LogError."""
    from tdhil.session import read

    record = read(LOG)
    source = (read_json(Path("request.json")) or {}).get("uploaded")
    return record if source is None else replace(record, configuration={**record.configuration, "uploaded": source})


def read_upload(kind: str, options: Mapping[str, Any]) -> RunRecord:
    """Return the record of an upload in the present folder. ``options``: values of `OF_A_TRACE` for a trace.

    Raises TdhilError: for a file that can't be read, and for a log without a motion to identify from.
    """
    from tdhil.session import is_evaluation, is_verification, read, trace_arguments

    if kind == "trace":
        if not options.get("excitation"):
            return read(TRACE, **trace_arguments({**options, "excitation": None}, "the upload"))
        with TemporaryDirectory(prefix=".motion.", dir=".") as own:        # a preview may run beside an identification
            motion = Path(own) / MOTION
            motion.write_text(options["excitation"], encoding="utf-8")
            return read(TRACE, **trace_arguments({**options, "excitation": str(motion)}, "the upload"))
    record = read(LOG)
    record.require_motion()
    if is_evaluation(record.configuration) or is_verification(record.configuration):
        raise request_wrong("this log contains a virtual string or steps of the speed loop, and no motion for J", LOG,
                            "Evaluate it in a terminal: tdhil replay")
    return record


def preview_of(kind: str, options: Mapping[str, Any], *, readable: bool = True) -> dict[str, Any]:
    """Return the preview: for a trace its table and a guess of the columns, for a log its run; and the reading.

    ``reading`` is None if the file can't be read with these columns: ``mistakes`` has each wrong field with the reason,
    or ``problem`` the error of the file. Without ``columns`` the guess is used. ``readable``: False if a value is
    wrong; then only the table is returned.
    """
    found: dict[str, Any] = {"kind": kind, "table": None, "run": None, "reading": None, "problem": None,
                             "mistakes": []}
    try:
        if kind == "trace":
            from tdhil.recording import survey_trace

            survey = survey_trace(Path(TRACE))
            columns = options.get("columns") or guessed_columns(survey)
            found["table"] = _table(survey, columns)
            mistakes = columns_wrong({**options, "columns": columns}, survey.names)
            if mistakes or not readable:
                return {**found, "mistakes": mistakes}
            options = {**options, "columns": columns}
        record = read_upload(kind, options)
    except TdhilError as error:
        return {**found, "problem": asdict(Told.of(error))}
    return {**found, "run": None if kind == "trace" else _run(record),
            "reading": reading_of(record.recording, (*(record.assumed or ()), *record.problems))}


def guessed_columns(survey: TraceSurvey) -> list[str]:
    """Return the guess as choices of columns, such as ``speed=n:rpm``; a quantity without a guess is left out."""
    return [f"{one.quantity}={one.column}" + (f":{one.unit}" if one.unit else "")
            for one in survey.guess if one.column]


def _table(survey: TraceSurvey, columns: Sequence[str]) -> dict[str, Any]:
    from tdhil.recording import units_of

    return {
        "encoding": survey.encoding, "separator": {"\t": "tab", ";": "semicolon", ",": "comma"}[survey.delimiter],
        "decimal": "comma" if survey.comma else "point", "header_line": survey.line,
        "names": list(survey.names), "units": list(survey.units), "rows": [list(row) for row in survey.rows],
        "guess": [asdict(one) for one in survey.guess], "columns": list(columns),
        "known_units": {one.quantity: list(units_of(one.quantity)) for one in survey.guess},
    }


def _run(record: RunRecord) -> dict[str, Any]:
    from tdhil.report import run_facts

    facts = run_facts(record.recording, record.configuration, LOG)
    return {name: facts[name] for name in (
        "date", "operator", "note", "rig", "drive", "profile", "connection", "recorded_by", "simulated",
        "rehearsed_faults", "complete", "stages")}


def reading_of(recording: Recording, warnings: Sequence[str]) -> dict[str, Any]:
    """Return length, rate, gaps, ranges, warnings and a thinned plot of a recording. Times are in s."""
    from tdhil.recording import GAP_INTERVALS

    time_s = recording.time_s
    steps = np.diff(time_s)
    usual = float(np.median(steps)) if len(steps) else 0.0
    at = np.flatnonzero(steps > GAP_INTERVALS * usual) if usual > 0.0 else np.empty(0, dtype=np.int64)
    widest = int(np.argmax(steps)) if len(steps) else 0
    return {
        "samples": len(time_s), "duration_s": float(time_s[-1] - time_s[0]) if len(time_s) else 0.0,
        "rate_hz": 1.0 / usual if usual > 0.0 else None, "gaps": len(at),
        "widest_gap_s": float(steps[widest]) if len(at) else None,
        "widest_gap_at_s": float(time_s[widest]) if len(at) else None,
        "speed_rad_s": _range(recording.speed_rad_s), "torque_nm": _range(recording.torque_nm),
        "excitation": None if recording.excitation is None else recording.excitation.kind,
        "warnings": list(warnings), "plot": thinned(time_s, recording.speed_rad_s, recording.torque_nm),
    }


def _range(signal: FloatArray) -> dict[str, float] | None:
    good = signal[np.isfinite(signal)]
    if not len(good):
        return None
    return {"min": float(good.min()), "max": float(good.max()), "mean": float(good.mean())}


def thinned(time_s: FloatArray, *signals: FloatArray) -> list[list[float | None]]:
    """Return the columns for a plot, at most `PLOTTED` stretches with the smallest and largest value of each."""
    count = len(time_s)
    if count <= 2 * PLOTTED:
        return [_plain(one) for one in (time_s, *signals)]
    edges = np.linspace(0, count, PLOTTED + 1).astype(np.int64)[:-1]
    found = [np.repeat(time_s[edges], 2)]
    found[0][1::2] = time_s[np.minimum(edges + count // (2 * PLOTTED), count - 1)]
    for signal in signals:
        both = np.empty(2 * len(edges))
        both[0::2], both[1::2] = np.fmin.reduceat(signal, edges), np.fmax.reduceat(signal, edges)
        found.append(both)
    return [_plain(one) for one in found]


def _plain(values: FloatArray) -> list[float | None]:
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]


# ---------------------------------------------------------------------------------------------------------------------


def identify_upload(kind: str, options: Mapping[str, Any], source: Mapping[str, Any]) -> dict[str, Any]:
    """Identify the upload in the present folder, and write log, result and report. Return facts for the run.

    ``source``: of the file, with the rig as stated. Raises TdhilError; then the upload is as it was.
    """
    from tdhil.report import has_extra
    from tdhil.session import conclude, write_as_log

    for name in ("result.json", "report.html", *((LOG,) if kind == "trace" else ())):
        Path(name).unlink(missing_ok=True)
    record = read_upload(kind, options)
    said = {name: options[name] for name in STATED if options.get(name)}
    settings = {one.name: options[one.name] for one in ASKED_AGAIN if options.get(one.name) is not None}
    configuration = {**record.asked(settings), **said, "uploaded": dict(source)}
    record = replace(record, configuration=configuration, log=LOG)
    try:
        found = conclude(record.recording, configuration, LOG, record.assumed)
        if kind == "trace":
            given = {one.name: options[one.name] for one in OF_A_TRACE if options.get(one.name) is not None}
            write_as_log(record, Path(LOG), {"trace": {"options": given}})
        write_json(Path("result.json"), found.document)
    except BaseException:
        if kind == "trace":
            Path(LOG).unlink(missing_ok=True)
        raise
    document = found.document
    if has_extra():
        from tdhil.report import write_report
        from tdhil.service.letterhead import stored_letterhead

        with suppress(UsageError, LogError, OSError):      # the result is valid without its report
            write_report(document, record.recording, Path("report.html"), stored_letterhead(Path("../..")))
    code = ExitCode.PARTIAL if record.partial and found.exit_code is ExitCode.OK else found.exit_code
    return {
        "verdict": document["verdict"], "exit_code": int(code), "simulated": record.recording.simulated,
        "rehearsal": document["rehearsal"], "identity": (document["drive"] or {}).get("name") or "",
        "said": {**{name: document[name] for name in STATED if document[name]},
                 **({"fault": document["rehearsed_faults"]} if document["rehearsed_faults"] else {})},
    }
