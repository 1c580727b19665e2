"""Views of ended runs in the API: pictures, samples, fleets; and the possible rehearsals."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from profiles import STAGE_NUMBERS
from tdhil.buses import all_buses
from tdhil.errors import UsageError
from tdhil.service import fleets as fleets_module
from tdhil.service import worker
from tdhil.service.fleets import Fleets
from tdhil.service.run_state import Conflict
from tdhil.service.start_request import Rigs
from tdhil.service.store import read_json
from tdhil.session import hold
from tests.recording.test_log_tail import write
from tests.service.conftest import HANGS_S, Service, play_uploads, wait_for

HOSTILE = "<script>alert(1)</script>"


@pytest.mark.heavy
def test_a_run_has_the_pictures_of_its_report(call, service):
    run = call.start()["id"]
    service.wait(run, "done")
    assert call("GET", f"/runs/{run}/pictures", 200) == []
    (service.store.place(run) / "report.html").write_text(
        "<section><h2>A &amp; B</h2>\n<figure><svg id='x'></svg><figcaption>one &lt;b&gt;</figcaption></figure>\n"
        "<figure><svg id='y'></svg>\n<figcaption>two</figcaption></figure></section>")
    assert call("GET", f"/runs/{run}/pictures", 200) == [
        {"number": 0, "heading": "A & B", "caption": "one <b>"}, {"number": 1, "heading": "A & B", "caption": "two"}]
    picture = call("GET", f"/runs/{run}/pictures/1", 200)
    assert picture.text == "<svg id='y'></svg>"
    assert "sandbox" in picture.headers["content-security-policy"]
    for number in ("2", "-1", "x"):
        call("GET", f"/runs/{run}/pictures/{number}", 404)


@pytest.mark.heavy
def test_samples_are_a_table(call, service, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "run.mcap")
    worker.samples({"folder": str(tmp_path)})
    first, *rows = csv.reader((tmp_path / "samples.csv").open())
    assert first[:3] == ["time_s", "speed_rad_s", "torque_nm"]
    assert len(rows) > 10
    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    call("GET", f"/runs/{run}/samples.csv", 422)
    call("POST", f"/runs/{run}/stop", 200, json={})
    service.wait(run, "stopped")
    (tmp_path / "samples.csv").replace(service.store.place(run) / "samples.csv")
    assert call("GET", f"/runs/{run}/samples.csv", 200).text.startswith("time_s,")


def test_a_full_disk_is_reported_as_such_while_samples_are_written(call, service, tmp_path, monkeypatch):
    """It gave HTTP 422 with the text of another program."""
    run = call.start()["id"]
    service.wait(run, "done")
    write(service.store.place(run) / "run.mcap")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(csv, "writer", full)
    play_uploads(service, monkeypatch)
    found = call("GET", f"/runs/{run}/samples.csv", 507)["error"]
    assert (found["what"], found["next_step"]) == ("the disk is full (No space left on device)",
                                                   "Free some disk space, then repeat the request")
    assert not list(service.store.place(run).glob("*samples.csv"))


def test_samples_of_a_file_that_is_no_log_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.mcap").write_bytes(b"no log")
    with pytest.raises(UsageError):
        worker.samples({"folder": str(tmp_path)})


def test_possible_rehearsals_are_accepted_at_every_stage(call):
    for bus in all_buses():
        faults = bus.faults()
        assert len({one.name for one in faults}) == len(faults) > 20
        for one in faults:
            for stage in STAGE_NUMBERS:
                value = f"={one.value}" if one.takes and one.value else ""
                text = f"{one.name}{value}" if one.from_start else f"{one.name}@{stage}+2s{value}/5s"
                assert len(bus.parse_faults([text])) == 1, text
    found = {one["name"]: one for one in call("GET", "/rigs/a/faults", 200)}
    assert found["sto"]["row"] == 33
    assert found["frame-loss"]["value"] == "5%"
    call("GET", "/rigs/real/faults", 403)
    call("GET", "/rigs/nobody/faults", 404)


def test_the_example_rigs_are_simulated():
    assert [(rig.problem, rig.simulated) for rig in Rigs(None).all()] == [("", True), ("", True)]


def test_a_drive_in_use_may_turn(service):
    with hold("a drive of this test"):
        assert service.supervisor.turning()
        assert service.supervisor.turned_by().startswith(f"process {os.getpid()} (")


def test_a_replay_states_for_which_drive_it_waits(call, service, monkeypatch):
    """The page showed "Identifying again" with a progress bar, although nothing was computed."""
    run = call.start("a", "done")["id"]
    service.wait(run, "done")
    monkeypatch.setattr(service.supervisor, "work", lambda *asked: {"document": {"verdict": "valid"}})
    with hold("a drive of this test"):
        call("POST", f"/runs/{run}/replays", 202, json={"model": "rigid"})
        found = wait_for("its delay", lambda: next(
            (one for one in call("GET", f"/runs/{run}", 200)["replays"] if one["state"] == "delayed"), None))
        assert found["holder"].startswith(f"process {os.getpid()} (")
    wait_for("its end", lambda: call("GET", f"/runs/{run}/replays/001", 200)["state"] == "done")
    assert call("GET", f"/runs/{run}", 200)["replays"][0]["holder"] is None


def test_a_replay_that_the_end_of_the_service_interrupted_has_failed(call, service, tmp_path, monkeypatch):
    """It was accepted, and then lost without a trace."""
    run = call.start("a", "done")["id"]
    service.wait(run, "done")
    goes_on = threading.Event()
    monkeypatch.setattr(service.supervisor, "work", lambda *asked: goes_on.wait(HANGS_S) and {"document": {}})
    call("POST", f"/runs/{run}/replays", 202, json={"model": "rigid"})
    assert [one.state for one in service.web.replays(run)] == ["waiting"]
    after = Service(tmp_path / "data", None)
    (found,) = after.web.replays(run)
    assert (found.state, found.asked) == ("failed", {"model": "rigid"})
    assert (found.error.what, found.error.next_step) == ("the service ended before this was done", "Repeat it")
    goes_on.set()
    wait_for("its end", lambda: [one.state for one in service.web.replays(run)] == ["done"])


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    (folder / "below").mkdir(parents=True)
    (folder / "below" / "bad.mcap").write_bytes(b"no log")
    (folder / "trace.csv").write_text(f"{HOSTILE},n,m\n0,1,2\n")
    (folder / "trace.yaml").write_text("rig: R7\ncolumns: ['time=t', 'speed=n', 'torque=m']\n")
    return folder


def hurry(fleets: Fleets) -> None:
    """Give the process normal priority: beside other tests it would take minutes on a small computer."""
    if (going := fleets._going) is None:
        return                         # its end
    process = going.process
    wait_for("its nice", lambda: process.poll() is not None or os.getpriority(os.PRIO_PROCESS, process.pid) == 19)
    with suppress(PermissionError, ProcessLookupError):
        os.setpriority(os.PRIO_PROCESS, process.pid, 0)


@pytest.mark.heavy
def test_many_logs_are_identified_again_and_wait_while_a_shaft_turns(call, service, logs):
    turns = [True]
    service.web.fleets = fleets = Fleets(service.store, {"logs": logs}, lambda: turns[0])
    assert call("GET", "/fleets/folders", 200) == ["", "logs"]
    fleet = call("POST", "/fleets", 202, json={"folder": "logs", "tolerance": 0.01})["id"]
    assert call("POST", "/fleets", 202, json={"folder": "logs", "tolerance": 0.01})["id"] == fleet
    with pytest.raises(Conflict, match="other logs are being identified"):
        fleets.ask("logs", "below", {}, "local")
    hurry(fleets)
    held = wait_for("logs that are found", lambda: (one := fleets.get(fleet)).total and one)
    assert (held.held, held.total, held.done) == (True, 2, 0)
    turns[0] = False
    wait_for("its end", lambda: fleets.get(fleet).state != "running")
    found = call("GET", f"/fleets/{fleet}", 200)
    assert (found["state"], found["done"], found["failed"]) == ("done", 2, 2)
    assert found["summary"]["out"] == "fleet.csv"
    bad, trace = call("GET", f"/fleets/{fleet}/rows", 200)
    assert (bad["log"], trace["log"]) == ("below/bad.mcap", "trace.csv")
    assert HOSTILE in trace["error_text"]
    assert call("GET", f"/fleets/{fleet}/rows?from=1", 200) == [trace]
    rows = list(csv.DictReader(call("GET", f"/fleets/{fleet}/fleet.csv", 200).text.splitlines()))
    assert [row["log"] for row in rows] == ["below/bad.mcap", "trace.csv"]
    call("POST", "/fleets", 202, json={"folder": "logs", "tolerance": 0.01})       # again: all logs are complete
    hurry(fleets)
    wait_for("its end", lambda: fleets.get(fleet).state != "running")
    assert fleets.get(fleet).summary["done_before"] == 2
    assert [one["id"] for one in call("GET", "/fleets", 200)] == [fleet]
    assert [one["what"] for one in call("GET", "/audit", 200)["entries"]].count("fleet asked") == 3


@pytest.mark.heavy
def test_an_ended_fleet_or_one_of_a_dead_web_keeps_its_rows(call, service, logs):
    turns = [True]
    service.web.fleets = fleets = Fleets(service.store, {"logs": logs}, lambda: turns[0])
    fleet = fleets.ask("logs", "", {}, "local").id
    hurry(fleets)
    wait_for("logs that are found", lambda: fleets.get(fleet).total)
    again = Fleets(service.store, {"logs": logs}, lambda: False)           # as read by the next web server
    assert again.get(fleet).state == "interrupted"
    call("POST", f"/fleets/{fleet}/stop", 200, json={})
    wait_for("its end", lambda: fleets.get(fleet).state == "interrupted")


class PlayedFleet:
    """Process of a fleet for the web server: a row, a rehearsal, and no end before the test permits it."""

    def __init__(self, *_: object, **more: object) -> None:
        self.stdin, self.stdout, self.over = io.BytesIO(), self, threading.Event()

    def __iter__(self):
        for log, faults in (("run.mcap", None), ("rehearsal.mcap", "spike=3")):
            yield json.dumps({"row": {"log": log, "error_kind": None, "rehearsed_faults": faults}}).encode()
        self.over.wait(HANGS_S)

    def wait(self) -> int:
        return 0

    def close(self) -> None: ...


@pytest.mark.parametrize("asked", [False, True])
def test_the_rows_of_a_fleet_include_rehearsals_only_if_asked_for(call, service, logs, monkeypatch, asked):
    played = []
    monkeypatch.setattr(fleets_module.subprocess, "Popen", lambda *_, **more: played.append(PlayedFleet()) or played[0])
    service.web.fleets = fleets = Fleets(service.store, {"logs": logs}, lambda: False)
    body = {"folder": "logs"} | ({"rehearsals": True} if asked else {})
    fleet = call("POST", "/fleets", 202, json=body)["id"]
    wait_for("both rows", lambda: fleets.get(fleet).done == 2)
    found = [one["log"] for one in call("GET", f"/fleets/{fleet}/rows", 200)]
    assert found == ["run.mcap", "rehearsal.mcap"][: 1 + asked]
    assert call("GET", f"/fleets/{fleet}", 200)["rehearsals"] is asked
    played[0].over.set()
    wait_for("its end", lambda: fleets._going is None)
    assert read_json(service.store.folder / "fleets" / fleet / "request.json").get("rehearsals", False) is asked
    assert call("GET", f"/fleets/{fleet}", 200)["rehearsals"] is asked


@pytest.mark.heavy(but_first=6)
@pytest.mark.parametrize("body", [
    {"folder": "/etc"}, {"folder": "logs", "below": ".."}, {"folder": "logs", "below": "../logs2"},
    {"folder": "logs", "below": "/etc"}, {"folder": "logs", "below": "nothing"}, {"folder": "logs", "below": "a\0b"},
    {"folder": "logs", "below": "link"}, {"folder": ""}, {"folder": "", "below": "x"}, {"folder": "logs", "model": "x"},
    {"folder": "logs", "tolerance": 0}, {"folder": "logs", "confidence": 1.0}, {"jobs": 3}, {"folder": HOSTILE},
])
def test_a_fleet_goes_through_no_other_folder(call, service, logs, body):
    (logs.parent / "logs2").mkdir()
    (logs / "link").symlink_to("/etc")
    service.web.fleets = Fleets(service.store, {"logs": logs}, lambda: False)
    call("POST", "/fleets", 422, json=body)
    assert call("GET", "/fleets", 200) == []


def test_no_other_file_is_a_fleet(call):
    for name in ("nothing", "..", "%2e%2e", "..%2fruns"):
        assert call._client.get(f"/api/v1/fleets/{name}").status_code in (404, 405)


def two_ended(call, service):
    runs = []
    for _ in range(2):
        runs.append(call.start()["id"])
        service.wait(runs[-1], "done")
        wait_for("its end", lambda: not service.supervisor.live())
    return runs


@pytest.mark.heavy
def test_two_runs_of_a_rig_give_its_torque_calibration(call, service, monkeypatch):
    without, loaded = two_ended(call, service)
    asked = []
    monkeypatch.setattr(service.supervisor, "work",
                        lambda what, run, more: asked.append((what, more)) or {"document": {"verdict": "valid"}})
    body = {"without": without, "with_body": loaded, "added_kg_m2": 55.0}
    answer = call("POST", "/rigs/a/calibration", 200, json={**body, "added_sd_kg_m2": 0.1})
    assert answer == {"calibration": {"verdict": "valid"}}
    assert asked == [("calibrate", {**body, "added_sd_kg_m2": 0.1, "at": "motor",
                                    "runs_folder": str(service.store.runs)})]
    assert not list(service.store.folder.rglob("calibration*"))
    for wrong in ({"added_kg_m2": 0.0}, {"added_kg_m2": -1.0}, {"added_kg_m2": "x"}, {"added_sd_kg_m2": -1.0},
                  {"at": "bit"}, {"more": 1}):
        call("POST", "/rigs/a/calibration", 422, json={**body, **wrong})
    assert "not a run of rig b" in call("POST", "/rigs/b/calibration", 422, json=body)["error"]["message"]
    call("POST", "/rigs/a/calibration", 404, json={**body, "without": "../../x"})
    both = call("POST", "/rigs/a/calibration", 422, json={**body, "added_kg_m2": 0.0, "added_sd_kg_m2": -1.0})
    assert [one["option"] for one in both["fields"]] == ["added_kg_m2", "added_sd_kg_m2"]
    stored = service.store.request
    with monkeypatch.context() as patched:
        patched.setattr(service.store, "request",
                        lambda run: replace(stored(run), options={"fault": ["trip@speed"]} if run == loaded else {}))
        (field,) = call("POST", "/rigs/a/calibration", 422, json=body)["fields"]
    assert field["option"] == "with_body" and "is a rehearsal of faults" in field["message"]
    (service.store.place(loaded) / "run.mcap").unlink()
    call("POST", "/rigs/a/calibration", 422, json=body)
    assert len(asked) == 1


@pytest.mark.heavy
def test_the_worker_calibrates_as_the_command_does(tmp_path, monkeypatch):
    from tests.calibration import bodies

    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    logs = iter(one.record for one in bodies.two(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tdhil.session.read", lambda path: next(logs))
    found = worker.calibrate({"runs_folder": str(tmp_path), "without": "one", "with_body": "two", "added_kg_m2": 55.0,
                              "added_sd_kg_m2": None, "at": "motor"})["document"]
    factor = found["calibration_factor"]
    assert factor["low"] <= 1.0 / bodies.SCALE <= factor["high"]
    assert any("standard uncertainty of the body" in warning for warning in found["warnings"])


@pytest.mark.parametrize(("name", "text"), [
    ("log.mcap", "The run ended without a log"), ("result.json", "The run ended without a result"),
    ("report.pdf", "The run ended without a report"), ("samples.csv", "The run ended without a log"),
    ("trace.csv", "Only a run from an uploaded trace has this file"),
    ("evidence.zip", "Make the evidence first"),
])
def test_a_file_of_an_ended_run_is_not_waited_for(call, service, name, text):
    run = call.start("a", "unseen")["id"]
    service.wait(run, "stop_not_confirmed")
    (service.store.place(run) / "run.mcap").unlink(missing_ok=True)
    assert call("GET", f"/runs/{run}/{name}", 404)["error"]["next_step"] == text
    assert call("POST", f"/runs/{run}/replays", 422, json={})["error"]["next_step"] == "The run ended without a log"


def test_a_file_of_a_live_run_is_waited_for(call, service):
    run = call.start("a", "hold")["id"]
    service.wait(run, "moving")
    for name in ("result.json", "evidence.zip"):
        assert call("GET", f"/runs/{run}/{name}", 404)["error"]["next_step"] == "Wait until the run has ended"
