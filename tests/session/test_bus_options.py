"""Bus options: precedence of their sources, and messages if the bus cannot be opened."""

import argparse
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import can
import can.cli
import can.util
import pytest

from drivers.errors import CommunicationLost, DataFileError, PreflightRefused
from tdhil.buses import canopen
from tdhil.buses.canopen import CanLine, can_line, check_link, open_bus, parse_link
from tdhil.errors import UsageError
from tests.rigs import loaded_rig


@pytest.fixture(autouse=True)
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Path, Path]]:
    """Use two own configuration files instead of those of this computer."""
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    first, second = tmp_path / "can.conf", tmp_path / "canrc"
    monkeypatch.setattr(can.util, "CONFIG_FILES", [str(first), str(second)])
    yield first, second


def cli(*words: str) -> dict[str, object]:
    parser = argparse.ArgumentParser()
    can.cli.add_bus_arguments(parser)
    return vars(parser.parse_args(words))


def test_no_can_lineured(files: tuple[Path, Path]) -> None:
    assert can_line(cli()).interface is None
    files[0].write_text("[default]\nbitrate = 250000\n")
    assert can_line(cli("-c", "can0")).interface is None
    with pytest.raises(UsageError, match="--simulate"):
        open_bus(can_line({}))


def test_each_value_comes_from_the_first_place_that_names_it(
    tmp_path: Path, files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    files[0].write_text("[default]\ninterface = pcan\nchannel = PCAN_USBBUS1\nbitrate = 125000\nfd = False\n")
    files[1].write_text("[default]\nbitrate = 250000\nstate = ACTIVE\n")
    found = can_line({})
    assert found.kwargs() == can.util.load_config() | {"state": "ACTIVE"}
    assert (found.bitrate, found.source("bitrate")) == (250000, str(files[1]))

    monkeypatch.setenv("CAN_CONFIG", '{"channel": "vcan1", "receive_own_messages": "true", "bitrate": "1"}')
    monkeypatch.setenv("CAN_BITRATE", "500000")
    found = can_line({})
    assert (found.channel, found.source("channel")) == ("vcan1", "CAN_CONFIG")
    assert (found.bitrate, found.source("bitrate")) == (500000, "CAN_BITRATE")
    assert found.kwargs() == can.util.load_config() | {"state": "ACTIVE"}

    bench = loaded_rig(tmp_path, "bus:\n  channel: can7\n  options: {tcp_tune: true}\n")
    found = can_line(cli("-i", "socketcan", "--bus-kwargs", "a=1"), bench)
    assert list(found.rows())[:3] == [
        ("interface", "socketcan", "--interface"),
        ("channel", "can7", "rig.yaml:2"),
        ("bitrate", "500000", "CAN_BITRATE"),
    ]
    assert found.source("tcp_tune") == "rig.yaml:3"
    assert (found.kwargs()["a"], found.source("a")) == (1, "--bus-kwargs")


def test_bustype_is_an_interface(files: tuple[Path, Path]) -> None:
    files[0].write_text("[default]\nbustype = virtual\n")
    assert can_line({}).interface == "virtual"


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("CAN_CONFIG", "{", "CAN_CONFIG: not a JSON object"),
        ("CAN_CONFIG", "[]", "CAN_CONFIG: not a JSON object"),
        ("CAN_INTERFACE", "sockercan", "CAN_INTERFACE: python-can knows no interface 'sockercan'"),
        ("CAN_BITRATE", "fast", "CAN_BITRATE: bitrate must be a positive whole number"),
    ],
)
def test_wrong_variables(monkeypatch: pytest.MonkeyPatch, variable: str, value: str, words: str) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(UsageError, match=words.replace("[", r"\[")):
        can_line({})


@pytest.mark.parametrize("text", ["interface = x\n", "[default]\nno equals\n", "[default]\na = %(b)s\n", "[default\n"])
def test_wrong_files(files: tuple[Path, Path], text: str) -> None:
    files[0].write_text(text)
    with pytest.raises(DataFileError) as caught:
        can_line({})
    assert str(files[0]) in str(caught.value)


def link(*, up: bool = True, bitrate: int | None = 250000, name: str = "can0") -> str:
    kind = {"info_kind": "can", "info_data": {"state": "ERROR-ACTIVE", "bittiming": {"bitrate": bitrate, "sjw": 1}}}
    info = kind if bitrate else {"info_kind": "vcan"}
    flags = ["NOARP", "UP", "LOWER_UP", "ECHO"] if up else ["NOARP", "ECHO"]
    return json.dumps([{"ifindex": 3, "ifname": name, "flags": flags, "mtu": 16, "linkinfo": info}])


def test_output_of_ip_for_a_link() -> None:
    assert parse_link(link(), "can0") == (True, 250000)
    assert parse_link(link(up=False), "can0") == (False, 250000)
    assert parse_link(link(bitrate=None, name="vcan0"), "vcan0") == (True, None)


