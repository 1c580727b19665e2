"""Whole runs over EtherCAT: pysoem and a simulated drive in its own process, over a pair of veth interfaces."""

import pytest

from tdhil.recording.log_reader import read_frames, read_run, read_samples
from tests.path.ethercat_segment import segment, simulated_drive
from tests.path.path_runs import INERTIA, QUICK, STAGES, Shaft, host, identify, tdhil

SETPOINTS = 2                      # sync manager of the outputs


_segment = pytest.fixture(scope="module", autouse=True)(segment)


def embedded(folder, *arguments):
    trace = folder / "shaft.csv"
    done = identify(folder, "--drive", "ethercat", "--simulate", *QUICK, "--trace", trace, *arguments)
    return done, Shaft.read(trace)


@pytest.mark.parametrize("seed", [pytest.param(seed, marks=pytest.mark.heavy if seed == 1 else pytest.mark.long)
                                  for seed in range(1, 21)])
def test_the_five_stages_identify_the_inertia(tmp_path, seed):
    done, shaft = embedded(tmp_path, "--seed", seed, "--periods", 3)
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
def test_stop_brings_a_drive_to_standstill_that_another_host_left_turning(tmp_path):
    with simulated_drive(tmp_path, "--seed", 1, "--stepped") as drive:
        with host(tmp_path, *drive.options, *QUICK, "--stepped") as running:
            assert running.wait_for_line("stage torque …"), running.err
            running.signal(9)
            running.child.wait()
        done = tdhil("stop", "--drive", "ethercat", *drive.options)
        assert done.code == 0, done.err
        assert "at standstill" in done.out + done.err
        drive.shaft.assert_never_let_go()
        assert abs(drive.shaft.speed_rad_s[-1]) < 0.05
