"""Pages of the list of runs in Chromium: the address has filters, order and page, and a choice is kept."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from tests.service.chromium.pages import IN_CHROMIUM
from tests.service.test_run_list import rows

pytestmark = IN_CHROMIUM
RUNS = 250


@pytest.fixture
def many(served: Any) -> Any:
    """Add 250 rows of runs to the index; the newest have the highest numbers."""
    index = served.service.index
    index.rebuild()
    for one in rows(RUNS):
        index.put(replace(one, archived=False))
    return served


def shown(page: Any) -> list[int]:
    return [int(one) for one in re.findall(r"run (\d+)", page.locator("#runs").inner_text())]


def test_the_pages_of_the_list_have_permanent_addresses(page, many):
    page.goto("/runs")
    page.get_by_text("Runs 1 to 100 of 250").wait_for()
    assert shown(page) == list(range(249, 149, -1))
    assert page.get_by_text("Previous page").get_attribute("aria-disabled") == "true"
    page.locator("#runs input:enabled").first.check()
    page.get_by_role("link", name="Next page").focus()
    page.keyboard.press("Enter")
    page.get_by_text("Runs 101 to 200 of 250").wait_for()
    assert shown(page) == list(range(149, 49, -1))
    page.locator("#runs input:enabled").first.check()
    page.get_by_text("2 chosen").wait_for()                    # of two pages
    page.get_by_role("link", name="Next page").click()
    page.get_by_text("Runs 201 to 250 of 250").wait_for()
    assert page.get_by_text("Next page").get_attribute("aria-disabled") == "true"
    kept = page.url
    page.go_back()
    page.get_by_text("Page 2 of 3").wait_for()
    assert page.get_by_role("button", name="Compare", exact=True).is_enabled()
    many.service.index.put(replace(rows(1)[0], id="20260102-000000-000000", note="run 999", archived=False))
    page.goto(kept)
    page.get_by_text("Runs 201 to 250 of 250").wait_for()      # a new run changes no page
    assert shown(page) == list(range(49, -1, -1))
    page.get_by_role("link", name="Previous page").click()
    page.get_by_role("link", name="Previous page").click()
    page.get_by_text("Runs 1 to 100 of 251").wait_for()
    assert shown(page)[0] == 999


def test_search_filters_and_order_reach_runs_of_every_page(page, many):
    page.goto("/runs")
    page.get_by_label("Search").fill("run 7")
    page.get_by_text(re.compile(r"^Runs 1 to \d+ of \d+$")).wait_for()
    page.locator("#runs").get_by_text(re.compile(r"run 7\b")).wait_for()          # it is on the oldest page
    page.get_by_label("Search").fill("")
    page.get_by_text("Runs 1 to 100 of 250").wait_for()
    page.locator("select[name=rig]").select_option("b")
    page.get_by_label("Verdict").select_option("valid")
    page.get_by_label("Tag").select_option("bearing")
    expected = [one for one in rows(RUNS) if one.rig == "b" and one.verdict == "valid" and "bearing" in one.tags]
    page.get_by_text(f"Runs 1 to {len(expected)} of {len(expected)}").wait_for()
    page.get_by_role("button", name="J, interval to quote").click()
    page.locator("th[aria-sort=ascending]").wait_for()
    known = sorted(one.inertia_kg_m2 for one in expected if one.inertia_kg_m2 is not None)
    values = [float(one) for one in re.findall(r"([\d.]+) kg", page.locator("#runs").inner_text())]
    assert values == known and len(known) > 2
    address = page.url
    page.goto("/")
    page.goto(address)                                          # the address has all conditions
    page.get_by_text(f"Runs 1 to {len(expected)} of {len(expected)}").wait_for()
    assert page.locator("select[name=rig]").input_value() == "b" and page.get_by_label("Tag").input_value() == "bearing"
    page.locator("th[aria-sort=ascending]").wait_for()


def test_the_list_shows_sorts_and_filters_by_the_acceptance(page, many):
    page.goto("/runs?archived=true")
    page.get_by_text("Runs 1 to 100 of 250").wait_for()
    newest = page.locator("#runs tr").locator("nth=0")
    assert newest.locator("td.acceptance").inner_text() == (rows(RUNS)[-1].acceptance or "")
    page.get_by_role("button", name="acceptance").click()
    page.locator("th[aria-sort=ascending]").get_by_text("acceptance").wait_for()
    page.locator("#runs tr").first.get_by_text("cannot tell").wait_for()
    page.get_by_role("button", name="acceptance").click()
    page.locator("th[aria-sort=descending]").get_by_text("acceptance").wait_for()
    page.locator("#runs tr").first.get_by_text("pass", exact=True).wait_for()
    page.get_by_label("Acceptance").select_option("fail")
    page.wait_for_url("**acceptance=fail**")
    expected = [one for one in rows(RUNS) if one.acceptance == "fail"]
    page.get_by_text(f"Runs 1 to {len(expected)} of {len(expected)}").wait_for()
    assert set(page.locator("td.acceptance").all_inner_texts()) == {"fail"}


def test_on_a_phone_the_acceptance_has_its_name_and_a_run_without_one_has_no_line(page, many):
    page.set_viewport_size({"width": 390, "height": 844})
    page.goto("/runs?archived=true")
    page.get_by_text("Runs 1 to 100 of 250").wait_for()
    cells = page.locator("td.acceptance").evaluate_all("""all => all.map((one) => [
        one.textContent, one.getBoundingClientRect().height > 0, one.dataset.label,
        getComputedStyle(one, "::before").content !== "none"])""")
    assert {text for text, *_ in cells} == {"", "pass", "fail", "cannot tell"}
    assert all(seen is bool(text) for text, seen, *_ in cells)
    assert {tuple(named) for text, _, *named in cells if text} == {("acceptance", True)}


@pytest.mark.heavy
@pytest.mark.parametrize("width", [390, 1280])
def test_the_list_with_its_filters_fits(page, many, width):
    page.set_viewport_size({"width": width, "height": 844})
    page.goto("/runs?page=2")
    page.get_by_text("Page 2 of 3").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.heavy
def test_a_rehearsal_is_compared_once_it_is_chosen_and_a_history_has_it_if_asked(page, served):
    served.service.index.rebuild()
    for one, rehearsal in zip(rows(2), (False, True), strict=True):
        served.service.index.put(replace(one, rig="a", state="done", verdict="valid", inertia_kg_m2=104.0,
                                         archived=False, uploaded=False, rehearsal=rehearsal))
    page.goto("/runs")
    page.get_by_text("Runs 1 to 2 of 2").wait_for()
    for box in page.locator("#runs input").all():
        box.check()
    page.get_by_role("button", name="Compare", exact=True).click()
    page.wait_for_url("**/compare?runs=*&rehearsals=true")
    page.goto("/rigs/a?archived=true")
    page.get_by_text("1 rehearsal of faults on the simulated drive: left out").wait_for()
    page.get_by_role("link", name="Rehearsals too").click()
    page.wait_for_url("**/rigs/a?archived=true&rehearsals=true")
    page.get_by_text("no run has a result yet").wait_for()
    assert page.get_by_text("left out").count() == 1           # the torque scale, in the head of the page
    page.get_by_role("link", name="Without rehearsals").click()
    page.wait_for_url("**/rigs/a?archived=true")
