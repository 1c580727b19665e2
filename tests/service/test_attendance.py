"""Attendance of a run: the code and its end, the board, and the data of a stop for a page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers import Check, Command, Identity, Mode, Outcome, PowerState, PreflightRefused, Sample
from tdhil.errors import Interrupted
from tdhil.recording import Stage
from tdhil.runner import ExcitationRequest, StopRequest, Task
from tdhil.service.attendance import (
    CODE_S,
    LEASE_S,
    SILENT_S,
    TRIES,
    Board,
    Confirming,
    Lease,
    ServiceOperator,
    Watcher,
    print_line,
)
from tdhil.service.run_state import State, Status, now
from tdhil.service.store import Store
from tests.rigs import LIMITS
from tests.service.conftest import wait_for

TASK = Task(LIMITS, ExcitationRequest())
COMMAND = Command(Mode.TORQUE, 0.0, 50.0)
SAMPLE = Sample(1.0, 0.0, 0.0, True, 3.0, 50.0, None, Mode.TORQUE, PowerState.ENABLED, False, False, 0)


def preflight(*, simulated: bool) -> SimpleNamespace:
    return SimpleNamespace(
        identity=Identity(1, 2, 3, 4, "A <drive>\x1b[2J", simulated), watched=True, watchdog_s=0.5,
        safe_action="quick_stop", reaction="quick stop", fed_by_any_client=False,
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
    assert store.status(run) == found.status           # everything was written


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
    with pytest.raises(PreflightRefused, match="already been used"):
        confirming.take(confirming.code, None, "who")


def test_after_a_minute_it_is_void():
    clock = Clock()
    confirming = Confirming("b" * 64, lambda: None, clock=clock)
    clock.now_s = CODE_S
    for _ in range(2):
        with pytest.raises(PreflightRefused, match="not entered within 60 s"):
            confirming.take(confirming.code, None, "who")
    with pytest.raises(PreflightRefused):
        confirming.look()


def test_a_code_is_void_for_another_plan_a_changed_file_and_after_three_attempts():
    def changed() -> None:
        raise PreflightRefused("the rig's file was changed")

    for confirming, code, binding, tries, words in (
        (Confirming("b" * 64, lambda: None), None, "c" * 64, 1, "another plan"),
        (Confirming("b" * 64, changed), None, None, 1, "was changed"),
        (Confirming("b" * 64, lambda: None), "nonsense", None, TRIES, "wrong codes"),
    ):
        for left in range(tries, 0, -1):
            with pytest.raises(PreflightRefused, match=words if left == 1 else "code is wrong"):
                confirming.take(code or confirming.code, binding, "who")
        with pytest.raises(PreflightRefused, match=words):
            confirming.take(confirming.code, confirming.binding, "who")       # the right one comes too late
        assert confirming.confirmed_by is None


def operator_interface(board: Board, tmp_path, confirming: Confirming, **more) -> ServiceOperator:
    return ServiceOperator(board, Watcher(board), tmp_path, lambda found: confirming, **more)


def test_a_real_drive_waits_for_the_code_and_is_fed_in_the_meantime(board, tmp_path):
    confirming = Confirming("b" * 64, lambda: None)
    there, cycles = operator_interface(board, tmp_path, confirming), []
    board.to(State.PREFLIGHT)

    def idle() -> None:
        cycles.append(board.status.state)
        if len(cycles) == 5:
            there.confirming.take(confirming.code, confirming.binding, "who")

    there.confirm(TASK, preflight(simulated=False), idle, ())
    assert cycles == [State.AWAITING] * 5
    assert (board.status.state, board.status.stage) == (State.MOVING, "setup")
    wait_for("confirm.json", (tmp_path / "confirm.json").exists)


def test_without_a_confirmation_there_is_no_motion(board, tmp_path):
    clock = Clock()
    there = operator_interface(board, tmp_path, Confirming("b" * 64, lambda: None, clock=clock))
    board.to(State.PREFLIGHT)

    def idle() -> None:
        clock.now_s += 1.0

    with pytest.raises(PreflightRefused, match="not entered"):
        there.confirm(TASK, preflight(simulated=False), idle, ())
    assert board.status.state is State.AWAITING


def test_an_exception_during_the_wait_is_raised(board, tmp_path):
    there = operator_interface(board, tmp_path, Confirming("b" * 64, lambda: None))
    board.to(State.PREFLIGHT)

    def idle() -> None:
        raise KeyError("a stop was asked for")

    with pytest.raises(KeyError):
        there.confirm(TASK, preflight(simulated=False), idle, ())


def test_a_simulated_shaft_needs_no_confirmation(board, tmp_path):
    there = operator_interface(board, tmp_path, Confirming("b" * 64, lambda: None))
    board.to(State.PREFLIGHT)
    there.confirm(TASK, preflight(simulated=True), pytest.fail, ())
    assert board.status.state is State.MOVING
    assert there.confirming is None


def test_a_speed_that_an_operator_would_have_to_confirm_is_refused(board, tmp_path):
    there = operator_interface(board, tmp_path, Confirming("b" * 64, lambda: None))
    with pytest.raises(PreflightRefused, match="no operator can confirm"):
        there.confirm_speed(1.0, "no angle", pytest.fail)


# -- the lease of a watched run


KEY = "k" * 16


class Watched:
    """Lease with an adjustable clock, and its messages."""

    def __init__(self) -> None:
        self.clock, self.told, self.lost, self.needed = Clock(), [], [], True
        self.lease = Lease(KEY, "who", change=self.told.append, lost=self.lost.append, needed=lambda: self.needed,
                           clock=self.clock)

    def at(self, now_s: float) -> Lease:
        self.clock.now_s = now_s
        return self.lease


def test_a_lease_holds_as_long_as_it_is_renewed_and_is_lost_for_good_5_s_after():
    watched = Watched()
    for second in range(1, 8):
        watched.at(second).renew(KEY, "who")
        watched.at(second + 0.9).look()
    watched.at(7 + LEASE_S - 0.01).look()
    assert watched.lost == []
    watched.at(7 + LEASE_S).look()
    (lost,) = watched.lost
    assert (lost.by, lost.how) == ("who", "silent")
    assert lost.since <= lost.gone <= lost.lost
    for key in (KEY, "x" * 16):
        with pytest.raises(PreflightRefused, match="can't be renewed"):
            watched.lease.renew(key, "who")
    watched.at(100.0).look()
    assert len(watched.lost) == 1


def test_a_late_renewal_does_not_count_even_without_a_check_in_between():
    watched = Watched()
    with pytest.raises(PreflightRefused, match="can't be renewed"):
        watched.at(LEASE_S + 0.01).renew(KEY, "who")
    assert len(watched.lost) == 1


def test_a_closing_page_is_reported_and_may_return_in_time():
    watched = Watched()
    watched.at(1.0).renew(KEY, "who", gone="hidden")
    watched.at(2.5).look()
    watched.at(3.0).renew(KEY, "who")
    watched.at(3.0 + SILENT_S).look()
    watched.at(5.5).renew(KEY, "who", gone="closed")
    watched.at(5.5).renew(KEY, "who", gone="hidden")   # as at closing, in each order
    watched.at(3.0 + LEASE_S).look()                   # the message of a closing page does not renew the lease
    assert [(one.how, one.lost is not None) for one in watched.told] == [
        (None, False), ("hidden", False), (None, False), ("silent", False), ("closed", False), ("closed", True)]


def test_a_reloaded_page_keeps_the_lease():
    watched = Watched()
    watched.lease.renew(KEY, "who", new_key="n" * 16)
    watched.lease.renew(KEY, "who", new_key="n" * 16)  # its reply was lost
    with pytest.raises(PreflightRefused, match="another page"):
        watched.lease.renew(KEY, "who")                # the former page, or a copy of it
    with pytest.raises(PreflightRefused, match="another page"):
        watched.lease.renew("n" * 16, "somebody else")
    with pytest.raises(PreflightRefused, match="another page"):
        watched.lease.renew("ä", "who", gone="closed")
    watched.lease.renew("n" * 16, "who")
    assert watched.lost == []


def test_after_the_motion_no_lease_is_lost():
    watched = Watched()
    watched.needed = False
    watched.at(100.0).look()
    assert watched.lost == []


@pytest.mark.parametrize("simulated", [True, False])
def test_a_watched_shaft_waits_for_a_page_and_brakes_without_one(board, tmp_path, simulated):
    confirming = Confirming("b" * 64, lambda: None, watched=True)
    lost = []
    there = operator_interface(board, tmp_path, confirming, watched=True, unwatched=lost.append)
    board.to(State.PREFLIGHT)

    def idle() -> None:
        if board.status.confirmation is not None:
            with pytest.raises(PreflightRefused, match="only while the operator watches"):
                confirming.take(confirming.code, None, "who")
            confirming.take(confirming.code, None, "who", KEY)

    there.confirm(TASK, preflight(simulated=simulated), idle, ())
    assert board.status.state is State.MOVING
    assert board.status.watch.by == "who"
    there.lease._clock = lambda: 1e9                   # its own thread detects it
    wait_for("the end of the lease", lambda: lost)
    wait_for("the status", lambda: board.status.watch.lost)
    there.lease.end()


def test_only_the_control_loop_writes_it_to_the_log(board):
    watcher, told = Watcher(board), []
    watcher.log = SimpleNamespace(event=lambda *said: told.append(said))
    watcher.remark("its page is hidden")
    assert told == []
    watcher.cycle(COMMAND, SAMPLE)
    watcher.cycle(COMMAND, SAMPLE)
    assert told == [(SAMPLE.time_s, "watch", "its page is hidden")]


# -- the board and its data


def test_a_stop_by_a_signal_is_reported_too_and_one_by_the_socket_by_its_sender(board):
    stop = StopRequest()
    watcher = Watcher(board, stop)
    stop.ask(15)
    watcher.cycle(COMMAND, SAMPLE._replace(state=PowerState.QUICK_STOP))
    assert board.status.stop.by == "a signal"
    assert board.status.stop.seen is not None
    other = StopRequest()
    watcher = Watcher(board, other)
    board.know(stop=type(board.status.stop)())
    other.ask(15, "somebody asked")
    watcher.cycle(COMMAND, SAMPLE)
    assert board.status.stop.asked is None             # the requesting side records it
    with pytest.raises(Interrupted, match="interrupted: somebody asked"):
        other.check()


def test_stages_are_shown_and_a_stop_has_its_times(board):
    watcher = Watcher(board)
    watcher.preflight(preflight(simulated=True))
    board.to(State.PREFLIGHT)
    watcher.stage_started("setup", 10.0)
    assert board.status.state is State.PREFLIGHT            # the drive is only read
    board.to(State.MOVING, "setup")
    watcher.stage_started("speed", 40.0)
    assert (board.status.stage, board.status.expected_s["speed"]) == ("speed", 40.0)
    watcher.cycle(COMMAND, SAMPLE)
    assert board.status.stop.seen is None
    watcher.asked_to_stop("who")
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


def test_the_plan_states_the_duration_of_its_stage(board):
    Watcher(board).planned(SimpleNamespace(duration_s=100.0))
    assert board.status.expected_s["acquire"] == 105.0


def test_data_of_a_drive_are_text(board):
    Watcher(board).preflight(preflight(simulated=True))
    assert "\x1b" not in board.status.identity + board.status.preflight[0].found
    assert "<drive>" in board.status.identity              # the page escapes it


def test_a_step_that_cannot_be_ends_no_run(board):
    board.to(State.DONE)
    assert board.status.state is State.REQUESTED


def test_a_line_for_a_log_that_accepts_none_is_no_error(monkeypatch):
    full = Path("/dev/full").open("w")                     # noqa: SIM115
    monkeypatch.setattr("sys.stderr", full)
    print_line("no space for this")
    monkeypatch.undo()
    with pytest.raises(OSError, match="No space"):
        full.close()


def test_a_full_disk_delays_nothing(board, monkeypatch):
    def full(status: Status) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(board._store, "save", full)
        board.to(State.PREFLIGHT)
        board.know(pid=7)
    assert board.status == replace(board.status, pid=7)


def test_a_second_stop_keeps_the_time_of_the_first(board, monkeypatch):
    times = iter(f"2026-01-01T00:00:{number:02d}.000Z" for number in range(60))
    monkeypatch.setattr("tdhil.service.attendance.now", lambda: next(times))
    watcher = Watcher(board)
    board.to(State.PREFLIGHT)
    board.to(State.MOVING, "setup")
    braking = SAMPLE._replace(state=PowerState.QUICK_STOP)
    watcher.asked_to_stop("first")
    watcher.cycle(COMMAND, braking)
    first = board.status.stop
    assert first.seen is not None
    watcher.asked_to_stop("second")
    watcher.cycle(COMMAND, braking)
    assert board.status.stop == first


def test_a_stop_after_standstill_is_not_recorded_as_its_cause(board):
    """The page showed a standstill that was earlier than its request."""
    watcher = Watcher(board)
    for state in (State.PREFLIGHT, State.MOVING):
        board.to(state)
    watcher.stopped(confirmed=True)
    board.to(State.IDENTIFYING)
    watcher.asked_to_stop("anna")
    assert (board.status.stop.asked, board.status.stop.by) == (None, None)
    assert board.status.stop.at_rest is not None
