"""Full disk during a run of the whole command: the shaft comes to standstill, and the written data are kept."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from tdhil.recording.log_reader import read_run

QUICK = ("--rate", "50", "--seed", "1", "--periods", "4")
ROOT = Path(__file__).parents[2]


def identify(log, room):
    """Run the command with a limit of ``room`` bytes for its files."""
    def cap():
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    command = [sys.executable, "-m", "tdhil", "identify", "--simulate", *QUICK, "--json", "--log", str(log)]
    return subprocess.run(command, cwd=ROOT, preexec_fn=cap, capture_output=True, text=True, timeout=600)


@pytest.mark.heavy
def test_a_log_that_fails_during_a_run_stops_the_shaft(tmp_path):
    done = identify(tmp_path / "run.mcap", 100_000)
    said = json.loads(done.stdout)
    assert (done.returncode, said["exit_code"]) == (3, 3), done.stderr
    assert said["error"]["kind"] == "LogBroken"
    assert "at standstill" in said["stop"]
    assert "can't be written any more" in done.stderr
    assert "Traceback" not in done.stderr
    run = read_run(tmp_path / "run.mcap")
    assert not run.complete
    assert run.recording.time_s[-1] > 5.0
    assert (tmp_path / "run.mcap").stat().st_size <= 100_000


@pytest.mark.heavy
def test_a_disk_without_room_refuses_the_run(tmp_path):
    done = identify(Path("/dev/full"), 10**9)
    assert done.returncode == 4, done.stderr
    assert "No space left" in done.stderr


@pytest.mark.heavy
def test_a_disk_that_fails_at_the_end_does_not_lose_the_result(tmp_path, monkeypatch, capsys):
    from tdhil.cli.main import main
    from tdhil.errors import LogBroken
    from tdhil.recording.log_writer import RunWriter
    from tdhil.recording.mcap_container import Container

    def full(self):
        raise OSError(28, "No space left on device")

    def broken(self, result):
        raise LogBroken("the log can't be written any more")

    monkeypatch.setattr(Container, "finish", full)
    monkeypatch.setattr(RunWriter, "result", broken)
    log = tmp_path / "run.mcap"
    code = main(["identify", "--simulate", *QUICK, "--json", "--log", str(log)])
    said = capsys.readouterr()
    assert json.loads(said.out)["verdict"] == "valid"
    assert code == 3
    assert "No space left" in said.err
    assert len(read_run(log).recording.time_s) > 1000
