"""Service on its own port, its pages, and a run whose results contain everything that a page can show."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import threading
from dataclasses import asdict
from html import escape
from importlib.util import find_spec
from pathlib import Path

import pytest

from tdhil.service.server import _listen
from tdhil.service.store import write_json
from tests.recording.test_log_tail import write
from tests.service.conftest import Service, wait_for

CHROMIUM = os.environ.get("TDHIL_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
IN_CHROMIUM = [
    pytest.mark.browser,
    pytest.mark.real_time,         # a run brakes after five seconds of silence of its page
    pytest.mark.one_worker,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium (apt-get install chromium, or TDHIL_CHROMIUM=PATH)"),
    pytest.mark.skipif(find_spec("playwright") is None, reason="no playwright: pip install -e '.[browser]'"),
]
"""Marks of every test file in this folder."""
HOSTILE = "<script>window.pwned=1</script><b id=x>bold</b>"
PAGES = ("/", "/new-rig", "/start/a", "/calibrate/a", "/rehearse/a", "/rigs/a", "/runs", "/upload", "/fleets", "/audit",
         "/docs", "/letterhead", "/rigs/a/file", "/start/watched", "/start/real")
TRACE = "Zeit;Drehzahl soll;Drehzahl ist;Drehmoment\nms;U/min;U/min;%\n" + "".join(
    f"{10 * k};40,0;{40 + k % 7},5;{20 + k % 5},25\n" for k in range(400))
PLAN = {
    "excitation": "multisine", "mode": "torque", "duration_s": 100.0, "expected_half_width": 0.021, "stopping": None,
    "speed_rad_s": {"min": 1.0, "max": 5.0}, "torque_nm": {"min": -10.0, "max": 50.0},
    "limits": {"speed_min_rad_s": 0.5, "speed_max_rad_s": 10.0, "torque_nm": 400.0},
}


class Served:
    """Web server of one service on its own port, in a thread that can be ended."""

    def __init__(self, service: Service, cert: Path | None = None, key: Path | None = None) -> None:
        import uvicorn

        self.service = service
        listening = _listen("127.0.0.1", 0)
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


def begin(served: Served, what: str = "hold", rig: str = "a") -> str:
    run = served.service.supervisor.start_run(rig, {"note": what}, "local").request.id
    served.service.wait(run, "awaiting_confirmation" if what == "ask" else "moving")
    return run


def estimate(value: float, share: float = 0.01) -> dict[str, float]:
    return {"value": value, "low": value * (1 - share), "high": value * (1 + share)}


def results(served: Served, run: str, monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    """Return pages of results with every possible part, with hostile names and texts."""
    from tdhil.fleet import FleetRow
    from tdhil.fleet.table import write_table

    store = served.service.store
    folder = store.place(run)
    inertia = {**estimate(104.0), "low_total": 100.0, "high_total": 108.0, "half_width_total_rel": 0.04,
               "repeatability_rel": 0.01, "confidence": 0.9}
    write_json(folder / "result.json", {
        "verdict": "valid", "inertia_kg_m2": inertia, "reason": HOSTILE, "advice": HOSTILE,
        "calibration_advised": True, "model": "rigid+lags",
        "warnings": [HOSTILE, "speed was quantised"], "viscous_nm_s_rad": estimate(8.0), "speed_lag_s": estimate(0.4),
        "budget": [{"source": "noise", "half_width_kg_m2": 0.2, "note": HOSTILE}],
        "second_opinions": [{"route": HOSTILE, "inertia_kg_m2": estimate(103.0), "agrees": True, "note": ""}],
        "friction_curve": [{"speed_rad_s": speed, "torque_nm": estimate(60.0 + 8.0 * speed)} for speed in (2.0, 5.0)],
    })
    svg = "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 9 9'><path d='M0 0L9 9' stroke='red'/></svg>"
    (folder / "report.html").write_text(
        f"<h2>Friction over speed</h2><figure>{svg}<figcaption>{escape(HOSTILE)} no lag touches it</figcaption>")
    row = FleetRow(f"runs/{run}/run.mcap", "valid", rig=HOSTILE, date="2026-05-01T12:00:00", inertia_kg_m2=104.0,
                   inertia_low_kg_m2=103.0, inertia_high_kg_m2=105.0, inertia_low_total_kg_m2=100.0,
                   inertia_high_total_kg_m2=108.0, simulated=True, changed=True, stored_verdict="valid_wide",
                   stored_inertia_kg_m2=99.0)
    bad = FleetRow(f"../{HOSTILE}.csv", "unread", error_kind="UsageError", error_text=f"no column {HOSTILE}\x1b[2J")
    place = store.folder / "fleets" / "0123456789ab"
    place.mkdir(parents=True)
    asked = {"folder": "", "below": HOSTILE, "settings": {"model": "rigid"}, "root": "", "asked": row.date,
             "asked_by": HOSTILE}
    write_json(place / "request.json", asked)
    summary = {"logs": 2, "verdicts": {"valid": 1}, "failed": {"UsageError": 1}, "changed": [{}], "done_before": 1,
               "slowest": [{"log": HOSTILE, "cpu_s": 0.5}], "live": 1, "bare_traces": 0, "left": 0, "wall_s": 3.0,
               "cpu_s": 2.0}
    write_json(place / "state.json", {"state": "done", "total": 2, "done": 2, "failed": 1, "summary": summary})
    write_table([row, bad], place / "fleet.csv")
    point = {"log": run, "date": row.date, **estimate(104.0)}
    after = {"log": run, "date": "2026-06-01T12:00:00", **estimate(99.0)}
    change = {"before": run, "after": run, "before_date": point["date"], "after_date": after["date"]}
    told = {"column": "inertia_kg_m2", "name": "inertia", "unit": "kg·m²", "differs": True, "relative": True,
            **estimate(-0.05), "change": -0.05}
    curve = [{"hertz": hertz, **estimate(100.0 + 40 * hertz)} for hertz in (0.1, 0.2)]
    played = {
        "trend": {"notes": [HOSTILE], "quantities": [
            {"name": "inertia", "unit": "kg·m²", "text": f"changed by -5 % {HOSTILE}", "points": [point, after],
             "changes": [change], "drift": None}]},
        "compare": {
            "results": [asdict(row), asdict(row)], "apparent_inertia": [curve, curve], "friction": [[], []],
            "differences": [{"text": f"the inertias differ {HOSTILE}", "quantities": [
                told, {**told, "column": "coulomb_nm", "name": HOSTILE}]}],
            "settings": [{"name": "rig", "values": [HOSTILE, "R7"], "differs": True},
                         {"name": "load", "values": ["none", "none"], "differs": False}]},
    }
    monkeypatch.setattr(served.service.supervisor, "work", lambda what, run, asked: {"document": played[what]})
    write_json(folder / "row.json", asdict(row))
    return (f"/runs/{run}", f"/compare?runs={run},{second(served, run)}", f"/rigs/{store.request(run).rig}",
            "/fleets/0123456789ab")


def judge(served: Served, run: str) -> None:
    """Add a failed acceptance, the verdict on a rehearsal, stages and events to a run, each with foreign text."""
    folder = served.service.store.place(run)
    rows = [{"name": "inertia", "label": "moment of inertia J", "unit": "kg·m²", "expected": 95.0, "tolerance": 1.0,
             "value": 104.0, "low": 100.0, "high": 108.0, "verdict": "fail", "text": HOSTILE},
            {"name": "drive-serial", "label": "serial number of the drive", "unit": "", "expected": HOSTILE,
             "tolerance": 0.0, "value": HOSTILE, "low": None, "high": None, "verdict": "pass", "text": HOSTILE}]
    write_json(folder / "result.json", json.loads((folder / "result.json").read_bytes()) | {
        "acceptance": {"verdict": "fail", "code": "TDH-1202", "off": [HOSTILE], "quantities": rows},
        "stages": [{"name": "setup", "outcome": "aborted", "duration_s": 2.0, "detail": HOSTILE}]})
    write_json(folder / "state.json", json.loads((folder / "state.json").read_bytes()) | {"rehearsal": {
        "verdict": "fail", "seen": HOSTILE,
        "faults": [{"fault": HOSTILE, "row": 118, "required": HOSTILE, "codes": [6, 9], "verdict": "fail"}]}})
    write(folder / "other.mcap")
    (folder / "other.mcap").replace(folder / "run.mcap")


def asks_with_a_checklist(served: Served) -> str:
    """Return a run that waits for its code, with a point to tick."""
    supervisor = served.service.supervisor
    run = supervisor.start_run("rehearsed", {"note": "ask", "operator": "[ ] brake released"}, "local").request.id
    served.service.wait(run, "awaiting_confirmation")
    return str(run)


def second(served: Served, run: str) -> str:
    """Return another run of the rig."""
    other = served.service.supervisor.start_run(served.service.store.request(run).rig, {"note": "done"}, "local")
    served.service.wait(other.request.id, "done")
    return str(other.request.id)
