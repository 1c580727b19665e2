"""An archive of evidence from the log of a run, and its check. Everything here reads files, or identifies."""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from tdhil.errors import LogError, MessageCode, TdhilError, UsageError
from tdhil.evidence.archive import (
    LOG,
    MANIFEST,
    README,
    RESULT,
    STATEMENT,
    LogFacts,
    archive_of,
    members_in,
    members_of,
    missing_in,
    problems_of_members,
    text_of,
)
from tdhil.evidence.leaks import leaks_in, texts_in
from tdhil.evidence.log_scrub import LogScrub
from tdhil.evidence.statement import PublisherStatement, serial_hmac, statement_in
from tdhil.version import __version__

Conclude = Callable[[Path], Mapping[str, Any]]
"""Function (log) → result document of this log, by its name run.mcap."""

LEVEL: Final = 12
"""Compression of the log in an archive: a third smaller than in a run, in some seconds."""
_ALIKE: Final = 1e-9
"""Relative difference of two equal results: they come from equal samples, by the same program."""
_REPLAYED: Final = 1e-6
"""Relative difference of a replay by the same version on another computer: rounding of the linear algebra."""
OTHER_VERSION: Final = 0.01
"""Relative difference of a replay by another version, whose identification may be better."""
_MOST: Final = 1e300
"""Magnitude above which a stated value is no number: an integer of JSON may exceed every float."""
_INTERVAL: Final = ("value", "low", "high", "low_total", "high_total")
_MAY_LACK: Final = frozenset({
    "backlash", "backlash_motion", "calibration_advised", "coulomb_nm.high_total", "coulomb_nm.low_total",
    "customer",
    "frequency_response.lines.impedance_magnitude", "frequency_response.lines.impedance_phase_rad", "inertia_scope",
    "least_harmonics", "order_number", "place", "speed_loop_present", "torque_scale_rel_sd",
    "viscous_nm_s_rad.high_total", "viscous_nm_s_rad.low_total",
})
"""Keys that version 0.1.0 has since a later state. An archive of an earlier state lacks them."""
_MAY_DIFFER: Final[Mapping[str, str]] = {
    "second_opinions.note": "a sentence that has another wording in a later state of version 0.1.0",
    "second_opinions.least_scale_change": "a later state of version 0.1.0 calculates it for two stages",
}
"""Keys whose values may differ in one version, each with its reason."""


@dataclass(frozen=True)
class EvidenceArchive:
    """A finished archive: its bytes, and what it says. ``sha256``: of the whole archive."""

    archive: bytes
    sha256: str
    members: Mapping[str, bytes]


@dataclass(frozen=True)
class EvidenceCheck:
    """Outcome of a check. ``problems``: one sentence each, () if the archive passes; ``notes``: for the reader."""

    sha256: str
    problems: tuple[str, ...]
    notes: tuple[str, ...] = ()


def conclude_log(log: Path) -> Mapping[str, Any]:
    """Return the result document of a log, as `tdhil replay` finds it."""
    from tdhil.session import conclude_run, read

    record = read(log)
    record.require_motion()
    return conclude_run(record.recording, record.configuration, LOG, record.virtual_string, record.assumed).document


def make_evidence(
    log: Path, statement: PublisherStatement, words: Iterable[str] = (), *, serial_key: bytes = b"",
    conclude: Conclude = conclude_log,
) -> EvidenceArchive:
    """Return the archive of a run. ``words``: further words to remove, such as the names of this computer.

    ``serial_key``: key for the hash of the drive's serial number, b'' for no hash.

    Raises UsageError for a simulated run without its mark, a rehearsal, an incomplete log, and for a text that would
    leave the site; LogError for a log that can't be read.
    """
    from tdhil.recording import examine, write_copy

    found = examine(log)
    run, recording = found.run, found.run.recording
    facts = LogFacts(run.configuration, _preflight(run.events), recording.simulated)
    _refuse(facts, statement, str(log))
    stages = [(one.name, one.outcome) for one in run.stages]
    if foreign := _foreign(log):
        raise UsageError(f"the log has records that tdhil did not write: {', '.join(foreign)}", where=str(log),
                         next_step="Name the log as tdhil wrote it, without attachments or metadata of another program",
                         entry=MessageCode.EVIDENCE_INCOMPLETE)
    if missing := missing_in(facts, stages, complete=found.whole):
        raise UsageError(f"the log lacks {'; '.join(missing)}", where=str(log),
                         next_step="Name the log of a run that reached its end",
                         entry=MessageCode.EVIDENCE_INCOMPLETE)
    if serial_key:
        statement = replace(statement, serial_hmac_sha256=serial_hmac(serial_key, run.configuration["identity"]))
    scrub = LogScrub(run.configuration, words, rig_name="rig" in statement.publish)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / LOG
        write_copy(log, copy, found, edit=scrub.message, level=LEVEL)
        stored: Mapping[str, Any] = run.result or {}
        before = stored if stored.get("tdhil") == __version__ else conclude(log)
        result = conclude(copy)
        if _difference(_verdict_and_inertia(before), _verdict_and_inertia(result), _ALIKE):    # a number was a name
            raise LogError(
                "scrubbing would change the result: a setting of the log has the name of the operator or rig",
                where=str(log), next_step="Report it with the archive of tdhil support")
        members = _members(copy, statement, result, __version__)
        leaks = [f"{name}: {' and '.join(kinds)}" for name, texts in _texts(members, copy)
                 if (kinds := leaks_in(texts))]
    if leaks:
        raise UsageError(
            f"the archive would contain private texts ({'; '.join(leaks)})", where=str(log),
            next_step="Correct the texts of the statement, or remove a word with --remove",
            entry=MessageCode.EVIDENCE_LEAK)
    archive = archive_of(members)
    return EvidenceArchive(archive, hashlib.sha256(archive).hexdigest(), members)


