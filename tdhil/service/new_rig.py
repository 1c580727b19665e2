"""A rig that is added in the browser: profiles to choose from, the draft of its file with every mistake, its file.

Nothing here opens a bus. A scan is `tdhil scan`, and a check is `tdhil doctor`, each in a process of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from drivers import CommunicationLost
from profiles import DataFileError, Profile, load_profile, profile_names, unit_text
from tdhil.buses import FoundDrive, bus_named
from tdhil.config import Limits, Rig, parse_rig
from tdhil.errors import ExitCode
from tdhil.service.run_state import page_text, request_wrong
from tdhil.service.schemas import (
    DraftBody,
    DraftProblemView,
    DraftView,
    FieldView,
    FoundDriveView,
    NewRigView,
    ProfileView,
    ScanView,
)
from tdhil.service.start_request import NEW_RIG_MOTIONS, ValuesWrong
from tdhil.session import LIMIT_KEYS, STRING_KEYS, RigEntries, blank_rig, by_hand, doubtful

LONGEST_S: Final = 120.0         # of a scan or a check; a scan of a serial line with all its settings takes most of it
DRAFT: Final = "rig.yaml"
"""Name of the draft in the places of its mistakes."""


def new_rig_view() -> NewRigView:
    """Return the fields of the machine, and every profile that ships with what it asks of the person."""
    limits = [FieldView(f"limits.{name}", Limits.model_fields[name].description or "") for name in LIMIT_KEYS]
    string = [FieldView(name, Rig.model_fields[name].description or "") for name in STRING_KEYS]
    return NewRigView(limits + string, [_view(load_profile(name)) for name in sorted(profile_names())])


def _view(profile: Profile) -> ProfileView:
    return ProfileView(
        profile.name, profile.title, profile.bus, bus_named(profile.bus).title, profile.experimental,
        by_hand(profile), {name: entry.source for name, entry in doubtful(profile)}, profile.rated_torque_by_hand,
        [FieldView(f"parameters.{one.name}", one.title,
                   one.require.text_in(one.unit) if one.require else "", unit_text(one.unit))
         for one in profile.untold], _address_fields(profile.bus),
    )


def _address_fields(bus: str) -> list[FieldView]:
    """Return the fields of the drive's address: keys of the bus's section with one value, and its keys beside it."""
    model = bus_named(bus).section_model
    fields = [] if model is None else [
        FieldView(name, field.description or "") for name, field in model.model_fields.items()
        if field.default is None]
    return fields + [FieldView(name, "number of the drive on the bus") for name in _beside(bus)]


def draft_of(body: DraftBody) -> DraftView:
    """Return the text of the file, and every mistake with its field. Nothing is written. Raises UsageError."""
    profile = _profile(body.profile)
    if body.motion not in NEW_RIG_MOTIONS:
        raise request_wrong(f"must be {' or '.join(NEW_RIG_MOTIONS)}", "motion")
    if body.load not in ("none", "string"):
        raise request_wrong("must be none or string", "load")
    fields = {one.name for one in _address_fields(profile.bus)}
    if unknown := sorted(set(body.address) - fields):
        raise request_wrong(f"{unknown[0]}: not a key of this bus", "address")
    known = RigEntries(
        simulated=body.simulated, name=body.name.strip() or None,
        address={} if body.simulated else _given(body.address), limits=_given(body.limits, LIMIT_KEYS),
        string=_given(body.string, STRING_KEYS) if body.load == "string" else {},
        drive_data={"rated_torque_nm": body.rated_torque_nm.strip()} if body.rated_torque_nm.strip() else {},
        parameters={} if body.simulated else _given(body.parameters, tuple(one.name for one in profile.untold)),
        gear_ratio=body.gear_ratio.strip() or None,
        accept_unverified=tuple(one for one in body.accept_unverified if one in dict(doubtful(profile))),
        motion="never" if body.simulated else body.motion,      # a simulated rig moves without a rule
    )
    text = blank_rig(profile, profile.name, body.load, known, "tdhil serve")
    problems = _missing(profile, body, known)
    view: dict[str, float] = {}
    try:
        rig = parse_rig(text, DRAFT)
    except DataFileError as error:
        missing = {problem.field for problem in problems}
        problems += [one for problem in error.problems if (one := _problem_of(problem.message, profile)).field
                     not in missing and one.field not in ("limits", "load")]
    else:
        if rig.limits is not None:
            view = {name: value for name in (*LIMIT_KEYS, "watchdog_s")
                    if isinstance(value := getattr(rig.limits, name), float)}
    return DraftView(text, problems, view)


def _profile(name: str) -> Profile:
    """Return a profile that ships. Raises UsageError: no path comes over HTTP."""
    if name not in profile_names():
        raise request_wrong("is not a profile of tdhil", "profile", "See the list of profiles")
    return load_profile(name)


def _given(typed: Mapping[str, str], known: tuple[str, ...] | None = None) -> dict[str, str]:
    return {name: text.strip() for name, text in typed.items() if text.strip() and (known is None or name in known)}


def _missing(profile: Profile, body: DraftBody, known: RigEntries) -> list[DraftProblemView]:
    """Return the entries that the rig needs and the draft does not have. A simulated rig needs no drive's entries, and
    all limits or none.
    """
    found = [] if known.name else [DraftProblemView(
        "name", page_text("The rig needs its own name, such as bench 3."))]
    if body.load == "string":
        found += [DraftProblemView(name, page_text("A drill string needs it.")) for name in STRING_KEYS
                  if name not in known.string]
    if known.limits or not body.simulated:
        why = (page_text("Type this limit. A simulated rig has all limits or none.") if body.simulated
               else page_text("Type this limit. A real drive does not move without it."))
        found += [DraftProblemView(f"limits.{name}", why) for name in LIMIT_KEYS if name not in known.limits]
    if body.simulated:
        return found
    if not known.address:
        found.append(DraftProblemView("address", page_text("Type the address of the drive. For a rig without a drive,"
                                                           " select Simulated.")))
    if profile.rated_torque_by_hand and not known.drive_data:
        found.append(DraftProblemView("rated_torque_nm", page_text(
            "Type it from the name plate. The drive does not report it.")))
    found += [DraftProblemView(f"parameters.{one.name}", page_text(
                  "Read this value at the drive, and type it. The drive does not report it over the bus."))
              for one in profile.untold if one.name not in known.parameters]
    open_entries = [name for name, _ in doubtful(profile) if name not in known.accept_unverified]
    if open_entries:
        found.append(DraftProblemView("accept_unverified", page_text(
            f"Compare these entries with the manual. Accept each only if both agree: {', '.join(open_entries)}.")))
    return found


def _problem_of(message: str, profile: Profile) -> DraftProblemView:
    """Return a mistake in the file with its field of the form. ``message``: "limits.torque_nm: must be …"."""
    key, found, text = message.partition(": ")
    if not found:
        key, text = "", message
    section, _, inner = key.partition(".")
    bus = bus_named(profile.bus)
    if section == bus.section and inner:
        key = f"address.{inner}"
    elif key in _beside(profile.bus):
        key = f"address.{key}"
    elif key == "gear.ratio":
        key = "gear_ratio"
    return DraftProblemView(key.removeprefix("drive_data."), f"{text[:1].upper()}{text[1:]}.")


def scan_for(body: DraftBody) -> ScanView:
    """Scan for the drives at the address of a draft, by `tdhil scan`. Raises UsageError and CommunicationLost."""
    profile = _profile(body.profile)
    address = _given(body.address)
    if not address:
        raise ValuesWrong([("address", "Type the address of the bus first.")])
    text = blank_rig(profile, profile.name, "none", RigEntries(address=address))
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / DRAFT
        place.write_text(text, encoding="utf-8")
        document = document_of("scan", place, "found", [ExitCode.OK])
    return ScanView([
        FoundDriveView(one["address"], one["title"], one["identity"], one["simulated"], one["profile"], one["why"],
                       {**{name: str(value) for name, value in one["line"].items()},
                        **_address_of(profile.bus, one["address"])})
        for one in document["found"]], list(document.get("remarks", [])))


def document_of(command: str, place: Path, key: str, fine: Sequence[ExitCode]) -> dict[str, Any]:
    """Return the document of a command for a rig's file, with ``key``. Raises CommunicationLost without it."""
    try:
        done = subprocess.run([sys.executable, "-m", "tdhil", command, "--rig", str(place), "--json"], check=False,
                              stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        raise CommunicationLost(f"the {command} did not end within {LONGEST_S:.0f} s", where=command,
                                next_step="Check the interface, and narrow the address") from None
    document: dict[str, Any] = {}
    with suppress(ValueError):
        document = json.loads(done.stdout)
    if done.returncode in fine and key in document:
        return document
    if said := str((document.get("error") or {}).get("message") or " ".join(done.stderr.split())[-400:]):
        raise CommunicationLost(said)                # with its own next step
    raise CommunicationLost("no reply", where=command, next_step="Check the drive's supply, the wiring and the address")


def _address_of(bus: str, number: int) -> dict[str, str]:
    """Return the fields of the address that name this drive on its bus."""
    return {name: str(value) for name, value in (_beside(bus, number) or {bus_named(bus).address_word: number}).items()}


def _beside(bus: str, number: int = 1) -> Mapping[str, Any]:
    """Return the keys of the address beside the section of the bus, for the drive with this number."""
    return bus_named(bus).rig_keys(FoundDrive(bus, number, "", "", False))
