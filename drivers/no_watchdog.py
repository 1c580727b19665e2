"""A drive whose watchdog is not armed, or can't be: refused, unless the operator has accepted just that by name.

Accepted is a watchdog that is *off*. One that is on and reads back otherwise than it was set stays refused: nobody
knows when it would act, and on whom.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from drivers.drive import Check, Outcome
from drivers.preflight import Table

FLAG = "--accept-no-watchdog"
SHARED_FLAG = "--accept-shared-watchdog"
ANY_CLIENT = (
    "any other client's requests feed it, too: while one goes on asking, the drive will not stop by itself if this"
    " computer, the program or the cable fails"
)
DIES = "Without it a host that dies would leave the shaft turning"
NOTHING_STOPS_IT = "the drive will not stop by itself if this computer, the program or the cable fails"
ACCEPTED_BY = f"accepted by {FLAG}"
_HINT = f"A drive whose watchdog is off, and can't be armed, is taken by name only: {FLAG}"
_NOT_OFF = f"{FLAG} takes a watchdog that is off, not one that is set otherwise"


def settle(table: Table, tried: Table, accepted: bool, is_off: Callable[[], bool]) -> bool:
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


def spare(table: Table, title: str, wanted: str, found: str, where: str) -> None:
    """A row about the watchdog's own parameter that would be refused, were a watchdog that is off not accepted."""
    table.checks.append(_noted(Check(title, wanted, found, Outcome.REFUSED, where)))


def _noted(check: Check) -> Check:
    if check.outcome is not Outcome.REFUSED:
        return check
    return replace(check, found=f"{check.found}; {ACCEPTED_BY}", outcome=Outcome.NOTE, next_step="")


def _hinted(check: Check, hint: str) -> Check:
    before = check.next_step and check.next_step + ("" if check.next_step.endswith((".", "?", "!")) else ".") + " "
    return replace(check, next_step=before + hint)