def check_evidence(archive: bytes, sha256: str = "", *, conclude: Conclude | None = conclude_log) -> EvidenceCheck:
    """Check digests, completeness, secrets, and the result by identifying it again from the log in the archive.

    ``sha256``: stated digest of the archive, '' if unknown; ``conclude``: None to leave the replay out.
    """
    digest = hashlib.sha256(archive).hexdigest()
    problems: list[str] = []
    notes: list[str] = [] if sha256 else ["no digest of the archive was given: a change of every member at once is not"
                                          " seen"]
    if sha256 and sha256.strip().lower() != digest:
        problems.append(f"the archive was changed: its SHA-256 is {digest}, not {sha256[:64]}")
    try:
        members = members_in(archive)
    except ValueError as error:
        return EvidenceCheck(digest, (*problems, f"{error}"), tuple(notes))
    problems += problems_of_members(members)
    try:
        statement = statement_in(json.loads(members[STATEMENT]))
        stated = json.loads(members[RESULT])
        version = str(json.loads(members[MANIFEST])["tdhil"])
        if not isinstance(stated, dict):
            raise TypeError(f"{RESULT} is no document")
    except (ValueError, KeyError, TypeError) as error:
        return EvidenceCheck(digest, (*problems, f"a document is missing or can't be read: {error}"), tuple(notes))
    if LOG not in members:
        return EvidenceCheck(digest, tuple(problems), tuple(notes))
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / LOG
        copy.write_bytes(members[LOG])
        try:
            problems += _problems_of_log(copy, rig_name="rig" in statement.publish)
            for name, texts in _texts(members, copy):
                problems += [f"{name} contains this: {kind}" for kind in leaks_in(texts)]
            derived = _members(copy, statement, stated, version)
            # another version may word the README anew
            problems += [f"{name} does not follow from {LOG} and {STATEMENT}" for name in derived
                         if members.get(name) != derived[name]
                         and (version == __version__ or name not in (README, MANIFEST))]
            if statement.simulated is not (stated.get("simulated") is True):
                problems.append("the statement and the log differ on whether the drive is simulated")
            if version != __version__:
                notes.append(f"made by tdhil {version}, checked by {__version__}: the result may differ by up to"
                             f" {100 * OTHER_VERSION:.0f} %")
            if conclude is None:
                notes.append("the log was not identified again")
            elif text := _difference(stated, json.loads(text_of(conclude(copy))),
                                     _REPLAYED if version == __version__ else OTHER_VERSION,
                                     one_version=version == __version__):
                problems.append(f"the result does not follow from {LOG}: {text}")
        except TdhilError as error:
            problems.append(f"{LOG} can't be used: {error.what}")
    return EvidenceCheck(digest, tuple(dict.fromkeys(problems)), tuple(notes))


# ---------------------------------------------------------------------------------------------------------------------


def _refuse(facts: LogFacts, statement: PublisherStatement, where: str) -> None:
    """Raise UsageError for a run that is no evidence as it is requested."""
    if facts.run.get("trace") is not None:
        raise UsageError("is a trace of another tool, and no log of a run: it has no identity and no preflight",
                         where=where, next_step="Name the run.mcap of a run", entry=MessageCode.EVIDENCE_INCOMPLETE)
    if facts.run.get("faults"):
        raise UsageError("is a rehearsal of faults, which is no evidence about a drive", where=where,
                         next_step="Name the log of another run", entry=MessageCode.EVIDENCE_SIMULATED)
    if facts.simulated and not statement.simulated:
        raise UsageError("is a run of the simulated drive, which is no evidence about a drive", where=where,
                         next_step="Add --simulated to make an example that is marked as simulated",
                         entry=MessageCode.EVIDENCE_SIMULATED)
    if statement.simulated and not facts.simulated:
        raise UsageError("is a run of a real drive, and would be marked as simulated", where=where,
                         next_step="Leave --simulated out", entry=MessageCode.EVIDENCE_SIMULATED)


