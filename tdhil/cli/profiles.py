"""`tdhil profiles`: profiles in tdhil, their confidence, their required settings, and checks of a file."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles import (
    DataFileError,
    Profile,
    ProfileEntry,
    eds_path,
    load_profile,
    matching_names,
    profile_names,
    unit_text,
)
from tdhil.buses import (
    MARKS,
    bus_named,
    counts,
    facts_of,
    modes_text,
    row,
    sure_text,
    watchdog_text,
)
from tdhil.cli.arguments import add_option
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.errors import ExitCode, MessageCode, existing_file
from tdhil.session import UNVERIFIED_FLAG, doubtful

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


# ---------------------------------------------------------------------------------------------------------------------
# `tdhil profiles show`: all information needed at the drive, on the terminal.


_NARROW = 72          # columns; a narrower table is without the watchdog
_SHOW = ("torque: the drive has a torque mode. V/L/U: number of entries that are verified, likely, unverified. *: "
         "experimental.\ntdhil profiles show NAME shows what to set at the drive and what to look up in its manual.")


def show(profile: Profile, console: Console) -> None:
    """Print the page. Unverified entries come last, where they are visible."""
    _head(profile, console)
    _by_hand(profile, console)
    bus = bus_named(profile.bus)
    for one in bus.profile_tables(profile):
        if one.headings:
            table = _table(one.title, *one.headings)
            for cells in one.rows:
                table.add_row(*cells)
            console.print(table)
        for remark in one.remarks:
            console.print(remark, markup=False)
    sections = bus.profile_sections
    if sections is None:
        sections = tuple(name for name, _ in profile.entries() if not name.startswith("parameters."))
    for name, entry in profile.entries():
        if name in sections:
            _section(name, entry, console)
    found = doubtful(profile)
    if not found:
        console.print("Every entry is verified.")
        return
    table = _table("not verified: look these up in the drive's manual", "entry", "confidence", "claim", "source")
    for name, entry in found:
        claims = "; ".join(f"{key} {value}" for key, value, _ in facts_of(entry))
        table.add_row(name, MARKS[entry.confidence], claims, entry.source)
    console.print(table)
    console.print(
        f"A real drive is refused until you set 'confidence: verified' in a copy of the profile, or accept them as "
        f"they are: {UNVERIFIED_FLAG} likely accepts all likely ones, {UNVERIFIED_FLAG} NAME one entry.", markup=False
    )


def _head(profile: Profile, console: Console) -> None:
    console.print(f"{profile.name}: {profile.title}", style="bold", markup=False)
    rows = [("bus", profile.bus), ("modes", modes_text(profile)), ("watchdog", watchdog_text(profile))]
    rows += bus_named(profile.bus).profile_facts(profile)
    if profile.experimental:
        rows.append(("EXPERIMENTAL", "from secondary sources, or never tried on this bus"))
    rows.append(("confidence", sure_text(profile)))
    for name, text in rows:
        console.print(f"  {name:<12}  {text}", markup=False)
    for hint in getattr(profile, "hints", ()):
        console.print(f"  - {hint}", markup=False)


def _by_hand(profile: Profile, console: Console) -> None:
    """Print the checklist: settings at the drive, keys in rig.yaml, and settings of a run."""
    required = [one for one in profile.parameters if one.require is not None]
    if required:
        table = _table("set by hand at the drive; a run is refused until they are read", "parameter", "must be", "do")
        for one in required:
            assert one.require is not None
            needed = one.require.text_in(one.unit)
            table.add_row(one.title, needed, _advice(one, one in profile.untold))
        console.print(table)
    missing = [(f"parameters: {{{one.name}: …}}", one.title, unit_text(one.unit)) for one in profile.untold]
    if profile.rated_torque_by_hand:
        missing.insert(0, ("rated_torque_nm", "torque that is 100 %", "N·m"))
    if missing:
        table = _table("required in rig.yaml, not reported by the drive", "key under drive_data", "meaning", "unit")
        for row in missing:
            table.add_row(*row)
        console.print(table)
    written = [one for one in profile.parameters if one.set_to is not None]
    if written:
        table = _table("written by a run, read back, and restored afterwards", "parameter", "value")
        for one in written:
            table.add_row(one.title, str(one.set_to).replace("_", " "))
        console.print(table)
    if (loop := profile.speed_controller) is not None and loop.belongs_to(simulated=False):
        table = _table("speed loop, for the gains of tdhil tune; no run writes them", "parameter", "confidence")
        for entry in (loop.gain, loop.integral, loop.filter, *loop.notch):
            if entry is not None:
                table.add_row(entry.title, MARKS[entry.confidence])
        console.print(table)


def _advice(one: Any, untold: bool) -> str:
    """Return the instruction for a parameter. ``untold``: it cannot be read over the bus."""
    stated = f"and state it in rig.yaml: drive_data.parameters.{one.name}" if untold else ""
    return "; ".join(part for part in (one.advice or "", stated) if part)


def _section(name: str, entry: ProfileEntry, console: Console) -> None:
    table = _table(f"{name} ({entry.confidence}: {entry.source})", "", "", "")
    table.show_header = False
    for key, value, said in facts_of(entry):
        table.add_row(key, value, said)
    if table.row_count:
        console.print(table)


def _table(title: str, *headings: str) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(f"\n{title}"), title_justify="left", expand=False)
    for heading in headings:
        table.add_column(heading, overflow="fold")
    return table


# ---------------------------------------------------------------------------------------------------------------------

def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add `tdhil profiles`, `… show NAME`, `… check FILE`, `… import FILE`."""
    add_option(parser, OPTION["json"])
    actions = parser.add_subparsers(dest="action", metavar="ACTION")
    shown = actions.add_parser("show", help="show the settings that one profile needs at the drive",
                                description="Show the settings that one profile needs at the drive. A vendor's name "
                                            "lists the profiles for that vendor's drives.")
    shown.add_argument("name", metavar="NAME", help="vendor/model or the beginning of it, a vendor, or a .yaml file")
    checked = actions.add_parser("check", help="check your own profile; exit 2 and one line per problem",
                                 description="Check your own profile. Exit 2 and one line per problem.")
    checked.add_argument("files", metavar="FILE", nargs="+", help="a .yaml file, or vendor/model")
    begun = actions.add_parser("import", help="create your own profile from the drive's EDS or DCF",
                               description="Create your own profile from the drive's EDS or DCF. What the file "
                                           "does not contain is marked unverified, with what to find in the manual.")
    begun.add_argument("file", metavar="FILE", help="the .eds or .dcf file from the drive's manufacturer")
    begun.add_argument("-o", "--output", metavar="FILE", default=None,
                       help="the profile (default: named as the EDS, in this folder); none is overwritten")
    for action in (shown, checked, begun):
        action.add_argument("--json", action="store_const", const=True, default=argparse.SUPPRESS,
                            help="print one JSON document on stdout")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Run the command. Return the exit code. Raises DataFileError with every problem and its line."""
    as_json = namespace.json is True
    if namespace.action == "show":
        return _show(namespace.name, as_json)
    if namespace.action == "check":
        return _check(namespace.files, as_json)
    if namespace.action == "import":
        return _import(namespace.file, namespace.output, as_json)
    return _list(as_json)


def _list(as_json: bool, names: tuple[str, ...] = ()) -> int:
    """List all profiles, or those of ``names``."""
    profiles = [load_profile(name) for name in names or profile_names()]
    if as_json:
        print_json({"profiles": [row(profile) for profile in profiles]})
        return 0
    from rich.table import Table

    console = _console()
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    columns = ("profile", "bus", "torque", "V/L/U", "watchdog")[:5 if console.width >= _NARROW else 4]
    for heading in columns:
        table.add_column(heading, no_wrap=heading != "watchdog")
    for profile in profiles:
        sure = "/".join(map(str, counts(profile).values())) + ("*" if profile.experimental else "")
        watchdog = watchdog_text(profile).replace(", then ", " → ").replace("the drive would keep", "keeps")
        cells = (profile.name, profile.bus, "yes" if profile.can_torque else "no", sure, watchdog)
        table.add_row(*cells[:len(columns)])
    console.width = max(console.width, 56)        # the names need as much
    console.print(table)
    console.print(_SHOW)
    return 0


def _show(name: str, as_json: bool) -> int:
    meant = matching_names(name)
    if len(meant) > 1:
        return _list(as_json, meant)
    profile = load_profile(meant[0] if meant else name)
    if as_json:
        print_json({
            "profile": profile.model_dump(mode="json", by_alias=True),
            "not_verified": [
                {"name": name, "confidence": entry.confidence, "source": entry.source}
                for name, entry in doubtful(profile)
            ],
        })
        return 0

    show(profile, _console())
    return 0


def _check(files: list[str], as_json: bool) -> int:
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
        print_json({"ok": not problems, "profiles": found, "problems": problems, "exit_code": code})
    return code


def _import(file: str, output: str | None, as_json: bool) -> int:
    import shlex

    from profiles import DataFileError, Problem, begin_profile, read_eds

    source = Path(file)
    target = Path(output) if output is not None else Path(f"{source.stem}.yaml")
    if target.suffix not in (".yaml", ".yml"):
        raise DataFileError((Problem(str(target), 0, "a profile's file name must end in .yaml: name it with -o"),))
    begun = begin_profile(read_eds(source), file)
    try:
        with target.open("x", encoding="utf-8") as stream:
            stream.write(begun.text)
    except FileExistsError:
        raise existing_file(target) from None
    except OSError as error:
        message = f"can't be written ({error.strerror or error}); name another path with -o"
        raise DataFileError((Problem(str(target), 0, message),), entry=MessageCode.FILE_NOT_WRITABLE) from error
    open_entries = [name for name, entry in doubtful(begun.profile) if entry.confidence == "unverified"]
    if as_json:
        print_json({"file": str(target), "profile": row(begun.profile), "unverified": open_entries})
        return 0
    named = f"{begun.profile.name} on {begun.profile.bus}"
    print(f"{target}: {named}, created from {source.name}: {sure_text(begun.profile)}")  # noqa: T201
    print(f"Look up in the drive's manual: {', '.join(open_entries)}. The file states what to look for.")  # noqa: T201
    # --profile takes a bare name as a profile of the library: a file in this folder needs ./
    path = shlex.quote(str(target) if target.parent.name or target.is_absolute() else f"./{target}")
    print(f"Then: tdhil profiles check {target}, and tdhil identify --simulate --profile {path}")  # noqa: T201
    return 0


def _load(file: str) -> Profile:
    """Load a profile as `load_profile` does, and check that its EDS exists."""
    profile = load_profile(file)
    eds_path(file)
    return profile


def _console() -> Any:
    from tdhil.report import PlainConsole

    return PlainConsole()
