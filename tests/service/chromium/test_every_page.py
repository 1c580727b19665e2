"""Each page in Chromium: foreign text stays text, everything fits a phone, and axe-core finds no serious fault."""

from __future__ import annotations

import os

import pytest

from tests.service.chromium.pages import HOSTILE, IN_CHROMIUM, PAGES, results

pytestmark = IN_CHROMIUM


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
