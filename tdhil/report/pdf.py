"""Report as PDF on A4: figures and letters as vectors, by matplotlib alone (docs/decisions/0009).

A sheet is filled from the top. A heading stays with the next block, and a figure with its caption. A table stays on one
sheet if that leaves little of the sheet before it empty. Otherwise it is split between rows, and its head is repeated.
Several layouts are tried, and `_Sheets.rank` chooses one. All lengths are in points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from io import BytesIO
from itertools import product
from typing import TYPE_CHECKING, Any

from tdhil.report.blocks import WIDTH_IN, AnswerBox, Column, Pairs, Picture, Report, ReportSection, Table, Text
from tdhil.report.letterhead import Letterhead
from tdhil.report.page import lay_out, repeatable_figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDE, HIGH = 595.28, 841.89
LEFT, TOP, BOTTOM = 46.0, 44.0, 796.0
INNER = WIDE - 2.0 * LEFT
BODY, SMALL = 8.6, 7.6
_LEADING = 1.36
_COLOURS = {"green": "#1a7f37", "yellow": "#8a6100", "red": "#b42318"}
_DARK, _QUIET, _RULE = "#222222", "#666666", "#cccccc"

Draw = Callable[["_Sheets", float], None]
"""Function that draws a piece at a distance from the sheet's top."""


def pdf_bytes(report: Report) -> bytes:
    """Return the whole file; the same report gives the same bytes."""
    from matplotlib.backends.backend_pdf import PdfPages

    data = BytesIO()
    title = report.title + (f" ({report.simulated})" if report.simulated else "")
    metadata = {"Title": title, "Subject": report.subtitle, "Creator": report.footer, "CreationDate": None}
    with _fonts(), PdfPages(data, metadata=metadata) as pages:
        for figure in sheets_of(report):
            pages.savefig(figure)
    return data.getvalue()


def sheets_of(report: Report) -> list[Figure]:
    """Return the sheets as figures of A4, with their feet, in the layout of the lowest rank.

    If a sheet is left too empty, the sheet before the last is tried shorter, which moves content to the last.
    """
    with _fonts():
        laid_out = [_laid_out(report, *layout) for layout in product(_PICTURE_SCALES, _MOST_EMPTY)]
        best = min(laid_out, key=lambda one: one.rank)
        count, excess, *_ = best.rank
        if excess > 0.0 and count > 1:
            laid_out += [_laid_out(report, *layout)
                         for layout in product(_PICTURE_SCALES, _MOST_EMPTY, [count - 1], _SHORTER)]
            best = min(laid_out, key=lambda one: one.rank)
        return best.drawn(report.footer)


def _laid_out(report: Report, *layout: Any) -> _Sheets:
    sheets = _Sheets(report.simulated, _running_head(report), *layout)
    _write(sheets, report)
    return sheets


def _running_head(report: Report) -> str:
    """Return the line at the top of every sheet but the first."""
    parts = (report.subtitle or report.title, *(f"{name} {text}" for name, text in report.reference))
    lines = wrapped(" · ".join(filter(None, parts)), 6.8, INNER)
    return lines[0] + (" …" if len(lines) > 1 else "")


@contextmanager
def _fonts() -> Iterator[None]:
    from matplotlib import rc_context

    fonts: Any = {"pdf.fonttype": 42, "font.family": "DejaVu Sans", "font.size": SMALL, "axes.linewidth": 0.6}
    with repeatable_figures(), rc_context(fonts):
        yield


_PICTURE_SCALES = (1.0, 0.95, 0.9, 0.85, 0.8, 0.75, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3)
"""Heights of the pictures that are tried, relative to their own. A flatter picture is hard to read."""
_MOST_EMPTY = (0.25 * (BOTTOM - TOP), 0.0)
"""Spaces that are tried: the largest that a table leaves empty on a sheet so that it stays in one piece, points."""
_SHORTER = (38.0, 76.0, 113.0, 150.0, 188.0)
"""Lengths by which the sheet before the last is tried shorter, points."""
_LEAST_FILLED = 0.53
"""Share of the last sheet's text area that is filled at least, if any layout allows it: half of the sheet.

A report of little more than one sheet cannot fill a second one: the first would be left emptier than `_MOST_LEFT`.
"""
_MOST_LEFT = 0.25
"""Share of any other sheet that is left empty at most, if any layout allows it."""


