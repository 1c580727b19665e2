"""Who has the say on each option: the command line, before rig.yaml, before the default; and who had it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from types import MappingProxyType
from typing import Any, Literal

from pydantic import BaseModel, ValidationError

from profiles import messages_of
from tdhil.config.registry import DEFAULT_BUS, DEFAULT_EXCITATION
from tdhil.config.rig import Rig
from tdhil.errors import UsageError


class Origin(Enum):
    """Who had the say on a setting. What follows from it hangs on this, never on the words that name the place."""

    COMMAND_LINE = "command line"
    RIG_FILE = "rig.yaml"
    BUS_FILE = "python-can's own files and variables"
    PROFILE = "profile"
    BUILT_IN = "default"
    SCAN = "scan"


@dataclass(frozen=True)
class Setting:
    """One option's value, where it came from in words (``--node``, ``rig.yaml:7``, ``default``), and who that is."""

    value: Any
    source: str
    origin: Origin

    @staticmethod
    def by_flag(value: Any, flag: str) -> "Setting":
        return Setting(value, flag, Origin.COMMAND_LINE)

    @staticmethod
    def by_rig(value: Any, rig: Rig, at: str) -> "Setting":
        """``at``: the key in rig.yaml."""
        return Setting(value, rig.source(at) or "rig", Origin.RIG_FILE)


@dataclass(frozen=True)
class Option:
    """``name`` of the field, its ``flag``, its key ``at`` in rig.yaml, and its default.

    Without ``at`` no file says it: what a person at the shaft answers for.
    """

    name: str
    flag: str
    at: str
    default: Any
    beside_rig: bool       # a path, looked for beside rig.yaml when it stands there
    joined: bool           # a list: what the command line names comes besides rig.yaml's


def _option(flag: str, at: str, default: Any = None, *, beside_rig: bool = False, joined: bool = False) -> Any:
    return field(default=default, metadata={"flag": flag, "at": at, "beside_rig": beside_rig, "joined": joined})


@dataclass(frozen=True)
class RunOptions:
    """Every option of a run with its value, and in ``settings`` where each came from.

    None as a value: chosen by the drive's profile or by the plan of the run.
    """

    drive: str = _option("--drive", "drive", DEFAULT_BUS)
    node: int | None = _option("--node", "node")
    profile: str = _option("--profile", "profile", "generic/cia402", beside_rig=True)
    accept_unverified: tuple[str, ...] = _option("--accept-unverified", "accept_unverified", (), joined=True)
    rate_hz: float | None = _option("--rate", "rate_hz")
    excitation: str = _option("--excitation", "run.excitation", DEFAULT_EXCITATION)
    mode: Literal["torque", "speed"] | None = _option("--mode", "run.mode")
    frequency_hz: float | None = _option("--frequency", "run.frequency_hz")
    amplitude_rad_s: float | None = _option("--amplitude", "run.amplitude_rad_s")
    offset_rad_s: float | None = _option("--offset", "run.offset_rad_s")
    periods: int | None = _option("--periods", "run.periods")
    tolerance: float = _option("--tolerance", "run.tolerance", 0.05)
    max_time_s: float | None = _option("--max-time", "run.max_time_s")
    impedance: Literal["offset", "reference"] | None = _option("--impedance", "run.impedance")
    string_impedance_nm_s_rad: float | None = _option("--string-impedance", "run.string_impedance_nm_s_rad")
    model: str = _option("--model", "run.model", "auto")
    confidence: float = _option("--confidence", "run.confidence", 0.95)
    seed: int | None = _option("--seed", "run.seed")
    simulate: bool = _option("--simulate", "run.simulate", False)
    real_time: bool = _option("--real-time", "run.real_time", False)
    stepped: bool = _option("--stepped", "run.stepped", False)
    yes: bool = _option("--yes", "", False)
    json: bool = _option("--json", "run.json", False)
    log: str = _option("--log", "run.log", "run.mcap")
    plant: str | None = _option("--plant", "run.plant", beside_rig=True)
    trace: str | None = _option("--trace", "run.trace")
    settings: Mapping[str, Setting] = field(default_factory=dict)

    @staticmethod
    def of(settings: Mapping[str, Setting]) -> "RunOptions":
        values = {name: setting.value for name, setting in settings.items()}
        return RunOptions(**values, settings=MappingProxyType(dict(settings)))

    def source(self, name: str) -> str:
        """Where an option's value came from, in words."""
        return self.settings[name].source

    def given(self, name: str) -> bool:
        """Has anybody said it, or is it the built-in default?"""
        return self.settings[name].origin is not Origin.BUILT_IN

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """(option, value, source) to print; '-' where the profile or the plan will choose."""
        for name, setting in self.settings.items():
            yield name, _shown(setting.value), setting.source

    def replaced(self, **settings: Setting) -> "RunOptions":
        """The same with other settings of these names."""
        return RunOptions.of({**self.settings, **settings})


