"""`tdhil profiles`: what ships, what each is sure of, what it needs set on the drive; and whether a file is right."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from profiles.library import Profile


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`tdhil profiles`, `… show NAME`, `… check FILE`, `… import FILE`."""
    parser.add_argument("--json", action="store_const", const=True, help="one JSON document on stdout")
    actions = parser.add_subparsers(dest="action", metavar="ACTION")
    shown = actions.add_parser("show", help="all that a person at the drive needs of one profile",
                               description="All that a person at the drive needs of one profile. A vendor's name "
                                           "lists what ships for that vendor's drives.")
    shown.add_argument("name", metavar="NAME", help="vendor/model or the beginning of it, a vendor, or a .yaml file")
    checked = actions.add_parser("check", help="is a profile of your own right? exit 2 and a line a problem if not",
                                 description="Is a profile of your own right? Exit 2 and a line a problem if not.")
    checked.add_argument("files", metavar="FILE", nargs="+", help="a .yaml file, or vendor/model")
    begun = actions.add_parser("import", help="begin a profile of your own from the drive's EDS or DCF",
                               description="Begin a profile of your own from the drive's EDS or DCF. What the file "
                                           "can't know is marked unverified, with what to look for in the manual.")
    begun.add_argument("file", metavar="FILE", help="the .eds or .dcf file that the drive's maker gives out")
    begun.add_argument("-o", "--output", metavar="FILE", default=None,
                       help="the profile (default: named as the EDS, in this folder); none is overwritten")
    for action in (shown, checked, begun):
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
    if namespace.action == "import":
        return _import(namespace.file, namespace.output, as_json)
    return _list(as_json)


def _list(as_json: bool, names: tuple[str, ...] = ()) -> int:
    """All, or those of ``names``."""
    from profiles.library import load_profile, profile_names
    from tdhil.cli.profile_text import row, sure_text

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
    from tdhil.cli.profile_text import counts, sure_text
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


def _import(file: str, output: str | None, as_json: bool) -> int:
    from pathlib import Path

    from profiles.eds_import import begin_profile
    from profiles.eds_reader import read_eds
    from profiles.errors import DataFileError, Problem
    from tdhil.cli.profile_text import row, sure_text
    from tdhil.commands.unverified import doubtful

    source = Path(file)
    target = Path(output) if output is not None else Path(f"{source.stem}.yaml")
    if target.suffix not in (".yaml", ".yml"):
        raise DataFileError((Problem(str(target), 0, "a profile's file ends in .yaml: name it so with -o"),))
    begun = begin_profile(read_eds(source), file)
    try:
        with target.open("x", encoding="utf-8") as stream:
            stream.write(begun.text)
    except FileExistsError:
        message = "is there already and stays as it is; name another one with -o"
        raise DataFileError((Problem(str(target), 0, message),)) from None
    except OSError as error:
        message = f"can't be written ({error.strerror or error}); name another place with -o"
        raise DataFileError((Problem(str(target), 0, message),)) from error
    open_entries = [name for name, entry in doubtful(begun.profile) if entry.confidence == "unverified"]
    if as_json:
        _dump({"file": str(target), "profile": row(begun.profile), "unverified": open_entries})
        return 0
    print(f"{target}: {begun.profile.name} on canopen, begun from {source.name}: {sure_text(begun.profile)}")  # noqa: T201
    print(f"Look up in the drive's manual: {', '.join(open_entries)}. What to look for stands in the file.")  # noqa: T201
    print(f"Then: tdhil profiles check {target}, and tdhil identify --simulate --profile {_as_path(target)}")  # noqa: T201
    return 0


def _as_path(target: Path) -> str:
    """As a shell takes it, and as `--profile` knows it for a file."""
    import shlex

    return shlex.quote(str(target) if target.parent.name or target.is_absolute() else f"./{target}")


def _load(file: str) -> Profile:
    """As `load_profile`; and the EDS that it names is there."""
    from profiles.library import eds_path, load_profile

    profile = load_profile(file)
    eds_path(file)
    return profile


def _console() -> Any:
    from tdhil.report.console import PlainConsole

    return PlainConsole()


def _dump(document: dict[str, Any]) -> None:
    json.dump(document, sys.stdout, ensure_ascii=False, indent=2, allow_nan=False)
    sys.stdout.write("\n")
