"""Supervisor of runs: it starts, finds and brakes them, and never reports standstill of a lost run."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers import CommunicationLost, DataFileError
from tdhil.errors import LogError, UsageError
from tdhil.service import supervisor as supervisor_module
from tdhil.service.limits import STOP_S
from tdhil.service.run_channel import STOP_FILE, RunRefused
from tdhil.service.run_state import Conflict, NoRoom, State, Status, now, way_to
from tdhil.service.store import KEYS, StoredRequest
from tdhil.session import drive_lock
from tests.service.conftest import FAKE, Service, wait_for


def begun(service: Service, what: str = "hold", rig: str = "a", *states: str) -> str:
    """Return a run in this state."""
    run = service.supervisor.start_run(rig, {"note": what}, "anna").request.id
    service.wait(run, *(states or ("moving",)))
    return run


def ended(service: Service, rig: str = "a", state: State = State.STOP_NOT_CONFIRMED) -> str:
    """Return an earlier run with this end."""
    run = service.store.new_id()
    status = service.store.begin(StoredRequest(run, rig, "rig.yaml", "0" * 64, {}, "anna", now(), True, "never"))
    service.store.save(way_to(status.to(State.PREFLIGHT, now()).to(State.MOVING, now()), state, now(),
                              exit_code=8))
    return run


def lines(service: Service) -> list[tuple[str, str, str | None, str | None]]:
    return [(one.who, one.what, one.run, one.rig) for one in service.audit.entries()]


def test_blocking_and_live_runs_are_found_at_the_start(service, tmp_path, rigs):
    bad, good = ended(service), ended(service, "b", State.STOPPED)
    signed = ended(service, "real")
    service.store.sign_off(signed, "anna", "at rest")
    (service.store.runs / "20260101-000000-abcdef").mkdir()                # a folder without a request
    service.supervisor.start()
    run = begun(service, "hold", "b")
    service.supervisor.close()
    after = Service(tmp_path / "data", rigs)
    after.supervisor.start()
    assert after.supervisor.live() == [run]
    assert [after.supervisor.blocked(rig) for rig in ("a", "b", "real")] == [bad, None, None]
    assert after.supervisor.run_of("b") == run
    assert after.supervisor.run_of("a") is None
    assert good not in after.supervisor.live()
    assert run in after.supervisor.ahead_of_the_index()
    wait_for("the index", lambda: {one.id for one in after.index.find()} >= {bad, good, signed})
    after.supervisor.stop(run, "anna")
    after.wait(run, "stopped")
    wait_for("its end", lambda: not after.supervisor.live())
    wait_for("the audit", lambda: ("service", "ended: stopped", run, "b") in lines(after))
    wait_for("the index", lambda: after.supervisor.ahead_of_the_index() == [])
    assert ("anna", "stop asked", run, "b") in lines(after)
    after.supervisor.close()


def test_close_ends_its_threads_and_no_run(service):
    service.supervisor.start()
    run = begun(service)
    thread = service.supervisor._thread
    service.supervisor.note("anna", "asked", None, None)
    service.supervisor.close()
    assert not thread.is_alive()
    assert not any(one.is_alive() for one in service.supervisor._begun)
    assert [one.what for one in service.audit.entries()] == ["asked", "asked"]     # all notes are written
    assert service.store.status(run).state is State.MOVING


@pytest.mark.heavy
def test_a_service_that_brakes_starts_no_more_runs(service):
    service.supervisor.start()
    loose, run = begun(service, "loose"), begun(service, "hold", "b")
    assert service.supervisor.brake("the end")
    assert service.supervisor.not_at_rest == [loose]
    assert service.said[0] == (f"Stopping run {loose}, {run}. tdhil waits {STOP_S:.0f} s at most for standstill."
                               " If a shaft keeps turning, use the hard-wired emergency stop.")
    assert {service.store.status(one).stop.by for one in (loose, run)} == {"the end"}
    with pytest.raises(Conflict, match="service is ending"):
        begun(service, "hold", "b")
    wait_for("their end", lambda: not service.supervisor.live())
    service.said.clear()
    assert service.supervisor.brake("again")
    assert service.said == []                                              # no motion, no message
    assert service.supervisor.not_at_rest == [loose]


@pytest.mark.heavy
def test_after_its_time_out_a_service_reports_live_runs(service):
    service.supervisor.start()
    run = begun(service, "frozen")
    assert not service.supervisor.brake("the end", within_s=0.0)
    assert service.supervisor.not_at_rest == [run]
    assert service.said[-1] == f"run {run}: moving"
    os.kill(service.store.status(run).pid, signal.SIGKILL)
    service.wait(run, "interrupted")


def test_a_run_that_is_identified_is_not_waited_for(service):
    """Its standstill was reported as not confirmed, with exit code 8, although it was in its record."""
    service.supervisor.start()
    run = begun(service, "identify", "a", "identifying")
    assert service.supervisor.brake("the end")
    assert (service.supervisor.not_at_rest, service.supervisor.may_turn()) == ([], [])
    assert service.said == [f"run {run} is still being identified; it continues"]
    assert service.store.status(run).state is State.IDENTIFYING


def test_a_key_gives_its_run_for_the_same_request_of_the_same_user_and_rig(service):
    service.supervisor.start()
    first = service.supervisor.start_run("a", {"note": "done"}, "anna", "key")
    assert (first.new, first.request.asked_by, first.request.idempotency_key) == (True, "anna", "key")
    again = service.supervisor.start_run("a", {"note": "done"}, "anna", "key")
    assert (again.new, again.request) == (False, first.request)
    with pytest.raises(Conflict, match="another request"):
        service.supervisor.start_run("a", {"note": "hold"}, "anna", "key")
    service.wait(first.request.id, "done")
    wait_for("its end", lambda: not service.supervisor.live())
    other = service.supervisor.start_run("a", {"note": "done"}, "berta", "key")
    assert other.new
    service.wait(other.request.id, "done")
    assert KEYS >= 100
    wait_for("the audit", lambda: sum(one.what == "asked" for one in service.audit.entries()) == 2)


def test_no_run_starts_for_a_rig_that_may_not_move_or_with_impossible_options(service):
    for rig, options, wrong in (("never", {}, "can't be moved over HTTP"), ("broken", {}, "broken.yaml"),
                                ("a", {"excitation": "nosuch"}, "excitation"), ("nosuch", {}, "does not exist")):
        with pytest.raises(Exception, match=wrong):
            service.supervisor.start_run(rig, options, "anna")
    assert service.store.ids() == []


def test_the_request_is_recorded(service):
    service.supervisor.start()
    run = begun(service, "done", "a", "done")
    request, rig = service.store.request(run), service.supervisor.rigs.get("a")
    assert (request.id, request.rig, request.rig_file, request.rig_sha256, request.simulated, request.motion) == (
        run, "a", str(rig.path.resolve()), rig.sha256, True, "never")
    assert (service.store.place(run) / "process.log").exists()


def test_a_stop_reaches_a_process_that_does_not_listen_yet_by_its_file(service, monkeypatch):
    run = begun(service)
    real, asked = supervisor_module.ask, []

    def deaf_once(folder: Path, wish: Any, **more: Any) -> Any:
        asked.append((wish, more))
        if len(asked) == 1:
            raise CommunicationLost("not yet")
        return real(folder, wish, **more)

    monkeypatch.setattr(supervisor_module, "ask", deaf_once)
    service.supervisor.stop(run, "anna")
    assert asked == [({"do": "stop", "by": "anna"}, {"timeout_s": 1.0})] * 2
    assert "anna" in (service.store.place(run) / STOP_FILE).read_text()
    service.wait(run, "stopped")


@pytest.mark.parametrize("dies", [False, True])
def test_a_stop_without_a_recipient_is_reported(service, monkeypatch, dies):
    run = begun(service, "hold")
    sent: list[int] = []

    def nothing(*_: Any, **__: Any) -> Any:
        raise CommunicationLost("nobody answers")

    with monkeypatch.context() as patched:
        patched.setattr(supervisor_module, "ask", nothing)
        patched.setattr(supervisor_module, "send_signal", lambda pid, folder, number: sent.append(number) or False)
        if dies:
            patched.setattr(supervisor_module, "lives", lambda folder: False)
            patched.setattr(service.supervisor, "_running", lambda run: None)
            found = service.supervisor.stop(run, "anna")
            assert (found.state, found.stop.by, found.stop.asked is not None) == (State.MOVING, "anna", True)
        else:
            with pytest.raises(CommunicationLost, match="nobody answers") as lost:
                service.supervisor.stop(run, "anna")
            assert "hard-wired emergency stop" in lost.value.next_step
        assert sent == ([] if dies else [signal.SIGTERM])
    service.supervisor.stop(run, "anna")
    service.wait(run, "stopped")


def test_a_full_disk_does_not_prevent_the_second_way_of_a_stop(service, monkeypatch):
    run = begun(service, "deaf")

    def full(*_: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(supervisor_module, "write_json", full)
        service.supervisor.stop(run, "anna")
    service.wait(run, "stopped")


def test_a_code_without_a_waiting_run_is_refused_and_recorded(service):
    service.supervisor.start()
    run = begun(service)
    with pytest.raises(Conflict, match="nothing to confirm"):
        service.supervisor.confirm(run, "123456", None, "anna")
    real = begun(service, "ask", "real", "awaiting_confirmation")
    with pytest.raises(Conflict, match="the code is wrong"):
        service.supervisor.confirm(real, "000000", None, "anna")
    with pytest.raises(Conflict, match="is not watched"):
        service.supervisor.renew(real, "key", "anna", new_key=None, gone=None)
    assert service.supervisor.confirm(real, "123456", None, "berta").id == real
    service.wait(real, "done")
    with pytest.raises(Conflict, match="nothing to confirm"):
        service.supervisor.confirm(real, "123456", None, "anna")
    wait_for("the audit", lambda: sum(one.what == "confirmation refused" for one in service.audit.entries()) == 3)
    assert ("berta", "confirmed", real, "real") in lines(service)
    service.supervisor.stop(run, "anna")
    service.wait(run, "stopped")


def test_a_sign_off_is_for_an_unconfirmed_stop_only(service):
    bad, good = ended(service), ended(service, "b", State.STOPPED)
    service.supervisor.start()
    with pytest.raises(Conflict, match="nothing to sign off: the run is stopped"):
        service.supervisor.sign_off(good, "anna", "at rest")
    assert service.store.signed_off(good) is None
    with pytest.raises(Conflict, match="neither confirmed nor signed off"):
        begun(service)
    service.supervisor.sign_off(bad, "anna", "at rest")
    assert service.store.signed_off(bad)["note"] == "at rest"
    begun(service, "done", "a", "done")
    wait_for("the audit", lambda: ("anna", "signed off", bad, "a") in lines(service))


@pytest.mark.heavy
def test_an_edit_does_not_wait_for_the_owner_of_the_rig(service, monkeypatch, rigs):
    service.supervisor.start()
    rig = service.supervisor.rigs.get("real")
    text = rig.path.read_text()
    run = begun(service, "ask", "real", "awaiting_confirmation")
    with pytest.raises(Conflict, match="uses this rig"):
        service.supervisor.edit_rig("real", text, rig.sha256, "anna")
    service.supervisor.stop(run, "anna")
    service.wait(run, "stopped")
    wait_for("its end", lambda: not service.supervisor.live())
    with pytest.raises(Conflict, match="changed meanwhile"):
        service.supervisor.edit_rig("real", text, "0" * 64, "anna")
    with pytest.raises(DataFileError):
        service.supervisor.edit_rig("real", "torque: 1", rig.sha256, "anna")

    def full(*_: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(supervisor_module, "write_whole", full)
        with pytest.raises(LogError, match="No space"):
            service.supervisor.edit_rig("real", text.replace("400.0", "300.0"), rig.sha256, "anna")
    assert rig.path.read_text() == text
    mode = rig.path.stat().st_mode
    found = service.supervisor.edit_rig("real", text.replace("400.0", "300.0"), rig.sha256, "anna")
    assert found.rig.limits.torque_nm == 300.0
    assert rig.path.stat().st_mode == mode
    assert (service.store.folder / "rigs" / "real" / f"{rig.sha256}.yaml").read_text() == text
    wait_for("the audit", lambda: ("anna", "rig file edited", None, "real") in lines(service))


@pytest.mark.heavy
def test_a_lost_process_is_handled_once_and_the_others_as_usual(service, monkeypatch):
    service.supervisor.start()
    run, other = begun(service), begun(service, "hold", "b")
    real, died = service.supervisor._died, []

    def slow(one: str, status: Status) -> Status:
        died.append(one)
        going.wait(60.0)
        return real(one, status)

    going = threading.Event()
    monkeypatch.setattr(service.supervisor, "_died", slow)
    os.kill(service.store.status(run).pid, signal.SIGKILL)
    wait_for("the loss", lambda: died)
    service.supervisor.stop(other, "anna")
    service.wait(other, "stopped")                     # in the meantime
    wait_for("its end", lambda: service.supervisor.live() == [run])
    going.set()
    service.wait(run, "interrupted")
    wait_for("its end", lambda: not service.supervisor.live())
    assert died == [run]
    status = service.store.status(run)
    assert (status.exit_code, status.confirmation, status.error.kind) == (5, None, "CommunicationLost")
    assert any(f"run {run}: its process is gone; stopping the drive" in one for one in service.said)
    assert not (service.store.place(run) / ".reserve").exists()
    assert all(child.poll() is not None for child in service.supervisor._children.values())


def test_a_stop_just_after_the_loss_of_the_process_is_in_the_record(service, monkeypatch):
    """The service stopped the drive already, and the page said that the stop was not delivered."""
    monkeypatch.setattr(service.supervisor, "_look", lambda: None)     # the loss is not seen yet
    service.supervisor.start()
    run = begun(service)
    child = service.supervisor._children[run]
    child.kill()
    child.wait()
    found = service.supervisor.stop(run, "anna")
    assert (found.state, found.stop.by) == (State.MOVING, "anna")
    service.supervisor.stop(run, "berta")
    service.supervisor._look_at(run)
    service.wait(run, "interrupted")
    status = service.store.status(run)
    assert (status.stop.by, status.stop.asked) == ("anna", found.stop.asked)
    wait_for("its end", lambda: not service.supervisor.live())
    assert not (service.store.place(run) / STOP_FILE).exists()


def test_a_failure_of_one_run_does_not_affect_the_others(service, monkeypatch):
    service.supervisor.start()
    run, other = begun(service), begun(service, "hold", "b")
    real = service.supervisor._look_at

    def looks(one: str) -> None:
        if one == run:
            raise RuntimeError("this one")
        real(one)

    monkeypatch.setattr(service.supervisor, "_look_at", looks)
    service.supervisor.stop(other, "anna")
    service.wait(other, "stopped")
    wait_for("its end", lambda: service.supervisor.live() == [run])
    assert f"run {run}: RuntimeError: this one" in service.said
    monkeypatch.undo()
    service.supervisor.stop(run, "anna")


def test_the_data_of_a_lost_run_give_its_result(service, monkeypatch):
    service.supervisor.start()
    found: list[tuple[str, str]] = []
    monkeypatch.setattr(service.supervisor, "work", lambda what, run, asked: found.append((what, run)) or {
        "document": {"verdict": "valid", "inertia_kg_m2": None}})
    run = begun(service)
    os.kill(service.store.status(run).pid, signal.SIGKILL)
    service.wait(run, "interrupted")
    wait_for("the result", lambda: service.store.result(run))
    assert found == [("recover", run)]
    wait_for("the index", lambda: [one.verdict for one in service.index.find()] == ["valid"])


@pytest.mark.heavy
def test_a_failed_computation_gives_the_reason(service, monkeypatch):
    with pytest.raises(RunRefused, match="nosuch") as refused:
        service.supervisor.work("plan", None, {"rig_file": "/nosuch/rig.yaml", "options": {}})
    assert refused.value.reported.exit_code != 0
    replies = [(b"is not JSON", b"first\nkilled\n"), (b"is not JSON", b"")]

    class Broken:
        def __init__(self, *_: Any, **__: Any) -> None:
            pass

        def communicate(self, question: bytes) -> tuple[bytes, bytes]:
            return replies.pop(0)

    monkeypatch.setattr(supervisor_module.subprocess, "Popen", Broken)
    with pytest.raises(RunRefused) as refused:
        service.supervisor.work("plan", None, {})
    assert (refused.value.reported.message, refused.value.reported.what) == ("the work failed", "killed")
    with pytest.raises(RunRefused):
        service.supervisor.work("plan", None, {})


def test_the_end_of_the_service_ends_a_computation(service, monkeypatch):
    """It waited for it, without a message, and its result was lost."""
    begun, real = [], subprocess.Popen

    def slow(command: list[str], **more: Any) -> Any:
        begun.append(real([sys.executable, "-c", "import sys, time; sys.stdin.read(); time.sleep(3600)"], **more))
        return begun[0]

    monkeypatch.setattr(supervisor_module.subprocess, "Popen", slow)
    with ThreadPoolExecutor(1) as thread:
        work = thread.submit(service.supervisor.work, "replay", None, {})
        wait_for("the process", lambda: service.supervisor._workers)
        service.supervisor.close()
        with pytest.raises(Conflict, match="the service ended before this was done"):
            work.result()
    assert begun[0].wait(60.0) == -signal.SIGTERM
    with pytest.raises(Conflict, match="the service ended"):
        service.supervisor.work("plan", None, {})


def test_an_unwritable_audit_or_index_is_reported_and_delays_nothing(service, monkeypatch):
    def full(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        for name in ("note", "begin"):
            patched.setattr(service.audit, name, full)
        for name in ("put", "rebuild"):
            patched.setattr(service.index, name, full)
        service.supervisor.start()
        run = begun(service, "done", "a", "done")
        for words in ("the audit can't be written", "the index can't be written", "the index can't be made"):
            wait_for(words, lambda words=words: any(words in one for one in service.said))
        assert sum("the index can't be written and is retried" in one for one in service.said) == 1
    wait_for("the index", lambda: [one.id for one in service.index.find()] == [run])


@pytest.mark.parametrize(("simulated", "state", "turns"), [
    (False, State.MOVING, True), (False, State.AWAITING, False), (True, State.MOVING, False)])
def test_a_real_shaft_of_a_run_that_moves_may_turn(service, monkeypatch, simulated, state, turns):
    run = service.store.new_id()
    status = service.store.begin(StoredRequest(run, "a", "rig.yaml", "0" * 64, {}, "anna", now(), simulated, "never"))
    status = status.to(State.PREFLIGHT, now())
    service.store.save(status.to(state, now()))
    service.supervisor._live[run] = None
    assert service.supervisor.turning() is turns
    service.supervisor._live.clear()
    monkeypatch.setattr(supervisor_module, "holders", lambda: ["somebody"])
    assert service.supervisor.turning()


def test_the_codes_of_runs_that_wait_are_shown_at_the_terminal_of_the_service(service):
    service.supervisor.start()
    run = begun(service, "ask", "real", "awaiting_confirmation")
    wait_for("the code", lambda: any("123 456" in one for one in service.said))
    service.supervisor.stop(run, "anna")
    service.wait(run, "stopped")
    wait_for("its end", lambda: not service.supervisor.live())
    assert run not in service.supervisor._console._shown


def test_the_process_of_a_run_has_its_own_session(service):
    """The end of the web server's session ends no run. The lock is inherited, so that the run never appears dead."""
    service.supervisor.start()
    run = begun(service)
    pid = service.store.status(run).pid
    assert os.getsid(pid) == pid
    assert service.supervisor._children[run].args == [sys.executable, str(FAKE), str(service.store.place(run))]
    service.supervisor.stop(run, "anna")
    service.wait(run, "stopped")


