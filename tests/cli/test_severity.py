"""`tdhil severity` from CSV: one record, two records, width of the card, page, and usage errors."""

from __future__ import annotations

import json
import re
from math import sqrt
from pathlib import Path

import numpy as np
import pytest

from tdhil.cli.main import main
from tdhil.errors import MessageCode
from tdhil.soft_torque import reflection_at
from tests.cli.test_tune import estimate, result
from tests.soft_torque.cases import DRIVE, SOFT_035, STRING

STRING_YAML = Path(__file__).parents[2] / "examples" / "string.yaml"
MOTOR = ("--gear", "10")


@pytest.fixture
def bench(tmp_path):
    """Write two records of a motor with a gear of 10: oscillation of 5.6 kN·m with 8.16 s, and a tenth of it."""
    (tmp_path / "result.json").write_text(json.dumps(result(torque_lag_s=None)), encoding="utf-8")
    time_s = 0.05 * np.arange(6000)
    swing = np.sin(2.0 * np.pi * time_s / 8.16)
    for name, torque_nm in (("before", 5600.0), ("after", 560.0)):
        np.savetxt(tmp_path / f"{name}.csv",
                   np.column_stack([time_s, 10.0 * (10.5 - 1e-5 * torque_nm * swing),
                                    0.1 * (3000.0 + torque_nm * swing)]),
                   delimiter=",", header="time_s,speed_rad_s,torque_nm", comments="", fmt="%.5f")
    return tmp_path


def ran(bench, capsys, *words):
    code = main(["severity", str(bench / "before.csv"), "--result", str(bench / "result.json"),
                 "--string", str(STRING_YAML), *MOTOR, *words])
    return (code, *capsys.readouterr())


def test_one_record(bench, capsys):
    code, out, _ = ran(bench, capsys, "--json")
    assert code == 0
    (found,) = json.loads(out)["records"]
    assert found["level"] == "stick-slip"
    assert found["period_s"]["value"] == pytest.approx(8.16, rel=0.005)
    assert found["bit_noise"] is None and "without stick-slip" in found["bit_noise_refused"]
    # ω_b = τ/ζ sin ΩT, by hand
    assert found["downhole_swing_rpm"]["value"] == pytest.approx(
        5600.0 / 296.5 * np.sin(2.0 * np.pi / 8.16 * 0.944) * 30.0 / np.pi, rel=0.05)


def test_a_calibrated_result_calibrates_the_record_once(bench, capsys):
    """J of a calibrated result is in true kg·m², and the record in the drive's own N·m: half-swings were 5 % wrong."""
    swings = {}
    for name, factor, inertia in (("true", 1.0, 15.0), ("calibrated", 0.95, 0.95 * 15.0)):
        (bench / "result.json").write_text(json.dumps(result(
            inertia_kg_m2=estimate(inertia, 0.99 * inertia, 1.01 * inertia), torque_scale_rel_sd=0.0,
            torque_calibration={"factor": factor, "rel_sd": 0.0})), encoding="utf-8")
        swings[name] = json.loads(ran(bench, capsys, "--json")[1])["records"][0]["string_torque_swing_nm"]["value"]
    assert swings["calibrated"] == pytest.approx(0.95 * swings["true"], rel=1e-9)


def test_the_torque_scale_is_in_the_interval_of_torque_and_downhole_speed(bench, capsys):
    found = []
    for rel_sd in (0.0, 0.02):
        (bench / "result.json").write_text(json.dumps(result(torque_scale_rel_sd=rel_sd)), encoding="utf-8")
        found += json.loads(ran(bench, capsys, "--json")[1])["records"]
    for name in ("string_torque_swing_nm", "downhole_swing_rpm"):
        exact, wide = (one[name] for one in found)
        assert wide["value"] == exact["value"]
        for end in ("low", "high"):
            added = sqrt((wide[end] - wide["value"]) ** 2 - (exact[end] - exact["value"]) ** 2)
            assert added == pytest.approx(1.96 * 0.02 * wide["value"], rel=0.05), (name, end)


def test_the_printed_intervals_contain_those_of_the_document(bench, capsys):
    (found,) = json.loads(ran(bench, capsys, "--json")[1])["records"]
    card = " ".join(ran(bench, capsys)[1].split())
    for name, key in (("severity index", "severity_index"), ("downhole speed", "downhole_swing_rpm"),
                      ("string torque", "string_torque_swing_nm"), ("oscillation every", "period_s")):
        (ends,) = re.findall(rf"{name} [^(]*\(±?([\d.]+) to ±?([\d.]+)\)", card)
        assert float(ends[0]) <= found[key]["low"] <= found[key]["high"] <= float(ends[1]), name


