"""Recording in, Identification out; pure numpy and scipy, knows no drive and no file."""

from tdhil.estimation.identification import identify
from tdhil.estimation.paper_method import (
    STEP_S,
    line_fit,
    paper_estimate,
)
from tdhil.estimation.result import (
    BudgetLine,
    Compliant,
    Estimate,
    FrictionPoint,
    Identification,
    InertiaEstimate,
    LineFit,
    Options,
    PaperEstimate,
    ResidualTest,
    SecondOpinion,
    Verdict,
)
from tdhil.estimation.rough_estimates import RoughFriction, RoughInertia, rough_friction, rough_inertia
from tdhil.estimation.samples import (
    STICK_SLIP_REGULAR,
    STICK_SLIP_SHARE,
    Samples,
    Stretch,
    excited_window,
    repeats,
    stretches,
    usable_samples,
)

__all__ = [
    "STEP_S",
    "STICK_SLIP_REGULAR",
    "STICK_SLIP_SHARE",
    "BudgetLine",
    "Compliant",
    "Estimate",
    "FrictionPoint",
    "Identification",
    "InertiaEstimate",
    "LineFit",
    "Options",
    "PaperEstimate",
    "ResidualTest",
    "RoughFriction",
    "RoughInertia",
    "Samples",
    "SecondOpinion",
    "Stretch",
    "Verdict",
    "excited_window",
    "identify",
    "line_fit",
    "paper_estimate",
    "repeats",
    "rough_friction",
    "rough_inertia",
    "stretches",
    "usable_samples",
]
