"""Who has the say on each option: the command line, before rig.yaml, before the default; and who had it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from profiles.yaml_messages import messages_of
from tdhil.errors import UsageError
from tdhil.rig import Rig


@dataclass(frozen=True)
class Option:
    """``name`` as in the parsed command line, its ``flag``, its key ``at`` in rig.yaml, and its default.

    Without ``at`` no file says it: what a person at the shaft answers for.
    """

    name: str
    flag: str
    at: str
    default: Any = None
    beside_rig: bool = False       # a path, looked for beside rig.yaml when it stands there
    joined: bool = False           # a list: what the command line names comes besides rig.yaml's


OPTIONS = (
    Option("drive", "--drive", "drive", "canopen"),
    Option("node", "--node", "node"),
    Option("profile", "--profile", "profile", "generic/cia402", beside_rig=True),
    Option("accept_unverified", "--accept-unverified", "accept_unverified", joined=True),
    Option("rate_hz", "--rate", "rate_hz"),
    Option("excitation", "--excitation", "run.excitation", "multisine"),
    Option("mode", "--mode", "run.mode"),
    Option("frequency_hz", "--frequency", "run.frequency_hz"),
    Option("amplitude_rad_s", "--amplitude", "run.amplitude_rad_s"),
    Option("offset_rad_s", "--offset", "run.offset_rad_s"),
    Option("periods", "--periods", "run.periods"),
    Option("tolerance", "--tolerance", "run.tolerance", 0.05),
    Option("max_time_s", "--max-time", "run.max_time_s"),
    Option("model", "--model", "run.model", "auto"),
    Option("confidence", "--confidence", "run.confidence", 0.95),
    Option("seed", "--seed", "run.seed"),
    Option("simulate", "--simulate", "run.simulate", False),
    Option("real_time", "--real-time", "run.real_time", False),
    Option("stepped", "--stepped", "run.stepped", False),
    Option("yes", "--yes", "", False),
    Option("json", "--json", "run.json", False),
    Option("log", "--log", "run.log", "run.mcap"),
    Option("plant", "--plant", "run.plant", beside_rig=True),
    Option("trace", "--trace", "run.trace"),
)
"""None as a default: chosen by the drive's profile or by the plan of the run."""


@dataclass(frozen=True)
class Setting:
    """One option's value, and where it came from: ``--node``, ``rig.yaml:7`` or ``default``."""

    value: Any
    source: str


@dataclass(frozen=True)
class Resolved:
    """Every option with its value; ``resolved["node"]`` is the value, ``resolved.source("node")`` its origin."""

    settings: Mapping[str, Setting]

    def __getitem__(self, name: str) -> Any:
        return self.settings[name].value

    def source(self, name: str) -> str:
        return self.settings[name].source

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """(option, value, source) to print; '-' where the profile or the plan will choose."""
        for name, setting in self.settings.items():
            yield name, _shown(setting.value), setting.source

    def replaced(self, **settings: Setting) -> "Resolved":
        """The same with other settings of these names."""
        return Resolved(MappingProxyType({**self.settings, **settings}))


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "-"
    return "-" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def resolve(cli_values: Mapping[str, Any], rig: Rig | None) -> Resolved:
    """Every option of `OPTIONS`; None or absent in ``cli_values`` (keyed by option name) means not given.

    A flag that is not given must be None or absent too, not False: rig.yaml could not set it otherwise.
    UsageError names every flag with a value that rig.yaml would not take either.
    """
    given = {option.name: cli_values[option.name] for option in OPTIONS if cli_values.get(option.name) is not None}
    given |= {option.name: tuple(given[option.name]) for option in OPTIONS if option.joined and option.name in given}
    if given.get("real_time") and "stepped" not in given:
        given["stepped"] = False       # the command line's word on the clock undoes rig.yaml's
    elif given.get("stepped") and "real_time" not in given:
        given["real_time"] = False
    _check(given)
    settings = {option.name: _setting(option, given, cli_values, rig) for option in OPTIONS}
    return Resolved(MappingProxyType(settings))


def _setting(option: Option, given: Mapping[str, Any], cli_values: Mapping[str, Any], rig: Rig | None) -> Setting:
    if option.joined:
        return _joined(option, given, rig)
    if option.name in given:
        other = "--real-time" if option.name == "stepped" else "--stepped"
        return Setting(given[option.name], option.flag if cli_values.get(option.name) is not None else other)
    value = rig.get(option.at) if rig is not None and option.at else None
    if rig is None or value is None:
        return Setting(option.default, "default")
    if option.beside_rig and (option.name != "profile" or value.endswith((".yaml", ".yml"))):
        value = str(rig.folder / value)
    return Setting(value, rig.source(option.at) or "rig")


def _joined(option: Option, given: Mapping[str, Any], rig: Rig | None) -> Setting:
    """Everything that either place names, each thing once.

    What a file takes of a profile it takes of the one that it goes with, not of another on the command line.
    """
    in_rig = (rig.get(option.at) if rig is not None else None) or ()
    if rig is not None and given.get("profile") not in (None, rig.profile):
        if in_rig and option.name not in given:
            return Setting((), f"{rig.source(option.at)} is for the profile of that file, not for --profile")
        in_rig = ()
    named = tuple(dict.fromkeys((*given.get(option.name, ()), *in_rig)))
    at = (rig.source(option.at) or "rig") if rig is not None and in_rig else ""
    sources = [source for source in (option.flag if option.name in given else "", at) if source]
    return Setting(named, " and ".join(sources) or "default")


def _check(given: Mapping[str, Any]) -> None:
    """The same rules as for rig.yaml, in terms of the flags."""
    data: dict[str, Any] = {}
    flags: dict[tuple[str | int, ...], str] = {}
    for option in OPTIONS:
        if option.name in given and option.at:
            *section, key = option.at.split(".")
            (data.setdefault(section[0], {}) if section else data)[key] = given[option.name]
            flags[tuple(option.at.split("."))] = option.flag
    try:
        Rig.model_validate(data)
    except ValidationError as error:
        wrong = [f"{flags.get(path, '')}: {message}" for path, message in messages_of(error, data, Rig)]
        raise UsageError("; ".join(wrong), next_step="See tdhil identify --help") from None
