"""A study's outcome on a terminal of 80 columns: tables, then what holds and what doesn't."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from tdhil.studies.output import Written
from tdhil.studies.study import ResultTable, Statement, Study, StudyOutcome
from tdhil.study.write_numbers import column_texts

MARKS: dict[bool | None, tuple[str, str, str]] = {
    True: ("✓", "holds", "green"),
    False: ("✗", "does not hold", "red"),
    None: ("~", "open: the paper contradicts itself or leaves out what decides", "yellow"),
}
SIMULATED = "SIMULATED"
_GAP = 2          # between columns


def print_outcome(outcome: StudyOutcome, written: Written, console: Console) -> None:
    """Everything, and where the files are."""
    console.print(Text.assemble((f"{outcome.name}  {outcome.title}", "bold"), (f"  {SIMULATED}", "magenta")))
    for table in outcome.tables:
        console.print(Text(table.name.replace("_", " "), style="italic"))
        for part in _tables(table, console.width):
            console.print(part)
            console.print()
    console.print(statements(outcome.statements))
    console.print(Text(f"files: {written.folder}", style="dim"), soft_wrap=True)
    console.print()


def print_list(studies: Iterable[Study], console: Console) -> None:
    """Names and titles."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for study in studies:
        grid.add_row(Text(study.name, style="bold"), study.title)
    console.print(grid)


def statements(all_of_them: Iterable[Statement]) -> RenderableType:
    """Each with its mark, what was published and what came out here."""
    parts: list[RenderableType] = []
    for statement in all_of_them:
        mark, word, style = MARKS[statement.holds]
        parts.append(Text.assemble((f"{mark} ", style), statement.text, (f"  [{word.partition(':')[0]}]", style)))
        grid = Table.grid(padding=(0, 1))
        grid.add_column(style="dim", no_wrap=True)
        grid.add_column(overflow="fold")
        grid.add_row("published", Text(statement.published))
        grid.add_row("ours", Text(statement.ours))
        parts.append(Padding(grid, (0, 0, 0, 4)))
    return Group(*parts)


def _tables(table: ResultTable, width: int) -> Iterator[Table]:
    """The table in parts that fit beside the margin, its first column before each: no number is ever folded."""
    cells = [column_texts([row[index] for row in table.rows]) for index in range(len(table.columns))]
    widths = [
        max([len(word) for word in name.split("_")] + [len(text) for text in texts])
        for name, texts in zip(table.columns, cells, strict=True)
    ]
    part, used = [0], widths[0]
    for index in range(1, len(table.columns)):
        if len(part) > 1 and used + _GAP + widths[index] > width:
            yield _part(table, cells, widths, part)
            part, used = [0], widths[0]
        part.append(index)
        used += _GAP + widths[index]
    yield _part(table, cells, widths, part)


def _part(table: ResultTable, cells: list[list[str]], widths: list[int], columns: list[int]) -> Table:
    drawn = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, _GAP - 1, 0, 0))
    for index in columns:
        numeric = any(isinstance(row[index], int | float) for row in table.rows)
        drawn.add_column(table.columns[index].replace("_", " "), justify="right" if numeric else "left",
                         header_style="dim", vertical="bottom", width=widths[index])
    for number in range(len(table.rows)):
        drawn.add_row(*(Text(cells[index][number], no_wrap=True) for index in columns))
    return drawn
