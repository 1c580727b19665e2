"""Whole runs over EtherCAT: pysoem and a simulated drive in a process of its own, over a pair of veth interfaces."""

import os

import pytest

from tdhil.recording.log_reader import read_frames, read_run, read_samples
from tests.path.ethercat_segment import simulated_drive, why_not
from tests.path.path_runs import INERTIA, QUICK, STAGES, Shaft, host, identify, tdhil, wait_for

SETPOINTS = 2                      # sync manager of the outputs


@pytest.fixture(scope="module", autouse=True)
def _segment():
    reason = why_not()
    if reason and os.environ.get("TDHIL_REQUIRE_VETH") == "1":
        pytest.fail(f"no run over EtherCAT was tried ({reason}); TDHIL_REQUIRE_VETH=1 forbids to skip", pytrace=False)
    if reason:
        pytest.skip(f"no run over EtherCAT was tried: {reason}")


def embedded(folder, *arguments):
    trace = folder / "shaft.csv"
    done = identify(folder, "--drive", "ethercat", "--simulate", *QUICK, "--trace", trace, *arguments)
    return done, Shaft.read(trace)


@pytest.mark.heavy
def test_the_five_stages_identify_the_inertia(tmp_path):
    done, shaft = embedded(tmp_path, "--seed", 1, "--periods", 3)
    assert done.code == 0, done.err
    document = done.document
    assert document["verdict"] in ("valid", "valid_wide")
    assert done.outcomes == [(name, "ok") for name in STAGES]
    inertia = document["inertia_kg_m2"]
    assert inertia["low_total"] < INERTIA < inertia["high_total"]
    shaft.assert_never_let_go()
    assert shaft.state[-1] == "switch on disabled"
    assert document["simulated"] is True
    run = read_run(done.log)
    assert run.complete
    assert run.result == document
    frames = sum(frame.identifier == SETPOINTS and frame.time_s > 0.0 for frame in read_frames(done.log))
    assert frames == sum(1 for _ in read_samples(done.log))
    moved = done.log.rename(tmp_path / "elsewhere.mcap")
    replayed = tdhil("replay", "--json", moved)
    assert replayed.document == document | {"log": str(moved)}
    assert tdhil("export", moved, "--to", "csv").code == 0


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["maxon/epos4-ethercat", "elmo/gold-ethercat", "beckhoff/ax8000"])
def test_the_simulated_drive_has_the_units_of_each_profile(tmp_path, name):
    done, shaft = embedded(tmp_path, "--seed", 1, "--periods", 3, "--profile", name)
    assert done.code == 0, done.err
    inertia = done.document["inertia_kg_m2"]
    assert inertia["low_total"] < INERTIA < inertia["high_total"]
    shaft.assert_at_rest()


@pytest.mark.heavy
@pytest.mark.parametrize(("fault", "code", "said"), [
    ("bus-dead@speed+5s", 8, "no feedback from the drive any more"),
    ("al-error@speed+5s=001Ah", 6, "AL status code 001Ah"),
    ("sm-watchdog@speed+5s", 5, "AL status code 001Bh"),
])
def test_a_fault_ends_with_the_shaft_at_rest(tmp_path, fault, code, said):
    done, shaft = embedded(tmp_path, "--seed", 7, "--fault", fault)
    assert done.code == code, done.err
    assert said in " ".join(done.err.split())
    shaft.assert_at_rest()


@pytest.mark.long
@pytest.mark.parametrize("fault", ["frame-loss@speed=1%", "wrong-working-counter@speed=1%"])
def test_lost_frames_end_no_run(tmp_path, fault):
    done, shaft = embedded(tmp_path, "--seed", 7, "--periods", 3, "--fault", fault)
    assert done.code == 0, done.err
    inertia = done.document["inertia_kg_m2"]
    assert inertia["low_total"] < INERTIA < inertia["high_total"]
    shaft.assert_at_rest()


@pytest.mark.heavy
def test_a_killed_host_leaves_the_shaft_to_the_drives_watchdog(tmp_path):
    with simulated_drive(tmp_path, "--seed", 1, "--stepped") as drive:
        with host(tmp_path, *drive.options, *QUICK, "--stepped") as running:
            assert running.wait_for_line("stage torque …"), running.err
            running.signal(9)
            running.child.wait()
        wait_for("standstill", lambda: drive.shaft.state[-1] == "quick stop active"
                 and drive.shaft.time_s[-1] > drive.shaft.at_rest_from() + 1.5)
        drive.shaft.assert_at_rest()
