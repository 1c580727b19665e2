"""Rows of the fault table with causes in another node, master, tool or panel on CANopen; checks of the true shaft.

If the host is killed, the watchdog of the drive stops the shaft. These tests show that no other node takes over the
watchdog. A run is refused, uses another node number, or ends at standstill before a kill is possible.
"""

import pytest

from tdhil.errors import ExitCode
from tdhil.recording.log_reader import read_run

IN_MOTION = "@speed+15s"       # at 4 rad/s

STOPPED = (
    (56, "foreign-heartbeat" + IN_MOTION, 1.1, ("77Fh", "watchdog if this host fails")),
    (56, "foreign-heartbeat" + IN_MOTION + "=20s", 20.2, ("77Fh", "watchdog if this host fails")),
    (57, "tool-writes" + IN_MOTION, 0.2, ("1016h:1", "8323572 (7F01F4h) was set, 0 is there now")),
    (57, "tool-writes" + IN_MOTION + "=6007h=0", 0.2, ("6007h", "3 was set, 0 is there now")),
    (58, "setting-changed" + IN_MOTION, 6.2, ("6007h", "the watchdog's reaction was changed")),
    (58, "setting-changed" + IN_MOTION + "=1016h:1=0", 6.2, ("1016h:1", "the drive's watchdog was changed")),
    (58, "setting-changed" + IN_MOTION + "=605Ah=0", 6.2, ("605Ah", "6 was set, 0 is there now")),
    (59, "foreign-setpoints" + IN_MOTION, 0.1, ("RPDO4, 501h", "second master")),
    (60, "sdo-master" + IN_MOTION, 0.1, ("by SDO", "second master")),
)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("row", "fault", "notice_s", "words"), STOPPED, ids=[row[1] for row in STOPPED])
def test_noticed_and_stopped(row, fault, notice_s, words, rehearse, seen):
    run = rehearse("--fault", fault)
    run.assert_ended(5, *words)
    standstill_s = run.assert_stopped(run.fault_s, notice_s)
    assert "at standstill" in run.done.document["stop"]
    assert max(run.shaft.speed_rad_s[run.shaft.time_s >= run.fault_s]) < 10.0
    seen(row, f"`{fault}`: {run.message}", standstill_s, run.assert_log_whole(), run.done.code)


@pytest.mark.heavy
def test_a_number_that_is_taken_from_the_start_is_not_the_host_s(rehearse, seen):
    run = rehearse("--fault", "foreign-heartbeat", "--max-time", 40)
    assert run.done.document.get("error") is None, run.done.err
    preflight = [event.text for event in read_run(run.log).events if event.kind == "preflight"]
    (line,) = [text for text in preflight if text.startswith("host's node number")]
    assert "126, because another node uses 127" in line
    run.shaft.assert_at_rest()
    seen(56, f"`foreign-heartbeat`: {line}", None, run.assert_log_whole(), run.done.code)


@pytest.mark.heavy
def test_stray_writes_that_the_cycle_undoes_are_told(rehearse, seen):
    run = rehearse(
        "--fault", "tool-writes@speed+15s=6040h=6", "--fault", "tool-writes@speed+18s=6060h=4", "--max-time", 40
    )
    assert run.done.document.get("error") is None, run.done.err
    warnings = " ".join(run.done.document["warnings"])
    for text in ("6040h = 6h was written by another master, 1 time",
                 "6060h = 4h was written by another master, 1 time"):
        assert text in warnings
        assert text in run.done.err
    events = [event.text for event in read_run(run.log).events if event.kind == "bus"]
    assert events == ["another master wrote 6040h = 6h by SDO", "another master wrote 6060h = 4h by SDO"]
    assert run.shaft.at_rest_from() <= run.shaft.time_s[-1] - 1.0
    rehearsal = run.done.document["rehearsal"]     # the drive was disabled in motion, and not by this host
    assert (run.done.code, rehearsal["verdict"]) == (ExitCode.OK, "pass"), rehearsal["seen"]
    seen(61, f"reported at the end: {warnings}", None, run.assert_log_whole(), run.done.code)


@pytest.mark.heavy
def test_a_quick_stop_that_is_undone_again_and_again_is_left_to_the_watchdog(rehearse, seen):
    """The host stops its sign of life and continues to read. The reaction of the drive itself brakes the shaft."""
    run = rehearse("--fault", f"foreign-setpoints{IN_MOTION}=again")
    events = [event for event in read_run(run.log).events if event.kind in ("bus", "stop")]
    assert any("in spite of the quick stop" in event.text for event in events)
    (lost_s,) = run.shaft.events("host heartbeat lost")
    assert lost_s - run.fault_s <= 5.0
    assert run.shaft.at_rest_from() <= float(run.done.document["stop"].split("seen at ")[1].split(" s")[0]) + 1.0
    standstill_s = run.assert_stopped(run.fault_s, 5.0)
    seen(62, f"`foreign-setpoints=again`: {run.done.document['stop']}", standstill_s, run.assert_log_whole(),
         run.done.code)
