"""Every shipped profile in the five stages, or their speed-mode variant, on the simulator with that profile.

The tests use one seed. `benchmarks/every_profile.py` uses twenty and measures the coverage.
"""

from statistics import fmean

import pytest

from profiles.library import load_profile, profile_names
from tests.path.path_runs import Shaft, identify, tdhil

TRUE_KG_M2 = 104.0
# tests/path/test_five_stages.py runs generic/cia402. EPOS4 takes four times as long as any other profile.
# The simulated EtherCAT drive accepts its own profile only (tests/path/test_ethercat_path.py).
NAMES = [name for name in profile_names()
         if name not in ("generic/cia402", "maxon/epos4") and load_profile(name).bus != "ethercat"]


def weighed(name):
    """Mark the profiles: CI runs one per bus, since the others differ in registers only.

    Also, tests/path/test_cli_modbus.py runs the generic profile, and test_braking_probe.py those of vendors.
    """
    heavy = name in ("siemens/g120", "siemens/s120-canopen")
    return pytest.param(name, marks=pytest.mark.heavy if heavy else pytest.mark.long)


@pytest.mark.parametrize("name", [weighed(name) for name in NAMES])
def test_the_inertia(name, tmp_path):
    trace = tmp_path / "shaft.csv"
    profile = load_profile(name)
    by_name = ["--accept-no-watchdog"] if profile.watchdog.kind == "none" else []
    done = identify(tmp_path, "--simulate", "--profile", name, "--seed", 2, "--trace", trace, *by_name)
    assert done.code == 0, done.err
    document = done.document
    assert document["verdict"] in ("valid", "valid_wide")
    inertia = document["inertia_kg_m2"]
    assert inertia["value"] == pytest.approx(TRUE_KG_M2, rel=0.02)
    assert inertia["low"] < TRUE_KG_M2 < inertia["high"]
    outcomes = dict(done.outcomes)
    assert [outcomes[stage] for stage in ("setup", "speed", "acquire")] == ["ok"] * 3
    if not profile.can_torque:                        # no torque mode, or none in motion
        assert (outcomes["torque"], outcomes["hold"]) == ("skipped", "skipped")
    Shaft.read(trace).assert_at_rest()


@pytest.mark.parametrize("seeds", [
    pytest.param(range(1, 4), marks=pytest.mark.heavy),
    pytest.param(range(1, 12), marks=pytest.mark.long),
], ids=["3 seeds", "11 seeds"])
def test_the_cross_check_of_a_slow_line_has_no_bias(seeds, tmp_path):
    """On a rig of `rig new` with 15 cycles per second, the cross-check of a good run used to be 3 % too high.

    The mean of n independent results deviates by at most the stated half-width over the root of n, with 95 % coverage.
    For 200 seeds of each profile see `benchmarks/cross_check_alarms.py`.
    """
    rig = tmp_path / "rig.yaml"
    assert tdhil("rig", "new", "--profile", "siemens/g120", "--load", "none", "--name", "bench", rig).code == 0
    checked, found = [], []
    for seed in seeds:
        done = identify(tmp_path, "--simulate", "--rig", rig, "--seed", seed, log=f"{seed}.mcap")
        assert done.code == 0, done.err
        (opinion,) = done.document["second_opinions"]
        assert opinion["agrees"] is True, (seed, opinion)
        checked.append(opinion["inertia_kg_m2"])
        found.append(done.document["inertia_kg_m2"])
    for estimates in (checked, found):
        allowed = 0.5 * fmean(one["high"] - one["low"] for one in estimates) / len(estimates) ** 0.5
        assert fmean(one["value"] for one in estimates) == pytest.approx(TRUE_KG_M2, abs=allowed)
