"""Run in Chromium: content of its page, stops, and the loss of its page or of the service."""

from __future__ import annotations

import json
import os
import re
import signal
from dataclasses import replace
from typing import Any

import pytest

from tdhil.service.run_state import State, Stop, now, way_to
from tdhil.service.store import StoredRequest, write_json
from tdhil.session import hold
from tests.recording.test_log_tail import write
from tests.service.chromium.pages import IN_CHROMIUM, Served, begin, judge, results
from tests.service.conftest import wait_for

pytestmark = IN_CHROMIUM
HIDE = """hidden => {
    const get = () => hidden ? "hidden" : "visible";
    Object.defineProperty(document, "visibilityState", { configurable: true, get });
    document.dispatchEvent(new Event("visibilitychange"));
}"""


def test_a_requested_stop_is_no_alarm(page, served):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.get_by_role("button", name="Stop", exact=True).click()
    page.wait_for_url(f"**/runs/{run}")                # the page changes to the result
    page.get_by_text("stopped, at standstill").wait_for()
    page.get_by_role("list", name="Stop").get_by_text("drive replied").wait_for()
    assert page.locator("#result .alarm").count() == 0


@pytest.mark.parametrize(("what", "state"), [
    ("identify", "failed"), ("ask", "refused"), ("brake", "stop_not_confirmed"),
])
def test_a_page_changes_to_the_result_once_the_shaft_is_at_standstill(page, served, what, state):
    """Also after a failure and a refusal. If standstill is not confirmed, the live page with its Stop stays. Else the
    live page has no Stop any more.
    """
    run = begin(served, what) if what != "identify" else served.service.supervisor.start_run(
        "a", {"note": what}, "local").request.id
    folder = served.service.store.place(run)
    page.goto(f"/runs/{run}/live")
    page.locator("#state", has_text={"identify": "identifying", "ask": "waiting", "brake": "moving"}[what]).wait_for()
    path = folder / "state.json"
    stored = json.loads(path.read_bytes())
    write_json(path, {**stored, "state": state, "history": [*stored["history"], {
        "state": state, "at": stored["history"][-1]["at"], "stage": None}]})
    if what == "brake":
        page.locator("#state", has_text="STOP NOT CONFIRMED").wait_for()
        page.wait_for_timeout(500)
        assert page.url.endswith("/live") and page.get_by_role("link", name="To the result").is_visible()
        asked: list[str] = []

        def answered(route: Any) -> None:
            asked.append(route.request.url)
            route.fulfill(json={"runs": [], "said": "tdhil stop did NOT confirm standstill", "exit_code": 8})

        page.route("**/rigs/a/stop", answered)         # the run is over, so the Stop is that of its rig
        page.get_by_role("button", name="Stop", exact=True).click()
        page.get_by_text("tdhil stop did NOT confirm standstill. Use the hard-wired emergency stop").wait_for()
        assert len(asked) == 1
    else:
        page.wait_for_url(f"**/runs/{run}")
        page.goto(f"/runs/{run}/live")                 # opened again: there is no Stop
        page.get_by_role("link", name="To the result").wait_for()
        assert page.get_by_role("button", name="Stop", exact=True).is_hidden()
    os.kill(stored["pid"], signal.SIGKILL)             # it did not end: only its file states this


def test_a_sign_off_without_words_is_refused_at_its_field(page, served):
    run = served.service.supervisor.start_run("a", {"note": "unseen"}, "local").request.id
    served.service.wait(run, "stop_not_confirmed")
    page.goto(f"/runs/{run}")
    saw = page.get_by_label("What you saw")
    saw.fill("   ")
    page.get_by_role("button", name="Sign off").click()
    page.locator("#sign #wrong-note").wait_for()
    assert saw.get_attribute("aria-invalid") == "true" and not page.locator("#away").is_visible()
    saw.fill("at standstill, key out")
    page.get_by_role("button", name="Sign off").click()
    page.get_by_text("Signed off by local").wait_for()


