"""How long lists and searches of the service take with many runs in its index.

::

    python benchmarks/many_runs.py [--runs 10000]

The runs are files of requests, states and annotations without logs. Printed are the medians of five tries, s: the
index made from the files, the longest list during that, one entry renewed, the list, and searches that find one run,
many, and none.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import threading
import time
import timeit
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from tdhil.service.annotations import Annotations
from tdhil.service.run_state import State, Status, now, way_to
from tdhil.service.store import Index, Store, StoredRequest

TRIES = 5


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
    """Write the files of ended runs; each tenth has tags and an edited note, each hundredth is archived."""
    for number in range(runs):
        run, at = f"20260101-{number // 36 % 240000:06d}-{number:06x}", now()
        (store.runs / run).mkdir()
        request = StoredRequest(run, f"rig-{number % 20}", "rig.yaml", "0" * 64, {"operator": "Anna", "note": "daily"},
                                "local", at, True, "never")
        status = way_to(Status.begun(run, request.rig, at), State.REFUSED, at)
        for name, plain in (("request.json", asdict(request)), ("state.json", status.plain())):
            (store.runs / run / name).write_text(json.dumps(plain))
        if number % 10 == 0:
            found = Annotations((f"batch {number // 100}", "checked"), note=f"bearing {number}",
                                archived=number % 100 == 0)
            (store.runs / run / "annotations.json").write_text(json.dumps(found.plain()))


def main() -> None:
    """Make the runs, then measure."""
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


if __name__ == "__main__":
    main()
