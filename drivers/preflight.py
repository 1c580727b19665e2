"""The preflight table while it is being filled in, whatever the bus."""

from __future__ import annotations

from collections.abc import Callable

from drivers.drive import Check, Outcome
from drivers.errors import CommandRejected, PreflightRefused


class Table:
    """Collects the rows. One that fails doesn't hide those after it: an engineer wants the whole list."""

    def __init__(self) -> None:
        self.checks: list[Check] = []

    def row(self, title: str, wanted: str, found: str, good: bool, where: str = "", next_step: str = "") -> bool:
        """A row that is right or refused; whether it is right."""
        outcome = Outcome.OK if good else Outcome.REFUSED
        self.checks.append(Check(title, wanted, found, outcome, where, "" if good else next_step))
        return good

    def note(self, title: str, found: str, where: str = "", next_step: str = "") -> None:
        """A row that is worth a line and no obstacle."""
        self.checks.append(Check(title, "", found, Outcome.NOTE, where, next_step))

    def attempt(
        self, title: str, wanted: str, where: str, work: Callable[[], tuple[str, bool]], mend: str = ""
    ) -> bool:
        """A row whose work the drive may refuse: that refusal is then the row."""
        try:
            found, good = work()
        except (PreflightRefused, CommandRejected) as error:
            step = mend or error.next_step
            self.checks.append(Check(title, wanted, error.what, Outcome.REFUSED, error.where or where, step))
            return False
        return self.row(title, wanted, found, good, where, mend)
