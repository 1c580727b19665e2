"""The paper's printed figures for comparison, and the single runs that follow from them."""

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
        """Return the same factors in the form that a design uses."""
        return tuple(Factor(name=factor.name, levels=factor.levels) for factor in self.factors)

    @property
    def runs_kg_m2(self) -> tuple[float, ...]:
        """J of every run, which the paper does not print: its arrays are saturated, so the level means determine
        them.
        """
        return runs_from_means(shipped_arrays()[self.array], [factor.mean_inertia_kg_m2 for factor in self.factors])


class PublishedGains(DataModel):
    """Gains of section 3.4.3."""

    step: float
    sine: float


class Published(DataModel):
    """Content of published.yaml."""

    true_inertia_kg_m2: float
    designs: tuple[PublishedDesign, ...]
    gains: PublishedGains

    def design(self, study: str) -> PublishedDesign:
        """Return Table 6 or Table 7 by the name of its study."""
        return next(design for design in self.designs if design.study == study)


@cache
def published() -> Published:
    """Return the content of the data file beside this module."""
    name = "published.yaml"
    return parse_model(files("tdhil.studies.paper").joinpath(name).read_text(encoding="utf-8"), name, Published)
