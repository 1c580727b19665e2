"""Connection of a run as plain data: round trip for each profile and each kind of connection."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from drivers import DataFileError
from profiles import load_profile, profile_names
from profiles.library import profile_path
from tdhil.config import load_rig, resolve
from tdhil.session import connection_of, connection_of_kept, kept_connection
from tests.rigs import rig_file

CANOPEN = ("bus: {interface: socketcan, channel: can3, bitrate: 250000, options: {receive_own_messages: false}}\n"
           "node: 17\n")
WAYS = (
    CANOPEN, "modbus: {host: 192.0.2.1, port: 1502, unit: 7}\n",
    "modbus: {serial: /dev/ttyUSB3, baud: 38400, parity: N, stop_bits: 2, unit: 3}\n",
    "ethercat: {interface: eth3, position: 3}\n",
)


def kept(path: Path) -> tuple:
    rig = load_rig(path)
    options, connection = connection_of({}, rig, resolve({}, rig))
    return options, connection, json.loads(json.dumps(kept_connection(options, connection)))


@pytest.mark.parametrize("text", WAYS)
def test_the_connection_to_a_drive_is_restored_without_its_files(tmp_path, monkeypatch, text):
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE"):
        monkeypatch.delenv(name, raising=False)
    path = rig_file(tmp_path, text)
    options, connection, plain = kept(path)
    path.unlink()
    monkeypatch.setenv("CAN_CHANNEL", "can9")              # a later environment has no effect
    again, back = connection_of_kept(plain)
    assert {name: one.value for name, one in back.line.settings.items()} == {
        name: one.value for name, one in connection.line.settings.items()}
    assert (back.bus, back.profile, again.node) == (connection.bus, connection.profile, options.node)
    assert back.bus.address(again, back) == connection.bus.address(options, connection) == plain["address"]


@pytest.mark.parametrize("name", profile_names())
def test_a_profile_is_restored(tmp_path, name):
    profile = load_profile(name)
    way = {"canopen": CANOPEN, "modbus": WAYS[1], "ethercat": WAYS[-1]}[profile.bus]
    assert connection_of_kept(kept(rig_file(tmp_path, f"profile: {name}\n{way}"))[2])[1].profile == profile


def test_a_profile_of_the_user_is_kept(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text(profile_path("generic/modbus").read_text())
    options, connection, plain = kept(rig_file(tmp_path, f"profile: own.yaml\n{WAYS[1]}"))
    own.write_text(own.read_text().replace("per_lsb: 0.1", "per_lsb: 0.2"))
    assert connection_of_kept(plain)[1].profile == connection.profile
    own.unlink()
    with pytest.raises(DataFileError):
        kept_connection(options, connection)


@pytest.mark.parametrize("plain", [{}, {"drive": "no bus"}, {"drive": "modbus", "profile": "x", "profile_text": "x"}])
def test_invalid_connection_data_are_refused(plain):
    with pytest.raises((DataFileError, KeyError, TypeError, ValueError)):
        connection_of_kept(plain)
