"""The pages in Chromium, before a service whose runs are played: what they show, and what they do when nobody answers.

Skipped where there is no Chromium (`TDHIL_CHROMIUM` names one, else the PATH) or no playwright (extra `browser`).
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import signal
import socket
import threading
import time
import zipfile
from collections.abc import Iterator
from dataclasses import asdict
from html import escape
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest

from drivers import PreflightRefused
from tdhil.service.store import write_json
from tdhil.session import hold
from tests.recording.test_log_tail import write
from tests.service.conftest import Service, play_uploads, wait_for

CHROMIUM = os.environ.get("TDHIL_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.real_time,         # a page that is silent for five seconds brakes its run
    pytest.mark.one_worker,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium (apt-get install chromium, or TDHIL_CHROMIUM=PATH)"),
    pytest.mark.skipif(find_spec("playwright") is None, reason="no playwright: pip install -e '.[browser]'"),
]
HOSTILE = "<script>window.pwned=1</script><b id=x>bold</b>"
PAGES = ("/", "/new-rig", "/start/a", "/calibrate/a", "/rehearse/a", "/rigs/a", "/runs", "/upload", "/fleets", "/audit",
         "/docs", "/letterhead")
PLAN = {
    "excitation": "multisine", "mode": "torque", "duration_s": 100.0, "expected_half_width": 0.021, "stopping": None,
    "speed_rad_s": {"min": 1.0, "max": 5.0}, "torque_nm": {"min": -10.0, "max": 50.0},
    "limits": {"speed_min_rad_s": 0.5, "speed_max_rad_s": 10.0, "torque_nm": 400.0},
}


class Served:
    """The web of one service on a port of its own, in a thread; it can be ended."""

    def __init__(self, service: Service, cert: Path | None = None, key: Path | None = None) -> None:
        import uvicorn

        self.service = service
        listening = socket.socket()
        listening.bind(("127.0.0.1", 0))
        self.url = f"http{'s' if cert else ''}://127.0.0.1:{listening.getsockname()[1]}"
        config = uvicorn.Config(service.web.asgi, log_level="error", ws="websockets-sansio",
                                timeout_graceful_shutdown=1, ssl_certfile=cert, ssl_keyfile=key)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._server.serve(sockets=[listening])), daemon=True)
        self._thread.start()
        wait_for("the server", lambda: self._server.started)

    def end(self) -> None:
        self._server.should_exit = True
        self._thread.join(10.0)


@pytest.fixture
def served(service: Service, rigs: Path) -> Iterator[Served]:
    (rigs / "hostile.yaml").write_text(f"name: '{HOSTILE}'\nrun: {{simulate: true}}\n")
    found = Served(service)
    yield found
    found.end()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as engine:
        found = engine.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-dev-shm-usage"])
        yield found
        found.close()


@pytest.fixture
def page(browser: Any, served: Served) -> Iterator[Any]:
    """A page that loads nothing from elsewhere, and whose script makes no mistake."""
    context = browser.new_context(base_url=served.url)
    context.set_default_timeout(60_000)
    found = context.new_page()
    trouble: list[str] = []
    found.on("pageerror", lambda error: trouble.append(str(error)))
    found.on("console", lambda said: trouble.append(said.text) if "Content Security" in said.text else None)
    found.on("request", lambda asked: trouble.append(asked.url) if not asked.url.startswith(served.url) else None)
    yield found
    context.close()
    assert trouble == []


def begin(served: Served, what: str = "hold", rig: str = "a") -> str:
    run = served.service.supervisor.start_run(rig, {"note": what}, "local").request.id
    served.service.wait(run, "awaiting_confirmation" if what == "ask" else "moving")
    return run


def estimate(value: float, share: float = 0.01) -> dict[str, float]:
    return {"value": value, "low": value * (1 - share), "high": value * (1 + share)}


def results(served: Served, run: str, monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    """Pages of results, with everything on them that there may be, called and said as badly as can be."""
    from tdhil.fleet import FleetRow
    from tdhil.fleet.table import write_table

    store = served.service.store
    folder = store.place(run)
    inertia = {**estimate(104.0), "low_total": 100.0, "high_total": 108.0, "half_width_total_rel": 0.04,
               "repeatability_rel": 0.01, "confidence": 0.9}
    write_json(folder / "result.json", {
        "verdict": "valid", "inertia_kg_m2": inertia, "reason": HOSTILE, "advice": HOSTILE,
        "calibration_advised": True, "model": "rigid+lags",
        "warnings": [HOSTILE, "speed was quantised"], "viscous_nm_s_rad": estimate(8.0), "speed_lag_s": estimate(0.4),
        "budget": [{"source": "noise", "half_width_kg_m2": 0.2, "note": HOSTILE}],
        "second_opinions": [{"route": HOSTILE, "inertia_kg_m2": estimate(103.0), "agrees": True, "note": ""}],
        "friction_curve": [{"speed_rad_s": speed, "torque_nm": estimate(60.0 + 8.0 * speed)} for speed in (2.0, 5.0)],
    })
    svg = "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 9 9'><path d='M0 0L9 9' stroke='red'/></svg>"
    (folder / "report.html").write_text(
        f"<h2>Friction over speed</h2><figure>{svg}<figcaption>{escape(HOSTILE)} no lag touches it</figcaption>")
    row = FleetRow(f"runs/{run}/run.mcap", "valid", rig=HOSTILE, date="2026-05-01T12:00:00", inertia_kg_m2=104.0,
                   inertia_low_kg_m2=103.0, inertia_high_kg_m2=105.0, inertia_low_total_kg_m2=100.0,
                   inertia_high_total_kg_m2=108.0, simulated=True, changed=True, stored_verdict="valid_wide",
                   stored_inertia_kg_m2=99.0)
    bad = FleetRow(f"../{HOSTILE}.csv", "unread", error_kind="UsageError", error_text=f"no column {HOSTILE}\x1b[2J")
    place = store.folder / "fleets" / "0123456789ab"
    place.mkdir(parents=True)
    asked = {"folder": "", "below": HOSTILE, "settings": {"model": "rigid"}, "root": "", "asked": row.date,
             "asked_by": HOSTILE}
    write_json(place / "request.json", asked)
    summary = {"logs": 2, "verdicts": {"valid": 1}, "failed": {"UsageError": 1}, "changed": [{}], "done_before": 1,
               "slowest": [{"log": HOSTILE, "cpu_s": 0.5}], "live": 1, "bare_traces": 0, "left": 0, "wall_s": 3.0,
               "cpu_s": 2.0}
    write_json(place / "state.json", {"state": "done", "total": 2, "done": 2, "failed": 1, "summary": summary})
    write_table([row, bad], place / "fleet.csv")
    point = {"log": run, "date": row.date, **estimate(104.0)}
    after = {"log": run, "date": "2026-06-01T12:00:00", **estimate(99.0)}
    change = {"before": run, "after": run, "before_date": point["date"], "after_date": after["date"]}
    told = {"column": "inertia_kg_m2", "name": "inertia", "unit": "kg·m²", "differs": True, "relative": True,
            **estimate(-0.05), "change": -0.05}
    curve = [{"hertz": hertz, **estimate(100.0 + 40 * hertz)} for hertz in (0.1, 0.2)]
    played = {
        "trend": {"notes": [HOSTILE], "quantities": [
            {"name": "inertia", "unit": "kg·m²", "text": f"changed by -5 % {HOSTILE}", "points": [point, after],
             "changes": [change], "drift": None}]},
        "compare": {
            "results": [asdict(row), asdict(row)], "apparent_inertia": [curve, curve], "friction": [[], []],
            "differences": [{"text": f"the inertias differ {HOSTILE}", "quantities": [
                told, {**told, "column": "coulomb_nm", "name": HOSTILE}]}],
            "settings": [{"name": "rig", "values": [HOSTILE, "R7"], "differs": True},
                         {"name": "load", "values": ["none", "none"], "differs": False}]},
    }
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": played[what]})
    write_json(folder / "row.json", asdict(row))
    return (f"/runs/{run}", f"/compare?runs={run},{second(served, run)}", f"/rigs/{store.request(run).rig}",
            "/fleets/0123456789ab")


def second(served: Served, run: str) -> str:
    """Another run of the rig."""
    other = served.service.supervisor.start_run(served.service.store.request(run).rig, {"note": "done"}, "local")
    served.service.wait(other.request.id, "done")
    return str(other.request.id)


@pytest.mark.heavy
def test_from_the_rigs_to_a_result_by_keyboard_alone(page, served, monkeypatch):
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": PLAN})
    page.goto("/")
    page.get_by_role("article", name="Rig a").get_by_role("link", name="Start").focus()
    page.keyboard.press("Enter")
    page.wait_for_url("**/start/a")
    page.get_by_label("Tolerance: half-width").focus()
    page.keyboard.type("2,5")
    page.keyboard.press("Enter")       # as the first button would have it: a plan, and nothing begins by mistake
    page.get_by_role("row", name="expected interval of J").get_by_text("±2.1 %").wait_for()
    assert served.service.store.ids() == []
    page.locator("button[value=start]:enabled").wait_for()
    page.get_by_role("button", name="Start").focus()
    page.keyboard.press("Enter")
    page.get_by_text("J = 104.0 (100.0 to 108.0) kg·m²").wait_for()       # by itself: the page becomes the result
    assert "/live" not in page.url
    (run,) = served.service.store.ids()
    assert served.service.store.request(run).options == {"tolerance": 0.025}
    page.get_by_role("link", name="The recorded motion").click()
    page.locator("#readout").wait_for()
    page.get_by_role("link", name="To the result").wait_for()             # it stays


def test_an_error_names_the_field_and_takes_the_old_plan_away(page, served, monkeypatch):
    """The terminal's words are options: on the form they are its labels, and the field is marked."""
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": PLAN})
    page.goto("/start/a")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("row", name="expected interval of J").wait_for()

    def refused(what: str, run: Any, asked: Any) -> Any:
        raise PreflightRefused("time: 20 s are too short", next_step="Give --max-time 146s or more, not --max-times")

    monkeypatch.setattr(served.service.supervisor, "work", refused)
    field = page.locator("[name=max_time_s]")
    label = page.locator("label", has=field).get_attribute("data-label")
    field.fill("20")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("alert").get_by_text(f"Give “{label}” 146s or more, not --max-times").wait_for()
    assert field.get_attribute("aria-invalid") == "true"
    assert field.evaluate("one => one === document.activeElement")
    assert not page.locator("#plan").is_visible()


