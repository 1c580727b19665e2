"""The connection of a run as plain data. With it a later stop reaches the drive of that run and no other.

The rig's file, the profile's file and the environment may change during a run. The data contain the bus, each setting
of its line, the node, and the profile's text.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from profiles import parse_profile, profile_text
from tdhil.buses import Connection, bus_named
from tdhil.config import Origin, RunOptions, Setting, resolve

_SOURCE: Final = "the run's own connection"
_PLAIN: Final = (str, int, float, bool, type(None), list, dict)


def kept_connection(options: RunOptions, connection: Connection) -> dict[str, Any]:
    """Return the connection for JSON. Raises DataFileError if the profile can't be read any more."""
    line = {name: one.value for name, one in connection.line.settings.items() if isinstance(one.value, _PLAIN)}
    return {
        "drive": connection.drive, "line": line, "node": options.node, "profile": connection.profile.name,
        "profile_text": profile_text(options.profile), "address": connection.bus.address(options, connection),
    }


def connection_of_kept(plain: Mapping[str, Any]) -> tuple[RunOptions, Connection]:
    """Return options and connection of the run. Raises DataFileError, KeyError, TypeError or ValueError."""
    bus = bus_named(str(plain["drive"]))
    profile = parse_profile(str(plain["profile_text"]), str(plain["profile"]))
    settings = {name: Setting(value, _SOURCE, Origin.RIG_FILE) for name, value in dict(plain["line"]).items()}
    options = resolve({"drive": bus.name, "node": plain["node"]}, None)
    return options, Connection(bus, profile, bus.line_type(settings))
