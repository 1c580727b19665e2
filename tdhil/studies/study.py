"""Result of any study: tables, statements that hold or do not, a JSON document, and a plot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Cell = str | int | float | None


@dataclass(frozen=True)
class ResultTable:
    """Table, written as one CSV and printed. Units are in the column names (``inertia_kg_m2``)."""

    name: str                                  # file stem, and heading in print
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


@dataclass(frozen=True)
class Statement:
    """Published statement, whether tdhil confirms it, and by how much.

    ``holds`` is None if the paper contradicts itself or does not state a setting. ``ours`` then states this, and no
    parameter is adjusted to make the statement true.
    """

    text: str
    published: str
    ours: str
    holds: bool | None


@dataclass(frozen=True)
class StudyOutcome:
    """Outcome. ``draw`` draws on an empty matplotlib figure; it is not called without matplotlib."""

    name: str
    title: str
    tables: tuple[ResultTable, ...]
    statements: tuple[Statement, ...] = ()
    document: Mapping[str, Any] = field(default_factory=dict)      # for --json, besides tables and statements
    simulated_s: float = 0.0                                       # plant time of all runs together
    simulation_wall_s: float = 0.0                                 # wall time of the simulation; not in the document
    draw: Callable[[Figure], None] | None = None
    figure_size_in: tuple[float, float] = (8.0, 5.0)
    interrupted: bool = False                                      # by Ctrl-C: the figures are of the completed runs


Progress = Callable[[float, str], None]
"""Function that receives the completed share (0 to 1) and the present step."""


class Study(Protocol):
    """One experiment. ``settings``: its pydantic model (frozen, units in field names), filled from file and --set."""

    name: str
    title: str

    @property
    def settings_model(self) -> type[Any]: ...

    def run(self, settings: Any, progress: Progress) -> StudyOutcome: ...
