"""Console for all output to the operator: text from outside is printed as plain text, for any content."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TextIO

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from profiles import visible


class PlainConsole(Console):
    """Console without markup in plain strings (a drive may be called ``[/]``) and without control characters."""

    def __init__(self, file: TextIO | None = None, *, record: bool = False) -> None:
        super().__init__(file=file, highlight=False, markup=False, record=record)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            if segment.control is None and not segment.text.isprintable():
                yield Segment(visible(segment.text, keep="\n"), segment.style)
            else:
                yield segment

    def on_broken_pipe(self) -> None:
        """Raise the error for the caller: rich would end the process with 1, the exit code of an internal error."""
        raise  # noqa: PLE0704 (rich calls this where it has caught the BrokenPipeError)


def stderr_console() -> Console:
    """Return the console for progress and messages. stdout is for results."""
    return PlainConsole(sys.stderr)


def working(text: str, console: Console | None = None) -> AbstractContextManager[object]:
    """Return a context with a moving sign beside a constant text at a terminal, and without output elsewhere."""
    console = console or stderr_console()
    return console.status(text) if console.is_terminal else nullcontext()


def names_and_texts(rows: Iterable[tuple[str, RenderableType]], *, quiet: bool = False) -> Table:
    """Return dimmed names, each with its text, folded at the console's width; ``quiet``: the texts are dimmed too."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(style="dim" if quiet else None, overflow="fold")
    for row in rows:
        grid.add_row(*row)
    return grid


def figures_table(headings: Iterable[str], rows: Iterable[Iterable[str]], left: int = 1) -> Table:
    """Return a table of figures. The first ``left`` columns are aligned on the left. A cell that begins with "!"
    exceeds a limit and is red.
    """
    grid = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for at, name in enumerate(headings):
        grid.add_column(name, justify="left" if at < left else "right")
    for cells in rows:
        grid.add_row(*(Text(cell[1:], style="bold red") if cell.startswith("!") else cell for cell in cells))
    return grid


# The shaft may turn between the two entries. With a rigid shaft a smaller I raises the loop's phase at every frequency
# and lowers its gain, so that the phase margin does not fall. If I falls, it comes first: the loop in between is the
# present one with a smaller I. If I rises, P comes first: the loop in between is the new one with a smaller I.
ENTRY_ORDER = ("If I becomes smaller, type it in first; otherwise type in P first. With an integral time T_I = P/I: if "
               "it becomes longer, type it in first; otherwise type in P first. In the other order the loop may "
               "oscillate between the two entries.")
COMPENSATION_ORDER = ("With inertia compensation: if J_c becomes smaller, type it in before P and I; if it becomes "
                      "larger, after them.")


def print_settings(settings: Sequence[tuple[str, str, str]], console: Console, order: str = ENTRY_ORDER) -> None:
    """Print parameters of the drive with the value to enter and its confidence, if any, and the order of entry."""
    if settings:
        console.print(Text("to be typed into the drive, by hand (confidence of the profile's entry)", style="bold"))
        grid = Table.grid(padding=(0, 2))
        for _ in range(2):
            grid.add_column(overflow="fold")
        for title, value, sure in settings:
            grid.add_row(title, f"{value} ({sure})")
        console.print(grid)
    console.print(Text(order))
