"""Ends of a run: the true shaft comes to standstill within the time of the settings, and stays there.

The tests use two processes and stepped time. Times are plant times from the simulator's trace, independent of the host
and of wall time. A signal is sent when stderr names the stage. If the run was so quick that the signal came in the
next stage, it is repeated.
"""

import os
import signal
from itertools import pairwise, product

import pytest

from tdhil.recording.log_reader import read_run
from tdhil.report.live import LiveDisplay
from tests.path.path_runs import (
    INERTIA,
    INTERRUPTING,
    PLAIN,
    QUICK,
    STAGES,
    SWINGS_IN_RAD_S,
    TOO_MUCH,
    TORQUE_NM,
    WATCHDOG_S,
    Shaft,
    host,
    identify,
    peer,
    tail_time,
    tdhil,
    wait_for,
)
from tests.rigs import PATIENT_LIMITS, rig_file

CYCLE_S = 0.02
LONG = (*QUICK, "--periods", 40)      # no stage 5 ends before the signal arrives
STEPPED = ("--stepped", "--seed", 1)
TRIES = 4


def reached(drive, running, stage):
    """Wait until the shaft moves in a stage; return False if the run ended before."""
    if not running.wait_for_line(f"stage {stage} …"):
        return False
    if stage == "setup":
        return wait_for("probe", lambda: b"operation enabled" in drive.trace.read_bytes(), running.child)
    begun_s = tail_time(drive.trace)
    return wait_for("a row", lambda: tail_time(drive.trace) > begun_s, running.child)


def aborted_stage(log):
    return [stage.name for stage in read_run(log).stages if stage.outcome == "aborted"]


ALWAYS, HEAVY = (), pytest.mark.heavy
SELDOM = {
    ("SIGINT", "setup"): HEAVY, ("SIGINT", "acquire"): HEAVY, ("SIGINT twice", "acquire"): ALWAYS,
    ("SIGINT", "speed"): HEAVY, ("SIGINT", "torque"): HEAVY, ("SIGTERM", "speed"): HEAVY,
}
"""Marks of a signal and a stage. All other combinations are long."""


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("how", "stage"), [
        *(pytest.param(how, stage, marks=SELDOM.get((how, stage), pytest.mark.long))
          for how, stage in product(["SIGINT", "SIGTERM", "SIGINT twice"], STAGES)),
        pytest.param("SIGHUP", "speed", marks=HEAVY),
    ],
)
def test_a_signal_in_each_stage(tmp_path, how, stage):
    number = signal.Signals[how.split()[0]]
    for attempt in range(TRIES):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with peer(folder, *STEPPED) as drive, host(folder, *drive.options, "--stepped", *LONG) as running:
            assert reached(drive, running, stage), running.err
            running.signal(number)
            if "twice" in how:
                wait_for("stop", lambda drive=drive: b"quick stop active" in drive.trace.read_bytes(), running.child)
                running.signal(number)
            done = running.finish()
            shaft = drive.shaft
        assert done.code == INTERRUPTING[number], done.err
        assert "Traceback" not in done.err
        assert "the shaft is at standstill" in done.document["stop"]
        shaft.assert_enabled(True)
        assert_stopped(shaft, done)
        if aborted_stage(done.log) == [stage]:
            return
    pytest.fail(f"the signal never came in time for stage {stage}")


def assert_stopped(shaft, done):
    """Assert a few cycles from the request to the quick stop, then the ramp, standstill, and the disabled drive."""
    begun_s = shaft.assert_stopped_within_settings()
    (asked_s,) = [event.time_s for event in read_run(done.log).events if event.kind == "interrupted"]
    assert begun_s - asked_s <= 3 * CYCLE_S
    assert shaft.state[-1] == "switch on disabled"
    assert done.document["error"]["kind"] == "Interrupted"
    replayed = tdhil("replay", "--json", done.log)
    assert replayed.code in (3, 9)
    if aborted_stage(done.log) == ["setup"]:           # no data for an identification
        assert replayed.document["error"]["kind"] == "NothingRecorded"
    else:
        assert replayed.document["stages"] == done.document["stages"] or replayed.document["complete"]


