"""`tdhil doctor`: checks of everything that a run needs. Read only; it also works with nothing connected.

Each check is one line: ok, note, or bad with what to do. Exit 0 when nothing is bad, else 4.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import platform
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers import DataFileError, TdhilError
from tdhil.buses import DoctorFinding, all_buses, bad, examples, note, of_error, ok, sure_text
from tdhil.cli.results import print_json
from tdhil.session.real_time import HOW, allowed

if TYPE_CHECKING:
    from tdhil.buses import Connection, ValueSeen
    from tdhil.config import Rig, RunOptions


# ---------------------------------------------------------------------------------------------------------------------
# Checks of the computer: versions, timer, scheduling, disk. They only read, and sleep for 0.1 s.


WANTED_FREE_BYTES = 200_000_000
"""Free disk space that the log requires, bytes (tdhil.recording.log_writer)."""
TIMER_RESOLUTION_S = 1e-4
LATE_S = 0.002
"""Half a period at 250 Hz: a cycle that starts later counts as an overrun."""
NAPS, NAP_S = 50, 0.002


def host_findings(log: Path) -> Iterator[DoctorFinding]:
    """Yield all findings on the computer; ``log`` determines the disk."""
    yield ok("computer", f"{platform.system()} {platform.release()}, Python {platform.python_version()}")
    yield from library_findings(_version)
    yield timer_finding(time.get_clock_info("monotonic").resolution)
    yield jitter_finding(naps(time.monotonic, time.sleep))
    yield priority_finding(*allowed())
    yield disk_finding(log)


def library_findings(version_of: Callable[[str], str | None]) -> Iterator[DoctorFinding]:
    """Yield for each library a finding: is it installed, and new enough?"""
    pip = f"{shlex.quote(sys.executable or 'python')} -m pip"      # the pip of this environment
    for name, least in (one for bus in all_buses() for one in bus.libraries.items()):
        version = version_of(name)
        wanted = ".".join(map(str, least))
        if version is None:
            yield bad(name, "is not installed", f"{pip} install '{name}>={wanted}'")
        elif _numbers(version)[: len(least)] < least:
            yield bad(name, f"{version} is too old, {wanted} is needed", f"{pip} install --upgrade '{name}>={wanted}'")
        else:
            yield ok(name, version)


def timer_finding(resolution_s: float) -> DoctorFinding:
    """Return the finding on the resolution of the monotonic clock."""
    text = f"resolution {resolution_s * 1e9:.3g} ns"
    if resolution_s <= TIMER_RESOLUTION_S:
        return ok("timer", text)
    return note("timer", f"{text}: coarse", "Lower --rate, so that a cycle is at least ten ticks")


def jitter_finding(late_s: Sequence[float]) -> DoctorFinding:
    """Return the finding on the lateness of wake-ups, from some short sleeps."""
    ordered = sorted(late_s)
    typical, worst = ordered[len(ordered) // 2], ordered[-1]
    text = f"wakes {typical * 1e3:.2f} ms late, at worst {worst * 1e3:.2f} ms (in {len(ordered)} tries)"
    if worst <= LATE_S:
        return ok("scheduling", text)
    return note("scheduling", text, "Close other programs, connect the laptop to mains, or use a lower --rate")


def priority_finding(why_no_priority: str, why_not_locked: str) -> DoctorFinding:
    """Return a finding: may the control loop have real-time priority and locked memory?"""
    both = (("priority", why_no_priority), ("locked memory", why_not_locked))
    missing = [f"{name}: {why}" for name, why in both if why]
    if not missing:
        return ok("real time", "--real-time-priority is available")
    said = f"--real-time-priority is not available ({'; '.join(missing)})"
    return note("real time", said, f"If cycles are late: {HOW}")


def naps(now_s: Callable[[], float], sleep: Callable[[float], None]) -> list[float]:
    """Return the excess durations of some short sleeps, s."""
    late = []
    for _ in range(NAPS):
        begun_s = now_s()
        sleep(NAP_S)
        late.append(max(0.0, now_s() - begun_s - NAP_S))
    return late


def disk_finding(log: Path) -> DoctorFinding:
    """Return the finding on the disk space for the log."""
    folder = log.absolute().parent
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return bad("disk", f"{folder}: {error.strerror or error}", "Make that folder, or log elsewhere with --log")
    text = f"{free / 1e9:.0f} GB free for {log}" if free >= 1e10 else f"{free / 1e6:.0f} MB free for {log}"
    if free >= WANTED_FREE_BYTES:
        return ok("disk", text)
    return bad("disk", f"{text}, {WANTED_FREE_BYTES / 1e6:.0f} MB required", "Free disk space, or log to another disk")


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _numbers(version: str) -> tuple[int, ...]:
    """Return the leading whole numbers: 4.6.1rc2 → 4, 6, 1."""
    found = []
    for part in version.split("."):
        digits = part[: len(part) - len(part.lstrip("0123456789"))]
        if not digits:
            break
        found.append(int(digits))
    return tuple(found)


# ---------------------------------------------------------------------------------------------------------------------

def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of drive and line, as for identify."""
    from tdhil.cli.arguments import add_drive_arguments, add_line_arguments, add_option
    from tdhil.config import OPTION

    drive = add_drive_arguments(parser)
    add_option(drive, OPTION["simulate"], help="check the embedded simulator")
    add_option(drive, OPTION["log"], help="path at which a run would write its log")
    add_option(parser, OPTION["json"])
    add_line_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Run all checks. Return 0 if nothing is bad, else 4. Raises UsageError and DataFileError for wrong input."""
    from tdhil.config import load_rig, resolve
    from tdhil.errors import ExitCode

    rig = load_rig(namespace.rig) if namespace.rig else None
    options = resolve(vars(namespace), rig)
    if options.json is True:
        namespace.json = True
    registers: list[ValueSeen] = []
    found: list[DoctorFinding] = []
    for one in findings(vars(namespace), rig, options, registers):
        found.append(one)
        if not namespace.json:
            print(one.text, flush=True)  # noqa: T201
    code = ExitCode.REFUSED if any(one.grade == "bad" for one in found) else ExitCode.OK
    if namespace.json:
        print_json({
            "checks": [asdict(one) for one in found],
            "registers": [one.plain() for one in registers],
            "exit_code": int(code),
        })
    else:
        if registers:
            from rich.table import Table

            from tdhil.report import PlainConsole

            table = Table(title="registers, as read; compare them with the drive's panel", title_justify="left")
            for heading in ("address", "counts", "is", "meaning"):
                table.add_column(heading, overflow="fold")
            for register in registers:
                table.add_row(*register.cells())
            PlainConsole().print(table)
        bad = sum(one.grade == "bad" for one in found)
        print("no obstacle was found" if not bad else f"{bad} to correct, see 'bad'")  # noqa: T201
    return int(code)


def findings(
    cli: Mapping[str, Any], rig: Rig | None, options: RunOptions, registers: list[ValueSeen]
) -> Iterator[DoctorFinding]:
    """Yield findings from the computer to the drive; ``registers`` receives values to compare."""
    from tdhil.session import connection_of, plan_peer

    yield from host_findings(Path(options.log))
    yield from _left(Path(options.log).parent)
    try:
        options, connection = connection_of(cli, rig, options)
    except DataFileError as error:
        yield of_error("profile", error)
        return
    yield from _profile(options, connection)
    yield from _limits(rig)
    if not (options.simulate or connection.configured):
        yield note("drive", f"{connection.bus.nothing_there}: no drive was checked",
                   f"Name it, such as {examples()}")
    else:
        yield from connection.bus.findings(
            plan_peer(options, connection), connection, options, rig, registers
        )


def _left(folder: Path) -> Iterator[DoctorFinding]:
    """Yield settings that runs left in their drives when they ended without restoring them."""
    from drivers.undo_journal import PREFIX, SUFFIX, read

    for path in sorted(folder.glob(f"{PREFIX}*{SUFFIX}")):
        try:
            drive, settings = read(path)
        except TdhilError as error:
            yield of_error("left in a drive", error)
            continue
        yield bad("left in a drive", f"{drive}: {', '.join(one.text for one in settings)} ({path.name})",
                  "If a run is active, wait for its end. Otherwise the next run on that drive restores them")


def _profile(options: RunOptions, connection: Connection) -> Iterator[DoctorFinding]:
    from tdhil.session import doubtful, is_accepted

    profile = connection.profile
    yield ok("profile", f"{profile.name} ({options.source('profile')}): {sure_text(profile)}")
    accepted = options.accept_unverified
    open_questions = [name for name, entry in doubtful(profile) if not is_accepted(name, entry, accepted)]
    if open_questions:
        yield note("profile", f"not verified: {', '.join(open_questions)}",
                   f"A run on a real drive needs them verified or accepted: tdhil profiles show {profile.name}")


def _limits(rig: Rig | None) -> Iterator[DoctorFinding]:
    from tdhil.config import limits_step

    if rig is not None and rig.limits is not None:
        limits = rig.limits
        yield ok("limits", f"{limits.speed_max_rad_s:g} rad/s, {limits.torque_nm:g} N·m ({rig.source('limits')})")
    else:
        yield note("limits", "none: a real drive will not be moved", limits_step(rig))
