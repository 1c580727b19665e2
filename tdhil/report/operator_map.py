"""Operator's map of a tuning: set speed × bit torque, for the document and the page."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table as Grid
from rich.text import Text as Words

from tdhil.report.blocks import Column, Picture, ReportSection, Table, Text
from tdhil.report.console import PlainConsole
from tdhil.report.figure_words import words_of
from tdhil.soft_torque import OperatorMap

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

Part = Mapping[str, Any]

_COLOURED = {"Green": "stable", "Yellow": "at risk", "Red": "stick-slip"}
HOW_TO_READ = (
    "Find the bit torque or the weight on bit on the left, and the set speed below. "
    + " ".join(f"{colour}: {words_of(state)}" for colour, state in _COLOURED.items())
    + " From yellow, raise the set speed into green. At a yellow speed, a bit that sticks again stays stuck.")
_COLOURS = {"stable": "#7fbf7f", "at risk": "#f2d16b", "stick-slip": "#d9695f"}


def map_document(found: OperatorMap) -> dict[str, Any]:
    """Return the map as plain data: a row for each bit torque, a cell for each set speed."""
    return {"speeds_rpm": list(found.speeds_rpm), "bit_torques_nm": list(found.bit_torques_nm),
            "weights_on_bit_kn": None if found.weights_on_bit_kn is None else list(found.weights_on_bit_kn),
            "states": {kind: [list(row) for row in rows] for kind, rows in found.states.items()},
            "how_to_read": HOW_TO_READ}


def map_section(document: Part, bit: str) -> ReportSection:
    """Return figure and table of the map."""
    kinds = list(document["states"])
    width = 0.8 / len(kinds)
    weights = document.get("weights_on_bit_kn")
    title, rows = _rows(document)
    return ReportSection("The operator's map", (
        Picture("map", partial(draw_map, document=document), 2.9, HOW_TO_READ),
        Table((Column(title, 0.2), *(Column(kind, width) for kind in kinds)), rows),
        Text(f"Simulated every {document['speeds_rpm'][1] - document['speeds_rpm'][0]:.0f} rpm, with bit noise; string "
             f"and J have their stated values. The bit is that of string.yaml ({bit}), with its torque scaled. The bit "
             "torque is that of a bit that turns fast." + ("" if weights is None else " Weight on bit: the bit torque "
             "over torque_per_weight_nm_kn of string.yaml.")),
    ))


def map_figures(document: Part) -> tuple[str, ...]:
    """Return the names of the columns and of the states."""
    return (_rows(document)[0], *document["states"], *_COLOURED.values())


def print_map(document: Part, console: PlainConsole) -> None:
    """Print the map: for each bit torque, the set speeds in words."""
    title, rows = _rows(document)
    console.print(Words("map of bit torque and set speed; at risk between the two speeds", style="bold"))
    grid = Grid(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name in (title, *document["states"]):
        grid.add_column(name)
    for row in rows:
        grid.add_row(*row)
    console.print(grid)
    console.print()


def _rows(document: Part) -> tuple[str, tuple[tuple[str, ...], ...]]:
    """Return the title of the first column, and a row for each bit torque: the torque, then each controller.

    A controller's text: the speed from which the row is stable, and the speed up to which the bit sticks.
    """
    weights = document.get("weights_on_bit_kn")
    speeds_rpm, rows = document["speeds_rpm"], []
    for k, torque in enumerate(document["bit_torques_nm"]):
        cells = [f"{torque / 1e3:.2g} kN·m" + ("" if weights is None else f", {weights[k]:.3g} kN")]
        for every in document["states"].values():
            states = every[k]
            stable = next((speed for at, speed in enumerate(speeds_rpm) if all(one == "stable" for one in states[at:])),
                          None)
            sticking = [speed for speed, one in zip(speeds_rpm, states, strict=True) if one == "stick-slip"]
            cells.append((f"not stable up to {speeds_rpm[-1]:.0f} rpm" if stable is None
                          else f"stable from {stable:.0f} rpm")
                         + (f", stick-slip up to {sticking[-1]:.0f}" if sticking else ""))
        rows.append(tuple(cells))
    return "bit torque" if weights is None else "bit torque, weight on bit", tuple(rows)


def draw_map(figure: FigureBase, document: Part) -> None:
    """Draw a field of cells for each controller."""
    kinds, speeds = list(document["states"]), document["speeds_rpm"]
    torques = [torque / 1e3 for torque in document["bit_torques_nm"]]
    step, rise = speeds[1] - speeds[0], torques[1] - torques[0]
    every = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
    for axes, kind in zip(every, kinds, strict=True):
        for torque, row in zip(torques, document["states"][kind], strict=True):
            for speed, state in zip(speeds, row, strict=True):
                axes.bar(speed, rise, step, torque - 0.5 * rise, color=_COLOURS[state], edgecolor="white", lw=0.4)
        # below the axes, because a report's figure has no room for a title above them
        axes.set(xlabel=f"{kind}: set speed, rpm", xlim=(speeds[0] - 0.5 * step, speeds[-1] + 0.5 * step),
                 ylim=(torques[0] - 0.5 * rise, torques[-1] + 0.5 * rise))
    every[0].set_ylabel("bit torque, kN·m")
    weights = document.get("weights_on_bit_kn")
    if weights is not None:      # the same axis, in the unit that the driller sets
        every[0].set_yticks(torques, [f"{weight:.3g}" for weight in weights])
        every[0].set_ylabel("weight on bit, kN")


__all__ = ["HOW_TO_READ", "draw_map", "map_document", "map_figures", "map_section"]
