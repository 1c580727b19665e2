"""The data that identification works on (`Case`), and the result of one route (`Finding`), from which the verdict is
made.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from tdhil.estimation.friction_levels import Levels, ViscousConstraint
from tdhil.estimation.result import (
    REJECT_P,
    Estimate,
    ModelResult,
    Options,
    PaperEstimate,
    Refusal,
    TorqueRatio,
    rejects,
)
from tdhil.estimation.samples import Samples, Stretch
from tdhil.estimation.spectrum import ComplexArray, PeriodLines, SpectralLine
from tdhil.recording import FloatArray, Recording, Stage


def _no_samples() -> Samples:
    return Samples(np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Case:
    """Recording, options of its identification, and the results so far.

    ``recording``: the data, up to the ``aborted`` stage if a stage was aborted. ``levels``: mean operating points of
    the excited segments; None without any. ``sound``: the data passed their own checks, so cross-checks may use them.
    """

    recording: Recording
    options: Options
    aborted: Stage | None = None
    samples: Samples = field(default_factory=_no_samples)
    paper: PaperEstimate | None = None
    periods_used: int = 0
    samples_used: int = 0
    warnings: tuple[str, ...] = ()
    levels: Levels | None = None
    sound: bool = False
    torque_ratios: tuple[TorqueRatio, ...] = ()


@dataclass(frozen=True, kw_only=True)
class PeriodicCase(Case):
    """Case with periodic excitation: its whole periods, their spectral lines, and B from the mean operating points.

    ``every``: the lines pooled over the segments. ``lines``: those where both signals are clear of the scatter;
    ``usable``: those where at least one signal is. ``undeclared``: warnings of undeclared motion in
    the reported samples.
    """

    levels: Levels
    stretches: tuple[Stretch, ...]
    fits: tuple[PeriodLines, ...]
    constraint: ViscousConstraint | None
    every: tuple[SpectralLine, ...]
    undeclared: tuple[str, ...] = ()
    lines: tuple[SpectralLine, ...] = ()
    usable: tuple[SpectralLine, ...] = ()


@dataclass(frozen=True)
class ModelWords:
    """Words for a model, and the advice if the data contradict it or its interval is wide.

    ``what`` and ``explains``: subject and verb of the sentence on the model. ``spread``: the quantity that is too wide.
    ``digits``: digits of p in the message of a contradiction.
    """

    what: str = ""
    if_rejected: str = ""
    if_wide: str = ""
    explains: str = "explains the data"
    spread: str = "interval"
    digits: int = 1


class ResponseCurve(Protocol):
    """A fitted model over frequency."""

    def at(self, hertz: FloatArray) -> tuple[ComplexArray, FloatArray, FloatArray]:
        """Return T/ω (K,), N·m·s/rad, and the half-widths of its interval: relative magnitude, and phase, rad."""


_NONE, _WORDLESS = Refusal("", ""), ModelWords()


@dataclass(frozen=True, kw_only=True)
class Finding(ModelResult):
    """Result of one route for a case, in the same form for every route. `conclude` adds the verdict.

    ``inertia``: bounded estimate; None if the residuals contradict the model (no other value is then given), or if the
    data do not determine J (``refusal``). ``conditions``: conditions of J besides the torque scale. ``bent``: the
    friction of the model is nonlinear in speed. ``samples_used``: None for the number of the case. ``preface`` and
    ``remark``: text before and after the sentence on the model. ``reading_kg_m2``: additional error of J, on either
    side, due to the moment at which torque is read. ``speed_scale_share``: difference of J, as a share, if the angle of
    the shaft is right and the reported speed is not; it counts as half of a 95 % interval. ``advice``: replaces the
    usual advice. ``contradiction``: evidence in the same run that contradicts J beyond chance; J is then not valid.
    ``reject_p``: the p-value below which the residuals contradict the model. ``curve``: the model over frequency;
    ``settled``: lines without residual oscillation; () for the lines of the case.
    """

    words: ModelWords = _WORDLESS
    refusal: Refusal = _NONE
    inertia: Estimate | None = None
    conditions: tuple[str, ...] = ()
    bent: bool = False
    samples_used: int | None = None
    preface: str = ""
    remark: str = ""
    reading_kg_m2: float = 0.0
    speed_scale_share: float = 0.0
    advice: str = ""
    contradiction: Refusal = _NONE
    reject_p: float = REJECT_P
    curve: ResponseCurve | None = None
    settled: tuple[SpectralLine, ...] = ()

    @property
    def rejected(self) -> bool:
        """True if the data contradict the model."""
        return rejects(self.residual, self.reject_p)

    def taken_back(self, contradiction: Refusal) -> "Finding":
        """Return the finding without an inertia, and without figures that need it, after another signal contradicted
        J.
        """
        return Finding(
            model=self.model, words=self.words, residual=self.residual, lines=self.lines,
            samples_used=self.samples_used, warnings=self.warnings, contradiction=contradiction,
            bent=self.bent, harmonics=self.harmonics, least_harmonics=self.least_harmonics, backlash=self.backlash,
            backlash_motion=self.backlash_motion,
        )

    @property
    def contradicted(self) -> str:
        """Sentence on a model that the data contradict."""
        p_value = "" if self.residual is None else f" (p = {self.residual.p_value:.{self.words.digits}g})"
        return f"the residuals contradict {self.words.what}{p_value}{self.remark}"

    @property
    def explained(self) -> str:
        """Sentence on a model that the data do not contradict."""
        tested = ", untested" if self.residual is None else f" (p = {self.residual.p_value:.2g})"
        return f"{self.preface}{self.words.what} {self.words.explains}{tested}{self.remark}"
