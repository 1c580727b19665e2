"""Common settings of all tests. Property tests use the same examples in every run; with TDHIL_FUZZ=1 new ones.

The command of the README runs the quick tests, in less than four minutes. Heavy cases run in CI (--heavy: only
those), the longest with --long only; the header of every run states this. CI of a commit runs one of nine shares of the
heavy cases (--share), so that it ends in 20 minutes: decision 0061.
pyproject.toml explains the markers.

A failed test in real time (`real_time`) is run again if this computer stood still during it, and the log states this.
In such a pause the watchdog of a drive acts, and a late run ends itself, both rightly. The same applies if the run
itself reports that it was late.

Ctrl-C has its default handler: a shell that starts the tests in the background ignores it, and children inherit this.

Collection produces no garbage. Garbage collection is off during it, which saves a fifth of its time, and skips its
objects later. Bytecode is kept for the hundreds of started programs: with PYTHONDONTWRITEBYTECODE, each of them would
compile all modules again.

Linear algebra has one thread: with several pytest workers, two threads wait for each other and take twice the time.
"""

import argparse
import gc
import json
import os
import signal
import sys
import threading
import time
import zlib
from collections import Counter
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import settings

from tdhil.numerics import prepare

settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("fuzz", deadline=None, max_examples=1000)
settings.load_profile("fuzz" if os.environ.get("TDHIL_FUZZ") else "same")

if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

prepare()           # before numpy is loaded

gc.disable()        # until everything is collected
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

GROUPS = "one_worker"
"""Key of the file name in which a worker of pytest-xdist writes the groups of its `one_worker` items."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also the cases that are left out for their time")
    parser.addoption("--heavy", action="store_true", help="only the heavy cases, which CI runs beside the README's")
    parser.addoption("--all-but-long", action="store_true", help="the heavy cases, too")
    parser.addoption("--share", type=share, metavar="K/N", default=(1, 1),
                     help="of the heavy cases the K-th of N shares, and those that each share has; with --long, of all")


def share(text: str) -> tuple[int, int]:
    """Return K and N of "K/N"."""
    one, _, of = text.partition("/")
    if not (one.isdecimal() and of.isdecimal() and 1 <= int(one) <= int(of)):
        raise argparse.ArgumentTypeError(f"{text!r}: must be K/N with 1 <= K <= N, as 2/3")
    return int(one), int(of)


def in_share(nodeid: str, one: int, of: int) -> bool:
    """Return whether a case is in the share. It stays there if other cases are added."""
    return zlib.crc32(nodeid.encode()) % of == one - 1


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node) -> None:            # type: ignore[no-untyped-def]  # where pytest-xdist is installed
    if node.gateway.id == "gw0":
        node.workerinput[GROUPS] = str(groups_file(node.config))


def groups_file(config: pytest.Config) -> Path:
    return config._tmp_path_factory.getbasetemp() / "one_worker.json"       # type: ignore[attr-defined]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):      # type: ignore[no-untyped-def]
    """Replace --dist loadgroup, which has no effect with pytest 9, since pytest-xdist 3.8 cannot mark its node-IDs."""
    from functools import cached_property

    from xdist.scheduler import LoadScopeScheduling

    class ByMarker(LoadScopeScheduling):
        @cached_property
        def groups(self) -> dict[str, str]:
            """Return the groups, which the first worker has written once every worker has collected."""
            return json.loads(groups_file(config).read_text())

        def _split_scope(self, nodeid: str) -> str:
            return self.groups.get(nodeid, nodeid)

        def mark_test_complete(self, node, item_index: int, duration: float = 0) -> None:  # type: ignore[no-untyped-def]
            """Remove a completed group: pytest-xdist counts all groups of a worker again after each test."""
            super().mark_test_complete(node, item_index, duration)
            groups = self.assigned_work[node]
            done = self._split_scope(self.registered_collections[node][item_index])
            if all(groups[done].values()):
                del groups[done]

    return ByMarker(config, log) if config.getvalue("dist") == "load" else None


def cases_of(items: list[pytest.Item], name: str) -> set[str]:
    """Return the node-IDs under the marker ``name``. ``name(but_first=n)``: all cases of the test but its first n."""
    seen: Counter[str] = Counter()
    found = set()
    for item in items:
        function = item.nodeid.partition("[")[0]
        seen[function] += 1
        if any(seen[function] > mark.kwargs.get("but_first", 0) for mark in item.iter_markers(name)):
            found.add(item.nodeid)
    return found


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    part = config.getoption("--share")
    if config.getoption("--long"):
        chosen = [item for item in items if in_share(item.nodeid, *part)]
    else:
        only, too = config.getoption("--heavy"), config.getoption("--all-but-long")
        heavy, longest = cases_of(items, "heavy"), cases_of(items, "long")
        always = {item.nodeid for item in items for mark in item.iter_markers("heavy") if mark.kwargs.get("each_share")}
        other = {nodeid for nodeid in heavy - always if not in_share(nodeid, *part)}
        chosen = [
            item for item in items
            if item.nodeid not in longest and item.nodeid not in other and (too or (item.nodeid in heavy) is only)
        ]
    if len(chosen) < len(items):
        kept = set(chosen)
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = chosen
    write_to = getattr(config, "workerinput", {}).get(GROUPS)
    if write_to is not None:
        marks = ((item.nodeid, item.get_closest_marker("one_worker")) for item in items)
        groups = {nodeid: " ".join(mark.args) or nodeid.split("::")[0] for nodeid, mark in marks if mark is not None}
        Path(write_to).write_text(json.dumps(groups))


@pytest.fixture
def no_bus_of_the_user(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Remove the bus settings of the user from environment and configuration files."""
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)


STOOD_STILL_S = 0.5
LATE = ("stood still for", "the computer or the adapter is too slow", "host was silent for too long")
"""Texts in the message of a late run (drivers)."""
TRIES = 4


class Stalls:
    """Monitor of pauses. ``longest_s``: longest delay of a sleeping thread while the context is active."""

    def __enter__(self) -> "Stalls":
        self.longest_s, self._over = 0.0, threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def _look(self) -> None:
        before_s = time.monotonic()
        while not self._over.wait(0.05):
            now_s = time.monotonic()
            self.longest_s, before_s = max(self.longest_s, now_s - before_s - 0.05), now_s

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    if item.get_closest_marker("real_time") is None:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for left in reversed(range(TRIES)):
        with Stalls() as stalls:
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
        failed = [report.longreprtext for report in reports if report.failed]
        late = stalls.longest_s >= STOOD_STILL_S or any(word in text for word in LATE for text in failed)
        if not (left and failed and late):
            break
        item.warn(pytest.PytestWarning(f"this computer was late (by {stalls.longest_s:.1f} s here): run again"))
        item._initrequest()         # type: ignore[attr-defined]  # anew, with fixtures of its own
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    gc.enable()
    gc.freeze()


def pytest_report_header(config: pytest.Config) -> str:
    if config.getoption("--long"):
        return "long and heavy cases: run too"
    one, of = config.getoption("--share")
    part = f", share {one} of {of}" if of > 1 else ""
    if config.getoption("--all-but-long"):
        return f"long cases: LEFT OUT (--long); heavy cases: run too{part}"
    heavy = f"ONLY THESE{part}" if config.getoption("--heavy") else "LEFT OUT, run by .ci/run (--heavy)"
    return f"long cases: LEFT OUT (--long); heavy cases: {heavy}"
