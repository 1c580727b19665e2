"""`tdhil evaluate` on the simulated drive, through CANopen frames in stepped time, from files to verdict and replay."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import numpy as np
import pytest

from tests.path.path_runs import Shaft, host, peer, tdhil, wait_for

EXAMPLES = Path(__file__).parents[2] / "examples"
PLANT = """plant: {kind: rigid, inertia_kg_m2: 1500, viscous_nm_s_rad: 8, coulomb_nm: 60}
drive: {rated_torque_nm: 20000, torque_limit_nm: 30000, speed_limit_rpm: 250, speed_gain_nm_s_rad: 6000,
        speed_integral_gain_nm_rad: 4000}
"""
RIG = """limits: {speed_min_rad_s: 0.5, speed_max_rad_s: 15, torque_nm: 15000, probe_torque_nm: 1000,
         probe_travel_rad: 3, time_s: 1500, quick_stop_rad_s2: 2, watchdog_s: 0.5}
"""


def interval(value, low, high):
    return {"value": value, "low": low, "high": high}


def tuning(**more):
    """As `tdhil tune --a 0.25 --json` has it for this rig on the example's string, as far as it is looked at."""
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
    (tmp_path / "plant.yaml").write_text(PLANT)
    (tmp_path / "rig.yaml").write_text(RIG)
    return tmp_path


def evaluate(folder, *more, use="soft", rate=50):
    return tdhil(
        "evaluate", "--virtual-string", EXAMPLES / "string.yaml", "--controller", folder / "tune.json", "--use", use,
        "--simulate", "--plant", folder / "plant.yaml", "--rig", folder / "rig.yaml", "--seed", 3, "--rate", rate,
        "--log", folder / "run.mcap", "--trace", folder / "shaft.csv", "--json", *more,
    )


@pytest.mark.heavy
def test_a_soft_controller_does_on_the_drive_what_tune_says_and_its_log_says_the_same(files):
    done = evaluate(files)
    document = done.document
    assert (done.code, document["verdict"]) == (0, "as_predicted"), done.err
    assert document["critical_rpm"]["value"] == pytest.approx(57.0, abs=3.0)
    assert document["least_damping"]["value"] == pytest.approx(0.2256, abs=0.02)
    assert document["torque_rms_nm"]["sticking"] > 20.0 * document["torque_rms_nm"]["turning"]
    assert document["simulated"] is True and document["loop"]["clamped_cycles"] == 0
    shaft = Shaft.read(files / "shaft.csv")
    shaft.assert_at_rest()
    assert shaft.speed_rad_s.min() > -0.1      # a heavy shaft swings in behind the drive's own stop
    again = tdhil("replay", files / "run.mcap", "--json")
    assert (again.code, again.document) == (0, document)
    assert "as predicted" in tdhil("replay", files / "run.mcap").out


@pytest.mark.heavy
def test_the_drives_own_loop_does_what_tune_says_of_its_gains(files):
    """The string through 60B2h; the gains are the plant's."""
    gains = "speed_gain_nm_s_rad: 1186, speed_integral_gain_nm_rad: 1000"
    text = PLANT.replace("speed_gain_nm_s_rad: 6000,\n        speed_integral_gain_nm_rad: 4000", gains)
    assert gains in text
    (files / "plant.yaml").write_text(text)
    done = evaluate(files, "--own-loop")
    document = done.document
    assert (done.code, document["verdict"]) == (0, "as_predicted"), done.err
    assert document["critical_rpm"]["value"] == pytest.approx(57.0, abs=3.0)
    assert document["controller"]["own_loop"] is True
    assert [stage["outcome"] for stage in document["stages"]] == ["ok", "ok", "skipped", "ok", "ok"]
    Shaft.read(files / "shaft.csv").assert_at_rest()


@pytest.mark.heavy
@pytest.mark.parametrize(("fault", "code"), [
    ("frozen-feedback", 5), ("internal-limit", 7), ("drive-fault", 6), ("feedback-lost", 5), ("load-lost", 7),
])
def test_a_fault_while_the_bit_sticks_and_slips_ends_with_a_shaft_at_rest(files, fault, code):
    done = evaluate(files, "--fault", f"{fault}@acquire+25s")
    assert done.code in (code, 8), done.err
    shaft = Shaft.read(files / "shaft.csv")
    assert shaft.at_rest_from() <= shaft.time_s[-1] - 1.0
    if fault != "drive-fault":       # whose own reaction it is
        shaft.assert_never_let_go()
    assert shaft.speed_rad_s.min() > -0.1
    begun = [row for row, event in enumerate(shaft.event) if "quick stop active" in event or "fault" in event]
    if begun:      # nothing but braking comes after
        later = shaft.torque_nm[begun[-1] + 250:]
        assert np.all(later < 500.0)


@pytest.mark.heavy
def test_a_host_killed_while_the_bit_sticks_and_slips_leaves_the_shaft_to_the_drive_s_watchdog(files):
    """The drive goes on with the last torque for the watchdog's time, then brakes by itself; nothing turns back."""
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
    assert shaft.speed_rad_s.min() > -0.1
    replayed = tdhil("replay", "--json", done.log)
    assert replayed.code == 9, replayed.err
    assert replayed.document["verdict"] == "not_found" and replayed.document["complete"] is False


@pytest.mark.parametrize(("more", "rate", "code", "said"), [
    ((), 10, 4, "cycles a second"),
    (("--use", "broadband"), 50, 2, "nearly all of J"),
    (("--use", "stiff"), 50, 2, "there is no stiff"),
    (("--controller", "nowhere.json"), 50, 2, "no such file"),
    (("--controller", EXAMPLES / "string.yaml"), 50, 2, "no JSON"),
    (("--virtual-string", "longer"), 50, 2, "another string"),
    (("--own-loop", "--drive", "modbus"), 50, 4, "torque offset"),
])
def test_what_can_not_be_evaluated_is_refused(files, more, rate, code, said):
    if "longer" in more:
        longer = files / "longer.yaml"
        longer.write_text((EXAMPLES / "string.yaml").read_text().replace("3000", "3100"))
        more = (more[0], longer)
    done = evaluate(files, *more, rate=rate)
    assert done.code == code and said in " ".join(done.err.split()), done.err
