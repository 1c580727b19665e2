"""A torque calibration without a body: by a reference sensor beside a log, or by a known pipe below the drive."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles import CodedText
from tdhil.errors import MessageCode, UsageError
from tdhil.file_hash import sha256_of
from tdhil.session.run_record import RunRecord
from tdhil.session.stored_calibration import drive_identity, drive_settings, refuse_rehearsal

if TYPE_CHECKING:
    from tdhil.calibration import KnownPipe
    from tdhil.recording import Recording
    from tdhil.soft_torque import StringFile, WaveLine


def log_of_calibration(record: RunRecord) -> dict[str, Any]:
    """Return log, name, hash and date of a recording, for the document of a calibration."""
    return {"log": record.log, "name": Path(record.log).name, "sha256": sha256_of(Path(record.log)),
            "date": record.configuration.get("started")}


def date_of_log(run: Mapping[str, Any]) -> str:
    """Return the date of a log, from `log_of_calibration`; the present time for a trace, which has no date."""
    return str(run["date"] or datetime.now().astimezone().isoformat(timespec="seconds"))


def gear_before(recording: Recording, at: str) -> tuple[float, tuple[str, ...]]:
    """Return the ratio of the gear between drive and sensor at the shaft ``at``, and a warning about its loss.

    While the drive turns the load, the sensor shows the torque less this loss. No key of rig.yaml states an efficiency.
    """
    ratio = recording.gear_ratio if at == "main" else 1.0
    return ratio, () if ratio == 1.0 else (CodedText(
        f"the sensor is behind a gear of {ratio:g}: the loss of the gear is in the factor, and not in its interval."
        " Measure at the motor shaft, or note pairs with rising and with falling torque at standstill",
        MessageCode.GEAR_LOSS_IN_FACTOR),)


def find_by_reference(
    record: RunRecord, trace: Path, columns: Sequence[str] | None, at: str, reference_rel_sd: float | None,
    confidence: float,
) -> dict[str, Any]:
    """Return the document of the calibration by a reference sensor.

    ``columns``: columns of the trace, as `QUANTITY=NAME:UNIT`; ``at``: the sensor's shaft. Raises UsageError and
    CsvUnusable for a trace that is not usable, NothingRecorded for a log without motion.
    """
    from tdhil.calibration import TorqueRecord, calibrate_reference, scale_of_reference
    from tdhil.recording import REFERENCE_FLAG, TIME_AND_TORQUE, parse_columns, read_reference
    from tdhil.report import reference_document

    record.require_motion()
    refuse_rehearsal(record)
    recording = record.recording
    sensor = read_reference(trace, parse_columns(columns or (), TIME_AND_TORQUE, REFERENCE_FLAG))
    ratio, loss = gear_before(recording, at)
    rel_sd, assumed = scale_of_reference(reference_rel_sd)
    good = recording.fresh
    drive = TorqueRecord(recording.time_s[good], recording.torque_nm[good] - recording.torque_offset_nm,
                         recording.torque_resolution_nm)
    try:
        found = calibrate_reference(
            drive, TorqueRecord(sensor.time_s, sensor.torque_nm / ratio), reference_rel_sd=rel_sd,
            scale_rel_sd=recording.torque_scale_rel_sd, confidence=confidence)
    except ValueError as error:
        raise UsageError(str(error), where=str(trace)) from None
    if found.series is not None:
        found = replace(found, series=replace(found.series, time_s=found.series.time_s - float(recording.time_s[0])))
    digest = sha256_of(trace)
    run = log_of_calibration(record)
    return reference_document(
        found, {"file": str(trace), "sha256": digest, "at": at, "rel_sd": rel_sd}, (run,),
        drive_identity(record.configuration), drive_settings(record.configuration, recording),
        date=date_of_log(run), confidence=confidence,
        simulated=recording.simulated, warnings=[*found.warnings, *loss, *sensor.warnings, *assumed])


# ---------------------------------------------------------------------------------------------------------------------
# A pipe of known sizes.


DENSITY_TOLERANCE = 0.005
"""Relative half-width of the density of steel, if it is not stated: 7,810 to 7,890 kg/m³."""
_STEP = 1e-4


def known_pipe_of(file: StringFile, gear_ratio: float) -> KnownPipe:
    """Return impedance and travel time of the string's one section at the motor shaft, with its tolerances.

    Raises ValueError for more than one section, or one without a length.
    """
    from tdhil.calibration import KnownPipe, PipeInput
    from tdhil.soft_torque import ToleranceFile, line_of, string_of

    if len(file.sections) != 1 or file.sections[0].length_m is None:
        raise ValueError("a known pipe is one section with length_m, from the drive down to the bottom-hole assembly")
    section = file.sections[0]
    line = line_of(section)

    def sensitivity(name: str) -> tuple[float, float]:
        """Return the relative sensitivities of ζ and T to one size of the pipe's body."""
        size = float(getattr(section, name))
        ends = [line_of(section.model_copy(update={name: size * (1.0 + sign * _STEP)})) for sign in (1.0, -1.0)]
        impedance, delay = ([value(one) for one in ends] for value in (_impedance_of, _delay_of))
        low, high = ((math.log(pair[0]) - math.log(pair[1])) / (2.0 * _STEP) for pair in (impedance, delay))
        return low, high

    stated = file.tolerance or ToleranceFile()
    tolerance = string_of(file).tolerance
    density = DENSITY_TOLERANCE if stated.density is None else stated.density
    inputs = [
        PipeInput("shear modulus of the pipe", *tolerance.shear, *sensitivity("shear_modulus_pa")),
        PipeInput("density of the pipe", 1.0 - density, 1.0 + density, *sensitivity("density_kg_m3")),
        PipeInput("length of the pipe", 1.0 - stated.length, 1.0 + stated.length, *sensitivity("length_m")),
    ]
    measured = stated.outer_diameter is not None or stated.inner_diameter is not None
    for source, half, name in (("outer diameter of the pipe", stated.outer_diameter, "outer_diameter_m"),
                               ("inner diameter of the pipe", stated.inner_diameter, "inner_diameter_m")):
        if half is not None:
            inputs.append(PipeInput(source, 1.0 - half, 1.0 + half, *sensitivity(name)))
    if not measured or "wear" in stated.model_fields_set:
        inputs.append(PipeInput("wear of the pipe", 1.0 - stated.wear, 1.0, 1.0, 0.0))
    return KnownPipe(line.impedance_nm_s_rad / gear_ratio**2, line.delay_s, tuple(inputs))


