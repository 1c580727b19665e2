"""Labels of the form in the texts of a run, and on the page of the calibration."""

from __future__ import annotations

import json

from tdhil.service.run_channel import RunRefused
from tdhil.service.run_state import Told
from tdhil.service.store import write_json
from tests.service.chromium.pages import IN_CHROMIUM, begin, second

pytestmark = IN_CHROMIUM


def test_the_page_of_a_run_and_the_calibration_name_no_option_of_the_terminal(page, served, monkeypatch):
    run = begin(served)
    served.service.supervisor.stop(run, "the test")
    served.service.wait(run, "stopped")
    folder = served.service.store.place(run)
    refused = Told("LimitHit", "time: Give --max-time 146s", "time", "--mode", "Give --max-time 146s", 7, "TDH-501")
    check = {"name": "identity", "wanted": "read", "found": "not read; --profile states x", "outcome": "note",
             "where": "0", "next_step": "Check the unit number (--unit)"}
    write_json(folder / "state.json", json.loads((folder / "state.json").read_bytes()) | {
        "error": refused.__dict__, "preflight": [check], "identity": "A", "safe_action": "quick stop"})
    write_json(folder / "result.json", {
        "verdict": "valid_wide", "inertia_kg_m2": {"value": 104.0, "low_total": 100.0, "high_total": 108.0},
        "reason": "wider than --tolerance", "advice": "add --excitation prbs", "code": "TDH-002",
        "warnings": ["the rate is too high; lower --rate"]})
    page.goto(f"/runs/{run}")
    page.get_by_text("Add “Motion” prbs.").wait_for()
    page.get_by_text("Preflight", exact=True).click()
    text = page.locator("#main").inner_text()
    for said in ("Give “Longest duration of stage 5, minutes” 146s",
                 "Wider than “Tolerance: half-width of the repeatability, ± % of J”.",
                 "lower “Control cycles per second”", "“profile” (rig's file) states x", "“modbus.unit” (rig's file)"):
        assert said in text
    assert "--" not in text
    done = [second(served, run) for _ in range(2)]
    said = "the inertia seems to be given at the other shaft; use --at main. Give --added 55"

    def refuse(what, run, asked):
        raise RunRefused(Told("UsageError", said, said, "", "", 2, "TDH-204"))

    monkeypatch.setattr(served.service.supervisor, "work", refuse)
    page.goto("/calibrate/a")
    for name, which in zip(("without", "with_body"), done, strict=True):
        page.locator(f"[name={name}]").select_option(which)
    page.get_by_label("Inertia of the body, kg·m²").fill("55")
    page.get_by_role("button", name="Calibrate", exact=True).click()
    page.get_by_role("alert").get_by_text("use “At the shaft” main").wait_for()
    assert "Give “Inertia of the body, kg·m²” 55" in page.get_by_role("alert").inner_text()
    assert page.locator("[name=at]").get_attribute("aria-invalid") == "true"
