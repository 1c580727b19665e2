"""`tdhil profiles`: what ships, what each is sure of, what it needs set on the drive; and whether a file is right."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from profiles.library import Profile


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`tdhil profiles`, `tdhil profiles show NAME`, `tdhil profiles check FILE`."""
    parser.add_argument("--json", action="store_const", const=True, help="one JSON document on stdout")
    actions = parser.add_subparsers(dest="action", metavar="ACTION")
    shown = actions.add_parser("show", help="all that a person at the drive needs of one profile",
                               description="All that a person at the drive needs of one profile. A vendor's name "
                                           "lists what ships for that vendor's drives.")
    shown.add_argument("name", metavar="NAME", help="vendor/model or the beginning of it, a vendor, or a .yaml file")
    checked = actions.add_parser("check", help="is a profile of your own right? exit 2 and a line a problem if not",
                                 description="Is a profile of your own right? Exit 2 and a line a problem if not.")
    checked.add_argument("files", metavar="FILE", nargs="+", help="a .yaml file, or vendor/model")
    for action in (shown, checked):
        action.add_argument("--json", action="store_const", const=True, default=argparse.SUPPRESS,
                            help="one JSON document on stdout")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """The exit code; DataFileError, with every problem and its line, for what can't be loaded."""
    as_json = namespace.json is True
    if namespace.action == "show":
        return _show(namespace.name, as_json)
    if namespace.action == "check":
        return _check(namespace.files, as_json)
    return _list(as_json)


def _list(as_json: bool, names: tuple[str, ...] = ()) -> int:
    """All, or those of ``names``."""
    from profiles.library import load_profile, profile_names
    from tdhil.commands.profile_said import row, sure_text

    profiles = [load_profile(name) for name in names or profile_names()]
    if as_json:
        _dump({"profiles": [row(profile) for profile in profiles]})
        return 0
    from rich.table import Table

    table = Table(expand=False)
    for heading in ("profile", "bus", "modes"):
        table.add_column(heading, no_wrap=True)
    for heading in ("watchdog", "how sure"):
        table.add_column(heading, overflow="fold")
    for profile in profiles:
        said = row(profile)
        sure = sure_text(profile) + (", experimental" if said["experimental"] else "")
        table.add_row(said["name"], said["bus"], said["modes"], said["watchdog"], sure)
    console = _console()
    console.print(table)
    console.print("tdhil profiles show NAME tells what to set at the drive and what to look up in its manual.")
    return 0


def _show(name: str, as_json: bool) -> int:
    from profiles.library import load_profile, matching_names
    from tdhil.commands.unverified import doubtful

    meant = matching_names(name)
    if len(meant) > 1:
        return _list(as_json, meant)
    profile = load_profile(meant[0] if meant else name)
    if as_json:
        _dump({
            "profile": profile.model_dump(mode="json", by_alias=True),
            "not_verified": [
                {"name": name, "confidence": entry.confidence, "source": entry.source}
                for name, entry in doubtful(profile)
            ],
        })
        return 0
    from tdhil.commands.profile_page import show

    show(profile, _console())
    return 0


def _check(files: list[str], as_json: bool) -> int:
    from profiles.errors import DataFileError
    from tdhil.commands.profile_said import counts, sure_text
    from tdhil.errors import ExitCode

    problems: list[dict[str, Any]] = []
    found: list[dict[str, Any]] = []
    for file in files:
        try:
            profile = _load(file)
        except DataFileError as error:
            for problem in error.problems:
                problems.append({"file": problem.file, "line": problem.line, "message": problem.message})
                if not as_json:
                    print(problem, file=sys.stderr)  # noqa: T201
            continue
        found.append({"file": file, "name": profile.name, "bus": profile.bus, "entries": counts(profile)})
        if not as_json:
            entries = sum(counts(profile).values())
            print(f"{file}: ok, {profile.name} on {profile.bus}: {entries} entries, {sure_text(profile)}")  # noqa: T201
    code = int(ExitCode.USAGE) if problems else 0
    if as_json:
        _dump({"ok": not problems, "profiles": found, "problems": problems, "exit_code": code})
    return code


def _load(file: str) -> Profile:
    """As `load_profile`; and the EDS that it names is there."""
    from profiles.library import eds_path, load_profile

    profile = load_profile(file)
    eds_path(file)
    return profile


def _console() -> Any:
    from rich.console import Console

    return Console(highlight=False)


def _dump(document: dict[str, Any]) -> None:
    json.dump(document, sys.stdout, ensure_ascii=False, indent=2, allow_nan=False)
    sys.stdout.write("\n")
