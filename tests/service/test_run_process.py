"""Process of a run, executed within this process: actions before motion, without `fake_run`."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers import DriveFault
from tdhil.errors import ExitCode, LogBroken
from tdhil.recording import read_run
from tdhil.report import has_extra
from tdhil.service.run_channel import STOP_FILE
from tdhil.service.run_process import NICE, RunProcess, main
from tdhil.service.run_state import State, Watch, now
from tdhil.service.start_request import read_rig
from tdhil.service.store import CONNECTION_FILE, Store, StoredRequest, read_json, write_json
from tests.service.conftest import Service, wait_for
from tests.service.test_lost_run import attended_rig

SIMULATED = "run: {simulate: true}\n"


class Asked:
    """Requested run whose process has not started."""

    def __init__(self, folder: Path, text: str, *, simulated: bool = True, motion: str = "attended",
                 **options: object) -> None:
        self.rig = folder / "rig.yaml"
        self.rig.write_text(text)
        self.store = Store(folder / "data")
        self.store.prepare()
        found = read_rig(self.rig)
        self.run = self.store.new_id()
        self.folder = self.store.place(self.run)
        self.store.begin(StoredRequest(self.run, "rig", str(self.rig), found.sha256, options, "local", now(), simulated,
                                       motion))

    def serve(self) -> int:
        return main([str(self.folder)])

    @property
    def states(self) -> list[State]:
        return [one.state for one in self.store.status(self.run).history]


@pytest.fixture(autouse=True)
def nicer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own_locks: None) -> list[int]:
    """Return its changes of priority. Later tests keep their priority and working folder."""
    found: list[int] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.nice", found.append)
    return found


@pytest.mark.parametrize(("left", "by"), [({"by": "anna", "at": now()}, "anna"), ({}, "somebody")])
def test_an_early_stop_request_is_handled_first(tmp_path, left, by):
    asked = Asked(tmp_path, SIMULATED, seed=7)
    write_json(asked.folder / STOP_FILE, left)
    assert asked.serve() == ExitCode.TERMINATED
    assert asked.states == [State.REQUESTED, State.STOPPED]
    status = asked.store.status(asked.run)
    assert (status.stop.by, status.stop.seen) == (by, None)
    assert status.stop.asked is not None
    assert "Nothing has moved" in status.error.next_step
    assert not list(asked.folder.glob("*.mcap"))


@pytest.mark.parametrize("change", ["another", "removed"])
def test_a_rig_s_file_that_was_changed_before_the_process_began_ends_it(tmp_path, change):
    asked = Asked(tmp_path, SIMULATED, seed=7)
    if change == "another":
        asked.rig.write_text(f"name: another\n{SIMULATED}")
    else:
        asked.rig.unlink()
    assert asked.serve() != ExitCode.OK
    assert State.PREFLIGHT not in asked.states
    if change == "another":
        assert asked.states[-1] is State.REFUSED
        assert "was changed after the run was requested" in asked.store.status(asked.run).error.what
    assert not list(asked.folder.glob("*.mcap"))


@pytest.mark.heavy
def test_the_connection_is_recorded_before_the_bus_is_opened(tmp_path, nobody_s_port):
    """The address gives no reply, so the run fails at its first request to the drive."""
    asked = Asked(tmp_path, attended_rig(nobody_s_port), simulated=False)
    assert asked.serve() == ExitCode.REFUSED
    assert f"127.0.0.1:{nobody_s_port}" in asked.store.status(asked.run).error.message
    plan, status = read_json(asked.folder / "plan.json"), asked.store.status(asked.run)
    assert status.expected_half_width == plan["expected_half_width"]
    assert status.expected_s["acquire"] == plan["duration_s"] + 5.0
    plain = read_json(asked.folder / CONNECTION_FILE)
    assert plain["address"] == f"modbus tcp 127.0.0.1 port {nobody_s_port} unit 1"
    assert plain["profile_text"].startswith("#") or "bus: modbus" in plain["profile_text"]


@pytest.mark.heavy
def test_a_run_that_cannot_record_its_connection_opens_no_bus(tmp_path, nobody_s_port, monkeypatch):
    def full(path: Path, plain: object) -> None:
        if path.name == CONNECTION_FILE:
            raise OSError(28, "No space left on device")

    asked = Asked(tmp_path, attended_rig(nobody_s_port), simulated=False)
    monkeypatch.setattr("tdhil.service.run_process.write_json", full)
    assert asked.serve() == ExitCode.INTERNAL
    assert "No space" in asked.store.status(asked.run).error.message
    assert not (asked.folder / "run.mcap").exists()


def test_each_message_on_its_socket_has_a_reply(tmp_path):
    process = RunProcess(Asked(tmp_path, SIMULATED).folder)
    for asked, words in (({"do": "lease", "key": "x"}, "this run is not watched"),
                         ({"do": "confirm", "code": "1"}, "nothing to confirm")):
        with pytest.raises(Exception, match=words):
            process.answer(asked)
    assert process.answer({"do": "code"}) == {"code": None}
    assert process.answer({"do": "status"})["status"]["state"] == "requested"
    assert process.answer({})["status"]["stop"]["asked"] is None
    assert not process.stop.signum
    found = process.answer({"do": "stop", "by": "an\x1bna" + "x" * 200})["status"]
    assert len(found["stop"]["by"]) == 80
    assert found["stop"]["asked"] is not None
    assert process.stop.signum == 15
    assert "\x1b" not in process.stop.why
    process.board.close()


@pytest.mark.heavy
def test_a_simulated_run_from_its_request_to_its_result(tmp_path, nicer):
    asked = Asked(tmp_path, SIMULATED, seed=7, rate_hz=50.0)
    process = RunProcess(asked.folder)
    assert process.serve() == ExitCode.OK
    assert process.watcher.log is not None                 # it contains the message of the page
    assert asked.states[:3] == [State.REQUESTED, State.PREFLIGHT, State.MOVING]
    assert asked.states[-3:] == [State.STOPPING, State.IDENTIFYING, State.DONE]
    status = asked.store.status(asked.run)
    assert (status.exit_code, status.verdict, status.simulated) == (0, "valid", True)
    result = json.loads((asked.folder / "result.json").read_bytes())
    assert read_run(asked.folder / "run.mcap").complete
    assert (asked.folder / "report.html").exists() is has_extra()
    assert nicer == [NICE]
    assert not (asked.folder / "plan.json").exists()       # it is not confirmed
    assert json.loads((asked.folder / "row.json").read_bytes())["rig"] == "rig"
    assert result["verdict"] == "valid"
    assert (asked.folder / "run.mcap").exists()
    assert not (asked.folder / CONNECTION_FILE).exists()


@pytest.mark.heavy
def test_an_aborted_run_has_the_result_of_its_motion(tmp_path):
    """The result is that of `tdhil replay`: a part of a run gives a valid number with its interval."""
    asked = Asked(tmp_path, SIMULATED, seed=7, rate_hz=50.0, fault=["sto@acquire+160s"])
    assert RunProcess(asked.folder).serve() == ExitCode.DRIVE_FAULT
    status = asked.store.status(asked.run)
    assert (status.state, status.verdict) == (State.FAILED, None)
    assert status.rehearsal["verdict"] == "pass" and "standstill confirmed" in status.rehearsal["seen"]
    result = json.loads((asked.folder / "result.json").read_bytes())
    assert result["inertia_kg_m2"]["low_total"] < 104.0 < result["inertia_kg_m2"]["high_total"]
    assert result["rehearsed_faults"] == ["sto@acquire+160s"]
    assert result["rehearsal"] == status.rehearsal
    assert json.loads((asked.folder / "row.json").read_bytes())["aborted_stage"] == "acquire"
    assert (asked.folder / "report.html").exists() is has_extra()


@pytest.mark.heavy
def test_a_stop_file_reaches_a_run_of_the_service(tmp_path, rigs):
    """The web server writes it for a process that does not listen yet."""
    service = Service(tmp_path / "data", rigs, fake=False)
    begin = service.supervisor._begin

    def left(request: StoredRequest) -> None:
        write_json(service.store.place(request.id) / STOP_FILE, {"by": "anna"})
        begin(request)

    service.supervisor._begin = left
    service.supervisor.start()
    run = service.supervisor.start_run("a", {"seed": 7}, "local").request.id
    service.wait(run, "stopped")
    wait_for("its end", lambda: not service.supervisor.live())
    assert State.MOVING not in [one.state for one in service.store.status(run).history]
    service.supervisor.close()


def test_a_run_whose_lease_is_lost_stops_without_a_user(tmp_path):
    process = RunProcess(Asked(tmp_path, SIMULATED, motion="watched").folder)
    assert process.watched
    process.operator_interface._unwatched(Watch("anna", now(), now(), "hidden", now()))
    assert process.stop.why == "the run was not watched for 5 s (its page is hidden)"
    assert (process.stop.signum, process.board.status.stop.by) == (15, "nobody watched")
    process.board.close()


def test_a_lease_and_a_code_are_passed_on_unchanged(tmp_path):
    process = RunProcess(Asked(tmp_path, SIMULATED, motion="watched").folder)
    calls: list[object] = []
    watch = Watch("anna", now())
    process.operator_interface.lease = SimpleNamespace(
        renew=lambda *given, **more: calls.append((given, more)) or watch)
    asked = {"do": "lease", "key": "k", "by": "anna", "new_key": None, "gone": "hidden"}
    assert process.answer(asked)["watch"]["by"] == "anna"
    assert calls.pop() == (("k", "anna"), {"new_key": "", "gone": "hidden"})
    process.operator_interface.confirming = SimpleNamespace(
        take=lambda *given: calls.append(given), confirmed_by=None, void=None, code="123456", left_s=9.0, binding="b")
    assert process.answer({"do": "confirm", "code": 1, "binding": "b", "by": "anna", "lease": None})["status"]
    assert calls.pop() == ("1", "b", "anna", "")
    assert process.answer({"do": "code"}) == {"code": "123456", "left_s": 9.0, "binding": "b"}
    process.operator_interface.confirming.confirmed_by = "anna"
    assert process.answer({"do": "code"}) == {"code": None}
    process.board.close()


@pytest.mark.parametrize("state", [State.REFUSED, State.STOPPED])
def test_a_run_that_ends_during_its_identification_has_failed(tmp_path, state):
    """Its shaft moved and was stopped: it is neither refused nor stopped."""
    process = RunProcess(Asked(tmp_path, SIMULATED).folder)
    for passed in (State.PREFLIGHT, State.MOVING, State.STOPPING, State.IDENTIFYING):
        process.board.to(passed)
    assert process.board.status.state is State.IDENTIFYING
    process._end(state, int(ExitCode.INTERRUPTED))
    process.board.close()
    assert process.board.status.state is State.FAILED


def test_a_log_that_cannot_be_closed_does_not_lose_the_result(tmp_path, monkeypatch):
    """The shaft is at standstill and J is known. The run ended as failed, without a result."""
    document = {"verdict": "valid", "rehearsal": None, "inertia_kg_m2": None}

    class Session:
        rehearsal = None
        log = SimpleNamespace(recording=lambda complete: SimpleNamespace(torque_scale_rel_sd=0.02))

        def __init__(self, *_: object, **__: object) -> None:
            pass

        def move(self, stop: object) -> SimpleNamespace:
            process.board.to(State.MOVING)
            process.board.to(State.STOPPING)
            return SimpleNamespace(cause=None, stop=SimpleNamespace(confirmed=True))

        def conclude(self) -> SimpleNamespace:
            return SimpleNamespace(document=document, exit_code=ExitCode.OK)

        def close(self) -> None:
            raise LogBroken("no space is left", where="run.mcap")

    monkeypatch.setattr("tdhil.session.RunSession", Session)
    monkeypatch.setattr(RunProcess, "_row", lambda *_: None)
    monkeypatch.setattr(RunProcess, "_report", lambda *_: None)
    asked = Asked(tmp_path, SIMULATED)
    process = RunProcess(asked.folder)
    assert process._run() == ExitCode.PARTIAL
    process.board.close()
    assert read_json(asked.folder / "result.json") == document
    status = asked.store.status(asked.run)
    assert (status.state, status.verdict, status.exit_code) == (State.DONE, "valid", ExitCode.PARTIAL)
    assert "no space is left" in status.error.what


def test_after_the_motion_a_run_needs_no_page_and_keeps_its_plan(tmp_path, monkeypatch):
    """The lease ends before the result is made, so a page that closes then stops nothing."""
    done: list[str] = []

    class Session:
        log, rehearsal = SimpleNamespace(), None

        def __init__(self, *_: object, **__: object) -> None:
            process.operator_interface.lease = SimpleNamespace(end=lambda: done.append("lease ended"))

        def move(self, stop: object) -> SimpleNamespace:
            return SimpleNamespace(cause=DriveFault("it faulted", where="a test"), stop=None)

        def abandon(self) -> None:
            done.append("abandoned")

    plan = {"expected_half_width": 0.1, "duration_s": 60.0}
    monkeypatch.setattr("tdhil.session.RunSession", Session)
    monkeypatch.setattr("tdhil.service.run_process.plan_of", lambda *_: plan)
    process = RunProcess(Asked(tmp_path, SIMULATED, motion="watched").folder)
    assert process._run() == ExitCode.DRIVE_FAULT
    process.board.close()
    assert done == ["lease ended", "abandoned"]
    assert read_json(process.folder / "plan.json") == plan
