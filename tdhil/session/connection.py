"""The connection to the drive: bus, profile, address on the bus, and the source of each value.

No code here or above names a bus. `tdhil.buses.Bus` is the interface of a bus, and `tdhil.config.registry.BUSES` lists
them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from drivers import DataFileError, Problem
from profiles import load_profile
from tdhil.buses import Connection, all_buses, bus_named
from tdhil.config import DEFAULT_BUS, Origin, RunOptions, Setting
from tdhil.errors import MessageCode, UsageError

if TYPE_CHECKING:
    from tdhil.config import Rig


def connection_of(cli: Mapping[str, Any], rig: Rig | None, options: RunOptions) -> tuple[RunOptions, Connection]:
    """Return the options with drive and profile decided, and the connection to the drive.

    Raises UsageError for options of another bus, DataFileError for an unusable profile.
    """
    options = choose_drive(cli, rig, options)
    bus = bus_named(options.drive)
    for other in all_buses():
        flag = None if other.name == bus.name else other.asked_for(cli, bus.also)
        if flag is not None:
            raise UsageError(
                f"belongs to {other.title}, but the drive is on {bus.title}", where=flag,
                next_step=f"Name a {bus.title} drive with {bus.named_by}. For {other.title} add "
                f"--drive {other.name}",
                entry=MessageCode.OPTION_OF_ANOTHER_BUS,
            )
    profile = load_profile(options.profile, bus.name)
    found = Connection(bus, profile, bus.line(cli, rig, profile))
    if rig is None or found.configured or options.simulate:
        return options, found
    addressed = next((one for one in all_buses() if one.name != bus.name and one.placed_in(rig)), None)
    if addressed is not None:              # rig.yaml gives an address on another bus: the simulator was not meant
        missing = f"{bus.section}: ({bus.place_keys})" if bus.section else bus.named_by
        raise DataFileError((Problem(
            rig.file or "rig.yaml", rig.line(addressed.section),
            f"{addressed.section}: gives a drive's address, but the drive is on {bus.name} ({options.source('drive')}),"
            f" and its address is missing; give {missing}, name the other drive,"
            " or use the simulated one with --simulate",
        ),), entry=MessageCode.OPTION_OF_ANOTHER_BUS)
    return options, found


def choose_drive(cli: Mapping[str, Any], rig: Rig | None, options: RunOptions) -> RunOptions:
    """Return the options with the bus. If it is not named, it follows from the profile or the given address."""
    if not options.given("drive"):
        if options.given("profile"):
            profile = load_profile(options.profile)
            options = options.replaced(drive=Setting(profile.bus, f"profile {profile.name}", Origin.PROFILE))
        elif (setting := _bus_by_place(cli, rig)) is not None:
            options = options.replaced(drive=setting)
    if not options.given("profile") and (named := bus_named(options.drive).default_profile) != options.profile:
        options = options.replaced(profile=Setting(named, "default", Origin.BUILT_IN))
    return options


def _bus_by_place(cli: Mapping[str, Any], rig: Rig | None) -> Setting | None:
    """Return the bus of the address on the command line, or else in rig.yaml; None for the default bus."""
    others = [bus for bus in all_buses() if bus.name != DEFAULT_BUS]
    for bus in others:
        if (flag := bus.asked_for(cli)) is not None:
            return Setting.by_flag(bus.name, flag)
    if rig is None or bus_named(DEFAULT_BUS).placed_in(rig):
        return None
    return next((Setting.by_rig(bus.name, rig, bus.section) for bus in others if bus.placed_in(rig)), None)


def simulated_connection(options: RunOptions) -> Connection:
    """Return the connection to an embedded drive on the bus of the options."""
    bus = bus_named(options.drive)
    return Connection(bus, load_profile(options.profile, bus.name), bus.line_type())
