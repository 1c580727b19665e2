"""Resolution of an option: its value from the command line, else rig.yaml, else the default; and its source."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from profiles import messages_of
from tdhil.config.options import CLOCKS, OPTION, RESOLVED, Option, Origin, RunOptions, Setting, is_name
from tdhil.config.rig import Rig
from tdhil.errors import MessageCode, UsageError


def resolve(cli_values: Mapping[str, Any], rig: Rig | None) -> RunOptions:
    """Return every option of `RunOptions`; None or absent in ``cli_values`` (keyed by option name) means not given.

    A flag that is not given must also be None or absent, not False, so that rig.yaml can set it. Raises UsageError with
    every flag whose value rig.yaml would not accept.
    """
    given = {option.name: cli_values[option.name] for option in RESOLVED if cli_values.get(option.name) is not None}
    given |= {option.name: tuple(given[option.name]) for option in RESOLVED if option.joined and option.name in given}
    for one, other in (CLOCKS, CLOCKS[::-1]):
        if given.get(one) and other not in given:
            given[other] = False           # a clock on the command line overrides that of rig.yaml
    _check(given)
    settings = {option.name: _setting(option, given, cli_values, rig) for option in RESOLVED}
    return RunOptions.of(settings)


def _setting(option: Option, given: Mapping[str, Any], cli_values: Mapping[str, Any], rig: Rig | None) -> Setting:
    if option.joined:
        return _joined(option, given, rig)
    if option.name in given:
        said = option.name if cli_values.get(option.name) is not None else CLOCKS[option.name == CLOCKS[0]]
        return Setting.by_flag(given[option.name], OPTION[said].flag)
    value = rig.get(option.at) if rig is not None and option.at else None
    if rig is None or value is None:
        return Setting(option.default, "default", Origin.BUILT_IN)
    if option.beside_rig and not is_name(option.flag, value):
        value = str(rig.folder / value)
    return Setting.by_rig(value, rig, option.at)


def _joined(option: Option, given: Mapping[str, Any], rig: Rig | None) -> Setting:
    """Return all names from both sources, each once.

    Accepted entries in rig.yaml apply only to the profile in rig.yaml, not to another one on the command line.
    """
    in_rig = (rig.get(option.at) if rig is not None else None) or ()
    if rig is not None and given.get("profile") not in (None, rig.get("profile")):
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
    """Check the rules of rig.yaml, and name the flags in the error."""
    data, flags = _as_in_rig(given)
    check_values(Rig, data, flags)


def wrong_values(given: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return every value that rig.yaml would not accept, as name of the option and message."""
    data, flags = _as_in_rig({name: tuple(one) if isinstance(one, list) else one for name, one in given.items()})
    name_of = {option.flag: option.name for option in RESOLVED}
    try:
        Rig.model_validate(data)
    except ValidationError as error:
        return [(name_of.get(flags.get(path, ""), ""), text) for path, text in messages_of(error, data, Rig)]
    return []


def _as_in_rig(given: Mapping[str, Any]) -> tuple[dict[str, Any], dict[tuple[str | int, ...], str]]:
    """Return the values at their places in rig.yaml, and the flag for each place."""
    data: dict[str, Any] = {}
    flags: dict[tuple[str | int, ...], str] = {}
    for option in RESOLVED:
        if option.name in given and option.at:
            *section, key = option.at.split(".")
            (data.setdefault(section[0], {}) if section else data)[key] = given[option.name]
            flags[tuple(option.at.split("."))] = option.flag
    return data, flags


def check_values(model: type[BaseModel], data: Mapping[str, Any], flags: Mapping[tuple[str | int, ...], str]) -> None:
    """Raise UsageError with every value that ``model`` refuses, each with its flag."""
    try:
        model.model_validate(data)
    except ValidationError as error:
        wrong = [f"{flags.get(path, '')}: {message}" for path, message in messages_of(error, data, model)]
        raise UsageError("; ".join(wrong), next_step="See tdhil identify --help",
                         entry=MessageCode.VALUE_NOT_ALLOWED) from None
