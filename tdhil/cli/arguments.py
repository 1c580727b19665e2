"""Command line options that say which drive is meant and where it is: the same for every command that talks to one.

None as a default means: rig.yaml, else the profile, else the built-in default (`tdhil.config.options`).
"""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Callable, Iterable
from pathlib import Path

from profiles import quantities
from profiles.quantities import SHARE, Unit
from tdhil.config import BUSES, DEFAULT_BUS
from tdhil.session import bus_kinds

# ---------------------------------------------------------------------------------------------------------------------
# Quantities as people type them on the command line: 1%, 0.01, 5min, 40rpm. `profiles.quantities` has the units.


def amount(unit: Unit) -> Callable[[str], float]:
    """For argparse: a number in ``unit``, or with any unit of the same kind, in ``unit``."""

    def read(text: str) -> float:
        try:
            return quantities.read(text, unit)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text[:60]!r}: {error}") from None

    return read


share = amount(SHARE)
"""``1%`` or ``0.01``."""

TOLERANCE = "a share between 0 and 1, such as 1% or 0.01"


def meant(name: str, known: Iterable[str]) -> str:
    """The question whether it is the one of ``known`` that is much like it, and a space; nothing where none is."""
    close = difflib.get_close_matches(name[:40], list(known), n=1)
    return f"Did you mean '{close[0]}'? " if close else ""


# ---------------------------------------------------------------------------------------------------------------------

def add_drive_arguments(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Which drive; the group, for what a command has to add to it."""
    kinds = bus_kinds()
    drive = parser.add_argument_group("drive")
    drive.add_argument("--drive", choices=tuple(BUSES),
                       help=f"how the drive is spoken to (default: as the profile is, else {DEFAULT_BUS})")
    drive.add_argument("--profile", metavar="NAME", help="vendor/model, or a .yaml file (default "
                       f"{', '.join(kind.default_profile for kind in kinds)})")
    drive.add_argument("--rig", type=Path, metavar="rig.yaml", help="the bench; needed to move anything real")
    for kind in kinds:
        kind.add_drive_arguments(drive)
    return drive


def add_line_arguments(parser: argparse.ArgumentParser) -> None:
    """Where it is, on any bus: python-can's own options are the most, and come last."""
    for kind in reversed(bus_kinds()):
        kind.add_arguments(parser)
