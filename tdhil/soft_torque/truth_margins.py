"""Margins of one controller on every truth of a case."""

from __future__ import annotations

from tdhil.soft_torque.controller import SpeedController
from tdhil.soft_torque.stability import LoopMargins, RequiredMargins, StringResponses, least_of, loop_margins
from tdhil.soft_torque.tune_case import TuneCase


class TruthMargins:
    """Truths of one case. The frequency response of each string is computed once and kept."""

    def __init__(self, case: TuneCase) -> None:
        self.truths = case.truths()
        self.responses = StringResponses()

    def margins(self, number: int, law: SpeedController) -> LoopMargins:
        truth = self.truths[number]
        return loop_margins(truth.drive, law, truth.string, self.responses.of(truth.string, truth.drive, law))

    def every(self, law: SpeedController | None) -> LoopMargins:
        """Return the least of each margin over all truths. ``law`` None: each truth's present gains are used."""
        return least_of([self.margins(k, law or truth.present or SpeedController(0.0, 0.0))
                         for k, truth in enumerate(self.truths)])

    def keeps(self, law: SpeedController, required: RequiredMargins) -> bool:
        """Return whether the controller has the required margins on every truth."""
        return not any(required.failed(self.margins(k, law)) for k in range(len(self.truths)))
