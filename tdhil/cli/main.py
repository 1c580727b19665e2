"""The command line: which command, with which options. Imports what a command needs only once it is chosen."""

from __future__ import annotations

import argparse
import errno
import json
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from types import SimpleNamespace
from typing import NoReturn

from tdhil.cli.standard_streams import sheltered
from tdhil.errors import ExitCode, TdhilError, UsageError, exit_code
from tdhil.version import __version__

_COMMANDS = {
    "identify": "put a drive into motion and identify its moment of inertia",
    "replay": "identify again from a log, or from a trace that a drive's own tool exported",
    "fleet": "identify many logs again, into one table: by processes here, or on a Dask cluster",
    "trend": "did a rig change over time? From the table of a fleet",
    "compare": "two runs or more side by side: settings, inertias, whether they differ",
    "watch": "identify new logs in a folder as they come",
    "tune": "from J to a speed controller that damps the drill string; nothing moves",
    "evaluate": "a virtual drill string on the drive: does a tuned controller do what tune says?",
    "export": "a log's CAN frames or samples in another program's format",
    "profiles": "what is known of which drive, what it needs set, and how sure that is",
    "scan": "find out who is on the bus; writes nothing to any drive",
    "doctor": "check adapter, permissions, bus, computer, profile and drive; writes nothing",
    "recover": "say what a damaged log still holds, and make a clean copy of it",
    "stop": "stop a drive from outside of any run: best effort, no emergency stop",
    "serve": "rigs, runs and live pages in a browser, on this computer",
    "attend": "show the codes that let shafts of tdhil serve move, on this terminal",
    "simulate": "run the simulated rig as a process of its own",
    "rig": "write a rig.yaml to fill in, with no drive at hand",
    "support": "put a log and what is around it into one archive, for a support case",
    "docs": "where the documentation and the examples are",
    "study": "run the paper's experiments again, beside what it published",
}


process = SimpleNamespace(own=False)
"""``own``: this process is the command's own, and nothing but its end follows; set by `console`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; the exit code (`tdhil.errors.ExitCode`). No traceback for anything a user can cause."""
    namespace = argparse.Namespace()
    arguments = list(sys.argv[1:] if argv is None else argv)
    with sheltered():
        try:
            code = _main(arguments, namespace)
            sys.stdout.flush()
        except KeyboardInterrupt:
            _hear_no_more()
            print("tdhil: interrupted", file=sys.stderr)  # noqa: T201
            return 130
        except BrokenPipeError:
            return 141      # whoever read our output has gone
        except Exception as error:
            # What can't be understood leaves no namespace, and whoever asked for a document still waits for one.
            return _report(error, getattr(namespace, "json", None) is True or "--json" in arguments)
    return code


def _main(arguments: list[str], namespace: argparse.Namespace) -> int:
    # Libraries log what we report ourselves, with where and what next.
    for library in ("can", "canopen"):
        logging.getLogger(library).addHandler(logging.NullHandler())
        logging.getLogger(library).propagate = False
    chosen = _chosen(arguments)
    if chosen is not None and chosen == arguments[0] and chosen not in _COMMANDS:
        raise _no_command(chosen)
    parser = build_parser(chosen)
    parser.parse_args(arguments, namespace)
    if namespace.command is None:
        parser.print_help(sys.stderr)
        return 2
    return int(namespace.run(namespace))


class _Parser(argparse.ArgumentParser):
    """Its errors are a line, as all others: two dozen lines of usage above them would hide what is wrong."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(message, where=self.prog.partition(" ")[2], next_step=f"See {self.prog} --help")


def build_parser(chosen: str | None) -> argparse.ArgumentParser:
    """The parser; only the chosen command's options are built, since python-can's alone cost 150 ms to import."""
    parser = _Parser(
        prog="tdhil",
        description="Identifies the moment of inertia of a top drive, or of any inverter-driven machine, "
        "with an interval that holds.",
        epilog="tdhil COMMAND --help tells more. Ctrl-C stops the shaft, but it is no emergency stop: "
        "keep the hard-wired one within reach.",
    )
    parser.add_argument("--version", action="version", version=f"tdhil {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name, summary in _COMMANDS.items():
        # Options are written out in full: no `--y` may stand for --yes.
        sub = commands.add_parser(
            name, help=summary, description=summary[0].upper() + summary[1:] + "." * (summary[-1] != "?"),
            allow_abbrev=False,
        )
        if name == chosen:
            _builder(name)(sub)
    return parser


def _chosen(arguments: Sequence[str]) -> str | None:
    return next((argument for argument in arguments if not argument.startswith("-")), None)


def _no_command(name: str) -> UsageError:
    from tdhil.cli.arguments import meant

    return UsageError(f"there is no command '{name[:40]}'", next_step=f"{meant(name, _COMMANDS)}See tdhil --help")


_ELSEWHERE = {
    "watch": ("fleet", "add_watch_arguments"),
    "compare": ("trend", "add_compare_arguments"),
    "rig": ("rig_new", "add_arguments"),
}
"""Commands that don't have a module of their own name, each with its module and what adds its options."""


def _builder(name: str) -> Callable[[argparse.ArgumentParser], None]:
    module, function = _ELSEWHERE.get(name, (name, "add_arguments"))
    add_arguments: Callable[[argparse.ArgumentParser], None] = getattr(import_module(f"tdhil.cli.{module}"), function)
    return add_arguments


_THE_SYSTEM_S = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOSPC, errno.ENOMEM, errno.EIO, errno.EROFS})
"""Its state, not a mistake of ours: open files, disk, memory, a terminal that is gone."""


def _report(error: Exception, as_json: bool) -> int:
    """One message for an error of the tree; a traceback only for what is a mistake of ours."""
    code = exit_code(error)
    if isinstance(error, TdhilError):
        error.spelling = {}
        print(f"tdhil: {error}", file=sys.stderr)  # noqa: T201
    elif isinstance(error, OSError) and error.errno in _THE_SYSTEM_S:
        print(f"tdhil: the system refused: {error.strerror or error}", file=sys.stderr)  # noqa: T201
    else:
        traceback.print_exception(error, file=sys.stderr)
        print("tdhil: internal error; please report it with the lines above", file=sys.stderr)  # noqa: T201
        code = ExitCode.INTERNAL
    if as_json:
        document = {"error": {"kind": type(error).__name__, "message": str(error)}, "exit_code": int(code)}
        print(json.dumps(document, ensure_ascii=False))  # noqa: T201
    return int(code)


def _hear_no_more() -> None:
    """The process ends with its code, however often Ctrl-C is pressed meanwhile."""
    if process.own:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def leave(code: int) -> NoReturn:
    """The end of the process, at once also where arithmetic that was left alone goes on in a thread."""
    background = sys.modules.get("tdhil.runner.background")
    if background is not None and background.goes_on():
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):     # full, closed, or none
                stream.flush()
        os._exit(code)
    sys.exit(code)


def console() -> NoReturn:
    """`tdhil` in a shell."""
    process.own = True
    try:
        code = main()
    except KeyboardInterrupt:          # a second one, while the first was handled
        code = int(ExitCode.INTERRUPTED)
    _hear_no_more()
    leave(code)


if __name__ == "__main__":
    console()
