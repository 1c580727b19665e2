"""Tests on a real SocketCAN interface: their requirements, and the skip without them.

TDHIL_VCAN names the interface (default vcan0). Without it every test here is skipped with instructions to run it.
TDHIL_REQUIRE_VCAN=1, which run_in_guest.sh sets, turns the skip into a failure: with a promised interface, a skip must
not count as a pass.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NoReturn

import can
import pytest

ARPHRD_CAN = 280  # linux/if_arp.h
IFF_UP = 1  # linux/if.h
HOW = "run them with: tests/vcan/run_in_guest.sh -- python -m pytest tests/vcan"


def interface() -> str:
    return os.environ.get("TDHIL_VCAN") or "vcan0"


def what_is_missing(name: str) -> str | None:
    """Return why NAME cannot be used, or None. It reads flags, since the operstate of an active vcan is "unknown"."""
    link = Path("/sys/class/net") / name
    try:
        kind = int((link / "type").read_text())
        flags = int((link / "flags").read_text(), 16)
    except OSError:
        return f"there is no interface {name}"
    if kind != ARPHRD_CAN:
        return f"{name} is no CAN interface"
    if not flags & IFF_UP:
        return f"{name} is down"
    return None


def pytest_itemcollected(item: pytest.Item) -> None:
    item.add_marker("vcan")
    item.add_marker("real_time")        # a silent host counts as lost after a second


def give_up(why: str) -> NoReturn:
    if os.environ.get("TDHIL_REQUIRE_VCAN") == "1":
        pytest.fail(f"{why}, and TDHIL_REQUIRE_VCAN=1 forbids to skip", pytrace=False)
    pytest.skip(f"{why}; {HOW}")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    missing = what_is_missing(interface())
    if missing is not None:
        give_up(missing)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the reason of the skip, since a quiet run hides it."""
    skipped = [report for report in terminalreporter.stats.get("skipped", ()) if HOW in str(report.longrepr)]
    if skipped:
        why = what_is_missing(interface()) or "for want of tools"
        terminalreporter.write_line(f"vcan: {len(skipped)} tests SKIPPED, {why}; {HOW}", yellow=True, bold=True)


@pytest.fixture
def vcan() -> str:
    """Return the name of the interface, for python-can's `channel` and for can-utils."""
    return interface()


@pytest.fixture
def open_bus(vcan: str) -> Iterator[Callable[..., can.BusABC]]:
    """Open sockets on the interface; all are closed after the test."""
    with ExitStack() as buses:

        def open_one(**options: object) -> can.BusABC:
            return buses.enter_context(can.Bus(interface="socketcan", channel=vcan, **options))  # type: ignore[arg-type]

        yield open_one


@pytest.fixture
def tool() -> Callable[[str], str]:
    """Return the path of a program of can-utils; without it the test is skipped as without the interface."""

    def find(name: str) -> str:
        return shutil.which(name) or give_up(f"{name} is not on PATH (apt-get install can-utils)")

    return find


@pytest.fixture
def ip() -> str:
    """Return ip(8) if links may be changed. This needs root, as in the guest."""
    from tests.vcan.vcan_runs import root_s_ip

    command = root_s_ip()
    if command is None:
        give_up("links can only be changed by root, with ip (apt-get install iproute2)")
    return command
