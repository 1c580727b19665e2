"""SIGKILL during a run: the log is readable, and at most its last half second is missing."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tdhil.recording.log_reader import read_run
from tests.recording.log_runs import CONFIGURATION, LEVELS

REAL_TIME = """
import random, sys, time
from pathlib import Path
from tests.recording.log_runs import CONFIGURATION, LEVELS, frames, sample
from tdhil.recording.log_writer import RunWriter

writer, rng = RunWriter(Path(sys.argv[1]), epoch_ns=0, block=False), random.Random(1)
writer.configuration(CONFIGURATION, {"gear_ratio": 3.0})
writer.excitation(None, LEVELS)
start, cycle = time.monotonic(), 0
while True:
    for frame in frames(cycle, rng):
        writer.frame(frame)
    writer.sample(sample(cycle, rng))
    print(cycle * 0.004, flush=True)
    cycle += 1
    left_s = start + cycle * 0.004 - time.monotonic()
    start -= min(0.0, left_s)           # as the control loop, which catches up with nothing that it overslept
    time.sleep(max(0.0, left_s))
"""

STEPPED = REAL_TIME.replace("block=False", "block=True, queue_size=256").replace("time.sleep(", "float(")


def run_and_kill(path, after_s, script=REAL_TIME):
    child = subprocess.Popen(
        [sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])
    last_s = 0.0
    for line in child.stdout:
        last_s = float(line)
        if last_s >= after_s:
            child.send_signal(signal.SIGKILL)
            break
    rest = child.stdout.read().split("\n")[:-1]    # its output up to the kill
    child.stdout.close()
    assert child.wait() == -signal.SIGKILL
    return float(rest[-1]) if rest else last_s


@pytest.mark.heavy
def test_a_killed_run_is_replayed_up_to_its_last_half_second(tmp_path):
    for after_s in (1.0, 1.37):
        last_s = run_and_kill(tmp_path / "run.mcap", after_s)
        run = read_run(tmp_path / "run.mcap")
        assert not run.complete
        assert not run.recording.complete
        time_s = run.recording.time_s
        assert last_s - time_s[-1] <= 0.5 + 0.1    # a loaded computer may delay the thread a little
        np.testing.assert_array_equal(time_s, np.arange(len(time_s)) * 0.004)
        assert (run.configuration, run.result) == (CONFIGURATION, None)
        assert (run.recording.gear_ratio, run.recording.levels) == (3.0, LEVELS)
        assert "not closed" in run.problems[-1]


@pytest.mark.heavy
def test_in_stepped_time_the_queue_bounds_the_loss_by_a_kill(tmp_path):
    """Four records per cycle give 0.26 s of control time in the queue and 0.4 s in the open chunk."""
    last_s = run_and_kill(tmp_path / "run.mcap", 20.0, STEPPED)
    time_s = read_run(tmp_path / "run.mcap").recording.time_s
    assert last_s - time_s[-1] <= 256 / 4 * 0.004 + 0.4 + 0.02
    np.testing.assert_array_equal(time_s, np.arange(len(time_s)) * 0.004)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("cycle_s", [0.001, 0.004, 0.1])
def test_in_stepped_time_the_default_queue_keeps_to_half_a_second_too(tmp_path, cycle_s):
    """The queue alone could contain minutes at 10 Hz. One cycle may be printed and not yet queued."""
    script = STEPPED.replace("queue_size=256", "queue_size=None").replace("0.004", str(cycle_s))
    first = f"from tests.recording import log_runs; log_runs.PERIOD_S = {cycle_s}\n"
    script = script.replace("from tests.recording", f"{first}from tests.recording")
    last_s = run_and_kill(tmp_path / "run.mcap", 2000 * cycle_s, script)
    time_s = read_run(tmp_path / "run.mcap").recording.time_s
    assert last_s - time_s[-1] <= 0.4 + 2 * cycle_s
    np.testing.assert_allclose(time_s, np.arange(len(time_s)) * cycle_s)
