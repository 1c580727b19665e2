"""Rows 4 and 7: a killed or frozen host in its own process. Only the watchdog of the drive stops the shaft.

Time is stepped, but with a silent host the simulator continues in its own time. `tests/path/test_stops.py` tests more
stages, and `benchmarks/kill_at_random.py` fifty random times.
"""

import signal
from pathlib import Path

import pytest

from tdhil.recording.log_reader import read_run
from tests.path.path_runs import (
    PATIENT,
    PLAIN,
    host,
    peer,
    tail_time,
    tdhil,
    wait_for,
)

CYCLE_S = 0.04
SOURCES = ("drivers", "tdhil")


@pytest.fixture
def turning(no_bus_of_the_user, tmp_path, request):
    """Start peer and host, up to stage 2 after its ramp. The end of a host is found at once, a freeze by silence."""
    program = PLAIN if "frozen" in request.node.name else PATIENT
    with peer(tmp_path, "--stepped", "--seed", 1, program=program) as drive, host(
        tmp_path, *drive.options, "--stepped", "--rate", 25, "--periods", 40
    ) as running:
        assert running.wait_for_line("stage speed …"), running.err
        wait_for("speed", lambda: tail_time(drive.trace) > 12.0, running.child)
        yield drive, running


def stopped_by_its_watchdog(drive):
    wait_for("the end of the stop", drive.rests_after_watchdog)
    shaft = drive.shaft
    return round(shaft.at_rest_from() - shaft.assert_stopped_by_watchdog(CYCLE_S), 2)


@pytest.mark.heavy
def test_row_4_killed(turning, seen):
    drive, running = turning
    running.signal(signal.SIGKILL)
    done = running.finish()
    standstill_s = stopped_by_its_watchdog(drive)
    assert tdhil("recover", done.log).code == 3
    run = read_run(done.log)
    assert not run.complete
    missing_s = drive.shaft.events("running on in own time")[0] - run.recording.time_s[-1]
    assert missing_s <= 0.5 + CYCLE_S
    seen(4, "SIGKILL in stage 2: the drive's watchdog stops the shaft", standstill_s,
         f"salvaged up to {missing_s:.2f} s before the end", -9)


@pytest.mark.heavy
def test_row_7_frozen(turning, seen):
    drive, running = turning
    running.signal(signal.SIGSTOP)
    standstill_s = stopped_by_its_watchdog(drive)
    rested_s = tail_time(drive.trace)
    running.signal(signal.SIGCONT)
    done = running.finish()
    shaft = drive.shaft
    assert done.code == 5, done.err
    awake = shaft.time_s > rested_s
    assert abs(shaft.speed_rad_s[awake]).max() < 0.02
    assert "operation enabled" not in {state for state, now in zip(shaft.state, awake, strict=True) if now}
    message = done.document["error"]["message"]
    seen(7, f"SIGSTOP: the drive's watchdog stops the shaft; on waking it stays at rest: {message}", standstill_s,
         "whole" if read_run(done.log).complete else "salvageable", done.code)


def test_row_7_nothing_is_sent_by_kernel_or_thread():
    """Cyclic transmission by the kernel or another thread would feed the watchdog with setpoints of a dead host."""
    root = Path(__file__).parents[2]
    for path in (path for source in SOURCES for path in (root / source).rglob("*.py")):
        code = path.read_text(encoding="utf-8")
        assert "send_periodic(" not in code, path
    for sender in ("drive.py", "supervision.py"):
        assert "threading" not in (root / "drivers" / "canopen" / sender).read_text(encoding="utf-8")


@pytest.mark.heavy
def test_a_host_that_dies_with_a_torque_offset_at_work(no_bus_of_the_user, tmp_path):
    """The value in 60B2h stays, and the speed loop of the drive stops the shaft against it."""
    with peer(tmp_path, "--stepped", "--seed", 1) as drive, host(
        tmp_path, *drive.options, "--stepped", "--rate", 25, "--impedance", "offset", "--periods", 10
    ) as running:
        assert running.wait_for_line("stage acquire …"), running.err
        begun_s = tail_time(drive.trace)
        wait_for("the offset", lambda: tail_time(drive.trace) > begun_s + 30.0, running.child)
        running.child.send_signal(signal.SIGKILL)
        running.child.wait()
        stopped_by_its_watchdog(drive)


@pytest.mark.heavy
def test_a_rehearsal_over_a_wire(no_bus_of_the_user, tmp_path):
    """`tdhil simulate canopen --fault …` is a separate process, and receives the stages from the host."""
    with peer(tmp_path, "--stepped", "--seed", 1, "--fault", "emcy@speed+15s=4310h") as drive, host(
        tmp_path, *drive.options, "--stepped", "--rate", 25
    ) as running:
        done = running.finish()
        shaft = drive.shaft
    assert done.code == 6, done.err
    assert "EMCY 4310h, motor temperature" in done.document["error"]["message"]
    (begun_s,), (fault_s,) = shaft.events("stage 2"), shaft.events("fault: emcy")
    assert fault_s - begun_s == pytest.approx(15.0, abs=0.05)
    shaft.assert_stopped_within_settings()


@pytest.mark.parametrize(("more", "said"), [
    (("-i", "virtual", "-c", "x", "--fault", "sto"), "embedded simulator only"),
    (("--simulate", "--fault", "stop"), "no fault is called 'stop'"),
])
def test_faults_are_for_simulated_drives(more, said, no_bus_of_the_user):
    done = tdhil("identify", *more)
    assert done.code == 2
    assert said in done.err
