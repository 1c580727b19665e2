"""Scripted faults of the Modbus drive: refusals, and effects on requests, replies and shaft, by hand."""

import os
import socket
import struct
import termios
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from profiles.simulator_marker import MARKER_STAGE_REGISTER, STAGE_NUMBERS
from sim_bus.command import main
from sim_bus.fault_script import FaultRefused
from sim_bus.modbus.faults import KINDS, ONLY_ON, WRONGS, Faults, parse_all
from sim_bus.modbus.lines import RtuListener, TcpListener, crc
from sim_bus.modbus.machine import Machine
from sim_bus.modbus.server import DriveServer
from tests.rigs import QUIET_RIG
from tests.sim_bus.modbus_host import GENERIC, GenericHost, drive

READ = struct.pack(">BHH", 3, 42, 2)
PATTERN = bytes.fromhex("030412345678")


def host(*faults: str, **options: object) -> GenericHost:
    return GenericHost(drive(script=parse_all(faults, "embedded"), **options))


def reply_to(one: GenericHost, pdu: bytes = READ) -> tuple[bytes | None, float]:
    """Return the reply and its duration."""
    began_s = one.now_s
    reply, one.now_s = one.drive.serve(1, pdu, began_s)
    return reply, one.now_s - began_s


# -- syntax -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(KINDS))
def test_each_has_a_row_and_a_default(name: str) -> None:
    kind = KINDS[name]
    assert 0 <= kind.row < 200 and bool(kind.takes) is bool(kind.value)
    for line in ("tcp", "rtu", "embedded"):
        if line in ONLY_ON.get(name, (line,)):
            (fault,) = parse_all([name], line)
            assert fault.name == name
        else:
            with pytest.raises(FaultRefused, match="on this line"):
                parse_all([name], line)


@pytest.mark.parametrize(("text", "said"), [
    ("heartbeat-lost", "no fault is called"), ("exception=5", "an exception"), ("exception=x", "such as 4"),
    ("no-reply=101%", "0% to 100%"), ("late-reply=5", "such as 200ms"), ("sto=1", "takes no value"),
    ("scale-10@hold", "from the start"), ("sign/2s", "for good"), ("reads-back-otherwise=A-B", "a parameter"),
    ("reset", "simulate modbus --tcp"), ("drive-fault@landing", "no moment"), ("", "is no fault"),
])
def test_what_is_refused(text: str, said: str) -> None:
    with pytest.raises(FaultRefused) as caught:
        parse_all([text], "embedded")
    assert said in str(caught.value) and caught.value.exit_code == 2
    assert caught.value.where.startswith("--fault") and caught.value.next_step


@given(st.one_of(st.text(max_size=30), st.builds("{}={}".format, st.sampled_from(sorted(KINDS)), st.text(max_size=9))))
def test_no_text_does_worse_than_be_refused(text: str) -> None:
    try:
        parse_all([text], "tcp")
    except FaultRefused as error:
        assert str(error)


def test_a_parameter_that_the_profile_does_not_have() -> None:
    with pytest.raises(FaultRefused, match=r"no parameter 'nix'.*time_out"):
        host("reads-back-otherwise=nix")