def test_all_wrong_values_of_the_start_form_are_said_at_once(page, served):
    """Each field is marked and has its own words; the labels are the form's, and no option of the terminal is named."""
    page.goto("/start/a")
    page.get_by_text("Simulated rig", exact=True).click()
    for name, text in (("tolerance", "lots"), ("max_time_s", "-5"), ("seed", "-4")):
        page.locator(f"[name={name}]").fill(text)
    page.locator("[name=operator]").fill("Anna")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("alert").get_by_text("3 values can't be used").wait_for()
    marked = page.locator("[aria-invalid=true]")
    assert sorted(one.get_attribute("name") for one in marked.all()) == ["max_time_s", "seed", "tolerance"]
    for name in ("max_time_s", "seed", "tolerance"):
        field = page.locator(f"[name={name}]")
        label = page.locator("label", has=page.locator(f"[name={name}]")).get_attribute("data-label")
        assert page.locator(f"#{field.get_attribute('aria-describedby')}").inner_text()
        assert page.locator("#said").get_by_text(label, exact=True).count() == 1
    said = page.locator("#said").inner_text()
    assert "--" not in said
    assert "must be above 0 and at most" in said and "not -5 min" in said           # in the unit of the field
    assert served.service.store.ids() == []
    page.locator("[name=seed]").fill("")
    page.locator("[name=max_time_s]").fill("")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("alert").get_by_text("One value can't be used").wait_for()
    assert [one.get_attribute("name") for one in marked.all()] == ["tolerance"]


def test_a_run_by_the_clock_says_first_whether_this_computer_holds_its_rate(page, served, monkeypatch):
    """A computer under load is named before Start; a second Start goes on. Unasked, a simulated run is stepped."""
    found = {"rate_hz": 100.0, "cycles": 150, "late": 12, "worst_s": 0.03, "holds": False,
             "text": "This computer does not"}
    asked = []
    monkeypatch.setattr(served.service.supervisor, "work",
                        lambda what, run, wanted: (asked.append(what), {"document": dict(found)})[1])
    page.goto("/start/a")
    page.get_by_text("Simulated rig", exact=True).click()
    page.get_by_text("as fast as possible (stepped time)").wait_for()
    assert asked == []
    page.locator("[name=real_time]").check()
    page.locator("#pace.alarm").get_by_text("This computer does not").wait_for()
    page.locator("button[value=start]:enabled").click()
    page.get_by_text("Start again to run all the same").wait_for()
    assert (asked, served.service.store.ids()) == (["pace"], [])
    page.locator("button[value=start]:enabled").click()
    page.wait_for_url("**/live")
    (run,) = served.service.store.ids()
    assert served.service.store.request(run).options == {"real_time": True}


def test_a_wait_shows_how_long_it_lasts_and_how_long_it_usually_does(page, served, monkeypatch):
    """A plan takes seconds: a bar and its time, and at the second time the usual time too; asked twice, made once."""
    goes_on, asked = threading.Event(), []

    def slow(what: str, run: Any, wanted: Any) -> Any:
        asked.append(what)
        goes_on.wait(30.0)
        return {"document": PLAN}

    monkeypatch.setattr(served.service.supervisor, "work", slow)
    page.goto("/start/a")
    page.get_by_role("button", name="Plan").click()
    page.get_by_text(re.compile(r"^Planning: \d+ s$")).wait_for()
    assert page.get_by_role("progressbar").count() == 1
    goes_on.set()
    page.get_by_role("row", name="expected interval of J").wait_for()
    assert page.get_by_role("progressbar").count() == 0
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("row", name="expected interval of J").wait_for()
    assert asked == ["plan"]
    goes_on.clear()
    page.locator("[name=tolerance]").fill("3")
    page.get_by_role("button", name="Plan").click()
    page.get_by_text(re.compile(r"^Planning: \d+ s of about \d+ s$")).wait_for()
    goes_on.set()
    page.get_by_role("row", name="expected interval of J").wait_for()


