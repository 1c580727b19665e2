"""Pages of a rig in Chromium: a new rig, its card, its calibration, and the letterhead of the site."""

from __future__ import annotations

import json
import os
import re
import threading
import time
from pathlib import Path

import pytest

from tdhil.service.store import write_json
from tests.service.chromium.pages import HOSTILE, IN_CHROMIUM, begin, estimate, second
from tests.service.conftest import wait_for

pytestmark = IN_CHROMIUM


@pytest.mark.heavy
def test_a_letterhead_is_set_and_an_svg_refused_at_its_field(page, served):
    from tests.report.test_letterhead import png

    page.goto("/")
    page.get_by_role("link", name="Letterhead of reports").click()
    page.get_by_label("Company").fill(HOSTILE)
    page.get_by_label("Address").fill("Hafen 1\nAurich")
    logo = page.get_by_label("Logo, a PNG")
    logo.set_input_files({"name": "logo.png", "mimeType": "image/png", "buffer": b"<svg onload='window.pwned=1'/>"})
    page.get_by_role("button", name="Save").click()
    page.locator("#wrong-logo").get_by_text("It may contain scripts").wait_for()
    assert logo.get_attribute("aria-invalid") == "true" and not page.locator("#logo").is_visible()
    logo.set_input_files({"name": "logo.png", "mimeType": "image/png", "buffer": png(300, 100)})
    page.get_by_role("button", name="Save").click()
    page.get_by_text("Saved.").wait_for()
    wait_for("the picture", lambda: page.evaluate("document.querySelector('#logo img').naturalWidth") == 300)
    page.reload()
    wait_for("the text", lambda: page.get_by_label("Company").input_value() == HOSTILE)
    page.get_by_label("Remove the logo").check()
    page.get_by_role("button", name="Save").click()
    page.locator("#logo").wait_for(state="hidden")
    assert page.get_by_label("Address").input_value() == "Hafen 1\nAurich"
    assert page.evaluate("window.pwned") is None


def test_an_unavailable_action_gives_the_reason_before_the_click(page, served):
    page.goto("/start/watched")
    page.get_by_text("This rig moves only while a logged-in user watches it").wait_for()
    assert page.get_by_role("button", name="Start").count() == 0
    page.goto("/")
    card = page.get_by_role("article", name="watched", exact=True)
    card.get_by_text("free; moves only while a logged-in user watches it").wait_for()
    assert card.get_by_role("link", name="Start").count() == 0
    assert page.get_by_role("article", name="real", exact=True).get_by_role("link", name="Start").count() == 1
    page.goto("/rigs/a/file")
    page.get_by_text("Read-only: this service has no accounts").wait_for()
    assert not page.get_by_text("You can change here").is_visible()


def test_a_wrong_value_of_a_rehearsal_is_marked_at_its_fault(page, served):
    page.goto("/rehearse/a")
    button = page.get_by_role("button", name="Rehearse torque-scale", exact=True)
    row = page.locator("#faults li", has=button)
    row.get_by_role("textbox").fill("abc")
    button.click()
    row.locator(".wrong").wait_for()
    assert row.get_by_role("textbox").get_attribute("aria-invalid") == "true"
    assert "--fault" not in row.inner_text() and "torque-scale" in row.locator("strong").inner_text()
    assert served.service.store.ids() == []
    row.get_by_role("textbox").fill("1.1")
    button.click()
    page.wait_for_url("**/runs/**")


def test_the_code_page_marks_a_simulated_drive_also_one_that_preflight_finds_on_a_bus(page, served):
    run = begin(served, "ask", "rehearsed")
    page.goto(f"/runs/{run}/live")
    page.get_by_label("Six digits").wait_for()
    page.locator("h1").get_by_text("SIMULATED").wait_for()
    run = begin(served, "ask", "real")
    page.goto(f"/runs/{run}/live")
    page.get_by_label("Six digits").wait_for()
    assert not page.locator("h1").get_by_text("SIMULATED").is_visible()
    path = served.service.store.place(run) / "state.json"
    write_json(path, json.loads(path.read_bytes()) | {"simulated": True})
    page.locator("h1").get_by_text("SIMULATED").wait_for()


