"""Simulated Modbus drive as a separate process, its frames, and its command line."""

import os
import signal
import socket
import struct
import subprocess
import sys
import termios
import tty
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_bus.modbus.lines import NotModbus, ReceivedRequest, RtuReceiver, crc, rtu_reply, tcp_reply, tcp_requests
from tests.rigs import plant_file

HOME = Path(__file__).parents[2]
READ = struct.pack(">BHH", 3, 42, 2)
REPLY = bytes.fromhex("030412345678")


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-m", "sim_bus", "modbus", *arguments], stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, cwd=HOME)


def ready(process: subprocess.Popen[str]) -> list[str]:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line.startswith("ready: modbus "), line
    return line.split()


@pytest.mark.heavy
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_over_tcp(tmp_path: Path, number: signal.Signals) -> None:
    trace = tmp_path / "shaft.csv"
    process = start("--tcp", "127.0.0.1:0", "--unit", "9", "--trace", str(trace))
    try:
        words = ready(process)
        assert words[2] == "tcp" and words[4:] == ["unit", "9", "profile", "generic/modbus"]
        host, port = words[3].split(":")
        assert host == "127.0.0.1"
        with socket.create_connection((host, int(port)), timeout=120) as first, \
                socket.create_connection((host, int(port)), timeout=120) as second:
            second.sendall(b"GET / HTTP/1.0\r\n\r\n")                       # no Modbus: the connection is closed
            assert second.recv(64) == b""
            ask = struct.pack(">HHHB", 0x1234, 0, len(READ) + 1, 9) + READ
            first.sendall(ask[:5])                                            # in parts
            first.sendall(ask[5:] + ask[:9])
            assert first.recv(64) == struct.pack(">HHHB", 0x1234, 0, 7, 9) + REPLY
            first.sendall(ask[9:])
            assert first.recv(64)[7:] == REPLY
            first.sendall(struct.pack(">HHHB", 1, 0, len(READ) + 1, 8) + READ)   # another unit: no reply
            first.settimeout(0.2)
            with pytest.raises(TimeoutError):
                first.recv(64)
        os.kill(process.pid, number)
        assert process.wait(120.0) == 0
        assert process.stderr is not None and process.stderr.read() == ""
    finally:
        process.kill()
        process.communicate()
    rows = [line.split(",") for line in trace.read_text().splitlines()[1:]]
    assert rows[0][4] == "power on" and len(rows) > 20                        # the plant continues without requests
    assert all(float(a[0]) <= float(b[0]) for a, b in pairwise(rows))


@pytest.mark.heavy
def test_over_a_pseudo_terminal() -> None:
    process = start("--rtu", "--profile", "schneider/atv320")
    try:
        words = ready(process)
        assert words[2] == "rtu" and words[4:] == ["unit", "1", "profile", "schneider/atv320"]
        fd = os.open(words[3], os.O_RDWR | os.O_NOCTTY)
        try:
            tty.setraw(fd, termios.TCSANOW)
            for _ in range(2):
                os.write(fd, framed(b"\x01" + struct.pack(">BHH", 3, 6005, 1)))
                reply = b""
                while len(reply) < 7:
                    reply += os.read(fd, 64)
                assert reply == framed(bytes.fromhex("0103020064"))            # TTO: 10.0 s
        finally:
            os.close(fd)
        process.send_signal(signal.SIGTERM)
        assert process.wait(120.0) == 0
    finally:
        process.kill()
        process.communicate()


def test_unusable_addresses_give_one_line(tmp_path: Path) -> None:
    plant = plant_file(tmp_path, "plant:\n  inertja: 1\n")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        cases = {
            ("--tcp", f"127.0.0.1:{port}"): "can't listen",
            ("--rtu", str(tmp_path / "none")): "No such file",
            ("--rtu", "/dev/null"): "can't open",
            ("--tcp", "127.0.0.1:0", "--plant", str(plant)): ":2:",
            ("--tcp", "127.0.0.1:0", "--profile", "generic/nix"): "none named 'generic/nix'",
            ("--tcp", "127.0.0.1:0", "--profile", "generic/cia402"): "canopen",
            ("--tcp", "127.0.0.1:0", "--wrong", "scale_11"): "scale_10",
        }
        for arguments, wanted in cases.items():
            errors = one_line(*arguments)
            assert wanted in errors and "Traceback" not in errors


def one_line(*arguments: str) -> str:
    """Run in this process and return the printed text; the exit code is that of a usage error."""
    import contextlib
    import io

    from sim_bus.command import main

    output, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        assert main(["modbus", *arguments]) == 2
    assert output.getvalue() == "" and errors.getvalue().count("\n") == 1
    return errors.getvalue()


