"""The preflight table, for any bus."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from drivers.drive import Check, Outcome
from drivers.errors import CommandRejected, PreflightRefused


class PreflightTable:
    """Collects the rows. A failed row does not end the table: the engineer sees the whole list."""

    def __init__(self) -> None:
        self.checks: list[Check] = []

    def row(self, title: str, wanted: str, found: str, good: bool, where: str = "", next_step: str = "") -> bool:
        """Add a row that is right or refused. Return whether it is right."""
        outcome = Outcome.OK if good else Outcome.REFUSED
        self.checks.append(Check(title, wanted, found, outcome, where, "" if good else next_step))
        return good

    def note(self, title: str, found: str, where: str = "", next_step: str = "") -> None:
        """Add a row that is no obstacle."""
        self.checks.append(Check(title, "", found, Outcome.NOTE, where, next_step))

    def attempt(
        self, title: str, wanted: str, where: str, work: Callable[[], tuple[str, bool]], mend: str = ""
    ) -> bool:
        """Add a row whose work the drive may refuse: that refusal is then the row."""
        try:
            found, good = work()
        except (PreflightRefused, CommandRejected) as error:
            step = mend or error.next_step
            self.checks.append(Check(title, wanted, error.what, Outcome.REFUSED, error.where or where, step))
            return False
        return self.row(title, wanted, found, good, where, mend)


# ---------------------------------------------------------------------------------------------------------------------
# A drive whose watchdog is not armed, or can't be: refused, unless the operator has accepted exactly that by name.
#
# Accepted is a watchdog that is *off*. A watchdog that is on and reads back another value stays refused: it is unknown
# when it would trip, and for which host.


NO_WATCHDOG_FLAG = "--accept-no-watchdog"
SHARED_FLAG = "--accept-shared-watchdog"
ANY_CLIENT = (
    "requests of any client feed it: while another client continues to send them, the drive will not stop by itself"
    " if this computer, the program or the cable fails"
)
DIES = "Without it the shaft keeps turning if the host fails"
NOTHING_STOPS_IT = "the drive will not stop by itself if this computer, the program or the cable fails"
ACCEPTED_BY = f"accepted by {NO_WATCHDOG_FLAG}"
_HINT = f"If the watchdog is off and cannot be armed, a run needs {NO_WATCHDOG_FLAG}"
_NOT_OFF = f"{NO_WATCHDOG_FLAG} accepts a watchdog that is off, not one with another setting"


def settle(table: PreflightTable, tried: PreflightTable, accepted: bool, is_off: Callable[[], bool]) -> bool:
    """Add the rows of arming the watchdog. Return whether it is armed.

    ``is_off`` is called only if a row was refused and the operator has accepted a missing watchdog; the rows then
    become notes. A refusal that stays names the option.
    """
    refused = [check for check in tried.checks if check.outcome is Outcome.REFUSED]
    if refused and accepted and is_off():
        table.checks += [_noted(check) for check in tried.checks]
        table.note("no watchdog", f"{ACCEPTED_BY}: {NOTHING_STOPS_IT}", refused[-1].where)
        return False
    if refused:
        last, hint = refused[-1], _NOT_OFF if accepted else _HINT
        before = last.next_step and last.next_step + ("" if last.next_step.endswith((".", "?", "!")) else ".") + " "
        hinted = replace(last, next_step=before + hint)
        table.checks += [hinted if check is last else check for check in tried.checks]
    else:
        table.checks += tried.checks
    return not refused


def spare(table: PreflightTable, title: str, wanted: str, found: str, where: str) -> None:
    """Add a row about the watchdog's own parameter: refused, unless the operator accepted a watchdog that is off."""
    table.checks.append(_noted(Check(title, wanted, found, Outcome.REFUSED, where)))


def _noted(check: Check) -> Check:
    if check.outcome is not Outcome.REFUSED:
        return check
    return replace(check, found=f"{check.found}; {ACCEPTED_BY}", outcome=Outcome.NOTE, next_step="")


# ---------------------------------------------------------------------------------------------------------------------
# Trapped torque of a drill string after an earlier stop: the drive holds it, and preparing the drive would release it.


HELD_SHARE, HELD_COUNTS = 0.02, 5.0
"""Noise of the reported torque: share of the torque limit, or number of counts, the larger of both."""


def check_nothing_held(table: PreflightTable, held_nm: float | None, limit_nm: float, count_nm: float,
                       where: str) -> bool:
    """Add a row of the torque held in quick stop, N·m; None: not reported. Return whether the shaft may be released."""
    most_nm = max(HELD_SHARE * limit_nm, HELD_COUNTS * count_nm)
    found = "not reported" if held_nm is None else f"{held_nm:.4g} N·m"
    return table.row(
        "torque held in quick stop", f"at most {most_nm:.3g} N·m", found,
        held_nm is not None and abs(held_nm) <= most_nm, where,
        "The drive holds trapped torque of a drill string, and the run would release it at once. Reduce the torque with"
        " the rig's own control, then disable the drive there",
    )


# ---------------------------------------------------------------------------------------------------------------------
# The rated torque, from the drive and from rig.yaml: one row of the preflight table, for any bus.


def agreed_rated_torque(table: PreflightTable, from_drive_nm: float | None, rig_nm: float | None,
                        where: str) -> float | None:
    """Return rig.yaml's rated torque, N·m, or the drive's if the rig has none. None, and refused, without both.

    ``where`` names the object or the register.
    """
    rated_nm = rig_nm if rig_nm is not None else from_drive_nm
    if rated_nm is None:
        table.row(
            "rated torque", "known", "not reported by the drive", False, where,
            "Give drive_data.rated_torque_nm in rig.yaml (motor name plate)",
        )
    elif from_drive_nm is None:
        table.note("rated torque", f"{rated_nm:g} N·m, from the rig", where)
    else:
        agree = abs(from_drive_nm - rated_nm) <= 0.001 * rated_nm
        table.row(
            "rated torque", f"{rated_nm:g} N·m", f"{from_drive_nm:g} N·m", agree, where,
            "rig.yaml and the drive state different values, and this value scales every torque. Correct the wrong one",
        )
    return rated_nm
