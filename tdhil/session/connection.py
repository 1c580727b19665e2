"""How the drive is spoken to: which bus, which profile, and where on that bus; each with who had the say."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from drivers import DataFileError, Problem
from profiles import Profile, load_canopen_profile, load_modbus_profile, load_profile
from profiles.modbus import ModbusProfile
from tdhil.config import BUSES, Origin, RunOptions, Setting, load
from tdhil.errors import UsageError
from tdhil.session.buses import BusConfig, ModbusConfig, asked_for, bus_config, modbus_config

if TYPE_CHECKING:
    from drivers import Drive
    from tdhil.config import Rig

MODBUS_PROFILE = "generic/modbus"
"""Worn and spoken where nobody names another; for CANopen it is `tdhil.config.options`' default."""


@dataclass(frozen=True)
class BusKind:
    """What a run asks of a bus; `tdhil.config.registry.BUSES` lists them by name.

    ``open``: the drive on it, or the embedded simulator's, closed afterwards. ``parse_faults``: of the simulator, from
    what ``--fault`` says. ``steps_over_a_wire``: can a simulator in another process be stepped over it?
    """

    open: Callable[..., AbstractContextManager[Drive]]
    parse_faults: Callable[[Sequence[str]], tuple[Any, ...]]
    steps_over_a_wire: bool


def bus_kind(name: str) -> BusKind:
    """The bus of that name; its libraries are loaded. KeyError where there is none."""
    found: BusKind = load(BUSES, name)
    return found


@dataclass(frozen=True)
class Connection:
    """One of ``bus`` and ``modbus`` counts, as the profile's bus says."""

    profile: Profile
    bus: BusConfig
    modbus: ModbusConfig

    @property
    def drive(self) -> str:
        """``canopen`` or ``modbus``."""
        return self.profile.bus

    @property
    def line(self) -> BusConfig | ModbusConfig:
        """The one that counts."""
        lines: dict[str, BusConfig | ModbusConfig] = {"canopen": self.bus, "modbus": self.modbus}
        return lines[self.drive]

    @property
    def configured(self) -> bool:
        """Has anybody said where the drive is? If not, the embedded simulator is meant."""
        return self.line.configured

    @property
    def nothing_there(self) -> str:
        """Why the embedded simulator runs although nobody asked for it."""
        return self.line.nothing_there

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """(option, value, source) to print and to log."""
        return self.line.rows()


def connection_of(cli: Mapping[str, Any], rig: Rig | None, options: RunOptions) -> tuple[RunOptions, Connection]:
    """The options with drive and profile decided, and the way to the drive.

    UsageError for options of the other bus, DataFileError for a profile that can't be used.
    """
    options = choose_drive(cli, rig, options)
    if options.drive == "modbus":
        profile = load_modbus_profile(options.profile)
        _refuse_canopen_flags(cli)
        found = Connection(profile, NO_BUS, modbus_config(cli, rig, profile))
        _refuse_the_other_bus(found, rig, options)
        return options, found
    flag = asked_for(cli)
    if flag is not None:
        raise UsageError("belongs to Modbus", where=flag, next_step="Add --drive modbus, or leave it out")
    found = Connection(load_canopen_profile(options.profile), bus_config(cli, rig), NO_MODBUS)
    _refuse_the_other_bus(found, rig, options)
    return options, found


def _refuse_the_other_bus(found: Connection, rig: Rig | None, options: RunOptions) -> None:
    """A rig.yaml that says where a drive is, but on the other bus: nobody meant the simulator. Raises DataFileError."""
    if rig is None or found.configured or options.simulate:
        return
    if found.drive == "canopen" and (rig.modbus.host or rig.modbus.serial):
        section, missing = "modbus", "bus: (interface, channel)"
    elif found.drive == "modbus" and rig.bus.interface:
        section, missing = "bus", "modbus: (host or serial)"
    else:
        return
    raise DataFileError((Problem(
        rig.file or "rig.yaml", rig.line(section),
        f"{section}: says where a drive is, but the drive is on {found.drive} ({options.source('drive')}), and nothing"
        f" says where; give {missing}, name the other drive, or take the simulated one with --simulate",
    ),))


def choose_drive(cli: Mapping[str, Any], rig: Rig | None, options: RunOptions) -> RunOptions:
    """Who doesn't name the bus has named it by the profile, or by saying where the drive is."""
    if not options.given("drive"):
        if options.given("profile"):
            profile = load_profile(options.profile)
            options = options.replaced(drive=Setting(profile.bus, f"profile {profile.name}", Origin.PROFILE))
        elif (flag := asked_for(cli)) is not None:
            options = options.replaced(drive=Setting.by_flag("modbus", flag))
        elif rig is not None and rig.bus.interface is None and (rig.modbus.host or rig.modbus.serial):
            options = options.replaced(drive=Setting.by_rig("modbus", rig, "modbus"))
    if options.drive == "modbus" and not options.given("profile"):
        options = options.replaced(profile=Setting(MODBUS_PROFILE, "default", Origin.BUILT_IN))
    return options


def simulated_canopen(options: RunOptions) -> Connection:
    """The way to an embedded CANopen drive."""
    return Connection(load_canopen_profile(options.profile), NO_BUS, NO_MODBUS)


def can_torque(profile: Profile) -> bool:
    """Can torque be regulated over the bus, and be switched to while the shaft turns?"""
    has = profile.modes.torque if isinstance(profile, ModbusProfile) else bool(profile.modes.torque)
    return has and profile.modes.switch_while_enabled


NO_BUS = BusConfig(MappingProxyType({}))
NO_MODBUS = ModbusConfig(MappingProxyType({}))
_CANOPEN_FLAGS = {"node": "--node", "interface": "--interface", "channel": "--channel", "bitrate": "--bitrate"}


def _refuse_canopen_flags(cli: Mapping[str, Any]) -> None:
    for name, flag in _CANOPEN_FLAGS.items():
        if cli.get(name) is not None:
            step = "A Modbus drive is named by --host or --serial, and --unit; for CANopen say --drive canopen"
            raise UsageError("belongs to CANopen", where=flag, next_step=step)


@dataclass(frozen=True)
class PeerPlan:
    """What will be opened. ``seed`` and ``plant`` are the embedded simulator's, None without it."""

    embedded: bool
    stepped: bool
    seed: int | None
    plant: Any
    faults: tuple[Any, ...] = ()       # scripted faults of the embedded simulator (`sim_bus.fault_script`)
    never_came: list[str] = field(default_factory=list)    # those of them whose moment the run did not reach

    @property
    def epoch_ns(self) -> int:
        """Wall clock at control time zero, for the log's time stamps; in stepped time the clock runs ahead of it."""
        return time.time_ns()


def rated_torque_is_told_by_hand(profile: Profile) -> bool:
    """Does rig.yaml have to say what 100 % torque is?"""
    if isinstance(profile, ModbusProfile):
        return profile.rated_torque is None
    return profile.torque.rated_torque_nm_per_lsb is None
