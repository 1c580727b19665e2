"""Parser of the command line: errors of one line with the likely option, and help in two lengths."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NoReturn

from tdhil.errors import MessageCode, UsageError

HELP_ALL: Final = "--help-all"
_NAME_WIDTH: Final = 12
_MANY_OPTIONS: Final = 12
"""Most options of a command with a complete usage line."""


class CommandParser(argparse.ArgumentParser):
    """Parser for `tdhil` and each of its commands.

    Its errors are one line, like all others: a long usage above them would hide the error. ``--help`` shows the options
    that most runs need, ``--help-all`` shows all of them.
    """

    def __init__(self, *args: Any, **words: Any) -> None:
        super().__init__(*args, **words)
        self._rare: list[argparse.Action] = []
        self.usual_action = ""
        """Default action of a command with several actions."""
        self.also_called: Mapping[str, str] = {}       # other words for an action, for the suggestion

    def set_rare(self, rare: list[argparse.Action]) -> None:
        """Hide these options from ``--help``, and add ``--help-all``."""
        self._rare = rare
        if rare and HELP_ALL not in self._option_string_actions:
            self.add_argument(HELP_ALL, action=_HelpAll, dest=argparse.SUPPRESS, default=argparse.SUPPRESS,
                              help=f"show these and {len(rare)} more options and exit")
        if len(self._actions) > _MANY_OPTIONS and all(action.option_strings for action in self._actions):
            self.usage = "%(prog)s [option ...]"

    def format_help(self) -> str:
        """Return the text of ``--help``, without the rarely used options."""
        shown = {action: action.help for action in self._rare}
        try:
            for action in shown:
                action.help = argparse.SUPPRESS
            return super().format_help()
        finally:
            for action, text in shown.items():
                action.help = text

    def format_full_help(self) -> str:
        """Return the text of ``--help-all``."""
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Raise UsageError with the message of argparse, and the choices of missing options."""
        before, required, names = message.partition("arguments are required: ")
        if required:
            told = {"/".join(a.option_strings): f" {'|'.join(map(str, a.choices))}" for a in self._actions if a.choices}
            message = before + required + ", ".join(name + told.get(name, "") for name in names.split(", "))
        of_a_value = message.startswith("argument -") and ": expected " not in message
        entry = MessageCode.VALUE_NOT_ALLOWED if of_a_value or ": invalid " in message else MessageCode.USAGE
        raise self._refusal(message, entry)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Put the default action before words that begin with neither an action nor a help option. Refuse an unknown
        option in the parser that knows the options: argparse would leave it to the outermost parser.
        """
        if self.usual_action and args is not None:
            from tdhil.cli.arguments import meant
            from tdhil.config import OPTION

            actions = next(one for one in self._actions if isinstance(one, argparse._SubParsersAction))
            if all(word == OPTION["json"].flag for word in args):
                raise self._refusal(f"an action is missing: {', '.join(actions.choices)}", MessageCode.USAGE)
            if args[0] not in {*actions.choices, "-h", "--help", HELP_ALL}:
                word = args[0]
                # the default action would take a misspelt action as a file
                if not word.startswith("-") and (
                        hint := meant(self.also_called.get(word, word), actions.choices)) and not Path(word).exists():
                    raise self._refusal(f"there is no action {word[:40]}", MessageCode.USAGE, hint)
                args = [self.usual_action, *args]
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            raise self._unknown(unknown)
        return found, unknown

    def _unknown(self, words: list[str]) -> UsageError:
        from tdhil.cli.arguments import meant

        options = [word for word in words if word.startswith("-")]
        if not options:
            return self._refusal(f"unrecognized arguments: {' '.join(words)[:200]}", MessageCode.USAGE)
        name = options[0].partition("=")[0]
        hint = meant(name, self._option_string_actions)
        return self._refusal(f"there is no option {name[:40]}", MessageCode.UNKNOWN_OPTION, hint)

    def _refusal(self, what: str, entry: MessageCode, hint: str = "") -> UsageError:
        step = f"{hint}See {self.prog} --help"
        return UsageError(what, where=self.prog.partition(" ")[2], next_step=step, entry=entry)


class _HelpAll(argparse._HelpAction):
    """The option ``--help-all``."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        assert isinstance(parser, CommandParser)
        print(parser.format_full_help(), end="")  # noqa: T201
        parser.exit()


class FrontParser(CommandParser):
    """Parser of `tdhil` itself; its help lists the commands in groups."""

    groups: Mapping[str, Mapping[str, str]] = {}

    def format_help(self) -> str:
        """Return the text of ``tdhil --help``: groups of commands, one line for each command."""
        rows = [f"usage: {self.prog} COMMAND [option ...]", "", self.description or ""]
        for title, commands in self.groups.items():
            rows += ["", f"{title}:", *(f"  {name:<{_NAME_WIDTH}}{summary}" for name, summary in commands.items())]
        rows += ["", "options:", f"  {'-h, --help':<{_NAME_WIDTH}}show this help and exit",
                 f"  {'--version':<{_NAME_WIDTH}}show the version and exit", "", self.epilog or ""]
        return "\n".join(rows) + "\n"