def test_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["modbus", "--fault", "list"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in KINDS) and "heartbeat-lost" not in listed
    assert main(["modbus", "--tcp", ":0", "--fault", "stoo"]) == 2
    assert main(["modbus", "--rtu", "--fault", "reset"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and "'stoo'" in lines[0] and "no reset on this line" in lines[1]


# -- begin and end ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stage", STAGE_NUMBERS)
def test_a_stage_starts_it_once(stage: str) -> None:
    one = host(f"no-reply@{stage}+1s/500ms")
    one.wait(5.0)
    other = "hold" if stage != "hold" else "speed"
    one.write_one(MARKER_STAGE_REGISTER, STAGE_NUMBERS[other])
    one.wait(2.0)
    one.write(MARKER_STAGE_REGISTER, [STAGE_NUMBERS[stage]])
    assert one.read(MARKER_STAGE_REGISTER) == (STAGE_NUMBERS[stage],)
    one.wait(0.9)
    assert reply_to(one)[0] == PATTERN
    one.wait(0.15)
    assert reply_to(one)[0] is None
    one.wait(0.5)
    one.write_one(MARKER_STAGE_REGISTER, STAGE_NUMBERS[stage])
    one.wait(1.2)
    assert reply_to(one)[0] == PATTERN


def test_a_stage_is_accepted_during_any_fault_and_feeds_no_watchdog() -> None:
    one = host("no-reply@1s", "drive-fault@hold")
    one.write_one(40, 300)
    one.enable(5.0)
    one.wait(1.0 - one.now_s)
    for _ in range(4):
        one.write_one(MARKER_STAGE_REGISTER, 1)
        one.wait(0.1)
    assert one.drive.machine.watchdog.lost
    one.write_one(MARKER_STAGE_REGISTER, STAGE_NUMBERS["hold"])
    assert one.drive.machine.words.faulted


def test_without_a_script_the_stage_changes_nothing() -> None:
    told, untold = host(), host()
    told.write_one(MARKER_STAGE_REGISTER, 5)
    assert told.drive.machine.inverter.speed_rad_s == untold.drive.machine.inverter.speed_rad_s == 0.0
    assert told.read(16, 5) == untold.read(16, 5)


# -- the line --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", [1, 2, 3, 4, 6])
def test_exceptions(code: int) -> None:
    one = host(f"exception@1s={code}/1s")
    one.write_one(38, 100)
    one.wait(1.2)
    assert one.refused(READ) == one.refused(struct.pack(">BHH", 6, 38, 77)) == code
    one.wait(1.0)
    assert one.read(38) == (100,)                                               # no effect on the drive


def test_no_reply_and_a_late_one() -> None:
    silent, late = host("no-reply"), host("late-reply=200ms")
    right, takes_s = reply_to(host())
    assert reply_to(silent, struct.pack(">BHH", 6, 38, 77))[0] is None
    assert silent.drive.machine.parameters.number("torque_limit") != 77
    reply, late_s = reply_to(late)
    assert reply == right == PATTERN and late_s == pytest.approx(takes_s + 0.2, abs=1e-9)
    acknowledged, _ = reply_to(late, struct.pack(">BHH", 6, 38, 77))
    assert acknowledged and late.drive.machine.parameters.number("torque_limit") == 77


def test_a_short_reply_and_one_with_a_wrong_crc() -> None:
    assert reply_to(host("short-reply"))[0] == PATTERN[:3]
    spoilt = host("bad-crc")
    assert reply_to(spoilt, struct.pack(">BHH", 6, 38, 77))[0] is None
    assert spoilt.drive.machine.parameters.number("torque_limit") == 77         # the request was executed


def test_a_share_repeats_with_its_seed() -> None:
    def lost(seed: int) -> list[bool]:
        one = host("no-reply=30%", seed=seed)
        return [reply_to(one)[0] is None for _ in range(200)]

    first = lost(1)
    assert first == lost(1) != lost(2)
    assert 0.18 < sum(first) / 200 < 0.42                                        # 30 % ± 3.7 standard deviations


def test_frozen_feedback_permits_writing() -> None:
    one = host("frozen-feedback@4s")
    one.enable(20.0)
    one.cycles(4.2 - one.now_s, rpm=20.0)
    kept = one.command(0x0F, 20.0)
    one.cycles(2.0, rpm=0.0)
    assert one.command(0x0F) == kept and kept[1] > 1.0
    assert abs(one.drive.speed_rad_s) < 0.1                                      # it came to standstill
    assert one.number(42, "I") == 0x12345678


# -- the drive and its shaft -----------------------------------------------------------------------------------


def test_a_fault_of_the_drive_and_sto() -> None:
    tripped, off = host("drive-fault@4s"), host("sto@4s/2s")
    for one in (tripped, off):
        one.enable(20.0)
        one.cycles(3.9 - one.now_s, rpm=20.0)
    speed_rad_s = off.drive.speed_rad_s
    off.cycles(0.5, rpm=20.0)
    assert off.drive.machine.inverter.torque_nm == 0.0 and off.drive.speed_rad_s > 0.8 * speed_rad_s
    assert off.command(0x06)[0] & 0x6F == off.command(0x07)[0] & 0x6F == 0x40    # it cannot be enabled
    off.wait(2.0)
    off.enable()
    tripped.cycles(4.0, rpm=20.0)
    assert tripped.command(0x0F)[0] & 0x4F == 0x08 and abs(tripped.drive.speed_rad_s) < 0.01


def test_a_reduced_torque_stays_reduced_after_any_write() -> None:
    one = host("internal-limit@1s=20%/2s")
    most = one.drive.machine.inverter.control.limits.torque_forward_nm
    one.wait(1.5)
    one.command(0x00)
    assert one.drive.machine.inverter.control.limits.torque_forward_nm == pytest.approx(0.2 * most)
    one.wait(2.0)
    one.command(0x00)
    assert one.drive.machine.inverter.control.limits.torque_forward_nm == pytest.approx(most)


@pytest.mark.heavy
def test_false_reports() -> None:
    right, inverted, scaled = host(), host("encoder-inverted"), host("torque-scale=2")
    for one in (right, inverted, scaled):
        one.enable(20.0)
    found = [one.cycles(8.0, rpm=20.0) for one in (right, inverted, scaled)]
    assert found[1][1] == pytest.approx(-found[0][1]) and found[2][2] == pytest.approx(2 * found[0][2], abs=0.002)
    assert right.drive.speed_rad_s == inverted.drive.speed_rad_s == scaled.drive.speed_rad_s


def test_a_lost_load_accelerates_faster() -> None:
    right, light = host(), host("load-lost@1s=20%")
    for one in (right, light):
        one.enable()
        one.write_one(4, 1)
        one.cycles(4.0 - one.now_s, torque=0.15)
    assert right.drive.speed_rad_s > 0.1
    assert light.drive.speed_rad_s > 2.0 * right.drive.speed_rad_s


def test_commands_and_modes_that_are_not_followed() -> None:
    stuck, kept = host("stuck-state"), host("mode-not-followed")
    assert [stuck.command(word)[0] & 0x6F for word in (0x06, 0x07, 0x0F)] == [0x40] * 3
    kept.enable()
    kept.write_one(4, 1)
    assert kept.read(20) == (0,)


def test_the_watchdogs_time_is_not_kept_and_other_writes_are() -> None:
    one = host("watchdog-not-armed")
    one.write_one(40, 300)
    one.write_one(38, 77)
    assert (one.read(40), one.read(38)) == ((0,), (77,))


@pytest.mark.parametrize("name", sorted(WRONGS))
def test_a_fault_of_the_wiring_equals_the_same_scripted_error(name: str) -> None:
    def said(one: GenericHost) -> list[tuple[int, ...] | int]:
        one.refused(struct.pack(">BHH", 6, 38, 321))
        pdus = [struct.pack(">BHH", 3, address, 1) for address in range(16, 52)]
        return [one.refused(pdu) or one.read(int.from_bytes(pdu[1:3], "big")) for pdu in pdus]

    of = ":torque_limit" if name == "reads-back-otherwise" else ""
    assert said(host(name)) == said(GenericHost(drive(wrongs=[WRONGS[name] + of]))) != said(host())


# -- in real time ----------------------------------------------------------------------------------------------


@contextmanager
def served(line: str, *faults: str) -> Iterator[str]:
    """Yield the address of a drive on its own line."""
    stop = threading.Event()
    with Machine(QUIET_RIG, GENERIC, stepped=False) as machine:
        listener = TcpListener("127.0.0.1", 0) if line == "tcp" else RtuListener(
            None, baud=19200, parity="N", stop_bits=1)
        script = Faults(machine, GENERIC, parse_all(faults, line))
        server = DriveServer(machine, 1, listener, gateway=line == "tcp", faults=script)
        thread = threading.Thread(target=server.run, args=(stop,))
        thread.start()
        try:
            yield listener.reached_by.split()[1]
        finally:
            stop.set()
            thread.join()
            listener.close()


def connected(stack: ExitStack, where: str) -> socket.socket:
    name, port = where.split(":")
    client = stack.enter_context(socket.create_connection((name, int(port)), timeout=5.0))
    client.settimeout(5.0)
    return client


def ask(client: socket.socket, number: int) -> None:
    client.sendall(struct.pack(">HHHB", number, 0, len(READ) + 1, 1) + READ)


def test_on_tcp_another_transaction() -> None:
    with served("tcp", "wrong-transaction-id") as where, ExitStack() as stack:
        client = connected(stack, where)
        ask(client, 0x1234)
        reply = client.recv(64)
        assert reply[2:] == struct.pack(">HHB", 0, 7, 1) + PATTERN and reply[:2] != b"\x12\x34"


def test_on_tcp_a_late_reply_still_arrives() -> None:
    with served("tcp", "late-reply=300ms") as where, ExitStack() as stack:
        client = connected(stack, where)
        began_s = time.monotonic()
        for number in (1, 2):
            ask(client, number)
        got = client.recv(64)
        assert time.monotonic() >= began_s + 0.3
        while len(got) < 26:
            got += client.recv(64)
        assert [got[:2], got[13:15]] == [b"\0\1", b"\0\2"]


def test_on_tcp_connections_that_are_lost_once() -> None:
    with served("tcp", "reset") as where, ExitStack() as stack:
        client = connected(stack, where)
        ask(client, 1)
        with pytest.raises(ConnectionResetError):
            client.recv(64)
        again = connected(stack, where)
        ask(again, 2)
        assert again.recv(64)[7:] == PATTERN
    with served("tcp", "half-open") as where, ExitStack() as stack:
        client = connected(stack, where)
        for number in (1, 2):
            ask(client, number)
        again = connected(stack, where)
        ask(again, 3)
        assert again.recv(64)[7:] == PATTERN
        client.settimeout(0.05)
        with pytest.raises(TimeoutError):                                        # neither a reply nor an end
            client.recv(64)


def test_on_a_serial_line_a_wrong_crc() -> None:
    with served("rtu", "bad-crc") as where:
        fd = os.open(where, os.O_RDWR | os.O_NOCTTY)
        try:
            tty.setraw(fd, termios.TCSANOW)
            body = b"\x01" + READ
            os.write(fd, body + crc(body).to_bytes(2, "little"))
            got = b""
            while len(got) < 9:
                got += os.read(fd, 64)
        finally:
            os.close(fd)
    assert got[:7] == b"\x01" + PATTERN and int.from_bytes(got[7:], "little") != crc(got[:7])
