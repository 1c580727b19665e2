"""Limits of a run: those of the rig, and a lower maximum speed for one run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from drivers import PreflightRefused
from sim_bus.params import load_rig
from tdhil.cli.main import main
from tdhil.config import parse_rig, simulated_default_rig
from tdhil.errors import ExitCode, UsageError
from tdhil.session.task import bench_of, machine_limits, suited


def string_plant():
    return load_rig(Path(__file__).parents[2] / "examples" / "plant_string.yaml")


def test_limits_for_a_simulated_string_keep_what_the_file_states():
    rig = parse_rig("load: {kind: string}\nmake_up_torque_nm: 3000\ntorque_ramp_nm_s: 5\n", "rig.yaml")
    bench = suited(rig, string_plant())
    assert (bench.make_up_torque_nm, bench.torque_ramp_nm_s) == (3000.0, 5.0)
    assert bench.limits.torque_nm < 3000.0


def test_a_dry_run_plans_for_the_limits_of_the_run(capsys):
    """It planned for the default rig: ±400 N·m, where the run has 4000."""
    plant = Path(__file__).parents[2] / "examples" / "plant_string.yaml"
    assert main(["identify", "--simulate", "--plant", str(plant), "--dry-run", "--json"]) == 0
    limits = json.loads(capsys.readouterr().out)["limits"]
    bench = suited(None, string_plant())
    assert limits["torque_nm"] == bench.limits.torque_nm > 1000.0


@pytest.mark.parametrize("simulated", [False, True])
def test_a_run_may_have_a_lower_highest_speed_and_nothing_else_changes(simulated):
    rig = simulated_default_rig(None)
    usual, careful = machine_limits(bench_of(simulated, rig)), machine_limits(bench_of(simulated, rig, 4.0))
    assert (usual.speed_max_rad_s, careful.speed_max_rad_s) == (10.0, 4.0)
    assert {name for name in vars(usual) if getattr(usual, name) != getattr(careful, name)} == {"speed_max_rad_s"}
    assert rig.limits.speed_max_rad_s == 10.0


@pytest.mark.parametrize("speed_rad_s", [10.5, 0.5, 0.1])
def test_no_run_exceeds_the_limits_of_the_rig(speed_rad_s):
    with pytest.raises(UsageError, match=r"--highest-speed: .* is not within the limits of the rig, 0.5 to 10 rad/s"):
        bench_of(False, simulated_default_rig(None), speed_rad_s)


@pytest.mark.parametrize(("given", "rig_rad_s"), [(("--highest-speed", "2"), 10.0), ((), 0.0)])
def test_the_noise_of_a_run_with_a_lower_highest_speed_is_that_of_its_rig(given, rig_rad_s, monkeypatch, tmp_path):
    found = []

    def limits_of(*bench, **said):
        found.append(machine_limits(*bench, **said))
        raise PreflightRefused("enough is seen")

    monkeypatch.setattr("tdhil.session.run_session.machine_limits", limits_of)
    log = str(tmp_path / "run.mcap")
    assert main(["identify", "--simulate", *given, "--log", log]) == ExitCode.REFUSED
    assert found[0].rig_speed_max_rad_s == rig_rad_s
    assert found[0].noise_scale_rad_s == 10.0


def test_the_plan_stays_below_the_highest_speed_of_the_run(capsys):
    assert main(["identify", "--simulate", "--highest-speed", "4", "--dry-run", "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["limits"]["speed_max_rad_s"] == 4.0 and plan["speed_rad_s"]["max"] < 4.0
    assert main(["identify", "--simulate", "--highest-speed", "100rpm", "--dry-run"]) == ExitCode.USAGE


@pytest.mark.heavy
def test_no_stage_of_a_run_exceeds_its_highest_speed(tmp_path, capsys):
    trace = tmp_path / "shaft.csv"
    assert main(["identify", "--simulate", "--seed", "3", "--highest-speed", "4", "--trace", str(trace), "--log",
                 str(tmp_path / "run.mcap"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["inertia_kg_m2"]["low_total"] < 104.0 < found["inertia_kg_m2"]["high_total"]
    speeds = [float(line.split(",")[1]) for line in trace.read_text(encoding="utf-8").splitlines()[1:]]
    assert 3.0 < max(speeds) < 4.0
