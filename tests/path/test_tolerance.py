"""`--tolerance`, `--max-time` and `--dry-run` on the command line."""

import pytest

from profiles.quantities import TIME
from tdhil.cli.arguments import amount, share
from tdhil.recording import LogTail
from tdhil.recording.log_reader import read_run
from tests.path.path_runs import QUICK, Shaft, identify, tdhil
from tests.rigs import limits_text, rig_file


def half_width(document):
    inertia = document["inertia_kg_m2"]
    return 0.5 * (inertia["high"] - inertia["low"]) / inertia["value"]


@pytest.mark.heavy           # tests/runner/test_adaptive_duration.py has the rule, stage by stage
def test_it_acquires_until_the_interval_meets_the_tolerance(tmp_path):
    trace = tmp_path / "shaft.csv"
    done = identify(tmp_path, "--simulate", *QUICK, "--seed", 2, "--tolerance", "1%", "--trace", trace)
    assert done.code == 0, done.err
    document = done.document
    assert document["verdict"] == "valid"
    assert half_width(document) <= 0.01
    inertia = document["inertia_kg_m2"]
    assert inertia["low"] <= 104.0 <= inertia["high"]
    assert inertia["confidence"] == 0.95
    assert "expected interval of J" in done.err.replace("\n", " ")
    assert "scatter gives" in done.err.replace("\n", " ") or "the interval is" in done.err.replace("\n", " ")
    stopping = read_run(done.log).configuration["stopping"]
    assert stopping["tolerance"] == 0.01
    assert stopping["decisions"][-1]["periods"] == 0
    assert stopping["decisions"][-1]["working_confidence"] > 0.95      # cost of interim looks
    Shaft.read(trace).assert_at_rest()

    tail, inertias = LogTail(done.log), []
    while not inertias or not tail.closed:
        inertias += tail.read().inertias
    last = inertias[-1]                # on the page of the run: that of the result
    for name in ("low", "high", "low_total", "high_total"):
        assert getattr(last, f"{name}_kg_m2") == pytest.approx(inertia[name], rel=1e-9)
    assert (last.inertia_kg_m2, last.confidence) == (pytest.approx(inertia["value"], rel=1e-9), 0.95)

    replayed = tdhil("replay", "--json", done.log)
    assert replayed.document == document


@pytest.mark.long
@pytest.mark.heavy
def test_an_unreachable_tolerance_is_reported_before_motion_with_advice(tmp_path):
    done = identify(tmp_path, "--simulate", *QUICK, "--seed", 1, "--tolerance", "0.02%", "--max-time", "150s")
    assert done.code == 0, done.err
    assert done.document["verdict"] == "valid_wide"
    said = done.err.replace("\n", " ")
    assert said.index("can't be reached") < said.index("least possible value is ±") < said.index("stage setup")
    assert said.rindex("can't be reached") > said.index("stage setup")      # again, with the measured values
    assert done.document["advice"] == read_run(done.log).configuration["stopping"]["advice"]
    acquire = done.document["stages"][-1]
    assert acquire["duration_s"] <= 160.0


@pytest.mark.heavy
def test_periods_fix_the_length_and_the_tolerance_is_only_compared(tmp_path):
    done = identify(tmp_path, "--simulate", *QUICK, "--seed", 1, "--tolerance", "0.1%", "--periods", 4)
    assert done.code == 0, done.err
    assert done.document["verdict"] == "valid_wide"
    assert done.document["periods_used"] == 6
    assert "stopping" not in read_run(done.log).configuration


# -- dry run -------------------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_a_dry_run_changes_nothing_and_states_its_assumptions(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rig = rig_file(tmp_path, "expected: {inertia_kg_m2: 90.0, load_noise_nm: 4.0}\n")
    done = tdhil("identify", "--dry-run", "--rig", rig, "--json")
    assert done.code == 0, done.err
    document = done.document
    assert document["dry_run"] is True
    assert document["simulated"] is True
    source = {figure["name"]: figure["source"] for figure in document["rests_on"]}
    assert source["moment of inertia"] == source["disturbing torque (sd)"] == "rig.yaml:1"
    assert source["viscous friction"] == source["lag of the reported speed"] == "assumed"
    assert 0.0 < document["expected_half_width"] < 0.05
    assert document["limits"]["speed_max_rad_s"] > document["speed_rad_s"]["max"]
    assert abs(document["torque_nm"]["max"]) < document["limits"]["torque_nm"]
    assert {len(one["lines_hz"]) - len(one["amplitudes_rad_s"]) for one in document["segments"]} == {0}
    assert list(tmp_path.iterdir()) == [rig]


@pytest.mark.heavy
def test_a_dry_run_is_readable_in_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    done = tdhil("identify", "--dry-run", "--tolerance", "2%")
    assert done.code == 0
    assert max(map(len, done.out.splitlines())) <= 80
    for wanted in ("DRY RUN", "nothing moves", "assumed", "expected interval of J", "±400", "rad/s", "pilot",
                   "is assumed from the limits"):
        assert wanted in done.out


@pytest.mark.heavy
def test_a_plan_ends_before_the_time_limit_or_is_refused(tmp_path):
    """A run used to turn the shaft through stages 1 to 4 first, and the guard then ended stage 5."""
    short, shorter = (rig_file(tmp_path, limits_text(time_s=time_s), name=f"{time_s}.yaml") for time_s in (300.0, 75.0))
    done = tdhil("identify", "--simulate", "--dry-run", "--rig", short, "--max-time", "1h", "--json")
    assert done.document["duration_s"] <= 300.0 - 90.0
    done = tdhil("identify", "--simulate", "--dry-run", "--rig", short, "--periods", 30)
    assert done.code == 4 and "are left of limits.time_s" in done.err.replace("\n", " ")
    done = tdhil("identify", "--simulate", "--rig", shorter, "--log", tmp_path / "run.mcap")
    assert done.code == 4 and "75 s are too short" in done.err.replace("\n", " ")
    assert "stage speed" not in done.err


def test_a_dry_run_refuses_what_a_run_would_refuse(tmp_path, monkeypatch):
    assert "amplitude of 9" in tdhil("identify", "--dry-run", "--amplitude", 9).err
    assert tdhil("identify", "--dry-run", "--max-time", 20).code == 4
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    done = tdhil("identify", "--dry-run")                    # a real drive without limits
    assert done.code == 4
    assert "limits" in done.err


def test_one_tone_is_predicted_to_give_no_j():
    done = tdhil("identify", "--dry-run", "--excitation", "sine")
    assert done.code == 0
    assert "no interval of J is expected" in done.out.replace("\n", " ")
    assert done.out.startswith("SIMULATED: the simulated rig")      # no address of a drive


# -- quantities ----------------------------------------------------------------------------------------------


def test_quantities_in_usual_notations():
    assert share("1%") == share(" 0.01 ") == 0.01
    assert share("0.35 %") == 0.0035
    assert [amount(TIME)(text) for text in ("300", "300s", "5min", "0.5h")] == [300.0, 300.0, 300.0, 1800.0]


@pytest.mark.parametrize(
    "arguments", [("--tolerance", "x%"), ("--tolerance", "100%"), ("--tolerance", "0"), ("--max-time", "5 parsecs"),
                  ("--max-time", "-1"), ("--max-time", "nan")]
)
def test_an_invalid_quantity_is_a_usage_error(arguments):
    done = tdhil("identify", "--simulate", *arguments)
    assert done.code == 2
    assert arguments[0] in done.err
