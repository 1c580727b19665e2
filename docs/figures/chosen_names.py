"""Names of the figures that a script in this folder is called with."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence


def chosen(about: str | None, known: Iterable[str], words: Sequence[str]) -> list[str]:
    """Return the names of a script's call, each of them known; ``about`` is the script's docstring.

    Ends the process after ``--help``, and with exit code 2 at an unknown name.
    """
    names = list(known)
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(names)}; all of them if none is named")
    found: list[str] = parser.parse_args(words).names
    if unknown := [name for name in found if name not in names]:
        parser.error(f"there is no {', no '.join(unknown)}; --help lists the names")
    return found
