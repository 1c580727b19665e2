"""Entry point of the command line: selects the command, and imports only what this command needs."""

from __future__ import annotations

import argparse
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
from typing import Final, NoReturn

from profiles import with_code
from tdhil.cli.parser import CommandParser, FrontParser
from tdhil.cli.standard_streams import sheltered
from tdhil.config import BUSES
from tdhil.errors import (
    ExitCode,
    MessageCode,
    TdhilError,
    UsageError,
    code_of,
    error_document,
    exit_code,
    of_the_system,
)
from tdhil.version import __version__

_GROUPS: Final = {
    "identify": {
        "identify": "move the shaft and identify its moment of inertia",
        "stop": "stop a drive from outside of a run; this is no emergency stop",
    },
    "evaluate logs": {
        "replay": "identify again, from a log or from a CSV trace",
        "frf": "show the frequency response with intervals and distortion",
        "compare": "compare runs: settings, inertias and whether they differ",
        "fleet": "identify many logs again, into one table",
        "trend": "show from a fleet's table whether a rig changed over time",
        "watch": "identify each new log in a folder",
        "export": "write a log's CAN frames or samples in another format",
        "recover": "show what a damaged log holds, and write a clean copy",
        "evidence": "make or check an archive of a run on a real drive",
        "support": "pack a log and support data into one archive",
    },
    "prepare": {
        "doctor": "check adapter, permissions, bus, computer, profile, drive",
        "scan": "list the drives on the bus; writes no object or register",
        "rig": "write a rig.yaml to fill in, without a drive",
        "profiles": "show known drives, their settings and what is verified",
        "calibrate": "compute the scale of torque or speed from known quantities",
    },
    "use J": {
        "tune": "compute gains for the speed loop, or against stick-slip",
        "evaluate": "test a tuned controller on the drive with a virtual string",
        "severity": "show stick-slip in a record of ordinary drilling",
    },
    "service": {
        "serve": "show rigs, runs and live pages in a browser",
        "attend": "show the codes that allow motion, on this terminal",
    },
    "simulator": {
        "simulate": "run the simulated rig as a process of its own",
        "study": "repeat the experiments of the paper in simulation",
    },
    "help": {
        "explain": "show cause and cure of a message by its code (TDH-412)",
        "docs": "show where documentation and examples are",
        "completion": "print a completion script for bash or zsh",
    },
}
"""Commands in the groups of ``tdhil --help``, each with its one line."""
_COMMANDS: Final = {name: summary for commands in _GROUPS.values() for name, summary in commands.items()}
_INSTEAD: Final = {
    "help": "tdhil --help", "version": "tdhil --version",
    "run": "tdhil identify", "report": "tdhil replay run.mcap --report report.html",
    "plot": "tdhil frf run.mcap --plot frf.png", "bode": "tdhil frf run.mcap --plot frf.png",
}
"""Words that other tools have as commands, each with the call that does this here."""


process = SimpleNamespace(own=False)
"""Process of the command. ``own``: True if only the end of the process follows the command; `console` sets it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Return the exit code (`tdhil.errors.ExitCode`). An error that a user can cause shows no
    traceback.
    """
    namespace = argparse.Namespace()
    arguments = list(sys.argv[1:] if argv is None else argv)
    with sheltered():
        try:
            # libraries log errors that tdhil reports itself, with place and next step
            for library in (name for bus in BUSES.values() for name in bus.loggers):
                logging.getLogger(library).addHandler(logging.NullHandler())
                logging.getLogger(library).propagate = False
            chosen = _chosen(arguments)
            if chosen is not None and chosen == arguments[0] and chosen not in _COMMANDS:
                from tdhil.cli.arguments import meant

                advice = (f"Use {_INSTEAD[chosen]}" if chosen in _INSTEAD
                          else f"{meant(chosen, _COMMANDS)}See tdhil --help")
                raise UsageError(f"there is no command '{chosen[:40]}'", entry=MessageCode.UNKNOWN_COMMAND,
                                 next_step=advice)
            parser = build_parser(chosen)
            parser.parse_args(arguments, namespace)
            if namespace.command is None:
                parser.print_help(sys.stderr)
                code = 2
            else:
                code = int(namespace.run(namespace))
            sys.stdout.flush()
        except KeyboardInterrupt:
            _hear_no_more()
            print(f"tdhil: {with_code('interrupted', MessageCode.INTERRUPTED.code)}", file=sys.stderr)  # noqa: T201
            return 130
        except BrokenPipeError:
            return 141      # the reader of the output has closed it
        except Exception as error:
            # a syntax error gives no namespace, but a caller with --json still expects a document
            as_json = getattr(namespace, "json", None) is True or "--json" in arguments
            printed = getattr(sys.stdout, "written", False)      # stdout has one document, that of the result
            return _report(error, as_json and not printed)
    return code


