"""`tdhil severity`: stick-slip and torsional oscillation in a recording of normal drilling; nothing moves."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.cli.arguments import add_option
from tdhil.cli.evaluate import CONTROLLERS
from tdhil.cli.replay import add_trace_arguments, check_trace, read_recorded
from tdhil.cli.report_file import ReportFile, add_head_options, add_report_option
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.errors import ExitCode, MessageCode, UsageError

if TYPE_CHECKING:
    from tdhil.recording import Recording
    from tdhil.soft_torque import (
        BitNoiseEstimate,
        Interval,
        Severity,
        SpeedController,
        SurfaceRecord,
        TopDrive,
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of severity."""
    parser.add_argument("log", type=Path, metavar="run.mcap|trace.csv",
                        help="torque and speed of the top drive during rotation: a log, or a trace in CSV")
    parser.add_argument("--result", type=Path, required=True, metavar="result.json|run.mcap",
                        help="result of tdhil identify for this top drive: J, and the lags of its reported signals")
    parser.add_argument("--string", type=Path, metavar="string.yaml",
                        help="drill string (reference/string.md); without it, k and J_L of the result are used")
    parser.add_argument("--against", type=Path, metavar="LATER",
                        help="a second record, for example after tuning: both are shown side by side")
    parser.add_argument("--controller", type=Path, metavar="tune.json",
                        help="result of tdhil tune --json: checks that the reflection in the last record is that of "
                             "these gains")
    parser.add_argument("--use", choices=CONTROLLERS, default="soft", help="controller in that file (default soft)")
    add_option(parser, OPTION["json"])
    add_report_option(parser, "severity")
    add_head_options(parser)
    add_trace_arguments(parser, motion=False)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Read, assess, print."""
    from tdhil.cli.tune_inputs import inertia_warnings, read_result
    from tdhil.cli.tune_soft_torque import string_for
    from tdhil.report import (
        PlainConsole,
        print_severity,
        rehearsed_faults,
        severity_document,
        severity_report,
        working,
    )
    from tdhil.session import require_file
    from tdhil.soft_torque import SeverityRefused, bit_noise_in, severity

    check_trace(namespace)
    paths = [namespace.log] if namespace.against is None else [namespace.log, namespace.against]
    report = ReportFile.of_files(namespace, *paths)
    with working("reading the result …"):
        result = read_result(namespace.result)
    ratio, inertia = _inertia(result, namespace)
    string = string_for(result, namespace, ratio).string
    expected = None if namespace.controller is None else _expected(namespace)
    found: list[tuple[Severity, str]] = []
    noises: list[BitNoiseEstimate | str] = []
    warnings = inertia_warnings(result)
    faults = [str(one) for one in result.get("rehearsed_faults") or ()]      # those of the run that gave J
    simulated = bool(faults)
    configurations = []
    for path in paths:
        require_file(path)
        recorded = read_recorded(namespace, path, paths)
        warnings += [f"{path.name}: {one}" for one in (*(recorded.assumed or ()), *recorded.problems)]
        record, remarks = _surface(recorded.recording, result, namespace)
        warnings += remarks
        with working("computing the downhole speed …"):
            found.append((severity(record, string, inertia, expected if path == paths[-1] else None), str(path)))
            warnings += [f"{path.name}: {one}" for one in found[-1][0].left_out]
            try:
                noises.append(bit_noise_in(record, string, inertia))
            except SeverityRefused as refused:     # a text states why the record does not determine the bit noise
                noises.append(str(refused))
        simulated |= recorded.recording.simulated
        faults += rehearsed_faults(recorded.configuration)
        configurations.append(recorded.configuration)
    document = severity_document(found, noises, string, inertia, simulated=simulated,
                                 rehearsed_faults=faults,
                                 warnings=tuple(dict.fromkeys(warnings)))
    if namespace.json:
        print_json(document)
    else:
        print_severity(document, PlainConsole())
    if report is not None:
        report.write(severity_report(document, [one for one, _ in found]), configurations)
    return int(ExitCode.OK)


def _inertia(result: Mapping[str, Any], namespace: argparse.Namespace) -> tuple[float, Interval]:
    """Return the gear ratio, and J at the main shaft with its interval. Raises TuningRefused without J."""
    from tdhil.cli.tune_inputs import inertia_to_tune_for
    from tdhil.soft_torque import Interval, TuningRefused

    low, value, high = inertia_to_tune_for(result, namespace.result, TuningRefused)
    ratio = float(result["gear_ratio"])
    return ratio, Interval(*(ratio**2 * one for one in (value, low, high)))


def _surface(
    recording: Recording, result: Mapping[str, Any], namespace: argparse.Namespace
) -> tuple[SurfaceRecord, list[str]]:
    """Return the record at the main shaft, with the lags of its reports, and warnings.

    Its torque is read in the drive's own N·m. J of a calibrated result is not, so the result's calibration is applied.
    """
    import numpy as np

    from tdhil.cli.tune_inputs import COVERAGE, calibration_factor
    from tdhil.estimation import normal_quantile
    from tdhil.soft_torque import SurfaceRecord

    good = recording.fresh & np.isfinite(recording.speed_rad_s) & np.isfinite(recording.torque_nm)
    time_s = recording.time_s[good]
    kept = np.concatenate([[True], np.diff(time_s) > 0.0]) if len(time_s) else np.zeros(0, dtype=bool)
    recorded = namespace.gear_ratio is not None or recording.gear_ratio != 1.0
    ratio = recording.gear_ratio if recorded else result["gear_ratio"]
    lags, remarks = [], []
    for name, own in (("speed_lag_s", recording.lag_prior.speed_lag_s),
                      ("torque_lag_s", recording.lag_prior.torque_lag_s)):
        stated = result.get(name)
        value = stated.get("value") if isinstance(stated, dict) else None
        if getattr(namespace, name) is not None or value is None:
            value = own
        if value is None:
            remarks.append(f"The lag of the reported {name.split('_')[0]} is not known and counts as 0: state it with "
                        f"--{name.removesuffix('_s').replace('_', '-')}.")
        lags.append(max(0.0, float(value or 0.0)))
    stated = result.get("torque_scale_rel_sd")
    wide = normal_quantile(COVERAGE) * (
        float(stated) if isinstance(stated, int | float) else recording.torque_scale_rel_sd)
    return SurfaceRecord(time_s[kept], recording.speed_rad_s[good][kept] / ratio, calibration_factor(result)
                         * recording.torque_nm[good][kept] * ratio, lags[0], lags[1], (1.0 - wide, 1.0 + wide)), remarks


def _expected(namespace: argparse.Namespace) -> tuple[TopDrive, SpeedController]:
    """Return top drive and controller of the tuning. Raises UsageError if the file has no such controller."""
    from tdhil.session import load_tuning
    from tdhil.soft_torque import SpeedController, TopDrive

    tuning = load_tuning(namespace.controller)
    chosen = next((one for one in tuning["controllers"] if one["kind"] == namespace.use), None)
    if chosen is None or chosen["refused"]:
        held = ", ".join(one["kind"] for one in tuning["controllers"] if not one["refused"])
        raise UsageError(f"it contains no {namespace.use} controller", where=str(namespace.controller),
                         next_step=f"--use one of: {held}", entry=MessageCode.NOT_A_TUNING)
    main = tuning["main_shaft"]
    return (TopDrive(main["inertia_kg_m2"]["value"], main["viscous_nm_s_rad"], main["coulomb_nm"],
                     tuple(main["inner_lags_s"])), SpeedController(**chosen["at_main_shaft"]))
