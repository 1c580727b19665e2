"""`tdhil calibrate torque` without a body: with pairs of torque, the recording of a reference sensor, or a known
pipe.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from tdhil.cli.arguments import require_new
from tdhil.cli.replay import read_recorded
from tdhil.cli.report_file import ReportFile
from tdhil.cli.results import print_json
from tdhil.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from tdhil.session import RunRecord

    _Found = tuple[dict[str, Any], RunRecord | None]
    """Document of the calibration, and the record that names the drive."""

WITHOUT_BODY: Final = ("pairs", "reference", "known_pipe")
"""Options that replace the bodies; one at a time."""
_BODY = ("added", "added_sd", "body")
_NEEDS = {"column": ("reference",), "reference_sd": ("reference", "pairs")}
_EXAMPLES = {
    "pairs": "tdhil calibrate torque run.mcap --pairs pairs.csv --save calibration.json",
    "reference": "tdhil calibrate torque run.mcap --reference sensor.csv --save calibration.json",
    "known_pipe": "tdhil calibrate torque run.mcap --known-pipe string.yaml --save calibration.json",
}


def run_without_body(namespace: argparse.Namespace, confidence: float) -> int:
    """Read, fit, print, save. The kind is the single given option of `WITHOUT_BODY`."""
    from tdhil.report import PlainConsole, factor_report, print_factor, stderr_console
    from tdhil.session import save_calibration

    kind, *others = [name for name in WITHOUT_BODY if getattr(namespace, name) is not None]
    unwanted = [*others, *(name for name in _BODY if getattr(namespace, name)),
                *(name for name, needed in _NEEDS.items()
                  if kind not in needed and getattr(namespace, name) is not None)]
    for name in unwanted:
        raise UsageError(f"does not go with --{kind.replace('_', '-')}", where=f"--{name.replace('_', '-')}",
                         next_step=f"Such as: {_EXAMPLES[kind]}")
    if kind == "known_pipe" and namespace.at == "main":
        raise UsageError("does not go with --known-pipe, whose file states the shaft", where="--at main",
                         next_step=f"Such as: {_EXAMPLES[kind]}")
    if namespace.save is not None:
        require_new("--save", namespace.save)
    report = ReportFile.of_files(namespace, getattr(namespace, kind), *namespace.logs)
    document, record = _KINDS[kind](namespace, confidence)
    console = stderr_console()
    if namespace.json:
        print_json(document)
    else:
        print_factor(document, PlainConsole())
    found = document["calibration_factor"] is not None
    if namespace.save is not None and found:
        save_calibration({name: value for name, value in document.items() if name != "series"}, namespace.save)
        console.print(f"calibration: {namespace.save}", markup=False, soft_wrap=True)
    elif namespace.save is not None:
        console.print(f"tdhil: nothing was written to {namespace.save}: there is no calibration factor",
                      style="yellow", markup=False, soft_wrap=True)
    if report is not None:
        report.write(factor_report(document), () if record is None else (record.configuration,))
    return int(ExitCode.OK if found else ExitCode.NOT_IDENTIFIABLE)


def _one_log(namespace: argparse.Namespace, kind: str) -> RunRecord:
    from tdhil.session import require_file

    if len(namespace.logs) != 1:
        raise UsageError(f"takes one log, not {len(namespace.logs)}", where=f"--{kind.replace('_', '-')}",
                         next_step=f"Such as: {_EXAMPLES[kind]}")
    require_file(namespace.logs[0])
    return read_recorded(namespace, namespace.logs[0])


def _pairs(namespace: argparse.Namespace, confidence: float) -> _Found:
    from tdhil.calibration import calibrate_pairs, scale_of_reference
    from tdhil.report import pairs_document
    from tdhil.session import date_of_log, drive_identity, drive_settings, gear_before, log_of_calibration, read_pairs

    if len(namespace.logs) > 1 or (namespace.save is not None and not namespace.logs):
        raise UsageError("takes one log, which names the drive", where="--save" if namespace.save else "--pairs",
                         next_step=f"Such as: {_EXAMPLES['pairs']}")
    pairs = read_pairs(namespace.pairs)
    record = _one_log(namespace, "pairs") if namespace.logs else None
    rel_sd, warnings = scale_of_reference(_reference_sd(namespace))
    if namespace.at == "main":
        if record is None:
            raise UsageError("needs a log, which has the gear ratio", where="--at main",
                             next_step="Such as: tdhil calibrate torque run.mcap --pairs pairs.csv --at main")
        ratio, loss = gear_before(record.recording, "main")
        if len(set(pairs.direction)) < 2:       # with both directions, friction of the gear is in the hysteresis
            warnings = (*loss, *warnings)
        pairs = replace(pairs, reference_nm=pairs.reference_nm / ratio, reference_sd_nm=pairs.reference_sd_nm / ratio)
    scale = {} if record is None else {"scale_rel_sd": record.recording.torque_scale_rel_sd}
    try:
        found = calibrate_pairs(pairs, confidence, reference_rel_sd=rel_sd, **scale)
    except ValueError as error:
        raise UsageError(str(error), where=str(namespace.pairs)) from None
    found = replace(found, warnings=(*found.warnings, *warnings))
    if record is None:      # no day of the measurement is known: the document is no calibration for rig.yaml
        return pairs_document(found, pairs, str(namespace.pairs), {}, {}, confidence=confidence, date=None,
                              simulated=False), None
    run = log_of_calibration(record)
    return pairs_document(
        found, pairs, str(namespace.pairs), drive_identity(record.configuration),
        drive_settings(record.configuration, record.recording), confidence=confidence, date=date_of_log(run),
        simulated=record.recording.simulated, runs=(run,)), record


def _reference_sd(namespace: argparse.Namespace) -> float | None:
    """Return the stated standard uncertainty of the sensor's scale, as a share; None if none is stated."""
    stated: float | None = namespace.reference_sd
    if stated is not None and not 0.0 <= stated < 1.0:
        raise UsageError(f"{stated:g}: must be a share from 0 to below 1", where="--reference-sd")
    return stated


def _reference(namespace: argparse.Namespace, confidence: float) -> _Found:
    from tdhil.report import working
    from tdhil.session import find_by_reference, require_file

    stated = _reference_sd(namespace)
    record = _one_log(namespace, "reference")
    require_file(namespace.reference)
    with working("comparing both torques …"):
        return find_by_reference(
            record, namespace.reference, namespace.column, namespace.at, stated, confidence), record


def _known_pipe(namespace: argparse.Namespace, confidence: float) -> _Found:
    from tdhil.report import working
    from tdhil.session import find_by_known_pipe, require_file

    record = _one_log(namespace, "known_pipe")
    require_file(namespace.known_pipe)
    with working("fitting the string …"):
        return find_by_known_pipe(record, namespace.known_pipe, confidence), record


_KINDS = {"pairs": _pairs, "reference": _reference, "known_pipe": _known_pipe}
