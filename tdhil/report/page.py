"""Common parts of every HTML page: style, figures as SVG, and the message on missing packages."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil import version
from tdhil.errors import MessageCode, UsageError

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

Draw = Callable[["FigureBase"], None]

NEEDED = ("matplotlib", "jinja2")

STYLE = """\
body { font: 15px/1.45 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
nav a { margin-right: .8rem; white-space: nowrap }
img, svg { max-width: 100%; height: auto }
img { border: 1px solid #ddd }
.wide { overflow-x: auto }
@media (max-width: 40rem) { .wide svg { max-width: none } }
table { border-collapse: collapse; margin: .6rem 0; font-size: 13px }
caption { text-align: left; font-style: italic; padding-bottom: .2rem }
th, td { border: 1px solid #ddd; padding: .2rem .5rem; text-align: right }
th { background: #f4f4f4; font-weight: 600 }
.claims td { text-align: left; vertical-align: top }
.green { color: #1a7f37 } .red { color: #b42318 } .yellow { color: #8a6100 }
"""


def install_command() -> str:
    """Return the command that installs the extra `report` here: into this environment, from the clone, or by package
    names.

    tdhil is not in a package index, so its own name would not be found.
    """
    python = shlex.quote(sys.executable or "python")
    clone = Path(version.__file__).resolve().parent.parent
    if (clone / "pyproject.toml").is_file():
        return f"{python} -m pip install -e {shlex.quote(f'{clone}[report]')}"
    try:
        stated = metadata.requires("tdhil") or []
    except metadata.PackageNotFoundError:
        stated = []
    wanted = [line.split(";")[0].strip() for line in stated if line.split(";")[0].strip().startswith(NEEDED)
              and "report" in line]
    return f"{python} -m pip install {' '.join(map(shlex.quote, wanted or NEEDED))}"


def has_extra() -> bool:
    """Return whether the packages for reports are installed."""
    return all(find_spec(name) is not None for name in NEEDED)


def require_extra(where: str) -> None:
    """Raise UsageError, in one line, if optional packages for a report are missing."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise UsageError(
            f"a report needs {' and '.join(missing)}, not installed here", where=where,
            next_step=f"Install: {install_command()}",
            entry=MessageCode.PACKAGE_MISSING,
        )


@contextmanager
def repeatable_figures() -> Iterator[None]:
    """Configure matplotlib so that the same data give the same file: salted ids, and no style of the user."""
    from matplotlib import rc_context

    with rc_context({"svg.hashsalt": "tdhil", "font.size": 10.0, "figure.facecolor": "white"}):
        yield


def lay_out(figure: FigureBase, wide_in: float, high_in: float, *, names_left: bool = False) -> None:
    """Set margins in inches, equal for every figure of a page, so that their axes are aligned."""
    left = 1.75 if names_left else 0.86      # room for the label beside ticks such as 112.5 and −0.25
    every: Any = figure.axes
    above = not names_left and any(axes.texts for axes in every)
    top = 0.3 if above else 0.08
    figure.subplots_adjust(left=left / wide_in, right=1.0 - 0.1 / wide_in, bottom=0.4 / high_in,
                           top=1.0 - top / high_in, hspace=0.1)


def inline_svg(draw: Draw, size_in: tuple[float, float], *, names_left: bool = False) -> str:
    """Return a figure as an <svg> element for the page: without a date or a second file, and with text as text."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with repeatable_figures(), rc_context({"svg.fonttype": "none", "font.family": "sans-serif", "font.size": 8.0}):
        figure = Figure(figsize=size_in)
        FigureCanvasSVG(figure)
        draw(figure)
        lay_out(figure, *size_in, names_left=names_left)
        text = StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    whole = text.getvalue()
    return whole[whole.index("<svg") :]
