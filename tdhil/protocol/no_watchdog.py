"""A run on a drive that is known not to watch its host, which the operator has accepted by name.

Everything else stays as it is: guard, limits and the stop are the host's and the drive's as ever. What changes is what
may be said: nobody is to be told that the drive will stop the shaft by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.drive import Preflight
from drivers.errors import CommunicationLost
from drivers.no_watchdog import ACCEPTED_BY, FLAG, NOTHING_STOPS_IT

SAID = f"no watchdog is armed in the drive, {ACCEPTED_BY}: {NOTHING_STOPS_IT}"
_WARNING = (
    f"no watchdog was armed in the drive, {ACCEPTED_BY}: it would not have stopped by itself had this computer, the"
    " program or the cable failed"
)
_STEP = (
    f"If the shaft still turns, use the hard-wired emergency stop now: no watchdog is armed in this drive ({FLAG})."
    " Then check supply, cable and adapter"
)


def configuration(preflight: Preflight) -> dict[str, Any]:
    """For the log, under `watchdog`; nothing where one is armed."""
    return {} if preflight.watched else {"watchdog": {"armed": False, "accepted_by": FLAG}}


def warnings(run: Mapping[str, Any]) -> tuple[str, ...]:
    """For the result, from the log's configuration: the same live and replayed."""
    found = run.get("watchdog")
    return (_WARNING,) if isinstance(found, Mapping) and found.get("armed") is False else ()


def correct(error: BaseException, preflight: Preflight | None) -> None:
    """Whoever can't reach the drive any more says that its watchdog acts; here none does."""
    if isinstance(error, CommunicationLost) and preflight is not None and not preflight.watched:
        error.next_step = _STEP