class _Sheets:
    """Sheets so far: the pieces of each with their positions. They are drawn when all is laid out.

    ``at``: the position up to which the last sheet is filled. ``scale``: relative height of the pictures.
    ``most_empty``: see `_MOST_EMPTY`. Sheet number ``short`` is ``shorter`` by these points. ``figure``: the sheet that
    is drawn.
    """

    figure: Figure

    def __init__(self, banner: str, running_head: str, scale: float, most_empty: float, short: int = 0,
                 shorter: float = 0.0) -> None:
        self._pieces: list[list[tuple[float, Draw]]] = []
        self._left: list[float] = []        # points left empty on each sheet but the last
        self.at = BOTTOM
        self.scale, self.most_empty = scale, most_empty
        self._short, self._shorter = short, shorter
        self._banner, self._running_head = banner, running_head
        self._top = TOP

    def place(self, height: float, draw: Draw, space: float = 0.0) -> None:
        """Add a piece of this height that stays together, below a space (none at the top of a sheet)."""
        if not self._pieces or (space + height > self.room() and not self.fresh):
            self.new()
        if self.fresh:
            space = 0.0
        self.at += space
        self._pieces[-1].append((self.at, draw))
        self.at += height

    def room(self, space: float = 0.0) -> float:
        """Return the height left on this sheet below a space."""
        bottom = BOTTOM - (self._shorter if max(len(self._pieces), 1) == self._short else 0.0)
        return bottom - self.at - space if self._pieces else bottom - TOP

    def new(self) -> None:
        """Begin another sheet."""
        first = not self._pieces
        if not first:
            self._left.append(BOTTOM - self.at)
        self._pieces.append([])
        self._top = self.at = TOP + (6.0 if self._banner else 0.0) + (0.0 if first else 8.0)

    @property
    def fresh(self) -> bool:
        """Return whether the last sheet is still empty."""
        return bool(self._pieces) and self.at == self._top

    @property
    def rank(self) -> tuple[int, float, bool, float, float]:
        """Return what is compared between layouts, the most important first.

        Number of sheets; by how much the emptiest sheet exceeds its limit, as a share of the sheet; then how far the
        layout is from the usual one: tables split, heights of the pictures, a shorter sheet.
        """
        high = BOTTOM - TOP
        last = (BOTTOM - self.at) / high - (1.0 - _LEAST_FILLED) if len(self._pieces) > 1 else 0.0
        excess = max(0.0, last, max(self._left, default=0.0) / high - _MOST_LEFT)
        return (len(self._pieces), round(excess, 2), self.most_empty != _MOST_EMPTY[0], abs(self.scale - 1.0),
                self._shorter)

    def drawn(self, footer: str) -> list[Figure]:
        """Draw all sheets, with a foot each."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        found = []
        for number, pieces in enumerate(self._pieces, start=1):
            self.figure = Figure(figsize=(WIDE / 72.0, HIGH / 72.0))
            FigureCanvasAgg(self.figure)
            self._head(number)
            for at, draw in pieces:
                draw(self, at)
            self.line(LEFT, HIGH - 26.0, footer, 6.8, color=_QUIET)
            page = f"page {number} of {len(self._pieces)}"
            self.line(WIDE - LEFT, HIGH - 26.0, page, 6.8, color=_QUIET, side="right")
            found.append(self.figure)
        return found

    def _head(self, number: int) -> None:
        if self._banner:
            self.box(TOP - 18.0, 15.0, LEFT, INNER, "#a21caf")
            self.line(LEFT + 6.0, TOP - 18.0 + 10.8, self._banner, SMALL, color="white", weight="bold")
        if number > 1:
            self.line(LEFT, TOP + (6.5 if self._banner else -4.0), self._running_head, 6.8, color=_QUIET)

    # -- on the sheet that is drawn -----------------------------------------------------------------------------------

    def line(self, x: float, y: float, text: str, size: float, *, color: str = _DARK, weight: str = "normal",
             style: str = "normal", side: str = "left") -> None:
        """Draw one line of text with its baseline at ``y``."""
        self.figure.text(x / WIDE, 1.0 - y / HIGH, text, fontsize=size, color=color, fontweight=weight,
                              fontstyle=style, ha=side, va="baseline", parse_math=False)

    def lines(self, x: float, y: float, texts: Sequence[str], size: float, **how: Any) -> None:
        """Draw lines below each other; ``y`` is the top of the first."""
        for number, text in enumerate(texts):
            self.line(x, y + (number + 0.78) * size * _LEADING, text, size, **how)

    def rule(self, y: float, color: str = _RULE, width: float = 0.5) -> None:
        """Draw a line across the page."""
        from matplotlib.lines import Line2D

        figure = self.figure
        figure.add_artist(Line2D((LEFT / WIDE, (LEFT + INNER) / WIDE), (1.0 - y / HIGH,) * 2, lw=width, color=color))

    def box(self, y: float, height: float, x: float, width: float, color: str) -> None:
        """Draw a filled rectangle, from its top."""
        from matplotlib.patches import Rectangle

        figure = self.figure
        figure.add_artist(Rectangle((x / WIDE, 1.0 - (y + height) / HIGH), width / WIDE, height / HIGH, lw=0.0,
                                    facecolor=color, transform=figure.transFigure))

    def image(self, y: float, x: float, size: tuple[float, float], png: bytes) -> None:
        """Draw a PNG of this width and height, with its own pixels."""
        from matplotlib.image import imread

        width, height = size
        axes = self.figure.add_axes((x / WIDE, 1.0 - (y + height) / HIGH, width / WIDE, height / HIGH))
        axes.imshow(imread(BytesIO(png), format="png"), interpolation="none", aspect="auto", cmap="gray", vmin=0.0,
                    vmax=1.0)
        axes.set_axis_off()

    def picture(self, y: float, picture: Picture, height: float) -> None:
        """Draw a figure within the figure of the sheet."""
        figure = self.figure
        grid = figure.add_gridspec(3, 3, width_ratios=(LEFT, INNER, WIDE - LEFT - INNER),
                                   height_ratios=(y, height, HIGH - y - height))
        inside = figure.add_subfigure(grid[1, 1])
        picture.draw(inside)
        lay_out(inside, INNER / 72.0, height / 72.0, names_left=picture.names_left)


# -- the report ----------------------------------------------------------------------------------------------


def _write(sheets: _Sheets, report: Report) -> None:
    def head(on: _Sheets, y: float) -> None:
        on.line(LEFT, y + 17.0, report.title, 17.0, weight="bold")
        on.line(LEFT, y + 31.0, report.subtitle, 9.0, color=_QUIET)

    if report.letterhead:
        _letterhead(sheets, report.letterhead)
    sheets.place(38.0, head, 8.0)
    if report.reference:
        _reference(sheets, report.reference)
    if report.answer is not None:
        _answer(sheets, report.answer)
    for warning in report.warnings:
        _warning(sheets, warning)
    for section in report.sections:
        _section(sheets, section)


_LOGO = (180.0, 52.0)
"""Largest width and height of the logo, points."""


def _letterhead(sheets: _Sheets, letterhead: Letterhead) -> None:
    """Draw the logo on the left, company and address on the right, and a line below."""
    columns, rows = letterhead.logo_size
    scale = min(_LOGO[0] / columns, _LOGO[1] / rows) if letterhead.logo else 0.0
    width = INNER - (_LOGO[0] + 20.0 if letterhead.logo else 0.0)
    company = wrapped(letterhead.company, 11.0, width, "bold") if letterhead.company else []
    address = [part for line in letterhead.address for part in wrapped(line, SMALL, width)]
    texts = len(company) * 11.0 * _LEADING + len(address) * SMALL * _LEADING
    height = max(texts, rows * scale) + 8.0

    def draw(on: _Sheets, y: float) -> None:
        if letterhead.logo:
            on.image(y, LEFT, (columns * scale, rows * scale), letterhead.logo)
        on.lines(WIDE - LEFT, y, company, 11.0, weight="bold", side="right")
        on.lines(WIDE - LEFT, y + len(company) * 11.0 * _LEADING, address, SMALL, color=_QUIET, side="right")
        on.rule(y + height, "#888888", 1.0)

    sheets.place(height, draw)


def _reference(sheets: _Sheets, reference: Sequence[tuple[str, str]]) -> None:
    """Draw customer, order number and place beside each other."""
    share = INNER / len(reference)
    cells = [(name, wrapped(text, 9.0, share - 12.0, "bold")) for name, text in reference]
    most = max(len(texts) for _, texts in cells)

    def draw(on: _Sheets, y: float) -> None:
        for number, (name, texts) in enumerate(cells):
            x = LEFT + number * share
            on.lines(x, y, [name], SMALL, color=_QUIET)
            on.lines(x, y + SMALL * _LEADING, texts, 9.0, weight="bold")

    sheets.place((SMALL + most * 9.0) * _LEADING, draw, 2.0)


def _answer(sheets: _Sheets, answer: AnswerBox) -> None:
    width, colour = INNER - 26.0, _COLOURS[answer.colour]
    big = wrapped(answer.value, 15.0, width, "bold")
    lines = [part for line in answer.lines for part in wrapped(line, BODY, width)]
    verdict = wrapped(answer.verdict, BODY, width, "bold")
    reason = wrapped(answer.reason, BODY, width)
    advice = wrapped(answer.advice, BODY, width, style="italic") if answer.advice else []
    step = BODY * _LEADING
    height = 16.0 + len(big) * 15.0 * _LEADING + step * (len(lines) + len(verdict) + len(reason) + len(advice)) + 6.0

    def draw(on: _Sheets, y: float) -> None:
        on.box(y, height, LEFT, INNER, "#f7f7f7")
        on.box(y, height, LEFT, 5.0, colour)
        x, down = LEFT + 16.0, y + 8.0
        on.lines(x, down, big, 15.0, weight="bold")
        down += len(big) * 15.0 * _LEADING
        for texts, how in ((lines, {}), (verdict, {"weight": "bold", "color": colour}), (reason, {}),
                           (advice, {"style": "italic"})):
            on.lines(x, down, texts, BODY, **how)
            down += len(texts) * step + (3.0 if texts is not reason else 0.0)

    sheets.place(height, draw, 6.0)


def _warning(sheets: _Sheets, warning: str) -> None:
    texts = wrapped(warning, BODY, INNER - 22.0)
    height = len(texts) * BODY * _LEADING + 7.0

    def draw(on: _Sheets, y: float) -> None:
        on.box(y, height, LEFT, INNER, "#fff8e6")
        on.box(y, height, LEFT, 2.5, _COLOURS["yellow"])
        on.lines(LEFT + 12.0, y + 3.0, texts, BODY)

    sheets.place(height, draw, 5.0)


_HEADING = 21.0         # points, with the rule below it


def _section(sheets: _Sheets, section: ReportSection) -> None:
    """Draw a section. The heading stays with the first block, or with the first rows of a table longer than a sheet."""
    heading: str | None = section.heading
    for block in section.blocks:
        if isinstance(block, Table | Pairs):
            _table(sheets, heading, block)
        elif isinstance(block, Picture):
            _picture(sheets, heading, block)
        else:
            _text(sheets, heading, block)
        heading = None


def _headed(sheets: _Sheets, heading: str | None, height: float, draw: Draw, space: float = 5.0) -> None:
    if heading is None:
        sheets.place(height, draw, space)
        return

    def both(on: _Sheets, y: float) -> None:
        on.line(LEFT, y + 11.0, heading, 10.5, weight="bold")
        on.rule(y + 15.5, "#888888", 0.7)
        draw(on, y + _HEADING)

    sheets.place(_HEADING + height, both, 13.0)


def _text(sheets: _Sheets, heading: str | None, block: Text) -> None:
    texts = wrapped(block.text, BODY, INNER)
    _headed(sheets, heading, len(texts) * BODY * _LEADING, lambda on, y: on.lines(LEFT, y, texts, BODY))


def _picture(sheets: _Sheets, heading: str | None, block: Picture) -> None:
    height = sheets.scale * block.height_in * INNER / WIDTH_IN
    caption = wrapped(block.caption, SMALL, INNER)

    def draw(on: _Sheets, y: float) -> None:
        on.picture(y, block, height)
        on.lines(LEFT, y + height + 2.0, caption, SMALL, color=_QUIET)

    _headed(sheets, heading, height + 2.0 + len(caption) * SMALL * _LEADING, draw)


_LEAST_ROWS = 3
"""Fewest rows of a split table on one sheet."""


def _table(sheets: _Sheets, heading: str | None, block: Table | Pairs) -> None:
    columns = block.columns if isinstance(block, Table) else (Column("", 0.27), Column("", 0.73))
    rows = [_TableRow(columns, cells) for cells in block.rows]
    head = _TableRow(columns, tuple(column.title for column in columns), head=True) if isinstance(block,
                                                                                                  Table) else None
    head_height = head.height if head is not None else 0.0
    height = head_height + sum(row.height for row in rows)
    above = 13.0 + _HEADING if heading is not None else 5.0
    room, whole = sheets.room(above), BOTTOM - TOP - 40.0
    if height <= room or (height <= whole and room <= sheets.most_empty):
        _headed(sheets, heading, height, lambda on, y: _draw_rows(on, y, head, rows))
        return
    while rows:
        fit, used = 0, head_height
        room = sheets.room(above)
        while fit < len(rows) and used + rows[fit].height <= room:
            used += rows[fit].height
            fit += 1
        if fit < len(rows):
            fit = min(fit, len(rows) - _LEAST_ROWS)      # no sheet begins or ends with only one or two rows of a table
        if fit < _LEAST_ROWS and not sheets.fresh and fit < len(rows):
            sheets.new()
            continue
        part, rows = rows[: max(fit, 1)], rows[max(fit, 1):]
        part_height = head_height + sum(row.height for row in part)
        _headed(sheets, heading, part_height, lambda on, y, part=part: _draw_rows(on, y, head, part))      # type: ignore[misc]
        heading, above = None, 5.0


class _TableRow:
    """One row of a table, its cells wrapped to their columns."""

    def __init__(self, columns: Sequence[Column], cells: Sequence[str], head: bool = False) -> None:
        self.columns, self.head = columns, head
        self.names = len(columns) == 2 and not any(column.title for column in columns)
        weight = "bold" if head else "normal"
        self.cells = [
            wrapped(cell, SMALL, column.share * INNER - 8.0, weight)
            for cell, column in zip(cells, columns, strict=True)
        ]
        self.height = max(1, *(len(cell) for cell in self.cells)) * SMALL * _LEADING + 4.0

    def draw(self, on: _Sheets, y: float) -> None:
        """Draw from the top of the block."""
        if self.head:
            on.box(y, self.height, LEFT, INNER, "#f1f1f1")
        x = LEFT
        for number, (column, cell) in enumerate(zip(self.columns, self.cells, strict=True)):
            width = column.share * INNER
            quiet = self.names and number == 0
            on.lines(x + width - 4.0 if column.number else x + 4.0, y + 2.0, cell, SMALL,
                     weight="bold" if self.head else "normal", side="right" if column.number else "left",
                     color=_QUIET if quiet else _DARK)
            x += width
        on.rule(y + self.height)


def _draw_rows(on: _Sheets, y: float, head: _TableRow | None, rows: Sequence[_TableRow]) -> None:
    for row in ([head] if head is not None else []) + list(rows):
        row.draw(on, y)
        y += row.height


# -- text ----------------------------------------------------------------------------------------------------


def wrapped(text: str, size: float, width: float, weight: str = "normal", style: str = "normal") -> list[str]:
    """Return lines no wider than ``width``; a word without spaces is cut if necessary."""
    return list(_wrapped(text, size, width, weight, style))


@lru_cache(maxsize=4096)       # the same texts are laid out again for each height of the pictures
def _wrapped(text: str, size: float, width: float, weight: str, style: str) -> tuple[str, ...]:
    lines: list[str] = []
    for paragraph in text.splitlines() or [""]:
        line = ""
        for whole in paragraph.split():
            word = whole
            trial = f"{line} {word}" if line else word
            if _measured(trial, weight, style) * size <= width:
                line = trial
                continue
            if line:
                lines.append(line)
            while len(word) > 1 and _measured(word, weight, style) * size > width:
                cut = max(1, next((k for k in range(len(word) - 1, 0, -1)
                                   if _measured(word[:k], weight, style) * size <= width), 1))
                lines.append(word[:cut])
                word = word[cut:]
            line = word
        lines.append(line)
    return tuple(lines)


@lru_cache(maxsize=4096)
def _measured(text: str, weight: str, style: str) -> float:
    """Return the width of a line in letters of one point."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    slant: Any = style
    properties = FontProperties(family="DejaVu Sans", size=10.0, weight=weight, style=slant)
    width, _, _ = text_to_path.get_text_width_height_descent(text, properties, False)
    return float(width) / 10.0
