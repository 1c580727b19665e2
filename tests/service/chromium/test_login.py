"""Login, accounts, and a page whose login ends, in Chromium over TLS: phone width, dark, by keyboard."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.service.chromium.pages import HOSTILE, IN_CHROMIUM, Served
from tests.service.conftest import Service
from tests.service.test_access import PASSWORD, cheap, people  # noqa: F401

pytestmark = IN_CHROMIUM


@pytest.fixture
def served(tmp_path: Path, rigs: Path, people: None, tls: tuple[Path, Path]) -> Iterator[Served]:  # noqa: F811
    service = Service(tmp_path / "data", rigs, login=True)
    found = Served(service, *tls)
    yield found
    for run in service.supervisor.live():
        service.supervisor.stop(run, "end of the test")
    found.end()


@pytest.fixture
def page(browser: Any, served: Served) -> Iterator[Any]:
    context = browser.new_context(base_url=served.url, ignore_https_errors=True, color_scheme="dark",
                                  viewport={"width": 390, "height": 800}, bypass_csp=bool(os.environ.get("TDHIL_AXE")))
    context.set_default_timeout(60_000)
    found = context.new_page()
    trouble: list[str] = []
    found.on("pageerror", lambda error: trouble.append(str(error)))
    found.on("console", lambda said: trouble.append(said.text) if "Content Security" in said.text else None)
    yield found
    context.close()
    assert trouble == []


def log_in(page: Any, name: str, password: str = PASSWORD) -> None:
    """Log in by keyboard. The field of the name has the focus once the page is ready."""
    page.locator("input[name=name]:focus").wait_for()
    page.keyboard.type(name)
    page.keyboard.press("Tab")
    page.keyboard.type(password)
    page.keyboard.press("Enter")


def fits(page: Any) -> None:
    assert page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"), page.url
    if axe := os.environ.get("TDHIL_AXE"):
        page.add_script_tag(path=axe)
        assert [one["id"] for one in page.evaluate("axe.run()")["violations"]
                if one["impact"] in ("serious", "critical")] == []


@pytest.mark.heavy
def test_from_the_login_to_a_run_and_out_again(page, served):
    page.goto("/start/a")
    page.wait_for_url("**/login?next=%2Fstart%2Fa")
    fits(page)
    log_in(page, "operator", "not the password")
    page.get_by_text("name or password is wrong").wait_for()
    page.get_by_label("Password").fill(PASSWORD)
    page.keyboard.press("Enter")
    page.wait_for_url("**/start/a")
    page.locator("input[name=note]").fill("hold")
    page.get_by_role("button", name="Start").click()
    page.wait_for_url("**/live")
    (run,) = served.service.store.ids()
    served.service.wait(run, "moving")
    page.get_by_role("button", name="Stop", exact=True).click()
    served.service.wait(run, "stopped")
    assert served.service.store.request(run).asked_by == served.service.store.status(run).stop.by == "operator"
    page.wait_for_url(f"**/runs/{run}")                # the page changes to the result
    fits(page)
    assert page.get_by_role("link", name="Audit").count() == 0
    page.goto("/")
    page.get_by_role("button", name="Log out").click()
    page.wait_for_url("**/login")
    page.goto("/")
    page.wait_for_url("**/login?next=%2F")


def test_a_page_whose_login_has_ended_reports_it_and_can_still_stop(page, served):
    run = served.service.supervisor.start_run("a", {"note": "hold"}, "operator").request.id
    served.service.wait(run, "moving")
    page.goto(f"/runs/{run}/live")
    log_in(page, "viewer")
    page.locator("#state", has_text="moving").wait_for()
    later = served.service.access._clock() + 13 * 3600.0
    served.service.access._clock = lambda: later
    page.get_by_text("Your login has ended").wait_for()
    page.get_by_role("button", name="Stop", exact=True).click()
    served.service.wait(run, "stopped")
    assert served.service.store.status(run).stop.by == "viewer"
    assert not page.get_by_text("NOT DELIVERED").is_visible()
    page.get_by_role("link", name="Log in").click()
    page.wait_for_url("**/login?next=**")


@pytest.mark.heavy
def test_a_page_from_before_a_new_login_can_still_stop(page, served):
    run = served.service.supervisor.start_run("a", {"note": "hold"}, "operator").request.id
    served.service.wait(run, "moving")
    page.goto(f"/runs/{run}/live")
    log_in(page, "viewer")
    page.locator("#state", has_text="moving").wait_for()
    other = page.context.new_page()
    other.goto("/")
    other.get_by_role("button", name="Log out").click()
    log_in(other, "engineer")
    other.get_by_role("heading", name="Rigs").wait_for()
    page.get_by_role("button", name="Stop", exact=True).click()
    served.service.wait(run, "stopped")
    assert served.service.store.status(run).stop.by == "engineer"


def test_a_page_without_its_script_sends_nothing(browser, served):
    context = browser.new_context(base_url=served.url, ignore_https_errors=True)
    page = context.new_page()
    page.route("**/static/app.js?*", lambda route: route.abort())
    page.goto("/login")
    page.keyboard.type("operator\n")
    assert page.locator("main").evaluate("one => one.inert && !one.contains(document.activeElement)")
    page.evaluate("document.forms.login.elements.password.value = 'secret'; document.forms.login.submit()")
    page.wait_for_timeout(300)
    assert page.url == f"{served.url}/login"
    context.close()


def test_an_admin_s_accounts(page, served):
    page.goto("/accounts")
    log_in(page, "admin")
    page.get_by_role("heading", name="Users").wait_for()
    form = page.locator("#add-user")
    form.get_by_label("Name").fill(HOSTILE)
    form.get_by_label("First password").fill(PASSWORD)
    form.get_by_role("button").click()
    form.locator("label", has=page.locator("[name=name]")).get_by_text("must be 1 to 32").wait_for()
    assert form.get_by_label("Name").get_attribute("aria-invalid") == "true"
    form.get_by_label("Name").fill("anna")
    form.get_by_label("First password").fill(PASSWORD)
    form.get_by_role("button").click()
    page.get_by_role("button", name="Remove anna").wait_for()
    form = page.locator("#add-token")
    form.get_by_label("Name").fill("meter")
    form.get_by_role("button").click()
    token = page.locator("#token code").text_content()
    assert served.service.access.accounts.known.of_token(token).name == "meter"
    fits(page)
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Remove anna").click()
    page.get_by_role("button", name="Remove anna").wait_for(state="detached")
    assert "anna" not in served.service.access.accounts.known.users
    assert page.evaluate("window.pwned === undefined")


@pytest.mark.heavy
def test_an_engineer_edits_limits(page, served, rigs):
    page.goto("/")
    log_in(page, "engineer")
    page.get_by_role("article", name="Rig a").get_by_role("link", name="File").click()
    field = page.get_by_label("rig.yaml")
    page.get_by_text("limits").first.wait_for()
    before = field.input_value()
    assert before == (rigs / "a.yaml").read_text()
    field.fill(before + "node: 3\n")
    page.get_by_role("button", name="Save").click()
    page.get_by_text("can't be changed over HTTP").wait_for()
    field.fill(before + "rate_hz: 50\n")
    page.get_by_role("button", name="Save").click()
    page.get_by_text("Saved.").wait_for()
    assert (rigs / "a.yaml").read_text() == before + "rate_hz: 50\n"
    fits(page)