@pytest.mark.heavy
@pytest.mark.real_time
def test_ctrl_c_in_real_time(tmp_path):
    """The embedded simulator runs in real time. A slow cycle and a long watchdog tolerate a loaded computer."""
    rig, trace = rig_file(tmp_path, "rate_hz: 4\n", PATIENT_LIMITS), tmp_path / "shaft.csv"
    with host(tmp_path, "--simulate", "--real-time", "--seed", 1, "--trace", trace, "--rig", rig) as running:
        assert running.wait_for_line("stage speed …"), running.err
        running.signal(signal.SIGINT)
        done = running.finish()
    assert done.code == 130, done.err
    # Late cycles of a loaded computer mark the stage as degraded. The stage must only be complete here.
    assert done.outcomes[0] in [("setup", "ok"), ("setup", "degraded")]
    assert done.outcomes[1:] == [("speed", "aborted")]
    shaft = Shaft.read(trace)
    shaft.assert_enabled(True)
    shaft.assert_stopped_within_settings()
    assert read_run(done.log).complete


@pytest.mark.parametrize("stage", [       # in stage 2 tests/faults/test_rows_process.py kills one
    pytest.param("hold", marks=pytest.mark.long), pytest.param("acquire", marks=pytest.mark.heavy),
])
def test_a_killed_host_leaves_the_shaft_to_the_drive_s_watchdog(tmp_path, stage):
    with peer(tmp_path, *STEPPED) as drive, host(tmp_path, *drive.options, "--stepped", *LONG) as running:
        assert reached(drive, running, stage), running.err
        if stage == "speed":        # after its ramp from standstill
            wait_for("speed", lambda: tail_time(drive.trace) > 12.0, running.child)
        running.signal(signal.SIGKILL)
        done = running.finish()
        assert done.code == -signal.SIGKILL
        wait_for("the end of the stop", drive.rests_after_watchdog)
        shaft = drive.shaft
    assert_stopped_by_watchdog(shaft)
    replayed = tdhil("replay", "--json", done.log)
    assert replayed.code in (3, 9), replayed.err
    assert "Traceback" not in replayed.err
    assert replayed.document["complete"] is False
    inertia = replayed.document["inertia_kg_m2"]
    assert (replayed.code == 3) == (inertia is not None)
    if inertia is not None:         # the ramps of stages 2 and 3 also give J, with its uncertainty
        assert inertia["low"] <= INERTIA <= inertia["high"]


def assert_stopped_by_watchdog(shaft):
    silent_s = shaft.assert_stopped_by_watchdog(CYCLE_S)
    # Until then the last setpoint acts: at most the torque limit on the inertia, and the decay of the torque.
    fastest = shaft.speed_at(silent_s) + (WATCHDOG_S + CYCLE_S) * TORQUE_NM / INERTIA + SWINGS_IN_RAD_S
    after = shaft.time_s >= silent_s
    assert shaft.speed_rad_s[after].max() <= fastest
    assert shaft.speed_rad_s[after].min() > -SWINGS_IN_RAD_S


@pytest.mark.heavy
def test_a_run_killed_late_in_acquire_is_replayed_as_a_partial_result(tmp_path):
    for attempt in range(TRIES):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with peer(folder, *STEPPED) as drive, host(
            folder, *drive.options, "--stepped", *QUICK, "--periods", 7
        ) as running:
            assert reached(drive, running, "acquire"), running.err
            begun_s = tail_time(drive.trace)
            # one mean speed of seven periods of 10 s, and half of the other
            if wait_for("periods", lambda drive=drive, begun_s=begun_s: tail_time(drive.trace) > begun_s + 105.0,
                        running.child):
                running.signal(signal.SIGKILL)
            done = running.finish()
            if "stage acquire ok" in done.err:          # it ended before the signal
                continue
            assert done.code == -signal.SIGKILL, done.err
            wait_for("the end of the stop", drive.rests_after_watchdog)
            assert_stopped_by_watchdog(drive.shaft)
            break
    else:
        pytest.fail("the signal never came in time")
    replayed = tdhil("replay", "--json", done.log)
    document = replayed.document
    assert replayed.code == 3, replayed.out
    assert document["complete"] is False
    assert document["verdict"] in ("valid", "valid_wide")
    assert abs(document["inertia_kg_m2"]["value"] / INERTIA - 1.0) < 0.03
    assert document["periods_used"] >= 6
    assert document["log"] == str(done.log)
    again = tdhil("replay", "--json", done.log)
    assert again.document == document


