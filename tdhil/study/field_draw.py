"""How the pictures of the field studies look: colours, grid, the mark of a published number."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#1f5fa8", "#d1642a", "#2e8b57", "#8b3fa0", "#a08020", "#3aa0b5", "#7a7a7a")
PUBLISHED: dict[str, Any] = {
    "color": "black", "marker": "D", "linestyle": "none", "markersize": 6, "markerfacecolor": "none"
}
"""Published numbers stand out as hollow black diamonds in every picture."""


def tidy(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Labels, a light grid, no box."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if title:
        axes.set_title(title, fontsize=10)
    axes.grid(True, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def colour(index: int) -> str:
    """The same index, the same colour, in every panel."""
    return COLOURS[index % len(COLOURS)]
