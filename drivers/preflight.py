"""The preflight table while it is being filled in, whatever the bus."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from drivers.drive import Check, Outcome
from drivers.errors import CommandRejected, PreflightRefused


class PreflightTable:
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


# ---------------------------------------------------------------------------------------------------------------------
# A drive whose watchdog is not armed, or can't be: refused, unless the operator has accepted just that by name.
#
# Accepted is a watchdog that is *off*. One that is on and reads back otherwise than it was set stays refused: nobody
# knows when it would act, and on whom.


NO_WATCHDOG_FLAG = "--accept-no-watchdog"
SHARED_FLAG = "--accept-shared-watchdog"
ANY_CLIENT = (
    "any other client's requests feed it, too: while one goes on asking, the drive will not stop by itself if this"
    " computer, the program or the cable fails"
)
DIES = "Without it a host that dies would leave the shaft turning"
NOTHING_STOPS_IT = "the drive will not stop by itself if this computer, the program or the cable fails"
ACCEPTED_BY = f"accepted by {NO_WATCHDOG_FLAG}"
_HINT = f"A drive whose watchdog is off, and can't be armed, is taken by name only: {NO_WATCHDOG_FLAG}"
_NOT_OFF = f"{NO_WATCHDOG_FLAG} takes a watchdog that is off, not one that is set otherwise"


def settle(table: PreflightTable, tried: PreflightTable, accepted: bool, is_off: Callable[[], bool]) -> bool:
    """Take over the rows that arming gave; whether the watchdog is armed.

    ``is_off`` is asked only where a row was refused and the operator has accepted a drive without: then they become
    notes that say so. A refusal that stands names the way out.
    """
    refused = [check for check in tried.checks if check.outcome is Outcome.REFUSED]
    if refused and accepted and is_off():
        table.checks += [_noted(check) for check in tried.checks]
        table.note("no watchdog", f"{ACCEPTED_BY}: {NOTHING_STOPS_IT}", refused[-1].where)
        return False
    hint = _NOT_OFF if accepted else _HINT
    table.checks += [_hinted(check, hint) if refused and check is refused[-1] else check for check in tried.checks]
    return not refused


def spare(table: PreflightTable, title: str, wanted: str, found: str, where: str) -> None:
    """A row about the watchdog's own parameter that would be refused, were a watchdog that is off not accepted."""
    table.checks.append(_noted(Check(title, wanted, found, Outcome.REFUSED, where)))


def _noted(check: Check) -> Check:
    if check.outcome is not Outcome.REFUSED:
        return check
    return replace(check, found=f"{check.found}; {ACCEPTED_BY}", outcome=Outcome.NOTE, next_step="")


def _hinted(check: Check, hint: str) -> Check:
    before = check.next_step and check.next_step + ("" if check.next_step.endswith((".", "?", "!")) else ".") + " "
    return replace(check, next_step=before + hint)


# ---------------------------------------------------------------------------------------------------------------------
# A drill string that an earlier stop has left wound up: the drive holds it, and preparing the drive disables that.


HELD_SHARE, HELD_COUNTS = 0.02, 5.0
"""Of the torque limit, or so many counts of the reported torque: less than both is nothing."""


def check_nothing_held(table: PreflightTable, held_nm: float | None, limit_nm: float, count_nm: float,
                       where: str) -> bool:
    """A row of what a drive in quick stop holds, N·m; None: it doesn't tell. Whether the shaft may be let go."""
    most_nm = max(HELD_SHARE * limit_nm, HELD_COUNTS * count_nm)
    found = "not told" if held_nm is None else f"{held_nm:.4g} N·m"
    return table.row(
        "torque held in quick stop", f"at most {most_nm:.3g} N·m", found,
        held_nm is not None and abs(held_nm) <= most_nm, where,
        "A drill string is wound up, and the run would let go of it at once: bring its torque down with the rig's own"
        " control, then disable the drive there",
    )


# ---------------------------------------------------------------------------------------------------------------------
# The rated torque, which the drive and rig.yaml may both know: one row of the preflight table, whatever the bus.


def agreed_rated_torque(table: PreflightTable, from_drive_nm: float | None, rig_nm: float | None,
                        where: str) -> float | None:
    """N·m; rig.yaml's, and the drive's where the rig has none. None, and refused, where neither tells.

    ``where`` names the object or the register.
    """
    rated_nm = rig_nm if rig_nm is not None else from_drive_nm
    if rated_nm is None:
        table.row(
            "rated torque", "known", "the drive does not tell", False, where,
            "Give drive_data.rated_torque_nm in rig.yaml (motor name plate)",
        )
    elif from_drive_nm is None:
        table.note("rated torque", f"{rated_nm:g} N·m, from the rig", where)
    else:
        agree = abs(from_drive_nm - rated_nm) <= 0.001 * rated_nm
        table.row(
            "rated torque", f"{rated_nm:g} N·m", f"{from_drive_nm:g} N·m", agree, where,
            "rig.yaml and the drive disagree, and every torque is scaled by it: find out which is right",
        )
    return rated_nm
