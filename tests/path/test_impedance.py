"""`tdhil identify --impedance` on the simulated drive by CANopen: the whole path, its replay, its faults.

The runs have 50 Hz and few periods, which takes a fifth of the usual computing time. For many seeds at the usual rate
see benchmarks/impedance_coverage.py.
"""

import json

import numpy as np
import pytest

from tdhil.recording import read_cycles, read_run
from tests.faults.rehearsal import run
from tests.path.path_runs import tdhil

OFFSET = ("--impedance", "offset", "--string-impedance", 20.56, "--periods", 8)
GAIN, INTEGRAL, INERTIA, VISCOUS, LAGS = 300.0, 300.0, 104.0, 8.0, (0.010, 0.020)      # of the simulated rig


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("impedance")
    return run(folder, *OFFSET, "--report", folder / "report.html")


@pytest.mark.heavy
def test_a_run_finds_the_gains_and_the_reflection_of_the_drive(measured):
    assert measured.done.code == 0, measured.done.err
    found = measured.done.document["impedance"]
    assert (found["verdict"], found["by"]) == ("valid", "offset")
    assert found["gain_nm_s_rad"]["value"] == pytest.approx(GAIN, rel=0.02)
    assert found["integral_nm_rad"]["value"] == pytest.approx(INTEGRAL, rel=0.01)
    assert found["inner_lag_s"]["value"] == pytest.approx(sum(LAGS), abs=0.006)
    for point in found["points"]:
        s = 2j * np.pi * point["hertz"]
        z = INERTIA * s + VISCOUS + (GAIN + INTEGRAL / s) / (1.0 + LAGS[0] * s) / (1.0 + LAGS[1] * s)
        assert point["reflection"]["value"] == pytest.approx(abs((z - 20.56) / (z + 20.56)), abs=0.005)
    assert "own impedance" in (measured.log.parent / "report.html").read_text(encoding="utf-8")


@pytest.mark.heavy
def test_its_replay_agrees(measured):
    again = tdhil("replay", measured.log, "--json")
    assert again.code == 0
    assert json.loads(again.out)["impedance"] == measured.done.document["impedance"]
    assert "drive's impedance" in tdhil("replay", measured.log).out


@pytest.mark.heavy
def test_the_log_has_every_offset_and_none_is_left_when_the_stop_begins(measured):
    cycles = [(command, sample) for command, sample in read_cycles(measured.log) if command is not None]
    offsets = np.array([command.torque_offset_nm for command, _ in cycles])
    assert 60.0 < np.max(np.abs(offsets)) <= 160.0
    acquire = read_run(measured.log).recording.stages[-1]
    assert not np.any(offsets[[sample.time_s > acquire.end_s for _, sample in cycles]])


@pytest.mark.long(but_first=3)
@pytest.mark.heavy
@pytest.mark.parametrize(("fault", "code", "words"), [
    ("frozen-feedback@acquire+25s", 5, "frozen"), ("feedback-lost@acquire+25s", 5, "no feedback"),
    ("internal-limit@acquire+25s=5%", 7, "left its window"), ("sto@acquire+25s", 6, "left the state"),
    ("heartbeat-lost@acquire+25s", 5, "heartbeat"), ("bus-dead@acquire+25s", 5, ""),
])
def test_whatever_fails_in_it_the_shaft_comes_to_rest_and_the_offset_goes_first(tmp_path, fault, code, words):
    ended = run(tmp_path, *OFFSET, "--fault", fault)
    assert ended.done.code == code or (fault.startswith("bus-dead") and ended.done.code == 8), ended.done.err
    assert words in ended.done.err
    ended.shaft.at_rest_from()
    assert abs(ended.shaft.speed_rad_s[-1]) < 0.02
    offsets = [command.torque_offset_nm for command, _ in read_cycles(ended.log) if command is not None]
    assert any(offsets) and offsets[-1] == 0.0


def test_a_drive_on_modbus_refuses_the_offset_before_anything_moves(tmp_path):
    done = tdhil("identify", "--drive", "modbus", "--simulate", "--seed", 1, *OFFSET, "--json", "--log",
                 tmp_path / "run.mcap")
    assert done.code == 4
    assert "names no register that adds a torque" in done.err
    assert "nothing has moved" in done.err


def test_a_slow_reference_is_refused_before_anything_moves(tmp_path):
    done = tdhil("identify", "--simulate", "--seed", 1, "--rate", 20, "--impedance", "reference", "--json", "--log",
                 tmp_path / "run.mcap")
    assert done.code == 4
    assert "a filter of the reference could not be identified" in " ".join(done.err.split())
    assert "nothing has moved" in done.err
