"""`tdhil completion`: a shell script that completes commands, options and choices."""

from __future__ import annotations

import argparse
from typing import Any

from tdhil.errors import MessageCode, UsageError

SHELLS = ("bash", "zsh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the shell's name."""
    parser.add_argument("shell", choices=SHELLS, help="the shell that reads the script")
    parser.epilog = (
        "bash: tdhil completion bash > ~/.local/share/bash-completion/completions/tdhil. "
        "zsh: tdhil completion zsh > a folder of $fpath, as _tdhil. Run it again after an update."
    )
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Print the script. Raises UsageError if shtab is not installed."""
    try:
        import shtab
    except ImportError as error:
        raise UsageError("the package shtab is not installed", where="completion",
                         next_step="Install it: python -m pip install 'shtab>=1.7,<2'",
                         entry=MessageCode.PACKAGE_MISSING) from error
    from tdhil.cli.main import build_full_parser

    parser = build_full_parser()
    _complete_files(parser, shtab.FILE)
    print(shtab.complete(parser, shell=namespace.shell))  # noqa: T201
    return 0


def _complete_files(parser: argparse.ArgumentParser, files: Any) -> None:
    """Let an option that takes a value without choices complete files: most of them are paths."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                _complete_files(sub, files)
        elif action.choices is None and action.nargs != 0 and action.type not in (int, float):
            action.complete = files  # type: ignore[attr-defined]
