"""Who is there while a run goes: the code and what voids it, the board, and what a page is told of a stop."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from drivers import Check, Command, Identity, Mode, Outcome, PowerState, PreflightRefused, Sample
from tdhil.recording import Stage
from tdhil.run import ExcitationRequest, MachineLimits, Task
from tdhil.service.attending import CODE_S, TRIES, Board, Confirming, ServiceAttendant, Watcher
from tdhil.service.states import State, Status, now
from tdhil.service.store import Store
from tests.service.conftest import wait_for

TASK = Task(MachineLimits(0.5, 10.0, 400.0, 900.0, probe_torque_nm=200.0), ExcitationRequest())
COMMAND = Command(Mode.TORQUE, 0.0, 50.0)
SAMPLE = Sample(1.0, 0.0, 0.0, True, 3.0, 50.0, None, Mode.TORQUE, PowerState.ENABLED, False, False, 0)


def preflight(*, simulated: bool) -> SimpleNamespace:
    return SimpleNamespace(
        identity=Identity(1, 2, 3, 4, "A <drive>\x1b[2J", simulated), watched=True, watchdog_s=0.5,
        safe_action="quick_stop", fed_by_any_client=False,
        checks=(Check("identity", "", "found\x1b]0;x\x07", Outcome.OK, "1018h", ""),),
    )


@pytest.fixture
def board(tmp_path) -> Board:
    store = Store(tmp_path)
    store.prepare()
    run = store.new_id()
    found = Board(store, Status.begun(run, "rig", now()))
    yield found
    found.close()
    assert store.status(run) == found.status           # all of it was written


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


# -- the code


def test_a_code_is_good_once_for_a_minute():
    clock = Clock()
    confirming = Confirming("b" * 64, lambda: None, clock=clock)
    assert len(confirming.code) == 6
    assert confirming.code.isdecimal()
    clock.now_s = CODE_S - 0.1
    assert not confirming.look()
    confirming.take(confirming.code, confirming.binding, "who")
    assert confirming.look()
    with pytest.raises(PreflightRefused, match="used already"):
        confirming.take(confirming.code, None, "who")


def test_after_a_minute_it_is_void():
    clock = Clock()
    confirming = Confirming("b" * 64, lambda: None, clock=clock)
    clock.now_s = CODE_S
    for _ in range(2):
        with pytest.raises(PreflightRefused, match="not confirmed within 60 s"):
            confirming.take(confirming.code, None, "who")
    with pytest.raises(PreflightRefused):
        confirming.look()


def test_so_it_is_for_another_plan_a_changed_file_and_after_three_tries():
    def changed() -> None:
        raise PreflightRefused("the rig's file was changed")

    for confirming, code, binding, tries, words in (
        (Confirming("b" * 64, lambda: None), None, "c" * 64, 1, "another plan"),
        (Confirming("b" * 64, changed), None, None, 1, "was changed"),
        (Confirming("b" * 64, lambda: None), "nonsense", None, TRIES, "wrong codes"),
    ):
        for left in range(tries, 0, -1):
            with pytest.raises(PreflightRefused, match=words if left == 1 else "isn't the code"):
                confirming.take(code or confirming.code, binding, "who")
        with pytest.raises(PreflightRefused, match=words):
            confirming.take(confirming.code, confirming.binding, "who")       # the right one comes too late
        assert confirming.confirmed_by is None


def attendant(board: Board, tmp_path, confirming: Confirming) -> ServiceAttendant:
    return ServiceAttendant(board, Watcher(board), tmp_path, lambda found: confirming)


def test_a_real_shaft_waits_for_the_code_and_is_fed_meanwhile(board, tmp_path):
    confirming = Confirming("b" * 64, lambda: None)
    there, cycles = attendant(board, tmp_path, confirming), []
    board.to(State.PREFLIGHT)

    def idle() -> None:
        cycles.append(board.status.state)
        if len(cycles) == 5:
            there.confirming.take(confirming.code, confirming.binding, "who")

    there.confirm(TASK, preflight(simulated=False), idle, ())
    assert cycles == [State.AWAITING] * 5
    assert (board.status.state, board.status.stage) == (State.MOVING, "setup")
    wait_for("confirm.json", (tmp_path / "confirm.json").exists)


def test_nobody_confirms_and_nothing_moves(board, tmp_path):
    clock = Clock()
    there = attendant(board, tmp_path, Confirming("b" * 64, lambda: None, clock=clock))
    board.to(State.PREFLIGHT)

    def idle() -> None:
        clock.now_s += 1.0

    with pytest.raises(PreflightRefused, match="not confirmed"):
        there.confirm(TASK, preflight(simulated=False), idle, ())
    assert board.status.state is State.AWAITING


def test_what_is_raised_while_waiting_goes_out(board, tmp_path):
    there = attendant(board, tmp_path, Confirming("b" * 64, lambda: None))
    board.to(State.PREFLIGHT)

    def idle() -> None:
        raise KeyError("a stop was asked for")

    with pytest.raises(KeyError):
        there.confirm(TASK, preflight(simulated=False), idle, ())


def test_a_simulated_shaft_asks_nobody(board, tmp_path):
    there = attendant(board, tmp_path, Confirming("b" * 64, lambda: None))
    board.to(State.PREFLIGHT)
    there.confirm(TASK, preflight(simulated=True), pytest.fail, ())
    assert board.status.state is State.MOVING
    assert there.confirming is None


def test_a_speed_that_somebody_would_have_to_see_is_refused(board, tmp_path):
    there = attendant(board, tmp_path, Confirming("b" * 64, lambda: None))
    with pytest.raises(PreflightRefused, match="nobody is there to see"):
        there.confirm_speed(1.0, "no angle", pytest.fail)


# -- the board and what it is told


def test_stages_go_by_and_a_stop_has_its_times(board):
    watcher = Watcher(board)
    watcher.preflight(preflight(simulated=True))
    board.to(State.PREFLIGHT)
    watcher.stage_started("setup", 10.0)
    assert board.status.state is State.PREFLIGHT            # the drive is only looked at
    board.to(State.MOVING, "setup")
    watcher.stage_started("speed", 40.0)
    assert (board.status.stage, board.status.expected_s["speed"]) == ("speed", 40.0)
    watcher.cycle(COMMAND, SAMPLE)
    assert board.status.stop.seen is None
    watcher.look_for_the_stop()
    watcher.cycle(COMMAND, SAMPLE)
    assert board.status.stop.seen is None
    watcher.cycle(COMMAND, SAMPLE._replace(state=PowerState.QUICK_STOP))
    assert board.status.stop.seen is not None
    watcher.stage_ended(Stage("speed", 0.0, 1.0, "aborted"))
    assert board.status.state is State.STOPPING
    watcher.stage_started("torque", 1.0)
    assert board.status.state is State.STOPPING
    watcher.stopped(confirmed=True)
    assert board.status.stop.confirmed
    assert board.status.stop.at_rest is not None


def test_what_a_drive_says_of_itself_is_text(board):
    Watcher(board).preflight(preflight(simulated=True))
    assert "\x1b" not in board.status.identity + board.status.preflight[0].found
    assert "<drive>" in board.status.identity              # the page escapes it


def test_a_step_that_cannot_be_ends_no_run(board):
    board.to(State.DONE)
    assert board.status.state is State.REQUESTED


def test_a_full_disk_holds_nobody_up(board, monkeypatch):
    def full(status: Status) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(board._store, "save", full)
        board.to(State.PREFLIGHT)
        board.know(pid=7)
    assert board.status == replace(board.status, pid=7)
