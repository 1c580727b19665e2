"""Address of a Modbus drive: precedence of sources, conflicts, and the bus without a statement."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DataFileError
from profiles.library import load_modbus_profile
from tdhil.buses.modbus import modbus_line
from tdhil.config.resolution import resolve
from tdhil.config.rig import Rig
from tdhil.errors import UsageError
from tdhil.session.connection import connection_of
from tests.rigs import loaded_rig

PROFILE = load_modbus_profile("generic/modbus")


@pytest.fixture(autouse=True)
def no_bus_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    import can.util

    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(can.util, "CONFIG_FILES", [])


def chosen(cli: dict[str, Any], rig: Rig | None = None) -> tuple[str, str, str, str]:
    """Return (drive, its source, profile, its source)."""
    options, connection = connection_of(cli, rig, resolve(cli, rig))
    assert connection.drive == options.drive
    return options.drive, options.source("drive"), options.profile, options.source("profile")


def test_no_address_is_stated() -> None:
    found = modbus_line({}, None, PROFILE)
    assert found.host is None and found.serial is None
    assert list(found.rows()) == [("unit", "1", "profile generic/modbus")]
    assert found.unit == 1


def test_each_value_comes_from_the_first_place_that_names_it(tmp_path: Path) -> None:
    rig = loaded_rig(tmp_path, "modbus:\n  host: 192.0.2.10\n  port: 5020\n  unit: 7\n")
    found = modbus_line({"unit": 9}, rig, PROFILE)
    assert list(found.rows()) == [
        ("host", "192.0.2.10", "rig.yaml:2"), ("port", "5020", "rig.yaml:3"), ("unit", "9", "--unit"),
    ]
    assert (found.host, found.port, found.unit, found.serial) == ("192.0.2.10", 5020, 9, None)


def test_the_command_line_s_serial_device_undoes_the_rig_s_host(tmp_path: Path) -> None:
    rig = loaded_rig(tmp_path, "modbus: {host: 192.0.2.10, port: 5020}\n")
    found = modbus_line({"serial": "/dev/ttyUSB0", "baud": 9600}, rig, PROFILE)
    assert list(found.rows()) == [
        ("serial", "/dev/ttyUSB0", "--serial"), ("baud", "9600", "--baud"),
        ("parity", "E", "profile generic/modbus"), ("stop_bits", "1", "profile generic/modbus"),
        ("unit", "1", "profile generic/modbus"),
    ]
    assert (found.baud, found.parity, found.stop_bits) == (9600, "E", 1)


@pytest.mark.parametrize(
    ("cli", "said"),
    [
        ({"host": "a", "serial": "/dev/ttyUSB0"}, "--serial: and host exclude each other"),
        ({"host": "a", "unit": 300}, "--unit: must be at most 255"),
        ({"host": "a", "port": 0}, "--port: must be at least 1"),
        ({"serial": "/dev/ttyUSB0", "unit": 0}, "1 to 247"),
        ({"serial": "/dev/ttyUSB0", "baud": 1}, "--baud"),
        ({"host": "a", "baud": 9600}, "--baud: has no effect without --serial"),
        ({"port": 5020}, "--port: has no effect without --host"),
    ],
)
def test_what_is_refused(cli: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError) as caught:
        modbus_line(cli, None, PROFILE)
    assert said in str(caught.value)


def test_choice_of_the_bus(tmp_path: Path) -> None:
    assert chosen({}) == ("canopen", "default", "generic/cia402", "default")
    assert chosen({"drive": "modbus"}) == ("modbus", "--drive", "generic/modbus", "default")
    assert chosen({"profile": "generic/modbus"})[:2] == ("modbus", "profile generic/modbus")
    assert chosen({"profile": "generic/cia402"})[:2] == ("canopen", "profile generic/cia402")
    assert chosen({"host": "a"})[:3] == ("modbus", "--host", "generic/modbus")
    rig = loaded_rig(tmp_path, "modbus: {serial: /dev/ttyUSB0}\n")
    assert chosen({}, rig)[:2] == ("modbus", "rig.yaml:1")
    both = loaded_rig(tmp_path, "bus: {interface: virtual}\nmodbus: {serial: /dev/ttyUSB0}\n")
    assert chosen({}, both)[0] == "canopen"
    assert chosen({"drive": "modbus"}, both)[0] == "modbus"


@pytest.mark.parametrize(
    ("cli", "said"),
    [
        ({"drive": "canopen", "host": "a"}, "--host: belongs to Modbus"),
        ({"drive": "canopen", "unit": 3}, "--unit: belongs to Modbus"),
        ({"drive": "modbus", "node": 3}, "--node: belongs to CANopen"),
        ({"drive": "modbus", "interface": "virtual"}, "--interface: belongs to CANopen"),
    ],
)
def test_options_of_the_other_bus(cli: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError) as caught:
        chosen(cli)
    assert said in str(caught.value)
    assert caught.value.next_step


@pytest.mark.parametrize(("drive", "profile"), [("modbus", "generic/cia402"), ("canopen", "generic/modbus")])
def test_a_profile_of_the_other_bus(drive: str, profile: str) -> None:
    with pytest.raises(DataFileError, match=f"--drive says {drive}"):
        chosen({"drive": drive, "profile": profile})
