"""`tdhil attend`: the code that permits motion, on the terminal of the operator at the shaft."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of attend."""
    parser.add_argument("--data", type=Path, metavar="DIR", default=Path("tdhil-data"),
                        help="the folder of tdhil serve (default: tdhil-data)")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Show codes until Ctrl-C. Runs continue."""
    from tdhil.service import attend

    def say(text: str) -> None:
        print(text, flush=True)  # noqa: T201

    with suppress(KeyboardInterrupt):
        attend(namespace.data, say)
    return 0
