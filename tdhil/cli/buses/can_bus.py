"""Which CAN bus: python-can's own options, with the place that each value came from.

Command line, then rig.yaml's ``bus:``, then CAN_INTERFACE, CAN_CHANNEL, CAN_BITRATE and CAN_CONFIG, then
python-can's files, the last of which that names an option has the say, as python-can has it. Values from
the environment and from files pass through python-can's own conversion, so that they mean what they mean there.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from drivers.errors import DataFileError, Problem
from tdhil.config.options import Origin, Setting
from tdhil.config.rig import Rig, bit_rate_problem
from tdhil.errors import UsageError

_FLAGS = {
    "interface": "--interface",
    "channel": "--channel",
    "bitrate": "--bitrate",
    "fd": "--fd",
    "data_bitrate": "--data-bitrate",
    "timing": "--timing",
    "can_filters": "--filter",
}
_VARIABLES = {"interface": "CAN_INTERFACE", "channel": "CAN_CHANNEL", "bitrate": "CAN_BITRATE"}


@dataclass(frozen=True)
class BusConfig:
    """Each option of the bus and its origin, in the order in which python-can takes them."""

    settings: Mapping[str, Setting]

    @property
    def configured(self) -> bool:
        """Has anybody named an interface? If not, the embedded simulator is meant."""
        return self.interface is not None

    @property
    def interface(self) -> str | None:
        return str(self.settings["interface"].value) if "interface" in self.settings else None

    @property
    def channel(self) -> str:
        return str(self.settings["channel"].value) if "channel" in self.settings else ""

    @property
    def bitrate(self) -> int | None:
        return self.settings["bitrate"].value if "bitrate" in self.settings else None

    def source(self, option: str) -> str:
        return self.settings[option].source if option in self.settings else ""

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """(option, value, source) to print."""
        for name, setting in self.settings.items():
            yield name, str(setting.value), setting.source

    def kwargs(self) -> dict[str, Any]:
        """What `can.Bus` takes; it looks at the same places again, but finds nothing there that isn't here."""
        return {name: setting.value for name, setting in self.settings.items()}


def bus_config(cli: Mapping[str, Any], rig: Rig | None = None) -> BusConfig:
    """The bus as configured from everywhere; ``cli`` is the namespace that `can.cli.add_bus_arguments` filled.

    UsageError and DataFileError where a value can't be used. A file or variable that names a bit rate but no
    interface leaves the bus unconfigured.
    """
    settings: dict[str, Setting] = {}
    for source in (_from_cli(cli), _from_rig(rig), _from_environment(), _from_files()):
        for name, setting in source.items():
            settings.setdefault(name, setting)
    if "interface" in settings and not settings["interface"].value:
        settings.pop("interface", None)
    _check(settings)
    first = [name for name in ("interface", "channel", "bitrate") if name in settings]
    ordered = {name: settings[name] for name in (*first, *(name for name in settings if name not in first))}
    return BusConfig(MappingProxyType(ordered))


def _from_cli(cli: Mapping[str, Any]) -> dict[str, Setting]:
    found = {name: Setting.by_flag(cli[name], flag) for name, flag in _FLAGS.items() if cli.get(name) is not None}
    for name, value in (cli.get("bus_kwargs") or {}).items():
        found.setdefault(name, Setting.by_flag(value, "--bus-kwargs"))
    return found


def _from_rig(rig: Rig | None) -> dict[str, Setting]:
    if rig is None:
        return {}
    found = {}
    for name in ("interface", "channel", "bitrate"):
        if (value := getattr(rig.bus, name)) is not None:
            found[name] = Setting.by_rig(value, rig, f"bus.{name}")
    for name, value in rig.bus.options.items():
        found.setdefault(name, Setting.by_rig(value, rig, f"bus.options.{name}"))
    return found


def _from_environment() -> dict[str, Setting]:
    found = {
        name: Setting(_cast(value), key, Origin.BUS_FILE)
        for name, key in _VARIABLES.items() if (value := os.environ.get(key))
    }
    text = os.environ.get("CAN_CONFIG")
    if text is None:
        return found
    try:
        more = json.loads(text)
    except (ValueError, RecursionError):
        more = None
    if not isinstance(more, dict):
        step = 'Write it like {"interface": "socketcan"}, or unset it'
        raise UsageError("not a JSON object", where="CAN_CONFIG", next_step=step)
    for name, value in more.items():
        found.setdefault(_option(name), Setting(_cast(value), "CAN_CONFIG", Origin.BUS_FILE))
    return found


def _from_files() -> dict[str, Setting]:
    """python-can's files, section [default]; a later file's word goes before an earlier one's."""
    from can.util import CONFIG_FILES

    found: dict[str, Setting] = {}
    for name in CONFIG_FILES:
        for option, value in _section(Path(os.path.expanduser(name))).items():  # noqa: PTH111 (as python-can does)
            found[_option(option)] = Setting(_cast(value), name, Origin.BUS_FILE)
    return found


def _section(path: Path) -> dict[str, str]:
    config = ConfigParser()
    config.optionxform = _as_written  # type: ignore[assignment,method-assign]
    try:
        config.read(path)
        return dict(config.items("default")) if config.has_section("default") else {}
    except (ConfigParserError, UnicodeDecodeError) as error:
        line = getattr(error, "lineno", None) or next((number for number, _ in getattr(error, "errors", ())), 0)
        message = f"not a python-can configuration ({str(error).splitlines()[0]})"
        raise DataFileError((Problem(str(path), line, message),)) from None


def _as_written(option: str) -> str:
    return option


def _option(name: str) -> str:
    return "interface" if name == "bustype" else name      # python-can's old word for it


def _cast(value: Any) -> Any:
    from can.util import cast_from_string

    cast: Callable[[str], Any] = cast_from_string
    return cast(value) if isinstance(value, str) else value


def _check(settings: dict[str, Setting]) -> None:
    import can

    if (chosen := settings.get("interface")) and chosen.value not in can.VALID_INTERFACES:
        raise UsageError(
            f"python-can knows no interface '{chosen.value}'",
            where=chosen.source,
            next_step=f"It knows {', '.join(sorted(can.VALID_INTERFACES))}",
        )
    for name in ("bitrate", "port"):
        if (given := settings.get(name)) and (not isinstance(given.value, int) or given.value <= 0):
            raise UsageError(f"{name} must be a positive whole number, not {given.value!r}", where=given.source)
    if (given := settings.get("bitrate")) and (wrong := bit_rate_problem(given.value)):
        raise UsageError(f"bitrate {wrong}", where=given.source)
