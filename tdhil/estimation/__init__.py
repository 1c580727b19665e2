"""Recording in, Identification out; pure numpy and scipy, knows no drive and no file."""

from tdhil.estimation.identify import identify
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
from tdhil.estimation.rough_inertia import RoughFriction, RoughInertia, rough_friction, rough_inertia

__all__ = [
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
    "SecondOpinion",
    "Verdict",
    "identify",
    "rough_friction",
    "rough_inertia",
]
