"""Fields of the motion on the start form in Chromium: wrong values are marked at once, speeds follow the unit."""

from __future__ import annotations

from typing import Any

import pytest

from tests.service.chromium.pages import IN_CHROMIUM, PLAN

pytestmark = IN_CHROMIUM


def opened(page: Any, path: str = "/start/a") -> Any:
    page.goto(path)
    page.locator("#motion > summary").click()
    return page


def test_wrong_values_of_the_motion_are_marked_at_once_and_stay_typed(page, served):
    opened(page)
    typed = {"amplitude_rad_s": "fast", "periods": "many", "confidence": "20"}
    for name, text in typed.items():
        page.locator(f"[name={name}]").fill(text)
    page.locator("#motion > summary").click()             # closed: an error opens it
    page.locator("[name=offset_rad_s]").wait_for(state="hidden")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("alert").get_by_text("3 values can't be used").wait_for()
    marked = page.locator("[aria-invalid=true]").all()
    assert sorted(one.get_attribute("name") for one in marked) == sorted(typed)
    assert all(one.is_visible() for one in marked)
    assert {name: page.locator(f"[name={name}]").input_value() for name in typed} == typed
    page.locator("#wrong-confidence").get_by_text("must be at least 50 % and below 100 %, not 20 %").wait_for()
    for name in typed:
        page.locator(f"[name={name}]").fill("")
    page.get_by_role("button", name="Start").click()
    page.wait_for_url("**/runs/**")
    (run,) = served.service.store.ids()
    assert served.service.store.request(run).options == {}


def test_the_plan_is_of_the_typed_motion_and_a_refusal_marks_its_fields(page, served, monkeypatch):
    from drivers import PreflightRefused

    asked = []

    def plan(what: str, run: Any, wanted: Any) -> Any:
        asked.append(wanted["options"])
        if len(asked) > 1:
            raise PreflightRefused("the speed leaves its window", next_step="Lower --amplitude or --offset")
        return {"document": PLAN}

    monkeypatch.setattr(served.service.supervisor, "work", plan)
    opened(page)
    for name, text in (("amplitude_rad_s", "1,5"), ("offset_rad_s", "40rpm"), ("periods", "6")):
        page.locator(f"[name={name}]").fill(text)
    page.locator("[name=mode]").select_option("speed")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("row", name="expected interval of J").wait_for()
    (options,) = asked
    assert options == {"amplitude_rad_s": 1.5, "offset_rad_s": pytest.approx(4.18879), "periods": 6, "mode": "speed"}
    page.locator("[name=periods]").fill("7")
    page.locator("#motion > summary").click()
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("alert").get_by_text("Lower “Amplitude of the speed” or “Mean speed”").wait_for()
    marked = page.locator("[aria-invalid=true]").all()
    assert sorted(one.get_attribute("name") for one in marked) == ["amplitude_rad_s", "offset_rad_s"]
    assert all(one.is_visible() for one in marked)


@pytest.mark.heavy
def test_a_typed_speed_follows_the_unit_of_the_page(page, served):
    """A number without a unit is in the unit beside its label. The switch changes both, so the speed stays the same."""
    opened(page)
    field = page.locator("[name=offset_rad_s]")
    field.fill("4")
    page.locator("[name=amplitude_rad_s]").fill("1.5 rad/s")
    page.locator("#speed-unit").click()
    assert field.input_value() == "38.1972"
    assert page.locator("[name=amplitude_rad_s]").input_value() == "1.5 rad/s"
    page.locator("label", has=field).get_by_text("rpm", exact=True).wait_for()
    page.get_by_role("button", name="Start").click()
    page.wait_for_url("**/runs/**")
    (run,) = served.service.store.ids()
    options = served.service.store.request(run).options
    assert options == {"offset_rad_s": pytest.approx(4.0, rel=1e-5), "amplitude_rad_s": 1.5}


@pytest.mark.heavy
def test_the_fields_fit_a_telephone(page, served):
    page.set_viewport_size({"width": 390, "height": 844})
    opened(page)
    wide = page.evaluate("document.documentElement.scrollWidth - innerWidth")
    assert wide <= 0
    for one in page.locator("#motion .field").all():
        box, about = one.locator("input, select").bounding_box(), one.locator("small").bounding_box()
        assert about["y"] >= box["y"] + box["height"]             # the help covers no field
        assert box["x"] + box["width"] <= 390
