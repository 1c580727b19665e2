"""Recording in, Identification out; pure numpy and scipy, knows no drive and no file."""

from tdhil.identify.identification import (
    BudgetLine,
    Compliant,
    Estimate,
    FrictionPoint,
    Identification,
    InertiaEstimate,
    LineFit,
    PaperEstimate,
    ResidualTest,
    SecondOpinion,
    Verdict,
)
from tdhil.identify.identify import identify
from tdhil.identify.options import Options
from tdhil.identify.rough import RoughFriction, RoughInertia, rough_friction, rough_inertia

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
