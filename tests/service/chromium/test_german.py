"""Pages in another language in Chromium: no English text, German fits a phone, and a decimal comma is accepted."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tdhil.service.languages import Language, languages
from tests.service.catalogue import texts
from tests.service.chromium.pages import HOSTILE, IN_CHROMIUM, PAGES, PLAN, Served, results
from tests.service.conftest import Service

pytestmark = IN_CHROMIUM

FIRST, LAST = "⟦", "⟧"
DATA = {
    r"Rig [ab]|a|b|broken|hostile|never|real|rehearsed|watched|local|done|admin": "names of rigs and users, a note",
    r"bench-3|nothing|csv": "an example of an id, and names of this test",
    r"(rad/s²?|N·m(·s/rad|/s)?|kg·m²|Hz|min|MiB|KiB|s|rpm)": "units",
    r"multisine|sine|step|prbs|pulses|coast-down": "names of excitations",
    r"auto|rigid(\+lags)?|two-mass|string|paper|J|κ|p": "names of models and quantities",
    r"tdhil|run\.mcap|report\.(html|pdf)|result\.json|samples\.csv|fleet\.csv|trace\.csv|rig\.yaml|A4|PNG|CSV|SHA":
        "names of files and formats",
    r"Deutsch|English": "names of languages, each in its own",
    r"CANopen|Modbus|EtherCAT|RTU|TCP|UTC": "names of buses and zones",
    r"sto@hold": "a fault, as it is typed",
}
"""Texts that a page shows in each language, with the reason."""
LEFT = re.compile(rf"\b({'|'.join(DATA)})\b|\w*\d[\w.:-]*")
TEXTS = """() => {
    const found = [], walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walk.nextNode()) {
        const at = walk.currentNode.parentElement;
        if (at.closest("script, noscript, code, pre, time, textarea, [lang=en], option:not([value])")) continue;
        if (at.tagName !== "OPTION" && !at.checkVisibility()) continue;
        found.push(walk.currentNode.textContent);
    }
    for (const one of document.querySelectorAll("[placeholder], [aria-label], [alt]"))
        if (!one.closest("[lang=en]")) found.push(one.placeholder || "", one.getAttribute("aria-label") || "");
    return found;
}"""


@pytest.fixture
def pseudo(tmp_path: Path, rigs: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    """Service whose German texts are the English ones between marks."""
    marked = Language("de", "Deutsch", ",", {key: f"{FIRST}{where[0].text}{LAST}" for key, where in texts().items()})
    monkeypatch.setattr("tdhil.service.page_routes.languages", lambda: {**languages(), "de": marked})
    found = Served(Service(tmp_path / "data", rigs))
    yield found
    for run in found.service.supervisor.live():
        found.service.supervisor.stop(run, "end of the test")
    found.service.supervisor.close()
    found.end()


def german(browser: Any, served: Served, width: int = 1280) -> Any:
    context = browser.new_context(base_url=served.url, viewport={"width": width, "height": 800}, locale="de-DE",
                                  bypass_csp=bool(os.environ.get("TDHIL_AXE")))
    context.set_default_timeout(60_000)
    return context.new_page()


def unmarked(text: str) -> str:
    """Return the rest of a text without its marked parts and data."""
    while (less := re.sub(f"{FIRST}[^{FIRST}{LAST}]*{LAST}", "", text)) != text:
        text = less
    text = re.sub(f"^[^{FIRST}]*{LAST}|{FIRST}[^{LAST}]*$", "", text)          # a value is within the text
    return LEFT.sub("", text.replace(HOSTILE, ""))


@pytest.mark.heavy
def test_a_page_in_another_language_has_no_english_text(browser, pseudo, monkeypatch):
    run = pseudo.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    pseudo.service.wait(run, "done")
    page, bare = german(browser, pseudo), set()
    paths = [one for one in PAGES if one != "/docs"]
    for path in (*paths, "/accounts", "/rigs/a/file", "/start/watched", "/start/real", f"/runs/{run}/live", "/nothing",
                 *results(pseudo, run, monkeypatch)):
        page.goto(path)
        page.wait_for_timeout(700)
        page.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")
        for text in page.evaluate(TEXTS):
            if re.search(r"[^\W\d_]{2,}", unmarked(text)):
                bare.add((path, text.strip()))
    page.context.close()
    assert not bare, "\n".join(f"{path}: {text!r}" for path, text in sorted(bare))


@pytest.mark.heavy
@pytest.mark.parametrize("width", [390, 1280])
def test_every_german_page_fits_and_can_be_read(browser, served, monkeypatch, width):
    """Pages are not wider than their window; axe-core, if TDHIL_AXE names its file, finds no serious fault."""
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    page, faults = german(browser, served, width), []
    for path in (*PAGES, *results(served, run, monkeypatch), f"/runs/{run}/live", "/start/watched", "/nothing"):
        page.goto(path)
        page.wait_for_timeout(500)
        page.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")
        assert page.evaluate("document.documentElement.lang") == "de"
        assert page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"), path
        if (axe := os.environ.get("TDHIL_AXE")) and path != "/docs":        # that page is the English one
            page.add_script_tag(path=axe)
            faults += [(path, one["id"], [node["target"] for node in one["nodes"]][:4])
                       for one in page.evaluate("axe.run()")["violations"] if one["impact"] in ("serious", "critical")]
    page.context.close()
    assert faults == []


@pytest.mark.heavy
def test_numbers_have_a_comma_and_a_typed_comma_arrives_as_a_number(browser, served, monkeypatch):
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": PLAN})
    page = german(browser, served)
    page.goto("/start/a")
    page.get_by_label("Toleranz: halbe Breite").fill("2,5")
    page.get_by_text("Simulierte Anlage", exact=True).click()
    page.locator("[name=simulated_torque_scale]").fill("1,05")
    page.get_by_role("button", name="Planen").click()
    page.get_by_role("row", name="erwartetes Intervall von J").get_by_text("±2,1 %").wait_for()
    page.locator("button[value=start]:enabled").wait_for()
    page.get_by_role("button", name="Starten").click()
    page.get_by_text("J = 104,0 (100,0 bis 108,0) kg·m²").wait_for()
    (run,) = served.service.store.ids()
    assert served.service.store.request(run).options == {"tolerance": 0.025, "simulated_torque_scale": 1.05}
    page.get_by_role("button", name="Drehzahlen in rad/s").click()
    page.get_by_role("button", name="Drehzahlen in 1/min").wait_for()
    page.get_by_role("button", name="English").click()               # kept in a cookie, on every page
    page.get_by_text("J = 104.0 (100.0 to 108.0) kg·m²").wait_for()
    page.goto("/runs")
    page.get_by_role("heading", name="Runs").wait_for()
    page.get_by_role("button", name="Speeds in rpm").wait_for()
    page.context.close()


@pytest.mark.heavy
def test_an_error_is_german_or_has_a_german_title_before_its_english_text(browser, served, monkeypatch):
    from drivers import PreflightRefused
    from tdhil.errors import MessageCode

    def refused(what: str, run: Any, asked: Any) -> Any:
        raise PreflightRefused("time: 20 s are too short", next_step="Give --max-time 146s or more",
                               entry=MessageCode.PLAN_NOT_POSSIBLE)

    page = german(browser, served)
    page.goto("/runs/20200101-000000-aaaaaa")
    page.get_by_text("dieser Lauf existiert nicht. Siehe die Liste der Läufe").wait_for()
    monkeypatch.setattr(served.service.supervisor, "work", refused)
    page.goto("/start/a")
    page.locator("[name=max_time_s]").fill("20")
    page.get_by_role("button", name="Planen").click()
    said = page.get_by_role("alert").get_by_text("Keine Bewegung passt in die Grenzen")
    assert "20 s are too short. Give “Längste Dauer der Stufe 5, Minuten” 146s or more" in said.inner_text()
    page.locator("[name=tolerance]").fill("viel")
    page.get_by_role("button", name="Planen").click()
    page.get_by_role("alert").get_by_text("Ein Wert ist nicht verwendbar. Nichts wurde gestartet.").wait_for()
    page.context.close()
