"""Results and recordings in Chromium: the list of runs, charts, acceptance, evidence, and uploads."""

from __future__ import annotations

import json
import os
import re
import threading
import zipfile
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from unittest.mock import Mock

import pytest

from tdhil.config import Expectation
from tdhil.errors import UsageError
from tdhil.service.run_channel import RunRefused
from tdhil.service.run_state import Told, now
from tdhil.service.schemas import ReplayView
from tdhil.service.store import write_json
from tests.recording.test_log_tail import write
from tests.service.chromium.pages import HOSTILE, IN_CHROMIUM, TRACE, begin, estimate, results
from tests.service.conftest import play_uploads, wait_for

pytestmark = IN_CHROMIUM
REHEARSAL = {
    "verdict": "fail", "seen": "the run went on to its end (exit 0): valid, J 115 (110 to 119) kg·m²",
    "faults": [{"fault": "torque-scale=1.1", "row": 118, "required": "QS, no J", "codes": [6, 9], "verdict": "fail"}],
}


def ended_run(served, rig="a", request=None):
    """Start a run, wait for its end, and return its id."""
    run = served.service.supervisor.start_run(rig, request or {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    return run


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
    run = ended_run(served)
    sent = []
    page.on("request", lambda asked: sent.append(asked.url) if asked.url.endswith("/annotations") else None)
    page.goto(f"/runs/{run}")
    page.get_by_label("Operator").fill("Anna")
    page.locator("#annotate button").dblclick()
    page.get_by_text("Operator: Anna").wait_for()
    assert len(sent) == 1


@pytest.mark.heavy
def test_samples_that_are_made_first_show_their_progress(page, served, monkeypatch):
    run = ended_run(served)
    folder, goes_on = served.service.store.place(run), threading.Event()
    (folder / "run.mcap").write_bytes(b"log")

    def slow(what, of, asked):
        goes_on.wait(30.0)
        (folder / "samples.csv").write_text("time_s\n")
        return {"document": {"file": "samples.csv"}}

    monkeypatch.setattr(served.service.supervisor, "work", slow)
    page.goto(f"/runs/{run}")
    page.get_by_role("link", name="samples.csv").click()
    page.get_by_text(re.compile(r"^Making the file: \d+ s$")).wait_for()
    with page.expect_download() as got:
        goes_on.set()
    assert Path(got.value.path()).read_text() == "time_s\n"


@pytest.mark.heavy
@pytest.mark.parametrize(("path", "label", "stored"), [
    ("/letterhead", "Company", ""), ("/rigs/a/file", "rig.yaml", "simulate: true"),
])
def test_a_form_takes_no_text_before_what_is_stored_is_in_it(page, path, label, stored):
    held = []

    def hold(route):           # a method of a list cannot be a handler
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
    """After an edit or a signature, the page shows the progress and its time, and then the new report."""
    run = ended_run(served)
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
    page.get_by_text(re.compile(r"^Making the page again: \d+ s$")).wait_for()
    assert page.locator(".making").get_by_role("progressbar").count() == 1
    goes_on.set()
    with page.context.expect_page() as opened:
        page.get_by_role("link", name="open it").click()
    opened.value.get_by_text("with its order").wait_for()
    assert made == ["report.html"]
    with page.expect_download() as got:
        page.get_by_role("link", name="report.pdf").click()
    assert Path(got.value.path()).read_text() == "<h1>with its order</h1>" and made == ["report.html", "report.pdf"]


def test_a_delayed_replay_shows_what_it_waits_for(page, served):
    run = ended_run(served)
    served.service.web.waiting_replays[run, "001"] = ReplayView("001", {}, now(), "local", "delayed", holder="run X")
    page.goto(f"/runs/{run}")
    row = page.locator("#replay-rows tr", has_text="waits until run X has ended")
    row.wait_for()
    assert row.get_by_role("progressbar").count() == 0
    served.service.web.waiting_replays[run, "001"] = ReplayView("001", {}, now(), "local", "waiting")
    page.locator("#replay-rows").get_by_text("Identifying again: ").wait_for()


def test_a_rehearsal_shows_the_required_and_observed_reaction_and_its_verdict(page, served):
    run = ended_run(served, "a", {"note": "done", "fault": ["torque-scale=1.1"]})
    path = served.service.store.place(run) / "state.json"
    write_json(path, {**json.loads(path.read_bytes()), "rehearsal": REHEARSAL})
    page.goto(f"/runs/{run}")
    page.get_by_role("heading", name="Rehearsal", exact=True).wait_for()
    assert page.locator("h1").inner_text().endswith("REHEARSAL")
    assert page.locator("#result .verdict.bad").first.inner_text() == "fail"
    page.get_by_role("row", name="required by row 118").get_by_text("QS, no J").wait_for()
    page.get_by_role("row", name="torque-scale=1.1").get_by_text("exit 6 or 9 is required").wait_for()
    page.get_by_role("row", name="seen").get_by_text("the run went on to its end").wait_for()


def test_an_acceptance_shows_expected_and_identified_values_and_differences(page, served):
    from tdhil.config import Expectation
    from tdhil.report import acceptance_of

    run = ended_run(served)
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
    ended_run(served)
    page.set_viewport_size({"width": 390, "height": 800})
    page.goto("/runs")
    for text in ("104.0 (100.0 to 108.0) kg·m²", "valid"):
        box = page.locator("#runs").get_by_text(text, exact=True).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 390, text


@pytest.mark.parametrize(("width", "hinted"), [(390, True), (1280, False)])
def test_a_graph_that_is_wider_than_the_screen_shows_that_it_scrolls(page, served, width, hinted):
    run = ended_run(served)
    svg = "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 500 100'><path d='M0 0L500 100' stroke='red'/></svg>"
    (served.service.store.place(run) / "report.html").write_text("".join(
        f"<h2>{name}</h2><figure>{svg}<figcaption>about</figcaption></figure>"
        for name in ("Speed and torque", "Estimates of the inertia")))
    page.set_viewport_size({"width": width, "height": 800})
    page.goto(f"/runs/{run}")
    graph = page.get_by_role("region", name="Estimates of the inertia, picture")
    graph.scroll_into_view_if_needed()
    wait_for("the picture", lambda: graph.locator("img").evaluate("one => one.complete && one.naturalWidth > 0"))
    shown = "one => getComputedStyle(one, '::before').content"
    wait_for("the hint", lambda: ("scroll sideways" in graph.evaluate(shown)) is hinted)
    assert graph.evaluate("one => one.scrollWidth > one.clientWidth") is hinted
    graph.focus()
    page.keyboard.press("ArrowRight")
    wait_for("the right part", lambda: (graph.evaluate("one => one.scrollLeft") > 0) is hinted)


def test_the_list_of_runs_names_a_rig_as_its_other_pages_do(page, served):
    run = ended_run(served, "hostile", {"note": "done"})
    page.goto("/runs")
    link = page.locator("#runs a")
    link.wait_for()
    assert (link.inner_text(), link.get_attribute("href")) == (HOSTILE, f"/runs/{run}")
    page.locator("select[name=rig]").select_option(label=HOSTILE)
    page.wait_for_url("**/runs?rig=hostile")
    assert page.evaluate("window.pwned") is None


def test_the_list_of_runs_can_be_searched_and_sorted(page, served):
    for rig, operator in (("a", "Anna"), ("b", "Berta"), ("a", "Carla")):
        run = served.service.supervisor.start_run(rig, {"note": "done", "operator": operator}, "local").request.id
        served.service.wait(run, "done")
    page.goto("/runs")
    names, search = page.locator("#runs td:last-child"), page.get_by_label("Search")
    page.get_by_text("Carla: done").wait_for()
    assert set(names.all_inner_texts()) == {"Carla: done", "Berta: done", "Anna: done"}
    page.get_by_role("button", name="operator, note, tags").click()
    page.locator("#runs tr").first.get_by_text("Anna: done").wait_for()
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

    run = ended_run(served)
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
    page.get_by_text("The signature is not valid: the log is not the signed one").wait_for()
    assert page.evaluate("window.pwned") is None


@pytest.mark.heavy
def test_numbers_of_a_result_have_the_digits_of_the_card(page, served):
    """The page printed 3004 (2884 to 3124) where the card prints 3000 (2880 to 3130)."""
    from tdhil.report.acceptance import acceptance_of
    from tdhil.report.card import budget_figures
    from tdhil.report.intervals import with_interval

    run = ended_run(served)
    wait_for("its end", lambda: not served.service.supervisor.live())
    path = served.service.store.place(run) / "result.json"
    J = {"value": 1235.0, "low_total": 1222.2, "high_total": 1246.8, "low": 1222.2, "high": 1246.8}
    acceptance = acceptance_of([Expectation("inertia", 1234.5, 12.349)], {"inertia_kg_m2": J})
    halves = (4.11, 1234.0, 0.0304)
    write_json(path, {**json.loads(path.read_bytes()), "acceptance": acceptance, "budget": [
        {"source": f"source {half}", "half_width_kg_m2": half, "note": ""} for half in halves]})
    page.goto(f"/runs/{run}")
    page.get_by_text("1234.5 ± 12.349 kg·m²").wait_for()
    page.get_by_text("1235.0 (1222.2 to 1246.8) kg·m²").wait_for()
    for half in halves:
        page.get_by_text(f"± {budget_figures(half, 104.0)[0]} kg·m²", exact=True).wait_for()
    for one in ((3004.2, 2884.3, 3123.7), (1234.0, 1111.0, 1357.0), (104.2, 100.14, 108.26), (5.0, -12000.0, 12345.0),
                (0.0123456, 0.0121, 0.0126), (104.0, 103.55, 104.45), (400.04, 400.04, 400.04)):
        assert page.evaluate("one => window.tdhil.interval(...one)", one) == with_interval(*one, "").rstrip()


@pytest.mark.heavy
@pytest.mark.parametrize("width", [390, 1280])
def test_evidence_of_a_run_is_made_on_its_page(browser, served, monkeypatch, width):
    """Every missing part is marked at its field. Then the page has the archive and its digest.

    The run is of the simulated drive, so the page marks the archive accordingly without a question.
    """
    from functools import partial

    from tdhil.evidence import check_evidence, make_evidence
    from tests.evidence.small_runs import RESULT, write_run

    result = {**RESULT, "simulated": True}

    def found(log):
        return result

    play_uploads(served.service, monkeypatch)
    monkeypatch.setattr("tdhil.evidence.making.make_evidence", partial(make_evidence, conclude=found))
    run = ended_run(served)
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
    firmware, remove = page.get_by_label("Firmware version"), page.get_by_label("Further words to remove")
    for part in page.get_by_role("group", name="Parts that may be published").get_by_role("checkbox").all():
        part.check()
    for label, text in (("Publisher: who permits this", HOSTILE), ("Its standard uncertainty", "1"),
                        ("How, in words", "a disc of 480 kg")):
        page.get_by_role("textbox", name=label).fill(text)
    page.get_by_label("How it is known").select_option("weighed")
    firmware.fill("from 10.1.2.3")
    page.get_by_role("button", name="Make the archive").click()
    page.locator("#wrong-firmware", has_text="private text (IP address)").wait_for()
    assert (firmware.get_attribute("aria-invalid"), firmware.input_value()) == ("true", "from 10.1.2.3")
    firmware.fill("3.1")
    leak = UsageError("the archive would contain a private text", next_step="Remove a word with --remove")
    with monkeypatch.context() as patched:      # found in the log; the worker names an option
        patched.setattr("tdhil.evidence.make_evidence", Mock(side_effect=leak))
        page.get_by_role("button", name="Make the archive").click()
        said = page.locator("#evidence-said")
        said.wait_for()
    assert "“Further words to remove”" in said.inner_text() and "--remove" not in said.inner_text()
    assert (remove.get_attribute("aria-invalid"), firmware.input_value()) == ("true", "3.1")
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
    page.get_by_role("button", name="Restore from the archive").wait_for()
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


def test_a_rehearsal_is_marked_wherever_its_run_is_shown(page, served):
    run = served.service.supervisor.start_run(
        "a", {"note": "done", "fault": ["torque-scale=1.1"]}, "local").request.id
    served.service.wait(run, "done")
    for path in ("/runs", f"/runs/{run}", f"/runs/{run}/live"):
        page.goto(path)
        page.get_by_text("REHEARSAL", exact=True).first.wait_for()
    page.goto("/")
    page.get_by_role("article", name="Rig a").get_by_text("no result yet").wait_for()


@pytest.mark.heavy
def test_one_run_has_one_time_on_each_page(browser, served, monkeypatch):
    """The list, its page, the history and the comparison show the time of its request, in the reader's time zone."""
    from tdhil.fleet import FleetRow, trend_document

    ids = []
    for _ in range(3):
        run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
        served.service.wait(run, "done")
        row = FleetRow(run, "valid", rig="a", date="2020-01-01T00:00:00+00:00", inertia_kg_m2=104.0,
                       inertia_low_kg_m2=103.0, inertia_high_kg_m2=105.0, confidence=0.95, simulated=True)
        write_json(served.service.store.place(run) / "row.json", asdict(row))
        (served.service.store.place(run) / "run.mcap").write_bytes(b"log")
        ids.append((run, asdict(row)))

    def work(what, of, asked):
        if what == "trend":
            return {"document": trend_document([FleetRow(**one) for one in asked["rows"]], "a", rehearsals=True)}
        return {"document": {"results": [row for _, row in ids[:2]], "apparent_inertia": [[], []], "friction": [[], []],
                             "differences": [], "settings": [
                                 {"name": "date", "values": ["2020-01-01"] * 2, "differs": False}]}}

    monkeypatch.setattr(served.service.supervisor, "work", work)
    run = ids[0][0]
    context = browser.new_context(base_url=served.url, timezone_id="Asia/Kolkata")
    page = context.new_page()
    page.goto(f"/runs/{run}")
    page.locator("#result .figure").wait_for()
    time = page.locator("main time").first.inner_text()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC\+05:30", time)
    page.goto("/runs")
    row = page.locator("#runs tr", has=page.locator(f"a[href='/runs/{run}']"))
    row.get_by_role("cell", name=time, exact=True).wait_for()
    page.goto("/rigs/a")
    page.get_by_text("inertia in numbers").click()
    page.locator(f"#history a[href='/runs/{run}']", has_text=time).first.wait_for()
    page.goto(f"/compare?runs={run},{ids[1][0]}")
    page.locator(f"th a[href='/runs/{run}']", has_text=f"a, {time}").first.wait_for()
    page.get_by_role("row", name="date").get_by_role("cell", name=time).first.wait_for()
    context.close()


@pytest.mark.heavy
def test_a_stopped_run_is_compared_and_each_verdict_has_its_colour(page, served, monkeypatch):
    from tdhil.fleet import FleetRow

    runs = [begin(served)]
    served.service.supervisor.stop(runs[0], "local")
    served.service.wait(runs[0], "stopped")
    for _ in range(2):
        runs.append(served.service.supervisor.start_run("b", {"note": "done"}, "local").request.id)
        served.service.wait(runs[-1], "done")
    inertia = {**estimate(104.0), "low_total": 100.0, "high_total": 108.0}
    for run, verdict in zip(runs, ("valid", "valid_wide", "not_identifiable"), strict=True):
        write_json(served.service.store.place(run) / "result.json", {"verdict": verdict, "inertia_kg_m2": inertia})
        (served.service.store.place(run) / "run.mcap").write_bytes(b"log")
        served.service.supervisor.index.put(served.service.store.summary(run))
    page.goto("/runs")
    rows = {run: page.locator("#runs tr", has=page.locator(f"a[href='/runs/{run}']")) for run in runs}
    rows[runs[0]].get_by_text("stopped", exact=True).wait_for()      # a list does not know of standstill
    colours = [rows[run].locator(".verdict:not(.acceptance)").evaluate("one => getComputedStyle(one).color")
               for run in runs]
    assert len({*colours, page.evaluate("getComputedStyle(document.body).color")}) == 4
    assert rows[runs[0]].locator("th, td:not(.pick)").first.inner_text().startswith("Rig a")     # the rig comes first
    assert page.locator("thead th").nth(1).inner_text().strip().lower().startswith("rig")
    rows_of = [asdict(FleetRow(run, "valid", rig="a", inertia_kg_m2=104.0, aborted_by="operator")) for run in runs[:2]]
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": {
        "results": rows_of, "differences": [], "settings": [], "apparent_inertia": [], "friction": []}})
    for run in runs[:2]:
        rows[run].get_by_role("checkbox").check()
    page.get_by_role("button", name="Compare").click()
    page.wait_for_url("**/compare?runs=*,*")
    page.locator(f"th a[href='/runs/{runs[0]}']").first.wait_for()