@pytest.mark.heavy
def test_expected_values_are_typed_on_the_start_form(page, served):
    page.goto("/start/a")
    page.get_by_label("Expected values of an acceptance").fill("inertia=104,5 kg·m² ± 5 %, speed-lag = 400 ms ± 50 ms")
    page.get_by_role("button", name="Start").click()
    page.wait_for_url("**/runs/**")
    (run,) = served.service.store.ids()
    assert served.service.store.request(run).options == {
        "expect": ["inertia=104.5 kg·m² ± 5 %", "speed-lag = 400 ms ± 50 ms"]}


@pytest.mark.heavy
def test_a_plan_of_other_values_is_taken_away(page, served, monkeypatch):
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": PLAN})
    page.goto("/start/a")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("row", name="expected interval of J").wait_for()
    page.get_by_label("Tolerance: half-width").fill("3")
    page.locator("#plan").wait_for(state="hidden")


@pytest.mark.heavy
def test_a_page_with_a_text_that_is_not_saved_is_not_loaded_again(page, served):
    run = begin(served)
    page.goto(f"/runs/{run}")
    page.get_by_role("link", name="Live", exact=True).wait_for()
    page.get_by_label("Operator").fill("Anna")
    served.service.supervisor.stop(run, "local")
    page.get_by_text("This page has new content.").wait_for()
    assert page.get_by_label("Operator").input_value() == "Anna"
    page.get_by_role("button", name="Show it").click()
    wait_for("the new page", lambda: page.get_by_label("Operator").input_value() == "")


@pytest.mark.heavy
def test_a_record_is_saved_once_by_a_double_click(page, served):
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    sent = []
    page.on("request", lambda asked: sent.append(asked.url) if asked.url.endswith("/annotations") else None)
    page.goto(f"/runs/{run}")
    page.get_by_label("Operator").fill("Anna")
    page.locator("#annotate button").dblclick()
    page.get_by_text("Operator: Anna").wait_for()
    assert len(sent) == 1


@pytest.mark.heavy
def test_samples_that_are_made_first_show_their_progress(page, served, monkeypatch):
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    folder, goes_on = served.service.store.place(run), threading.Event()
    (folder / "run.mcap").write_bytes(b"log")

    def slow(what, of, asked):
        goes_on.wait(30.0)
        (folder / "samples.csv").write_text("time_s\n")
        return {"document": {"file": "samples.csv"}}

    monkeypatch.setattr(served.service.supervisor, "work", slow)
    page.goto(f"/runs/{run}")
    page.get_by_role("link", name="samples.csv").click()
    page.get_by_text(re.compile(r"^The file is made: \d+ s$")).wait_for()
    with page.expect_download() as got:
        goes_on.set()
    assert Path(got.value.path()).read_text() == "time_s\n"


@pytest.mark.heavy
def test_a_wrong_time_of_a_rehearsal_starts_no_run(page, served):
    page.goto("/rehearse/a")
    page.get_by_label("Delay after the start").fill("two")
    page.get_by_role("button", name="Rehearse sto", exact=True).click()
    page.locator("#wrong-after").get_by_text("a number of seconds").wait_for()
    assert served.service.store.ids() == []


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


@pytest.mark.heavy
@pytest.mark.parametrize(("path", "label", "stored"), [
    ("/letterhead", "Company", ""), ("/rigs/a/file", "rig.yaml", "simulate: true"),
])
def test_a_form_takes_no_text_before_what_is_stored_is_in_it(page, path, label, stored):
    held = []

    def hold(route):           # a method of a list can't be a handler
        held.append(route)

    page.route(f"**/api/v1{path}", hold)
    page.goto(path)
    wait_for("the question", lambda: page.wait_for_timeout(20) or held)
    field = page.get_by_label(label)
    assert not field.is_enabled()
    held[0].continue_()
    wait_for("the answer", field.is_enabled)
    assert stored in field.input_value()


@pytest.mark.heavy
def test_a_report_that_is_made_again_shows_its_progress(page, served, monkeypatch):
    """After an edit, as after a signature: the page says so, shows the time, and then gives the new report."""
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    wait_for("its end", lambda: not served.service.supervisor.live())
    folder = served.service.store.place(run)
    for name in ("report.html", "report.pdf"):
        (folder / name).write_text("<h1>old</h1>")
    goes_on, made = threading.Event(), []

    def slow(what, of, asked):
        made.append(asked["name"])
        goes_on.wait(30.0)
        (folder / asked["name"]).write_text("<h1>with its order</h1>")
        return {"document": {"file": asked["name"]}}

    monkeypatch.setattr(served.service.supervisor, "work", slow)
    page.goto(f"/runs/{run}")
    page.get_by_label("Order number").fill("4711")
    page.get_by_role("button", name="Save").click()
    page.get_by_text("made again when it is opened").wait_for()
    page.get_by_text("made again at the next download").wait_for()
    page.get_by_role("link", name="report.html").click()
    page.get_by_text(re.compile(r"^The page is made again: \d+ s$")).wait_for()
    assert page.locator(".making").get_by_role("progressbar").count() == 1
    goes_on.set()
    with page.context.expect_page() as opened:
        page.get_by_role("link", name="open it").click()
    opened.value.get_by_text("with its order").wait_for()
    assert made == ["report.html"]
    with page.expect_download() as got:
        page.get_by_role("link", name="report.pdf").click()
    assert Path(got.value.path()).read_text() == "<h1>with its order</h1>" and made == ["report.html", "report.pdf"]


REHEARSAL = {
    "verdict": "fail", "seen": "the run went on to its end (exit 0): valid, J 115 (110 to 119) kg·m²",
    "faults": [{"fault": "torque-scale=1.1", "row": 118, "required": "QS, no J", "codes": [6, 9], "verdict": "fail"}],
}


def test_a_rehearsal_shows_the_required_reaction_what_was_seen_and_its_verdict(page, served):
    run = served.service.supervisor.start_run("a", {"note": "done", "fault": ["torque-scale=1.1"]}, "local").request.id
    served.service.wait(run, "done")
    path = served.service.store.place(run) / "state.json"
    write_json(path, {**json.loads(path.read_bytes()), "rehearsal": REHEARSAL})
    page.goto(f"/runs/{run}")
    page.get_by_role("heading", name="Rehearsal", exact=True).wait_for()
    assert page.locator("h1").inner_text().endswith("REHEARSAL")
    assert page.locator("#result .verdict.bad").first.inner_text() == "fail"
    page.get_by_role("row", name="required by row 118").get_by_text("QS, no J").wait_for()
    page.get_by_role("row", name="torque-scale=1.1").get_by_text("exit 6 or 9 is required").wait_for()
    page.get_by_role("row", name="seen").get_by_text("the run went on to its end").wait_for()


