"""End of a run in its log: typed fields, or the event of older logs."""

import signal

import pytest

from drivers.errors import CommunicationLost, DriveFault, LimitHit, PreflightRefused
from tdhil.errors import Interrupted, exit_code
from tdhil.recording.log_format import Event
from tdhil.recording.log_reader import read_run
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.run_end import find_ended
from tdhil.recording.run_log import RunLog

ERRORS = [
    PreflightRefused("wanted 1, found 2", where="6502h", next_step="Choose the profile"),
    CommunicationLost("node 1 does not answer", where="1018h"),
    DriveFault("the drive shows 'off'", next_step="Look for STO"),
    LimitHit("the speed left its window"),
    Interrupted(signal.SIGINT),
    Interrupted(signal.SIGHUP),
    ZeroDivisionError("a mistake: of ours"),
]


@pytest.mark.parametrize("error", ERRORS, ids=repr)
def test_the_cause_survives_a_round_trip(tmp_path, error):
    log = RunLog(RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True), {"options": {}})
    log.failure(3.5, error)
    log.close()
    run = read_run(tmp_path / "run.mcap")
    found = find_ended(run.configuration, run.events)
    assert (found.kind, found.exit_code, found.time_s) == (type(error).__name__, exit_code(error), 3.5)
    for part in ("what", "where", "next_step"):
        assert getattr(found, part) == getattr(error, part, str(error) if part == "what" else "")
    older = find_ended({}, run.events)
    assert (older.kind, older.exit_code, older.time_s) == (found.kind, found.exit_code, 3.5)
    assert found.what in older.what
    assert run.events[0].kind == ("interrupted" if isinstance(error, Interrupted) else "failure")


def test_a_complete_run_has_no_cause():
    assert find_ended({}, (Event(0.0, "plan", "failure is no word of ours"),)) is None


@pytest.mark.parametrize("ended", [{}, {"exit_code": "x", "time_s": None}, {"kind": 3, "exit_code": 77}, [], "text"])
def test_hostile_fields_are_harmless(ended):
    find_ended({"ended": ended}, ())