def test_j_of_a_rehearsal_marks_the_values_derived_from_it(bench, capsys):
    rehearsed = result(torque_lag_s=None) | {"simulated": True, "rehearsed_faults": ["torque-scale=1.1"]}
    (bench / "result.json").write_text(json.dumps(rehearsed), encoding="utf-8")
    assert "· SIMULATED · FAULT REHEARSAL" in " ".join(ran(bench, capsys)[1].split())


@pytest.mark.parametrize("option", ["--excitation", "--motion-kind", "--motion-lines"])
def test_options_of_a_motion_are_not_accepted(bench, capsys, option):
    """A record of normal drilling has no periodic motion, so no motion is fitted."""
    code, _, err = ran(bench, capsys, option, "sine")
    assert code == 2 and f"there is no option {option}" in err


@pytest.mark.heavy
def test_two_records_side_by_side_in_80_columns_and_as_a_page(bench, capsys):
    code, out, err = ran(bench, capsys, "--against", str(bench / "after.csv"), "--report", str(bench / "page.html"))
    assert code == 0
    assert max(len(line) for line in out.splitlines()) <= 80
    words = " ".join(out.split())
    assert "stick-slip 100 → 0 % of the time" in words and "before after" in words
    assert "--torque-lag" in words
    assert "report: " in err
    page = (bench / "page.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 4 and "Severity index" in page


@pytest.mark.parametrize(("change", "code", "message"), [
    ({"verdict": "not_identifiable", "inertia_kg_m2": None}, 11, "the result has no J"),
    # with J of motor and string, the bit noise was 40 % too large, and its interval excluded the truth
    ({"warning_codes": [MessageCode.STRING_MOVES_WITH_MOTOR.code]}, 11, "motor and string together"),
    ({}, 2, "a controller"),
])
def test_usage_errors(bench, capsys, change, code, message):
    (bench / "result.json").write_text(json.dumps(result(**change)), encoding="utf-8")
    other = bench / "tune.json"
    other.write_text(json.dumps({"main_shaft": {}, "string": {}, "controllers": [], "identified": {}}))
    words = () if change else ("--controller", str(other))
    seen, _, err = ran(bench, capsys, *words)
    assert seen == code
    assert message in err or "no soft controller" in err
    assert "Traceback" not in err


def controller_file(bench, refused=""):
    """Write the output of `tune --json` for one soft controller, a = 0.35 of the reference case."""
    main = {"inertia_kg_m2": {"value": 1500.0, "low": 1440.0, "high": 1560.0}, "viscous_nm_s_rad": 8.0,
            "coulomb_nm": 60.0, "inner_lags_s": [0.02, 0.01, 0.003]}
    gains = {"gain_nm_s_rad": 847.1, "integral_nm_rad": 705.1, "compensated_kg_m2": 0.0, "derivative_filter_s": 0.05}
    path = bench / "tune.json"
    path.write_text(json.dumps({
        "main_shaft": main, "string": {}, "identified": {}, "tuned_for": {},
        "controllers": [{"kind": "soft", "refused": refused or None, "at_main_shaft": gains}]}), encoding="utf-8")
    return "--controller", str(path)


def test_the_reflection_of_the_record_is_compared_with_that_of_the_gains(bench, capsys):
    """The top of the record hardly moves and reflects nearly all of a wave, unlike a top with soft gains."""
    code, out, err = ran(bench, capsys, *controller_file(bench), "--json")
    assert code == 0, err
    (found,) = json.loads(out)["records"]
    hertz = np.array([0.5 * (found["reflection"]["from_hz"] + found["reflection"]["to_hz"])])
    assert found["reflection"]["expected"] == pytest.approx(reflection_at(DRIVE, SOFT_035, STRING, hertz)[0], abs=0.02)
    assert found["reflection"]["verdict"] == "reflects more"
    code, _, err = ran(bench, capsys, *controller_file(bench, refused="too little margin"))
    assert code == 2 and "no soft controller" in err


def test_a_frozen_signal_is_left_out_with_a_warning(bench, capsys):
    rows = np.loadtxt(bench / "before.csv", delimiter=",", skiprows=1)
    rows[3000:, 2] = rows[3000, 2]
    np.savetxt(bench / "before.csv", rows, delimiter=",", header="time_s,speed_rad_s,torque_nm", comments="")
    code, out, _ = ran(bench, capsys, "--json")
    assert code == 0
    (said,) = (one for one in json.loads(out)["warnings"] if "did not change" in one)
    assert said.startswith("before.csv: The reported torque did not change for 150 s, first at 150 s.")


def test_a_record_at_standstill_is_refused(bench, capsys):
    still = np.column_stack([0.05 * np.arange(3000), np.zeros(3000), np.full(3000, 5.0)])
    np.savetxt(bench / "before.csv", still, delimiter=",", header="time_s,speed_rad_s,torque_nm", comments="")
    code, _, err = ran(bench, capsys)
    assert code == 9
    assert "does not turn steadily" in err and "TDH-925" in err