@pytest.mark.long       # tests/faults/test_rows_process.py freezes one too
def test_a_frozen_host_is_no_watchdog_either(tmp_path):
    """With SIGSTOP the connection stays open without data. After SIGCONT no stale setpoint may move the shaft."""
    with peer(tmp_path, *STEPPED, program=PLAIN) as drive, host(
        tmp_path, *drive.options, "--stepped", *LONG
    ) as running:
        assert reached(drive, running, "hold"), running.err
        running.signal(signal.SIGSTOP)
        wait_for("the end of the stop", drive.rests_after_watchdog)
        assert_stopped_by_watchdog(drive.shaft)
        rested_s = tail_time(drive.trace)
        running.signal(signal.SIGCONT)
        done = running.finish()
        shaft = drive.shaft
    assert done.code not in (0, 1), done.err
    assert "Traceback" not in done.err
    awake = shaft.time_s > rested_s
    assert abs(shaft.speed_rad_s[awake]).max() < 0.02
    assert "operation enabled" not in {state for state, now in zip(shaft.state, awake, strict=True) if now}


# -- a programming error in each stage ------------------------------------------------------------------------


@pytest.mark.parametrize("stage", [
    pytest.param(stage, marks={"torque": pytest.mark.long, "hold": pytest.mark.long, "acquire": HEAVY}.get(stage, ()))
    for stage in STAGES
])
def test_an_exception_in_each_stage(tmp_path, monkeypatch, stage):
    def begin(self, name, expected_s, plain=LiveDisplay.stage_started):
        self.under_way, self.cycles = name, 0
        plain(self, name, expected_s)

    def a_mistake_of_ours(self, command, sample):
        self.cycles += 1
        # In setup the shaft first moves after a second of standstill and a part of the probe's ramp.
        if self.under_way == stage and self.cycles == (120 if stage == "setup" else 20):
            raise ZeroDivisionError("made for this test")

    monkeypatch.setattr(LiveDisplay, "stage_started", begin)
    monkeypatch.setattr(LiveDisplay, "cycle", a_mistake_of_ours)
    trace = tmp_path / "shaft.csv"
    done = identify(tmp_path, "--simulate", *QUICK, "--seed", 1, "--trace", trace)
    assert done.code == 1
    assert "ZeroDivisionError" in done.err
    assert done.outcomes[-1] == (stage, "aborted")
    assert done.document["error"] == {
        "kind": "ZeroDivisionError", "message": "made for this test", "code": "TDH-100",
    }
    shaft = Shaft.read(trace)
    shaft.assert_enabled(True)
    begun_s = shaft.assert_stopped_within_settings()
    (kept,) = [event for event in read_run(done.log).events if event.kind == "failure"]
    assert "a_mistake_of_ours" in kept.traceback
    assert begun_s - kept.time_s <= 3 * CYCLE_S
    assert tdhil("replay", done.log).code in (3, 9)


@pytest.mark.heavy
def test_a_log_that_can_not_grow_stops_the_shaft(tmp_path):
    """The disk is full during the run. The stop still runs, and the JSON on stdout is one document."""
    import resource

    def little_room():
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    with peer(tmp_path, *STEPPED) as drive, host(
        tmp_path, *drive.options, "--stepped", *LONG, preexec_fn=little_room
    ) as running:
        done = running.finish()
        shaft = drive.shaft
    assert done.code not in (0, 130, 143), done.err
    assert "log" in done.err
    assert done.document["error"]["kind"] == "LogBroken"
    shaft.assert_enabled(True)
    shaft.assert_stopped_within_settings()
    assert tdhil("replay", done.log).code in (3, 9)


@pytest.mark.heavy
def test_the_end_of_an_interrupted_run_is_in_order(tmp_path):
    """The order in an interrupted run is: enabled, quick stop, disabled, and only then the bus is closed."""
    trace = tmp_path / "shaft.csv"
    done = identify(tmp_path, "--simulate", *QUICK, "--seed", 1, "--trace", trace, *TOO_MUCH)
    assert done.code == 7
    shaft = Shaft.read(trace)
    marks = [
        shaft.events("state: operation enabled")[0],
        shaft.events("state: quick stop active")[0],
        shaft.events("state: switch on disabled")[-1],
        shaft.events("NMT pre-operational")[-1],
    ]
    assert all(before <= behind for before, behind in pairwise(marks))
    assert len(shaft.events("state: quick stop active")) == 1
    shaft.assert_stopped_within_settings()


@pytest.mark.heavy
def test_a_dead_simulator_ends_the_host(tmp_path):
    """The drive's side of the bus disappears in this case."""
    with peer(tmp_path, *STEPPED) as drive, host(tmp_path, *drive.options, "--stepped", *LONG) as running:
        assert reached(drive, running, "speed"), running.err
        os.kill(drive.child.pid, signal.SIGKILL)
        done = running.finish()
    assert done.code == 8, done.err
    assert done.document["error"]["kind"] == "CommunicationLost"
    assert "hard-wired emergency stop" in done.err
    assert tdhil("replay", done.log).code in (3, 9)