def test_an_acceptance_shows_expected_beside_identified_and_what_is_off(page, served):
    from tdhil.config import Expectation
    from tdhil.report import acceptance_of

    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    path = served.service.store.place(run) / "result.json"
    result = json.loads(path.read_bytes()) | {"speed_lag_s": estimate(1.2), "viscous_nm_s_rad": estimate(8.0)}
    expected = [Expectation("inertia", 104.0, 10.4), Expectation("viscous", 8.0, 0.01),
                Expectation("speed-lag", 0.4, 0.05), Expectation("gain", 1.0, 0.1)]
    write_json(path, {**result, "acceptance": acceptance_of(expected, result)})
    page.goto(f"/runs/{run}")
    page.get_by_role("heading", name="Acceptance", exact=True).wait_for()
    page.get_by_text("lag of the reported speed is 3 times the expected value: the speed filter").wait_for()
    for name, verdict in (("moment of inertia J", "pass"), ("lag of the reported speed", "fail"),
                          ("gain P of the drive's speed loop", "cannot tell")):
        row = page.get_by_role("region", name="Acceptance").get_by_role("row", name=name)
        assert row.locator("td").last.inner_text() == verdict
    assert page.get_by_text("104 ± 10.4 kg·m²").count() == page.get_by_text("0.4 ± 0.05 s").count() == 1
    page.get_by_text("An interval overlaps the edge of its tolerance.").wait_for()
    page.set_viewport_size({"width": 390, "height": 800})
    table = page.get_by_role("region", name="Acceptance")
    assert table.evaluate("one => one.scrollWidth <= one.clientWidth")             # a phone shows the verdict too


def test_on_a_phone_the_list_of_runs_shows_j_and_verdict(page, served):
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    page.set_viewport_size({"width": 390, "height": 800})
    page.goto("/runs")
    for text in ("104.0 (100.0 to 108.0) kg·m²", "valid"):
        box = page.locator("#runs").get_by_text(text, exact=True).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 390, text


def test_the_list_of_runs_can_be_searched_and_sorted(page, served):
    for rig, operator in (("a", "Anna"), ("b", "Berta"), ("a", "Carla")):
        run = served.service.supervisor.start_run(rig, {"note": "done", "operator": operator}, "local").request.id
        served.service.wait(run, "done")
    page.goto("/runs")
    names, search = page.locator("#runs td:last-child"), page.get_by_label("Search")
    page.get_by_text("Carla: done").wait_for()
    assert set(names.all_inner_texts()) == {"Carla: done", "Berta: done", "Anna: done"}
    page.get_by_role("button", name="operator, note, tags").click()
    assert names.all_inner_texts() == ["Anna: done", "Berta: done", "Carla: done"]
    page.get_by_role("button", name="when").click()
    search.fill("anna done")
    page.get_by_text("Carla: done").wait_for(state="detached")
    assert names.all_inner_texts() == ["Anna: done"]
    search.fill("nothing of the kind")
    page.get_by_text("no run matches").wait_for()
    search.fill("")
    page.get_by_label("State").select_option("failed")
    page.get_by_text("no run matches").wait_for()


@pytest.mark.heavy
def test_an_acceptance_that_fails_is_signed_with_a_remark_and_then_shows_who_signed(page, served):
    from tests.service.test_records import ACCEPTANCE

    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    wait_for("its end", lambda: not served.service.supervisor.live())
    path = served.service.store.place(run) / "result.json"
    write_json(path, {**json.loads(path.read_bytes()), "acceptance": {**ACCEPTANCE, "verdict": "fail"}})
    page.goto(f"/runs/{run}")
    page.get_by_label("Name of the person").fill("Anna Berg")
    page.get_by_role("button", name="Sign", exact=True).click()
    page.get_by_text("a remark is needed, because the verdict is fail").wait_for()
    assert page.get_by_label("Remark").get_attribute("aria-invalid") == "true"
    page.get_by_label("Remark").fill(HOSTILE)
    page.keyboard.press("Enter")
    page.get_by_role("row", name="signed by").get_by_text("Anna Berg (admin, account local)").wait_for()
    page.get_by_role("row", name="remark").get_by_text(HOSTILE).wait_for()
    log = path.with_name("run.mcap")
    log.write_bytes(log.read_bytes() + b"x")
    page.reload()
    page.get_by_text("The signature does not hold: the log is another one").wait_for()
    assert page.evaluate("window.pwned") is None


@pytest.mark.heavy
@pytest.mark.parametrize("width", [390, 1280])
def test_evidence_of_a_run_is_made_on_its_page(browser, served, monkeypatch, width):
    """Every missing part is marked at its field; then the archive is there, with its digest.

    The run is of the simulated drive, so the page marks the archive as such without a question.
    """
    from functools import partial

    from tdhil.evidence import check_evidence, make_evidence
    from tests.evidence.small_runs import RESULT, write_run

    result = {**RESULT, "simulated": True}

    def found(log):
        return result

    play_uploads(served.service, monkeypatch)
    monkeypatch.setattr("tdhil.evidence.making.make_evidence", partial(make_evidence, conclude=found))
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    wait_for("its end", lambda: not served.service.supervisor.live())
    log = served.service.store.place(run) / "run.mcap"
    log.unlink(missing_ok=True)
    write_run(log, simulated=True, result=result)
    context = browser.new_context(base_url=served.url, viewport={"width": width, "height": 800}, bypass_csp=True)
    page = context.new_page()
    page.goto(f"/runs/{run}")
    page.get_by_text("Make evidence of this run").click()
    page.get_by_label("Reference inertia at the motor shaft").fill("104")
    page.get_by_role("button", name="Make the archive").click()
    page.locator("#wrong-publisher").wait_for()
    assert {"publisher", "publish", "reference_sd_kg_m2", "reference_method", "reference_note"} == {
        one.get_attribute("name") for one in page.locator("#evidence-form [aria-invalid=true]").all()}
    if axe := os.environ.get("TDHIL_AXE"):
        page.add_script_tag(path=axe)
        assert [one["id"] for one in page.evaluate("axe.run()")["violations"]
                if one["impact"] in ("serious", "critical")] == []
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    for label, text in (("Publisher: who permits this", HOSTILE), ("Parts that may be published", "all"),
                        ("Its standard uncertainty", "1"), ("How, in words", "a disc of 480 kg")):
        page.get_by_role("textbox", name=label).fill(text)
    page.get_by_label("How it is known").select_option("weighed")
    page.get_by_role("button", name="Make the archive").click()
    link = page.get_by_role("link", name="evidence.zip")
    link.wait_for()
    digest = page.locator(".files code").inner_text()
    with page.expect_download() as download:
        link.click()
    archive = Path(download.value.path()).read_bytes()
    assert check_evidence(archive, digest, conclude=found).problems == ()
    assert json.loads(zipfile.ZipFile(BytesIO(archive)).read("manifest.json"))["simulated"] is True
    assert page.evaluate("window.pwned") is None
    context.close()


