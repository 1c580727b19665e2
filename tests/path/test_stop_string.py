"""Stop of a simulated drill string on the whole path: twisted, oscillating, or stuck at the bottom."""

from pathlib import Path

import pytest

from tests.path.path_runs import HELD, Shaft, identify
from tests.rigs import STRING, limits_text, rig_file

EXAMPLES = Path(__file__).parents[2] / "examples"


def string_rig(folder, speed, torque, probe, ramp, time):
    limits = limits_text(speed_min_rad_s=2.0, speed_max_rad_s=speed, torque_nm=torque, time_s=time,
                         quick_stop_rad_s2=ramp, probe_torque_nm=probe, probe_travel_rad=60.0)
    return rig_file(folder, "rate_hz: 100\n", limits, STRING, "run: {mode: speed}\n")


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("plant", "speed", "torque", "probe", "ramp", "time"),
    [("plant_two_mass.yaml", 10.0, 4000.0, 2000.0, 2.0, 160.0), ("plant_string.yaml", 10.0, 4000.0, 2000.0, 2.0, 160.0),
     ("plant_stick_slip.yaml", 22.0, 15000.0, 8000.0, 3.0, 160.0)],
)
def test_a_string_is_stopped_and_released_before_a_disable(tmp_path, plant, speed, torque, probe, ramp, time):
    rig, trace = string_rig(tmp_path, speed, torque, probe, ramp, time), tmp_path / "shaft.csv"
    done = identify(
        tmp_path, "--simulate", "--seed", 3, "--plant", EXAMPLES / plant, "--rig", rig, "--trace", trace
    )
    assert done.code == 7, done.err                        # no time is left for stage 5, while it turns
    assert "the shaft is at standstill" in done.document["stop"]
    shaft = Shaft.read(trace)
    assert shaft.state[-1] == "switch on disabled"
    off = max(k for k, state in enumerate(shaft.state) if state in HELD)
    begun_s = sum(stage["duration_s"] for stage in done.document["stages"])
    stopped = [k for k, time_s in enumerate(shaft.time_s[:off]) if time_s > begun_s]
    residual_nm = max(0.02 * torque, 5.0 * 0.001 * 20000.0 if "stick" in plant else 50.0)
    # In its last second of operation the drive has nearly no torque, and the shaft does not turn.
    last = shaft.time_s[off] - 1.0
    held = [(t, w) for s, t, w in zip(shaft.time_s[:off], shaft.torque_nm, shaft.speed_rad_s, strict=False) if s > last]
    assert abs(sum(t for t, _ in held) / len(held)) < 2.0 * residual_nm
    assert max(abs(w) for _, w in held) < 0.15
    # Afterwards it does not move.
    assert max(abs(w) for w in shaft.speed_rad_s[off:]) < 0.05
    # The string was twisted: the torque before was much larger.
    assert max(abs(shaft.torque_nm[k]) for k in stopped) > 4.0 * residual_nm


def test_the_example_of_a_string_stops_without_a_rig_file(tmp_path):
    from sim_bus.params import RigParams
    from sim_bus.params import load_rig as load_plant
    from tdhil.config.rig import Rig, load_rig
    from tdhil.session.task import suited

    bench = suited(None, load_plant(EXAMPLES / "plant_string.yaml"))
    assert (bench.load.kind, bench.limits.torque_nm, bench.make_up_torque_nm) == ("string", 4000.0, 8000.0)
    assert suited(None, None) is None
    assert suited(None, RigParams()) is None
    assert suited(Rig(node=3), load_plant(EXAMPLES / "plant_two_mass.yaml")).node == 3
    rig = load_rig(string_rig(tmp_path, 10, 400, 200, 2, 20))
    assert suited(rig, load_plant(EXAMPLES / "plant_string.yaml")) is rig
