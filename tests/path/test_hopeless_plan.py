"""What no shaft could do is refused before the drive is touched; what this one can't do, in its own words."""

import pytest

from tdhil.config.resolution import resolve
from tdhil.config.rig import load_rig
from tdhil.session.dry_run import refuse_hopeless
from tests.path.path_runs import tdhil

QUICK = ("--seed", 1)


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize(("arguments", "option"), [
    (("--max-time", 60), "--max-time 1"),
    (("--max-time", "1min", "--tolerance", "1%"), "--max-time 1"),
    (("--max-time", 60, "--mode", "speed"), "--max-time 1"),
    (("--max-time", 10, "--excitation", "pulses"), "--max-time"),
    (("--max-time", 5, "--excitation", "sine", "--frequency", 0.1), "--max-time"),
    (("--periods", 1), "--periods 2"),
    (("--excitation", "coast-down", "--frequency", 0.1), "--frequency"),
    (("--amplitude", 9), "--amplitude"),
    (("--offset", 9.99), "--offset"),
    (("--drive", "modbus", "--max-time", 60), "--max-time"),
])
def test_a_run_refuses_at_once_what_a_dry_run_does(tmp_path, monkeypatch, arguments, option):
    monkeypatch.chdir(tmp_path)
    runs = [tdhil("identify", *more, "--simulate", *arguments) for more in (("--dry-run",), QUICK)]
    for done in runs:
        assert done.code == 4, done.err
        assert option in done.err
        assert "stage" not in done.err.replace("stage 5", "")
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.parametrize("arguments", [
    {}, {"max_time_s": 150.0}, {"tolerance": 0.01}, {"tolerance": 0.01, "max_time_s": 150.0},
    {"excitation": "coast-down"}, {"excitation": "pulses", "mode": "speed"},
    {"excitation": "sine", "frequency_hz": 1.0},
    {"amplitude_rad_s": 1.0, "offset_rad_s": 4.0}, {"excitation": "step", "periods": 3}, {"rate_hz": 20.0},
])
def test_what_may_be_done_is_not_refused(arguments):
    refuse_hopeless(resolve(arguments, None), None, can_torque=True)
    if arguments.get("excitation") != "coast-down":
        refuse_hopeless(resolve(arguments, None), None, can_torque=False)


def test_what_hangs_on_the_shaft_is_left_to_the_run(tmp_path):
    """An amplitude that the assumed shaft is too heavy for: a lighter one may turn out to hang there."""
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "limits: {speed_min_rad_s: 0.5, speed_max_rad_s: 10, torque_nm: 400, time_s: 900, quick_stop_rad_s2: 2,"
        " probe_torque_nm: 200, probe_travel_rad: 3}\nexpected: {inertia_kg_m2: 2000}\n"
    )
    options = resolve({"amplitude_rad_s": 1.0, "excitation": "sine", "frequency_hz": 0.5}, load_rig(rig))
    refuse_hopeless(options, load_rig(rig), can_torque=True)


@pytest.mark.parametrize(("profile", "lets_go"), [
    ("siemens/s120-canopen", True), ("siemens/g130-s120", True), ("generic/cia402", False), ("generic/modbus", False),
])
def test_a_dry_run_knows_what_lets_go_of_a_string(tmp_path, profile, lets_go):
    """By the profile, as the run itself refuses it in preflight."""
    rig = tmp_path / "string.yaml"
    rig.write_text(
        "load: string\nmake_up_torque_nm: 29000\ntorque_ramp_nm_s: 400\n"
        "limits: {speed_min_rad_s: 0.5, speed_max_rad_s: 10, torque_nm: 400, time_s: 900, quick_stop_rad_s2: 2,"
        " probe_torque_nm: 200, probe_travel_rad: 3}\n"
    )
    done = tdhil("identify", "--dry-run", "--simulate", "--rig", rig, "--profile", profile,
                 "--excitation", "sine", "--frequency", 0.5)
    assert done.code == (4 if lets_go else 0), done.err
    assert ("is disabled after a quick stop and would release it" in done.err) == lets_go
    assert ("quick_stop of the profile" in done.err) == lets_go
    coasting = tdhil("identify", "--dry-run", "--simulate", "--rig", rig, "--profile", profile,
                     "--excitation", "coast-down")
    assert coasting.code == 4
    assert "coast-down is not possible with a drill string on the shaft" in coasting.err
