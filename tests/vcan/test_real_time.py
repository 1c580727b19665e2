"""Ten runs in real time, at the rate that each of them chooses, against a simulated drive in a process of its own.

A guest beside the other tests is a slow and a busy computer: late frames, bursts and stalls are to be expected. What
must hold on any computer: a run gives J, covered by its interval or with none, or it ends with 5 and says that this
computer was late; nobody else is blamed, and the shaft comes to rest. How many of a hundred longer ones come through
on a computer that isn't overloaded, and how many cycles they miss, is measured by benchmarks/real_time_runs.py.
"""

from __future__ import annotations

import math
import os

import pytest
from path_runs import INERTIA, PLAIN, identify, peer

from tdhil.record.reader import read_run

pytestmark = pytest.mark.real_time
RUNS = 10
SHORT = ("--mode", "speed", "--frequency", 1, "--periods", 12)
"""Half a minute of motion before the excitation, and twelve seconds of it."""


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    interface = os.environ.get("TDHIL_VCAN") or "vcan0"
    options = ("-i", "socketcan", "-c", interface, "--seed", 5)
    with peer(tmp_path_factory.mktemp("drive"), *options, program=PLAIN) as here:
        yield here


@pytest.fixture(autouse=True)
def no_bus_of_the_user(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("number", range(RUNS))
def test_a_run_gives_its_result_or_says_that_this_computer_was_late(drive, tmp_path, number):
    done = identify(tmp_path, *drive.options, *SHORT)
    assert done.log.exists(), done.err
    run = read_run(done.log)
    counters, rate_hz = run.configuration["counters"], run.configuration["cycle"]["rate_hz"]
    print(f"exit {done.code}, {rate_hz:g} Hz, {counters}")
    assert [one["rate_hz"] for one in run.configuration["rate_tried"]][-1] == rate_hz
    if done.code == 5:
        said = done.document["error"]["message"]
        assert said.startswith("host"), said
        assert "somebody else" not in said
        assert "supply" not in said
    else:
        assert done.code in (0, 9), done.err
        j = done.document["inertia_kg_m2"]
        assert j is None or not math.isfinite(j["low"]) or j["low"] <= INERTIA <= j["high"], j
    assert abs(drive.shaft.speed_rad_s[-1]) < 0.05
    drive.shaft.assert_never_let_go()