@pytest.mark.heavy
def test_a_run_is_tagged_archived_and_deleted_from_its_page(page, served):
    runs = []
    for note in ("done", "done"):
        runs.append(served.service.supervisor.start_run("a", {"note": note}, "local").request.id)
        served.service.wait(runs[-1], "done")
    wait_for("their end", lambda: not served.service.supervisor.live())
    run = runs[0]
    page.goto(f"/runs/{run}")
    page.get_by_label("Tags, separated by commas").fill(f"after repair, {HOSTILE}")
    page.get_by_label("Operator").fill("Anna")
    page.get_by_role("button", name="Save").click()
    page.get_by_text("a tag has at most 40 characters").wait_for()          # at its field, and nothing was saved
    assert page.get_by_label("Tags, separated by commas").get_attribute("aria-invalid") == "true"
    page.get_by_label("Tags, separated by commas").fill("after repair, <b id=x>")
    page.get_by_role("button", name="Save").click()
    page.get_by_text("Edits: 2").click()
    page.get_by_role("row", name="after repair, <b id=x>").get_by_text("local").wait_for()
    page.goto("/runs")
    page.get_by_label("Search").fill("repair anna")
    page.locator("#runs").get_by_text("after repair", exact=True).wait_for()
    wait_for("the search", lambda: page.locator("#runs tr").count() == 1)        # before, the list has all runs
    assert page.locator("#runs tr").count() == 1 and page.locator("b#x").count() == 0
    page.goto(f"/runs/{run}")
    page.get_by_role("button", name="Archive", exact=True).click()
    page.get_by_role("button", name="Take out of the archive").wait_for()
    page.goto("/runs")
    page.locator("#runs tr").first.wait_for()
    assert page.locator("#runs tr").count() == 1
    page.get_by_label("Archived runs too").check()
    page.locator("#runs").get_by_text("ARCHIVED").wait_for()
    page.goto(f"/runs/{run}")
    page.get_by_text("Delete this run").click()
    button, typed = page.get_by_role("button", name="Delete", exact=True), page.get_by_label("Type the run's id")
    typed.fill(run[:-1])
    assert button.is_disabled()
    typed.fill(run)
    button.click()
    page.wait_for_url("**/runs")
    page.get_by_label("Archived runs too").check()
    page.locator("#runs tr").first.wait_for()
    assert [one.name for one in served.service.store.runs.iterdir()] == [runs[1]]
    assert page.evaluate("window.pwned") is None


def test_a_stop_that_was_asked_for_is_no_alarm(page, served):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.get_by_role("button", name="Stop", exact=True).click()
    served.service.wait(run, "stopped")
    page.goto(f"/runs/{run}")
    page.get_by_text("stopped, at standstill").wait_for()
    assert page.locator("#result .alarm").count() == 0


def test_what_cant_be_done_here_says_why_before_the_click(page, served):
    page.goto("/start/watched")
    page.get_by_text("This rig moves only while a logged-in user watches it").wait_for()
    assert page.get_by_role("button", name="Start").count() == 0
    page.goto("/rigs/a/file")
    page.get_by_text("Read-only: this service has no accounts").wait_for()
    assert not page.get_by_text("You can change here").is_visible()


def test_a_rehearsal_is_marked_wherever_its_run_is_shown(page, served):
    run = served.service.supervisor.start_run(
        "a", {"note": "done", "fault": ["torque-scale=1.1"]}, "local").request.id
    served.service.wait(run, "done")
    for path in ("/runs", f"/runs/{run}", f"/runs/{run}/live"):
        page.goto(path)
        page.get_by_text("REHEARSAL", exact=True).first.wait_for()
    page.goto("/")
    page.get_by_role("article", name="Rig a").get_by_text("no result yet").wait_for()


def test_the_recorded_motion_can_be_zoomed_read_and_exported(page, served):
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    write(served.service.store.place(run) / "run.mcap")         # 0 to 1.99 s, speed 10 rad/s², torque -20 N·m/s
    page.goto(f"/runs/{run}/live")
    charts, readout = page.locator("#plot-speed .u-over, #plot-torque .u-over"), page.locator("#readout")
    whole, box = page.get_by_role("button", name="Whole run"), charts.first.bounding_box()
    wait_for("the samples", lambda: page.evaluate("document.getElementById('speed').textContent") != "–")
    assert whole.is_disabled()

    def move(share: float) -> list[float]:
        page.mouse.move(box["x"] + share * box["width"], box["y"] + 40, steps=3)
        readout.get_by_text("N·m").wait_for()
        return [float(one) for one in re.findall(r"-?[\d.]+", readout.inner_text().replace("N·m", ""))]

    def saved(name: str) -> bytes:
        with page.expect_download() as download:
            page.get_by_role("button", name=name, exact=True).click()
        assert download.value.suggested_filename.startswith(run)
        return Path(download.value.path()).read_bytes()

    time_s, speed_rad_s, torque_nm = move(0.5)
    assert (time_s, speed_rad_s, torque_nm) == pytest.approx((1.0, 10.0 * time_s, -20.0 * time_s), abs=0.06)
    move(0.25)
    page.mouse.down()
    move(0.5)
    page.mouse.up()
    assert whole.is_enabled()
    # both charts show the same part, and only that part is exported
    assert move(0.0)[0] == pytest.approx(0.5, abs=0.06) and move(0.999)[0] == pytest.approx(1.0, abs=0.06)
    head, *rows = saved("CSV").decode().splitlines()
    assert head == "time_s,speed_rad_s,torque_nm" and 9 <= len(rows) <= 15      # spacing 0.04 or 0.05 s
    assert all(0.45 <= float(row.split(",")[0]) <= 1.05 for row in rows)
    assert saved("PNG").startswith(b"\x89PNG")
    page.get_by_role("button", name="Speeds in rad/s").click()
    time_s, speed_rpm, _ = move(0.5)
    assert "rpm" in readout.inner_text() and speed_rpm == pytest.approx(95.5 * time_s, rel=0.02)
    charts.last.dblclick()
    assert whole.is_disabled()
    page.goto("/start/a")                                       # the unit is kept
    page.get_by_role("button", name="Speeds in rpm").wait_for()


def test_a_stop_says_when_it_was_asked_seen_and_at_rest(page, served):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.get_by_text("Not an emergency stop.").wait_for()
    button = page.get_by_role("button", name="Stop", exact=True)
    button.focus()
    page.keyboard.press("Enter")
    page.get_by_text("drive reacted").wait_for()
    served.service.wait(run, "stopped")
    page.get_by_text("stopped, at standstill").wait_for()
    assert not page.get_by_text("NOT DELIVERED").is_visible()
    assert button.is_disabled()


