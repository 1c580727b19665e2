"""`tdhil evaluate` on the simulated drive, by CANopen frames in stepped time, from files to verdict and replay."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import numpy as np
import pytest

from tests.path.path_runs import LETS_GO_S, Shaft, host, peer, tdhil, wait_for
from tests.rigs import plant_file, rig_file

EXAMPLES = Path(__file__).parents[2] / "examples"
PLANT = (EXAMPLES / "plant_top_drive.yaml").read_text(encoding="utf-8")
RIG = (EXAMPLES / "rig_top_drive.yaml").read_text(encoding="utf-8")
SWINGS_IN_RAD_S = 15_000.0 / 1500.0 * LETS_GO_S      # past zero, at a stop: rig's torque limit, plant's inertia


def interval(value, low, high):
    return {"value": value, "low": low, "high": high}


def tuning(**more):
    """Return the used part of `tdhil tune --a 0.25 --json` for this rig with the string of the example."""
    soft = {
        "kind": "soft", "refused": None,
        "at_main_shaft": {"gain_nm_s_rad": 1186.0032, "integral_nm_rad": 999.9749, "compensated_kg_m2": 0.0,
                          "derivative_filter_s": 0.05},
        "least_damping": interval(0.2256, 0.2125, 0.2398),
        "critical_rpm": {"cure": interval(57.0, 56.0, 59.0)},
    }
    return {
        "identified": {
            "inertia_kg_m2": {"value": 1500.0}, "viscous_nm_s_rad": {"value": 8.0}, "coulomb_nm": {"value": 60.0},
            "speed_lag_s": interval(0.4, 0.39, 0.41), "torque_lag_s": interval(0.15, 0.14, 0.16), "gear_ratio": 1.0,
        },
        "main_shaft": {"inertia_kg_m2": interval(1500.0, 1440.0, 1560.0), "viscous_nm_s_rad": 8.0, "coulomb_nm": 60.0,
                       "inner_lags_s": [0.02, 0.01, 0.003]},
        "string": {
            "impedance_nm_s_rad": 296.5026, "stiffness_nm_rad": 314.1, "echo_s": 1.8878,
            "modes_hz": [0.1299478, 0.566667, 1.0790772], "bottom_inertia_kg_m2": 374.0,
            "bit": {"coulomb_nm": 2500.0, "static_nm": 5000.0},
        },
        "controllers": [soft, {"kind": "broadband", "refused": "nearly all of J"}],
    } | more


@pytest.fixture
def files(tmp_path):
    from tdhil.soft_torque import load_string

    string = load_string(EXAMPLES / "string.yaml")
    document = tuning()
    document["string"] |= {"impedance_nm_s_rad": string.impedance_nm_s_rad, "echo_s": string.echo_s,
                           "stiffness_nm_rad": string.stiffness_nm_rad}
    (tmp_path / "tune.json").write_text(json.dumps(document))
    plant_file(tmp_path, PLANT)
    rig_file(tmp_path, RIG)
    return tmp_path


def evaluate(folder, *more, use="soft", rate=50):
    return tdhil(
        "evaluate", "--virtual-string", EXAMPLES / "string.yaml", "--controller", folder / "tune.json", "--use", use,
        "--simulate", "--plant", folder / "plant.yaml", "--rig", folder / "rig.yaml", "--seed", 3, "--rate", rate,
        "--log", folder / "run.mcap", "--trace", folder / "shaft.csv", "--json", *more,
    )


@pytest.mark.heavy
def test_a_soft_controller_on_the_drive_agrees_with_tune_and_its_log_agrees(files):
    done = evaluate(files)
    document = done.document
    assert (done.code, document["verdict"]) == (0, "as_predicted"), done.err
    assert document["critical_rpm"]["value"] == pytest.approx(57.0, abs=3.0)
    assert document["least_damping"]["value"] == pytest.approx(0.2256, abs=0.02)
    assert document["torque_rms_nm"]["sticking"] > 20.0 * document["torque_rms_nm"]["turning"]
    assert document["simulated"] is True and document["loop"]["clamped_cycles"] == 0
    shaft = Shaft.read(files / "shaft.csv")
    shaft.assert_at_rest()
    assert shaft.speed_rad_s.min() > -SWINGS_IN_RAD_S
    again = tdhil("replay", files / "run.mcap", "--json")
    assert (again.code, again.document) == (0, document)
    page = files / "page.html"
    assert "as predicted" in tdhil("replay", files / "run.mcap", "--report", page).out
    assert page.read_text(encoding="utf-8").count("<svg") == 3


@pytest.mark.heavy
def test_the_drives_own_loop_agrees_with_tune(files):
    """The string acts by 60B2h. The gains are those of the plant."""
    text = PLANT.replace("_nm_s_rad: 6000.0", "_nm_s_rad: 1186").replace("_nm_rad: 4000.0", "_nm_rad: 1000")
    assert "gain_nm_s_rad: 1186\n" in text and "gain_nm_rad: 1000\n" in text
    plant_file(files, text)
    done = evaluate(files, "--own-loop")
    document = done.document
    assert (done.code, document["verdict"]) == (0, "as_predicted"), done.err
    assert document["critical_rpm"]["value"] == pytest.approx(57.0, abs=3.0)
    assert document["controller"]["own_loop"] is True
    assert [stage["outcome"] for stage in document["stages"]] == ["ok", "ok", "skipped", "ok", "ok"]
    Shaft.read(files / "shaft.csv").assert_at_rest()


@pytest.mark.heavy
@pytest.mark.parametrize("own_loop", [False, pytest.param(True, marks=pytest.mark.long)])
def test_after_a_torque_calibration_the_string_acts_in_the_torque_of_the_drive(files, own_loop):
    """The N·m of the drive are 10 % too small. Without the factor, string and controller would be 9 % too weak."""
    text = PLANT + "reporting:\n  torque_scale: 1.1\n"
    if own_loop:
        text = text.replace("_nm_s_rad: 6000.0", "_nm_s_rad: 1304.6").replace("_nm_rad: 4000.0", "_nm_rad: 1100")
    plant_file(files, text)
    document = json.loads((files / "tune.json").read_text())
    document["identified"]["torque_calibration"] = {"factor": 1.0 / 1.1}
    (files / "tune.json").write_text(json.dumps(document), encoding="utf-8")
    done = evaluate(files, *(["--own-loop"] if own_loop else []))
    assert (done.code, done.document["verdict"]) == (0, "as_predicted"), done.err
    assert done.document["least_damping"]["value"] == pytest.approx(0.2256, abs=0.02)
    assert done.document["loop"]["unknown_rms_nm"] < 50.0


@pytest.mark.long
def test_a_reported_torque_of_nine_tenths_of_the_commanded_one_is_not_as_predicted(files):
    """The loop itself does not use the reported torque, so everything else agrees with tune."""
    done = evaluate(files, "--fault", "torque-scale=0.9")
    assert (done.code, done.document["verdict"]) == (9, "invalid"), done.err
    assert "reported torque is 0.9" in done.document["reason"]
    assert "per_lsb" in done.document["reason"]
    again = tdhil("replay", files / "run.mcap", "--json")
    assert (again.code, again.document) == (9, done.document)


@pytest.mark.long(but_first=3)
@pytest.mark.heavy
@pytest.mark.parametrize(("fault", "code"), [
    ("frozen-feedback", 5), ("internal-limit", 7), ("drive-fault", 6), ("feedback-lost", 5), ("load-lost", 7),
])
def test_a_fault_while_the_bit_sticks_and_slips_ends_with_a_shaft_at_rest(files, fault, code):
    done = evaluate(files, "--fault", f"{fault}@acquire+25s")
    assert done.code in (code, 8), done.err
    shaft = Shaft.read(files / "shaft.csv")
    assert shaft.at_rest_from() <= shaft.time_s[-1] - 1.0
    if fault != "drive-fault":       # the reaction of the drive itself
        shaft.assert_never_let_go()
    assert shaft.speed_rad_s.min() > -SWINGS_IN_RAD_S
    begun = [row for row, event in enumerate(shaft.event) if "quick stop active" in event or "fault" in event]
    if begun:      # only braking afterwards
        later = shaft.torque_nm[begun[-1] + 250:]
        assert np.all(later < 500.0)


@pytest.mark.heavy
def test_a_host_killed_while_the_bit_sticks_and_slips_leaves_the_shaft_to_the_drive_s_watchdog(files):
    """The drive keeps the last torque for the watchdog time. Then its reaction brakes without reverse rotation."""
    with peer(files, "--stepped", "--seed", 1, "--plant", files / "plant.yaml") as drive, host(
        files, *drive.options, "--stepped", "--rate", 50, "--rig", files / "rig.yaml", "--controller",
        files / "tune.json", "--virtual-string", EXAMPLES / "string.yaml", command="evaluate",
    ) as running:
        assert running.wait_for_line("ramp of the set speed"), running.err
        running.signal(signal.SIGKILL)
        done = running.finish()
        assert done.code == -signal.SIGKILL

        def rests():
            shaft = Shaft.read(drive.trace)
            lost = shaft.events("host heartbeat lost")
            return bool(lost) and shaft.time_s[-1] > max(lost[-1], shaft.at_rest_from()) + 1.0

        wait_for("the end of the stop", rests)
        shaft = drive.shaft
    shaft.assert_at_rest()
    assert shaft.speed_rad_s.min() > -SWINGS_IN_RAD_S
    replayed = tdhil("replay", "--json", done.log)
    assert replayed.code == 9, replayed.err
    assert replayed.document["verdict"] == "not_found" and replayed.document["complete"] is False


def test_the_shipped_example_has_room_for_the_string(files):
    """A dry run uses the unchanged files of the page."""
    done = evaluate(files, "--dry-run")
    assert done.code == 0, done.err
    assert done.document["set_speed_rad_s"]["min"] * 30.0 / np.pi == pytest.approx(44.0, abs=0.1)
    assert done.document["moving_torque_nm"] < 0.95 * done.document["limits"]["torque_nm"]
    assert done.document["duration_s"] < done.document["limits"]["time_s"]
    assert not (files / "run.mcap").exists()


@pytest.mark.parametrize(("change", "said"), [
    (("inertia_kg_m2", interval(104.0, 100.0, 108.0)), "a top drive of 104 kg·m² at the main shaft is light"),
    (("speed_min_rad_s", 4.0), "Set it to"),
    (("load", "string"), "load is string"),
])
def test_a_dry_run_names_the_reasons_of_a_refusal(files, change, said):
    key, value = change
    if key == "inertia_kg_m2":
        document = json.loads((files / "tune.json").read_text())
        document["main_shaft"][key] = document["identified"][key] = value
        document["controllers"][0]["at_main_shaft"]["gain_nm_s_rad"] = 459.0
        (files / "tune.json").write_text(json.dumps(document))
    elif key == "speed_min_rad_s":
        rig_file(files, RIG.replace("speed_min_rad_s: 0.5", f"speed_min_rad_s: {value}"))
    else:
        hangs = "load: {kind: string}\nmake_up_torque_nm: 20000\ntorque_ramp_nm_s: 100\n"
        rig_file(files, RIG, hangs)
    done = evaluate(files, "--dry-run")
    assert done.code == 4 and said in " ".join(done.err.split()), done.err


@pytest.mark.parametrize(("more", "rate", "code", "said"), [
    ((), 10, 4, "cycles a second"),
    (("--use", "broadband"), 50, 2, "nearly all of J"),
    (("--use", "stiff"), 50, 2, "contains no stiff"),
    (("--controller", "nowhere.json"), 50, 2, "file does not exist"),
    (("--controller", EXAMPLES / "string.yaml"), 50, 2, "is not JSON"),
    (("--virtual-string", "longer"), 50, 2, "different string"),
    (("--own-loop", "--drive", "modbus"), 50, 4, "torque offset"),
])
def test_impossible_evaluations_are_refused(files, more, rate, code, said):
    if "longer" in more:
        longer = files / "longer.yaml"
        longer.write_text((EXAMPLES / "string.yaml").read_text().replace("3000", "3100"))
        more = (more[0], longer)
    done = evaluate(files, *more, rate=rate)
    assert done.code == code and said in " ".join(done.err.split()), done.err
