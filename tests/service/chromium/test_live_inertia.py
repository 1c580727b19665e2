"""J from the periods so far, on the page of a run in Chromium: values, graph, and agreement with the result."""

from __future__ import annotations

from typing import Any

import pytest

from tdhil.recording import LiveInertia, RunWriter
from tests.recording.test_log_tail import COMMAND, sample
from tests.service.chromium.pages import IN_CHROMIUM, begin

pytestmark = IN_CHROMIUM
SHOWN = "104.2 (103.1 to 105.3) kg·m²"
FIRST = LiveInertia(0.8, 3, 0.95, "valid", "because", 103.0, 96.0, 110.0, 94.0, 112.0, 0.62, 0.01, 90.0)
LAST = LiveInertia(1.6, 4, 0.95, "valid", "because", 104.2, 103.1, 105.3, 100.0, 108.4, 0.41, 0.01, 35.0)


def played(served: Any, *found: LiveInertia) -> str:
    """Begin a run whose log has these intermediate results."""
    run = begin(served)
    folder = served.service.store.place(run)
    with RunWriter(folder / "other.mcap", epoch_ns=10**18, block=True) as writer:
        writer.configuration({"seed": 7}, {})
        for number in range(200):
            writer.command(0.01 * number, COMMAND)
            writer.sample(sample(number))
        for one in found:
            writer.inertia(one)
    (folder / "other.mcap").replace(folder / "run.mcap")
    return run


@pytest.mark.heavy
def test_j_so_far_is_shown_with_interval_p_and_least_time(page, served):
    run = played(served, FIRST, LAST)
    page.goto(f"/runs/{run}/live")
    page.locator("#inertia-now", has_text=SHOWN).wait_for()
    said = page.locator("#inertia-said").inner_text()
    assert said.startswith("4 periods, ")
    for one in ("p = 0.41", "at least 35 s to ±1 %"):
        assert one in said
    plot = page.locator("#plot-inertia canvas")
    plot.wait_for()
    drawn = plot.evaluate("""canvas => {
        const all = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
        let count = 0;
        for (let k = 3; k < all.length; k += 4) if (all[k]) count += 1;
        return count;
    }""")
    assert drawn > 1000                  # axes, bands and marks


@pytest.mark.heavy
def test_j_so_far_can_be_read_at_each_time(page, served):
    run = played(served, FIRST, LAST)
    page.goto(f"/runs/{run}/live")
    over = page.locator("#plot-inertia .u-over")
    over.scroll_into_view_if_needed()
    for place, shown in ((0.05, "0.8 s: J = 103.0 (96.0 to 110.0) kg·m², with the torque scale 103.0 (94.0 to 112.0)"),
                         (0.95, f"1.6 s: J = {SHOWN}, with the torque scale 104.2 (100.0 to 108.4)")):
        box = over.bounding_box()
        page.mouse.move(box["x"] + place * box["width"], box["y"] + 40, steps=3)
        page.locator("#plot-inertia + .readout", has_text=shown).wait_for()


@pytest.mark.heavy
def test_the_last_value_is_the_one_of_the_result(page, served):
    """The page shows the same digits live with the repeatability, and for the key of the result."""
    run = played(served, FIRST, LAST)
    page.goto(f"/runs/{run}/live")
    now = page.locator("#inertia-now", has_text=SHOWN)
    now.wait_for()
    document = {"value": LAST.inertia_kg_m2, "low": LAST.low_kg_m2, "high": LAST.high_kg_m2,
                "low_total": LAST.low_kg_m2, "high_total": LAST.high_kg_m2}      # the torque scale is exact
    assert page.evaluate("J => window.tdhil.ofResult({ inertia_kg_m2: J })", document) == now.inner_text()


def test_the_page_of_a_run_shows_stage_time_and_j_until_the_run_ends(page, served):
    run = played(served, FIRST, LAST)
    page.goto(f"/runs/{run}")
    page.locator("#inertia-now", has_text=SHOWN).wait_for()
    assert page.locator("#result").inner_text().startswith("moving: setup")
    assert page.locator("#time-now").inner_text() == "2 s"
    assert "p = 0.41" in page.locator("#inertia-said").inner_text()
    page.get_by_label("Operator").fill("Anna")         # the page is not loaded again
    served.service.supervisor.stop(run, "local")
    page.get_by_text("This page has new content.").wait_for()
    assert not page.locator("#so-far").is_visible()


def test_one_period_is_written_in_the_singular(page, served):
    run = played(served, LiveInertia(0.5, 1, 0.95, "not_identifiable", "the scatter stays open"))
    page.goto(f"/runs/{run}/live")
    page.locator("#inertia-said", has_text="the scatter stays open").wait_for()
    assert page.locator("#inertia-said").inner_text() == "1 period, the scatter stays open"


@pytest.mark.heavy
def test_an_interval_without_a_number_gives_the_reason(page, served):
    run = played(served, LiveInertia(0.5, 2, 0.95, "not_identifiable", "2 periods leave the scatter open"))
    page.goto(f"/runs/{run}/live")
    page.locator("#inertia-said", has_text="2 periods leave the scatter open").wait_for()
    assert page.locator("#inertia-now").inner_text() == "–"
    assert not page.locator("#inertia").is_visible()