def test_the_recorded_motion_can_be_zoomed_read_and_exported(page, served):
    run = ended_run(served)
    write(served.service.store.place(run) / "run.mcap")         # 0 to 1.99 s, speed 10 rad/s², torque -20 N·m/s
    page.goto(f"/runs/{run}/live")
    charts, readout = page.locator("#plot-speed .u-over, #plot-torque .u-over"), page.locator("#readout")
    whole = page.get_by_role("button", name="Whole run")
    wait_for("the samples", lambda: page.evaluate("document.getElementById('speed').textContent") != "–")
    assert whole.is_disabled()

    def move(share: float) -> list[float]:
        charts.first.scroll_into_view_if_needed()
        box = charts.first.bounding_box()
        page.mouse.move(box["x"] + share * box["width"], box["y"] + 40, steps=3)
        readout.get_by_text("N·m").wait_for()
        return [float(one) for one in re.findall(r"-?[\d.]+", readout.inner_text().replace("N·m", ""))]

    def saved(name: str) -> bytes:
        with page.expect_download() as download:
            page.get_by_role("button", name=name, exact=True).click()
        assert download.value.suggested_filename.startswith(run)
        return Path(download.value.path()).read_bytes()

    above = page.evaluate("""async () => {
        let named = null;
        const write = CanvasRenderingContext2D.prototype.fillText;
        CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
            if (text === "setup") named = { y, over: this.canvas.parentElement.querySelector(".u-over") };
            write.call(this, text, x, y);
        };
        const second = window.tdhil.motion("second");
        second.set([[0, 1, 2], [0, 1, 2], [0, 1, 2]]);
        second.stages([{ name: "setup", end_s: 1.5 }]);
        await new Promise(requestAnimationFrame);
        const above = devicePixelRatio * named.over.offsetTop - named.y;
        for (const id of ["plot-speed", "plot-torque"]) document.querySelector(`#${id} .uplot:last-child`).remove();
        return above;
    }""")
    assert 0 < above < 18            # px: the name of a stage is above the area of the curve
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
    whole.click()

    def seen() -> tuple[float, float]:
        return move(0.0)[0], move(0.999)[0]

    for name, part in (("Zoom in", (0.5, 1.5)), ("Zoom in", (0.75, 1.25)), ("Later", (0.87, 1.37)),
                       ("Earlier", (0.75, 1.25)), ("Zoom out", (0.5, 1.5))):
        page.get_by_role("button", name=name).click()
        assert seen() == pytest.approx(part, abs=0.07), name
    move(0.5)
    page.mouse.wheel(100, 0)                                    # sideways
    assert seen() == pytest.approx((0.56, 1.56), abs=0.07)
    move(0.5)
    page.keyboard.down("Control")
    page.mouse.wheel(0, -100)
    page.keyboard.up("Control")
    assert seen() == pytest.approx((0.71, 1.42), abs=0.07)
    whole.click()
    page.get_by_role("button", name="Speeds in rad/s").click()
    time_s, speed_rpm, _ = move(0.5)
    assert "rpm" in readout.inner_text() and speed_rpm == pytest.approx(95.5 * time_s, rel=0.02)
    charts.last.dblclick()
    assert whole.is_disabled()
    page.goto("/start/a")                                       # the unit is kept
    page.get_by_role("button", name="Speeds in rpm").wait_for()