@pytest.mark.parametrize("at", ["new_id", "begin"])
@pytest.mark.parametrize(("number", "kind"), [(errno.ENOSPC, NoRoom), (errno.EDQUOT, NoRoom), (errno.EROFS, LogError)])
def test_a_run_that_cannot_be_recorded_does_not_start(service, monkeypatch, at, number, kind):
    def full(*_: Any) -> Any:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(service.store, at, full)
    with pytest.raises(kind, match=os.strerror(number)) as refused:
        service.supervisor.start_run("a", {}, "anna")
    assert refused.value.next_step.startswith("Nothing was started.")
    assert service.store.ids() == []
    assert service.supervisor.live() == []


# -- threads that exist before they are needed


def test_jobs_are_done_in_order_in_an_existing_thread_and_failures_are_reported(monkeypatch):
    said: list[str] = []
    jobs = supervisor_module.Jobs("test", said.append)
    monkeypatch.setattr(threading.Thread, "start", lambda thread: pytest.fail("a thread was started"))
    done: list[int] = []
    jobs.add(lambda: done.append(1))
    jobs.add(lambda: done.append(1 // 0))
    jobs.add(lambda: done.append(2))
    assert jobs.finish(60.0)
    assert done == [1, 2]
    assert said == ["ZeroDivisionError: integer division or modulo by zero"]
    blocked = threading.Event()
    jobs.add(lambda: blocked.wait(60.0) and None)
    assert not jobs.finish(0.01)
    blocked.set()
    assert jobs.finish(60.0)


def test_a_stop_and_its_note_start_no_thread_and_wait_for_no_disk(service, monkeypatch):
    """The start of a thread takes long on a busy computer. The audit may wait for its disk without a limit."""
    service.supervisor.start()
    run = begun(service)
    written, real = threading.Event(), service.audit.note
    monkeypatch.setattr(service.audit, "note", lambda *what, **more: written.wait(60.0) and real(*what, **more))
    ours, start, begin = threading.current_thread(), threading.Thread.start, []
    monkeypatch.setattr(threading.Thread, "start", lambda one: (
        begin.append(one.name) if threading.current_thread() is ours else None, start(one))[1])
    service.supervisor.stop(run, "bert")
    assert begin == []
    written.set()
    wait_for("the note", lambda: ("bert", "stop asked", run, "a") in lines(service))


def test_a_change_during_indexing_is_indexed_once_more(service, monkeypatch):
    """Ten requests during this time give one indexing."""
    run, begun_, go, puts = ended(service), threading.Event(), threading.Event(), []

    def put(summary: Any) -> None:
        puts.append(summary.id)
        begun_.set()
        assert go.wait(60.0)

    monkeypatch.setattr(service.index, "put", put)
    service.supervisor.note("anna", "one", run, "a")
    assert begun_.wait(60.0)
    for _ in range(10):
        service.supervisor.note("anna", "more", run, "a")
    go.set()
    assert service.supervisor._indexing.finish(60.0)
    assert puts == [run, run]


@pytest.mark.parametrize(("code", "said", "seen", "words"), [
    (0, b"{}", True, "confirmed standstill"), (8, b"{}", False, "did NOT confirm"), (8, b"", False, "did NOT confirm"),
    (8, b"Traceback", False, "did NOT confirm"), (8, b"[1]", False, "did NOT confirm"),
    (8, b'{"same_drive": true}', False, "did NOT confirm"),
    (8, b'{"same_drive": false, "identity": "9,9"}', False, "another drive (9,9) replied"),
])
def test_the_end_of_a_stop_process_determines_whether_standstill_was_seen(monkeypatch, code, said, seen, words):
    monkeypatch.setattr(supervisor_module.subprocess, "run",
                        lambda *_, **__: SimpleNamespace(returncode=code, stdout=said))
    found, text = supervisor_module._stop_seen(["stop"])
    assert found is seen and words in text


@pytest.mark.parametrize("error", [OSError(errno.ENOENT, "no such program"), subprocess.TimeoutExpired("stop", 1.0)])
def test_a_stop_process_that_never_ends_confirms_nothing(monkeypatch, error):
    def fails(*_: Any, **__: Any) -> Any:
        raise error

    monkeypatch.setattr(supervisor_module.subprocess, "run", fails)
    found, text = supervisor_module._stop_seen(["stop"])
    assert not found and text.startswith("tdhil stop: ")


def test_a_drive_is_idle_if_no_process_on_this_computer_can_move_it(service, monkeypatch):
    supervisor, rig = service.supervisor, service.supervisor.rigs.get("real")
    assert supervisor.certainly_idle(rig) is True
    assert supervisor.certainly_idle(supervisor.rigs.get("a")) is False        # simulated: there is no drive
    with drive_lock.hold(rig.address):
        assert supervisor.certainly_idle(rig) is False
    monkeypatch.setattr(supervisor, "blocked", lambda rig_id: "a run" if rig_id == "real" else None)
    assert supervisor.certainly_idle(rig) is False


def test_a_rig_that_is_part_of_tdhil_is_not_edited(tmp_path):
    found = Service(tmp_path / "data", None)
    rig = found.supervisor.rigs.all()[0]
    with pytest.raises(UsageError, match="part of tdhil"):
        found.supervisor.edit_rig(rig.id, rig.path.read_text(), rig.sha256, "anna")
