"""Verdict of a rehearsed fault: required reaction, observed reaction, pass or fail, and exit code."""

import re
from dataclasses import replace

import numpy as np
import pytest

from sim_bus import RigParams, TrueShaft, read_shaft
from sim_bus.trace import HEADER
from tdhil.buses import PeerPlan, bus_named
from tdhil.errors import DriveFault, ExitCode, Interrupted, LimitHit, exit_code
from tdhil.recording import Stage
from tdhil.report import card_text, rehearsal_of
from tdhil.runner import RunOutcome
from tdhil.runner.stop import StopReport
from tdhil.session import ANY_FAULT, REQUIRED, RehearsedShaft, judge_rehearsal
from tests.faults.rows import ROWS
from tests.path.path_runs import identify, tdhil

STOPPED = StopReport(confirmed=True, at_rest_s=9.0, disabled=True)
LOST = StopReport(confirmed=False, at_rest_s=None, disabled=False)
STAGES = (Stage("setup", 0.0, 4.0, "ok"), Stage("speed", 4.0, 7.0, "aborted"))
HOLDS, MISSES = (
    {"verdict": "valid", "inertia_kg_m2": {"value": 0.5 * (low + high), "low_total": low, "high_total": high}}
    for low, high in ((99.0, 108.0), (110.0, 118.0))
)


def judged(*faults, cause=None, stop=STOPPED, document=None, code=None, never=(), shaft=None, untraced=""):
    bus = bus_named("canopen")
    peer = PeerPlan(True, True, 1, RigParams(), bus.parse_faults(faults), never_came=list(never))
    return judge_rehearsal(peer, "canopen", RunOutcome(STAGES, cause, stop, None), document, code,
                           shaft=RehearsedShaft(shaft, untraced, 10.0))


def shaft(speeds, *, on_until_s, disabled_s=()):
    """Return a simulated shaft with the speed interpolated between (time, speed), every 10 ms up to 20 s."""
    time_s = np.arange(0.0, 20.0, 0.01)
    speed = np.interp(time_s, [t for t, _ in speeds], [w for _, w in speeds])
    return TrueShaft(time_s, speed, np.full_like(time_s, 400.0), time_s < on_until_s, disabled_s, stop_s=5.0)


REST = replace(STOPPED, at_rest_s=14.5)
COASTS = [(0, 0), (4, 4), (7, 4), (14, 0)]


@pytest.mark.parametrize(("motion", "stop", "verdict", "seen"), [
    (shaft(COASTS, on_until_s=15, disabled_s=(15.0,)), REST, "pass", "reached 4.00 rad/s and stood still at the end"),
    (shaft(COASTS, on_until_s=7, disabled_s=(7.0,)), LOST, "fail",
     "UNSAFE, the simulated shaft: the drive was disabled at 4.00 rad/s"),
    (shaft([(0, 4), (20, 4)], on_until_s=99), LOST, "fail", "still turned under torque at the end, at 4.00 rad/s"),
    (shaft([(0, 4), (20, 4)], on_until_s=3), LOST, "pass", "turned without torque at the end"),
    (shaft([(0, 4), (10, 42), (20, 42)], on_until_s=5, disabled_s=(12.0,)), replace(LOST, torque_removed=True), "fail",
     "reached 42.00 rad/s, the limit is 10 rad/s"),
    (shaft([(0, 4), (9, 4), (14, 0)], on_until_s=15), STOPPED, "fail", "standstill was reported at 4.00 rad/s"),
])
def test_a_rehearsal_is_compared_with_the_simulated_shaft(motion, stop, verdict, seen):
    rehearsal = judged("sensor-lost@speed+3s", cause=LimitHit("reports contradict each other"), stop=stop, shaft=motion)
    assert (rehearsal.verdict, rehearsal.faults[0].verdict) == (verdict, verdict) and seen in rehearsal.seen
    by_hand = judged("sensor-lost@speed+3s", cause=Interrupted(2), stop=stop, code=130, shaft=motion)
    assert by_hand.verdict == ("fail" if verdict == "fail" else "inconclusive")


