"""JSON document: it contains every part, with units in the names, and only numbers that are valid JSON."""

import json
import math
from dataclasses import replace

import pytest

from tdhil.fleet import FleetRow
from tdhil.fleet.trend import _settings
from tdhil.report.blocks import _run_rows
from tdhil.report.calibration_page import calibrated_item
from tdhil.report.card import COMPLIANT, compliant_rows, estimate_text, quoted
from tdhil.report.document import result_document
from tests.report.findings import bare, full, open_sided, recording

NAMES = {key: title for title, key, _ in COMPLIANT}
UNITS = {key: unit for _, key, unit in COMPLIANT}


@pytest.mark.parametrize("make", [full, bare, open_sided])
def test_it_is_json(make):
    document = result_document(make(), recording(), {}, "run.mcap")
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_a_revision_is_written_in_hexadecimal_as_in_the_manual_of_the_drive():
    """65536 is 10000h in the report of a run, on the page of a calibration, and in a comparison."""
    drive = {"vendor": 0x2A, "product": 402, "revision": 65536, "serial": 7, "name": "EPOS4"}
    document = result_document(bare(), recording(), {"identity": drive}, "run.mcap")
    assert dict(_run_rows(document, recording()))["identity"] == "vendor 2Ah, product 192h, revision 10000h"
    (identity,) = calibrated_item({"drive": drive, "settings": {}}).blocks
    assert ("revision", "10000h") in identity.rows
    row = FleetRow("run.mcap", "valid", drive_revision=65536)
    assert _settings(row, document, recording(), {})["revision"] == "10000h"


def test_every_part_is_in_it():
    document = result_document(full(), recording(), {}, "run.mcap")
    assert [line["source"] for line in document["budget"]] == ["noise", "lags", "torque scale"]
    assert document["budget"][0]["half_width_kg_m2"] == 0.31
    assert [(o["route"], o["agrees"]) for o in document["second_opinions"]] == [
        ("speed change", True), ("coast-down", False)
    ]
    assert document["second_opinions"][0]["inertia_kg_m2"].keys() == {"value", "low", "high"}
    assert document["friction_curve"][0] == {
        "speed_rad_s": 2.9, "torque_nm": {"value": 83.1, "low": 81.6, "high": 84.6}
    }
    shaft = document["compliant"]
    assert shaft["motor_inertia_kg_m2"]["value"] == 104.0
    assert shaft["total_inertia_kg_m2"]["value"] == 130.0
    assert shaft["damping_nm_s_rad"] is None
    assert shaft["covariance"] is None       # of a result without it
    assert [line["hertz"] for line in document["lines"]] == [0.1, 0.2, 0.3, 0.4]


def test_all_quantities_that_are_proportional_to_torque_include_its_scale():
    """J_r + J_L stood without it, below a J that includes it."""
    found = replace(full(), torque_scale_rel_sd=0.02)
    document = result_document(found, recording(), {}, "run.mcap")
    for name in ("load_inertia_kg_m2", "total_inertia_kg_m2", "stiffness_nm_rad"):
        part = document["compliant"][name]
        assert part["high_total"] - part["value"] == pytest.approx(
            math.hypot(part["high"] - part["value"], 1.96 * 0.02 * part["value"]), rel=1e-3)
        (text,) = (str(value) for title, value in compliant_rows(document) if NAMES[name] in title)
        assert text == estimate_text(quoted(part), UNITS[name])


def test_the_interval_to_quote_goes_before_the_repeatability():
    document = result_document(full(), recording(gear_ratio=2.0), {}, "run.mcap")
    inertia = document["inertia_kg_m2"]
    first = ["value", "low_total", "high_total", "half_width_total_rel", "low", "high"]
    assert list(inertia)[: len(first)] == first
    assert inertia["half_width_total_rel"] == pytest.approx(4.1 / 104.0)
    assert inertia["repeatability_rel"] == pytest.approx(0.45 / 104.0)
    assert list(document["inertia_main_shaft_kg_m2"]) == ["value", "low_total", "high_total", "low", "high"]


def test_a_refusal_has_the_same_keys_with_nothing_in_them():
    empty = result_document(bare(), recording(), {}, "run.mcap")
    assert empty.keys() == result_document(full(), recording(), {}, "run.mcap").keys()
    assert empty["budget"] == empty["second_opinions"] == empty["friction_curve"] == empty["lines"] == []
    assert empty["compliant"] is None


SETTING = {"title": "25.02 gain", "where": "register 1", "raw": 12.0, "value": 1.2, "unit": "nm_s_rad",
           "confidence": "likely"}


def test_gains_that_the_drive_reported_are_in_it():
    run = {"speed_loop_present": {"gain": SETTING, "integral": None, "filter": None, "gain_nm_s_rad": 1.2,
                                  "integral_nm_rad": None, "filter_s": None}}
    document = result_document(full(), recording(), run, "run.mcap")
    assert document["speed_loop_present"] == {
        "gain_nm_s_rad": 1.2, "integral_nm_rad": None, "filter_s": None, "settings": {"gain": SETTING}}


@pytest.mark.parametrize("stated", [
    None, 3, "none", [], {}, {"gain": 5, "gain_nm_s_rad": 1.0}, {"gain": None, "integral": None, "filter": None},
])
def test_a_log_without_them_gives_null(stated):
    document = result_document(full(), recording(), {"speed_loop_present": stated}, "run.mcap")
    assert document["speed_loop_present"] is None


def test_their_values_in_a_log_are_checked():
    run = {"speed_loop_present": {
        "gain": {"title": "a\nb\x1b", "where": 7, "raw": "12", "value": float("nan"), "unit": True},
        "gain_nm_s_rad": -3.0, "integral_nm_rad": "4", "filter_s": True}}
    found = result_document(full(), recording(), run, "run.mcap")["speed_loop_present"]
    assert [found[name] for name in ("gain_nm_s_rad", "integral_nm_rad", "filter_s")] == [None] * 3
    assert found["settings"]["gain"] == {
        "title": "a b", "where": "", "unit": "", "confidence": "", "raw": None, "value": None}