@pytest.mark.heavy
def test_the_enter_key_does_not_send_a_new_rig_before_its_page_is_ready(page):
    held = []

    def hold(route):
        held.append(route)

    page.route("**/api/v1/new-rig", hold)
    page.goto("/new-rig")
    wait_for("the question", lambda: page.wait_for_timeout(20) or held)
    page.get_by_label("Name in reports").fill("Bench 3")
    page.keyboard.press("Enter")
    held[0].continue_()
    page.locator("#scan:enabled").wait_for()
    assert (page.get_by_label("Name in reports").input_value(), len(held)) == ("Bench 3", 1)


@pytest.mark.heavy
def test_a_result_of_a_simulated_drive_is_marked_on_the_card_of_a_real_rig(page):
    last = {"id": "20260501-120000-0123ab", "asked": "2026-05-01T12:00:00Z", "simulated": True, "state": "failed",
            "inertia_kg_m2": 104.0, "low_kg_m2": 100.0, "high_kg_m2": 108.0}
    rig = {"id": "a", "name": "Rig a", "state": "free", "simulated": False, "motion": "attended", "last": last}
    page.route("**/api/v1/rigs", lambda route: route.fulfill(json=[rig]))
    page.goto("/")
    card = page.get_by_role("article", name="Rig a")
    card.get_by_text("· failed").wait_for()
    assert card.get_by_text("SIMULATED").count() == 1


@pytest.mark.heavy
def test_the_steps_of_a_new_rig(page, served, rigs, monkeypatch):
    def box(label):
        return page.get_by_role("textbox", name=re.compile(f"^{label}"))

    page.goto("/")
    page.get_by_role("link", name="Add a rig").click()
    page.get_by_label("Name in reports").fill("Bench 3")
    assert page.get_by_label("Id:").input_value() == "bench-3"
    page.get_by_label("Profile:").select_option("maxon/epos4")
    box("Interface:").fill("socketcan")
    box("Highest speed").fill("95 rpmm")
    page.get_by_role("button", name="Save the rig").click()
    page.get_by_text("entries need a correction").wait_for()
    assert "is not a unit of speed" in box("Highest speed").locator("xpath=..").inner_text()
    page.locator("[data-field=accept_unverified] .wrong").wait_for()         # an error without its own field
    assert not (rigs / "bench-3.yaml").exists()
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, sent: {"document": {
        "found": [{"address": 3, "title": HOSTILE, "identity": HOSTILE, "simulated": False, "profile": "maxon/epos4",
                   "why": HOSTILE, "fields": {"node": "3"}}], "remarks": [HOSTILE]}})
    page.get_by_role("button", name="Scan for the drive").click()
    page.locator("label", has=page.locator("[name=alone]")).get_by_text("Confirm that no other master").wait_for()
    page.get_by_label("No other master is active").check()
    page.get_by_role("button", name="Scan for the drive").click()
    page.locator("#scan-said").get_by_text("node 3").wait_for()
    page.get_by_role("button", name="Use this drive").click()
    page.get_by_text("The fields above now have its address.").wait_for()
    assert box("Node:").input_value() == "3"
    for label, text in (("Lowest speed", "5 rpm"), ("Highest speed", "95 rpm"), ("Highest torque, either", "400"),
                        ("Longest run", "15 min"), ("Deceleration of a stop", "2"),
                        ("Highest torque of the sign", "200"), ("Farthest travel", "3")):
        box(label).fill(text)
    for one in page.locator("[name=accept], [name=made]").all():
        one.check()
    page.get_by_role("button", name="Check").click()
    page.get_by_text("The file is complete.").wait_for()
    page.reload()
    page.locator("[name=made]").first.wait_for()
    assert all(one.is_checked() for one in page.locator("[name=made]").all())
    page.get_by_label("Id:").fill("bench 3!")
    page.get_by_role("button", name="Save the rig").click()
    page.locator("#wrong-id").get_by_text("must be letters, digits").wait_for()
    page.get_by_label("Id:").fill("bench-3")
    page.get_by_role("img", name="Window of motion: 0.524 to 9.95 rad/s, at most 400 N·m").wait_for()
    page.get_by_role("button", name="Speeds in rad/s").click()
    page.get_by_role("img", name="Window of motion: 5 to 95 rpm, at most 400 N·m").wait_for()
    page.get_by_role("button", name="Save the rig").click()
    page.wait_for_url("**/start/bench-3?first=true")
    page.get_by_role("button", name="Start: preflight, then the code").wait_for()
    page.get_by_role("heading", name="First motion of this rig").wait_for()          # its steps, and a careful plan
    page.get_by_text("The shaft moves for the first time: at most 200 N·m and 3 rad.").wait_for()
    assert page.locator("[name=highest_speed_rad_s]").input_value() == "41"    # rpm, as set by the switch: 4.29 rad/s
    page.get_by_text("The shaft turns at 14 and then at 30.2 rpm.").wait_for()
    checks = [{"grade": grade, "name": HOSTILE, "said": HOSTILE, "do": do} for grade, do in
              (("ok", ""), ("note", ""), ("bad", "Choose its own profile"))]
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, sent: {"document": {"checks": checks}})
    page.get_by_role("button", name="Check the drive").click()          # before the first motion, and without motion
    page.get_by_text("Failed: 1 of 3 checks. Correct them before the first motion.").wait_for()
    rows = page.get_by_role("region", name="Findings of the check").locator("tbody tr")
    assert [row.locator("td").first.inner_text() for row in rows.all()] == ["pass", "for information", "fail"]
    assert "Choose its own profile" in rows.nth(2).inner_text()
    del checks[2]
    page.get_by_role("button", name="Check the drive").click()
    page.get_by_text("No check failed. Nothing has moved.").wait_for()
    assert served.service.store.ids() == []
    assert "speed_max_rad_s:         \"95 rpm\"" in (rigs / "bench-3.yaml").read_text()
    assert page.evaluate("window.pwned") is None


