"""One line of `tdhil doctor`: what was looked at, how it is, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

from drivers import Check, Outcome, TdhilError
from profiles import visible

Grade = Literal["ok", "note", "bad"]


@dataclass(frozen=True)
class DoctorFinding:
    """``bad`` is what would keep a run from starting, or make it unsafe; ``do``: what mends it."""

    grade: Grade
    name: str
    said: str
    do: str = ""

    @property
    def text(self) -> str:
        """One line; a second one says what to do."""
        line = f"{self.grade:<5} {self.name:<16} {self.said}"
        return visible(f"{line}\n{'':<22} → {self.do}" if self.do else line, keep="\n")


def ok(name: str, said: str) -> DoctorFinding:
    """As it should be."""
    return DoctorFinding("ok", name, said)


def note(name: str, said: str, do: str = "") -> DoctorFinding:
    """Worth a line, and no obstacle."""
    return DoctorFinding("note", name, said, do)


def bad(name: str, said: str, do: str) -> DoctorFinding:
    """An obstacle."""
    return DoctorFinding("bad", name, said, do)


def of_error(name: str, error: TdhilError) -> DoctorFinding:
    """An error of the tree as a line: what and where; its next step is what to do."""
    said = f"{error.where}: {error.what}" if error.where else error.what
    return bad(name, said, error.next_step or "See the message")


def of_check(check: Check) -> DoctorFinding:
    """A row of a preflight table as a line."""
    at = f" ({check.where})" if check.where else ""
    if check.outcome is Outcome.REFUSED:
        said = f"{check.name}: {check.found}, wanted: {check.wanted}{at}"
        return bad("setting", said, check.next_step or "Set it at the drive")
    said = f"{check.name}: {check.found}{at}"
    return ok("setting", said) if check.outcome is Outcome.OK else note("setting", said, check.next_step)


def attempted(name: str, work: Callable[[], Iterable[DoctorFinding]]) -> list[DoctorFinding]:
    """What ``work`` finds, up to where it fails: then that failure is the last line."""
    found: list[DoctorFinding] = []
    try:
        for one in work():
            found.append(one)  # noqa: PERF402 (what came before the failure counts)
    except TdhilError as error:
        found.append(of_error(name, error))
    return found
