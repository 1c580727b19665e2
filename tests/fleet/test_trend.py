"""`tdhil trend` and `tdhil compare`, from rows and logs to sentences."""

import json
import re
import subprocess
import sys
from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pytest

from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.fleet.change_detection import Difference
from tdhil.fleet.rows import FleetRow, FleetSettings, row_from_json, row_of
from tdhil.fleet.table import write_table
from tdhil.fleet.trend import _change_text, _differences, scale_of, trend_document
from tests.fleet.drawn_histories import draw


def rows(kind, count=24, serial=7):
    results, at = draw(np.random.default_rng(12), kind, count)
    return [
        FleetRow(
            f"R7-{k:02d}.mcap", "valid", rig="R7", date=f"2026-01-{k + 1:02d}T08:00:00+00:00", simulated=False,
            inertia_kg_m2=one.value, inertia_low_kg_m2=one.low, inertia_high_kg_m2=one.high, confidence=0.95,
            torque_scale_rel_sd=0.03, drive_vendor=1, drive_product=2, drive_serial=serial, speed_lag_s=0.4,
            speed_lag_low_s=0.39, speed_lag_high_s=0.41)
        for k, one in enumerate(results)
    ], at


@pytest.fixture
def table(tmp_path):
    found, _ = rows("step 5 %")
    write_table([*found, FleetRow("other.mcap", "valid", rig="R8")], tmp_path / "fleet.csv")
    return tmp_path / "fleet.csv"


def test_a_step_is_reported_with_its_place_and_size():
    found, at = rows("step 5 %")
    document = trend_document(found[::-1], "R7")
    inertia, lag = document["quantities"][0], document["quantities"][3]
    (change,) = inertia["changes"]
    assert (change["before"], change["after"]) == (f"R7-{at - 1:02d}.mcap", f"R7-{at:02d}.mcap")
    assert change["change"]["low"] < 0.05 < change["change"]["high"]
    assert "changed by +" in inertia["text"]
    assert f"between 2026-01-{at:02d}" in inertia["text"]
    assert lag["changes"] == []
    assert "no change is named: that there was none is 9" in lag["text"]
    assert f"between 2026-01-{at:02d} and 2026-01-{at + 1:02d} (" in inertia["text"]
    assert document["quantities"][1]["text"].startswith("0 results: 4 are needed")
    assert document["notes"] == []
    json.dumps(document, allow_nan=False)


def test_a_rehearsed_fault_is_no_history():
    """A rehearsed torque scale of 1.1 used to be reported as a change of J with more than 99.9 % probability."""
    found, _ = rows("none")
    rehearsed = [
        replace(one, log=f"fault-{one.log}", rehearsed_faults="torque-scale=1.1",
                inertia_kg_m2=1.1 * one.inertia_kg_m2, inertia_low_kg_m2=1.1 * one.inertia_low_kg_m2,
                inertia_high_kg_m2=1.1 * one.inertia_high_kg_m2)
        for one in found[12:]
    ]
    document = trend_document([*found, *rehearsed], "R7")
    assert document["quantities"] == trend_document(found, "R7")["quantities"]
    assert document["notes"] == ["12 rehearsals of faults on the simulated drive: left out"]


def test_a_result_from_a_part_of_a_run_is_no_history():
    """Six runs that a fault ended give a result 10 % higher. It used to be reported as a change of the rig."""
    found, _ = rows("none")
    ends = {"aborted_stage": "acquire", "aborted_by": "DriveFault"}
    parts = [replace(one, log=f"part-{one.log}", **({"complete": False} if k == 5 else ends),
                     inertia_kg_m2=1.1 * one.inertia_kg_m2, inertia_low_kg_m2=1.1 * one.inertia_low_kg_m2,
                     inertia_high_kg_m2=1.1 * one.inertia_high_kg_m2)
             for k, one in enumerate(found[18:])]
    document = trend_document([*found, *parts], "R7")
    assert document["quantities"] == trend_document(found, "R7")["quantities"]
    (note,) = document["notes"]
    assert note.startswith(f"6 results from a part of the run ({parts[0].log}: aborted in stage acquire (DriveFault), ")
    assert note.endswith(", and 1 more): left out")
    (one,) = trend_document([*found, parts[5]], "R7")["notes"]
    assert one == f"1 result from a part of the run ({parts[5].log}: log cut short): left out"


