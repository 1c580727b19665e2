"""Drive that ignores the change to speed mode at the stop, and whose quick stop coasts in torque mode.

The true shaft is read from the trace: friction stops it, and the drive is disabled at standstill only.
"""

from pathlib import Path

import pytest

from profiles.library import profile_path
from tests.path.path_runs import QUICK, Shaft, identify
from tests.rigs import STRING, limits_text, rig_file

EXAMPLES = Path(__file__).parents[2] / "examples"
LIMITS = limits_text(speed_min_rad_s=2.0, speed_max_rad_s=10.0, torque_nm=4000.0, probe_torque_nm=2000.0,
                     probe_travel_rad=60.0)
KEEPS_MODE = ("--fault", "mode-not-followed@hold")


def lets_go(folder, generic):
    """Write the generic profile of a drive whose quick stop coasts in torque mode, and return its path."""
    text = profile_path(generic).read_text(encoding="utf-8").replace(f"name: {generic}", "name: own/lets-go")
    text = text.replace("decelerates_in_torque_mode: true", "decelerates_in_torque_mode: false")
    text = text.replace("eds: cia402.eds", "eds: null")
    path = folder / "lets-go.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def stopped(folder, generic, *arguments):
    """Run with such a drive, which also ignores the change to speed mode."""
    profile, trace = lets_go(folder, generic), folder / "shaft.csv"
    done = identify(folder, "--simulate", "--profile", profile, "--seed", 3, "--trace", trace, *KEEPS_MODE, *arguments)
    assert done.code == 6, done.err                    # row 32 of the fault table: no other cause ended the run
    assert done.document["error"]["code"] == "TDH-601"
    assert "stayed in torque mode" in done.document["error"]["message"]
    assert done.document["rehearsal"]["verdict"] == "pass"
    assert "the shaft is at standstill" in done.document["stop"]
    shaft = Shaft.read(trace)
    shaft.assert_never_let_go()
    assert shaft.state[-1] == "switch on disabled"
    return shaft


BUSES = [
    pytest.param("generic/cia402", id="canopen"),
    pytest.param("generic/modbus", id="modbus"),
]


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("generic", BUSES)
def test_friction_stops_the_shaft_before_the_drive_is_disabled(tmp_path, generic):
    shaft = stopped(tmp_path, generic, *QUICK, "--periods", 3)
    shaft.assert_at_rest()
    assert not shaft.events("state: quick stop active"), "its quick stop would have disabled it"


@pytest.mark.parametrize("generic", BUSES)
def test_above_a_string_such_a_drive_does_not_enter_torque_mode(tmp_path, generic):
    """If the host fails there, the watchdog of such a drive removes the torque at once."""
    rig = rig_file(tmp_path, "rate_hz: 50\n", LIMITS, STRING)
    done = identify(tmp_path, "--simulate", "--profile", lets_go(tmp_path, generic), "--rig", rig, "--mode", "torque",
                    "--plant", EXAMPLES / "plant_two_mass.yaml")
    assert done.code == 4, done.err
    assert "the torque could be removed at once" in done.document["error"]["message"]