def test_a_result_shows_j_then_a_picture_then_the_budget_and_its_events_folded(page, served, monkeypatch):
    run = begin(served)
    served.service.supervisor.stop(run, "local")
    served.service.wait(run, "stopped")
    results(served, run, monkeypatch)
    judge(served, run)
    page.goto(f"/runs/{run}")
    places = [page.locator(one).first for one in (
        "#result .figure", "#picture figure", "#budget meter", "#accepted table", "#log-events", "#record")]
    for one in places:
        one.wait_for()
    tops = [one.evaluate("one => one.getBoundingClientRect().top + scrollY") for one in places]
    assert tops == sorted(tops)
    assert not page.locator("#log-events li").first.is_visible()
    page.locator("#log-events summary").click()
    page.locator("#log-events li").first.wait_for()


def test_a_stop_shows_the_times_of_request_receipt_and_standstill(page, served):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.get_by_text("Not an emergency stop.").wait_for()
    button = page.get_by_role("button", name="Stop", exact=True)
    button.focus()
    page.keyboard.press("Enter")
    page.get_by_text("drive replied").wait_for()
    served.service.wait(run, "stopped")
    page.get_by_text("stopped, at standstill").wait_for()
    page.locator("li", has_text="stop requested ").wait_for()          # the page of the result shows the request
    assert not page.get_by_text("NOT DELIVERED").is_visible()


@pytest.mark.parametrize(("state", "moved", "confirmed", "text"), [
    ("stopped", False, None, "stopped before motion"), ("failed", False, None, "failed before motion"),
    ("failed", True, None, "failed"), ("failed", True, True, "failed, at standstill"),
])
def test_only_a_confirmed_standstill_is_shown(page, served, state, moved, confirmed, text):
    """A drive that tdhil never contacted was shown as "at standstill"."""
    store = served.service.store
    run = store.new_id()
    status = store.begin(StoredRequest(run, "a", "a.yaml", "0" * 64, {}, "anna", now(), True, "never"))
    status = status.to(State.PREFLIGHT, now())
    if moved:
        status = status.to(State.MOVING, now())
    store.save(replace(way_to(status, State(state), now(), exit_code=5), stop=Stop(confirmed=confirmed)))
    page.goto(f"/runs/{run}")
    page.locator("#result .now", has_text=state).wait_for()
    assert page.locator("#result .now").inner_text() == text


def test_a_stop_after_standstill_is_not_shown_as_its_cause(page, served):
    run = served.service.supervisor.start_run("a", {"note": "identify"}, "local").request.id
    page.goto(f"/runs/{run}/live")
    page.locator("#state", has_text="identifying").wait_for()
    page.route("**/stop", lambda route: route.fulfill(json={**served.service.store.status(run).plain()}))
    page.get_by_role("button", name="Stop", exact=True).click()
    page.get_by_text("The shaft has been at standstill since").wait_for()
    page.wait_for_timeout(2500)
    assert not page.get_by_text("stop requested").is_visible() and not page.get_by_text("NOT DELIVERED").is_visible()
    served.service.supervisor.stop(run, "local")


def test_a_late_reply_does_not_revert_a_newer_one(page, served):
    run = begin(served, "brake")
    page.goto(f"/runs/{run}/live")
    page.locator("#state", has_text="moving").wait_for()

    def late(route: Any) -> None:
        answer = route.fetch()
        page.locator("#state", has_text="stopping").wait_for()
        route.fulfill(response=answer)

    page.route("**/stop", late)
    with page.expect_response("**/stop"):
        page.get_by_role("button", name="Stop", exact=True).click()
    page.wait_for_timeout(300)
    assert page.locator("#state", has_text="stopping").is_visible()
    (served.service.store.place(run) / "rest").touch()
    page.get_by_text("stopped, at standstill").wait_for()


def test_a_drive_in_use_by_a_terminal_is_stopped_from_its_card(page, served, monkeypatch):
    told = [(True, "tdhil stop confirmed standstill"), (False, "tdhil stop did NOT confirm standstill")]
    monkeypatch.setattr("tdhil.service.supervisor._stop_seen", lambda command: told.pop(0))
    with hold(served.service.supervisor.rigs.get("real").address):
        page.goto("/")
        stop = page.get_by_role("article", name="real", exact=True).get_by_role("button", name="Stop")
        stop.click()
        page.get_by_text("real: tdhil stop confirmed standstill").wait_for()
        stop.click()
        page.get_by_text("real: tdhil stop did NOT confirm standstill. Use the hard-wired emergency stop").wait_for()