def test_a_trend_loads_only_what_it_needs():
    """A page of the service waits for it. It used to load the estimation for one quantile, which was slow."""
    script = """
import sys
from tdhil.fleet import FleetRow, trend_document
rows = [FleetRow(str(k), "valid", rig="R", date=f"2026-05-0{k}T12:00:00+00:00", inertia_kg_m2=value,
                 inertia_low_kg_m2=value - 1.0, inertia_high_kg_m2=value + 1.0)
        for k, value in enumerate([104.0] * 4 + [144.0] * 4, 1)]
trend_document(rows)["quantities"][0]["changes"][0]
print([one for one in ("tdhil.estimation", "tdhil.fleet.task", "pydantic", "numpy.ma", "scipy") if one in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr


def test_logs_of_two_drives_are_never_one_series():
    """Two benches with one name and J 104 and 140 used to be reported as one rig with a change of 35 %."""
    found, _ = rows("none")
    other = [replace(one, date=f"2025{one.date[4:]}", drive_serial=9, inertia_kg_m2=1.35 * one.inertia_kg_m2,
                     inertia_low_kg_m2=1.35 * one.inertia_low_kg_m2, inertia_high_kg_m2=1.35 * one.inertia_high_kg_m2)
             for one in found]
    document = trend_document([*found, *other], "R7")
    assert document["quantities"] == trend_document(found, "R7")["quantities"]
    (note,) = document["notes"]
    assert "2 drives" in note and "24 results of serial number 9" in note
    profiles = trend_document([*found, *(replace(one, drive_serial=None, profile="other") for one in other)], "R7")
    assert profiles["quantities"] == document["quantities"]
    same_drive = trend_document([*found, *(replace(one, drive_serial=found[0].drive_serial, profile="other")
                                           for one in other)], "R7")
    assert same_drive["quantities"] == document["quantities"]      # another profile has another torque signal


def test_inertias_of_different_bodies_are_never_one_series():
    """A rigid shaft gives J of motor and load, a compliant one J_r. A mixture of both is no step of J."""
    found, _ = rows("none")
    mixed = [replace(one, inertia_scope="motor_and_load" if k < 12 else "motor_side",
                     inertia_kg_m2=one.inertia_kg_m2 * (1.0 if k < 12 else 0.8),
                     inertia_low_kg_m2=one.inertia_low_kg_m2 * (1.0 if k < 12 else 0.8),
                     inertia_high_kg_m2=one.inertia_high_kg_m2 * (1.0 if k < 12 else 0.8))
             for k, one in enumerate(found)]
    document = trend_document(mixed, "R7")
    inertia, lag = document["quantities"][0], document["quantities"][3]
    assert (len(inertia["points"]), inertia["changes"], len(lag["points"])) == (12, [], 24)
    (note,) = document["notes"]
    assert "2 kinds of J (J of motor and load together, J_r, the motor's side of a compliant shaft)" in note

    told = _differences(mixed[0], mixed[-1])
    assert "inertia_kg_m2" not in {one["column"] for one in told["quantities"]}
    assert told["text"].startswith("the inertias can't be compared: R7-00.mcap has J of motor and load together, and")
    assert "the inertias" in _differences(mixed[0], mixed[1])["text"]


def test_the_interval_of_a_change_is_rounded_outwards():
    assert _change_text(Difference(0.0212, 0.02046, 0.02194, 0.95, True, True, 1.0), "kg·m²") == (
        "+2.12 % (+2.04 % to +2.20 %)")
    assert _change_text(Difference(0.01, -0.00123456, 0.0234561, 0.95, False, True, 0.9), "s") == (
        "+0.01 (-0.00124 to +0.02346) s")


def test_a_rig_without_a_name_is_known_by_no_file_name():
    """Every folder may have its own rig.yaml. Two of them are not the same rig."""
    document = {"verdict": "valid", "reason": "", "rig": {"name": None, "file": "rig.yaml"}}
    assert row_of("run.mcap", document, settings=FleetSettings()).rig is None


def test_omissions_and_assumptions_are_stated():
    found, _ = rows("drift 5 %", serial=0)
    odd = [replace(found[0], verdict="model_rejected"), replace(found[1], date=None), replace(found[2], simulated=True)]
    document = trend_document([*odd, *found[3:]], "R7")
    assert "drifts by +" in document["quantities"][0]["text"]
    assert [note.split(":")[0] for note in document["notes"]] == [
        "1 of 24 logs without a result that stands", "1 log without a date",
        "2 drives or profiles under this name", "the drive reports no serial number"]
    assert "Left out: 1 result of no serial number, SIMULATED." in document["notes"][2]
    two = trend_document([*found[:12], *(replace(row, drive_serial=9) for row in found[12:])], "R7")
    assert any("2 drives" in note for note in two["notes"])
    assert trend_document(found)["rig"] == "R7"      # the only one
    with pytest.raises(UsageError, match=r"none is named.*There are: R7, R8"):
        trend_document([*found, FleetRow("other.mcap", "valid", rig="R8")])
    with pytest.raises(UsageError, match="No log in the table names its rig"):
        trend_document([FleetRow("other.mcap", "valid")])
    with pytest.raises(UsageError, match="There are: R7"):
        trend_document(found, "R9")


@pytest.mark.parametrize("serial", [0, 7])
def test_simulated_and_real_runs_are_never_one_series(serial):
    """With the same name, drive and profile, four simulated runs of J 104 and four real ones of J 140 are no change."""
    found, _ = rows("none", count=8, serial=serial)
    mixed = [replace(one, simulated=k < 4, inertia_kg_m2=one.inertia_kg_m2 * (1.0 if k < 4 else 1.35),
                     inertia_low_kg_m2=one.inertia_low_kg_m2 * (1.0 if k < 4 else 1.35),
                     inertia_high_kg_m2=one.inertia_high_kg_m2 * (1.0 if k < 4 else 1.35))
             for k, one in enumerate(found)]
    document = trend_document(mixed, "R7")
    assert (document["results"], document["simulated"], document["quantities"][0]["changes"]) == (4, False, [])
    assert not _differences(mixed[0], mixed[-1])["quantities"][0]["shared_scale"]


def test_runs_before_and_after_a_calibration_are_kept_apart():
    """A calibration changes J by 5 %. The torque scale of each side is in the difference, and no shaft has changed."""
    found, _ = rows("none")
    half = len(found) // 2
    day = "2026-01-12T10:00:00+00:00"
    after = [replace(one, inertia_kg_m2=1.05 * one.inertia_kg_m2, inertia_low_kg_m2=1.05 * one.inertia_low_kg_m2,
                     inertia_high_kg_m2=1.05 * one.inertia_high_kg_m2, torque_calibration=day,
                     torque_scale_rel_sd=0.005) for one in found[half:]]
    plain = [replace(one, torque_calibration=None, torque_scale_rel_sd=0.03) for one in after]

    def inertia(mine):
        document = trend_document(mine)
        return next(one for one in document["quantities"] if one["name"] == "inertia"), " ".join(document["notes"])

    apart, said = inertia(found[:half] + after)
    assert apart["changes"] == [] and "different torque calibrations (none, 2026-01-12)" in said
    together, said = inertia(found[:half] + plain)
    assert len(together["changes"]) == 1 and "torque calibrations" not in said
    assert scale_of(after[0]) != scale_of(found[0]) == scale_of(plain[0])


def test_two_calibrations_from_the_same_logs_are_two_torque_scales():
    """A recalculation with another added inertia has the same date. Its factor changes J, and no shaft has changed."""
    day = "2026-01-12T10:00:00+00:00"

    def run(factor, day=day):
        document = {"verdict": "valid", "rig": {"name": "R7"}, "date": "2026-02-01T08:00:00+00:00", "simulated": False,
                    "drive": {"vendor": 1, "product": 2, "serial": 7},
                    "inertia_kg_m2": {"value": 104.0 * factor, "low": 103.0 * factor, "high": 105.0 * factor,
                                      "confidence": 0.95},
                    "torque_calibration": {"factor": factor, "low": 0.99 * factor, "high": 1.01 * factor,
                                           "rel_sd": 0.005, "date": day}}
        return row_of(f"{factor}.mcap", document, settings=FleetSettings())

    first, other = run(0.997), run(1.133)
    assert (first.torque_calibration, first.torque_calibration_factor) == (day, 0.997)
    found = _differences(first, other)
    assert not found["quantities"][0]["shared_scale"]
    assert found["text"].endswith("two torque calibrations: the scale of each is in it")
    (note,) = trend_document([first, other])["notes"]
    assert "different torque calibrations (2026-01-12 (factor 0.997), 2026-01-12 (factor 1.133))" in note
    same = _differences(first, replace(run(0.997), log="again.mcap"))
    assert same["quantities"][0]["shared_scale"] and "torque scale cancels" in same["text"]
    # a row of an earlier version has the date only
    old = row_from_json({name: value for name, value in asdict(first).items() if name != "torque_calibration_factor"})
    assert scale_of(old) == scale_of(replace(old, log="b.mcap")) != scale_of(first)


def test_dates_of_the_picture_of_a_trend_are_legible(tmp_path):
    """They are on the time axis below the last picture only, and do not overlap."""
    from matplotlib.figure import Figure

    from tdhil.cli.trend import _draw_trend

    found, _ = rows("step 5 %")
    found = [replace(one, simulated=True) for one in found]
    found[3] = replace(found[3], rehearsed_faults="torque-scale=1.1")
    document = trend_document(found, "R7", rehearsals=True)
    assert document["simulated"] and document["rehearsed_faults"] == ["torque-scale=1.1"]
    figure = Figure((7.2, 7.5), layout="constrained")
    _draw_trend(figure, document)
    figure.draw_without_rendering()
    *above, last = figure.axes
    assert not any(label.get_visible() for axis in above for label in axis.get_xticklabels())
    places = [label.get_window_extent() for label in last.get_xticklabels() if label.get_text()]
    assert len(places) > 2
    assert all(one.x1 < other.x0 for one, other in pairwise(places))
    hollow = [line for line in figure.axes[0].lines if line.get_markerfacecolor() == "white"]
    assert [len(line.get_xdata()) for line in hollow if line.get_marker() == "o"] == [1]


def test_the_command_trend(table, tmp_path, capsys):
    report = tmp_path / "trend.html"
    assert main(["trend", str(table), "--rig", "R7", "--report", str(report)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^inertia, 1\d\d(\.\d)? to 1\d\d(\.\d)? kg·m²: changed by \+", text, re.MULTILINE)
    text = report.read_text(encoding="utf-8")
    assert "<svg" in text
    assert "changed by +" in text
    (tmp_path / "letterhead.yaml").write_text("company: Nordwerk\n")
    head = ["--letterhead", str(tmp_path / "letterhead.yaml"), "--customer", "Østfold"]
    assert main(["trend", str(table), "--rig", "R7", "--report", str(tmp_path / "head.html"), *head]) == 0
    assert all(one in (tmp_path / "head.html").read_text(encoding="utf-8") for one in ("Nordwerk", "Østfold"))
    assert "Nordwerk" not in text
    capsys.readouterr()
    assert main(["trend", str(table), "--rig", "R7", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["results"] == 24
    for wrong in ([], ["--rig", "R9"], ["--rig", "R7", "--report", str(report)], ["--rig", "R7", "--report", "x.txt"]):
        assert main(["trend", str(table), *wrong]) == 2
    assert main(["trend", str(tmp_path / "none.csv"), "--rig", "R7"]) == 2


@pytest.mark.heavy
@pytest.mark.one_worker("fleet")
def test_the_command_compare(few, tmp_path, capsys):
    """The command compares two runs of one rig with the same true values."""
    report = tmp_path / "compared.html"
    logs = [str(few / "R1-001.mcap"), str(few / "R1-002.mcap")]
    assert main(["compare", *logs, "--report", str(report), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    (told,) = document["differences"]
    inertia = told["quantities"][0]
    assert inertia["shared_scale"]
    assert inertia["low"] < 0.0 < inertia["high"]
    assert "the inertias do not differ significantly" in told["text"]
    differs = {one["name"]: one["differs"] for one in document["settings"]}
    assert differs["date"]
    assert not differs["rig"]
    assert len(document["apparent_inertia"][0]) > 3
    assert "<svg" in report.read_text(encoding="utf-8")
    assert main(["compare", *logs]) == 0
    text = capsys.readouterr().out
    assert "apparent J, 0.1 Hz" in text
    assert "do not differ significantly" in text
    assert main(["compare", logs[0]]) == 2
    assert main(["compare", logs[0], str(tmp_path / "none.mcap")]) == 2
    assert main(["compare", logs[0], str(few / "empty.mcap")]) == 2