def test_an_answer_that_was_overtaken_undoes_nothing(page, served):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.locator("#state", has_text="moving").wait_for()

    def late(route: Any) -> None:
        answer = route.fetch()
        served.service.wait(run, "stopped")
        page.get_by_text("stopped, at standstill").wait_for()
        route.fulfill(response=answer)

    page.route("**/stop", late)
    with page.expect_response("**/stop"):
        page.get_by_role("button", name="Stop", exact=True).click()
    page.wait_for_timeout(300)
    assert page.get_by_text("stopped, at standstill").is_visible()
    assert page.get_by_role("button", name="Stop", exact=True).is_disabled()


def test_a_drive_that_a_terminal_has_is_stopped_from_its_card(page, served, monkeypatch):
    told = [(True, "tdhil stop confirmed standstill"), (False, "tdhil stop did NOT confirm standstill")]
    monkeypatch.setattr("tdhil.service.supervisor._stop_seen", lambda command: told.pop(0))
    with hold(served.service.supervisor.rigs.get("real").address):
        page.goto("/")
        stop = page.get_by_role("article", name="real", exact=True).get_by_role("button", name="Stop")
        stop.click()
        page.get_by_text("real: tdhil stop confirmed standstill").wait_for()
        stop.click()
        page.get_by_text("real: tdhil stop did NOT confirm standstill. Use the hard-wired stop").wait_for()


@pytest.mark.parametrize("way", ["offline", "mute"])
def test_a_stop_that_nobody_hears_says_so(page, served, way):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.locator("#state", has_text="moving").wait_for()
    if way == "offline":
        page.context.set_offline(True)
    else:
        page.route("**/stop", lambda route: None)           # neither an answer nor an error
    page.get_by_role("button", name="Stop", exact=True).click()
    page.get_by_text("NOT DELIVERED: use the hard-wired stop").wait_for()
    if way == "offline":
        page.get_by_text("asking …").wait_for(state="hidden")
    assert served.service.store.status(run).stop.asked is None


def test_values_grow_grey_once_nothing_comes(page, served):
    run = begin(served)
    folder = served.service.store.place(run)
    write(folder / "other.mcap")
    (folder / "other.mcap").replace(folder / "run.mcap")
    page.goto(f"/runs/{run}/live")
    page.locator("#speed", has_text="19.").wait_for()
    # The log is old, and the run said to be moving: that alone is grey.
    page.locator("body.stale").wait_for()
    assert not page.locator("#away").is_visible()
    served.end()
    page.get_by_text("No connection to tdhil serve").wait_for()


def test_six_tabs_and_a_stop_still_gets_through(page, served):
    run = begin(served)
    for one in (*(page.context.new_page() for _ in range(5)), page):
        one.goto(f"/runs/{run}/live")
    page.get_by_role("button", name="Stop", exact=True).click()
    served.service.wait(run, "stopped")
    page.get_by_text("drive reacted").wait_for()


def test_the_code_is_asked_for_and_a_wrong_one_said(page, served):
    run = begin(served, "ask", "real")
    page.goto(f"/runs/{run}/live")
    page.get_by_text("this moves").wait_for()
    page.get_by_text("Expected: J to ±1.3 %, about 2 min 10 s. A drive; if the host fails: quick").wait_for()
    page.get_by_text("Preflight: values read from the drive").click()
    page.get_by_role("row", name="watchdog 500 ms 500 ms 1016h:1").wait_for()
    field = page.get_by_label("Six digits")
    field.fill("000000")
    field.press("Enter")
    page.get_by_text("the code is wrong").wait_for()
    field.fill("123 456")
    field.press("Enter")
    served.service.wait(run, "done")


def test_every_point_of_the_checklist_is_ticked_before_the_shaft_may_be_moved(page, served):
    points = "Before you confirm:\n  [ ] brake released\n  [ ] people clear of the shaft\n"
    run = served.service.supervisor.start_run("real", {"note": "ask", "operator": points}, "local").request.id
    served.service.wait(run, "awaiting_confirmation")
    page.goto(f"/runs/{run}/live")
    move = page.get_by_role("button", name="Move the shaft")
    page.get_by_label("brake released").check()
    assert move.is_disabled()
    page.get_by_label("Six digits").fill("123456")
    page.get_by_label("Six digits").press("Enter")          # no way round
    page.get_by_label("people clear of the shaft").check()
    assert move.is_enabled()
    assert served.service.store.status(run).state.value == "awaiting_confirmation"
    move.click()
    served.service.wait(run, "done")


def watched_run(page: Any, served: Served) -> str:
    """It moves, and this page holds its lease."""
    run = begin(served, "ask", "rehearsed")
    page.goto(f"/runs/{run}/live")
    page.get_by_label("Six digits").fill("123 456")
    page.get_by_role("button", name="Move the shaft").click()
    page.get_by_text("You watch this run").wait_for()
    return run


def lost(served: Served, run: str) -> Any:
    """How the run's page went, once the run was made to brake for it."""
    served.service.wait(run, "stopped")
    watch = served.service.store.status(run).watch
    assert watch.lost is not None
    return watch.how


HIDE = """hidden => {
    const get = () => hidden ? "hidden" : "visible";
    Object.defineProperty(document, "visibilityState", { configurable: true, get });
    document.dispatchEvent(new Event("visibilitychange"));
}"""


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("way", "how"), [("hidden", "hidden"), ("closed", "closed"), ("offline", "silent")])
def test_a_watched_run_brakes_once_its_page_is_gone(page, served, way, how):
    run = watched_run(page, served)
    if way == "closed":
        other = page.context.new_page()
        other.goto(f"/runs/{run}/live")
        other.get_by_text("watches this run on another page").wait_for()
        page.close()
        other.get_by_text("This run was not watched: it was stopped").wait_for()     # to look is not to hold
    elif way == "offline":
        page.context.set_offline(True)
        page.get_by_text("The run receives nothing from this page").wait_for()
        page.get_by_text("The run stops, because it is not watched").wait_for()
    else:
        page.evaluate(HIDE, True)
    assert lost(served, run) == how


@pytest.mark.heavy
def test_a_watched_run_goes_on_when_its_page_is_loaded_anew_or_hidden_for_a_moment(page, served):
    run = watched_run(page, served)
    page.reload()
    page.get_by_text("You watch this run").wait_for()
    page.evaluate(HIDE, True)
    page.wait_for_timeout(1000)
    page.evaluate(HIDE, False)
    page.wait_for_timeout(5500)            # longer than a lease
    status = served.service.store.status
    wait_for("its page", lambda: status(run).watch.gone is None or status(run).state != "moving")      # a moment late
    assert status(run).state == "moving"
    copy = page.context.new_page()         # a tab that is copied has what the first had kept: the later one holds
    copy.goto("/")
    copy.evaluate("kept => sessionStorage.setItem(...kept)", page.evaluate("Object.entries(sessionStorage)[0]"))
    copy.goto(f"/runs/{run}/live")
    copy.get_by_text("You watch this run").wait_for()
    page.get_by_text("watches this run on another page").wait_for()
    copy.close()
    assert lost(served, run) == "closed"


