"""The rows of the report's tables: every estimate with its unit, and what the run was."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from tdhil.record.recording import Recording
from tdhil.report.numbers import minutes

Estimates = list[tuple[str, Mapping[str, Any], str]]

_ESTIMATES = (
    ("moment of inertia J at the motor shaft", "inertia_kg_m2", "kg·m²"),
    ("J at the main shaft", "inertia_main_shaft_kg_m2", "kg·m²"),
    ("viscous friction B", "viscous_nm_s_rad", "N·m·s/rad"),
    ("Coulomb friction T_c, constant load included", "coulomb_nm", "N·m"),
    ("lag of the reported speed", "speed_lag_s", "s"),
    ("lag of the reported torque", "torque_lag_s", "s"),
    ("delay of the torque report behind the speed report", "skew_s", "s"),
)
_COMPLIANT = (
    ("motor side J_r", "motor_inertia_kg_m2", "kg·m²"),
    ("behind the spring J_L", "load_inertia_kg_m2", "kg·m²"),
    ("J_r + J_L", "total_inertia_kg_m2", "kg·m²"),
    ("spring k", "stiffness_nm_rad", "N·m/rad"),
    ("damping c", "damping_nm_s_rad", "N·m·s/rad"),
    ("resonance", "resonance_hz", "Hz"),
    ("antiresonance", "antiresonance_hz", "Hz"),
)


def estimate_rows(document: Mapping[str, Any]) -> Estimates:
    """(what, {value, low, high}, unit) of everything that was found."""
    found: Estimates = []
    for title, key, unit in _ESTIMATES:
        part = document[key]
        if part is None or (key == "inertia_main_shaft_kg_m2" and document["gear_ratio"] == 1.0):
            continue
        if "low_total" in part:
            total = {"value": part["value"], "low": part["low_total"], "high": part["high_total"]}
            found.append((title, total, unit))
            found.append((f"{title}: repeatability, this drive", part, unit))
        else:
            found.append((title, part, unit))
    shaft = document["compliant"]
    if shaft is not None:
        found += [(title, shaft[key], unit) for title, key, unit in _COMPLIANT if shaft[key] is not None]
    return found


def fact_rows(document: Mapping[str, Any], recording: Recording) -> list[tuple[str, str]]:
    """What the run was and what the result rests on, as texts."""
    return list(_facts(document, recording))


def _facts(document: Mapping[str, Any], recording: Recording) -> Iterator[tuple[str, str]]:
    yield "model", document["model"]
    if (inertia := document["inertia_kg_m2"]) is not None:
        yield "the interval holds if", "; ".join(inertia["conditional_on"])
        yield "confidence of every interval", f"{100.0 * inertia['confidence']:g} %"
    if document["reference_inertia_kg_m2"] is not None:
        yield "reference J (rig.yaml)", f"{document['reference_inertia_kg_m2']:g} kg·m²"
    yield "gear ratio, motor to main shaft", f"{document['gear_ratio']:g}"
    yield "torque scale, 1 sd", f"{100.0 * recording.torque_scale_rel_sd:g} %"
    if (paper := document["paper"]) is not None and paper["inertia_kg_m2"] is not None:
        r2 = "" if paper["r2"] is None else f", r² {paper['r2']:.3f}"
        yield "the paper's method", f"{paper['inertia_kg_m2']:.5g} kg·m²{r2}"
        if (raw := paper["raw_rate"]["inertia_kg_m2"]) is not None:
            yield "the same at the raw rate", f"{raw:.5g} kg·m²"
    if (test := document["residual"]) is not None and test["p_value"] is not None:
        yield "residual test", f"p = {test['p_value']:.2g}, {test['degrees_of_freedom']:g} degrees of freedom"
    yield "used", f"{document['periods_used']} periods, {document['samples_used']} samples"
    if len(recording.time_s):
        length = float(recording.time_s[-1] - recording.time_s[0])
        yield "recorded", f"{len(recording.time_s)} samples in {minutes(length)}"
    if recording.excitation is not None:
        yield "excitation", f"{recording.excitation.kind} in {recording.excitation.mode} mode"
    yield "whole", "yes" if document["complete"] else "no: the log ended before the run did"
    yield "log", document["log"]
    yield "tdhil", document["tdhil"]