def _impedance_of(line: WaveLine) -> float:
    return line.impedance_nm_s_rad


def _delay_of(line: WaveLine) -> float:
    return line.delay_s


def find_by_known_pipe(record: RunRecord, path: Path, confidence: float) -> dict[str, Any]:
    """Return the document of the calibration by the pipe in ``path`` (string.yaml). Raises UsageError for another
    string.
    """
    from profiles import load_model
    from tdhil.calibration import calibrate_known_pipe
    from tdhil.estimation import Refused, measure_string
    from tdhil.recording import Pipe, before_abort
    from tdhil.report import known_pipe_document
    from tdhil.soft_torque import StringFile

    record.require_motion()
    refuse_rehearsal(record)
    recording = before_abort(record.recording)
    try:
        known = known_pipe_of(load_model(path, StringFile), recording.gear_ratio)
    except ValueError as error:
        raise UsageError(str(error), where=str(path), next_step="docs/reference/string.md explains the file") from None
    pipe = Pipe(known.impedance_nm_s_rad * known.delay_s, known.impedance_nm_s_rad / known.delay_s, 1.0)
    found, measured, refusal = None, None, ("", "")
    delay_sd = max(known.delay_rel_sd, _LEAST_DELAY_REL_SD)
    try:
        measured = measure_string(recording, pipe, delay_sd, known.exponent, confidence)
        found = calibrate_known_pipe(known, measured, scale_rel_sd=recording.torque_scale_rel_sd, confidence=confidence)
    except Refused as refused:
        refusal = f"the log can't be used: {refused.refusal.reason}", refused.refusal.advice
    run = log_of_calibration(record)
    return known_pipe_document(
        found, measured, known, refusal, {"file": str(path), "sha256": sha256_of(path)}, (run,),
        drive_identity(record.configuration), drive_settings(record.configuration, recording),
        date=date_of_log(run), confidence=confidence,
        simulated=recording.simulated)


_LEAST_DELAY_REL_SD = 0.003
"""Least relative standard deviation of a stated travel time, so that it does not outweigh the data."""
