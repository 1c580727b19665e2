"""The paper's printed figures that ours are put beside, and what follows from them alone: its single runs."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from profiles import DataModel, parse_model
from tdhil.studies.paper.orthogonal_design import Factor, runs_from_means, shipped_arrays


class PublishedFactor(DataModel):
    """One column of Table 6 or 7."""

    letter: str
    name: str
    levels: tuple[float, ...]
    mean_inertia_kg_m2: tuple[float, ...]
    range_kg_m2: float


class PublishedDesign(DataModel):
    """Table 6 or 7, with the array and the levels behind it."""

    study: str
    source: str
    array: str
    factors: tuple[PublishedFactor, ...]

    @property
    def as_factors(self) -> tuple[Factor, ...]:
        """The same factors, as a design wants them."""
        return tuple(Factor(name=factor.name, levels=factor.levels) for factor in self.factors)

    @property
    def runs_kg_m2(self) -> tuple[float, ...]:
        """J of every run, which the paper doesn't print: its arrays are saturated, so the level means fix them."""
        return runs_from_means(shipped_arrays()[self.array], [factor.mean_inertia_kg_m2 for factor in self.factors])


class PublishedGains(DataModel):
    """Section 3.4.3."""

    step: float
    sine: float


class Published(DataModel):
    """Everything in published.yaml."""

    true_inertia_kg_m2: float
    designs: tuple[PublishedDesign, ...]
    gains: PublishedGains

    def design(self, study: str) -> PublishedDesign:
        """Table 6 or Table 7 by the name of its study."""
        return next(design for design in self.designs if design.study == study)


@cache
def published() -> Published:
    """The data file beside this module."""
    name = "published.yaml"
    return parse_model(files("tdhil.studies.paper").joinpath(name).read_text(encoding="utf-8"), name, Published)
