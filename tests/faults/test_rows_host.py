"""Rows of the fault table with causes in the host: signals, errors, disks, files, setpoints."""

import os
import signal
from itertools import product

import pytest

from drivers.drive import PowerState
from sim_bus.canopen.simulator import EmbeddedSimulator
from tdhil.errors import LogBroken
from tdhil.recording.log_reader import read_run
from tdhil.recording.run_log import RunLog
from tdhil.report.live import LiveDisplay
from tdhil.runner import stage_planner
from tdhil.runner.control_loop import ControlLoop
from tests.faults.rehearsal import at
from tests.path.path_runs import tdhil
from tests.rigs import limits_text, rig_file

NOTICED_AT_ONCE_S = 0.1
SPEEDS = ("speed", 15.0)


def kill(number):
    return lambda sample: os.kill(os.getpid(), number)


def stopped_by_host(run, since_s, seen, row, code, *words):
    run.assert_ended(code, *words)
    standstill_s = run.assert_stopped(since_s, NOTICED_AT_ONCE_S)
    assert run.shaft.state[-1] == "switch on disabled"
    assert "the shaft is at standstill" in run.done.document["stop"]
    seen(row, run.message, standstill_s, run.assert_log_whole(), code)


@pytest.mark.heavy
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 143),
                                              (signal.SIGQUIT, 143)])
def test_rows_1_3_a_signal(number, code, rehearse, monkeypatch, seen):
    acted = at(monkeypatch, *SPEEDS, kill(number))
    run = rehearse()
    stopped_by_host(run, acted[0], seen, 1 if number == signal.SIGINT else 3, code, "interrupted by")


@pytest.mark.heavy
def test_row_2_a_second_signal_during_the_stop(rehearse, monkeypatch, seen):
    acted = at(monkeypatch, *SPEEDS, kill(signal.SIGINT))
    plain, again = LiveDisplay.cycle, []

    def cycle(self, command, sample):
        plain(self, command, sample)
        if sample.state is PowerState.QUICK_STOP and len(again) < 3:
            again.append(sample.speed_rad_s)
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(LiveDisplay, "cycle", cycle)
    run = rehearse()
    assert min(again) > 1.0                          # while the shaft still turned
    stopped_by_host(run, acted[0], seen, 2, 130, "interrupted by Ctrl-C")


@pytest.mark.heavy
@pytest.mark.parametrize("where", ["control loop", "planning thread"])
def test_row_5_a_mistake_of_ours(where, rehearse, monkeypatch, seen):
    def mistake(*_arguments, **_options):
        raise ZeroDivisionError("made for this test")

    if where == "control loop":
        acted = at(monkeypatch, *SPEEDS, mistake)
        run = rehearse()
        since_s = acted[0]
    else:
        monkeypatch.setattr(stage_planner, "plan_acquisition", mistake)
        run = rehearse()
        since_s = next(event.time_s for event in read_run(run.log).events if event.kind == "failure")
    assert run.done.code == 1
    assert "made for this test" in run.message
    standstill_s = run.assert_stopped(since_s, NOTICED_AT_ONCE_S)
    (kept,) = [event for event in read_run(run.log).events if event.kind == "failure"]
    assert "ZeroDivisionError" in kept.traceback
    seen(5, f"in the {where}: {run.message}; traceback kept in the log", standstill_s, run.assert_log_whole(), 1)


@pytest.mark.heavy
def test_row_6_a_stop_that_is_not_confirmed(rehearse, monkeypatch, seen):
    """The drive ignores the quick stop. It follows the setpoint of zero speed, and its watchdog acts at the end."""
    acted = at(monkeypatch, "speed", 16.0, kill(signal.SIGINT))
    run = rehearse("--fault", "stuck-state@speed+15s")
    run.assert_ended(8)
    assert "NOT confirmed" in run.done.document["stop"]
    assert "Use the hard-wired emergency stop now" in run.done.err
    assert "interrupted" in run.message              # the first cause is kept
    assert run.shaft.state[-1] == "quick stop active"
    seen(6, "use the hard-wired emergency stop now; the setpoint of zero stops the shaft nevertheless, and the drive is"
         " not disabled", run.assert_stopped(acted[0], NOTICED_AT_ONCE_S), run.assert_log_whole(), 8)


