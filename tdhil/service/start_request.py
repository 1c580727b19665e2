"""Request of a run over HTTP: an object with options of the command line, and a rig's file.

Only the rig's file states the drive's address and type. No HTTP request can name a bus, a host, a device or a file.
Options that only an operator at the shaft can decide are refused.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal

from drivers import DataFileError, PreflightRefused
from profiles import profile_names
from profiles.quantities import read
from tdhil.buses import Connection
from tdhil.config import (
    OPTION,
    OPTIONS,
    Option,
    Overrides,
    Rig,
    RunDetails,
    RunOptions,
    Topic,
    expectations_of,
    load_rig,
    parse_rig,
    resolve,
    wrong_values,
)
from tdhil.errors import MessageCode, TdhilError, UsageError
from tdhil.service.run_state import NotAllowed, NotThere, request_wrong
from tdhil.service.store import LOG
from tdhil.session import address_of, connection_of

if TYPE_CHECKING:
    from tdhil.session import RunRequest

RIG_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
BUILT_IN: Final = Path(__file__).with_name("rigs")
"""Folder of two simulated rigs, used if there are no rig files."""

TAKEN: Final = MappingProxyType({one.name: one for one in OPTIONS if one.api is True})
"""Options that HTTP accepts, by name."""
_NAMES: Final = {one.flag.removeprefix("--").replace("-", "_"): one.name for one in OPTIONS}
"""Option names by the names of their flags."""


def options_of(asked: Mapping[str, Any], rig: RigFile | None = None) -> dict[str, Any]:
    """Return the options by name. Raises NotAllowed with the option, or ValuesWrong with all wrong values.

    ``rig``: the rig of the run. The simulator of its bus decides which faults can be rehearsed.
    """
    found: dict[str, Any] = {}
    wrong: list[tuple[str, str]] = []
    for given, value in asked.items():
        name = str(given).removeprefix("--").replace("-", "_")
        name = _NAMES.get(name, name)
        reason = OPTION[name].api if name in OPTION else False
        if isinstance(reason, str) and value not in (None, False):
            raise NotAllowed(reason, where=name, next_step="Run it at the rig: tdhil identify --rig FILE")
        if name not in TAKEN:
            raise request_wrong("is not an option of a run over HTTP", str(given)[:60],
                                f"Options: {', '.join(sorted(TAKEN))}")
        if value is None:
            continue
        try:
            found[name] = value_of(TAKEN[name], value)
        except UsageError as error:
            wrong.append((name, error.what))
    for text in RunDetails.of(found).expect:
        try:
            expectations_of({}, [text])
        except UsageError as error:
            wrong.append((OPTION["expect"].name, error.what))
    wrong += _wrong_faults(found.get("fault") or (), rig)
    wrong += [(name, limits_in_words(OPTION.get(name), found.get(name)) or text) for name, text in wrong_values(found)]
    require_right(wrong)
    return found


SMALLEST: Final = 1e-5
"""A lower limit below this value only means that the value must be positive. It is not printed."""
LARGEST: Final = 1e15
"""An upper limit above this value only comes from the number's type. It is not printed."""
LOWER, UPPER = ("", "above 0", "at least {low}"), ("", "at most {high}", "below {high}")
LIMIT_TEXTS: Final = tuple(" and ".join(filter(None, (low, high))) for low in LOWER for high in UPPER if low or high)
"""Every text of `limits_text`, for the catalogues of the pages."""


def number_with_unit(option: Option, value: float) -> str:
    """Return a number in the unit of the form's field, with this unit."""
    unit = option.form.unit if option.form is not None and option.form.unit is not None else option.unit
    if unit is None:
        return f"{value:g}"
    return f"{unit.of_si(value):.6g}" + ("" if unit.symbol == "1" else f" {unit.symbol}")


def limits_text(option: Option) -> tuple[str, dict[str, str]]:
    """Return one of `LIMIT_TEXTS`, and its values ``low`` and ``high`` in the unit of the form's field; '' if none."""
    low = option.limits.get("ge", option.limits.get("gt"))
    high = option.limits.get("le", option.limits.get("lt"))
    lower = "" if low is None else LOWER[1] if 0.0 <= low < SMALLEST and option.unit is not None else LOWER[2]
    upper = "" if high is None or high >= LARGEST else UPPER[1] if "le" in option.limits else UPPER[2]
    values = {name: number_with_unit(option, limit) for name, limit in (("low", low), ("high", high))
              if limit is not None}
    return " and ".join(filter(None, (lower, upper))), values


