"""The preflight table while it is being filled."""

from collections.abc import Callable

from drivers.drive import Check, Outcome
from drivers.errors import PreflightRefused


class Table:
    """Collects the rows."""

    def __init__(self) -> None:
        self.checks: list[Check] = []

    def row(self, title: str, wanted: str, found: str, good: bool, where: str = "", next_step: str = "") -> bool:
        outcome = Outcome.OK if good else Outcome.REFUSED
        self.checks.append(Check(title, wanted, found, outcome, where, "" if good else next_step))
        return good

    def note(self, title: str, found: str, where: str = "") -> None:
        self.checks.append(Check(title, "", found, Outcome.NOTE, where))

    def attempt(
        self, title: str, wanted: str, where: str, work: Callable[[], tuple[str, bool]], mend: str = ""
    ) -> None:
        """A row whose work may be refused by the drive: that refusal is then the row."""
        try:
            found, good = work()
        except PreflightRefused as error:
            self.checks.append(
                Check(title, wanted, error.what, Outcome.REFUSED, error.where or where, mend or error.next_step)
            )
        else:
            self.row(title, wanted, found, good, where, mend)