def _foreign(log: Path) -> tuple[str, ...]:
    """Return the records of another program in a log; () for a log that was cut off, which is refused as such."""
    from tdhil.recording import audit_log

    try:
        return audit_log(log).foreign
    except LogError:
        return ()


def _preflight(events: Iterable[Any]) -> tuple[str, ...]:
    return tuple(one.text for one in events if one.kind == "preflight")


def _members(log: Path, statement: PublisherStatement, result: Mapping[str, Any], version: str) -> dict[str, bytes]:
    """Return the members that follow from a scrubbed log and a statement."""
    from tdhil.recording import read_run

    run = read_run(log)
    torque_mode = any(one.kind == "mode" and one.text.startswith("torque mode confirmed") for one in run.events)
    facts = LogFacts(run.configuration, _preflight(run.events), run.recording.simulated, torque_mode)
    return members_of(facts, log.read_bytes(), statement, result, version)


def _verdict_and_inertia(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a result that scrubbing never changes."""
    inertia = result.get("inertia_kg_m2")
    return {"verdict": result.get("verdict"), "inertia_kg_m2": inertia if not isinstance(inertia, Mapping) else {
        name: inertia.get(name) for name in _INTERVAL}}


def _difference(stated: Any, found: Any, share: float, at: str = "", *, one_version: bool = True, size: float = 0.0
                ) -> str:
    """Return the first difference of two results, in words; '' if they are equal within this share.

    ``at``: key of this part; ``size``: largest number of the interval to which a number belongs. Results of two
    versions may have other keys and other texts. Their verdicts and numbers are compared.
    """
    if at in _MAY_DIFFER:
        return ""
    if isinstance(stated, Mapping) and isinstance(found, Mapping):
        for name in (*found, *(name for name in stated if name not in found)):
            place = f"{at}.{name}" if at else str(name)
            if name in stated and name in found:
                inner = max((abs(found[one]) for one in _INTERVAL if _is_number(found.get(one))), default=0.0)
                if text := _difference(stated[name], found[name], share, place, one_version=one_version,
                                       size=inner if name in _INTERVAL else 0.0):
                    return text
            elif one_version and not (name in found and place in _MAY_LACK):
                return f"{place[:80]!r} is {'stated and not found' if name in stated else 'found and not stated'}"
        return ""
    if isinstance(stated, list) and isinstance(found, list) and len(stated) == len(found):
        sizes = max((abs(one) for one in found if _is_number(one)), default=0.0)
        parts = (_difference(one, other, share, at, one_version=one_version, size=sizes)
                 for one, other in zip(stated, found, strict=True))
        return next(filter(None, parts), "")
    if _is_number(stated) and _is_number(found):
        alike = math.isclose(stated, found, rel_tol=share, abs_tol=share * size)
    elif isinstance(stated, str) and isinstance(found, str):
        alike = stated == found or not (one_version or at.rpartition(".")[2] == "verdict")
    else:
        alike = type(stated) is type(found) and stated == found
    return "" if alike else f"{at} is {repr(found)[:200]}, not {repr(stated)[:200]}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _MOST


def _problems_of_log(log: Path, *, rig_name: bool) -> Iterator[str]:
    """Yield what a log of an archive must not have: foreign records, or texts that scrubbing would change.

    ``rig_name``: the statement permits the name of the rig.
    """
    from tdhil.recording import audit_log, examine, messages_of

    if foreign := audit_log(log).foreign:
        yield f"{LOG} has attachments, metadata or other records that tdhil does not write: {', '.join(foreign)}"
    found = examine(log)
    if not found.whole:
        yield f"{LOG} is not whole: {'; '.join(found.lost)}"
    scrub = LogScrub(found.run.configuration, rig_name=rig_name)
    if any(scrub.message(channel, payload) != payload for channel, payload in messages_of(log)):
        yield f"{LOG} has names, serial numbers or entries that an archive must not have"


def _texts(members: Mapping[str, bytes], log: Path) -> Iterator[tuple[str, Iterable[str]]]:
    """Yield the texts of each member by its name; of the log those of every message and of its declarations."""
    from tdhil.recording import audit_log, messages_of, texts_of_message

    for name, data in members.items():
        if name != LOG:
            yield name, [data.decode("utf-8", "replace")]
    yield LOG, (text for part in audit_log(log).declarations for text in texts_in(part))
    yield LOG, (text for channel, payload in messages_of(log) for text in texts_of_message(channel, payload))
