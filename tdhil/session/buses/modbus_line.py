"""Where a Modbus drive is reached, with the place that each value came from.

Command line, then rig.yaml's ``modbus:``, then the profile's ``line:``, which says how the drive leaves the factory.
A host means TCP, a serial device means RTU; the command line's word for one of them undoes rig.yaml's for the other.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, cast

from profiles.modbus import BusLine, ModbusProfile
from tdhil.config import Modbus, Origin, Rig, Setting, check_values
from tdhil.errors import UsageError
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
    """Each value and its origin; only those that the way to the drive (TCP or RTU) knows."""

    nothing_there = "no Modbus host and no serial device is named"
    simulated_text = "Modbus drive and rig"
    row_name = "line"

    @property
    def configured(self) -> bool:
        """Has anybody named a host or a serial device? If not, the embedded simulator is meant."""
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
    """The line as configured from everywhere; ``cli`` is keyed by the names in `FLAGS`.

    UsageError where a value can't be used. Without a profile what it would say is left as the standard has it.
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
            raise UsageError(f"means nothing without {needs}", where=FLAGS[name], next_step="See tdhil identify --help")
    if found.serial is not None and not 1 <= found.unit <= 247:
        raise UsageError(
            f"a serial line has units 1 to 247, not {found.unit}", where=found.source("unit"),
            next_step="Give the drive's own with --unit",
        )
    return found


_STANDARD = BusLine(transports=("tcp", "rtu"), source="the Modbus specification", confidence="verified")