def limits_in_words(option: Option | None, value: Any) -> str:
    """Return as text which limits a number exceeds, in the unit of the form's field; '' if none."""
    if option is None or not option.limits or isinstance(value, bool) or not isinstance(value, int | float):
        return ""
    if not option.refusal(value):
        return ""
    text, values = limits_text(option)
    return f"must be {text.format_map(values)}, not {number_with_unit(option, value)}"


class ValuesWrong(UsageError):
    """Refusal of all wrong values of a request. ``fields``: option and message of each."""

    entry = MessageCode.REQUEST_WRONG

    def __init__(self, wrong: Sequence[tuple[str, str]]) -> None:
        self.fields = tuple(wrong)
        (name, what), *more = wrong
        super().__init__("; ".join((what, *(f"{other}: {text}" for other, text in more))), where=name)


def _wrong_faults(texts: Sequence[str], rig: RigFile | None) -> list[tuple[str, str]]:
    """Return the faults that the simulator of the rig's bus can't script; none for a rig whose file can't be used."""
    from tdhil.buses import bus_named

    wrong: list[tuple[str, str]] = []
    if rig is None or not texts:
        return wrong
    with suppress(UsageError, DataFileError):
        bus = bus_named(rig.way()[1].drive)
        for text in texts:
            try:
                bus.parse_faults([text])
            except TdhilError as error:
                step = error.next_step.replace("--fault list shows", "The page Rehearse lists")
                wrong.append(("fault", f"{error.what}. {step}"))
    return wrong


def require_right(wrong: Sequence[tuple[str, str]]) -> None:
    """Raise ValuesWrong with all wrong values, if there are any."""
    if wrong:
        raise ValuesWrong(wrong)


def value_of(option: Option, value: Any) -> Any:
    """Parse a value as on the command line. The checks of its limits follow later. Raises UsageError."""
    where = option.name
    if option.kind is float and option.unit is None:
        try:
            return float(value if isinstance(value, str) or not isinstance(value, bool) else "")
        except (TypeError, ValueError):
            raise request_wrong("must be a number", where) from None
    if option.unit is not None:
        if isinstance(value, str):
            try:
                return read(value, option.unit)
            except ValueError as error:
                raise UsageError(str(error), where=where) from None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise request_wrong("must be a number, or a text with a unit", where)
        return float(value)
    if option.joined:
        values = [value] if isinstance(value, str) else value
        if not isinstance(values, list) or not all(isinstance(one, str) for one in values):
            raise request_wrong("must be a text, or a list of texts", where)
        if option.allowed and (wrong := set(values) - set(option.allowed)):
            *first, last = option.allowed
            raise request_wrong(f"must be {', '.join(first)} or {last}, not {', '.join(sorted(wrong))[:60]}", where)
        return values
    if option.longest is not None and not (isinstance(value, str) and len(value) <= option.longest):
        raise request_wrong(f"must be a text of at most {option.longest} characters", where)
    if option.kind is int and isinstance(value, str):
        raise request_wrong("must be a whole number", where)
    if option.kind is bool and not isinstance(value, bool):
        raise request_wrong("must be true or false", where)
    return value


