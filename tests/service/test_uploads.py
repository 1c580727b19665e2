"""Uploads over HTTP: received files, refused files that leave no data, and the run from an upload."""

from __future__ import annotations

import asyncio
import errno
import hashlib
from collections import namedtuple
from collections.abc import Iterator
from typing import Any

import pytest
from starlette.requests import ClientDisconnect
from starlette.testclient import TestClient

from tdhil.service import upload_routes, uploads
from tdhil.service.limits import API
from tdhil.service.uploads import KEPT_FREE, WAITING, shown_name
from tests.service.conftest import URL, Service, play_uploads, wait_for

TRACE = b"t_s;n_rpm;m_pct\n" + b"".join(f"{k / 100};{40 + k % 7};{20 + k % 5}\n".encode() for k in range(300))
COLUMNS = ["time=t_s:s", "speed=n_rpm:rpm", "torque=m_pct:%"]
MAPPING = {"columns": COLUMNS, "rated_torque_nm": "480 Nm"}


@pytest.fixture
def work(service: Service, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    return play_uploads(service, monkeypatch)


def send(call: Any, data: Any = TRACE, name: str = "trace.csv", expect: int = 201, **more: Any) -> Any:
    headers = {"Content-Type": "application/octet-stream", **more.pop("headers", {})}
    return call("POST", "/uploads", expect, content=data, params={"name": name}, headers=headers, **more)


def left(service: Service) -> list[str]:
    folder = service.store.folder / "uploads"
    return sorted(one.name for one in folder.iterdir()) if folder.is_dir() else []


def identify(call: Any, upload: str, **more: Any) -> Any:
    call("POST", f"/uploads/{upload}/identify", 202, json={**MAPPING, **more})
    return wait_for("its end", lambda: (found := call("GET", f"/uploads/{upload}", 200))["state"] in ("done", "failed")
                    and found)


# -- from a file to a run


def test_a_trace_becomes_an_ended_run_without_a_rig(call, service, work):
    upload = send(call, name="Umrichter 7.csv")
    assert (upload["kind"], upload["state"], upload["size_bytes"]) == ("trace", "waiting", len(TRACE))
    assert upload["sha256"] == hashlib.sha256(TRACE).hexdigest()
    found = identify(call, upload["id"], rig="a", note="=1+1")
    run = call("GET", f"/runs/{found['run']}", 200)
    assert [one["state"] for one in run["history"]] == ["done"]
    assert (run["rig"], run["motion"], run["alive"], run["confirmation"]) == ("a", "never", False, None)
    assert run["uploaded"]["sha256"] == upload["sha256"] and run["uploaded"]["rig"] == "a"
    assert (run["operator"], run["note"], run["options"]["columns"]) == ("Anna", "=1+1", COLUMNS)
    (row,) = call("GET", "/runs?rig=a", 200)
    assert (row["uploaded"], row["inertia_kg_m2"], row["verdict"]) == (True, 104.0, "valid")
    assert (service.supervisor.live(), service.supervisor.blocked("a"), left(service)) == ([], None, [])
    rig = call("GET", "/rigs/a", 200)
    assert (rig["state"], rig["last"], rig["run"]) == ("free", None, None)
    assert call("GET", "/rigs/a/trend", 200)["trend"]["logs"] == 0
    assert call("GET", f"/runs/{run['id']}/trace.csv", 200).content == TRACE
    assert not (service.store.place(run["id"]) / "upload.json").exists()
    wait_for("the audit", lambda: {"recording uploaded", "upload identified"} <= {
        one.what for one in service.audit.entries()})
    audited = {one.what: one.details for one in service.audit.entries()}
    assert audited["upload identified"]["sha256"] == upload["sha256"]
    wait_for("the index", lambda: service.index.find(rig="a"))
    assert service.index.find(rig="a")[0].uploaded
    call("POST", f"/uploads/{upload['id']}/identify", 409, json=MAPPING)
    call("POST", f"/uploads/{upload['id']}/delete", 409, json={})


def test_a_run_that_is_in_progress_is_not_disturbed(call, service, work):
    live = call.start(what="hold")["id"]
    service.wait(live, "moving")
    assert identify(call, send(call)["id"], rig="a")["run"]
    assert service.supervisor.run_of("a") == live and service.store.status(live).state == "moving"
    call("POST", f"/runs/{live}/stop", 200, json={})


def test_without_a_rig_its_page_has_a_title_and_its_lists_a_row(call, client, service, work):
    run = identify(call, send(call)["id"])["run"]
    text = client.get(f"/runs/{run}").text
    assert "Uploaded recording" in text and "UPLOADED" in text and "trace.csv" in text
    assert call("GET", f"/runs/{run}", 200)["rig"] == ""
    assert call("GET", "/runs", 200)[0]["id"] == run
    assert 'attachment; filename="' in client.get(f"{API}/runs/{run}/trace.csv").headers["content-disposition"]


def test_a_preview_shows_table_guess_and_reading(call, work):
    upload = send(call)["id"]
    first = call("POST", f"/uploads/{upload}/preview", 200, json={})
    assert first["preview"]["table"]["columns"] == COLUMNS
    assert [one["option"] for one in first["wrong"]] == ["rated_torque_nm"]
    assert first["preview"]["reading"] is None
    found = call("POST", f"/uploads/{upload}/preview", 200, json=MAPPING)
    reading = found["preview"]["reading"]
    assert (found["wrong"], reading["samples"], round(reading["rate_hz"]), reading["gaps"]) == ([], 300, 100, 0)
    assert [len(one) for one in reading["plot"]] == [300, 300, 300]
    assert call("GET", "/runs", 200) == []


def test_every_wrong_value_is_named_at_its_field_and_no_run_is_made(call, service, work):
    upload = send(call)["id"]
    wrong = {"columns": ["speed=x:rpm", "torque=m_pct:%"], "rig": "none", "gear_ratio": -1, "speed_lag_sd_s": "1 ms",
             "tolerance": "9", "model": "cube"}
    error = call("POST", f"/uploads/{upload}/identify", 422, json=wrong)
    assert {one["option"] for one in error["fields"]} == {
        "columns.time", "columns.speed", "rated_torque_nm", "rig", "gear_ratio", "speed_lag_sd_s", "tolerance", "model"}
    assert call("GET", f"/uploads/{upload}", 200)["state"] == "waiting"
    error = call("POST", f"/uploads/{upload}/identify", 422, json={"excitations": ""})
    assert error["error"]["where"] == "excitations"
    assert work == []


MOTION = {"motion_start_s": "0.5 s", "motion_period_s": 0.5, "motion_periods": 4, "motion_offset_rad_s": "30 rpm",
          "motion_lines_hz": "2, 4, 10"}


@pytest.mark.parametrize(("more", "wrong"), [
    ({}, []),
    ({"motion_kind": "prbs", "motion_mode": "speed", "motion_settle_periods": 0}, []),
    ({"motion_periods": None, "motion_lines_hz": ""}, ["motion_periods", "motion_lines_hz"]),
    ({"motion_lines_hz": "2, 3.3"}, ["motion_lines_hz"]),
    ({"motion_lines_hz": "2, two"}, ["motion_lines_hz"]),
    ({"motion_lines_hz": "2 2"}, ["motion_lines_hz"]),
    ({"motion_periods": 1}, ["motion_periods"]),
    ({"motion_period_s": -1, "motion_kind": "pulses"}, ["motion_period_s", "motion_kind"]),
    ({"excitation": "kind: sine"}, ["excitation"]),
])
def test_the_fields_of_a_motion_are_checked_with_each_error_at_its_field(call, work, more, wrong):
    upload = send(call)["id"]
    found = call("POST", f"/uploads/{upload}/preview", 200, json={**MAPPING, **MOTION, **more})
    assert [one["option"] for one in found["wrong"]] == wrong
    reading = found["preview"]["reading"]
    assert wrong or reading["excitation"] == more.get("motion_kind", "multisine")


def test_a_failure_is_reported_and_can_be_identified_again(call, work):
    upload = send(call)["id"]
    found = identify(call, upload, note="fails")
    assert (found["state"], found["run"], found["error"]["message"]) == ("failed", None, "no row")
    assert identify(call, upload)["run"] is not None


def test_an_identification_waits_until_no_real_shaft_turns(call, service, work, monkeypatch):
    turning = [True]
    monkeypatch.setattr(service.supervisor, "turning", lambda: turning[0])
    monkeypatch.setattr(upload_routes, "POLL_S", 0.01)
    upload = send(call)["id"]
    call("POST", f"/uploads/{upload}/identify", 202, json=MAPPING)
    wait_for("it waits", lambda: call("GET", f"/uploads/{upload}", 200)["state"] == "delayed")
    call("POST", f"/uploads/{upload}/delete", 409, json={})
    turning.clear()
    turning.append(False)
    wait_for("its run", lambda: call("GET", f"/uploads/{upload}", 200)["run"])


# -- refusals, which leave no data


@pytest.mark.parametrize(("data", "headers", "status", "said"), [
    (TRACE, {"Content-Type": "text/plain"}, 422, "must be the file itself"), (b"", {}, 422, "the file is empty"),
    (TRACE, {"Content-Length": str(2**40)}, 413, "larger than the limit"),
])
def test_an_invalid_upload_is_refused(call, service, data, headers, status, said):
    assert said in send(call, data, expect=status, headers=headers)["error"]["what"]
    assert left(service) == []


def pieces(count: int) -> Iterator[bytes]:
    for _ in range(count):
        yield b"x" * 2**20


def test_a_file_above_the_limit_is_refused_also_without_a_stated_length(call, service):
    service.web.uploads.limit = 3 * 2**20
    assert "3 MiB" in send(call, pieces(5), expect=413)["error"]["what"]
    assert left(service) == []


@pytest.mark.parametrize("where", ["before", "while"])
def test_a_full_disk_keeps_nothing_and_leaves_room_for_runs(call, service, monkeypatch, where):
    usage = namedtuple("usage", "total used free")
    seen = iter([2 * KEPT_FREE] if where == "while" else [])
    monkeypatch.setattr(uploads.shutil, "disk_usage", lambda path: usage(0, 0, next(seen, KEPT_FREE - 1)))
    assert send(call, expect=507)["error"]["kind"] == "NoRoom"
    assert left(service) == []


def test_a_disk_that_fills_up_while_a_file_is_written_keeps_nothing(call, service, monkeypatch):
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(uploads.os, "fsync", full)
    send(call, expect=507)
    assert left(service) == []


def test_a_second_upload_may_come_and_a_third_at_the_same_time_may_not(call, service):
    begun = [service.web.uploads.begin(None) for _ in range(2)]
    assert "in progress" in send(call, expect=409)["error"]["what"]
    for one in begun:
        service.web.uploads.close(one)
    send(call)


def test_only_so_many_uploads_wait_and_a_deleted_one_makes_room(call, service):
    found = [send(call)["id"] for _ in range(WAITING)]
    assert "wait to be identified" in send(call, expect=409)["error"]["what"]
    assert len(call("POST", f"/uploads/{found[0]}/delete", 200, json={})["uploads"]) == WAITING - 1
    call("GET", f"/uploads/{found[0]}", 404)
    send(call)


class Body:
    """Request with a body from the test."""

    def __init__(self, *parts: bytes | Exception | float) -> None:
        self._parts = parts

    async def stream(self) -> Any:
        for one in self._parts:
            if isinstance(one, Exception):
                raise one
            if isinstance(one, float):
                await asyncio.sleep(one)
            else:
                yield one


@pytest.mark.parametrize(("body", "kind"), [
    (Body(b"half", ClientDisconnect()), "ClientDisconnect"), (Body(b"half", 60.0), "TooSlow"),
])
def test_an_upload_that_is_cut_off_or_too_slow_keeps_nothing(service, monkeypatch, body, kind):
    monkeypatch.setattr(upload_routes, "HEADERS_S", 0.05)
    received = service.web.uploads.begin(None)
    with pytest.raises(Exception) as caught:
        asyncio.run(upload_routes._receive(body, received))
    assert type(caught.value).__name__ == kind
    service.web.uploads.close(received)
    assert left(service) == []


def test_the_time_of_an_upload_grows_with_its_bytes(service, monkeypatch):
    monkeypatch.setattr(upload_routes, "HEADERS_S", 0.05)
    monkeypatch.setattr(upload_routes, "SLOWEST", 2**20)
    received = service.web.uploads.begin(None)
    asyncio.run(upload_routes._receive(Body(*[b"x" * 2**20] * 20, 0.3, b"x"), received))
    assert received.size == 20 * 2**20 + 1
    service.web.uploads.close(received)


def test_a_service_that_ended_leaves_nothing_half_received_and_old_uploads_expire(call, service, monkeypatch):
    service.web.uploads.begin(None)._file.close()
    (service.store.folder / "uploads" / "0123456789abcdef").mkdir()
    kept = send(call)["id"]
    service.web.uploads.start()
    assert left(service) == [kept]
    monkeypatch.setattr(uploads, "KEPT_S", -1.0)
    assert call("GET", "/uploads", 200)["uploads"] == []
    assert left(service) == []


# -- rights, names and hostile files


def test_without_a_login_nothing_is_uploaded(tmp_path, rigs):
    service = Service(tmp_path / "data", rigs, login=True)
    with TestClient(service.web.asgi, base_url=URL) as client:
        for method, path in (("POST", "/uploads"), ("GET", "/uploads"), ("POST", "/uploads/0123456789abcdef/identify")):
            answer = client.request(method, f"{API}{path}", headers={"Content-Type": "application/octet-stream"})
            assert answer.status_code == 401, path
    assert left(service) == []


@pytest.mark.parametrize(("name", "shown"), [
    ("../../etc/passwd", "passwd"), ("C:\\logs\\a.csv", "a.csv"), ("", "without a name"),
    ("a" * 500 + ".csv", "a" * 200), ("<b>x</b>.csv", "b>.csv"), ("a\r\nb.csv", None),
])
def test_a_name_is_a_text_of_one_line_and_never_a_path(name, shown):
    found = shown_name(name)
    assert shown is None or found == shown
    assert found.isprintable() and "/" not in found


def test_a_hostile_name_is_escaped_on_the_page(call, client, work):
    run = identify(call, send(call, name="<img src=x onerror=alert(1)>.csv")["id"])["run"]
    text = client.get(f"/runs/{run}").text
    assert "<img src=x" not in text and "&lt;img src=x" in text


@pytest.mark.parametrize(("data", "said"), [
    (b"x\n1\n2\n", "no table"), (b"\x00\x01\x02" * 500, "neither text"), (b"\x89MCAP0\r\n", ""),
    (b"t_s;n_rpm;m_nm\n" + b"0;nan;nan\n" * 50, ""), (b"PK\x03\x04" + b"x" * 99, "spreadsheet"),
])
def test_the_preview_reports_a_file_that_is_no_recording(call, work, data, said):
    upload = send(call, data)["id"]
    found = call("POST", f"/uploads/{upload}/preview", 200, json={})
    problem = found["preview"]["problem"]
    assert problem is None if found["wrong"] else said in problem["message"]
    assert found["preview"]["reading"] is None


def test_utf_16_is_read(call, work):
    text = "time_s,speed_rad_s,torque_nm\n" + "".join(f"{k / 10},4,{90 + k % 3}\n" for k in range(40))
    upload = send(call, text.encode("utf-16"))["id"]
    found = call("POST", f"/uploads/{upload}/preview", 200, json={})
    assert (found["preview"]["reading"]["samples"], found["wrong"]) == (40, [])


def test_a_log_has_its_own_motion_and_takes_no_options_of_a_trace(call, work):
    upload = send(call, b"\x89MCAP0\r\n")["id"]
    error = call("POST", f"/uploads/{upload}/identify", 422, json={"gear_ratio": 2.0})
    assert error["fields"][0]["option"] == "gear_ratio"


# -- the whole path


@pytest.mark.heavy
def test_an_identified_trace_is_marked_as_uploaded_in_every_document(call, service, client, monkeypatch):
    import numpy as np

    play_uploads(service, monkeypatch, played=False)

    time_s = np.arange(0.0, 80.0, 0.05)
    speed = 4.0 + np.where(time_s % 20 < 10, 0.5, -0.5) * np.minimum(1.0, (time_s % 10) / 2)
    noise = np.random.default_rng(1).normal(size=(2, len(time_s)))
    torque = 60.0 + 8.0 * speed + 104.0 * np.gradient(speed, time_s) + noise[0]
    rows = "".join(f"{a:.2f},{b:.5f},{c:.3f}\n"
                   for a, b, c in zip(time_s, speed + 0.003 * noise[1], torque, strict=True))
    upload = send(call, f"time_s,speed_rad_s,torque_nm\n{rows}".encode())["id"]
    usual = {"columns": ["time=time_s:s", "speed=speed_rad_s:rad/s", "torque=torque_nm:Nm"]}
    call("POST", f"/uploads/{upload}/identify", 202, json={**usual, "rig": "b", "operator": "Anna"})
    found = wait_for("its end", lambda: (one := call("GET", f"/uploads/{upload}", 200))["state"] in ("done", "failed")
                     and one)
    assert found["error"] is None
    run = found["run"]
    result = call("GET", f"/runs/{run}/result.json", 200)
    assert result["uploaded"]["rig"] == "b" and result["inertia_kg_m2"] is not None
    assert "UPLOADED" in client.get(f"{API}/runs/{run}/report.html").text
    replayed = service.supervisor.work("replay", run, {"confidence": 0.9})["document"]
    assert replayed["uploaded"] == result["uploaded"] and replayed["warnings"] == result["warnings"]
    assert len(call("GET", f"/runs/{run}/pictures", 200)) >= 3
    # the log of a run, uploaded again, is the same recording
    log = client.get(f"{API}/runs/{run}/log.mcap").content
    again = send(call, log, name="run.mcap")
    assert again["kind"] == "log"
    preview = call("POST", f"/uploads/{again['id']}/preview", 200, json={})["preview"]
    assert preview["reading"]["samples"] == len(time_s) and preview["run"]["operator"] == "Anna"


def test_a_preview_leaves_the_motion_of_a_running_identification_as_it_is(tmp_path, monkeypatch):
    """The identification reads the trace after its motion is written. A preview of another form may come in between."""
    from tdhil import session
    from tdhil.service.upload_work import read_upload

    monkeypatch.chdir(tmp_path)
    (tmp_path / "trace.csv").write_bytes(TRACE)
    seen: list[str] = []

    def read(name: str, *, excitation: str | None = None, **more: Any) -> Any:
        if excitation is not None and not seen:
            seen.append("")
            read_upload("trace", {"excitation": "kind: other\n"})
            read_upload("trace", {})
        seen.append("" if excitation is None else (tmp_path / excitation).read_text())
        return None

    monkeypatch.setattr(session, "read", read)
    monkeypatch.setattr(session, "trace_arguments", lambda given, where: {"excitation": given["excitation"]})
    read_upload("trace", {"excitation": "kind: mine\n"})
    assert seen == ["", "kind: other\n", "", "kind: mine\n"]
    assert [one.name for one in tmp_path.iterdir()] == ["trace.csv"]
