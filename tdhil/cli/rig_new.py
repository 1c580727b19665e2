"""`tdhil rig new`: a commented rig.yaml to fill in, without a drive."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from profiles import visible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command `new`."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    new = actions.add_parser("new", help="write a rig.yaml to fill in", allow_abbrev=False,
                             description="Write a commented rig.yaml to fill in, without a drive.")
    new.add_argument("file", type=Path, nargs="?", default=Path("rig.yaml"), metavar="rig.yaml",
                     help="file to write; an existing file is never overwritten")
    new.add_argument("--profile", default="generic/cia402", metavar="NAME",
                     help="vendor/model, or a .yaml file (tdhil profiles lists them; default generic/cia402)")
    new.add_argument("--load", choices=("none", "string"), required=True,
                     help="load on the shaft: string for a drill string, otherwise none")
    new.add_argument("--name", metavar="NAME", help="name of the rig in reports and in tdhil trend, such as 'bench 3'")
    new.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Write the file, and report the entries to fill in. Raises UsageError if it cannot be written."""
    from profiles import load_profile
    from tdhil.cli.scan import write_new
    from tdhil.config import LONGEST_NAME
    from tdhil.errors import MessageCode, UsageError
    from tdhil.session import RigEntries, blank_rig, to_fill_in

    path: Path = namespace.file
    name = namespace.name or _asked()
    if name is not None and len(name) > LONGEST_NAME:
        raise UsageError(f"{len(name)} characters are too many", where="--name",
                         next_step=f"Give at most {LONGEST_NAME}", entry=MessageCode.VALUE_NOT_ALLOWED)
    profile = load_profile(namespace.profile)
    named = namespace.profile
    if named.endswith((".yaml", ".yml")):
        named = Path(os.path.relpath(named, path.parent)).as_posix()      # relative to the folder of rig.yaml
    write_new(path, blank_rig(profile, named, namespace.load, RigEntries(name=name)))
    print(f"{path}: written. Fill these in; until then a real drive does not move:", file=sys.stderr)  # noqa: T201
    for line in to_fill_in(profile, namespace.load, name):
        print(f"  {line}", file=sys.stderr)  # noqa: T201
    return 0


def _asked() -> str | None:
    """Ask for the rig's name at a terminal. Return None without an answer: the file then has a blank."""
    if sys.stdin is None or not sys.stdin.isatty():
        return None
    print("Name of this rig, such as bench 3: ", end="", file=sys.stderr, flush=True)  # noqa: T201
    from tdhil.config import LONGEST_NAME

    return visible(sys.stdin.readline().strip())[:LONGEST_NAME] or None