@pytest.mark.heavy
def test_a_simulated_rig_is_added_without_a_drive(page, rigs):
    page.goto("/new-rig")
    page.get_by_label("Name in reports").fill("Bench 4")
    page.get_by_label("Profile:").select_option("maxon/epos4")
    page.get_by_label("Simulated: there is no drive").check()
    for hidden in ("Settings at the drive", "Scan for the drive", "Motion from the browser"):
        assert page.get_by_text(hidden, exact=True).count() == 1
        assert not page.get_by_text(hidden, exact=True).is_visible()
    page.reload()                                                   # the typed values are restored
    page.get_by_label("Simulated: there is no drive").wait_for()
    page.get_by_text("Type all of them or none").wait_for()
    page.get_by_label("Name in reports").fill("Prüfstand Größe 1")          # an id that Germans recognise
    assert page.get_by_label("Id:").input_value() == "prufstand-grosse-1"
    page.get_by_label("Name in reports").fill("Bench 4")
    gear = page.get_by_role("textbox", name="Gear:")
    gear.fill("0")
    page.get_by_role("textbox", name="Longest run").fill("15 min")
    page.get_by_role("button", name="Check").click()
    page.get_by_text("7 entries need a correction. Each is marked at its field.").wait_for()
    assert page.locator("label .wrong").count() == 7 and page.locator("#new-rig-said").is_hidden()
    gear.fill("")
    page.get_by_role("textbox", name="Longest run").fill("")
    page.get_by_role("button", name="Save the rig").click()
    page.wait_for_url("**/start/bench-4")
    page.get_by_text("SIMULATED").first.wait_for()
    page.get_by_role("button", name=re.compile("^Start")).wait_for()
    assert "run: {simulate: true}" in (rigs / "bench-4.yaml").read_text()


