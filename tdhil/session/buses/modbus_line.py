"""The address of a Modbus drive, with the source of each value.

Order: command line, rig.yaml's ``modbus:``, the profile's ``line:`` (factory settings of the drive). A host means
TCP, a serial device means RTU. If the command line names one of them, rig.yaml's value for the other is ignored.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, cast

from profiles.modbus import BusLine, ModbusProfile
from tdhil.config import Modbus, Origin, Rig, Setting, check_values
from tdhil.errors import MessageCode, UsageError
from tdhil.session.connection import LineConfig

FLAGS: Mapping[str, str] = MappingProxyType({
    "host": "--host",
    "port": "--port",
    "serial": "--serial",
    "baud": "--baud",
    "parity": "--parity",
    "stop_bits": "--stop-bits",
    "unit": "--unit",
})
TCP, RTU = ("host", "port", "unit"), ("serial", "baud", "parity", "stop_bits", "unit")


@dataclass(frozen=True)
class ModbusConfig(LineConfig):
    """Each value and its origin; only those of the transport in use (TCP or RTU)."""

    nothing_there = "no Modbus host and no serial device is named"
    simulated_text = "Modbus drive and rig"
    row_name = "line"

    @property
    def configured(self) -> bool:
        """Return whether a host or a serial device is named. If not, the embedded simulator is meant."""
        return self.host is not None or self.serial is not None

    @property
    def host(self) -> str | None:
        return cast("str | None", self.value("host"))

    @property
    def port(self) -> int:
        return cast(int, self.value("port"))

    @property
    def serial(self) -> str | None:
        return cast("str | None", self.value("serial"))

    @property
    def baud(self) -> int:
        return cast(int, self.value("baud"))

    @property
    def parity(self) -> Literal["N", "E", "O"]:
        return cast(Literal["N", "E", "O"], self.value("parity"))

    @property
    def stop_bits(self) -> Literal[1, 2]:
        return cast(Literal[1, 2], self.value("stop_bits"))

    @property
    def unit(self) -> int:
        return cast(int, self.value("unit"))


def modbus_config(cli: Mapping[str, Any], rig: Rig | None, profile: ModbusProfile | None) -> ModbusConfig:
    """Return the line from all sources; ``cli`` is keyed by the names in `FLAGS`.

    Raises UsageError for an unusable value. Without a profile the defaults are those of the Modbus standard.
    """
    given = {name: Setting.by_flag(cli[name], flag) for name, flag in FLAGS.items() if cli.get(name) is not None}
    values = {name: setting.value for name, setting in given.items()}
    check_values(Modbus, values, {(name,): flag for name, flag in FLAGS.items()})
    settings = dict(given)
    for name in FLAGS:
        if rig is not None and (value := getattr(rig.modbus, name)) is not None:
            settings.setdefault(name, Setting.by_rig(value, rig, f"modbus.{name}"))
    for one, other in (("host", "serial"), ("serial", "host")):
        if one in given and other not in given:
            settings.pop(other, None)
    line, source, origin = _STANDARD, "default", Origin.BUILT_IN
    if profile is not None:
        line, source, origin = profile.line, f"profile {profile.name}", Origin.PROFILE
    for name in FLAGS:
        if name not in ("host", "serial"):
            settings.setdefault(name, Setting(getattr(line, name), source, origin))
    known = RTU if "serial" in settings else TCP if "host" in settings else ("unit",)
    found = ModbusConfig(MappingProxyType({name: settings[name] for name in known if name in settings}))
    for name in given:
        if name not in known:
            needs = "--serial" if name in RTU else "--host"
            raise UsageError(f"has no effect without {needs}", where=FLAGS[name], next_step="See tdhil identify --help",
                             entry=MessageCode.BUS_OPTIONS_WRONG)
    if found.serial is not None and not 1 <= found.unit <= 247:
        raise UsageError(
            f"unit {found.unit} is outside 1 to 247, the range of a serial line", where=found.source("unit"),
            next_step="Give the drive's unit with --unit",
            entry=MessageCode.BUS_OPTIONS_WRONG,
        )
    return found


_STANDARD = BusLine(transports=("tcp", "rtu"), source="the Modbus specification", confidence="verified")
