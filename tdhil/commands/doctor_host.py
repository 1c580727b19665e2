"""The computer: versions, timer, scheduling, disk. Reads, and sleeps a tenth of a second."""

from __future__ import annotations

import importlib.metadata
import platform
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tdhil.cli.finding import Finding, bad, note, ok
from tdhil.cli.real_time import HOW, allowed

LIBRARIES = {"python-can": (4, 6), "canopen": (2, 4), "pymodbus": (3, 16)}
"""Name on the package index → the first version that this program was written for."""

WANTED_FREE_BYTES = 200_000_000
"""As the log wants it (tdhil.recording.log_writer)."""
TIMER_RESOLUTION_S = 1e-4
LATE_S = 0.002
"""Half a period at 250 Hz: a cycle that starts later counts as an overrun."""
NAPS, NAP_S = 50, 0.002


def host_findings(log: Path) -> Iterator[Finding]:
    """All of it; ``log`` says on which disk a run would write."""
    yield ok("computer", f"{platform.system()} {platform.release()}, Python {platform.python_version()}")
    yield from library_findings(_version)
    yield timer_finding(time.get_clock_info("monotonic").resolution)
    yield jitter_finding(naps(time.monotonic, time.sleep))
    yield priority_finding(*allowed())
    yield disk_finding(log)


def library_findings(version_of: Callable[[str], str | None]) -> Iterator[Finding]:
    """Is each library there, and not older than this program needs?"""
    pip = f"{shlex.quote(sys.executable or 'python')} -m pip"      # of this environment, whichever is active
    for name, least in LIBRARIES.items():
        version = version_of(name)
        wanted = ".".join(map(str, least))
        if version is None:
            yield bad(name, "is not installed", f"{pip} install '{name}>={wanted}'")
        elif _numbers(version)[: len(least)] < least:
            yield bad(name, f"{version} is too old, {wanted} is needed", f"{pip} install --upgrade '{name}>={wanted}'")
        else:
            yield ok(name, version)


def timer_finding(resolution_s: float) -> Finding:
    """How finely the monotonic clock counts."""
    text = f"resolution {resolution_s * 1e9:.3g} ns"
    if resolution_s <= TIMER_RESOLUTION_S:
        return ok("timer", text)
    return note("timer", f"{text}: coarse", "Lower --rate, so that a cycle is at least ten ticks")


def jitter_finding(late_s: Sequence[float]) -> Finding:
    """How late a sleeping process wakes up, from some naps."""
    ordered = sorted(late_s)
    typical, worst = ordered[len(ordered) // 2], ordered[-1]
    text = f"wakes {typical * 1e3:.2f} ms late, at worst {worst * 1e3:.2f} ms (of {len(ordered)} times)"
    if worst <= LATE_S:
        return ok("scheduling", text)
    return note("scheduling", text, "Close other programs, plug the laptop in; or run at a lower --rate")


def priority_finding(why_no_priority: str, why_not_locked: str) -> Finding:
    """May the control loop go before everything else, and is its memory its own?"""
    both = (("priority", why_no_priority), ("locked memory", why_not_locked))
    missing = [f"{name}: {why}" for name, why in both if why]
    if not missing:
        return ok("real time", "--real-time-priority may be used")
    said = f"--real-time-priority can't be had ({'; '.join(missing)})"
    return note("real time", said, f"Where cycles are late: {HOW}")


def naps(now_s: Callable[[], float], sleep: Callable[[float], None]) -> list[float]:
    """By how much each of some short sleeps was too long."""
    late = []
    for _ in range(NAPS):
        begun_s = now_s()
        sleep(NAP_S)
        late.append(max(0.0, now_s() - begun_s - NAP_S))
    return late


def disk_finding(log: Path) -> Finding:
    """Room for a log, where it would be written."""
    folder = log.absolute().parent
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return bad("disk", f"{folder}: {error.strerror or error}", "Make that folder, or log elsewhere with --log")
    text = f"{free / 1e6:.0f} MB free for {log}"
    if free >= WANTED_FREE_BYTES:
        return ok("disk", text)
    return bad("disk", f"{text}, {WANTED_FREE_BYTES / 1e6:.0f} MB wanted", "Free some space, or log to another disk")


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _numbers(version: str) -> tuple[int, ...]:
    """The leading whole numbers: 4.6.1rc2 → 4, 6, 1."""
    found = []
    for part in version.split("."):
        digits = part[: len(part) - len(part.lstrip("0123456789"))]
        if not digits:
            break
        found.append(int(digits))
    return tuple(found)
