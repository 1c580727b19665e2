"""The result of every study: tables, statements that hold or don't, a document for machines, and a picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Cell = str | int | float | None


@dataclass(frozen=True)
class ResultTable:
    """Written as one CSV and printed as one table. Units stand in the column names (``inertia_kg_m2``)."""

    name: str                                  # file stem, and heading when printed
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


@dataclass(frozen=True)
class Statement:
    """One thing that was published, whether it holds here, and by how much.

    ``holds`` is None where the paper contradicts itself or leaves a setting open: then ``ours`` says so, and no
    parameter is bent to make it true.
    """

    text: str
    published: str
    ours: str
    holds: bool | None


@dataclass(frozen=True)
class StudyOutcome:
    """``draw`` draws on an empty matplotlib figure; it is not called where there is no matplotlib."""

    name: str
    title: str
    tables: tuple[ResultTable, ...]
    statements: tuple[Statement, ...] = ()
    document: Mapping[str, Any] = field(default_factory=dict)      # for --json, beside tables and statements
    simulated_s: float = 0.0                                       # plant time, all runs added up
    simulation_wall_s: float = 0.0                                 # what simulating that took; not in the document
    draw: Callable[[Figure], None] | None = None
    figure_size_in: tuple[float, float] = (8.0, 5.0)
    interrupted: bool = False                                      # by Ctrl-C: the figures are of what was done by then


Progress = Callable[[float, str], None]
"""Share done (0 to 1) and what is being done."""


class Study(Protocol):
    """One experiment. ``settings`` is its pydantic model (frozen, units in field names), made from file and --set."""

    name: str
    title: str

    @property
    def settings_model(self) -> type[Any]: ...

    def run(self, settings: Any, progress: Progress) -> StudyOutcome: ...
