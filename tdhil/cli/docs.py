"""`tdhil docs`: where the documentation and the examples lie, in a clone and in an installed package alike."""

from __future__ import annotations

import argparse
from pathlib import Path
from textwrap import shorten

import tdhil
from tdhil.errors import UsageError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """No options of its own."""
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """The folder, and a line for each file in it."""
    folder = docs_folder()
    print(folder)  # noqa: T201
    found = (folder / "README.md", *sorted(folder.glob("docs/*.md")), *sorted(folder.glob("examples/*.yaml")),
             *sorted(folder.glob("examples/*.py")))
    names = [path.relative_to(folder).as_posix() for path in found]
    width = max(map(len, names))
    for name, path in zip(names, found, strict=True):
        print(f"  {name:<{width}} {shorten(_title(path), 77 - width, placeholder=' …')}")  # noqa: T201
    return 0


def docs_folder() -> Path:
    """The folder with README.md, docs/ and examples/. UsageError where an installation has none."""
    package = Path(tdhil.__file__).resolve().parent
    for folder in (package / "_docs", package.parent):
        if (folder / "docs" / "rig.md").is_file():
            return folder
    raise UsageError("this installation came without documentation", where=str(package),
                     next_step="Install it again from its wheel, or look into the clone that it came from")


def _title(path: Path) -> str:
    with path.open(encoding="utf-8") as file:
        return next((line.strip('#" \n') for line in file if line.strip('#" \n')), "")