@pytest.mark.parametrize("way", ["offline", "mute"])
def test_a_stop_without_a_reply_is_reported(page, served, way):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.locator("#state", has_text="moving").wait_for()
    if way == "offline":
        page.context.set_offline(True)
    else:
        page.route("**/stop", lambda route: None)           # neither a reply nor an error
    page.get_by_role("button", name="Stop", exact=True).click()
    page.get_by_text("NOT DELIVERED: use the hard-wired emergency stop").wait_for()
    if way == "offline":
        page.get_by_text("requesting …").wait_for(state="hidden")
    assert served.service.store.status(run).stop.asked is None


@pytest.mark.heavy
def test_the_stop_of_a_run_without_its_folder_states_that_it_was_signalled(page, served, tmp_path):
    run = begin(served)
    page.goto(f"/runs/{run}/live")
    page.locator("#state", has_text="moving").wait_for()
    served.service.store.place(run).rename(tmp_path / "moved")
    page.get_by_role("button", name="Stop", exact=True).click()
    page.get_by_text("SIGTERM was sent to its process").wait_for()
    assert not page.get_by_text("NOT DELIVERED").is_visible()
    live = served.service.supervisor.live
    wait_for("the end of the run", lambda: run not in live())


def test_the_time_left_of_a_simulated_run_is_in_real_time(page, served):
    """Ten seconds of a stepped run take one second, so 60 s of it take 6 s."""
    run, sockets = begin(served), []
    status = json.loads((served.service.store.place(run) / "state.json").read_bytes()) | {
        "simulated": True, "stage": "acquire", "expected_s": {"acquire": 100.0}}

    def tell(time_s: float, kind: str = "news") -> None:
        sockets[-1].send(json.dumps({"type": kind, "age_s": 0.1, "time_s": time_s, "status": status}))

    def take(socket: Any) -> None:              # playwright marks its handler, which a method of a list does not allow
        sockets.append(socket)

    page.clock.install()
    page.route_web_socket("**/live/*", take)
    page.goto(f"/runs/{run}/live")
    wait_for("the page", lambda: page.evaluate("1") and sockets)
    tell(0.0, "hello")
    page.get_by_text("moving").first.wait_for()
    page.clock.run_for(1000)
    assert page.locator("#left").inner_text() == ""             # the pace is not known yet
    page.clock.run_for(3000)
    tell(40.0)
    page.clock.run_for(500)
    left = page.locator("#left")
    left.get_by_text("about").wait_for()
    assert 5.0 <= float(re.search(r"([\d.]+) s", left.inner_text())[1]) <= 8.0


def test_values_turn_grey_without_new_data(page, served):
    run = begin(served)
    folder = served.service.store.place(run)
    write(folder / "other.mcap")
    (folder / "other.mcap").replace(folder / "run.mcap")
    page.goto(f"/runs/{run}/live")
    page.locator("#speed", has_text="19.").wait_for()
    # The log is old and the run is in motion: only the values are grey.
    page.locator("body.stale").wait_for()
    assert not page.locator("#away").is_visible()
    served.end()
    page.get_by_text("No connection to tdhil serve").wait_for()


def test_with_six_tabs_a_stop_is_still_received(page, served):
    run = begin(served)
    for one in (*(page.context.new_page() for _ in range(5)), page):
        one.goto(f"/runs/{run}/live")
    page.get_by_role("button", name="Stop", exact=True).click()
    served.service.wait(run, "stopped")
    page.get_by_text("drive replied").wait_for()


def watched_run(page: Any, served: Served) -> str:
    """Return a run in motion whose lease this page holds."""
    run = begin(served, "ask", "rehearsed")
    page.goto(f"/runs/{run}/live")
    page.get_by_label("Six digits").fill("123 456")
    page.get_by_role("button", name="Move the shaft").click()
    page.get_by_text("You watch this run").wait_for()
    return run


