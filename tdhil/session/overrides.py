"""Refuse unverified entries of a profile before a real shaft moves, unless the operator accepts them by name.

A wrong scale or word order in a profile gives a wrong moment of inertia, or turns the shaft the wrong way. `likely`
entries may be accepted all at once or by section, `unverified` entries only by their own name.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable

from drivers import PreflightRefused
from profiles import Profile, ProfileEntry
from tdhil.config import OPTION, RunOptions
from tdhil.errors import MessageCode, UsageError

ALL_LIKELY = "likely"
UNVERIFIED = OPTION["accept_unverified"]
UNVERIFIED_FLAG = UNVERIFIED.flag


def doubtful(profile: Profile) -> tuple[tuple[str, ProfileEntry], ...]:
    """Return (name, entry) of every entry below verified."""
    return tuple((name, entry) for name, entry in profile.entries() if entry.confidence != "verified")


def is_accepted(name: str, entry: ProfileEntry, accepted: Collection[str]) -> bool:
    """Return whether the operator accepted this entry."""
    if name in accepted:
        return True
    sections = {ALL_LIKELY, name.partition(".")[0]}
    return entry.confidence == "likely" and not sections.isdisjoint(accepted)


def check_names(profile: Profile, accepted: Iterable[str], source: str = UNVERIFIED_FLAG) -> None:
    """Raise UsageError for a name that is not in this profile: a typo must not count as an override."""
    known = {name for name, _ in profile.entries()}
    known |= {name.split(".")[0] for name in known} | {ALL_LIKELY}
    for name in accepted:
        if name not in known:
            close = difflib.get_close_matches(name, sorted(known), n=3, cutoff=0.5)
            meant = f"did you mean {' or '.join(repr(one) for one in close)}?" if close else "it has no such entry"
            raise UsageError(
                f"profile {profile.name} has no entry '{name[:60]}'; {meant}", where=source,
                next_step=f"See tdhil profiles show {profile.name}",
                entry=MessageCode.UNKNOWN_PROFILE_ENTRY,
            )


def check_unverified(profile: Profile, options: RunOptions) -> None:
    """Raise UsageError for a name in the run's options that is not in this profile."""
    check_names(profile, options.accept_unverified, options.source(UNVERIFIED.name))


def require_accepted(profile: Profile, accepted: Collection[str]) -> None:
    """Raise PreflightRefused with every entry that is not accepted. Call it for a drive that is not simulated."""
    refused = [(name, entry) for name, entry in doubtful(profile) if not is_accepted(name, entry, accepted)]
    if refused:
        raise PreflightRefused(_text(profile, refused), where=profile.name, next_step=_step(profile, refused),
                               entry=MessageCode.UNVERIFIED_PROFILE)


def accepted_lines(profile: Profile, accepted: Collection[str]) -> tuple[str, ...]:
    """Return the accepted entries that are not verified, one line each."""
    return tuple(
        f"{name} ({entry.confidence}): {entry.source}"
        for name, entry in doubtful(profile)
        if is_accepted(name, entry, accepted)
    )


def note(profile: Profile) -> str:
    """Return the note for a simulated drive, where these entries do not matter; '' if all are verified."""
    count = len(doubtful(profile))
    what = "1 entry is" if count == 1 else f"{count} entries are"
    if not count:
        return ""
    return f"profile {profile.name}: {what} not verified; a real drive needs {UNVERIFIED_FLAG} for them"


def _text(profile: Profile, refused: list[tuple[str, ProfileEntry]]) -> str:
    lines = [f"  {name} ({entry.confidence}): {entry.source}" for name, entry in refused]
    counted = "1 entry of this profile is" if len(lines) == 1 else f"{len(lines)} entries of this profile are"
    return "\n".join([f"{counted} not verified, and the drive is not simulated", *lines])


def _step(profile: Profile, refused: list[tuple[str, ProfileEntry]]) -> str:
    words = [ALL_LIKELY] if any(entry.confidence == "likely" for _, entry in refused) else []
    words += [name for name, entry in refused if entry.confidence == "unverified"]
    options = " ".join(f"{UNVERIFIED_FLAG} {word}" for word in words)
    return (
        f"\nCheck them in the drive's manual (tdhil profiles show {profile.name} lists them). Then either set "
        f"'confidence: verified' in a copy of the profile, or accept them as they are: {options}"
    )
