"""Rig that is added in the browser: draft of every profile, errors at their fields, its file, and a scan."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient

from drivers import CommunicationLost
from profiles import load_profile, profile_names
from tdhil.config import parse_rig
from tdhil.service import new_rig, worker
from tdhil.service.new_rig import draft_of, new_rig_view
from tdhil.service.schemas import DraftBody
from tests.service.conftest import URL, Service, wait_for

LIMITS = {"speed_min_rad_s": "5 rpm", "speed_max_rad_s": "95 rpm", "torque_nm": "400", "time_s": "15 min",
          "quick_stop_rad_s2": "2", "probe_torque_nm": "200", "probe_travel_rad": "3"}
STRING = {"make_up_torque_nm": "2 kN·m", "torque_ramp_nm_s": "40"}
ADDRESS = {"canopen": {"interface": "socketcan", "channel": "can0", "bitrate": "500000", "node": "3"},
           "modbus": {"host": "192.0.2.10", "port": "502", "unit": "1"},
           "ethercat": {"interface": "eth1", "position": "0"}}


def complete(profile, **changed):
    """Return a draft of this profile with every requested entry."""
    view = next(one for one in new_rig_view().profiles if one.name == profile)
    return DraftBody(**{
        "profile": profile, "name": "bench 3", "load": "string", "address": ADDRESS[view.bus], "limits": LIMITS,
        "string": STRING, "rated_torque_nm": "955" if view.rated_torque_by_hand else "",
        "parameters": {one.name.removeprefix("parameters."): "1500" for one in view.parameters},
        "gear_ratio": "8.5", "accept_unverified": list(view.unverified), "motion": "attended", **changed})


@pytest.mark.parametrize("name", sorted(profile_names()))
def test_a_complete_draft_of_each_profile_is_a_valid_file(name):
    found = draft_of(complete(name))
    assert found.problems == []
    rig = parse_rig(found.text, "rig.yaml")
    assert (rig.name, rig.limits.torque_nm, rig.gear.ratio, rig.service.motion) == ("bench 3", 400.0, 8.5, "attended")
    assert rig.limits.speed_max_rad_s == pytest.approx(9.948, abs=1e-3)
    assert (rig.load.kind, rig.make_up_torque_nm) == ("string", 2000.0)
    assert rig.drive_data.parameters.keys() == {one.name for one in load_profile(name).untold}
    assert found.limits["watchdog_s"] == 0.5


@pytest.mark.parametrize("name", sorted(profile_names()))
def test_a_simulated_rig_needs_its_name_alone(name):
    found = draft_of(DraftBody(name, simulated=True, name="bench 3", address={}, motion="attended"))
    assert found.problems == []
    rig = parse_rig(found.text, "rig.yaml")
    assert (rig.name, rig.profile, rig.run.simulate, rig.limits, rig.service.motion) == (
        "bench 3", name, True, None, "never")


def test_a_simulated_rig_may_have_the_limits_of_the_real_one():
    found = draft_of(complete("maxon/epos4", simulated=True))
    assert found.problems == [] and parse_rig(found.text, "rig.yaml").limits.torque_nm == 400.0
    assert "socketcan" not in found.text
    assert {one.field for one in draft_of(complete("maxon/epos4", simulated=True, name="", string={})).problems} == {
        "name", *STRING}


def test_a_limit_may_be_typed_as_a_power_of_ten():
    found = draft_of(complete("maxon/epos4", limits=LIMITS | {"torque_nm": "4e2"}))
    assert found.problems == [] and parse_rig(found.text, "rig.yaml").limits.torque_nm == 400.0


def test_a_simulated_drive_is_asked_for_no_parameter():
    found = draft_of(complete("siemens/g120", simulated=True))
    assert found.problems == [] and not parse_rig(found.text, "rig.yaml").drive_data.parameters


def test_a_parameter_is_shown_with_the_value_that_it_must_have():
    view = next(one for one in new_rig_view().profiles if one.name == "siemens/g120")
    required = {one.name: one.required for one in view.parameters}
    assert required["parameters.control_mode"] == "20" and required["parameters.reference_torque"] == ""
    assert required["parameters.monitoring_time"] == "at least 0.4 s"       # the display of the drive has ms
    units = {one.name: one.unit for one in view.parameters}
    assert units["parameters.reference_torque"] == "N·m" and units["parameters.control_mode"] == ""
    assert "p2040 monitoring time of the field bus: at least 0.4 s" in view.by_hand


def fields_of(**changed):
    return {one.field: one.message for one in draft_of(complete("maxon/epos4", **changed)).problems}


@pytest.mark.parametrize(("changed", "field", "said"), [
    ({"name": "  "}, "name", "its own name"),
    ({"address": {}}, "address", "select Simulated"),
    ({"address": ADDRESS["canopen"] | {"node": "300"}}, "address.node", "Must be at most 127"),
    ({"address": ADDRESS["canopen"] | {"bitrate": "77"}}, "address.bitrate", "is not a CAN bit rate"),
    ({"limits": LIMITS | {"torque_nm": ""}}, "limits.torque_nm", "does not move without it"),
    ({"limits": LIMITS | {"speed_max_rad_s": "95 rpmm"}}, "limits.speed_max_rad_s", "'rpmm' is not a unit"),
    ({"limits": LIMITS | {"probe_torque_nm": "900"}}, "limits.probe_torque_nm", "Must not be above torque_nm"),
    ({"string": {}}, "make_up_torque_nm", "A drill string needs it"),
    ({"gear_ratio": "0"}, "gear_ratio", "Must be greater than 0"),
    ({"simulated": True, "limits": {"torque_nm": "400"}}, "limits.time_s", "all limits or none"),
    ({"accept_unverified": []}, "accept_unverified", "only if both agree: modes, quick_stop"),
])
def test_an_error_is_marked_at_its_field(changed, field, said):
    assert said in fields_of(**changed)[field]


def test_all_errors_are_shown_at_once():
    found = fields_of(name="", address={}, limits={}, string={}, accept_unverified=[])
    assert "load" not in found         # each key is marked at its own field
    assert {"name", "address", "accept_unverified", *(f"limits.{key}" for key in LIMITS), *STRING} <= found.keys()


TEXTS = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=40).filter(lambda one: one.strip())


any_text = given(TEXTS | st.sampled_from(["a: b", "x # y", "'", '"', "{a: 1}", "[", "- a", "!!python/x", "on", "null",
                                          "1e3", "~"]))


@settings(max_examples=15)
@any_text
def test_a_text_stays_a_text(text):
    stays(text)


@pytest.mark.heavy
@any_text
def test_more_texts_stay_texts(text):
    stays(text)


def stays(text):
    found = draft_of(complete("maxon/epos4", name=text, address=ADDRESS["canopen"] | {"channel": text}))
    assert found.problems == []
    rig = parse_rig(found.text, "rig.yaml")
    assert rig.name == text.strip()
    assert str(rig.get("bus").channel) == text.strip() or float(rig.get("bus").channel) == float(text)
    assert rig.service.motion == "attended"


def test_a_line_break_adds_no_key():
    found = draft_of(complete("maxon/epos4", name="a\nservice: {motion: watched}",
                              gear_ratio="1}\nallow_reverse: true"))
    assert "gear_ratio" in {one.field for one in found.problems} and "\nallow_reverse" not in found.text
    assert "\nservice: {motion: watched}" not in found.text


@pytest.mark.parametrize("changed", [{"profile": "../../etc/passwd"}, {"profile": "mine.yaml"}, {"motion": "watched"},
                                     {"load": "other"}, {"address": {"options": "x"}}, {"address": {"host": "x"}}])
def test_what_the_form_does_not_offer_is_refused(call, changed):
    body = {"profile": "maxon/epos4", "name": "x", "address": {"channel": "can0"}} | changed
    assert call("POST", "/new-rig/draft", 422, json=body)["error"]["code"]


def test_a_simulated_rig_is_ready_to_start(call):
    draft = call("POST", "/new-rig/draft", 200, json={"profile": "maxon/epos4", "simulated": True, "name": "bench 4"})
    made = call("POST", "/rigs", 201, json={"id": "bench-4", "text": draft["text"]})
    assert (made["simulated"], made["state"]) == (True, "free")


def test_a_rig_is_added_once_with_an_audit_entry(call, service):
    text = call("POST", "/new-rig/draft", 200, json=vars(complete("generic/modbus", motion="never")))["text"]
    made = call("POST", "/rigs", 201, json={"id": "bench-3", "text": text})
    assert (made["id"], made["name"], made["motion"], made["state"]) == ("bench-3", "bench 3", "never", "free")
    assert (service.supervisor.rigs.folder / "bench-3.yaml").read_text() == text
    assert call("POST", "/rigs", 409, json={"id": "bench-3", "text": text})["error"]["message"]
    assert "bench-3" in {one["id"] for one in call("GET", "/rigs", 200)}
    wait_for("the audit", lambda: ("rig added", "bench-3") in {(one.what, one.rig) for one in service.audit.entries()})


@pytest.mark.parametrize("rig", ["", "../x", "a/b", ".x", "a" * 65, "x\n", "a\0"])
def test_an_invalid_id_writes_nothing(call, service, rig):
    before = sorted(service.supervisor.rigs.folder.iterdir())
    call("POST", "/rigs", 422, json={"id": rig, "text": "name: x\n"})
    assert sorted(service.supervisor.rigs.folder.iterdir()) == before


@pytest.mark.parametrize(("text", "code"), [
    ("run: {simulate: true, plant: /etc/passwd}\n", 403), ("run: {simulate: true, trace: trace.csv}\n", 403),
    ("run: {log: run.mcap}\n", 403), ("profile: /etc/passwd\n", 403), ("letterhead: ../letterhead.yaml\n", 403),
    ("drive_data: {torque_calibration: ../c.json}\n", 403), ("name: x\nallow_reverse: true\n", 403),
    ("service: {motion: watched}\n", 403), ("limits: 3\n", 422), ("name: [", 422), ("accept_no_watchdog: true\n", 422)])
def test_an_invalid_file_writes_nothing(call, service, text, code):
    call("POST", "/rigs", code, json={"id": "new", "text": text})
    assert not (service.supervisor.rigs.folder / "new.yaml").exists()


def test_without_a_folder_of_rigs_the_remedy_is_named(tmp_path):
    found = Service(tmp_path / "data", None)
    with pytest.raises(Exception, match="--rigs DIR"):
        found.supervisor.add_rig("new", "name: x\n", "anna")
    with TestClient(found.web.asgi, base_url=URL) as client:
        assert "/new-rig" not in (first := client.get("/").text) and "tdhil serve --rigs rigs" in first
        assert "<form" not in (page := client.get("/new-rig").text) and "tdhil serve --rigs rigs" in page
    found.supervisor.close()


FOUND = {"found": [{"bus": "canopen", "address": 3, "title": "EPOS4", "identity": "1, 2, 3, 4", "simulated": False,
                    "profile": "maxon/epos4", "why": "1018h", "seen": "", "line": {}}], "remarks": ["one drive"]}


def test_a_scan_asks_first_and_shows_what_replied(call, service, monkeypatch):
    body = {"profile": "generic/cia402", "address": ADDRESS["canopen"]}
    assert "no other master" in call("POST", "/new-rig/scan", 422, json=body)["error"]["message"]
    monkeypatch.setattr(service.supervisor, "work", lambda what, run, sent: {"document": json.loads(json.dumps({
        "found": [{"address": 3, "title": "EPOS4", "identity": "", "simulated": False, "profile": None, "why": "",
                   "fields": {"node": "3"}}], "remarks": []}))})
    assert call("POST", "/new-rig/scan", 200, json=body | {"alone": True})["found"][0]["fields"] == {"node": "3"}
    monkeypatch.setattr(service.supervisor, "turned_by", lambda: "process 7 (x)")
    refused = call("POST", "/new-rig/scan", 409, json=body | {"alone": True})
    assert "held by process 7 (x), so a shaft may turn" in refused["error"]["message"]


def test_the_scan_is_that_of_the_command_line(monkeypatch):
    seen = {}

    def run(command, **how):
        place = command[command.index("--rig") + 1]
        seen.update(command=command[1:4], text=Path(place).read_text(encoding="utf-8"))
        return SimpleNamespace(returncode=0, stdout=json.dumps(FOUND), stderr="")

    monkeypatch.setattr(new_rig.subprocess, "run", run)
    found = new_rig.scan_for(DraftBody("generic/cia402", address=ADDRESS["canopen"]))
    assert seen["command"] == ["-m", "tdhil", "scan"]
    assert parse_rig(seen["text"], "rig.yaml").get("bus").channel == "can0"
    assert (found.found[0].profile, found.found[0].fields) == ("maxon/epos4", {"node": "3"})
    assert found.remarks == ["one drive"]


@pytest.mark.heavy
def test_a_rig_is_checked_without_motion(call, service):
    text = call("POST", "/new-rig/draft", 200, json={"profile": "maxon/epos4", "simulated": True, "name": "b"})["text"]
    call("POST", "/rigs", 201, json={"id": "bench-4", "text": text})
    checks = call("POST", "/rigs/bench-4/check", 200, json={})
    grades = {one["name"]: one["grade"] for one in checks}
    assert {"drive", "identity", "peer", "watchdog", "modes", "limits", "setting", "state"} <= grades.keys()
    assert "bad" not in grades.values() and service.store.ids() == []
    wait_for("the audit", lambda: "rig checked" in {one.what for one in service.audit.entries()})


def test_no_rig_is_checked_while_a_real_shaft_may_turn(call, service, monkeypatch):
    rig = call("GET", "/rigs", 200)[0]["id"]
    monkeypatch.setattr(service.supervisor, "work", lambda *asked: pytest.fail("nothing is opened"))
    monkeypatch.setattr(service.supervisor, "turned_by", lambda: "process 7 (x)")
    refused = call("POST", f"/rigs/{rig}/check", 409, json={})
    assert "held by process 7 (x), so a shaft may turn" in refused["error"]["message"]


def test_the_check_is_that_of_the_command_line(monkeypatch, tmp_path):
    """A failed check is a result with exit code 4. Without findings, the message names the reason."""
    failed = {"grade": "bad", "name": "identity", "said": "another drive", "do": "choose its profile"}
    reply = SimpleNamespace(returncode=4, stdout=json.dumps({"checks": [failed], "exit_code": 4}), stderr="")
    seen = []
    monkeypatch.setattr(new_rig.subprocess, "run", lambda command, **how: seen.append(command) or reply)
    monkeypatch.chdir(tmp_path)
    asked = {"rig_file": "rig.yaml", "runs_folder": str(tmp_path)}
    assert worker.check(asked)["document"]["checks"] == [failed]
    assert seen[0][1:] == ["-m", "tdhil", "doctor", "--rig", "rig.yaml", "--json"]
    reply.stdout, reply.stderr = "", "rig.yaml: limits: must be a mapping"
    with pytest.raises(CommunicationLost, match="must be a mapping"):
        worker.check(asked)


@pytest.mark.parametrize("reply", [
    subprocess.TimeoutExpired("tdhil", 1.0), SimpleNamespace(returncode=5, stdout="", stderr="no drive answers"),
    SimpleNamespace(returncode=5, stdout='{"error": {"message": "no drive answers"}}', stderr="")])
def test_a_scan_without_a_reply_gives_the_reason(monkeypatch, reply):
    def run(command, **how):
        if isinstance(reply, Exception):
            raise reply
        return reply

    monkeypatch.setattr(new_rig.subprocess, "run", run)
    with pytest.raises(Exception, match=r"^(no drive answers|scan: the scan did not end within.*)$"):
        new_rig.scan_for(DraftBody("generic/cia402", address=ADDRESS["canopen"]))
