"""From what was asked for over HTTP to a run: the options of the command line, as an object, on a rig's own file.

Where a drive is, and what it is, the rig's file says alone: nothing that comes over HTTP names a bus, a host, a device
or a file. What only a person at the shaft can answer for is refused.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from drivers import DataFileError, PreflightRefused
from profiles.quantities import FREQUENCY, SHARE, SPEED, TIME, Unit, read
from tdhil.config import Rig, RunOptions, load_rig, parse_rig, resolve
from tdhil.errors import UsageError
from tdhil.service.run_state import NotAllowed, NotThere
from tdhil.session import Connection, address_of, connection_of

if TYPE_CHECKING:
    from tdhil.session import RunRequest

RIG_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
BUILT_IN: Final = Path(__file__).with_name("rigs")
"""Two simulated rigs, for where nobody has any."""

UNITS: Final[Mapping[str, Unit]] = {
    "frequency_hz": FREQUENCY, "rate_hz": FREQUENCY, "amplitude_rad_s": SPEED, "offset_rad_s": SPEED,
    "max_time_s": TIME, "tolerance": SHARE, "confidence": SHARE,
}
RUN_OPTIONS: Final = frozenset({
    "excitation", "mode", "frequency_hz", "amplitude_rad_s", "offset_rad_s", "periods", "tolerance", "max_time_s",
    "model", "confidence", "rate_hz", "seed", "real_time", "accept_unverified",
})
"""Of `tdhil.config.RunOptions`, those that may come over HTTP."""
BESIDE: Final = frozenset({
    "fault", "operator", "note", "accept_wider_limit", "accept_speed_unit", "reset_fault", "real_time_priority",
})
_OF_FLAGS: Final = {          # the options by their flags' names, as the command line has them
    "frequency": "frequency_hz", "amplitude": "amplitude_rad_s", "offset": "offset_rad_s", "rate": "rate_hz",
    "max_time": "max_time_s",
}
_ONLY_THERE: Final = {
    "accept_no_watchdog": "nothing but who stands there would stop the shaft: it is never taken over HTTP",
    "accept_shared_watchdog": "nothing but who stands there may stop the shaft: it is never taken over HTTP",
    "yes": "a confirmation is typed in for each run; nothing replaces it",
}
_SIMULATED_ONLY: Final = ("seed", "real_time", "fault")


def options_of(asked: Mapping[str, Any]) -> dict[str, Any]:
    """The options by their names in Python. Raises UsageError and NotAllowed, naming the option."""
    found: dict[str, Any] = {}
    for given, value in asked.items():
        name = str(given).removeprefix("--").replace("-", "_")
        name = _OF_FLAGS.get(name, name)
        if name in _ONLY_THERE and value not in (None, False):
            raise NotAllowed(_ONLY_THERE[name], where=name, next_step="Run it at the rig: tdhil identify")
        if name not in RUN_OPTIONS | BESIDE:
            raise UsageError("is no option of a run here", where=str(given)[:60],
                             next_step=f"There are {', '.join(sorted(RUN_OPTIONS | BESIDE))}")
        if value is not None:
            found[name] = _value(name, value)
    return found


def _value(name: str, value: Any) -> Any:
    if name in UNITS:
        if isinstance(value, str):
            try:
                return read(value, UNITS[name])
            except ValueError as error:
                raise UsageError(str(error), where=name) from None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise UsageError("must be a number, or a text with a unit", where=name)
        return float(value)
    if name in ("accept_unverified", "accept_wider_limit", "fault"):
        values = [value] if isinstance(value, str) else value
        if not isinstance(values, list) or not all(isinstance(one, str) for one in values):
            raise UsageError("must be a text, or a list of texts", where=name)
        if name == "accept_wider_limit" and (wrong := set(values) - {"torque", "speed", "quick-stop"}):
            raise UsageError(f"knows torque, speed and quick-stop, not {', '.join(sorted(wrong))[:60]}", where=name)
        return values
    if name in ("operator", "note"):
        if not isinstance(value, str) or len(value) > 500:
            raise UsageError("must be a text of at most 500 characters", where=name)
        return value
    if name in ("accept_speed_unit", "reset_fault", "real_time", "real_time_priority") and not isinstance(value, bool):
        raise UsageError("must be true or false", where=name)
    return value


@dataclass(frozen=True)
class RigFile:
    """One rig of the site, as its file has it now. ``problem``: why it can't be used, '' where it can."""

    id: str
    path: Path
    sha256: str
    rig: Rig | None
    problem: str = ""

    @property
    def name(self) -> str:
        return (self.rig.name if self.rig is not None else None) or self.id

    @property
    def motion(self) -> Literal["never", "attended", "watched"]:
        return "never" if self.rig is None else self.rig.service.motion

    def way(self, asked: Mapping[str, Any] | None = None) -> tuple[RunOptions, Connection]:
        """Its options and the way to its drive. Raises UsageError and DataFileError."""
        if self.rig is None:
            raise UsageError(self.problem, next_step="Mend the rig's file")
        cli = {name: value for name, value in (asked or {}).items() if name in RUN_OPTIONS}
        options, connection = connection_of(cli, self.rig, resolve(cli, self.rig))
        return options, connection

    @property
    def simulated(self) -> bool:
        """Is the embedded simulator meant? A real one where that can't be told."""
        try:
            options, connection = self.way()
        except (UsageError, DataFileError):
            return False
        return options.simulate or not connection.configured

    @property
    def address(self) -> str | None:
        """The drive's, as `tdhil.session.hold` locks it; None for a simulated one, or where it can't be told."""
        try:
            options, connection = self.way()
        except (UsageError, DataFileError):
            return None
        return address_of(connection, options)