@pytest.mark.parametrize(("fault", "found", "verdict", "code"), [
    ("sto@speed+3s", {"cause": DriveFault("off")}, "pass", 6),
    ("sto@speed+3s", {"cause": LimitHit("too fast")}, "pass", 7),
    ("heartbeat-lost@speed", {"cause": LimitHit("too fast")}, "fail", 12),
    ("heartbeat-lost@speed", {"document": HOLDS, "code": 0}, "fail", 12),
    ("heartbeat-lost@speed/100ms", {"document": HOLDS, "code": 0}, "pass", 0),
    ("heartbeat-lost@speed", {"cause": DriveFault("off"), "stop": LOST}, "fail", 8),
    ("torque-scale=1.01", {"document": HOLDS, "code": 0}, "pass", 0),
    ("torque-scale=1.1", {"document": MISSES, "code": 0}, "fail", 12),
    ("torque-scale=1.1", {"document": {"verdict": "not_identifiable", "inertia_kg_m2": None}, "code": 9}, "pass", 9),
    ("frame-loss=1%", {"document": MISSES, "code": 0}, "fail", 12),
    ("tool-writes@speed=6040h=6", {"document": HOLDS, "code": 0}, "pass", 0),
    ("tool-writes@speed=1016h:1=0", {"document": HOLDS, "code": 0}, "fail", 12),
    ("sto@speed+3s", {"cause": Interrupted(2)}, "inconclusive", 130),
    ("sto@hold", {"cause": DriveFault("off"), "never": ["sto@hold"]}, "inconclusive", 6),
    ("demand-scale=1.1", {"document": MISSES, "code": 0}, "fail", 12),
])
def test_the_verdict_is_the_row_s(fault, found, verdict, code):
    rehearsal = judged(fault, **found)
    own = found.get("code")
    own = own if own is not None else 8 if found.get("stop") is LOST else exit_code(found["cause"])
    assert (rehearsal.verdict, rehearsal.exit_code(int(own))) == (verdict, code)
    (one,) = rehearsal.faults
    assert one.required == REQUIRED.get(one.row, ANY_FAULT).words
    assert not re.search(r"\b(QS|WD|R|M)\b", one.required)
    assert ("TDH-1200" in rehearsal.lines[0]) is (verdict == "fail")


def test_a_fault_that_did_not_occur_is_no_pass_beside_one_that_did():
    rehearsal = judged("emcy@speed+1s", "sto@acquire", cause=DriveFault("7305h"), never=["sto@acquire"])
    assert [one.verdict for one in rehearsal.faults] == ["pass", "inconclusive"]
    assert rehearsal.verdict == "inconclusive" and "Not triggered: sto@acquire" in rehearsal.seen


def test_no_rehearsal_passes_without_the_motion_of_the_simulated_shaft():
    found = judged("sto@speed+3s", cause=DriveFault("off"), untraced="no temporary folder: disk full")
    assert (found.verdict, found.exit_code(6)) == ("inconclusive", 6)
    assert "the motion of the simulated shaft is not known (no temporary folder: disk full)" in found.seen
    failed = judged("heartbeat-lost@speed", cause=LimitHit("too fast"), untraced="no temporary folder: disk full")
    assert failed.verdict == "fail"


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("broken", "reason"), [
    ("tdhil.session.run_session.TemporaryDirectory", "no temporary folder"), ("sim_bus.read_shaft", "cannot be read"),
])
def test_a_rehearsal_goes_on_without_the_trace_of_the_shaft(no_bus_of_the_user, monkeypatch, tmp_path, broken, reason):
    def fails(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(broken, fails)
    done = identify(tmp_path, "--simulate", "--fault", "sto@speed+3s")
    assert done.code == ExitCode.DRIVE_FAULT
    found = done.document["rehearsal"]
    assert found["verdict"] == "inconclusive" and reason in found["seen"]


def test_a_damaged_trace_is_no_shaft(tmp_path):
    path = tmp_path / "shaft.csv"
    path.write_text(f"{HEADER}0.01,1.0,2.0,switched on,\n0.02,1.0\n", encoding="utf-8")
    with pytest.raises(ValueError, match="5 columns"):
        read_shaft(path)


@pytest.mark.parametrize("drive", ["canopen", "modbus"])
def test_every_row_that_a_script_names_has_its_required_reaction(drive):
    rows = {one.row for one in bus_named(drive).faults() if one.row}
    assert rows <= set(REQUIRED)
    assert all(ROWS[row].expected == REQUIRED[row].reaction for row in rows)


def test_a_log_may_contain_any_text():
    assert rehearsal_of({"rehearsal": {"verdict": 3, "faults": [{"row": "x"}, 5]}})["faults"][0]["row"] == 0
    assert rehearsal_of({"rehearsal": 5}) is None and rehearsal_of({}) is None


@pytest.mark.heavy
def test_a_refusal_that_is_required_passes_in_document_and_on_the_terminal(rehearse):
    run = rehearse("--fault", "wrong-identity", "--profile", "maxon/epos4")
    assert run.done.code == ExitCode.REFUSED
    assert run.done.document["rehearsal"]["verdict"] == "pass"
    assert run.done.document["rehearsal"]["faults"][0]["row"] == 29
    assert "tdhil: rehearsal: pass (rows of docs/reference/faults.md)" in run.done.err


@pytest.mark.heavy
def test_a_lie_that_no_signal_shows_fails_in_document_card_and_exit_code(rehearse):
    """The power stage gives nine tenths of the reported torque. J is too large, and no signal shows it."""
    run = rehearse("--fault", "torque-constant=0.8")
    document = run.done.document
    assert document["inertia_kg_m2"]["low_total"] > 104.0
    assert run.done.code == ExitCode.NOT_PASSED
    assert document["rehearsal"]["verdict"] == "fail" and "OUTSIDE" in document["rehearsal"]["seen"]
    assert "rehearsal" in card_text(document) and "fail" in card_text(document)
    again = tdhil("replay", run.log, "--json")
    assert (again.code, again.document["rehearsal"]) == (run.done.code, document["rehearsal"])
