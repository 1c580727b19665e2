"""Rows beyond the fifty that the guard, the rules for a string, the stop and the end of a run handle."""

import os
from pathlib import Path

import pytest

from tdhil.recording.log_reader import read_run
from tdhil.recording.log_writer import Pump
from tests.faults.rehearsal import at
from tests.rigs import STRING, limits_text, rig_file


@pytest.mark.parametrize(("drive", "profile"), [("canopen", "siemens/s120-canopen"), ("modbus", "siemens/g130-s120")])
def test_a_string_and_a_quick_stop_that_lets_go(drive, profile, rehearse, tmp_path, seen):
    run = rehearse("--drive", drive, "--profile", profile, "--rig", rig_file(tmp_path, STRING, limits_text()))
    run.assert_ended(4, "drill string", "is disabled after a quick stop", "quick_stop of the profile")
    run.assert_nothing_moved()
    seen(79, f"`load: string` with {profile}: {run.message}", None, run.assert_log_whole(), run.done.code)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("drive", "first", "never", "code"), [
    ("canopen", "emcy@speed+1s", "sto@acquire+7s", 6), ("modbus", "drive-fault@speed+1s", "sto@9999s", 6),
    ("canopen", "write-not-kept", "sto@speed", 4), ("modbus", "write-not-kept", "drive-fault@speed", 4),
])
def test_a_fault_that_never_comes_is_said(drive, first, never, code, rehearse, seen):
    """Faults that occurred are not listed. Faults from the start count as occurred, even in a refused run."""
    run = rehearse("--drive", drive, "--fault", first, "--fault", never)
    assert run.done.code == code, run.done.err
    (said,) = [line for line in run.done.err.splitlines() if "was not triggered" in line]
    assert said.startswith(f"tdhil: --fault {never} was not triggered")
    events = [event.text for event in read_run(run.log).events if event.kind == "fault"]
    assert events == [f"--fault {never} was not triggered"]
    seen(81, said, None, run.assert_log_whole(), run.done.code)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("drive", "when"), [
        ("canopen", "hold+2s"), ("modbus", "acquire+5s"),
        pytest.param("canopen", "acquire+5s", marks=pytest.mark.heavy),
    ],
)
def test_a_mode_that_is_lost_in_motion(drive, when, rehearse, seen):
    run = rehearse("--drive", drive, "--fault", f"mode-lost@{when}")
    run.assert_ended(6, "left its mode", "torque mode is commanded", "another master")
    standstill_s = run.assert_stopped(run.fault_s, 1.0)
    assert run.done.outcomes[-1] == (when.split("+")[0], "aborted")
    seen(82, f"in {when}: {run.message}", standstill_s, run.assert_log_whole(), run.done.code)


@pytest.mark.heavy
@pytest.mark.parametrize("drive", ["canopen", "modbus"])
def test_a_shaft_that_does_not_follow_in_speed_mode(drive, rehearse, seen):
    """The torque is sufficient for a tenth of the limit, and friction needs more."""
    run = rehearse("--drive", drive, "--fault", "internal-limit@speed+8s=10%")
    run.assert_ended(7, "does not follow", "deviating since", "limit", "brake or the load")
    standstill_s = run.assert_stopped(run.fault_s, 8.0)
    seen(83, run.message, standstill_s, run.assert_log_whole(), run.done.code)


def _thread_dies(path):
    """Make the next call in the thread raise, as if it ran out of memory."""
    def dead(*_arguments):
        raise SystemExit("killed")

    Pump._drain = dead


@pytest.mark.heavy
@pytest.mark.parametrize(("how", "said"), [
    (Path.unlink, "removed while it was being written"), (lambda path: os.truncate(path, 100), "was cut to 100 of"),
    (_thread_dies, "killed"),
], ids=["removed", "cut short", "thread dies"])
def test_a_log_that_is_taken_away(how, said, rehearse, monkeypatch, tmp_path, seen):
    monkeypatch.setattr(Pump, "_drain", Pump._drain)           # restored afterwards
    acted = at(monkeypatch, "speed", 15.0, lambda sample: how(tmp_path / "run.mcap"))
    run = rehearse()
    run.assert_ended(3, "can't be written any more", said, "run.mcap")
    standstill_s = run.assert_stopped(acted[0], 1.5)
    assert "the shaft is at standstill" in run.done.document["stop"]
    seen(84, run.message.replace(str(tmp_path), "."), standstill_s, "gone", run.done.code)
