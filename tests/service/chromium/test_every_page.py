"""Each page in Chromium: foreign text stays text, the page fits a phone, and axe-core finds no serious fault."""

from __future__ import annotations

import os

import pytest

from tests.service.chromium.pages import (
    HOSTILE,
    IN_CHROMIUM,
    PAGES,
    TRACE,
    asks_with_a_checklist,
    judge,
    results,
)
from tests.service.conftest import play_uploads

pytestmark = IN_CHROMIUM


@pytest.mark.heavy
def test_data_of_rigs_drives_and_logs_are_text_on_every_page(page, served, monkeypatch):
    run = served.service.supervisor.start_run("hostile", {"note": "done", "operator": HOSTILE}, "local").request.id
    served.service.wait(run, "done")
    paths = results(served, run, monkeypatch)
    judge(served, run)
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
def test_every_page_fits_a_phone_and_is_legible(browser, served, monkeypatch):
    """Pages are at most 390 px wide; axe-core, if TDHIL_AXE names its file, finds no serious fault.

    With dark colours it checks the contrast only, since the rest of the page is the same.
    """
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    context = browser.new_context(base_url=served.url, viewport={"width": 390, "height": 800}, color_scheme="light",
                                  bypass_csp=True)
    page, faults = context.new_page(), []
    axe = os.environ.get("TDHIL_AXE")

    def check(path):
        page.wait_for_timeout(500)
        page.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")
        page.wait_for_timeout(100)
        wide = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        assert wide <= 0, (path, wide)
        if axe:
            page.add_script_tag(path=axe)
            found = page.evaluate("axe.run()")["violations"]
            page.emulate_media(color_scheme="dark")
            found += page.evaluate("axe.run({runOnly: ['color-contrast']})")["violations"]
            page.emulate_media(color_scheme="light")
            faults.extend((path, one["id"], [node["target"] for node in one["nodes"]][:4])
                          for one in found if one["impact"] in ("serious", "critical"))

    paths = results(served, run, monkeypatch)
    judge(served, run)
    for path in (*PAGES, *paths, f"/runs/{run}/live", f"/runs/{asks_with_a_checklist(served)}/live", "/nothing"):
        page.goto(path)
        check(path)
    page.goto("/start/a")
    page.locator("[name=max_time_s]").fill("soon")
    page.get_by_role("button", name="Start").click()
    page.locator("#wrong-max_time_s").wait_for()
    check("a refused form")
    page.goto("/calibrate/a")
    page.get_by_role("button", name="Calibrate").click()
    page.locator("#wrong-without").wait_for()
    check("a refused calibration")
    play_uploads(served.service, monkeypatch)
    page.goto("/upload")
    page.set_input_files("#file", {"name": "x.csv", "mimeType": "text/csv", "buffer": TRACE.encode()})
    page.locator(".wrong").wait_for()
    check("an upload that is refused")
    page.get_by_label("Torque at 100 %, N·m").fill("480")
    page.get_by_label("Torque at 100 %, N·m").press("Tab")
    page.locator(".mini canvas").nth(1).wait_for()
    check("the preview of an upload")
    context.close()
    assert faults == []
    if not axe:
        pytest.skip("every page fits; no axe-core: npm install axe-core, and TDHIL_AXE=PATH of its axe.min.js")