OPTIONS = tuple(
    Option(one.name, default=None if one.metadata["joined"] else one.default, **one.metadata)
    for one in fields(RunOptions) if one.metadata
)


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "-"
    return "-" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def resolve(cli_values: Mapping[str, Any], rig: Rig | None) -> RunOptions:
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
    return RunOptions.of(settings)


def _setting(option: Option, given: Mapping[str, Any], cli_values: Mapping[str, Any], rig: Rig | None) -> Setting:
    if option.joined:
        return _joined(option, given, rig)
    if option.name in given:
        other = "--real-time" if option.name == "stepped" else "--stepped"
        return Setting.by_flag(given[option.name], option.flag if cli_values.get(option.name) is not None else other)
    value = rig.get(option.at) if rig is not None and option.at else None
    if rig is None or value is None:
        return Setting(option.default, "default", Origin.BUILT_IN)
    if option.beside_rig and (option.name != "profile" or value.endswith((".yaml", ".yml"))):
        value = str(rig.folder / value)
    return Setting.by_rig(value, rig, option.at)


def _joined(option: Option, given: Mapping[str, Any], rig: Rig | None) -> Setting:
    """Everything that either place names, each thing once.

    What a file takes of a profile it takes of the one that it goes with, not of another on the command line.
    """
    in_rig = (rig.get(option.at) if rig is not None else None) or ()
    if rig is not None and given.get("profile") not in (None, rig.profile):
        if in_rig and option.name not in given:
            text = f"{rig.source(option.at)} is for the profile of that file, not for --profile"
            return Setting((), text, Origin.RIG_FILE)
        in_rig = ()
    named = tuple(dict.fromkeys((*given.get(option.name, ()), *in_rig)))
    at = (rig.source(option.at) or "rig") if rig is not None and in_rig else ""
    sources = [source for source in (option.flag if option.name in given else "", at) if source]
    origin = Origin.COMMAND_LINE if option.name in given else Origin.RIG_FILE if in_rig else Origin.BUILT_IN
    return Setting(named, " and ".join(sources) or "default", origin)


def _check(given: Mapping[str, Any]) -> None:
    """The same rules as for rig.yaml, in terms of the flags."""
    data: dict[str, Any] = {}
    flags: dict[tuple[str | int, ...], str] = {}
    for option in OPTIONS:
        if option.name in given and option.at:
            *section, key = option.at.split(".")
            (data.setdefault(section[0], {}) if section else data)[key] = given[option.name]
            flags[tuple(option.at.split("."))] = option.flag
    check_values(Rig, data, flags)


def check_values(model: type[BaseModel], data: Mapping[str, Any], flags: Mapping[tuple[str | int, ...], str]) -> None:
    """Raise UsageError with every value that ``model`` wouldn't take, each by the flag of its place."""
    try:
        model.model_validate(data)
    except ValidationError as error:
        wrong = [f"{flags.get(path, '')}: {message}" for path, message in messages_of(error, data, model)]
        raise UsageError("; ".join(wrong), next_step="See tdhil identify --help") from None