def _taken(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Keep only the options that HTTP accepts, also for a request from a file."""
    return {name: value for name, value in asked.items() if name in TAKEN}


def option_schema(option: Option) -> dict[str, Any]:
    """Return the JSON schema of an option's value, as `options_of` accepts it."""
    text: dict[str, Any] = {"type": "string"}
    if option.allowed:
        text["enum"] = list(option.allowed)
    if option.longest is not None:
        text["maxLength"] = option.longest
    if option.joined:
        found: dict[str, Any] = {"type": "array", "items": text}
    elif option.unit is not None:
        found = {"type": ["number", "string"], "x-unit": option.unit.symbol}
    elif option.kind is float:
        found = {"type": ["number", "string"]}
    else:
        found = text if option.kind is str else {"type": {bool: "boolean", int: "integer"}[option.kind]}
    return {**found, "description": option.help_text, **({} if option.default is None else {"default": option.default})}


@dataclass(frozen=True)
class RigFile:
    """One rig of the site, from its present file. ``problem``: why the file can't be used, '' if it can."""

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
        """Return the rig's options and the connection to its drive. Raises UsageError and DataFileError."""
        return self._way(_taken(asked)) if asked else self._own_way

    @cached_property
    def _own_way(self) -> tuple[RunOptions, Connection]:
        """`way` without a request. It takes some 5 ms, and several parts of one page need it."""
        return self._way({})

    def _way(self, cli: Mapping[str, Any]) -> tuple[RunOptions, Connection]:
        if self.rig is None:
            raise UsageError(self.problem, next_step="Correct the rig's file")
        options, connection = connection_of(cli, self.rig, resolve(cli, self.rig))
        return options, connection

    @property
    def simulated(self) -> bool:
        """Return whether the rig uses the embedded simulator. A rig with an unusable file counts as real."""
        with suppress(UsageError, DataFileError):
            options, connection = self.way()
            return options.simulate or not connection.configured
        return False

    @property
    def address(self) -> str | None:
        """Return the drive's address, as `tdhil.session.hold` locks it; None for a simulated or unknown drive."""
        with suppress(UsageError, DataFileError):
            options, connection = self.way()
            return address_of(connection, options)
        return None


class Rigs:
    """The rig files of a folder, read again when they change. Without rig files: the built-in rigs."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self._known: dict[Path, tuple[tuple[int, int], RigFile]] = {}

    @property
    def built_in(self) -> bool:
        return self.folder is None or not any(self.folder.glob("*.yaml"))

    @property
    def left_out(self) -> list[str]:
        """Return the YAML files whose names are not valid for a rig."""
        found = () if self.folder is None else self.folder.glob("*.y*ml")
        return sorted(one.name for one in found if one.suffix != ".yaml" or not RIG_ID.fullmatch(one.stem))

    def all(self) -> list[RigFile]:
        """Return all rigs, by id."""
        folder = BUILT_IN if self.built_in or self.folder is None else self.folder
        paths = sorted(path for path in folder.glob("*.yaml") if RIG_ID.fullmatch(path.stem))
        return [self._read(path) for path in paths]

    def get(self, rig: str) -> RigFile:
        """Return one rig. Raises NotThere."""
        found = next((one for one in self.all() if one.id == rig), None)
        if found is None:
            raise NotThere("this rig does not exist", where=f"rig {rig[:64]}", next_step="See the list of rigs")
        return found

    def _read(self, path: Path) -> RigFile:
        try:
            looked = path.stat()
            stamp = (looked.st_mtime_ns, looked.st_size)
            known = self._known.get(path)
            if known is None or known[0] != stamp:
                known = self._known[path] = (stamp, read_rig(path))
            return replace(known[1])           # each request computes its own way: a profile may have changed
        except OSError as error:
            return RigFile(path.stem, path, "", None, f"can't be read ({error.strerror or error})")


def read_rig(path: Path) -> RigFile:
    """Return the present content of the file and its hash. Raises OSError."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    try:
        return RigFile(path.stem, path, digest, load_rig(path))
    except DataFileError as error:
        return RigFile(path.stem, path, digest, None, str(error))


EDITABLE: Final = frozenset({
    "name", "limits", "gear", "load", "make_up_torque_nm", "torque_ramp_nm_s", "drive_data", "expected",
    "reference_inertia_kg_m2", "accept_unverified", "rate_hz", "acceptance",
})
"""Keys of a rig's file that HTTP may change. The drive's address and type, and the rules of motion, are no part."""


def edited(old: bytes, text: str, name: str) -> tuple[str, ...]:
    """Return the keys in which the text differs from the former file. Raises DataFileError and NotAllowed.

    If the former file can't be used, there is nothing to compare. Then the text has the rules of a new rig.
    """
    wanted = parse_rig(text, name)
    try:
        present = parse_rig(old.decode(), name)
    except (DataFileError, UnicodeDecodeError):
        require_new_rig(text, name)
        return tuple(sorted(key for key in wanted.model_dump() if wanted.line(key)))
    before, after = present.model_dump(), wanted.model_dump()
    keys = tuple(sorted(key for key in before if before[key] != after[key]))
    if beyond := [key for key in keys if key not in EDITABLE]:
        raise NotAllowed("can't be changed over HTTP: the drive's address and type and the rules of motion",
                         where=wanted.source(beyond[0]) or f"{name}: {', '.join(beyond)}",
                         next_step="Edit the file on the service's computer")
    _refuse_files(wanted, name, present)
    return keys


_READ: Final = (*(one.at for one in OPTIONS if one.beside_rig and one.at), "drive_data.torque_calibration")
"""Keys of a rig's file that name a file beside it. A path would read any file of the service's computer."""
_WRITTEN: Final = tuple(one.at for one in OPTIONS if one.is_file and not one.beside_rig and one.at)
"""Keys that name a file to write."""


def _refuse_files(rig: Rig, name: str, present: Rig | None = None) -> None:
    """Refuse the keys of a file with a path, and those of a file to write. Raises NotAllowed.

    ``present``: the rig as its file states it now. What it states was written on the service's computer, and may stay.
    """
    for key in (*_READ, *_WRITTEN):
        stated = str(rig.get(key)) if rig.line(key) else ""
        plain = key in _READ and (Path(stated).name == stated or (key == "profile" and stated in profile_names()))
        if stated and not plain and (present is None or rig.get(key) != present.get(key)):
            raise NotAllowed("HTTP may name only a file beside the rig's file, to be read",
                             where=rig.source(key) or name, next_step="Edit the file on the service's computer")


NEW_RIG_MOTIONS: Final = ("never", "attended")
"""Rules of motion of a rig that is added over HTTP. In a watched run no person has to stand at the rig. So only a file
that was written on the service's computer allows it."""


def require_new_rig(text: str, name: str) -> None:
    """Check the file of a new rig. Raises DataFileError; NotAllowed for motion without a person at the rig, for motion
    in reverse, and for a file elsewhere.
    """
    rig = parse_rig(text, name)
    _refuse_files(rig, name)
    if rig.get("allow_reverse"):
        raise NotAllowed("a rig that is added over HTTP may not turn in reverse",
                         where=rig.source("allow_reverse") or name,
                         next_step="Edit the file on the service's computer")
    if rig.service.motion not in NEW_RIG_MOTIONS:
        raise NotAllowed("a rig that is added over HTTP may move only with a code from the rig",
                         where=rig.source("service.motion") or name,
                         next_step=f"Use {' or '.join(NEW_RIG_MOTIONS)}, or edit the file on the service's computer")


def require_motion(rig: RigFile) -> None:
    """Raise UsageError or NotAllowed if motion of this rig can't be requested over HTTP."""
    if rig.rig is None:
        raise UsageError(rig.problem, next_step="Correct the rig's file")
    if rig.simulated or rig.motion != "never":
        return
    where = rig.rig.source("service.motion") or rig.path.name
    raise NotAllowed("this rig can't be moved over HTTP (service.motion: never)", where=where,
                     next_step="Run it at the rig: tdhil identify --rig FILE. Or set service: {motion: attended} in"
                               " its file")


def require_unwatched(rig: RigFile) -> None:
    """Refuse a watched rig for a client that is not logged in. Raises NotAllowed."""
    if rig.motion == "watched" and not rig.simulated:
        where = (rig.rig and rig.rig.source("service.motion")) or rig.path.name
        raise NotAllowed("this rig moves only while a logged-in user watches it (service.motion: watched)",
                         where=where, next_step="Log in. On a service without accounts set motion: attended")


def run_request(rig: RigFile, asked: Mapping[str, Any], *, left_in: Path | None = None) -> RunRequest:
    """Make the request of a run, by the functions of the command line in the same order.

    Raises UsageError, DataFileError and PreflightRefused.
    """
    from tdhil.session import RunRequest, check_unverified, plan_peer, with_faults

    asked = _taken(asked)
    details = RunDetails.of(asked)
    options, connection = rig.way(asked)
    check_unverified(connection.profile, options)
    options = options.replaced(log=replace(options.settings["log"], value=LOG))
    peer = with_faults(plan_peer(options, connection), details.faults, connection.drive)
    if not peer.embedded:
        for one in OPTIONS:
            if one.group is Topic.SIMULATED and asked.get(one.name):
                raise request_wrong("is for a simulated rig", one.name)
    return RunRequest.of(
        options, connection, replace(peer, left_in=left_in), rig.rig, overrides=Overrides.of(asked),
        stated=details.texts(), expect=details.expect,
        real_time_priority=not peer.embedded if details.real_time_priority is None else details.real_time_priority,
    )


def plan_of(rig: RigFile, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plan, its assumptions and its expected result. No drive is connected. Raises as `run_request`."""
    from tdhil.session import plan_document, plan_dry, plan_peer, suited

    options, connection = rig.way(asked)
    simulated = options.simulate or not connection.configured
    bench = suited(rig.rig, plan_peer(options, connection).plant)
    planned, figures, limits = plan_dry(options, bench, simulated, connection.profile)
    return plan_document(planned, figures, limits)


def binding_of(request: RunRequest, rig_sha256: str, preflight: Any, plan: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the data that a code confirms: rig file, profile, options, preflight, plan."""
    plain = {
        "rig": rig_sha256,
        "profile": request.connection.profile.model_dump(mode="json", by_alias=True),
        "options": [list(row) for row in request.options.rows()],
        "way": [list(row) for row in request.connection.line.rows()],
        "preflight": preflight,
        "plan": plan,
    }
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()


def is_as_it_was(path: Path, sha256: str) -> bool:
    """Return whether the rig's file still exists and has this hash."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    except OSError:
        return False


def refuse_changed(path: Path, sha256: str) -> None:
    """Raise PreflightRefused if the rig's file has changed since the run was requested."""
    if not is_as_it_was(path, sha256):
        raise PreflightRefused("the rig's file was changed after the run was requested", where=path.name,
                               next_step="Nothing has moved; request the run again",
                               entry=MessageCode.CHANGED_MEANWHILE)
