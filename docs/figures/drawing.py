"""A small SVG writer for the figures of the pages: the same data give the same bytes, on every computer.

Lengths are in pixels of the figure. The background is light, so that a figure can be read on a dark page too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

INK, QUIET, GRID, PAPER = "#1f2933", "#5b6770", "#d9dfe5", "#fbfcfd"
BLUE, ORANGE, GREEN, RED = "#1f5fa8", "#c2410c", "#1a7f37", "#b42318"
PALE_BLUE, PALE_ORANGE, PALE_GREEN, PALE_RED = "#e3edf8", "#fbe9df", "#e2f2e6", "#fae3e1"

Points = Iterable[tuple[float, float]]


class Drawing:
    """Elements of one figure, in the order in which they are drawn."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self.width, self.height, self.title = width, height, title
        self.parts: list[str] = []

    def rect(
        self, x: float, y: float, width: float, height: float, fill: str, stroke: str = "none", radius: float = 0.0
    ) -> None:
        """Draw a rectangle from its upper left corner."""
        self.parts.append(
            f'<rect x="{_n(x)}" y="{_n(y)}" width="{_n(width)}" height="{_n(height)}" rx="{_n(radius)}" '
            f'fill="{fill}" stroke="{stroke}"/>'
        )

    def line(self, points: Points, stroke: str = INK, width: float = 1.5, dash: str = "", arrow: bool = False) -> None:
        """Draw straight pieces through the points; ``arrow`` puts a head at the last one."""
        path = " ".join(f"{_n(x)},{_n(y)}" for x, y in points)
        more = f' stroke-dasharray="{dash}"' if dash else ""
        more += ' marker-end="url(#head)"' if arrow else ""
        self.parts.append(
            f'<polyline points="{path}" fill="none" stroke="{stroke}" stroke-width="{_n(width)}" '
            f'stroke-linejoin="round"{more}/>'
        )

    def area(self, points: Points, fill: str) -> None:
        """Fill the polygon through the points."""
        path = " ".join(f"{_n(x)},{_n(y)}" for x, y in points)
        self.parts.append(f'<polygon points="{path}" fill="{fill}" stroke="{fill}" stroke-width="0.6"/>')

    def dot(self, x: float, y: float, fill: str = INK, radius: float = 4.0) -> None:
        """Draw a filled circle."""
        self.parts.append(f'<circle cx="{_n(x)}" cy="{_n(y)}" r="{_n(radius)}" fill="{fill}"/>')

    def text(
        self,
        x: float,
        y: float,
        text: str,
        *,
        size: float = 13.0,
        fill: str = INK,
        anchor: str = "start",
        bold: bool = False,
        turn: float = 0.0,
    ) -> None:
        """Write one line; ``y`` is its base line, ``turn`` degrees clockwise."""
        more = ' font-weight="600"' if bold else ""
        more += f' transform="rotate({_n(turn)} {_n(x)} {_n(y)})"' if turn else ""
        self.parts.append(
            f'<text x="{_n(x)}" y="{_n(y)}" font-size="{_n(size)}" fill="{fill}" '
            f'text-anchor="{anchor}"{more}>{escape(text)}</text>'
        )

    def box(
        self,
        x: float,
        y: float,
        width: float,
        height: float,
        lines: Sequence[str],
        *,
        fill: str = "#ffffff",
        stroke: str = QUIET,
        size: float = 13.0,
    ) -> None:
        """Draw a rounded box with centred lines, the first of them bold."""
        self.rect(x, y, width, height, fill, stroke, 6.0)
        first = y + height / 2 - (len(lines) - 1) * (size + 4) / 2 + size * 0.36
        for number, line in enumerate(lines):
            self.text(x + width / 2, first + number * (size + 4), line, size=size, anchor="middle", bold=number == 0)

    def svg(self) -> str:
        """Return the whole file."""
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" '
            f'width="{self.width}" height="{self.height}" role="img" font-family="system-ui, sans-serif">\n'
            f"<title>{escape(self.title)}</title>\n"
            f'<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
            f'orient="auto"><path d="M0,0 L10,5 L0,10 z" fill="{QUIET}"/></marker></defs>\n'
            f'<rect width="{self.width}" height="{self.height}" rx="8" fill="{PAPER}"/>\n'
        )
        return head + "\n".join(self.parts) + "\n</svg>\n"

    def save(self, path: Path) -> None:
        """Write the file."""
        path.write_text(self.svg(), encoding="utf-8")


class Axes:
    """A rectangle of a drawing with linear scales."""

    def __init__(
        self, on: Drawing, box: tuple[float, float, float, float], x: tuple[float, float], y: tuple[float, float]
    ) -> None:
        self.on, self.x, self.y = on, x, y
        self.left, self.top, self.width, self.height = box

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Return the place of a point in the drawing."""
        return (
            self.left + (x - self.x[0]) / (self.x[1] - self.x[0]) * self.width,
            self.top + self.height - (y - self.y[0]) / (self.y[1] - self.y[0]) * self.height,
        )

    def frame(self, xs: Sequence[float], ys: Sequence[float], xlabel: str = "", ylabel: str = "") -> None:
        """Draw grid, ticks and labels."""
        for value in ys:
            _, y = self.at(self.x[0], value)
            self.on.line(((self.left, y), (self.left + self.width, y)), GRID, 1.0)
            self.on.text(self.left - 8, y + 4, f"{value:g}".replace("-", "−"), size=12, fill=QUIET, anchor="end")
        for value in xs:
            x, _ = self.at(value, self.y[0])
            self.on.line(((x, self.top + self.height), (x, self.top + self.height + 4)), QUIET, 1.0)
            self.on.text(x, self.top + self.height + 18, f"{value:g}", size=12, fill=QUIET, anchor="middle")
        bottom = self.top + self.height
        self.on.line(((self.left, bottom), (self.left + self.width, bottom)), QUIET, 1.0)
        if xlabel:
            self.on.text(self.left + self.width / 2, self.top + self.height + 36, xlabel, anchor="middle")
        if ylabel:
            middle = self.top + self.height / 2
            self.on.text(self.left - 44, middle, ylabel, anchor="middle", turn=-90)

    def curve(self, points: Points, stroke: str = BLUE, width: float = 2.0, dash: str = "") -> None:
        """Draw a curve in the units of the axes."""
        self.on.line([self.at(x, y) for x, y in points], stroke, width, dash)


def _n(value: float) -> str:
    """Return a number with one decimal at most."""
    text = f"{value:.1f}"
    return text.removesuffix(".0")