@pytest.mark.heavy
def test_a_run_that_hears_no_stop_is_not_called_stopped(page, served):
    """Its process is frozen: SIGTERM reaches it, and does nothing."""
    run = begin(served, "frozen")
    page.goto(f"/runs/{run}/live")
    with page.expect_response("**/stop") as answered:
        page.get_by_role("button", name="Stop", exact=True).click()
    assert answered.value.ok
    page.get_by_text("NOT DELIVERED: use the hard-wired stop").wait_for()
    page.wait_for_timeout(500)
    assert page.get_by_text("NOT DELIVERED: use the hard-wired stop").is_visible()
    os.kill(served.service.store.status(run).pid, signal.SIGKILL)
    served.service.supervisor.start()
    served.service.wait(run, "interrupted")


def test_a_page_that_is_loaded_anew_while_a_run_brakes_shows_its_stop(page, served):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.get_by_role("button", name="Stop", exact=True).click()
    page.reload()
    page.locator("li", has_text="asked ").wait_for()
    page.get_by_text("drive reacted").wait_for()
    assert not page.get_by_text("NOT DELIVERED").is_visible()


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
    card.get_by_text("failed, at standstill").wait_for()
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
    assert "is no unit of a speed" in box("Highest speed").locator("xpath=..").inner_text()
    page.locator("[data-field=accept_unverified] .wrong").wait_for()         # a mistake that has no field of its own
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
    page.get_by_text("The fields above have its address.").wait_for()
    assert box("Node:").input_value() == "3"
    for label, text in (("Lowest speed", "5 rpm"), ("Highest speed", "95 rpm"), ("Highest torque, either", "400"),
                        ("Longest run", "15 min"), ("Deceleration of a stop", "2"),
                        ("Highest torque of the sign", "200"), ("Farthest travel", "3")):
        box(label).fill(text)
    for one in page.locator("[name=accept]").all():
        one.check()
    page.get_by_role("button", name="Check").click()
    page.get_by_text("The file is complete.").wait_for()
    page.reload()
    page.get_by_label("Id:").fill("bench 3!")
    page.get_by_role("button", name="Save the rig").click()
    page.locator("#wrong-id").get_by_text("must be letters, digits").wait_for()
    page.get_by_label("Id:").fill("bench-3")
    page.get_by_role("img", name="Window of motion: 0.524 to 9.95 rad/s, at most 400 N·m").wait_for()
    page.get_by_role("button", name="Save the rig").click()
    page.wait_for_url("**/start/bench-3")
    page.get_by_role("button", name="Start: preflight, then the code").wait_for()
    assert "speed_max_rad_s:         \"95 rpm\"" in (rigs / "bench-3.yaml").read_text()
    assert page.evaluate("window.pwned") is None


@pytest.mark.heavy
def test_a_simulated_rig_is_added_without_a_drive(page, rigs):
    page.goto("/new-rig")
    page.get_by_label("Name in reports").fill("Bench 4")
    page.get_by_label("Profile:").select_option("maxon/epos4")
    page.get_by_label("Simulated: there is no drive").check()
    for hidden in ("3. Settings at the drive", "Scan for the drive", "5. Motion from the browser"):
        assert not page.get_by_text(hidden, exact=True).is_visible()
    page.reload()                                                   # what was typed is there again
    page.get_by_label("Simulated: there is no drive").wait_for()
    page.get_by_text("These may stay empty").wait_for()
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
    monkeypatch.setattr(served.service.supervisor, "work",
                        lambda what, run, more: asked.append(more) or {"document": found})
    page.goto("/")
    page.get_by_role("link", name="Calibrate").first.click()
    page.wait_for_url("**/calibrate/a")
    page.get_by_label("Run without the body").select_option(run)
    page.get_by_label("Run with the body").select_option(run)
    page.get_by_label("Inertia of the body").fill("55,0")
    calibrate = page.get_by_role("button", name="Calibrate")
    calibrate.click()
    page.get_by_text("Choose two different runs.").wait_for()
    page.get_by_label("Run with the body").select_option(other)
    page.get_by_label("Inertia of the body").fill("much")
    calibrate.click()
    page.get_by_text("as a positive number of kg·m²").wait_for()
    assert asked == []
    page.get_by_label("Inertia of the body").fill("55,0")
    calibrate.click()
    page.get_by_text("κ = 0.9550 (0.9454 to 0.9646)").wait_for()
    assert (asked[0]["without"], asked[0]["with_body"], asked[0]["added_kg_m2"]) == (run, other, 55.0)
    with page.expect_download() as download:
        page.get_by_role("link", name="calibration.json").click()
    assert download.value.suggested_filename == "calibration.json"
    assert json.loads(Path(download.value.path()).read_text("utf-8")) == found
    assert page.evaluate("window.pwned") is None


@pytest.mark.heavy
def test_from_a_result_to_a_replay_and_two_runs_compared(page, served, monkeypatch):
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    results(served, run, monkeypatch)
    page.goto(f"/runs/{run}")
    page.get_by_text("speed was quantised").wait_for()
    shown = page.locator("time").first.inner_text()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC([+-]\d\d:\d\d)?", shown)      # local, with its zone
    page.get_by_role("row", name="J, 90 % interval to quote").wait_for()
    page.locator(".pictures img").evaluate("one => one.decode()")
    page.get_by_text("Friction over speed, in numbers").click()
    page.get_by_role("row", name="2 rad/s 76").wait_for()
    names = [one.inner_text() for one in page.locator(".files a").all()]
    assert names == ["run.mcap", "report.html", "report.pdf", "result.json", "samples.csv"]
    again = {"verdict": "valid_wide", "inertia_kg_m2": {**estimate(104.5), "low_total": 99.0, "high_total": 110.0,
                                                        "half_width_total_rel": 0.05}}
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": again})
    page.get_by_label("Model").select_option("rigid")
    page.get_by_label("Tolerance: half-width").fill("a lot")
    page.get_by_role("button", name="Replay").click()
    page.locator("#wrong-tolerance").get_by_text("a number and its unit").wait_for()         # and not passed over
    page.get_by_label("Tolerance: half-width").fill("0,1")
    page.get_by_role("button", name="Replay").click()
    page.get_by_role("row", name="model rigid, tolerance 0.001").get_by_text("104.5 (99.0 to 110.0)").wait_for()
    page.get_by_role("row", name="the run itself").get_by_text("104.0 (100.0 to 108.0)").wait_for()
    served.service.supervisor.work = lambda what, run, asked: {"document": {
        "results": [], "differences": [], "settings": [], "apparent_inertia": [], "friction": []}}
    page.goto("/runs")
    button = page.get_by_role("button", name="Compare")
    boxes = page.locator("#runs").get_by_role("checkbox")
    boxes.first.check()
    assert button.is_disabled()
    boxes.nth(1).check()
    button.click()
    page.wait_for_url("**/compare?runs=*,*")
    page.goto("/rehearse/a")
    page.get_by_label("speed", exact=True).check()
    page.get_by_label("Delay after").fill("1.5")
    page.get_by_label("internal-limit: share").fill("20%")
    page.get_by_role("button", name="Rehearse internal-limit").click()
    page.wait_for_url(re.compile("/runs/[^/]+$"))                          # by itself: the page becomes the result
    begun = served.service.store.request(served.service.store.ids()[0])
    assert begun.options["fault"] == ["internal-limit@speed+1.5s=20%"]


