"""Rows of the fault table with causes in drive or bus: scripted in the simulated drive, on the whole path."""

from itertools import product

import pytest

from tdhil.recording.log_reader import read_run
from tests.faults.rehearsal import CONTRADICT, FEEDBACK_S, IN_MOTION, WATCHDOG_S, Case

HEARTBEAT_S = 0.7              # 0.5 s without one, which may have been due 0.1 s before

CASES = (
    Case(12, "bus-dead" + IN_MOTION, 8, ("no feedback", "drive's own watchdog"), notice_s=WATCHDOG_S, confirmed=False),
    Case(12, "bus-dead@acquire+5s", 8, ("no feedback", "drive's own watchdog"), notice_s=WATCHDOG_S, confirmed=False),
    Case(19, "feedback-lost" + IN_MOTION, 5, ("no feedback for", "supply and the bus"), notice_s=FEEDBACK_S),
    Case(19, "frozen-feedback@acquire+2s", 5, ("frozen", "gateway"), notice_s=2.0),
    Case(20, "heartbeat-lost" + IN_MOTION, 5, ("1017h", "heartbeat has been missing"), notice_s=HEARTBEAT_S),
    Case(21, "node-reset" + IN_MOTION, 6, ("boot-up", "does not enable it again"), "coasts"),
    Case(22, "foreign-nmt-stop" + IN_MOTION, 5, ("NMT state stopped", "second master")),
    Case(22, "foreign-nmt-preop" + IN_MOTION, 5, ("NMT state pre-operational", "second master"),
         notice_s=WATCHDOG_S),
    Case(23, "emcy" + IN_MOTION, 6, ("EMCY 7305h", "sensor", "--reset-fault")),
    Case(23, "drive-fault@torque+3s", 6, ("EMCY 3210h", "DC link", "--reset-fault")),
    Case(24, "sdo-abort", 4, ("6072h", "0x08000020"), "refused"),
    Case(25, "sdo-timeout", 5, ("6072h", "does not answer", "bit rate"), "refused"),
    Case(26, "second-master", 4, ("6041h", "another master", "Nothing was written"), "refused"),
    Case(26, "second-master" + IN_MOTION, 5, ("second master", "Disconnect")),
    Case(26, "duplicate-node", 4, ("node 1", "answered twice", "its own node-ID"), "refused"),
    Case(26, "duplicate-node" + IN_MOTION, 6, ("boot-up",)),
    Case(26, "replayed-feedback" + IN_MOTION, 5, ("TPDO1", "another node")),
    Case(29, "wrong-identity", 4, ("1018h", "--profile"), "refused", more=("--profile", "maxon/epos4")),
    Case(30, "fault-at-start", 4, ("6041h", "3210h", "--reset-fault"), "refused"),
    Case(31, "stuck-state@setup", 6, ("was not enabled within 3 s", "statusword", "enable input"), "refused"),
    Case(32, "mode-not-followed@setup", 4, ("6061h", "mode display"), "refused"),
    Case(32, "mode-not-followed@torque", 6, ("6061h", "torque mode", "--mode speed"), notice_s=0.6),
    Case(33, "sto" + IN_MOTION, 6, ("statusword", "STO"), "coasts"),
    Case(33, "sto@setup", 6, ("was not enabled within 3 s", "STO"), "refused"),
    Case(33, "internal-limit@torque+3s", 7, ("internal limit", "bit 11", "panel"), notice_s=4.5),
    Case(34, "load-lost@torque+3s=20%", 7, ("changes faster than this shaft", "Was the load lost?"), notice_s=2.0),
    Case(34, "load-lost@acquire+2s", 7, ("changes faster than this shaft", "Was the load lost?"), notice_s=3.0),
    Case(35, "torque-scale@speed+15s=5", 7, ("above the limit of 400 N·m",)),
    Case(36, "encoder-inverted", 4, ("sign probe", "turned backwards", "encoder wiring"), notice_s=7.0),
    Case(45, "write-not-kept", 4, ("6080h", "speed limit: required"), "refused"),
    Case(45, "reads-back-otherwise", 4, ("6072h", "torque limit: required 400"), "refused"),
    Case(50, "watchdog-not-armed", 4, ("1016h:1", "watchdog: required", "keeps turning"), "refused"),
    Case(115, "sensor-lost" + IN_MOTION, 8, (*CONTRADICT, "encoder"), "coasts", confirmed=False),
    Case(115, "sensor-lost@torque+3s", 8, (*CONTRADICT, "encoder"), notice_s=1.5, confirmed=False),
    Case(115, "sensor-frozen@acquire+2s", 8, (*CONTRADICT, "encoder"), "coasts", confirmed=False,
         backwards_rad_s=3.0),
    Case(116, "speed-lost" + IN_MOTION, 6, (*CONTRADICT, "encoder"), notice_s=0.3),
    Case(116, "speed-frozen@acquire+2s", 8, ("position", "contradict each other"), notice_s=2.0, confirmed=False),
    Case(117, "speed-scale@acquire+2s=0.5", 8, (*CONTRADICT, "reported speed"), notice_s=0.3, confirmed=False),
    Case(118, "torque-scale=0.5", 6, ("contradicts the commanded torque", "per_lsb of 6071h and 6077h"), notice_s=60.0),
    Case(118, "torque-sign@acquire+2s", 6, ("contradict", "reported"), notice_s=4.0),
    Case(119, "position-frozen" + IN_MOTION, 6, ("reported position and reported speed contradict", "6064h"),
         notice_s=2.0),
    Case(120, "feedback-zero" + IN_MOTION, 8, ("0000h", "no valid state"), confirmed=False),
    Case(120, "feedback-ones" + IN_MOTION, 8, ("FFFFh", "no valid state"), confirmed=False),
    Case(121, "quick-stop-inverted", 8, ("EMCY 7305h",), "coasts", more=("--fault", "emcy" + IN_MOTION),
         confirmed=False),
    Case(121, "motor-polarity" + IN_MOTION, 8, CONTRADICT, "coasts", confirmed=False, backwards_rad_s=6.0),
    Case(121, "torque-stuck@acquire+2s=100", 8, ("contradicts the commanded torque",), "coasts", confirmed=False),
)


