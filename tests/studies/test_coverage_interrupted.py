"""Ctrl-C during the benchmark: the figures of completed runs are kept, shown, and marked as partial."""

import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tdhil.errors import TdhilError
from tdhil.studies.coverage import simulate, study
from tdhil.studies.coverage.plants import FLEET
from tdhil.studies.coverage.simulate import SimulatedRun
from tdhil.studies.coverage.study import COVERAGE, CoverageSettings
from tdhil.studies.output import StudyBar

ROOT = Path(__file__).parents[2]


def some_runs(wanted, processes):
    """Run two groups, then raise Ctrl-C."""
    for task in wanted[:2]:
        yield tuple(SimulatedRun(task.plant.name, number, 100.0, "valid", "", 104.0, 103.0, 105.0)
                    for number in range(task.first, task.first + task.count))
    raise KeyboardInterrupt


@pytest.mark.heavy
def test_completed_runs_are_kept(monkeypatch):
    monkeypatch.setattr(study, "run_all", some_runs)
    heard = []
    outcome = COVERAGE.run(CoverageSettings(seeds=60, plants=["field", "paper"]), lambda *told: heard.append(told))
    assert outcome.interrupted
    assert "interrupted: 40 of 120 runs" in outcome.title
    assert outcome.document["interrupted"] == {"runs": 40, "of": 120}
    assert [(row[0], row[3]) for row in outcome.tables[0].rows] == [("field", 40)]
    assert heard[1][1].startswith("field: 20 of 60 runs; 20 of 120 in all, about ")
    assert heard[-1] == (1.0, "interrupted")


def test_before_the_first_runs_no_data_are_kept(monkeypatch):
    def at_once(wanted, processes):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(study, "run_all", at_once)
    with pytest.raises(KeyboardInterrupt):
        COVERAGE.run(CoverageSettings(seeds=1, plants=["field"]), lambda *told: None)


@pytest.mark.heavy
def test_a_complete_benchmark_has_no_mark(monkeypatch):
    monkeypatch.setattr(study, "run_all", _all)
    outcome = COVERAGE.run(CoverageSettings(seeds=2, plants=["field"]), lambda *told: None)
    assert not outcome.interrupted
    assert "interrupted" not in outcome.document


def _all(wanted, processes):
    return [tuple(SimulatedRun(task.plant.name, n, 100.0, "valid", "", 104.0, 103.0, 105.0) for n in range(task.count))
            for task in wanted]


def test_without_a_terminal_there_is_one_line_per_minute(monkeypatch):
    from io import StringIO

    from rich.console import Console

    from tdhil.studies import output

    now = [0.0]
    monkeypatch.setattr(output.time, "monotonic", lambda: now[0])
    out = StringIO()
    with StudyBar(Console(file=out), 1).of(0, "coverage") as progress:
        for second in range(0, 200, 10):
            now[0] = float(second)
            progress(second / 200, f"run {second}")
    assert out.getvalue().splitlines() == [
        "study coverage …", "study coverage  30 %  run 60", "study coverage  60 %  run 120",
        "study coverage  90 %  run 180"]


ONE_BY_ONE = """
import sys
from tdhil.cli.main import main
from tdhil.studies.coverage import simulate as coverage_runs
if __name__ == "__main__":
    coverage_runs.GROUP = 1            # the first figures come sooner
    sys.exit(main())
"""


@pytest.mark.heavy
def test_ctrl_c_on_a_terminal(tmp_path):
    """The whole command runs in its own terminal, which sends Ctrl-C to the workers too."""
    command = [sys.executable, "-c", ONE_BY_ONE, "study", "coverage", "--json", "--out", str(tmp_path / "out"),
               "--set", "seeds=2000", "--set", "plants=[coarse]", "--set", "periods=4"]
    leader, follower = pty.openpty()
    with (tmp_path / "stdout").open("wb") as out:
        child = subprocess.Popen(command, cwd=ROOT, stdout=out, stderr=follower, stdin=follower, start_new_session=True)
    os.close(follower)
    os.set_blocking(leader, False)
    shown, end_s = b"", time.monotonic() + 600
    try:
        while time.monotonic() < end_s and child.poll() is None and b"of 2000 in" not in shown:
            shown += read_some(leader)
        assert b"of 2000 in" in shown
        os.killpg(child.pid, signal.SIGINT)
        while child.poll() is None and time.monotonic() < end_s:
            shown += read_some(leader)
        assert child.wait(60) == 130
    finally:
        child.kill()
    shown += read_some(leader)
    os.close(leader)
    said = json.loads((tmp_path / "stdout").read_text())
    done = said["interrupted"]["runs"]
    assert 1 <= done < 2000
    assert said["tables"]["coverage"][0]["runs"] == done
    assert (tmp_path / "out" / "coverage" / "coverage.csv").exists()
    assert b"was interrupted" in shown
    assert b"Traceback" not in shown


def read_some(descriptor):
    try:
        return os.read(descriptor, 65536)
    except BlockingIOError:
        time.sleep(0.05)
    except OSError:                # the other end is closed
        time.sleep(0.05)
    return b""


def dies(task):
    os.abort()


@pytest.mark.heavy
def test_a_process_that_dies_ends_the_benchmark(monkeypatch):
    monkeypatch.setattr(simulate, "run_task", dies)
    with pytest.raises(TdhilError, match=r"process .* died.*SIGABRT.*fewer of them"):
        list(simulate.run_all([simulate.SimulationTask(FLEET[0], 0, 1, 1, 2, 0.95)], 2))
