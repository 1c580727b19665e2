"""End-to-end rehearsal of `tdhil identify --drive ethercat --simulate --fault …` over a pair of veth interfaces."""

import pytest

from sim_bus.ethercat.faults import KINDS
from tests.faults.rehearsal import CONTRADICT, FEEDBACK_S, IN_MOTION, WATCHDOG_S, Case
from tests.path.ethercat_segment import segment, simulated_drive
from tests.path.path_runs import INERTIA, QUICK, host, wait_for

_segment = pytest.fixture(scope="module", autouse=True)(segment)

READ_BACK_S = 6.0              # ten requests without a reply

CASES = (
    Case(12, "bus-dead" + IN_MOTION, 8, ("no feedback", "drive's own watchdog"), notice_s=WATCHDOG_S),
    Case(12, "bus-dead@acquire+5s", 8, ("no feedback", "drive's own watchdog"), notice_s=WATCHDOG_S),
    Case(19, "frozen-feedback@acquire+2s", 5, ("frozen", "gateway"), notice_s=2.0),
    Case(21, "node-reset" + IN_MOTION, 6, ("INIT", "does not enable it again"), "coasts"),
    Case(23, "emcy" + IN_MOTION, 6, ("EMCY 7305h", "sensor", "--reset-fault")),
    Case(23, "drive-fault@torque+3s", 6, ("EMCY 3210h", "DC link", "--reset-fault")),
    Case(24, "sdo-abort", 4, ("6072h", "0x08000020"), "refused"),
    Case(25, "sdo-timeout", 5, ("no answer to an SDO request (CoE) for 6072h",), "refused"),
    Case(29, "wrong-identity", 4, ("1018h", "vendor 4h"), "refused"),
    Case(30, "fault-at-start", 4, ("6041h", "3210h", "--reset-fault"), "refused"),
    Case(31, "stuck-state@setup", 6, ("was not enabled within 3 s", "statusword", "enable input"), "refused"),
    Case(32, "mode-not-followed@setup", 4, ("6061h", "mode display"), "refused"),
    Case(32, "mode-not-followed@torque", 6, ("6061h", "torque mode", "--mode speed"), notice_s=0.6),
    Case(33, "sto" + IN_MOTION, 6, ("statusword", "STO"), "coasts"),
    Case(33, "internal-limit@torque+3s", 7, ("internal limit", "bit 11", "panel"), notice_s=4.5),
    Case(34, "load-lost@acquire+2s", 7, ("changes faster than this shaft", "Was the load lost?"), notice_s=3.0),
    Case(36, "encoder-inverted", 4, ("sign probe", "turned backwards", "encoder wiring"), notice_s=7.0),
    Case(45, "write-not-kept", 4, ("6080h", "speed limit: required"), "refused"),
    Case(45, "reads-back-otherwise", 4, ("6072h", "torque limit: required 400"), "refused"),
    Case(50, "watchdog-not-armed", 4, ("0400h, 0420h", "watchdog: required", "keeps turning"), "refused"),
    Case(82, "mode-lost" + IN_MOTION, 6, ("left its mode", "another master"), notice_s=0.6),
    Case(115, "sensor-lost" + IN_MOTION, 8, (*CONTRADICT, "encoder"), "coasts"),
    Case(116, "speed-lost" + IN_MOTION, 6, (*CONTRADICT, "encoder"), notice_s=0.3),
    Case(118, "torque-scale=0.5", 6, ("contradicts the commanded torque", "per_lsb"), notice_s=60.0),
    Case(120, "feedback-zero" + IN_MOTION, 8, ("0000h", "no valid state")),
    Case(120, "feedback-ones" + IN_MOTION, 8, ("FFFFh", "no valid state")),
    Case(121, "motor-polarity" + IN_MOTION, 8, CONTRADICT, "coasts", backwards_rad_s=6.0),
    Case(122, "al-error" + IN_MOTION + "=001Ah", 6, ("AL status code 001Ah", "synchronization error")),
    Case(122, "al-error@acquire+2s=001Ah", 6, ("AL status code 001Ah", "synchronization error")),
    Case(123, "sm-watchdog" + IN_MOTION, 5, ("AL status code 001Bh", "watchdog has tripped")),
    Case(124, "wrong-working-counter" + IN_MOTION + "=100%", 5, ("no feedback for", "supply and the bus"),
         notice_s=FEEDBACK_S),
    Case(125, "mailbox-timeout", 4, ("no answer to an SDO request", "--position"), "refused"),
    Case(125, "mailbox-timeout" + IN_MOTION, 5, ("can't be read back", "gateway"), notice_s=READ_BACK_S),
    Case(126, "sii-garbage", 4, ("SII", "vendor FFFFFFFFh", "EEPROM"), "refused"),
)
WITH_EACH_COMMIT = {"bus-dead" + IN_MOTION, "al-error" + IN_MOTION + "=001Ah", "sm-watchdog" + IN_MOTION, "sii-garbage",
                    "sdo-timeout", "watchdog-not-armed", "drive-fault@torque+3s"}
