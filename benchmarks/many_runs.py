"""How long lists and searches of the service take with many runs in its index.

::

    python benchmarks/many_runs.py [--runs 10000]

The runs are done, with request, state, result, row of the trend and annotations, but without logs. Printed are the
medians of five tries, s: the index made from the files, the longest list during that, one entry renewed, the list, and
searches that find one run, many, and none. Then a service with these runs is asked over HTTP: the first and the last
page of the list, the list in another order, searches, filters, and the trend of a rig with the most runs that a trend
has. The trend is once computed in the worker process and then comes from the memory; both are printed. Each figure is
also printed as a share of its target. Where there is Chromium (extra `browser`), the list and the trend are also timed
as pages, from the request until they show a run. The exit code is 1 if a figure misses its target. The first trend has
none, because it includes the start of a process.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import sys
import tempfile
import threading
import time
import timeit
import urllib.request
from collections.abc import Callable
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from tdhil.fleet import FleetRow
from tdhil.service.annotations import Annotations
from tdhil.service.run_state import State, Status, way_to
from tdhil.service.store import Index, Store, StoredRequest
from tests.service.chromium.pages import CHROMIUM, Served
from tests.service.conftest import Service

TRIES = 5
RIGS = 10
LIST_S, SEARCH_S, TREND_S = 0.3, 0.2, 0.5
"""Targets over HTTP, s: a page of the list, a search or a filter, and a trend. A page in the browser has these too."""


def seconds(work: Callable[[], Any]) -> float:
    """Return the median time of some tries, s."""
    times = []
    for _ in range(TRIES):
        began_s = time.monotonic()
        work()
        times.append(time.monotonic() - began_s)
    return statistics.median(times)


def waits_during(index: Index) -> list[float]:
    """Return the times of lists that are requested while the index is made again, s."""
    work = threading.Thread(target=index.rebuild)
    work.start()
    times = []
    while work.is_alive():
        times.append(timeit.timeit(index.find, number=1))
        time.sleep(0.02)
    return times


def make(store: Store, runs: int) -> None:
    """Write the files of done runs; each tenth has tags and an edited note, each hundredth is archived."""
    draw = random.Random(7)
    for number in range(runs):
        run = f"20260101-{number // 36 % 240000:06d}-{number:06x}"
        at = f"2026-{1 + number // 28 // 60 % 12:02d}-{1 + number // 60 % 28:02d}T12:{number % 60:02d}:00+00:00"
        (store.runs / run).mkdir()
        said = {"operator": "Anna", "note": "daily"}
        request = StoredRequest(run, f"rig-{number % RIGS}", "rig.yaml", "0" * 64, said, "local", at, True, "never")
        status = way_to(Status.begun(run, request.rig, at), State.PREFLIGHT, at)
        for state in (State.MOVING, State.IDENTIFYING, State.DONE):
            status = way_to(status, state, at)
        value = draw.gauss(104.0, 0.4)
        row = FleetRow(run, "valid", rig=request.rig, date=at, inertia_kg_m2=value, inertia_low_kg_m2=value - 0.9,
                       inertia_high_kg_m2=value + 0.9, confidence=0.95, torque_scale_rel_sd=0.02, simulated=True,
                       drive_name="Inverter", profile="generic/cia402")
        result = {"verdict": "valid", "inertia_kg_m2": {
            "value": value, "low": value - 0.9, "high": value + 0.9, "low_total": value - 4.0,
            "high_total": value + 4.0, "repeatability_rel": 0.0087}}
        for name, plain in (("request.json", asdict(request)), ("state.json", status.plain()),
                            ("row.json", asdict(row)), ("result.json", result)):
            (store.runs / run / name).write_text(json.dumps(plain))
        if number % 10 == 0:
            found = Annotations((f"batch {number // 100}", "checked"), note=f"bearing {number}",
                                archived=number % 100 == 0)
            (store.runs / run / "annotations.json").write_text(json.dumps(found.plain()))


def within(what: str, took_s: float, target_s: float) -> bool:
    """Print a figure as a share of its target. Return whether it is within it."""
    print(f"{what}: {took_s:.3f} s, {took_s / target_s:.0%} of {target_s} s", flush=True)
    return took_s <= target_s


def in_chromium(url: str) -> list[bool]:
    """Return whether each page shows a run within its target. Empty without Chromium."""
    if CHROMIUM is None or find_spec("playwright") is None:
        print("pages: not timed, there is no Chromium or no playwright")
        return []
    from playwright.sync_api import sync_playwright

    with sync_playwright() as engine:
        browser = engine.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-dev-shm-usage"])
        page = browser.new_page(base_url=url)

        def opened(path: str, shown: str) -> None:
            page.goto(path)
            page.locator(shown).first.wait_for()

        found = []
        for path, shown, target_s in (("/runs", "#runs a", LIST_S), ("/runs?text=bearing", "#runs a", SEARCH_S),
                                      ("/rigs/rig-0", "#history canvas", TREND_S)):
            opened(path, shown)                            # the files of the pages are then in the browser's memory
            took_s = seconds(lambda path=path, shown=shown: opened(path, shown))
            found.append(within(f"page {path}", took_s, target_s))
        browser.close()
    return found


def over_http(folder: Path, runs: int) -> bool:
    """Start a service with these runs, and print how long it takes to answer. Return whether all targets are met."""
    rigs = folder / "rigs"
    rigs.mkdir()
    for number in range(RIGS):
        (rigs / f"rig-{number}.yaml").write_text("run: {simulate: true}\n")
    service = Service(folder, rigs)
    service.index.rebuild()
    served = Served(service)
    # A service makes its index again when it starts. Lists during that are measured above, on the index alone. The
    # figures below are those of a service that has started: else they depend on how much of it was still to be made.
    if not service.index.wait_until_made(120.0):
        raise SystemExit("the index of the service was not made within 120 s")

    def answer(path: str) -> bytes:
        with urllib.request.urlopen(f"{served.url}/api/v1{path}", timeout=60) as found:
            return bytes(found.read())

    met = []
    pages = json.loads(answer("/runs/page"))["pages"]
    for what, target_s, path in (
        ("first page", LIST_S, "/runs/page"), ("last page", LIST_S, f"/runs/page?page={pages}"),
        ("last page by J", LIST_S, f"/runs/page?page={pages}&sort=inertia_kg_m2"),
        ("search, many found", SEARCH_S, "/runs/page?text=anna%20daily"),
        ("search, one found", SEARCH_S, f"/runs/page?text=bearing%20{runs // 2 + 10}%20checked"),
        ("search, none found", SEARCH_S, "/runs/page?text=nothing%20of%20the%20kind"),
        ("rig, verdict and tag", SEARCH_S, "/runs/page?rig=rig-0&verdict=valid&tag=checked"),
    ):
        met.append(within(f"HTTP, {what}", seconds(lambda path=path: answer(path)), target_s))
    for what in ("first, with the start of the worker process", "computed again", "again, from the memory"):
        if what == "computed again":
            path = service.store.runs / service.index.find(rig="rig-0", limit=1)[0].id / "row.json"
            path.write_text(path.read_text().replace('"valid"', '"valid_wide"'))
        took_s = timeit.timeit(lambda: answer("/rigs/rig-0/trend"), number=1)
        good = within(f"HTTP, trend of {min(1000, runs // RIGS)} results, {what}", took_s, TREND_S)
        met.append(good or what.startswith("first"))
    met += in_chromium(served.url)
    served.end()
    service.supervisor.close()
    return all(met)


def main() -> int:
    """Make the runs, then measure. Return 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=10_000)
    runs = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        store.prepare()
        make(store, runs)
        index = Index(store)
        began_s = time.monotonic()
        index.rebuild()
        made_s = time.monotonic() - began_s
        waits = waits_during(index)
        print(f"{runs} runs; index made from the files: {made_s:.2f} s; lists during that: {len(waits)}, the longest "
              f"took {max(waits):.4f} s, 1/{made_s / max(waits):.0f} of it")
        first = store.ids()[0]
        for what, work in (
            ("entry renewed", lambda: index.put(store.summary(first))),
            ("list of 100", index.find),
            ("search, many found", lambda: index.find(text="anna daily", limit=100)),
            ("search, one found", lambda: index.find(text=f"bearing {runs // 2 + 10} checked")),
            ("search, none found", lambda: index.find(text="nothing of the kind")),
            ("search, archived too", lambda: index.find(text="batch 0 checked", archived=True)),
        ):
            print(f"{what}: {seconds(work):.4f} s")
        return 0 if over_http(Path(folder), runs) else 1


if __name__ == "__main__":
    sys.exit(main())