AT_ONCE = ("sto" + IN_MOTION, "speed-lost" + IN_MOTION, "feedback-zero" + IN_MOTION, "encoder-inverted")
"""Faults in motion of the README's command; CI runs the others.

`test_lying_drive` has their contradictions without a bus.
"""


def at_once(case):
    return case.ends == "refused" or case.fault in AT_ONCE


@pytest.mark.parametrize("case", [
    pytest.param(case, id=case.id, marks=() if at_once(case) else pytest.mark.heavy) for case in CASES
])
def test_row(case, rehearse, seen):
    run = rehearse("--fault", case.fault, *case.more)
    standstill_s = run.assert_as(case)
    if case.ends != "refused":
        run.shaft.assert_enabled(True)
    assert ("NOT confirmed" in run.done.document["stop"]) is not case.confirmed
    if not case.confirmed:
        assert "hard-wired emergency stop" in run.done.err
        assert case.code == 8
    seen(case.row, f"`{case.fault}`: {run.message}", standstill_s, run.assert_log_whole(), run.done.code)


SOONEST = {"setup": "setup+3s", "torque": "torque+2s", "hold": "hold+2s", "acquire": "acquire+2s"}


@pytest.mark.long
@pytest.mark.parametrize(("fault", "stage"), [*product(["bus-dead", "emcy", "heartbeat-lost", "sto"], SOONEST)])
def test_the_other_stages(fault, stage, rehearse):
    run = rehearse("--fault", f"{fault}@{SOONEST[stage]}")
    run.assert_ended({"emcy": 6, "sto": 6, "bus-dead": 8}.get(fault, 5))
    run.assert_stopped(run.fault_s, HEARTBEAT_S, held=fault != "sto")
    assert run.done.outcomes[-1] == (stage, "aborted")
    run.assert_log_whole()


LOSSES = (
    (17, "frame-loss@acquire=5%", "without feedback"),
    (18, "duplicate-frames@acquire=10%", "late or twice"),
    (18, "reordered-frames@acquire=10%", "late or twice"),
)


@pytest.mark.heavy
@pytest.mark.parametrize(("row", "fault", "said"), LOSSES, ids=[fault for _, fault, _ in LOSSES])
def test_row_with_a_run_that_goes_on(row, fault, said, rehearse, seen):
    """Reaction M: the stage is marked, and the interval of J, if any, contains the true value."""
    run = rehearse("--fault", fault)
    document = run.done.document
    assert run.done.code in (0, 9), run.done.err
    outcome = {stage.name: (stage.outcome, stage.detail) for stage in read_run(run.log).stages}
    assert outcome["acquire"][0] == "degraded"
    assert said in outcome["acquire"][1]
    assert outcome["speed"][0] == "ok"
    inertia = document["inertia_kg_m2"]
    assert inertia is None or inertia["low"] <= 104.0 <= inertia["high"]
    run.shaft.assert_at_rest()
    got = f"J {inertia['low']:.1f} to {inertia['high']:.1f} kg·m² (true: 104)" if inertia else "no number"
    seen(row, f"`{fault}`: stage degraded: {outcome['acquire'][1]}; {document['verdict']}, {got}", None,
         run.assert_log_whole(), run.done.code)


@pytest.mark.heavy
def test_a_fault_that_passes(rehearse):
    """The bus is lost for less than the tolerated time, and the run continues."""
    run = rehearse("--fault", "feedback-lost@speed+15s/100ms", "--max-time", 40)
    assert run.shaft.events("fault over: ")[0] - run.fault_s == pytest.approx(0.1, abs=0.021)
    assert {stage["outcome"] for stage in run.done.document["stages"]} <= {"ok", "degraded"}
    assert "error" not in run.done.document or run.done.document["error"] is None


@pytest.mark.heavy
def test_a_script_repeats(rehearse):
    first, second = (rehearse("--fault", "frame-loss@speed+1s=20%", "--fault", "sto@speed+15s") for _ in range(2))
    assert first.message == second.message
    assert (first.shaft.speed_rad_s == second.shaft.speed_rad_s).all()
