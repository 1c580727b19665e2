"""Peer without the simulator's marker: it is treated as a real drive, since it cannot be distinguished from one.

There is no motion without limits and a confirmation. The tests use real time, like a real shaft. A signal ends each run
once the check is complete. Cycle and watchdog are slow, so that pauses of a loaded computer have no effect on the
drive.
"""

import signal
import sys
import time

import pytest

from tests.path.path_runs import HANGS_S, REAL, Terminal, host, identify, peer, tail_time, wait_for
from tests.rigs import PATIENT_LIMITS, PATIENT_S, rig_file

pytestmark = pytest.mark.real_time

ACCEPTED = "accept_unverified: [likely]\n"
RIG = f"rate_hz: 4\n{ACCEPTED}{PATIENT_LIMITS}name: bench 3\nrun: {{excitation: sine, frequency_hz: 0.2}}\n"


@pytest.fixture
def rig(tmp_path):
    return rig_file(tmp_path, RIG)


@pytest.fixture
def drive(tmp_path):
    with peer(tmp_path, program=REAL) as running:
        yield running


def assert_untouched(drive):
    """Assert that the drive was never enabled and the shaft never moved."""
    drive.child.terminate()
    drive.child.wait()
    shaft = drive.shaft
    shaft.assert_enabled(False)
    assert abs(shaft.speed_rad_s).max() == 0.0
    return shaft


def enabled(drive):
    return b"operation enabled" in drive.trace.read_bytes()


def at_rest_after(drive):
    """Return the motion of the shaft, some plant time after the end of the host."""
    gone_s = tail_time(drive.trace)
    wait_for("some more rows", lambda: tail_time(drive.trace) > gone_s + 1.5)
    shaft = drive.shaft
    shaft.assert_at_rest()
    return shaft


@pytest.mark.heavy
def test_without_a_rig_it_is_refused(tmp_path, drive):
    for yes in ((), ("--yes",)):
        done = identify(tmp_path, *drive.options, *yes)
        assert done.code == 4
        assert done.document["error"]["kind"] == "PreflightRefused"
        for key in ("speed_max_rad_s", "torque_nm", "time_s", "--rig"):
            assert key in done.err
        assert "nothing has moved" in done.err
        assert "SIMULATED" not in done.err
    assert_untouched(drive)


@pytest.mark.heavy
def test_a_rig_without_limits_is_refused(tmp_path, drive):
    rig = rig_file(tmp_path, "node: 1\n")
    done = identify(tmp_path, *drive.options, "--rig", rig, "--yes")
    assert done.code == 4
    assert "no machine limits" in done.err
    assert_untouched(drive)


@pytest.mark.heavy
def test_unverified_entries_are_refused_with_their_sources(tmp_path, drive, rig):
    rig.write_text(RIG.replace(ACCEPTED, ""))
    done = identify(tmp_path, *drive.options, "--rig", rig, "--yes")
    assert done.code == 4
    assert done.document["error"]["kind"] == "PreflightRefused"
    for said in ("6 entries", "speed (likely): CiA 402-2, 606Ch", "watchdog (likely)", "profiles show generic/cia402",
                 "--accept-unverified likely", "nothing has moved"):
        assert said in done.err
    partly = identify(tmp_path, *drive.options, "--rig", rig, "--yes", "--accept-unverified", "speed",
                      "--accept-unverified", "watchdog")
    assert partly.code == 4
    assert "4 entries" in partly.err
    assert "speed (likely)" not in partly.err
    shaft = assert_untouched(drive)
    assert not shaft.events("heartbeat supervision began")


@pytest.mark.heavy
def test_without_a_terminal_and_without_yes_it_is_refused(tmp_path, drive, rig):
    with host(tmp_path, *drive.options, "--rig", rig) as running:
        done = running.finish()
    assert done.code == 4
    assert done.outcomes == [("setup", "aborted")]
    assert "--yes" in done.err
    assert "preflight" in done.err                    # the table was shown
    assert "This run will move" in done.err
    assert "although unverified" in done.err
    assert "torque (likely): CiA 402-2" in done.err
    assert "SIMULATED" not in done.err
    assert_untouched(drive)


@pytest.mark.heavy
def test_stepped_time_is_refused(tmp_path, drive, rig):
    done = identify(tmp_path, *drive.options, "--rig", rig, "--yes", "--stepped")
    assert done.code == 4
    assert "marker" in done.err
    assert "real time" in done.err
    shaft = assert_untouched(drive)
    assert not shaft.events("heartbeat supervision began")


@pytest.mark.heavy
def test_yes_replaces_the_prompt(tmp_path, drive, rig):
    with host(tmp_path, *drive.options, "--rig", rig, "--yes") as running:
        assert running.wait_for_line("stage speed …"), running.err
        running.signal(signal.SIGTERM)
        done = running.finish()
    assert done.code == 143
    assert "Confirmed by --yes." in done.err
    assert "peak torque     400 N·m" in done.err
    assert "SIMULATED" not in done.err
    shaft = at_rest_after(drive)
    shaft.assert_enabled(True)
    assert shaft.speed_rad_s.max() > 0.1
    assert not shaft.events("host heartbeat lost")


@pytest.fixture
def prompt(tmp_path, drive, rig):
    """Yield a run on a terminal that waits at the prompt."""
    with Terminal(sys.executable, "-m", "tdhil", "identify", *drive.options, "--rig", rig, cwd=tmp_path) as terminal:
        assert terminal.read_until("anything else to cancel:"), terminal.plain
        yield terminal


@pytest.mark.parametrize("answer", [
    pytest.param("move", marks=pytest.mark.heavy), pytest.param("MOVE it", marks=pytest.mark.long),
    pytest.param("", marks=pytest.mark.heavy),
])
def test_a_wrong_word_moves_nothing(prompt, drive, answer):
    prompt.type(answer + "\n")
    assert prompt.finish() == 4
    assert "not confirmed" in prompt.plain
    assert "nothing has moved" in prompt.plain
    assert_untouched(drive)


@pytest.mark.heavy      # no word: see `without_a_terminal`, and tests/api/test_front_door.py
def test_end_of_input_moves_nothing(prompt, drive):
    prompt.type("\x04")
    assert prompt.finish() == 4
    assert_untouched(drive)


@pytest.mark.heavy
def test_ctrl_c_at_the_prompt_moves_nothing(prompt, drive):
    prompt.type("\x03")
    assert prompt.finish() == 130
    assert "Traceback" not in prompt.plain
    assert_untouched(drive)


@pytest.mark.heavy
def test_the_word_moves_the_shaft_and_the_prompt_fed_the_watchdog(prompt, drive):
    assert not enabled(drive)
    for asked in ("brake released", "pipe handler", "emergency stop", "watchdog        5 s in the drive"):
        assert asked in prompt.plain
    before_s = tail_time(drive.trace)
    end = time.monotonic() + HANGS_S
    while tail_time(drive.trace) < before_s + 1.5 * PATIENT_S:
        assert time.monotonic() < end
        prompt.read_until("anything else")            # the operator decides for longer than the watchdog time
        time.sleep(0.05)
    assert not enabled(drive)
    prompt.type("MOVE\n")
    prompt.read_until("enabled, speed mode")          # stage speed, as the live display shows it
    prompt.type("\x03")
    assert prompt.finish() == 130
    assert "the shaft is at standstill" in prompt.plain
    assert "SIMULATED" not in prompt.plain
    shaft = at_rest_after(drive)
    shaft.assert_enabled(True)
    assert not shaft.events("host heartbeat lost")