@pytest.mark.heavy
def test_from_a_result_to_a_replay_and_two_runs_compared(page, served, monkeypatch):
    run = ended_run(served)
    results(served, run, monkeypatch)
    page.goto(f"/runs/{run}")
    page.get_by_text("speed was quantised").wait_for()
    shown = page.locator("time").first.inner_text()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC([+-]\d\d:\d\d)?", shown)      # local, with its zone
    quoted = page.get_by_role("row", name="J, 90 % interval to quote")
    quoted.get_by_text("104.0 (100.0 to 108.0) kg·m² ±3.9 %").wait_for()           # 3.85 %, rounded up as in the report
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
    page.locator("#wrong-tolerance").get_by_text("a number and its unit").wait_for()         # and not skipped
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
    page.wait_for_url(re.compile("/runs/[^/]+$"))                          # without a click
    begun = served.service.store.request(served.service.store.ids()[0])
    assert begun.options["fault"] == ["internal-limit@speed+1.5s=20%"]


@pytest.mark.heavy
def test_a_trace_is_added_with_its_columns_corrected_and_becomes_a_marked_run(page, served, monkeypatch):
    play_uploads(served.service, monkeypatch)
    page.goto("/runs")
    page.get_by_role("link", name="Add a recording").click()
    page.locator("#limit").get_by_text("256 MiB").wait_for()
    page.set_input_files("#file", {"name": HOSTILE, "mimeType": "text/csv", "buffer": b""})
    page.get_by_text("This file is empty").wait_for()
    page.set_input_files("#file", {"name": "<b id=x>7</b>.csv", "mimeType": "text/csv", "buffer": TRACE.encode()})
    speed, rated = page.locator("[name='columns.speed']"), page.get_by_label("Torque at 100 %, N·m")
    page.get_by_text("Torque in % needs the rated torque").wait_for()
    assert rated.get_attribute("aria-invalid") == "true" and page.locator(".mini canvas").count() == 0
    assert (speed.input_value(), page.locator("[name='unit.time']").input_value()) == ("Drehzahl ist", "ms")
    assert page.locator("#table th.mapped small").all_inner_texts() == ["time", "speed", "torque"]
    speed.select_option("Zeit")                     # wrong values, all marked at once
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
def test_a_refused_identification_names_and_marks_its_fields_and_keeps_what_was_typed(page, served, monkeypatch):
    """This includes refusals of the worker process, with options of the command line, and one without a field."""
    play_uploads(served.service, monkeypatch)
    works = served.service.supervisor.work

    def refuses(what, run, asked):
        if what == "upload":
            said = "The torque of --gear and --rated-torque differs"
            raise RunRefused(Told("UsageError", said, said, "", "Give --gear-ratio", 2, "TDH-204"))
        return works(what, run, asked)

    monkeypatch.setattr(served.service.supervisor, "work", refuses)
    page.goto("/upload")
    page.set_input_files("#file", {"name": "x.csv", "mimeType": "text/csv", "buffer": TRACE.encode()})
    page.locator(".wrong").wait_for()
    rated, note = page.get_by_label("Torque at 100 %, N·m"), page.get_by_label("Note")
    rated.fill("480")
    rated.press("Tab")
    page.locator(".mini canvas").nth(1).wait_for()
    note.fill("after the repair")
    page.get_by_role("button", name="Identify").click()
    said = page.locator("#mapping-said")
    said.wait_for()
    assert "“Torque at 100 %, N·m (rated or reference torque)”" in said.inner_text()
    assert "--rated-torque" not in said.inner_text()
    assert (rated.get_attribute("aria-invalid"), rated.get_attribute("aria-describedby")) == ("true", "mapping-said")
    assert (rated.input_value(), note.input_value()) == ("480", "after the repair")
    wrong = [("columns", "one column can't hold two quantities"), ("rated_torque_nm", "must be above 0")]
    monkeypatch.setattr("tdhil.service.upload_routes.upload_options", lambda body, kind: ({}, list(wrong)))
    page.get_by_role("button", name="Identify").click()
    page.locator("#wrong-rated_torque_nm").wait_for()
    assert said.inner_text() == "columns: one column can't hold two quantities"        # without a field: it was omitted


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