def build_parser(chosen: str | None) -> argparse.ArgumentParser:
    """Return the parser; only the chosen command has its options, since python-can's alone cost 150 ms to import."""
    return _parser([chosen] if chosen is not None else [])


def build_full_parser() -> argparse.ArgumentParser:
    """Return the parser with the options of all commands, for the completion of a shell."""
    return _parser(list(_COMMANDS))


def _parser(chosen: Sequence[str]) -> argparse.ArgumentParser:
    parser = FrontParser(
        prog="tdhil",
        description="Identify the moment of inertia of a top drive, or of any machine on an\n"
        "inverter, with its 95 % coverage interval.",
        epilog="tdhil COMMAND --help shows more. Ctrl-C stops the shaft, but it is no emergency\n"
        "stop: keep the hard-wired one within reach.",
    )
    parser.groups = _GROUPS
    parser.add_argument("--version", action="version", version=f"tdhil {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=CommandParser)
    for name, summary in _COMMANDS.items():
        # options must be complete: --y must not mean --yes
        sub = commands.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".",
                                  allow_abbrev=False)
        if name in chosen:
            from tdhil.cli.arguments import rare_options

            _builder(name)(sub)
            sub.set_rare(rare_options(sub))
    return parser


def _chosen(arguments: Sequence[str]) -> str | None:
    return next((argument for argument in arguments if not argument.startswith("-")), None)


_ELSEWHERE = {
    "watch": ("fleet", "add_watch_arguments"),
    "compare": ("trend", "add_compare_arguments"),
    "rig": ("rig_new", "add_arguments"),
}
"""Commands without a module of their own name: module, and function that adds the options."""


def _builder(name: str) -> Callable[[argparse.ArgumentParser], None]:
    module, function = _ELSEWHERE.get(name, (name, "add_arguments"))
    add_arguments: Callable[[argparse.ArgumentParser], None] = getattr(import_module(f"tdhil.cli.{module}"), function)
    return add_arguments


def _report(error: Exception, as_json: bool) -> int:
    """Print one message for an error of the tree; a traceback only for an internal error of tdhil."""
    code = exit_code(error)
    if isinstance(error, TdhilError):
        error.spelling = {}
        said = str(error)
    elif isinstance(error, OSError) and of_the_system(error):
        said = f"The operating system refused a request: {error.strerror or error}"
    else:
        traceback.print_exception(error, file=sys.stderr)
        said = "Internal error. Please report it with the lines above"
        code = ExitCode.INTERNAL
    print(f"tdhil: {with_code(said, code_of(error))}", file=sys.stderr)  # noqa: T201
    if as_json:
        document = {"error": error_document(error), "exit_code": int(code)}
        print(json.dumps(document, ensure_ascii=False))  # noqa: T201
    return int(code)


def _hear_no_more() -> None:
    """Ignore further Ctrl-C, so that the process ends with its exit code."""
    if process.own:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def leave(code: int) -> NoReturn:
    """End the process at once, even if an abandoned computation continues in a thread."""
    background = sys.modules.get("tdhil.runner.background")
    if background is not None and background.thread_computes():
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):     # full, closed, or missing
                stream.flush()
        os._exit(code)
    sys.exit(code)


def console() -> NoReturn:
    """Run `tdhil` from a shell."""
    process.own = True
    try:
        code = main()
    except KeyboardInterrupt:          # a second one during the handling of the first
        code = int(ExitCode.INTERRUPTED)
    _hear_no_more()
    leave(code)


if __name__ == "__main__":
    console()