TRACE = "Zeit;Drehzahl soll;Drehzahl ist;Drehmoment\nms;U/min;U/min;%\n" + "".join(
    f"{10 * k};40,0;{40 + k % 7},5;{20 + k % 5},25\n" for k in range(400))


@pytest.mark.heavy
def test_a_trace_is_added_with_its_columns_corrected_and_becomes_a_marked_run(page, served, monkeypatch):
    play_uploads(served.service, monkeypatch)
    page.goto("/runs")
    page.get_by_role("link", name="Add a recording").click()
    page.locator("#limit").get_by_text("256 MiB").wait_for()
    page.set_input_files("#file", {"name": HOSTILE, "mimeType": "text/csv", "buffer": b""})
    page.get_by_text("This file is empty").wait_for()
    page.set_input_files("#file", {"name": "<b id=x>7</b>.csv", "mimeType": "text/csv", "buffer": TRACE.encode()})
    speed, rated = page.locator("[name='columns.speed']"), page.get_by_label("Rated torque, N·m")
    page.get_by_text("Torque in % needs the rated torque").wait_for()
    assert rated.get_attribute("aria-invalid") == "true" and page.locator(".mini canvas").count() == 0
    assert (speed.input_value(), page.locator("[name='unit.time']").input_value()) == ("Drehzahl ist", "ms")
    assert page.locator("#table th.mapped small").all_inner_texts() == ["time", "speed", "torque"]
    speed.select_option("Zeit")                     # wrong, and marked at once with all that is wrong
    page.get_by_text("This column is already that of time").wait_for()
    page.get_by_role("button", name="Identify").click()
    page.locator(".wrong").nth(1).wait_for()
    assert served.service.store.ids() == []
    speed.select_option("Drehzahl ist")
    rated.fill("480")
    rated.press("Tab")
    page.locator(".mini canvas").nth(1).wait_for()
    page.get_by_text("100 Hz").wait_for()
    page.get_by_label("Rig, as you state it").select_option("a")
    page.get_by_role("button", name="Identify").click()
    page.wait_for_url(re.compile(r"/runs/\d{8}-"))
    page.get_by_text("J = 104.0").wait_for()
    assert page.locator("h1 .badge").all_inner_texts() == ["UPLOADED"]
    assert page.locator("b#x").count() == 0
    page.goto("/runs")
    page.locator("#runs .badge", has_text="UPLOADED").wait_for()


@pytest.mark.heavy
def test_an_upload_that_waits_is_opened_again_and_deleted_by_keyboard(page, served, monkeypatch):
    play_uploads(served.service, monkeypatch)
    page.goto("/upload")
    page.set_input_files("#file", {"name": "x.csv", "mimeType": "text/csv", "buffer": TRACE.encode()})
    page.locator("#table table").wait_for()
    page.goto("/upload")
    page.on("dialog", lambda asked: asked.accept())
    waits = page.get_by_role("button", name="x.csv")
    waits.focus()
    page.keyboard.press("Enter")
    page.locator("#table table").wait_for()
    page.get_by_role("button", name="Delete this upload").press("Enter")
    page.wait_for_url("**/upload")
    waits.wait_for(state="detached")
    assert not any((served.service.store.folder / "uploads").iterdir())


@pytest.mark.heavy
def test_a_newcomer_clicks_twice_and_has_a_result(browser, tmp_path):
    """The service as a process, its own simulated rigs, a real run; how long it took is said (`pytest -s`)."""
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


@pytest.mark.heavy
def test_a_page_says_when_nobody_answers_any_more(page, served, monkeypatch):
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    results(served, run, monkeypatch)
    for path, shown in (("/runs", "104"), ("/rigs/a", "inertia, kg·m²"), ("/fleets/0123456789ab", "104")):
        page.goto(path)
        page.get_by_text(shown).first.wait_for()
        page.context.set_offline(True)
        page.get_by_text("No answer from tdhil serve: the values are old").wait_for()
        assert page.evaluate("document.body.classList.contains('stale')")
        page.context.set_offline(False)
        page.locator("body:not(.stale)").wait_for()


@pytest.mark.heavy
def test_what_comes_from_rigs_drives_and_logs_is_text_on_every_page(page, served, monkeypatch):
    run = served.service.supervisor.start_run("hostile", {"note": "done", "operator": HOSTILE}, "local").request.id
    served.service.wait(run, "done")
    paths = results(served, run, monkeypatch)
    for path in (*PAGES, "/start/hostile", "/rehearse/hostile", "/rigs/hostile", *paths, f"/runs/{run}/live",
                 f"/runs/{HOSTILE}", f"/compare?runs={HOSTILE}", f"/fleets/{HOSTILE}"):
        page.goto(path)
        page.wait_for_timeout(600)
        assert page.evaluate("window.pwned === undefined"), path
        assert page.locator("b#x").count() == 0, path
    for path in ("/", *paths):
        page.goto(path)
        page.get_by_text(HOSTILE).first.wait_for()


@pytest.mark.heavy
def test_every_page_fits_a_phone_and_can_be_read(browser, served, monkeypatch):
    """No page is wider than 390 px; axe-core, where TDHIL_AXE names its file, finds no serious fault.

    Of the dark colours it looks at the contrast only: all else is the same page.
    """
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    context = browser.new_context(base_url=served.url, viewport={"width": 390, "height": 800}, color_scheme="light",
                                  bypass_csp=True)
    page, faults = context.new_page(), []
    axe = os.environ.get("TDHIL_AXE")
    for path in (*PAGES, *results(served, run, monkeypatch), f"/runs/{run}/live", "/nothing"):
        page.goto(path)
        page.wait_for_timeout(500)
        page.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")
        wide = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        assert wide <= 0, (path, wide)
        if axe:
            page.add_script_tag(path=axe)
            found = page.evaluate("axe.run()")["violations"]
            page.emulate_media(color_scheme="dark")
            found += page.evaluate("axe.run({runOnly: ['color-contrast']})")["violations"]
            page.emulate_media(color_scheme="light")
            faults += [(path, one["id"], [node["target"] for node in one["nodes"]][:4])
                       for one in found if one["impact"] in ("serious", "critical")]
    context.close()
    assert faults == []
    if not axe:
        pytest.skip("every page fits; no axe-core: npm install axe-core, and TDHIL_AXE=PATH of its axe.min.js")