@pytest.mark.parametrize("arguments", [
    [], ["--tcp", "nowhere"], ["--tcp", ":0", "--rtu"], ["--tcp", ":0", "--unit", "0"],
    ["--tcp", ":0", "--unit", "248"],
    ["--tcp", ":0", "--seed", "-1"], ["--tcp", ":0", "--node", "1"],
])
def test_bad_options(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    from sim_bus.command import main

    with pytest.raises(SystemExit) as ended:
        main(["modbus", *arguments])
    assert ended.value.code == 2 and "usage:" in capsys.readouterr().err


# -- frames -----------------------------------------------------------------------------------------------------------

def framed(body: bytes) -> bytes:
    return body + struct.pack("<H", crc(body))


def test_crc_of_the_documents_and_of_the_catalogue() -> None:
    assert crc(b"123456789") == 0x4B37                                        # CRC-16/MODBUS
    assert crc(b"\x02\x07") == 0x1241                                         # serial line guide, appendix B


PDUS = st.one_of(
    st.builds(lambda code, data: bytes([code]) + data, st.sampled_from([1, 2, 3, 4, 5, 6]),
              st.binary(min_size=4, max_size=4)),
    st.builds(lambda head, data: b"\x10" + head + bytes([len(data)]) + data, st.binary(min_size=4, max_size=4),
              st.binary(max_size=240)),
    st.builds(lambda head, data: b"\x17" + head + bytes([len(data)]) + data, st.binary(min_size=8, max_size=8),
              st.binary(max_size=240)),
)


@pytest.mark.heavy
@given(st.lists(st.tuples(st.integers(0, 255), PDUS), max_size=4), st.data())
def test_frames_survive_any_split(requests: list[tuple[int, bytes]], data: st.DataObject) -> None:
    rtu = b"".join(framed(bytes([unit]) + pdu) for unit, pdu in requests)
    tcp = b"".join(struct.pack(">HHHB", at, 0, len(pdu) + 1, unit) + pdu for at, (unit, pdu) in enumerate(requests))
    receiver, found = RtuReceiver(), []
    for piece in pieces(rtu, data):
        found += receiver.feed(piece, 0.0)
    assert [(one.unit, one.pdu) for one in found] == requests
    buffer, heard = bytearray(), []
    for piece in pieces(tcp, data):
        buffer += piece
        heard += tcp_requests(buffer)
    assert heard == [ReceivedRequest(unit, pdu, at) for at, (unit, pdu) in enumerate(requests)] and not buffer


def pieces(stream: bytes, data: st.DataObject) -> list[bytes]:
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    return [stream[a:b] for a, b in pairwise([0, *cuts, len(stream)])]


@given(st.lists(st.binary(max_size=300), max_size=5))
def test_garbage_does_no_harm_and_silence_clears_it(chunks: list[bytes]) -> None:
    receiver = RtuReceiver()
    for at, chunk in enumerate(chunks):
        list(receiver.feed(chunk, 0.01 * at))
    asked = framed(b"\x01" + READ)
    assert list(receiver.feed(asked, 1.0)) == [ReceivedRequest(1, READ)]


def test_broken_and_unknown_rtu_frames() -> None:
    receiver = RtuReceiver()
    asked = framed(b"\x01" + READ)
    assert list(receiver.feed(asked[:-1] + bytes([asked[-1] ^ 1]), 0.0)) == []
    assert list(receiver.feed(asked, 0.001)) == [ReceivedRequest(1, READ)]    # of the right length: dropped as a whole
    assert list(receiver.feed(framed(b"\x01\x41\x00\x07"), 0.002)) == [ReceivedRequest(1, b"\x41\x00\x07")]


@given(st.binary(min_size=7, max_size=64))
def test_the_connection_is_closed_on_other_data(data: bytes) -> None:
    _, protocol, length = struct.unpack_from(">HHH", data)
    if protocol or not 2 <= length <= 254:
        with pytest.raises(NotModbus):
            list(tcp_requests(bytearray(data)))
    else:
        list(tcp_requests(bytearray(data)))


def test_replies_repeat_the_header_of_the_request() -> None:
    assert tcp_reply(ReceivedRequest(5, READ, 0xABCD), REPLY) == bytes.fromhex("abcd00000007 05") + REPLY
    assert rtu_reply(ReceivedRequest(5, READ), REPLY) == framed(b"\x05" + REPLY)
