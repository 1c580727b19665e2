"""`tdhil docs`: the path of the documentation and the examples, in a clone and in an installed package."""

from __future__ import annotations

import argparse
from pathlib import Path
from textwrap import shorten

import tdhil
from tdhil.errors import MessageCode, UsageError

KINDS = ("tutorials", "how-to", "reference", "reference/python", "explanation")
"""The folders of docs/ that hold pages, in the order of `tdhil docs`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add no options."""
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Print the folder, and a line for each page and example in it. Decision records are left out."""
    folder = docs_folder()
    print(folder)  # noqa: T201
    found = (folder / "README.md", *(page for kind in KINDS for page in sorted(folder.glob(f"docs/{kind}/*.md"))),
             *sorted(folder.glob("examples/*.yaml")), *sorted(folder.glob("examples/*.py")))
    names = [path.relative_to(folder).as_posix() for path in found]
    width = max(map(len, names))
    for name, path in zip(names, found, strict=True):
        with path.open(encoding="utf-8") as file:
            title = next((line.strip('#" \n') for line in file
                          if line.strip('#" \n') and not line.startswith("<!--")), "")
        print(f"  {name:<{width}} {shorten(title, 77 - width, placeholder=' …')}")  # noqa: T201
    return 0


def docs_folder() -> Path:
    """Return the folder with README.md, docs/ and examples/. Raises UsageError if an installation has none."""
    package = Path(tdhil.__file__).resolve().parent
    for folder in (package / "_docs", package.parent):
        if (folder / "docs" / "reference" / "rig.md").is_file():
            return folder
    raise UsageError("this installation contains no documentation", where=str(package),
                     next_step="Install it again from its wheel, or use the clone that it came from",
                     entry=MessageCode.PACKAGE_MISSING)
