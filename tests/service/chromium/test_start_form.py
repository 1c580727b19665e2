"""Start form and plan in Chromium: errors are at their fields, and nothing starts before it is allowed."""

from __future__ import annotations

import re
import threading
from typing import Any

import pytest

from drivers import PreflightRefused
from tests.service.chromium.pages import IN_CHROMIUM, PLAN, begin

pytestmark = IN_CHROMIUM


@pytest.mark.heavy
def test_from_the_rigs_to_a_result_by_keyboard_alone(page, served, monkeypatch):
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": PLAN})
    page.goto("/")
    page.get_by_role("article", name="Rig a").get_by_role("link", name="Start").focus()
    page.keyboard.press("Enter")
    page.wait_for_url("**/start/a")
    page.get_by_label("Tolerance: half-width").focus()
    page.keyboard.type("2,5")
    page.keyboard.press("Enter")       # the first button makes a plan, so nothing starts by mistake
    page.get_by_role("row", name="expected interval of J").get_by_text("±2.1 %").wait_for()
    assert served.service.store.ids() == []
    page.locator("button[value=start]:enabled").wait_for()
    page.get_by_role("button", name="Start").focus()
    page.keyboard.press("Enter")
    page.get_by_text("J = 104.0 (100.0 to 108.0) kg·m²").wait_for()       # without a click
    assert "/live" not in page.url
    (run,) = served.service.store.ids()
    assert served.service.store.request(run).options == {"tolerance": 0.025}
    page.get_by_role("link", name="The recorded motion").click()
    page.locator("#readout").wait_for()
    page.get_by_role("link", name="To the result").wait_for()             # the record is kept


def test_an_error_names_the_field_and_removes_the_old_plan(page, served, monkeypatch):
    """The terminal names options. The form shows its labels instead and marks the field."""
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


def test_all_wrong_values_of_the_start_form_are_reported_at_once(page, served):
    """Each field is marked and has its own message with labels of the form, without options of the terminal."""
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


def test_all_errors_are_in_the_order_of_the_form_and_the_first_has_the_focus(page, served):
    """The service names a limit last, and two errors of one field. Each wrong field has its reasons as description."""
    page.goto("/start/a")
    page.get_by_text("Simulated rig", exact=True).click()
    page.locator("#motion > summary").click()
    for name, text in (("fault", "no-such-fault, sto@nowhere"), ("amplitude_rad_s", "fast"), ("tolerance", "-5")):
        page.locator(f"[name={name}]").fill(text)
    for button in ("Start", "Plan"):
        page.get_by_role("button", name=button).click()
        page.get_by_role("alert").get_by_text("4 values can't be used").wait_for()
        assert page.evaluate("document.activeElement.name") == "tolerance"
        marked = page.locator("[aria-invalid=true]").all()
        assert [one.get_attribute("name") for one in marked] == ["tolerance", "amplitude_rad_s", "fault"]
        said = [page.locator(", ".join(f'[id="{name}"]' for name in one.get_attribute("aria-describedby").split()))
                .all_inner_texts() for one in marked]
        assert [len(texts) for texts in said] == [1, 2, 1] and all(all(texts) for texts in said)      # with the help
        assert "no fault is called 'no-such-fault'" in said[2][0] and "'nowhere' is no moment" in said[2][0]
        listed = page.locator("#said li strong").all_inner_texts()
        assert listed == [page.locator("label", has=page.locator(f"[name={name}]")).get_attribute("data-label")
                          for name in ("tolerance", "amplitude_rad_s", "fault", "fault")]
        page.get_by_role("heading", name="Limits").click()             # the focus is elsewhere again
    assert served.service.store.ids() == []


def test_before_a_run_in_real_time_the_rate_of_this_computer_is_checked(page, served, monkeypatch):
    """A computer under load is reported before the start; a second Start continues. The default is stepped time."""
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
    page.get_by_text("Request it again to run anyway").wait_for()
    assert (asked, served.service.store.ids()) == (["pace"], [])
    page.locator("button[value=start]:enabled").click()
    page.wait_for_url("**/live")
    (run,) = served.service.store.ids()
    assert served.service.store.request(run).options == {"real_time": True}


def test_a_wait_shows_its_duration_and_the_usual_one(page, served, monkeypatch):
    """A plan takes seconds: the page shows a bar and its time, later the usual time too. Two requests give one plan."""
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
def test_a_plan_of_other_values_is_removed(page, served, monkeypatch):
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": PLAN})
    page.goto("/start/a")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("row", name="expected interval of J").wait_for()
    page.get_by_label("Tolerance: half-width").fill("3")
    page.locator("#plan").wait_for(state="hidden")


@pytest.mark.heavy
def test_a_wrong_time_of_a_rehearsal_starts_no_run(page, served):
    page.goto("/rehearse/a")
    page.get_by_label("Delay after the start").fill("two")
    page.get_by_role("button", name="Rehearse sto", exact=True).click()
    page.locator("#wrong-after").get_by_text("a number of seconds").wait_for()
    assert served.service.store.ids() == []


def test_the_code_is_requested_and_a_wrong_one_reported(page, served):
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


def test_every_point_of_the_checklist_must_be_ticked_before_motion(page, served):
    points = "Before you confirm:\n  [ ] brake released\n  [ ] people clear of the shaft\n"
    run = served.service.supervisor.start_run("real", {"note": "ask", "operator": points}, "local").request.id
    served.service.wait(run, "awaiting_confirmation")
    page.goto(f"/runs/{run}/live")
    move = page.get_by_role("button", name="Move the shaft")
    page.get_by_label("brake released").check()
    assert move.is_disabled()
    page.get_by_label("Six digits").fill("123456")
    page.get_by_label("Six digits").press("Enter")          # no other way
    page.get_by_label("people clear of the shaft").check()
    assert move.is_enabled()
    assert served.service.store.status(run).state.value == "awaiting_confirmation"
    move.click()
    served.service.wait(run, "done")