"""Faults that CI rehearses; `test_rows_scripted` has the others on CANopen, through the same code of CiA 402."""


@pytest.mark.parametrize("case", [
    pytest.param(case, id=case.id,
                 marks=pytest.mark.heavy if case.fault in WITH_EACH_COMMIT else pytest.mark.long) for case in CASES
])
def test_row(case, rehearse, seen):
    run = rehearse("--drive", "ethercat", "--fault", case.fault)
    standstill_s = run.assert_as(case)
    if case.code == 8:
        assert "NOT confirmed" in run.done.document["stop"] and "hard-wired emergency stop" in run.done.err
    if case.row > 121:
        seen(case.row, f"`{case.fault}`: {run.message}", standstill_s, run.assert_log_whole(), run.done.code)


@pytest.mark.long
@pytest.mark.parametrize(("row", "fault", "outcome"), [
    (17, "frame-loss=1%", "degraded"), (124, "wrong-working-counter=1%", "degraded"),
    (127, "clock-jump@acquire+2s", "ok"), (127, "clock-jump@speed+15s=-1", "ok"),
    (125, "mailbox-timeout@speed+15s/2s", "ok"),
])
def test_row_with_a_run_that_goes_on(row, fault, outcome, rehearse, seen):
    """The interval of J contains the true value."""
    run = rehearse("--drive", "ethercat", "--fault", fault)
    document = run.done.document
    assert run.done.code == 0, run.done.err
    assert dict(run.done.outcomes)["speed"] == outcome
    inertia = document["inertia_kg_m2"]
    assert inertia["low_total"] <= INERTIA <= inertia["high_total"]
    run.shaft.assert_at_rest()
    seen(row, f"`{fault}`: {document['verdict']}, J {inertia['low_total']:.1f} to {inertia['high_total']:.1f} kg·m²"
         f" (true: {INERTIA:g})", None, run.assert_log_whole(), run.done.code)


KILLED_IN = ("setup", "speed", "torque", "hold", "acquire")


def stands(shaft):
    """Return whether the shaft is at standstill. The plant time does not advance before the drive is enabled."""
    moved = shaft.at_rest_from() > 0.0
    return shaft.state[-1] != "operation enabled" and (
        not moved or shaft.time_s[-1] > shaft.at_rest_from() + 1.5)


@pytest.mark.parametrize(("stage", "number"), [
    pytest.param(stage, number, marks=pytest.mark.heavy if (stage, number) == ("torque", 0) else pytest.mark.long)
    for stage in KILLED_IN for number in range(4)
])
def test_row_4_killed(tmp_path, stage, number):
    """The watchdog of the process data expires in each of 20 kills, and the drive stops the shaft."""
    with simulated_drive(tmp_path, "--seed", 1 + number, "--stepped") as drive:
        with host(tmp_path, *drive.options, *QUICK, "--stepped") as running:
            assert running.wait_for_line(f"stage {stage} …"), running.err
            at_s = drive.shaft.time_s[-1] + 0.7 * number
            wait_for("the moment of the kill", lambda: drive.shaft.time_s[-1] >= at_s)
            running.signal(9)
            running.child.wait()
        wait_for("standstill", lambda: stands(drive.shaft))
        if drive.shaft.at_rest_from() > 0.0:
            drive.shaft.assert_at_rest()


def test_every_fault_of_this_bus_is_rehearsed():
    rehearsed = " ".join((*(case.fault for case in CASES), "frame-loss wrong-working-counter clock-jump"))
    assert [name for name, kind in KINDS.items() if kind.row < 115 or kind.row > 121 if name not in rehearsed
            if kind.row] == []
