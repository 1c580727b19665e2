"""Hub with standard clients, and the simulator as a separate process."""

import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import can
import pytest

from sim_bus.canopen.simulator import EmbeddedSimulator
from sim_bus.canopen.socketcand import Hub, HubPort, WireFrame, frame_word, parse_send, split
from tests.rigs import plant_file

HANGS_S = 120.0


@contextmanager
def serving(hub: Hub) -> Iterator[None]:
    stop = threading.Event()

    def serve() -> None:
        while not stop.is_set():
            hub.poll(0.02)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        hub.close()


def client(port: int) -> can.BusABC:
    return can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="can0", tcp_tune=True)


def test_words() -> None:
    buffer = bytearray(b"< open can0 >< send 123 0  >< send 1")
    assert split(buffer) == ["open can0", "send 123 0"] and buffer == b"< send 1"
    assert parse_send("send 123 2 a 1f") == WireFrame(0x123, False, b"\x0a\x1f")
    assert parse_send("send 00000123 0") == WireFrame(0x123, True, b"")
    assert parse_send("send 701 1") == WireFrame(0x701, False, b"", 1)
    for bad in ("send", "send xyz 0", "send 123 2 a", "send 123 9", "send 123 1 1ff", "send fff 0"):
        assert parse_send(bad) is None
    assert frame_word(WireFrame(0x80, False, b""), 1.5) == b"< frame 080 1.500000  >"


def test_two_standard_clients_and_one_that_is_lost() -> None:
    hub = Hub()
    with serving(hub):
        first, second, third = client(hub.port), client(hub.port), client(hub.port)
        try:
            for frame in ((0x080, b""), (0x123, b"\x00\x0a\xff"), (0x7FF, bytes(range(8)))):
                first.send(can.Message(arbitration_id=frame[0], data=frame[1], is_extended_id=False))
                for other in (second, third):
                    received = other.recv(HANGS_S)
                    assert received is not None
                    assert (received.arbitration_id, bytes(received.data)) == frame
                    assert not received.is_extended_id
            assert first.recv(0.02) is None                       # never back to the sender
            third.shutdown()
            second.send(can.Message(arbitration_id=0x18FF0001, data=b"\x01", is_extended_id=True))
            received = first.recv(HANGS_S)
            assert received is not None and received.is_extended_id and received.arbitration_id == 0x18FF0001
        finally:
            for bus in (first, second, third):
                bus.shutdown()


def test_a_babbler_is_dropped_and_a_wrong_channel_refused() -> None:
    hub = Hub()
    with serving(hub):
        with socket.create_connection(("127.0.0.1", hub.port)) as babbler:
            assert babbler.recv(64) == b"< hi >"
            babbler.sendall(b"x" * 5000)
            babbler.settimeout(HANGS_S)
            with suppress(ConnectionResetError):
                assert babbler.recv(64) == b""
        with socket.create_connection(("127.0.0.1", hub.port)) as other:
            other.settimeout(HANGS_S)
            assert other.recv(64) == b"< hi >"
            other.sendall(b"< open can7 >")
            assert b"error" in other.recv(64)


def test_the_port_of_the_hub_reports_when_the_last_client_left() -> None:
    port = HubPort(hub := Hub())
    try:
        ready = threading.Event()

        def talk() -> None:
            bus = client(hub.port)
            bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
            ready.wait(HANGS_S)
            bus.shutdown()

        thread = threading.Thread(target=talk)
        thread.start()
        message = None
        while message is None:
            message = port.recv(0.1)
        assert message.arbitration_id == 0x80 and message.dlc == 0
        ready.set()
        with pytest.raises(can.CanOperationError, match="last client"):
            for _ in range(600):
                port.recv(0.1)
        thread.join()
    finally:
        port.shutdown()


COMMAND = [sys.executable, "-m", "sim_bus", "canopen"]
HOME = Path(__file__).parents[2]


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=HOME)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_process_over_its_hub(tmp_path: Path, number: signal.Signals) -> None:
    trace = tmp_path / "shaft.csv"
    process = start("--hub", "127.0.0.1:0", "--stepped", "--trace", str(trace))
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("ready: socketcand 127.0.0.1:") and line.endswith(" channel can0 node 1\n")
        bus = client(int(line.split()[2].rpartition(":")[2]))
        bus.send(can.Message(arbitration_id=0x601, data=struct.pack("<BHB4x", 0x40, 0x5FFE, 2), is_extended_id=False))
        answer = bus.recv(HANGS_S)
        assert answer is not None and answer.data[4] == 1
        bus.shutdown()
        os.kill(process.pid, number)
        assert process.wait(HANGS_S) == 0
        assert process.stderr is not None and process.stderr.read() == ""
        assert "power on" in trace.read_text()
    finally:
        process.kill()
        process.communicate()


def refused(*arguments: str) -> str:
    process = start(*arguments)
    output, errors = process.communicate(timeout=HANGS_S)
    assert process.returncode == 2 and output == "" and "Traceback" not in errors
    return errors


@pytest.mark.heavy
def test_bad_plant_file_and_used_port(tmp_path: Path) -> None:
    plant = plant_file(tmp_path, "plant:\n  inertia_kg_m2: 50.0\n  inertja: 1\n")
    message = refused("--hub", "127.0.0.1:0", "--plant", str(plant))
    assert "inertja" in message and ":3:" in message
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "can't open a hub" in refused("--hub", f"127.0.0.1:{taken.getsockname()[1]}")


def test_bad_options() -> None:
    from sim_bus.__main__ import main
    for arguments in (["--node", "0"], ["--node", "x"], ["--hub", "nowhere"], ["--seed", "-1"]):
        with pytest.raises(SystemExit) as ended:
            main(["canopen", *arguments])
        assert ended.value.code == 2


@pytest.mark.heavy
def test_plant_and_inverter_need_no_bus() -> None:
    heavy = "sys.exit(bool({'can', 'canopen', 'scipy'} & set(sys.modules)))"
    code = f"import sys, sim_bus.plant.rigid, sim_bus.inverter; {heavy}"
    assert subprocess.run([sys.executable, "-c", code], cwd=HOME, check=False).returncode == 0


def test_no_thread_is_left_and_failures_are_raised(tmp_path: Path) -> None:
    before = threading.active_count()
    with EmbeddedSimulator() as simulated:
        assert threading.active_count() == before + 1
    assert threading.active_count() == before
    simulated.close()
    broken = EmbeddedSimulator()
    broken.simulator.node.boot = lambda: 1 / 0  # type: ignore[assignment, method-assign, return-value]
    with pytest.raises(RuntimeError) as failure, broken:
        pass
    assert isinstance(failure.value.__cause__, ZeroDivisionError)
    assert threading.active_count() == before


def test_own_time_follows_the_wall_clock() -> None:
    with EmbeddedSimulator(stepped=False) as simulated, \
            can.Bus(interface="virtual", channel=simulated.channel) as bus:
        every_20_ms = struct.pack("<BHBI", 0x2B, 0x1017, 0, 20)
        bus.send(can.Message(arbitration_id=0x601, data=every_20_ms, is_extended_id=False))
        beats = 0
        while beats < 5:                                          # no SYNC
            message = bus.recv(HANGS_S)
            assert message is not None
            beats += message.arbitration_id == 0x701 and bytes(message.data) == b"\x7f"
        assert simulated.simulator.time_s >= 0.08
