"""Warnings of a run itself, for its result of any kind: the same live and in replay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from profiles import CodedText
from tdhil.errors import MessageCode

_STOP_UNSEEN = CodedText(
    "the stop of this run was NOT confirmed: standstill was not observed at its end", MessageCode.STOP_WAS_NOT_CONFIRMED
)


def run_warnings(run: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the warnings from the log's configuration: stop, watchdog, unit of speed, other masters."""
    from tdhil.runner import precondition_warnings, speed_warnings, stage_warnings

    # A run whose stop was not confirmed has no result of its own; its replay has one.
    stop = run.get("stop")
    unseen = isinstance(stop, Mapping) and stop.get("confirmed") is False
    return (
        *((_STOP_UNSEEN,) if unseen else ()), *precondition_warnings(run), *speed_warnings(run), *stage_warnings(run)
    )