class Rigs:
    """The rig files of a folder, read again when they change; the built-in ones where it has none."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self._known: dict[Path, tuple[tuple[int, int], RigFile]] = {}

    @property
    def built_in(self) -> bool:
        return self.folder is None or not any(self.folder.glob("*.yaml"))

    @property
    def left_out(self) -> list[str]:
        """Files that were meant as a rig's, and whose names are none."""
        found = () if self.folder is None else self.folder.glob("*.y*ml")
        return sorted(one.name for one in found if one.suffix != ".yaml" or not RIG_ID.fullmatch(one.stem))

    def all(self) -> list[RigFile]:
        """By their ids."""
        folder = BUILT_IN if self.built_in or self.folder is None else self.folder
        paths = sorted(path for path in folder.glob("*.yaml") if RIG_ID.fullmatch(path.stem))
        return [self._read(path) for path in paths]

    def get(self, rig: str) -> RigFile:
        """Raises NotThere."""
        found = next((one for one in self.all() if one.id == rig), None)
        if found is None:
            raise NotThere("there is no such rig", where=f"rig {rig[:64]}", next_step="See the list of rigs")
        return found

    def _read(self, path: Path) -> RigFile:
        try:
            looked = path.stat()
            stamp = (looked.st_mtime_ns, looked.st_size)
            known = self._known.get(path)
            if known is None or known[0] != stamp:
                known = self._known[path] = (stamp, read_rig(path))
            return known[1]
        except OSError as error:
            return RigFile(path.stem, path, "", None, f"can't be read ({error.strerror or error})")


def read_rig(path: Path) -> RigFile:
    """What the file says now, and its hash. Raises OSError."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    try:
        return RigFile(path.stem, path, digest, load_rig(path))
    except DataFileError as error:
        return RigFile(path.stem, path, digest, None, str(error))


EDITABLE: Final = frozenset({
    "name", "limits", "gear", "load", "make_up_torque_nm", "torque_ramp_nm_s", "drive_data", "expected",
    "reference_inertia_kg_m2", "accept_unverified", "rate_hz",
})
"""Of a rig's file, what may be edited over HTTP. Not where its drive is, nor what it is, nor who may move it how."""


