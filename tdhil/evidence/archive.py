"""Content of an archive of evidence: its members, its bytes, and their check. Pure: no file, no clock.

::

    README.txt       what the archive is, who permits what, how it is checked
    statement.json   the publisher, the permitted parts, the reference inertia and how it is known, the firmware
    identity.json    the drive as it reported itself; the serial number is replaced
    parameters.json  what preflight read from the drive, line by line
    profile.json     the profile that the run used, with source and confidence of each entry
    result.json      the result document, identified from run.mcap
    run.mcap         the log, scrubbed
    manifest.json    kind, format, version, and the SHA-256 of each member

The members are stored without compression (the log has its own), in this order, with one fixed date. So the same
content has the same bytes. Every member except the log and the statement follows from these two.
"""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Final

from tdhil.evidence.drives import CONFIDENCE, agreement_of, shown_entries
from tdhil.evidence.statement import PARTS, PublisherStatement
from tdhil.report import SIMULATED

KIND: Final = "tdhil_evidence"
FORMAT: Final = 1
README, STATEMENT, IDENTITY, PARAMETERS, PROFILE, RESULT, LOG, MANIFEST = MEMBERS = (
    "README.txt", "statement.json", "identity.json", "parameters.json", "profile.json", "result.json", "run.mcap",
    "manifest.json",
)
LARGEST: Final = 2 * 2**30
"""Largest archive that is read, bytes."""

_DATE: Final = (1980, 1, 1, 0, 0, 0)
"""Date of each member: the earliest one that ZIP can state."""
_CHECK: Final = re.compile(
    r"(?P<name>.*?): (?:required (?P<required>.*?), )?found (?P<found>.*) \((?P<outcome>ok|note|refused)\)"
    r" ?(?P<where>.*)")
"""Text of an event of preflight (`tdhil.runner`)."""


@dataclass(frozen=True)
class LogFacts:
    """Facts that the other members take from the scrubbed log. ``run``: its configuration; ``preflight``: texts of the
    events of preflight, in order; ``simulated``: as the recording states it; ``torque_mode``: the drive confirmed its
    torque mode.
    """

    run: Mapping[str, Any]
    preflight: tuple[str, ...]
    simulated: bool
    torque_mode: bool = False


def missing_in(facts: LogFacts, stages: Sequence[tuple[str, str]], *, complete: bool) -> tuple[str, ...]:
    """Return what the log lacks for an archive, in words. ``stages``: name and outcome of each."""
    missing = []
    if not complete:
        missing.append("the end of the log: it was cut off or damaged")
    if facts.run.get("ended"):
        missing.append("the end of the run: it was stopped, or ended by a limit or a fault")
    if not any(name == "acquire" for name, _ in stages):
        missing.append("stage acquire, from which J is identified")
    missing += [f"a complete stage {name}: it is {outcome}" for name, outcome in stages if outcome == "aborted"]
    if not isinstance(facts.run.get("identity"), Mapping):
        missing.append("the identity of the drive")
    if not isinstance(facts.run.get("profile"), Mapping):
        missing.append("the profile of the drive")
    if not facts.preflight:
        missing.append("what preflight read from the drive")
    if not isinstance(facts.run.get("stop"), Mapping):
        missing.append("whether the stop was confirmed")
    return tuple(missing)


def members_of(facts: LogFacts, log: bytes, statement: PublisherStatement, result: Mapping[str, Any], version: str
               ) -> dict[str, bytes]:
    """Return the members by name, in their order. ``log``: bytes of the scrubbed log; ``version``: of tdhil."""
    identity = dict(facts.run.get("identity") or {})
    if reported := _reported_firmware(facts):
        identity["firmware_reported"] = reported
    found = {
        README: "",
        STATEMENT: text_of(statement.plain()),
        IDENTITY: text_of(identity | {"firmware": statement.firmware or reported}),
        PARAMETERS: text_of([        # each line of preflight in its parts
            {name: part for name, part in check.groupdict().items() if part} if (check := _CHECK.fullmatch(one))
            else {"text": one} for one in facts.preflight]),
        PROFILE: text_of(facts.run.get("profile")),
        RESULT: text_of(result),
    }
    shown = shown_entries(facts.run, statement, result, torque_mode=facts.torque_mode)
    found[README] = readme(facts, statement, result, version)
    members = {name: text.encode() for name, text in found.items()} | {LOG: log}
    manifest = {
        "kind": KIND, "format": FORMAT, "tdhil": version, "simulated": facts.simulated,
        "shown": shown,
        "members": {name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
                    for name, data in members.items()},
    }
    return members | {MANIFEST: text_of(manifest).encode()}


def _reported_firmware(facts: LogFacts) -> str:
    """Return the software version that the drive reported (100Ah); '' for none, and for a log of an earlier version."""
    found = dict(facts.run.get("identity") or {}).get("firmware")
    return found if isinstance(found, str) else ""


def archive_of(members: Mapping[str, bytes]) -> bytes:
    """Return the bytes of the archive. The same members give the same bytes on every computer."""
    out = BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            one = zipfile.ZipInfo(name, _DATE)
            one.create_system, one.external_attr = 3, 0o100644 << 16      # as on Unix, wherever it is made
            archive.writestr(one, data)
    return out.getvalue()