def test_the_steps_of_a_torque_calibration(page, served, monkeypatch):
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    other = second(served, run)
    inertia = {"value": 109.0, "low_total": 105.0, "high_total": 113.0}
    for one in (run, other):
        write_json(served.service.store.place(one) / "result.json", {"verdict": "valid", "inertia_kg_m2": inertia})
        served.service.supervisor.index.put(served.service.store.summary(one))
    quantity = {**estimate(0.955), "coverage_factor": 2.0}
    found = {"verdict": "valid", "reason": HOSTILE, "advice": "", "warnings": [HOSTILE], "calibration_factor": quantity,
             "inertia_kg_m2": {**quantity, **estimate(104.0)}, "runs": [{"added_kg_m2": 55.0, "reported_kg_m2": 167.0}],
             "budget": [{"source": HOSTILE, "of_factor": 0.002, "of_inertia": 0.003}]}
    asked = []
    rehearsed = served.service.supervisor.start_run("a", {"note": "done", "fault": ["torque-scale=1.1"]}, "local")
    served.service.wait(rehearsed.request.id, "done")
    page.goto("/")
    page.get_by_role("link", name="Calibrate").first.click()
    page.wait_for_url("**/calibrate/a")
    page.get_by_label("Run without the body").select_option(run)
    assert page.locator(f"option[value='{rehearsed.request.id}']").count() == 0
    page.get_by_label("Run with the body").select_option(run)
    page.get_by_label("Inertia of the body").fill("55,0")
    page.get_by_label("Inertia of the body").fill("much")
    page.get_by_label("Its standard uncertainty").fill("-1")
    calibrate = page.get_by_role("button", name="Calibrate")
    calibrate.click()
    page.locator("#wrong-with_body", has_text="Choose two different runs.").wait_for()      # at once, each at its field
    page.locator("#wrong-added_kg_m2", has_text="as a positive number of kg·m²").wait_for()
    assert {one.get_attribute("name") for one in page.locator("#calibrate [aria-invalid=true]").all()} == {
        "with_body", "added_kg_m2", "added_sd_kg_m2"}
    assert asked == []
    page.get_by_label("Run with the body").select_option(other)
    page.get_by_label("Its standard uncertainty").fill("")
    page.get_by_label("Inertia of the body").fill("55,0")
    goes_on = threading.Event()

    def slow(what, run, more):
        goes_on.wait(30.0)
        asked.append(more)
        return {"document": found}

    monkeypatch.setattr(served.service.supervisor, "work", slow)
    calibrate.click()
    page.get_by_text(re.compile(r"^Identifying both logs: \d+ s$")).wait_for()
    assert page.locator("#said").get_by_role("progressbar").count() == 1
    goes_on.set()
    page.get_by_text("κ = 0.9550 (0.9454 to 0.9646)").wait_for()
    assert (asked[0]["without"], asked[0]["with_body"], asked[0]["added_kg_m2"]) == (run, other, 55.0)
    with page.expect_download() as download:
        page.get_by_role("link", name="calibration.json").click()
    assert download.value.suggested_filename == "calibration.json"
    assert json.loads(Path(download.value.path()).read_text("utf-8")) == found
    assert page.evaluate("window.pwned") is None


@pytest.mark.heavy
def test_a_new_user_has_a_result_after_two_clicks(browser, tmp_path):
    """The service is a process with its own simulated rigs and a real run. `pytest -s` shows the duration."""
    from tests.service.test_serve import served as process

    began_s = time.monotonic()
    with process(tmp_path / "data") as server:
        page = browser.new_context(base_url=server.url).new_page()
        page.set_default_timeout(300_000)
        page.goto("/")
        page.get_by_role("article", name="Simulated rig, CANopen").get_by_role("link", name="Start").click()
        clicked_s = time.monotonic()
        page.get_by_role("button", name="Start").click()
        page.get_by_text(re.compile(r"J = 1(07|08|09|10|11)")).first.wait_for()       # 1.05 times 104
        took_s = time.monotonic() - clicked_s
        page.locator(".pictures img").nth(4).evaluate("one => { one.loading = 'eager'; return one.decode() }")
        run = server.client.runs()[0]["id"]
        page.get_by_label("Tolerance: half-width").fill("0.1")
        page.get_by_role("button", name="Replay").click()
        page.get_by_role("row", name="tolerance 0.001").get_by_text("valid_wide").wait_for()
        page.get_by_role("row", name="the run itself").get_by_role("cell", name="valid", exact=True).wait_for()
        for name, begins in (("report.pdf", b"%PDF"), ("samples.csv", b"time_s,"), ("run.mcap", b"\x89MCAP")):
            with page.expect_download() as loaded:
                page.locator(".files").get_by_role("link", name=name).click()
            assert loaded.value.path().read_bytes().startswith(begins)
        page.get_by_role("link", name="Fleet").click()
        page.get_by_role("button", name="Identify").click()
        page.get_by_text("done: 1 of 1 logs").wait_for()
        page.get_by_role("row", name=run).get_by_text("the same").wait_for()
        assert [row["changed"] for row in server.client.fleet_rows(server.client.fleet()["id"])] == [False]
        print(f"a click to a result: {took_s:.0f} s, {clicked_s - began_s:.0f} s from the command to the click;"
              f" load {os.getloadavg()[0]:.1f}")
