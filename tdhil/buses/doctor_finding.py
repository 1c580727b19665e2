"""One line of `tdhil doctor`: the check, its result, and the remedy."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

from drivers import Check, Outcome, TdhilError
from profiles import visible

Grade = Literal["ok", "note", "bad"]


@dataclass(frozen=True)
class DoctorFinding:
    """One finding. ``bad``: it prevents a run or makes it unsafe; ``do``: the remedy."""

    grade: Grade
    name: str
    said: str
    do: str = ""

    @property
    def text(self) -> str:
        """Return one line; a second one with the remedy."""
        line = f"{self.grade:<5} {self.name:<16} {self.said}"
        return visible(f"{line}\n{'':<22} → {self.do}" if self.do else line, keep="\n")


def ok(name: str, said: str) -> DoctorFinding:
    """Return a finding that is in order."""
    return DoctorFinding("ok", name, said)


def note(name: str, said: str, do: str = "") -> DoctorFinding:
    """Return a finding for information."""
    return DoctorFinding("note", name, said, do)


def bad(name: str, said: str, do: str) -> DoctorFinding:
    """Return a finding that is an obstacle."""
    return DoctorFinding("bad", name, said, do)


def of_error(name: str, error: TdhilError) -> DoctorFinding:
    """Return an error of the tree as a finding; its next step is what to do."""
    said = f"{error.where}: {error.what}" if error.where else error.what
    return bad(name, said, error.next_step or "See the message")


def of_check(check: Check) -> DoctorFinding:
    """Return a row of a preflight table as a finding."""
    at = f" ({check.where})" if check.where else ""
    if check.outcome is Outcome.REFUSED:
        said = f"{check.name}: {check.found}, wanted: {check.wanted}{at}"
        return bad("setting", said, check.next_step or "Set it at the drive")
    said = f"{check.name}: {check.found}{at}"
    return ok("setting", said) if check.outcome is Outcome.OK else note("setting", said, check.next_step)


def attempted(name: str, work: Callable[[], Iterable[DoctorFinding]]) -> list[DoctorFinding]:
    """Return the findings of ``work``. If it fails, the failure is the last one."""
    found: list[DoctorFinding] = []
    try:
        for one in work():
            found.append(one)  # noqa: PERF402 (findings before a failure are kept)
    except TdhilError as error:
        found.append(of_error(name, error))
    return found
