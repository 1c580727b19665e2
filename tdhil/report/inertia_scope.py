"""Scope of an inertia: the bodies to which the J of a result refers.

A rigid shaft gives the J of all that turns. A compliant shaft gives J_r, that of the motor's side. Two results are one
series, a difference or an acceptance only if their scope is the same.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from profiles import MessageCode, entry_of
from tdhil.estimation import Identification
from tdhil.recording import Recording


class InertiaScope(StrEnum):
    """Bodies to which J refers, as the document's ``inertia_scope`` states them."""

    MOTOR_AND_LOAD = "motor_and_load"
    MOTOR_SIDE = "motor_side"
    MOTOR_AND_STRING = "motor_and_string"
    UNCLEAR = "unclear"


_TEXTS: Final = {
    InertiaScope.MOTOR_AND_LOAD: "J of motor and load together",
    InertiaScope.MOTOR_SIDE: "J_r, the motor's side of a compliant shaft",
    InertiaScope.MOTOR_AND_STRING: "J of motor and string together",
    InertiaScope.UNCLEAR: "J of the motor, with or without the string",
}


def scope_of(found: Identification, recording: Recording) -> InertiaScope | None:
    """Return the scope of the result's J; None without a J."""
    if found.inertia is None:
        return None
    if found.compliant is not None:
        return InertiaScope.MOTOR_SIDE
    if not recording.has_drill_string:
        return InertiaScope.MOTOR_AND_LOAD
    codes = {entry_of(one, MessageCode.RESULT_WARNING) for one in found.warnings}
    return (InertiaScope.MOTOR_AND_STRING if MessageCode.STRING_MOVES_WITH_MOTOR in codes else InertiaScope.UNCLEAR)


def scope_text(scope: str | None) -> str:
    """Return the scope in words. A row of an earlier version states none."""
    return "J of bodies that are not stated" if scope is None or scope not in _TEXTS else _TEXTS[InertiaScope(scope)]
