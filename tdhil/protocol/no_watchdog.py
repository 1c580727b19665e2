"""A run on a drive that is known not to watch its host, or not this one alone, which the operator has accepted by name.

Everything else stays as it is: guard, limits and the stop are the host's and the drive's as ever. What changes is what
may be said: nobody is to be told that the drive will stop the shaft by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.drive import Preflight
from drivers.errors import CommunicationLost
from drivers.no_watchdog import ACCEPTED_BY, ANY_CLIENT, FLAG, NOTHING_STOPS_IT, SHARED_FLAG

SAID = f"no watchdog is armed in the drive, {ACCEPTED_BY}: {NOTHING_STOPS_IT}"
SAID_SHARED = f"the drive's watchdog is no answer to a dead host, accepted by {SHARED_FLAG}: {ANY_CLIENT}"
_WARNING_SHARED = (
    f"the drive's watchdog was fed by any client, accepted by {SHARED_FLAG}: while another one went on asking, it would"
    " not have stopped by itself had this computer, the program or the cable failed"
)
_STEP_SHARED = (
    "If the shaft still turns, use the hard-wired emergency stop now: requests of any other client keep this drive's"
    f" watchdog from acting ({SHARED_FLAG}). Then check supply, cable and adapter"
)
_WARNING = (
    f"no watchdog was armed in the drive, {ACCEPTED_BY}: it would not have stopped by itself had this computer, the"
    " program or the cable failed"
)
_STEP = (
    f"If the shaft still turns, use the hard-wired emergency stop now: no watchdog is armed in this drive ({FLAG})."
    " Then check supply, cable and adapter"
)


def configuration(preflight: Preflight) -> dict[str, Any]:
    """For the log, under `watchdog`; nothing where one is armed that this host alone feeds."""
    if preflight.watched and preflight.fed_by_any_client:
        return {"watchdog": {"armed": True, "fed_by_any_client": True, "accepted_by": SHARED_FLAG}}
    return {} if preflight.watched else {"watchdog": {"armed": False, "accepted_by": FLAG}}


def warnings(run: Mapping[str, Any]) -> tuple[str, ...]:
    """For the result, from the log's configuration: the same live and replayed."""
    found = run.get("watchdog")
    if not isinstance(found, Mapping):
        return ()
    if found.get("fed_by_any_client") is True:
        return (_WARNING_SHARED,)
    return (_WARNING,) if found.get("armed") is False else ()


def correct(error: BaseException, preflight: Preflight | None) -> None:
    """Whoever can't reach the drive any more says that its watchdog acts; here none does."""
    if isinstance(error, CommunicationLost) and preflight is not None:
        if not preflight.watched:
            error.next_step = _STEP
        elif preflight.fed_by_any_client and not preflight.identity.simulated:
            error.next_step = _STEP_SHARED
