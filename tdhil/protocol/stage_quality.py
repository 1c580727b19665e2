"""How well a stage was seen: from what went wrong on the bus and in the loop while it ran. Pure."""

from __future__ import annotations

from drivers.drive import Counters

TOLERATED_LOSS = 0.01
"""A stage with a larger share of cycles without feedback counts as degraded; a few are an ordinary scheduler's."""

TOLERATED_LATE = 0.05
"""The same for cycles that began late, and for feedback that came after its cycle or twice."""

FEW_LATE = 10
"""So many of these are nothing, in however short a stage."""


def stage_quality(before: Counters, after: Counters) -> tuple[str, str]:
    """(``ok`` or ``degraded``, what there is to say)."""
    cycles = after.cycles - before.cycles
    parts, outcome = [], "ok"
    some_late = max(FEW_LATE, TOLERATED_LATE * cycles)
    for count, tolerated, text in (
        (after.missed - before.missed, TOLERATED_LOSS * cycles, "without feedback"),
        (after.late - before.late, some_late, "with feedback that came late or twice"),
        (after.overruns - before.overruns, some_late, "that began late"),
    ):
        if count:
            parts.append(f"{count} of {cycles} cycles {text}")
        if count > tolerated:
            outcome = "degraded"
    errors, passive = after.error_frames - before.error_frames, after.passive - before.passive
    if errors:
        parts.append(f"{errors} error frames" + (", the adapter was error-passive" if passive else ""))
    if passive or errors > TOLERATED_LOSS * cycles:
        outcome = "degraded"
    return outcome, ", ".join(parts)
