"""`tdhil evidence run.mcap`: one archive of a run on a real drive, for others to check. `--check` checks one."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles import visible
from tdhil.cli.arguments import add_option
from tdhil.config import OF_EVIDENCE, EvidenceOptions
from tdhil.errors import ExitCode, MessageCode, UsageError, existing_file

if TYPE_CHECKING:
    from tdhil.evidence import EvidenceCheck

_OF_THE_CHECK = "--check"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of evidence."""
    parser.add_argument("log", type=Path, nargs="?", metavar="run.mcap", help="the log of a complete run")
    parser.add_argument("-o", "--output", type=Path, metavar="evidence.zip",
                        help="default: beside the log; no file is overwritten")
    parser.add_argument(_OF_THE_CHECK, type=Path, metavar="evidence.zip", help="check this archive instead: digests, "
                        "completeness, private texts, and the result, identified again from its log")
    parser.add_argument("--sha256", metavar="HEX", help="with --check: the archive's SHA-256, as the publisher "
                        "states it")
    statement = parser.add_argument_group("statement of the publisher")
    for option in OF_EVIDENCE:
        add_option(statement, option)
    statement.add_argument("--serial-key", type=Path, metavar="FILE", help="key of at least 32 bytes for a keyed "
                           "hash of the serial number: it shows that two archives are of one drive")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Make or check an archive. Exit 0: made, or passed; 2: refused; 12: the archive does not pass."""
    if namespace.check is not None:
        return _check(namespace)
    if namespace.sha256 is not None:
        raise UsageError("is for the check of an archive", where="--sha256", next_step=f"Add {_OF_THE_CHECK} ARCHIVE")
    if namespace.log is None:
        raise UsageError("no log is named", next_step="For example: tdhil evidence run.mcap --publisher NAME --publish"
                         " log,result,identity", entry=MessageCode.LOG_NEEDED)
    return _make(namespace)


def _make(namespace: argparse.Namespace) -> int:
    from tdhil.evidence import flag_of, make_evidence, names_of_this_computer, statement_of, wrong_in
    from tdhil.report import working
    from tdhil.session import require_file

    log: Path = namespace.log
    target: Path = namespace.output or log.with_name(f"{log.stem}.evidence.zip")
    require_file(log)
    stated: dict[str, Any] = {one.keyword: value for one in OF_EVIDENCE
                              if (value := getattr(namespace, one.name)) is not None}
    given = EvidenceOptions(**stated | {"remove": tuple(stated.get("remove", ()))})
    if wrong := wrong_in(given):
        (name, why), *more = wrong
        also = f" ({', '.join(flag_of(one) for one, _ in more)} too)" if more else ""
        raise UsageError(f"{why}{also}", where=flag_of(name), entry=MessageCode.EVIDENCE_STATEMENT)
    if target.exists():
        raise existing_file(target)
    words = (*given.remove, *names_of_this_computer())
    key = _key(namespace.serial_key)
    with working("making the archive …"):
        made = make_evidence(log, statement_of(given), words, serial_key=key)
    try:
        with target.open("xb") as file:
            file.write(made.archive)
        target.with_name(f"{target.name}.sha256").write_text(f"{made.sha256}  {target.name}\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=str(target),
                         entry=MessageCode.FILE_NOT_WRITABLE) from error
    print(f"{made.sha256}  {target}")  # noqa: T201
    _say(f"{'SIMULATED: ' if given.simulated else ''}{len(made.archive) / 1e6:.2f} MB: {', '.join(made.members)}")
    _say("Names of persons, computers, folders and the rig, addresses and serial numbers were removed. Read README.txt"
         " and the other documents before you publish the archive.")
    return int(ExitCode.OK)


def _key(path: Path | None) -> bytes:
    """Return the key for serial numbers; b'' without a file. Raises UsageError for one that is too short."""
    from tdhil.evidence import SHORTEST_KEY

    if path is None:
        return b""
    try:
        key = path.read_bytes()
    except OSError as error:
        raise UsageError(f"can't be read ({error.strerror or error})", where=f"--serial-key {path}",
                         entry=MessageCode.FILE_NOT_FOUND) from error
    if len(key) < SHORTEST_KEY:
        raise UsageError(f"has {len(key)} bytes, and a key needs at least {SHORTEST_KEY}", where=f"--serial-key {path}",
                         next_step=f"Make one with: head -c {SHORTEST_KEY} /dev/urandom > serial.key")
    return key


def _check(namespace: argparse.Namespace) -> int:
    from tdhil.evidence import check_evidence, flag_of
    from tdhil.report import working

    path: Path = namespace.check
    if namespace.log is not None or namespace.output is not None:
        raise UsageError("makes no archive, so it takes neither a log nor -o", where=_OF_THE_CHECK)
    stated = [flag_of(one.name) for one in OF_EVIDENCE if getattr(namespace, one.name) is not None]
    if given := [*stated, *(["--serial-key"] if namespace.serial_key is not None else [])]:
        raise UsageError(f"has no effect with {_OF_THE_CHECK}, which makes no archive", where=" ".join(given),
                         next_step="Nothing was checked. Leave it out")
    digest = (namespace.sha256 or "").strip()
    if namespace.sha256 is not None and not re.fullmatch("[0-9a-fA-F]{64}", digest):
        raise UsageError(f"{visible(digest)[:80]!r} is not a SHA-256, which has 64 hexadecimal digits",
                         where="--sha256", next_step="Nothing was checked. Give all digits of the file .sha256",
                         entry=MessageCode.VALUE_NOT_ALLOWED)
    try:
        archive = path.read_bytes()
    except OSError as error:
        raise UsageError(f"can't be read ({error.strerror or error})", where=str(path),
                         entry=MessageCode.FILE_NOT_FOUND) from error
    with working("checking the archive …"):
        found = check_evidence(archive, digest)
    _show(found, path)
    return int(ExitCode.NOT_PASSED if found.problems else ExitCode.OK)


def _show(found: EvidenceCheck, path: Path) -> None:
    from profiles import with_code

    for problem in found.problems:
        _say(f"tdhil: {path}: {with_code(problem, MessageCode.EVIDENCE_FAILED.code)}")
    for note in found.notes:
        _say(f"note: {note}")
    print(f"{found.sha256}  {path}: {'DOES NOT PASS' if found.problems else 'passes'}")  # noqa: T201


def _say(text: str) -> None:
    from tdhil.report import stderr_console

    stderr_console().print(text, markup=False, highlight=False, soft_wrap=True)
