"""How far the studies are: on stderr, which is not for results."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from tdhil.studies.study import Progress

LINE_EVERY_S = 60.0


class StudyBar:
    """A bar over all studies on a terminal, gone while something else is printed; else a line a study and minute."""

    def __init__(self, console: Console, count: int) -> None:
        self._console = console
        self._told_s = 0.0
        self._bar = Bar(
            TextColumn("{task.fields[name]:<9}"), BarColumn(28), TextColumn("{task.percentage:3.0f} %"),
            TimeElapsedColumn(), TextColumn("{task.description}"), console=console, transient=True,
            redirect_stdout=False, redirect_stderr=False, disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=float(count), name="")

    @contextmanager
    def of(self, index: int, name: str) -> Iterator[Progress]:
        """While study ``index`` runs."""
        if not self._console.is_terminal:
            self._console.print(f"study {name} …", markup=False)
        self._bar.update(self._task, completed=float(index), name=name, description="")
        self._told_s = time.monotonic()
        with self._bar:
            yield lambda share, text: self._tell(index, name, share, text)

    def _tell(self, index: int, name: str, share: float, text: str) -> None:
        self._bar.update(self._task, completed=index + share, description=text)
        if not self._console.is_terminal and time.monotonic() - self._told_s >= LINE_EVERY_S:
            self._told_s = time.monotonic()
            self._console.print(f"study {name} {100.0 * share:3.0f} %  {text}", markup=False, soft_wrap=True)
