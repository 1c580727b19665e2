"""The case that identification works on, and the finding that a route brings back: what every verdict is made of."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from tdhil.estimation.friction_levels import Levels, ViscousConstraint
from tdhil.estimation.result import (
    REJECT_P,
    BudgetLine,
    Compliant,
    Estimate,
    FrictionPoint,
    LinePoint,
    Options,
    PaperEstimate,
    Refusal,
    ResidualTest,
    SecondOpinion,
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
    """A recording, the options of its identification, and the results so far.

    ``recording``: up to the ``aborted`` stage, if one was. ``levels``: of the excited segments; None without any.
    ``sound``: the data passed their own checks, so a cross-check with them makes sense.
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
    """A case with periodic excitation: its whole periods, their lines, and B from the levels.

    ``every``: the lines pooled over the segments. ``lines``: those where both signals stand clear of the scatter;
    ``usable``: where one of them does.
    """

    levels: Levels
    stretches: tuple[Stretch, ...]
    fits: tuple[PeriodLines, ...]
    constraint: ViscousConstraint | None
    every: tuple[SpectralLine, ...]
    lines: tuple[SpectralLine, ...] = ()
    usable: tuple[SpectralLine, ...] = ()


@dataclass(frozen=True)
class ModelWords:
    """A model in the reader's words, and what to do next: where the data contradict it, where its interval is wide.

    ``what`` ``explains`` the data; ``spread``: what is called too wide; ``digits``: of p where it is contradicted.
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


@dataclass(frozen=True)
class Finding:
    """The result of one route for a case, in the same form for every route; `conclude` adds the verdict.

    ``inertia``: bounded estimate; None if the residuals contradict the model (which then gives nothing else), or if the
    data do not determine it (``refusal``). ``conditions``: what J is conditional on besides the
    torque scale. ``bent``: the model has friction that is no straight line over speed. ``samples_used``: None for the
    case's own. ``preface`` and ``remark`` stand before and after the sentence on the model. ``reading_kg_m2``: by how
    much more J may be off on either side for the moment at which torque is read; ``advice``: instead of the usual.
    ``contradiction``: what else in the same run contradicts J beyond chance, so that J does not stand.
    ``reject_p``: the p-value below which the residuals contradict the model. ``curve``: the model over frequency;
    ``settled``: its lines without residual oscillation, () for the case's own.
    """

    model: str = "none"
    words: ModelWords = _WORDLESS
    residual: ResidualTest | None = None
    refusal: Refusal = _NONE
    inertia: Estimate | None = None
    conditions: tuple[str, ...] = ()
    viscous_nm_s_rad: Estimate | None = None
    coulomb_nm: Estimate | None = None
    speed_lag_s: Estimate | None = None
    torque_lag_s: Estimate | None = None
    skew_s: Estimate | None = None
    bent: bool = False
    compliant: Compliant | None = None
    budget: tuple[BudgetLine, ...] = ()
    lines: tuple[LinePoint, ...] = ()
    warnings: tuple[str, ...] = ()
    samples_used: int | None = None
    preface: str = ""
    remark: str = ""
    second_opinions: tuple[SecondOpinion, ...] = ()
    friction_curve: tuple[FrictionPoint, ...] = ()
    reading_kg_m2: float = 0.0
    advice: str = ""
    contradiction: Refusal = _NONE
    reject_p: float = REJECT_P
    curve: ResponseCurve | None = None
    settled: tuple[SpectralLine, ...] = ()

    @property
    def rejected(self) -> bool:
        """Do the data contradict the model?"""
        return rejects(self.residual, self.reject_p)

    def taken_back(self, contradiction: Refusal) -> "Finding":
        """Return what is left where something else in the run contradicts J: no inertia, no figure that needs it."""
        return Finding(
            self.model, self.words, self.residual, lines=self.lines, samples_used=self.samples_used,
            warnings=self.warnings, contradiction=contradiction,
        )

    @property
    def contradicted(self) -> str:
        """The sentence on a model that the data contradict."""
        p_value = "" if self.residual is None else f" (p = {self.residual.p_value:.{self.words.digits}g})"
        return f"the residuals contradict {self.words.what}{p_value}{self.remark}"

    @property
    def explained(self) -> str:
        """The sentence on a model that stands."""
        tested = ", untested" if self.residual is None else f" (p = {self.residual.p_value:.2g})"
        return f"{self.preface}{self.words.what} {self.words.explains}{tested}{self.remark}"
