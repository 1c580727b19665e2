"""What a stopping rule means for the result: intervals a little wider, so that they cover as asked after looking."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from tdhil.estimation.result import Identification, Verdict


def working_confidence_of(run: Mapping[str, Any], confidence: float) -> float:
    """The confidence to identify with; ``confidence`` itself where stage 5 had a fixed length.

    The run's own is in its log. Another one, asked for in a replay, is worked out by the same rule. A log that was cut
    before the first look owes nothing to it.
    """
    stopping = run.get("stopping")
    if not isinstance(stopping, Mapping) or not stopping.get("decisions"):
        return confidence
    last = stopping["decisions"][-1]
    if stopping.get("confidence") == confidence:
        return float(last["working_confidence"])
    from tdhil.run.design.stopping_rule import interval_confidence

    return interval_confidence(confidence, float(stopping["pilot_dof"]), int(last["seen"]))


def after_looks(found: Identification, run: Mapping[str, Any], confidence: float) -> Identification:
    """The result under the confidence that it holds with, and what would have brought the tolerance within reach."""
    stopping = run.get("stopping")
    if not isinstance(stopping, Mapping):
        return found
    if found.inertia is not None:
        found = replace(found, inertia=replace(found.inertia, confidence=confidence))
    if found.verdict is Verdict.VALID_WIDE and stopping.get("advice"):
        found = replace(found, advice=str(stopping["advice"]))
    return found