def edited(old: str, text: str, name: str) -> tuple[str, ...]:
    """The keys in which the text differs from the rig's file as it was. Raises DataFileError and NotAllowed."""
    wanted = parse_rig(text, name)
    before, after = parse_rig(old, name).model_dump(), wanted.model_dump()
    keys = tuple(sorted(key for key in before if before[key] != after[key]))
    if beyond := [key for key in keys if key not in EDITABLE]:
        raise NotAllowed("isn't changed over HTTP: where a drive is, what it is and who may move it stands at the rig",
                         where=wanted.source(beyond[0]) or f"{name}: {', '.join(beyond)}",
                         next_step="Edit the file on the service's computer")
    return keys


def require_motion(rig: RigFile) -> None:
    """May anybody ask for motion of this rig over HTTP? Raises UsageError and NotAllowed."""
    if rig.rig is None:
        raise UsageError(rig.problem, next_step="Mend the rig's file")
    if rig.simulated or rig.motion != "never":
        return
    where = rig.rig.source("service.motion") or rig.path.name
    raise NotAllowed("this rig is never moved from afar (service.motion: never)", where=where,
                     next_step="Run it at the rig: tdhil identify. Or say service: {motion: attended} in its file")


def require_unwatched(rig: RigFile) -> None:
    """Of who hasn't said who he is. Raises NotAllowed."""
    if rig.motion == "watched" and not rig.simulated:
        where = (rig.rig and rig.rig.source("service.motion")) or rig.path.name
        raise NotAllowed("this rig moves only while somebody who has logged in watches it (service.motion: watched)",
                         where=where, next_step="Take motion: attended where nobody logs in")


def run_request(rig: RigFile, asked: Mapping[str, Any], *, left_in: Path | None = None) -> RunRequest:
    """What the command line would make of it, by the same functions and in the same order.

    Raises UsageError, DataFileError and PreflightRefused.
    """
    from tdhil.session import Overrides, RunRequest, check_names, plan_peer, with_faults

    options, connection = rig.way(asked)
    check_names(connection.profile, options.accept_unverified, options.source("accept_unverified"))
    options = options.replaced(log=replace(options.settings["log"], value="run.mcap"))
    peer = with_faults(plan_peer(options, connection), asked.get("fault"), connection.drive)
    if not peer.embedded:
        for name in _SIMULATED_ONLY:
            if asked.get(name):
                raise UsageError("is for a simulated rig", where=name)
    overrides = Overrides(
        wider_limits=tuple(asked.get("accept_wider_limit") or ()), speed_unit=bool(asked.get("accept_speed_unit")),
        reset_fault=bool(asked.get("reset_fault")),
    )
    return RunRequest.of(
        options, connection, replace(peer, left_in=left_in), rig.rig, overrides=overrides,
        operator=asked.get("operator"), note=asked.get("note"),
        real_time_priority=bool(asked.get("real_time_priority", not peer.embedded)),
    )


def plan_of(rig: RigFile, asked: Mapping[str, Any]) -> dict[str, Any]:
    """The plan, what it rests on and what to expect of it; nothing is connected to. Raises as `run_request`."""
    from tdhil.session import plan_document, plan_dry

    options, connection = rig.way(asked)
    simulated = options.simulate or not connection.configured
    profile = connection.profile
    planned, figures, limits = plan_dry(
        options, rig.rig, simulated, profile.can_torque, profile.quick_stop.ends == "off"
    )
    return plan_document(planned, figures, limits)


def binding_of(request: RunRequest, rig_sha256: str, preflight: Any, plan: Mapping[str, Any]) -> str:
    """SHA-256 of all that a confirmation is for: rig file, profile, options, what preflight found, and the plan."""
    plain = {
        "rig": rig_sha256,
        "profile": request.connection.profile.model_dump(mode="json", by_alias=True),
        "options": [list(row) for row in request.options.rows()],
        "way": [list(row) for row in request.connection.rows()],
        "preflight": preflight,
        "plan": plan,
    }
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()


def is_as_it_was(path: Path, sha256: str) -> bool:
    """Is the rig's file still there, with the content of this hash?"""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    except OSError:
        return False


def refuse_changed(path: Path, sha256: str) -> None:
    """The rig's file is what it was when the run was asked for. Raises PreflightRefused."""
    if not is_as_it_was(path, sha256):
        raise PreflightRefused("the rig's file was changed after the run was asked for", where=path.name,
                               next_step="Ask for it again; nothing has moved")