def members_in(archive: bytes) -> dict[str, bytes]:
    """Return the members of an archive by name. Raises ValueError if it is none, or has other bytes than its members
    have in an archive of tdhil (a comment, another date, a hidden member).
    """
    if len(archive) > LARGEST:
        raise ValueError(f"it has {len(archive)} bytes (limit {LARGEST})")
    try:
        with zipfile.ZipFile(BytesIO(archive)) as found:
            if any(one.compress_type != zipfile.ZIP_STORED for one in found.infolist()):
                raise ValueError("a member is compressed; tdhil stores its members")
            members = {one.filename: found.read(one) for one in found.infolist()}
    except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"it can't be read as an archive: {error}") from error
    if archive_of(members) != archive:
        raise ValueError("it has bytes outside its members, or was written by another program")
    return members


def problems_of_members(members: Mapping[str, bytes]) -> tuple[str, ...]:
    """Return what is wrong with names, manifest and digests; () if all agree."""
    problems = [f"{name} is missing" for name in MEMBERS if name not in members]
    problems += [f"{name[:60]!r} does not belong in it" for name in members if name not in MEMBERS]
    if MANIFEST not in members:
        return tuple(problems)
    try:
        manifest = json.loads(members[MANIFEST])
        stated = manifest["members"]
        if manifest["kind"] != KIND or manifest["format"] != FORMAT:
            return (*problems, f"{MANIFEST} is of another kind or format")
        if text_of(manifest).encode() != members[MANIFEST]:
            problems.append(f"{MANIFEST} is written in another form than tdhil writes it")
        if set(stated) != set(MEMBERS) - {MANIFEST}:
            problems.append(f"{MANIFEST} lists other members")
        problems += [
            f"{name} was changed: its SHA-256 is not the one of {MANIFEST}" for name, data in members.items()
            if name in stated and stated[name] != {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        ]
    except (ValueError, KeyError, TypeError):
        problems.append(f"{MANIFEST} can't be read")
    return tuple(problems)


def text_of(value: Any) -> str:
    """Return plain data as JSON in the one form of an archive."""
    return json.dumps(value, ensure_ascii=False, indent=1) + "\n"


# ---------------------------------------------------------------------------------------------------------------------


def readme(facts: LogFacts, statement: PublisherStatement, result: Mapping[str, Any], version: str) -> str:
    """Return the text for a reader who has the archive and nothing else."""
    shown = shown_entries(facts.run, statement, result, torque_mode=facts.torque_mode)
    identity, profile = (dict(facts.run.get(name) or {}) for name in ("identity", "profile"))
    permitted = ", ".join(statement.publish)
    kept = ", ".join(one for one in PARTS if one not in statement.publish) or "none"
    reported, agreement = _reported_firmware(facts), agreement_of(statement, result)
    stated = statement.firmware or ("" if reported else "not stated")
    firmware = "; ".join(filter(None, (stated, f"the drive reports {reported} (100Ah)" if reported else "")))
    lines = [
        f"{SIMULATED}: this run is of the simulated drive of tdhil. It is no evidence about a drive.\n"
        if facts.simulated else "This run is of a real drive.\n",
        "An archive of tdhil: one run that identified a moment of inertia, with all that is needed to check it.\n",
        f"drive            {identity.get('name', '')}, vendor {identity.get('vendor')}, product"
        f" {identity.get('product')}, revision {identity.get('revision')}",
        f"firmware         {firmware}",
        f"profile          {profile.get('name', '')}: {profile.get('title', '')}",
        f"date             {facts.run.get('started') or 'not stated'}",
        f"J                {_inertia(result)}",
        f"verdict          {result.get('verdict')}",
        f"reference        {_reference(statement)}",
        f"agreement        {'not known: no reference, or no J' if agreement is None else agreement.text}",
        f"entries shown    {', '.join(shown) or 'none'}",
        "",
        f"publisher        {statement.publisher}",
        f"may be published {permitted}",
        f"may not be       {kept}",
        "",
        "Removed before it was made: names of persons, computers and folders, addresses, notes, the operator"
        f"{'' if 'rig' in statement.publish else ', the name of the rig'}.",
        "Serial numbers are replaced by 1, 2, ... in the log, its frames and its documents.",
        "",
        "Check it:        tdhil evidence --check ARCHIVE --sha256 DIGEST",
        "DIGEST is the SHA-256 of the whole archive. Take it from the publisher, not from the archive.",
        "The check compares each member with manifest.json, looks for names and passwords, and identifies J again",
        "from run.mcap. It shows that the archive is unchanged and consistent. It does not show who made the run.",
        "",
        "run.mcap opens in every MCAP viewer. tdhil replay run.mcap identifies it again.",
        f"Made by tdhil {version}.",
    ]
    return "\n".join(lines) + "\n"


def _inertia(result: Mapping[str, Any]) -> str:
    found = result.get("inertia_kg_m2")
    if not isinstance(found, Mapping):
        return "none"
    return (f"{found['value']:.6g} kg m2 at the motor shaft, {100 * found.get('confidence', CONFIDENCE):g} % coverage"
            f" interval {found['low_total']:.6g} to {found['high_total']:.6g}")


def _reference(statement: PublisherStatement) -> str:
    one = statement.reference
    if one is None:
        return "none stated"
    return (f"{one.inertia_kg_m2:.6g} kg m2, standard uncertainty {one.sd_kg_m2:.3g} kg m2, {one.method}:"
            f" {one.note}")