def lost(served: Served, run: str) -> Any:
    """Return how the page of the run was lost, once the run brakes because of it."""
    served.service.wait(run, "stopped")
    watch = served.service.store.status(run).watch
    assert watch.lost is not None
    return watch.how


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("way", "how"), [("hidden", "hidden"), ("closed", "closed"), ("offline", "silent")])
def test_a_watched_run_brakes_once_its_page_is_lost(page, served, way, how):
    run = watched_run(page, served)
    if way == "closed":
        other = page.context.new_page()
        other.goto(f"/runs/{run}/live")
        other.get_by_text("watches this run on another page").wait_for()
        page.close()
        other.get_by_text("This run was not watched: braking began").wait_for()     # a second page has no lease
    elif way == "offline":
        page.context.set_offline(True)
        page.get_by_text("The run receives nothing from this page").wait_for()
        page.get_by_text("If this page watches the run, the run brakes 5 s after its last message").wait_for()
    else:
        page.evaluate(HIDE, True)
    assert lost(served, run) == how


@pytest.mark.heavy
def test_a_watched_run_continues_if_its_page_is_reloaded_or_hidden_briefly(page, served):
    run = watched_run(page, served)
    page.reload()
    page.get_by_text("You watch this run").wait_for()
    page.evaluate(HIDE, True)
    page.wait_for_timeout(1000)
    page.evaluate(HIDE, False)
    page.wait_for_timeout(5500)            # longer than a lease
    status = served.service.store.status
    wait_for("its page", lambda: status(run).watch.gone is None or status(run).state != "moving")      # slightly late
    assert status(run).state == "moving"
    copy = page.context.new_page()         # a copied tab has the stored lease of the first one: the later tab holds it
    copy.goto("/")
    copy.evaluate("kept => sessionStorage.setItem(...kept)", page.evaluate("Object.entries(sessionStorage)[0]"))
    copy.goto(f"/runs/{run}/live")
    copy.get_by_text("You watch this run").wait_for()
    page.get_by_text("watches this run on another page").wait_for()
    copy.close()
    assert lost(served, run) == "closed"


@pytest.mark.heavy
def test_a_run_that_receives_no_stop_is_not_reported_as_stopped(page, served):
    """Its process is frozen, so SIGTERM has no effect."""
    run = begin(served, "frozen")
    page.goto(f"/runs/{run}/live")
    with page.expect_response("**/stop") as answered:
        page.get_by_role("button", name="Stop", exact=True).click()
    assert answered.value.ok
    page.get_by_text("NOT DELIVERED: use the hard-wired emergency stop").wait_for()
    page.wait_for_timeout(500)
    assert page.get_by_text("NOT DELIVERED: use the hard-wired emergency stop").is_visible()
    os.kill(served.service.store.status(run).pid, signal.SIGKILL)
    served.service.supervisor.start()
    served.service.wait(run, "interrupted")


def test_a_page_that_is_reloaded_while_a_run_brakes_shows_its_stop(page, served):
    run = begin(served, "brake")               # it continues to brake; a stopped run would show its result
    page.goto(f"/runs/{run}/live")
    page.get_by_role("button", name="Stop", exact=True).click()
    page.reload()
    page.locator("li", has_text="requested ").wait_for()
    page.get_by_text("drive replied").wait_for()
    assert not page.get_by_text("NOT DELIVERED").is_visible()


@pytest.mark.heavy
def test_a_page_reports_a_missing_service(page, served, monkeypatch):
    run = served.service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    served.service.wait(run, "done")
    results(served, run, monkeypatch)
    for path, shown in (("/runs", "104"), ("/rigs/a", "inertia, kg·m²"), ("/fleets/0123456789ab", "104")):
        page.goto(path)
        page.get_by_text(shown).first.wait_for()
        page.context.set_offline(True)
        page.get_by_text("No connection to tdhil serve: the values are old").wait_for()
        assert page.evaluate("document.body.classList.contains('stale')")
        page.context.set_offline(False)
        page.locator("body:not(.stale)").wait_for()
