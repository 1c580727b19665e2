"""Command line options for the drive and its address, the same for every command that uses a drive.

A default of None means: rig.yaml, else the profile, else the built-in default (`tdhil.config.options`).
"""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final
from weakref import WeakSet

from profiles import quantities
from profiles.quantities import SHARE, Unit
from tdhil.config import ASKED_AGAIN, OPTIONS, Option, Topic
from tdhil.errors import MessageCode, UsageError, existing_file

# ---------------------------------------------------------------------------------------------------------------------
# Quantities as typed on the command line: 1%, 0.01, 5min, 40rpm. `profiles.quantities` has the units.


def amount(unit: Unit) -> Callable[[str], float]:
    """Return a reader for argparse: a number in ``unit``, or a value with a unit of the same kind, converted to
    ``unit``.
    """

    def read(text: str) -> float:
        try:
            return quantities.read(text, unit)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text[:60]!r}: {error}") from None

    return read


share = amount(SHARE)
"""Reader of a share, ``1%`` or ``0.01``."""

LARGEST_VALUE: Final = 1e9
"""Largest value of a quantity of a calibration, in its unit of SI. A larger one is a typing error."""


def require_inertia(flag: str, value: float | None, *, zero: bool = False) -> None:
    """Raise UsageError for a stated inertia that is not positive; ``zero``: 0 is allowed too."""
    if value is not None and not ((value > 0.0 or (zero and value == 0.0)) and value <= LARGEST_VALUE):
        raise UsageError(f"{value:g}: must be a positive number of kg·m²", where=flag)


PICTURES: Final = (".png", ".svg", ".pdf")
"""Endings of a picture's file."""


_LEAST_ALIKE = 0.78
"""Least similarity (`difflib`, 0 to 1) of a suggested name. A mistyped name has 0.9 and more; another word that only
looks alike has up to 0.75, and the user did not mean it."""


def meant(name: str, known: Iterable[str]) -> str:
    """Return the suggestion "Did you mean 'NAME'? " for a similar known name, or an empty text."""
    close = difflib.get_close_matches(name[:40], list(known), n=1, cutoff=_LEAST_ALIKE)
    return f"Did you mean '{close[0]}'? " if close else ""


# ---------------------------------------------------------------------------------------------------------------------

_RARE: Final[WeakSet[argparse.Action]] = WeakSet()
"""Options that only ``--help-all`` shows, of all parsers."""


def rare_options(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Return the options of ``parser`` that only ``--help-all`` shows."""
    return [action for action in parser._actions if action in _RARE]


def add_option(group: argparse._ActionsContainer, option: Option, *, help: str = "") -> argparse.Action:
    """Add a row of the table as an argument; ``help``: for a command in which the option has another meaning."""
    words: dict[str, Any] = {"dest": option.name, "help": (help or option.help_text).replace("%", "%%")}
    if option.kind is bool:
        words |= {"action": "store_const", "const": True}
    else:
        words |= {"metavar": option.metavar, "choices": option.allowed or None}
        if option.joined:
            words["action"] = "append"
        elif option.kind is not str:
            words["type"] = option.kind if option.unit is None else amount(option.unit)
    return group.add_argument(option.flag, **words)


def add_options(parser: argparse.ArgumentParser, *groups: Topic) -> dict[Topic, argparse._ArgumentGroup]:
    """Add the rows of these groups, with a section for each. Return the sections, to which a command may add more."""
    sections = {group: parser.add_argument_group(group.value) for group in groups}
    for group, section in sections.items():
        for option in OPTIONS:
            if option.group is group:
                action = add_option(section, option)
                if not option.common:
                    _RARE.add(action)
    return sections


def hide_rare(*actions: argparse.Action) -> None:
    """Show these options of a command, which are not in a table, only in ``--help-all``."""
    _RARE.update(actions)


def add_left_out(parser: argparse._ActionsContainer, by_default: str) -> None:
    """Add the options that include archived runs and rehearsals; ``by_default``: what happens to these otherwise."""
    parser.add_argument("--archived", action="store_true",
                        help=f"include runs that tdhil serve has archived (default: they are {by_default})")
    parser.add_argument("--rehearsals", action="store_true",
                        help=f"include rehearsals: runs with --fault (default: they are {by_default})")


def add_settings(parser: argparse.ArgumentParser, whose: str) -> None:
    """Add the options of identifying a log again; ``whose`` settings are the default, such as ``the run's``."""
    for option in ASKED_AGAIN:
        add_option(parser, option, help=f"{option.asked_again} (default: {whose}, or {option.default_text})")


def settings_in(namespace: argparse.Namespace) -> dict[str, Any]:
    """Return the given settings, by name. Raises UsageError with an option whose value exceeds its limits."""
    given: dict[str, Any] = {}
    for one in ASKED_AGAIN:
        if (value := getattr(namespace, one.name)) is None:
            continue
        if one.limits and (wanted := one.refusal(value)):
            raise UsageError(f"{value:g}: must be {wanted}", where=one.flag, entry=MessageCode.VALUE_NOT_ALLOWED)
        given[one.name] = value
    return given


def require_log(path: Path) -> None:
    """Raise UsageError if there is no such log."""
    if not path.is_file():
        raise UsageError("this log does not exist", where=str(path), next_step="Name a run.mcap of tdhil",
                         entry=MessageCode.FILE_NOT_FOUND)


def require_target(flag: str, path: Path, sources: Iterable[Path], source: str) -> None:
    """Check, before the computation, that a new file can be written to ``path``. Raises UsageError.

    ``sources``: the files that are read; ``source``: what they are, such as ``the log``.
    """
    where = f"{flag} {path}"
    if path.resolve() in [one.resolve() for one in sources]:
        raise UsageError(f"is {source} itself", where=where, next_step="Name another file",
                         entry=MessageCode.SAME_FILE_TWICE)
    require_new(flag, path)


def require_new(flag: str, path: Path) -> None:
    """Raise UsageError if the file exists already, or its folder does not."""
    if path.exists():
        raise existing_file(f"{flag} {path}")
    require_folder(flag, path)


def require_folder(flag: str, path: Path) -> None:
    """Raise UsageError if the folder of a file to be written does not exist."""
    if not path.parent.is_dir():
        raise UsageError("can't be written: its folder does not exist", where=f"{flag} {path}",
                         next_step=f"Make {path.parent} first", entry=MessageCode.FILE_NOT_WRITABLE)


def add_drive_arguments(parser: argparse.ArgumentParser, *, moves: bool = False) -> argparse._ArgumentGroup:
    """Add the options that select the drive. Return the group, to which a command may add more. ``moves``: the command
    turns the shaft, which needs a file with the limits.
    """
    drive = add_options(parser, Topic.DRIVE)[Topic.DRIVE]
    use = "required to move a real drive" if moves else "it states the address of the drive"
    drive.add_argument("--rig", type=Path, metavar="rig.yaml", help=f"file of the rig; {use}")
    return drive


def add_line_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the address on any bus. Those of python-can are the most, and come last."""
    from tdhil.buses import all_buses

    before = set(parser._actions)
    buses = all_buses()
    for bus in reversed(buses):
        bus.add_arguments(parser)
    common = frozenset[str]().union(*(bus.common_flags for bus in buses))
    _RARE.update(action for action in parser._actions
                 if action not in before and common.isdisjoint(action.option_strings))