@pytest.mark.parametrize("text", ["", "{}", "[]", "[1]", '[{"ifname": "can0", "linkinfo": 3}]', "[" * 99999, "null"])
def test_invalid_output_of_ip(text: str) -> None:
    assert parse_link(text, "can0") == (True, None)


def test_a_link_with_another_bit_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(canopen, "read_link", lambda channel: link(name=channel))
    check_link(can_line(cli("-i", "socketcan", "-c", "can0")))
    check_link(can_line(cli("-i", "socketcan", "-c", "can0", "-b", "250000")))
    with pytest.raises(PreflightRefused) as caught:
        check_link(can_line(cli("-i", "socketcan", "-c", "can0", "-b", "500000")))
    assert "the CAN link runs at 250000 bit/s, but --bitrate requests 500000 bit/s" in str(caught.value)
    assert "sudo ip link set can0 down && sudo ip link set can0 up type can bitrate 500000" in str(caught.value)


def test_a_link_that_is_down(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(canopen, "read_link", lambda channel: link(name=channel, up=False))
    with pytest.raises(PreflightRefused, match="sudo ip link set can0 up type can bitrate 250000"):
        check_link(can_line(cli("-i", "socketcan", "-c", "can0")))
    monkeypatch.setattr(canopen, "read_link", lambda channel: link(name=channel, up=False, bitrate=None))
    with pytest.raises(PreflightRefused, match=r"sudo ip link set vcan9 up$"):
        check_link(can_line(cli("-i", "socketcan", "-c", "vcan9")))


def test_no_such_device() -> None:
    with pytest.raises((PreflightRefused, UsageError)) as caught:
        open_bus(can_line(cli("-i", "socketcan", "-c", "nocan77")))
    assert caught.value.next_step
    with pytest.raises(UsageError, match="needs a channel"):
        open_bus(can_line(cli("-i", "socketcan")))


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (OSError(19, "No such device"), PreflightRefused, "ip link show type can"),
        (PermissionError(13, "x"), PreflightRefused, "dialout"),
        (OSError(16, "x"), PreflightRefused, "another program"),
        (OSError(97, "x"), PreflightRefused, "modprobe can_raw"),
        (can.CanInterfaceNotImplementedError("no library"), UsageError, "vendor's driver"),
        (TypeError("unexpected keyword"), UsageError, "refuses its options"),
        (can.CanInitializationError("odd"), PreflightRefused, "can't be opened"),
    ],
)
def test_causes_are_named(
    monkeypatch: pytest.MonkeyPatch, error: Exception, kind: type[Exception], words: str
) -> None:
    def fail(**_: object) -> None:
        raise error

    monkeypatch.setattr(can, "Bus", fail)
    monkeypatch.setattr(canopen, "read_link", lambda channel: None)
    with pytest.raises(kind, match=words):
        open_bus(can_line(cli("-i", "socketcan", "-c", "can0")))


def test_the_virtual_bus_opens() -> None:
    with open_bus(can_line(cli("-i", "virtual", "-c", "bus options"))) as bus:
        assert isinstance(bus, can.BusABC)


def daemon(port: int, *more: str) -> CanLine:
    return can_line(cli("-i", "socketcand", "-c", "can0", "--bus-kwargs", "host=127.0.0.1", f"port={port}", *more))


def test_a_missing_socketcand_server_is_found_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check precedes that of python-can, which takes 10 s."""
    monkeypatch.setattr(can, "Bus", lambda *_, **__: pytest.fail("python-can was asked"))
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
        with pytest.raises(CommunicationLost, match=f"127.0.0.1:{port}: no socketcand server answers"):
            open_bus(daemon(port))
    with pytest.raises(UsageError, match="needs 'host'"):
        open_bus(can_line(cli("-i", "socketcand", "-c", "can0")))


def serve(server: socket.socket, answers: tuple[bytes, ...]) -> None:
    """Serve a probe first, which needs the greeting only, then the client."""
    for number in range(2):
        connection, _ = server.accept()
        connection.sendall(answers[0])
        if number:
            for answer in answers[1:]:
                connection.recv(100)
                connection.sendall(answer)
        connection.recv(100)
        connection.close()


def test_socketcand_opens_tuned(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        answers = (b"< hi >", b"< ok >", b"< ok >")
        threading.Thread(target=serve, args=(server, answers), daemon=True).start()
        bus = open_bus(daemon(server.getsockname()[1]))
        assert getattr(bus, "_SocketCanDaemonBus__tcp_tune") is True  # noqa: B009
        bus.shutdown()


def test_another_server_on_that_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(canopen, "PROBE_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent, pytest.raises(CommunicationLost, match="not a socketcand"):
        open_bus(daemon(silent.getsockname()[1]))
