"""What a profile only supposes of a drive is refused before a real shaft moves, unless the operator takes it by name.

A wrong scale or word order in a profile is a wrong moment of inertia, or a shaft that turns the wrong way. `likely`
entries may be taken all at once, or a whole section of them; `unverified` ones each by its own name.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable

from drivers import PreflightRefused
from profiles import Profile, ProfileEntry
from tdhil.config import OPTION, RunOptions
from tdhil.errors import UsageError

ALL_LIKELY = "likely"
UNVERIFIED = OPTION["accept_unverified"]
UNVERIFIED_FLAG = UNVERIFIED.flag


def doubtful(profile: Profile) -> tuple[tuple[str, ProfileEntry], ...]:
    """(name, entry) of everything below verified."""
    return tuple((name, entry) for name, entry in profile.entries() if entry.confidence != "verified")


def is_accepted(name: str, entry: ProfileEntry, accepted: Collection[str]) -> bool:
    """Has the operator taken this entry?"""
    if name in accepted:
        return True
    sections = {ALL_LIKELY, name.partition(".")[0]}
    return entry.confidence == "likely" and not sections.isdisjoint(accepted)


def check_names(profile: Profile, accepted: Iterable[str], source: str = UNVERIFIED_FLAG) -> None:
    """UsageError for a name that this profile has not: a typo must not pass for an override."""
    known = {name for name, _ in profile.entries()}
    known |= {name.split(".")[0] for name in known} | {ALL_LIKELY}
    for name in accepted:
        if name not in known:
            close = difflib.get_close_matches(name, sorted(known), n=3, cutoff=0.5)
            meant = f"did you mean {' or '.join(repr(one) for one in close)}?" if close else "it has no such entry"
            raise UsageError(
                f"profile {profile.name} has no entry '{name[:60]}'; {meant}", where=source,
                next_step=f"See tdhil profiles show {profile.name}",
            )


def check_unverified(profile: Profile, options: RunOptions) -> None:
    """The same of a run's options."""
    check_names(profile, options.accept_unverified, options.source(UNVERIFIED.name))


def require_accepted(profile: Profile, accepted: Collection[str]) -> None:
    """For a drive that is not simulated: PreflightRefused with every entry that was not taken, and how to take it."""
    refused = [(name, entry) for name, entry in doubtful(profile) if not is_accepted(name, entry, accepted)]
    if refused:
        raise PreflightRefused(_text(profile, refused), where=profile.name, next_step=_step(profile, refused))


def accepted_lines(profile: Profile, accepted: Collection[str]) -> tuple[str, ...]:
    """What is taken although nobody verified it, a line each."""
    return tuple(
        f"{name} ({entry.confidence}): {entry.source}"
        for name, entry in doubtful(profile)
        if is_accepted(name, entry, accepted)
    )


def note(profile: Profile) -> str:
    """For a simulated drive, where it is no obstacle; '' where there is nothing to say."""
    count = len(doubtful(profile))
    what = "1 entry is" if count == 1 else f"{count} entries are"
    if not count:
        return ""
    return f"profile {profile.name}: {what} not verified; on a real drive {UNVERIFIED_FLAG} must take them"


def _text(profile: Profile, refused: list[tuple[str, ProfileEntry]]) -> str:
    lines = [f"  {name} ({entry.confidence}): {entry.source}" for name, entry in refused]
    counted = "1 entry of this profile is" if len(lines) == 1 else f"{len(lines)} entries of this profile are"
    return "\n".join([f"{counted} not verified, and the drive is a real one", *lines])


def _step(profile: Profile, refused: list[tuple[str, ProfileEntry]]) -> str:
    words = [ALL_LIKELY] if any(entry.confidence == "likely" for _, entry in refused) else []
    words += [name for name, entry in refused if entry.confidence == "unverified"]
    options = " ".join(f"{UNVERIFIED_FLAG} {word}" for word in words)
    return (
        f"\nCheck them in the drive's manual (tdhil profiles show {profile.name} says what). Then either say "
        f"'confidence: verified' in a copy of the profile, or take them as they are: {options}"
    )