@pytest.mark.heavy
def test_row_10_the_log_can_not_be_written(rehearse, monkeypatch, seen):
    plain, full = RunLog.cycle, []

    def cycle(self, command, sample):
        if full:
            raise LogBroken("the disk is full", where="run.mcap", next_step="Make room and start anew")
        plain(self, command, sample)

    monkeypatch.setattr(RunLog, "cycle", cycle)
    acted = at(monkeypatch, *SPEEDS, full.append)
    run = rehearse()
    stopped_by_host(run, acted[0], seen, 10, 3, "the disk is full", "Make room")


def test_row_27_a_wrong_node_id(no_bus_of_the_user, tmp_path, seen):
    with EmbeddedSimulator(node_id=1) as simulated:
        done = tdhil("identify", "-i", "virtual", "-c", simulated.channel, "--stepped", "--node", 5, "--json",
                     "--log", tmp_path / "run.mcap")
    assert done.code == 4
    message = done.document["error"]["message"]
    for word in ("node 5 does not answer", "node-ID and bit rate"):
        assert word in message
    seen(27, message, None, "whole", 4)


@pytest.mark.parametrize(("name", "text"), [("bad.yaml", "profile: [\n"), ("two.yaml", "name: a\nname: b\n")])
def test_row_28_a_malformed_profile(name, text, no_bus_of_the_user, tmp_path, seen):
    (tmp_path / name).write_text(text)
    done = tdhil("identify", "--simulate", "--profile", name)
    assert done.code == 2
    assert f"{name}:" in done.err
    assert "Traceback" not in done.err
    seen(28, done.err.strip().splitlines()[0], None, "none begun", 2)


@pytest.mark.heavy
@pytest.mark.parametrize("which", ["time", "travel"])
def test_row_35_time_and_travel(which, rehearse, tmp_path, seen):
    short = {"time": {"time_s": 20.0}, "travel": {"probe_travel_rad": 0.02}}[which]
    run = rehearse("--rig", rig_file(tmp_path, limits_text(**short)))
    begun_s = run.shaft.events("state: quick stop active")[0] - 0.04
    code, *words = {"time": (7, "longer than the limit of 20 s", "limits.time_s"),
                    "travel": (4, "without a clear direction", "sign probe")}[which]
    run.assert_ended(code, *words)
    seen(35, run.message, run.assert_stopped(begun_s, NOTICED_AT_ONCE_S), run.assert_log_whole(), code)


NONE = (float("nan"), float("inf"), 1e9)


@pytest.mark.heavy
@pytest.mark.parametrize(("field", "value"), [*product(["torque_nm", "speed_rad_s"], NONE)])
def test_row_37_a_setpoint_that_is_none(field, value, rehearse, monkeypatch, seen):
    due, plain = [], ControlLoop.cycle

    def poisoned(bench, command):
        return plain(bench, command._replace(**{field: value}) if due else command)

    monkeypatch.setattr(ControlLoop, "cycle", poisoned)
    acted = at(monkeypatch, "speed", 3.0, due.append)
    run = rehearse()
    assert run.done.code == 1
    assert "setpoint" in run.message
    standstill_s = run.assert_stopped(acted[0], NOTICED_AT_ONCE_S)
    seen(37, run.message, standstill_s, run.assert_log_whole(), 1)


@pytest.mark.heavy
def test_row_49_an_aborted_run_begins_anew(rehearse, seen):
    """A run cannot be resumed. The next run starts with a new preflight, from standstill."""
    rehearse("--fault", "emcy@speed+3s").assert_ended(6)
    run = rehearse("--fault", "emcy@speed+3s")
    assert [name for name, _ in run.done.outcomes] == ["setup", "speed"]
    seen(49, "a new run begins with a new preflight at stage 1; no option continues an older run", None,
         run.assert_log_whole(), 6)


