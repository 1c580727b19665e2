"""Values under the cursor in the charts of J, of a rig's history and of compared runs; the page of a run that ended
early, in Chromium."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tdhil.report.blocks import UNCERTAINTY_BUDGET
from tdhil.service.store import write_json
from tests.service.chromium.pages import IN_CHROMIUM, begin, estimate, results

pytestmark = IN_CHROMIUM


def ended(served: Any) -> str:
    run = str(served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id)
    served.service.wait(run, "done")
    return run


def stopped(served: Any) -> str:
    run = begin(served)
    served.service.supervisor.stop(run, "anna")
    served.service.wait(run, "stopped")
    return run


def read(page: Any, plot: Any, share: float) -> str:
    over = plot.locator(".u-over")
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    page.mouse.move(box["x"] + share * box["width"], box["y"] + 40, steps=3)
    return str(plot.locator("xpath=following-sibling::p").first.inner_text())


def test_a_history_and_a_comparison_show_the_values_under_the_cursor(page, served, monkeypatch):
    _, compare, history, _ = results(served, ended(served), monkeypatch)
    page.goto(history)
    plot = page.locator(".plot").first
    plot.locator("canvas").wait_for()
    assert re.search(r"^2026-05-01 .*: 104\.0 \(102\.9 to 105\.1\) kg·m²$", read(page, plot, 0.1))
    assert re.search(r"^2026-06-01 .*: 99\.00 \(98\.01 to 99\.99\) kg·m²$", read(page, plot, 0.9))
    page.mouse.move(1, 1)
    page.get_by_text("Move over the chart to read its values.").wait_for()
    page.goto(compare)
    plot = page.locator(".plot").first
    plot.locator("canvas").wait_for()
    inertia = "104.0 (102.9 to 105.1) kg·m²"
    assert read(page, plot, 0.1) == f"0.1000 Hz: run 1: {inertia}; run 2: {inertia}"


@pytest.mark.heavy
def test_a_history_can_be_zoomed_panned_and_exported(page, served, monkeypatch):
    _, _, history, _ = results(served, ended(served), monkeypatch)
    page.goto(history)
    page.locator(".plot canvas").first.wait_for()
    tools = page.get_by_role("toolbar", name="View: inertia, kg·m²")
    whole = tools.get_by_role("button", name="Whole")

    def saved(name: str) -> bytes:
        with page.expect_download() as download:
            tools.get_by_role("button", name=name, exact=True).click()
        assert download.value.suggested_filename == f"inertia-kg-m².{name.lower()}"
        return Path(download.value.path()).read_bytes()

    def rows() -> list[str]:
        head, *found = saved("CSV").decode().splitlines()
        assert head == "run,date,value,low,high,unit"
        return [one.split(",")[1][:10] for one in found]

    assert whole.is_disabled() and rows() == ["2026-05-01", "2026-06-01"]
    tools.get_by_role("button", name="Zoom in").click()
    assert rows() == []
    for _ in range(2):
        tools.get_by_role("button", name="To the left").click()
    assert rows() == ["2026-05-01"] and saved("PNG").startswith(b"\x89PNG")
    assert "2026-05-01" in read(page, page.locator(".plot").first, 0.1)
    whole.click()
    assert whole.is_disabled() and len(rows()) == 2
    box = page.locator(".plot .u-over").first.bounding_box()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.98 * box["width"], box["y"] + 40, steps=4)
    page.mouse.up()
    assert rows() == ["2026-06-01"]


@pytest.mark.heavy
def test_the_friction_of_compared_runs_follows_the_unit_of_speed(page, served, monkeypatch):
    run = ended(served)
    _, compare, _, _ = results(served, run, monkeypatch)
    work = served.service.supervisor.work
    friction = [{"speed_rad_s": speed, **estimate(60.0 + 8.0 * speed)} for speed in (2.0, 5.0)]

    def with_friction(what: str, run: Any, asked: Any) -> Any:
        found = work(what, run, asked)
        return {"document": {**found["document"], "friction": [friction, friction[:1]]}}

    monkeypatch.setattr(served.service.supervisor, "work", with_friction)
    page.goto(compare)
    plot = page.locator(".plot").nth(1)
    plot.locator("canvas").wait_for()
    assert read(page, plot, 0.95) == "5 rad/s: run 1: 100.0 (99.0 to 101.0) N·m"
    page.locator("#speed-unit").click()
    assert read(page, plot, 0.95) == "47.75 rpm: run 1: 100.0 (99.0 to 101.0) N·m"
    page.get_by_text("Friction, N·m, in numbers").click()
    page.get_by_role("columnheader", name="speed, rpm").wait_for()
    page.get_by_role("rowheader", name="47.75", exact=True).wait_for()


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("how", ["stopped", "lost", "failed"])
def test_a_run_that_ended_early_has_its_j_its_budget_and_its_stages(page, served, how):
    """A requested stop is no alarm. A lost lease and a fault are alarms."""
    run = stopped(served)
    folder = served.service.store.place(run)
    state = json.loads((folder / "state.json").read_bytes())
    error = {"kind": "Interrupted", "message": "interrupted: anna requested a stop", "where": "", "next_step": "",
             "what": "interrupted: anna requested a stop", "exit_code": 143, "code": "TDH-1300"}
    at = state["history"][-1]["at"]
    watch = {"by": "anna", "since": at, "gone": at, "how": "closed", "lost": at} if how == "lost" else None
    if how == "failed":
        state["history"][-1]["state"] = "failed"
    write_json(folder / "state.json", {**state, "error": error, "watch": watch})
    inertia = {**estimate(104.0), "low_total": 100.0, "high_total": 108.0, "half_width_total_rel": 0.04,
               "repeatability_rel": 0.01}
    write_json(folder / "result.json", {
        "verdict": "valid_wide", "inertia_kg_m2": inertia, "reason": "a part", "warnings": ["the run was aborted"],
        "warning_codes": ["TDH-030"],
        "budget": [{"source": source, "half_width_kg_m2": half, "note": ""}
                   for source, half in (("noise", 0.2), ("torque scale", 4.0), ("timing", 1.0))],
        "stages": [{"name": "setup", "outcome": "ok", "duration_s": 3.7},
                   {"name": "acquire", "outcome": "aborted", "duration_s": 60.0, "detail": "anna requested a stop"}],
    })
    svg = "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 9 9'><path d='M0 0L9 9' stroke='red'/></svg>"
    (folder / "report.html").write_text("".join(
        f"<h2>{heading}</h2><figure>{svg}<figcaption>said</figcaption></figure>"
        for heading in ("Speed and torque", UNCERTAINTY_BUDGET.capitalize())))
    page.goto(f"/runs/{run}")
    page.get_by_text("J = 104.0 (100.0 to 108.0) kg·m²").first.wait_for()
    assert page.get_by_role("heading", name="Speed and torque").count() == 1
    assert page.get_by_role("heading", name="Uncertainty budget").count() == 1       # its picture is omitted
    bars = page.get_by_role("region", name="Uncertainty budget").get_by_role("row")
    assert [one.get_by_role("rowheader").inner_text() for one in bars.all()] == ["torque scale", "timing", "noise"]
    assert bars.first.get_by_role("meter").is_visible()
    table = page.get_by_role("region", name="Stages")
    assert not table.is_visible()
    page.get_by_text("Stages", exact=True).click()
    table.get_by_role("row", name="acquire").get_by_text("anna requested a stop").wait_for()
    assert page.locator("#result .alarm").count() == {"stopped": 0, "lost": 3, "failed": 2}[how]
    assert page.get_by_text("This run was not watched: braking began at").count() == (1 if how == "lost" else 0)


def test_a_run_that_ended_before_its_data_determined_j_states_it(page, served):
    run = stopped(served)
    page.goto(f"/runs/{run}")
    page.get_by_text("No J: the run ended before its data determined one").wait_for()
    assert page.locator("#result .alarm").count() == 0
