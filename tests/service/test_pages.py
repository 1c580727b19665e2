"""The pages in Chromium, before a service whose runs are played: what they show, and what they do when nobody answers.

Skipped where there is no Chromium (`TDHIL_CHROMIUM` names one, else the PATH) or no playwright (extra `browser`).
"""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
import threading
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.recording.test_log_tail import write
from tests.service.conftest import Service, wait_for

CHROMIUM = os.environ.get("TDHIL_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.one_worker,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium (apt-get install chromium, or TDHIL_CHROMIUM=PATH)"),
    pytest.mark.skipif(find_spec("playwright") is None, reason="no playwright: pip install -e '.[browser]'"),
]
HOSTILE = "<script>window.pwned=1</script><b id=x>bold</b>"
PAGES = ("/", "/start/a", "/rigs/a", "/runs", "/audit")
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
    context.set_default_timeout(20_000)
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


def test_from_the_rigs_to_a_result_by_keyboard_alone(page, served, monkeypatch):
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": PLAN})
    page.goto("/")
    page.get_by_role("article", name="Rig a").get_by_role("link", name="Start").focus()
    page.keyboard.press("Enter")
    page.wait_for_url("**/start/a")
    page.get_by_label("How tight").focus()
    page.keyboard.type("2.5")
    page.keyboard.press("Enter")       # as the first button would have it: a plan, and nothing begins by mistake
    page.get_by_role("row", name="expected interval of J").get_by_text("±2.1 %").wait_for()
    assert served.service.store.ids() == []
    page.locator("button[value=start]:enabled").wait_for()
    page.get_by_role("button", name="Start").focus()
    page.keyboard.press("Enter")
    page.wait_for_url("**/live")
    page.get_by_role("link", name="To the result").click()
    page.get_by_text("J = 104 (100 to 108) kg·m²").wait_for()
    (run,) = served.service.store.ids()
    assert served.service.store.request(run).options == {"tolerance": 0.025}


def test_a_stop_says_when_it_was_asked_seen_and_at_rest(page, served):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.get_by_text("Not an emergency stop.").wait_for()
    button = page.get_by_role("button", name="Stop", exact=True)
    button.focus()
    page.keyboard.press("Enter")
    page.get_by_text("seen by the drive").wait_for()
    served.service.wait(run, "stopped")
    page.get_by_text("stopped, at rest").wait_for()
    assert not page.get_by_text("NOT DELIVERED").is_visible()
    assert button.is_disabled()


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
    page.get_by_text("seen by the drive").wait_for()


def test_the_code_is_asked_for_and_a_wrong_one_said(page, served):
    run = begin(served, "ask", "real")
    page.goto(f"/runs/{run}/live")
    page.get_by_text("this moves").wait_for()
    field = page.get_by_label("The six digits")
    field.fill("000000")
    field.press("Enter")
    page.get_by_text("that isn't the code").wait_for()
    field.fill("123 456")
    field.press("Enter")
    served.service.wait(run, "done")


def watched_run(page: Any, served: Served) -> str:
    """It moves, and this page holds its lease."""
    run = begin(served, "ask", "rehearsed")
    page.goto(f"/runs/{run}/live")
    page.get_by_label("The six digits").fill("123 456")
    page.get_by_role("button", name="Let it move").click()
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


@pytest.mark.parametrize(("way", "how"), [("hidden", "hidden"), ("closed", "closed"), ("offline", "silent")])
def test_a_watched_run_brakes_once_its_page_is_gone(page, served, way, how):
    run = watched_run(page, served)
    if way == "closed":
        other = page.context.new_page()
        other.goto(f"/runs/{run}/live")
        other.get_by_text("watches this run on another page").wait_for()
        page.close()
        other.get_by_text("Nobody watched this run: it was braked").wait_for()     # to look is not to hold
    elif way == "offline":
        page.context.set_offline(True)
        page.get_by_text("The run hears nothing of this page").wait_for()
        page.get_by_text("It brakes once nobody watches it").wait_for()
    else:
        page.evaluate(HIDE, True)
    assert lost(served, run) == how


def test_a_watched_run_goes_on_when_its_page_is_loaded_anew_or_hidden_for_a_moment(page, served):
    run = watched_run(page, served)
    page.reload()
    page.get_by_text("You watch this run").wait_for()
    page.evaluate(HIDE, True)
    page.wait_for_timeout(1000)
    page.evaluate(HIDE, False)
    page.wait_for_timeout(3000)            # longer than a lease, as these runs have it
    status = served.service.store.status(run)
    assert (status.state, status.watch.gone) == ("moving", None)
    copy = page.context.new_page()         # a tab that is copied has what the first had kept: the later one holds
    copy.goto("/")
    copy.evaluate("kept => sessionStorage.setItem(...kept)", page.evaluate("Object.entries(sessionStorage)[0]"))
    copy.goto(f"/runs/{run}/live")
    copy.get_by_text("You watch this run").wait_for()
    page.get_by_text("watches this run on another page").wait_for()
    copy.close()
    assert lost(served, run) == "closed"


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
    page.get_by_text("asked ").wait_for()
    page.get_by_text("seen by the drive").wait_for()
    assert not page.get_by_text("NOT DELIVERED").is_visible()


def test_what_a_rig_is_called_is_text_on_every_page(page, served):
    run = served.service.supervisor.start_run("hostile", {"note": "done", "operator": HOSTILE}, "local").request.id
    served.service.wait(run, "done")
    for path in (*PAGES, "/start/hostile", f"/runs/{run}", f"/runs/{run}/live", f"/runs/{HOSTILE}"):
        page.goto(path)
        page.wait_for_timeout(600)
        assert page.evaluate("window.pwned === undefined"), path
        assert page.locator("b#x").count() == 0, path
    page.goto("/")
    page.get_by_text(HOSTILE).wait_for()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_page_fits_a_phone_and_can_be_read(browser, served, scheme):
    """No page is wider than 390 px; axe-core, where TDHIL_AXE names its file, finds no serious fault."""
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    context = browser.new_context(base_url=served.url, viewport={"width": 390, "height": 800}, color_scheme=scheme,
                                  bypass_csp=True)
    page, faults = context.new_page(), []
    for path in (*PAGES, f"/runs/{run}", f"/runs/{run}/live", "/nothing"):
        page.goto(path)
        page.wait_for_timeout(500)
        wide = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        assert wide <= 0, (path, wide)
        if axe := os.environ.get("TDHIL_AXE"):
            page.add_script_tag(path=axe)
            found = page.evaluate("axe.run()")
            faults += [(path, one["id"], [node["target"] for node in one["nodes"]][:4])
                       for one in found["violations"] if one["impact"] in ("serious", "critical")]
    context.close()
    assert faults == []
