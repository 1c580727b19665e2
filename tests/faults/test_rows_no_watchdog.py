"""Row 50: a drive without an armed watchdog is refused, or accepted by override; both cases on both buses.

With the override, all functions of the host are unchanged. No message promises a reaction of the drive.
"""

import pytest

from tdhil.recording.log_reader import read_run
from tests.path.path_runs import tdhil
from tests.rigs import STRING, limits_text, rig_file

NOT_ARMED = ("--fault", "watchdog-not-armed")
BY_NAME = "--accept-no-watchdog"
BUSES = ("canopen", "modbus")
WATCHED = {"canopen": "1016h:1", "modbus": "time_out"}


@pytest.fixture(params=BUSES)
def bus(request):
    return request.param


@pytest.fixture
def unarmed(rehearse, bus):
    return lambda *arguments: rehearse("--drive", bus, *NOT_ARMED, *arguments)


def assert_accepted(run):
    """Assert the entries of the log: row of the preflight table, event, and configuration of the result."""
    log = read_run(run.log)
    told = {kind: [event.text for event in log.events if event.kind == kind] for kind in ("preflight", "watchdog")}
    assert [text for text in told["preflight"] if text.startswith("no watchdog: ") and BY_NAME in text]
    assert not [text for text in told["preflight"] if "(refused)" in text]
    assert ["will not stop by itself" in text for text in told["watchdog"]] == [True]
    assert log.configuration["watchdog"] == {"armed": False, "accepted_by": BY_NAME}
    assert "will not stop by itself" in " ".join(run.done.err.split())


def test_no_other_switch_takes_it(unarmed, bus, seen):
    run = unarmed("--yes", "--accept-unverified", "likely", "--accept-unverified", "watchdog")
    run.assert_ended(4, BY_NAME if bus == "canopen" else "register 40")
    run.assert_nothing_moved()
    assert BY_NAME in run.message
    log = run.assert_log_whole()
    if bus == "modbus":                # the scripted row covers the other bus
        seen(50, f"the same on Modbus: {run.message}", None, log, run.done.code)


@pytest.mark.heavy
def test_taken_by_name_the_host_still_stops_the_shaft(unarmed, bus, seen):
    cause, code = ("emcy@speed+15s", 6) if bus == "canopen" else ("torque-scale@speed+15s=5", 7)
    run = unarmed(BY_NAME, "--fault", cause)
    run.assert_ended(code)
    assert_accepted(run)
    standstill_s = run.assert_stopped(run.shaft.events("fault: ")[-1], 0.6)
    run.shaft.assert_enabled(True)
    assert "the shaft is at standstill" in run.done.document["stop"]
    seen(50, f"{bus}, {BY_NAME}: accepted, and reported; `{cause}` then: {run.message}", standstill_s,
         run.assert_log_whole(), run.done.code)


@pytest.mark.heavy
def test_taken_by_name_and_the_line_is_gone(unarmed, bus, seen):
    """The operator accepted this: nothing stops the shaft. The message names only the hard-wired stop."""
    cause = "bus-dead@speed+15s" if bus == "canopen" else "no-reply@speed+15s"
    run = unarmed(BY_NAME, "--fault", cause)
    run.assert_ended(8, "no watchdog is armed", "hard-wired emergency stop")
    assert "watchdog stops the shaft" not in run.message
    assert "NOT confirmed" in run.done.document["stop"]
    assert abs(run.shaft.speed_rad_s[-1]) > 1.0, "the simulated drive has an active watchdog"
    detail = read_run(run.log).stages[-1].detail
    assert "watchdog stops the shaft" not in detail
    seen(50, f"{bus}, {BY_NAME}, `{cause}`: {run.message}", None, run.assert_log_whole(), run.done.code)


def test_set_otherwise_is_refused_by_name_too(rehearse, bus):
    fault = f"reads-back-otherwise={WATCHED[bus]}"
    run = rehearse("--drive", bus, "--fault", fault, BY_NAME)
    run.assert_ended(4, "with another setting")
    run.assert_nothing_moved()
    run.assert_log_whole()


def test_never_with_a_string(unarmed, tmp_path):
    run = unarmed(BY_NAME, "--rig", rig_file(tmp_path, "name: bench 3\n", STRING, limits_text()))
    run.assert_ended(4, "drill string", "no watchdog", BY_NAME, "load in rig.yaml")
    run.assert_nothing_moved()
    run.assert_log_whole()


@pytest.mark.heavy
def test_the_result_says_so_live_and_replayed(rehearse):
    """The shortest run on one bus is sufficient: all other parts are the same."""
    run = rehearse(*NOT_ARMED, BY_NAME, "--periods", 3, "--mode", "speed")
    assert run.done.code in (0, 9), run.done.err
    assert_accepted(run)
    run.shaft.assert_at_rest()
    assert [line for line in run.done.document["warnings"] if "no watchdog was armed" in line and BY_NAME in line]
    assert tdhil("replay", "--json", run.log).document == run.done.document
