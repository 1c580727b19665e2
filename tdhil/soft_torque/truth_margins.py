"""Margins of one controller on every truth of a case."""

from __future__ import annotations

from tdhil.soft_torque.controller import SpeedController
from tdhil.soft_torque.stability import (
    LoopMargins,
    RequiredMargins,
    StringResponse,
    highest_crossover,
    least_of,
    loop_margins,
    response_of,
)
from tdhil.soft_torque.tune_case import TuneCase


class TruthMargins:
    """Truths of one case. The frequency response of each string is computed once and kept."""

    def __init__(self, case: TuneCase) -> None:
        self.truths = case.truths()
        self._responses: dict[int, StringResponse] = {}

    def margins(self, number: int, law: SpeedController) -> LoopMargins:
        truth = self.truths[number]
        top = highest_crossover(truth.drive, law)
        known = self._responses.get(number)
        if known is None or known.omega_rad_s[-1] < 0.98 * top:
            known = self._responses[number] = response_of(truth.string, 1.3 * top)
        return loop_margins(truth.drive, law, truth.string, known)

    def every(self, law: SpeedController | None) -> LoopMargins:
        """Return the least of each margin over all truths. ``law`` None: each truth's present gains are used."""
        return least_of([self.margins(k, law or truth.present or SpeedController(0.0, 0.0))
                         for k, truth in enumerate(self.truths)])

    def keeps(self, law: SpeedController, required: RequiredMargins) -> bool:
        """Return whether the controller has the required margins on every truth."""
        return not any(required.failed(self.margins(k, law)) for k in range(len(self.truths)))
