"""Bus alone: assumptions about SocketCAN and python-can on a real interface."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest

Open = Callable[..., can.BusABC]
Tool = Callable[[str], str]
WAIT = 60.0  # s; for frames that must arrive
QUIET = 0.2  # s; for frames that must not arrive


def frame(can_id: int, data: bytes = b"", extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=extended)


FRAMES = [
    frame(0x000, b"\x01\x05"),  # NMT start, node 5
    frame(0x080),  # SYNC: no data at all
    frame(0x605, bytes.fromhex("4041600000000000")),  # SDO upload of the status word
    frame(0x7FF, bytes(range(8))),
    frame(0x0, b"\xff", extended=True),  # the same number as NMT, but another frame
    frame(0x1ABCDEF0, b"\x10\x20\x30", extended=True),
    frame(0x1FFFFFFF, extended=True),
    can.Message(arbitration_id=0x705, is_remote_frame=True, dlc=1, is_extended_id=False),  # request of node guarding
]


def content(message: can.Message) -> tuple[int, bool, bool, int, bytes]:
    return message.arbitration_id, message.is_extended_id, message.is_remote_frame, message.dlc, bytes(message.data)


def receive(bus: can.BusABC, count: int) -> list[can.Message]:
    end = time.monotonic() + WAIT
    got: list[can.Message] = []
    while len(got) < count:
        message = bus.recv(max(0.0, end - time.monotonic()))
        assert message is not None, f"{len(got)} of {count} frames came"
        got.append(message)
    return got


def listeners(vcan: str) -> int:
    """Return the kernel's count of sockets that receive every frame of the interface."""
    rows = Path("/proc/net/can/rcvlist_all").read_text().splitlines()
    return sum(row.split()[:1] == [vcan] for row in rows)


def wait_for_listener(vcan: str, before: int) -> None:
    end = time.monotonic() + WAIT
    while listeners(vcan) <= before:
        assert time.monotonic() < end, "the listener never bound its socket"
        time.sleep(0.01)


@pytest.mark.parametrize("sent", FRAMES, ids=str)
def test_a_frame_arrives_unchanged(open_bus: Open, sent: can.Message) -> None:
    one, other = open_bus(), open_bus()
    one.send(sent)
    (got,) = receive(other, 1)
    assert content(got) == content(sent)


def test_both_ways_in_order(open_bus: Open) -> None:
    one, other = open_bus(), open_bus()
    for i in range(100):
        one.send(frame(0x185, bytes([i])))
        other.send(frame(0x205, bytes([i])))
    assert [(m.arbitration_id, m.data[0]) for m in receive(other, 100)] == [(0x185, i) for i in range(100)]
    assert [(m.arbitration_id, m.data[0]) for m in receive(one, 100)] == [(0x205, i) for i in range(100)]


def test_own_frames_return_on_request_only(open_bus: Open) -> None:
    deaf, hearing, other = open_bus(), open_bus(receive_own_messages=True), open_bus()
    deaf.send(frame(0x181, b"\x01"))
    receive(other, 1)
    assert deaf.recv(QUIET) is None
    receive(hearing, 1)
    hearing.send(frame(0x182, b"\x02"))
    (own,) = receive(hearing, 1)
    assert own.arbitration_id == 0x182
    assert not own.is_rx


def test_is_rx_does_not_identify_our_own_frames(open_bus: Open) -> None:
    """It shows whether a frame is from this host (MSG_DONTROUTE), which includes other programs on it."""
    one, other = open_bus(), open_bus()
    one.send(frame(0x181, b"\x01"))
    (got,) = receive(other, 1)
    assert not got.is_rx


def test_filters_act_in_the_kernel(open_bus: Open) -> None:
    one = open_bus()
    narrow = open_bus(can_filters=[{"can_id": 0x185, "can_mask": 0x7FF, "extended": False}])
    for can_id in (0x184, 0x185, 0x186):
        one.send(frame(can_id))
    assert [m.arbitration_id for m in receive(narrow, 1)] == [0x185]
    assert narrow.recv(QUIET) is None


def test_time_stamps_are_wall_clock(open_bus: Open) -> None:
    """The driver maps them to monotonic time. This assumes that they are wall clock and do not decrease."""
    one, other = open_bus(), open_bus()
    before = time.time()
    for i in range(50):
        one.send(frame(0x80, bytes([i])))
    after = time.time()
    stamps = [m.timestamp for m in receive(other, 50)]
    assert stamps == sorted(stamps)
    # Tolerance of a microsecond: the conversion to float truncates the time stamp.
    assert before - 1e-6 <= stamps[0]
    assert stamps[-1] <= after + 1e-6


def test_two_sockets_see_the_same_stamp(open_bus: Open) -> None:
    one, a, b = open_bus(), open_bus(), open_bus()
    one.send(frame(0x80))
    assert receive(a, 1)[0].timestamp == receive(b, 1)[0].timestamp


def test_a_burst_is_not_lost(open_bus: Open) -> None:
    """A reader that sleeps during 200 frames still receives them all. The default kernel buffer holds few more."""
    one, other = open_bus(), open_bus()
    for i in range(200):
        one.send(frame(0x185, bytes([i])))
    assert [m.data[0] for m in receive(other, 200)] == list(range(200))


SENDER = """
import sys, time, can
bus = can.Bus(interface="socketcan", channel=sys.argv[1])
bus.send_periodic(can.Message(arbitration_id=0x77F, data=[5], is_extended_id=False), 0.01)
while True:
    bus.send(can.Message(arbitration_id=0x205, data=[1], is_extended_id=False))
    time.sleep(0.01)
"""


def test_a_killed_process_falls_silent(open_bus: Open, vcan: str) -> None:
    """SIGKILL closes the socket and ends all transmission by the kernel on its behalf."""
    bus = open_bus()
    with subprocess.Popen([sys.executable, "-c", SENDER, vcan]) as sender:
        try:
            seen: set[int] = set()
            end = time.monotonic() + WAIT  # Python starts slowly in a guest
            while seen != {0x205, 0x77F} and time.monotonic() < end:
                message = bus.recv(WAIT)
                if message is not None:
                    seen.add(message.arbitration_id)
            assert seen == {0x205, 0x77F}
        finally:
            sender.kill()
    assert sender.returncode == -signal.SIGKILL
    while bus.recv(0) is not None:  # frames sent before
        pass
    assert bus.recv(QUIET) is None


LOG_LINE = re.compile(r"\((\d+\.\d+)\) (\S+) ([0-9A-F]{3}|[0-9A-F]{8})#(R?)([0-9A-F]*)(?: [RT])?")


def decode(line: str, vcan: str) -> tuple[float, tuple[int, bool, bool, int, bytes]]:
    """Parse `(1700000000.123456) vcan0 605#4041600000000000`, 8-digit extended ids, remote frames as `705#R1`."""
    match = LOG_LINE.fullmatch(line)
    assert match, line
    stamp, channel, can_id, remote, rest = match.groups()
    assert channel == vcan
    data = b"" if remote else bytes.fromhex(rest)
    length = int(rest or "0") if remote else len(data)
    return float(stamp), (int(can_id, 16), len(can_id) == 8, bool(remote), length, data)


def test_candump_sees_what_we_send(open_bus: Open, vcan: str, tool: Tool) -> None:
    candump = tool("candump")
    one, other = open_bus(), open_bus()
    before = listeners(vcan)
    with subprocess.Popen([candump, "-L", "-n", str(len(FRAMES)), vcan], stdout=subprocess.PIPE, text=True) as dump:
        try:
            wait_for_listener(vcan, before)
            for message in FRAMES:
                one.send(message)
            log, _ = dump.communicate(timeout=WAIT)
        finally:
            dump.kill()
    decoded = [decode(line, vcan) for line in log.splitlines()]
    assert [seen for _, seen in decoded] == [content(message) for message in FRAMES]
    stamps = [message.timestamp for message in receive(other, len(FRAMES))]
    # The time stamp belongs to the frame, not to the reader: another socket has the same one, to six digits.
    assert [stamp for stamp, _ in decoded] == pytest.approx(stamps, abs=2e-6)


def test_we_see_what_cansend_sends(open_bus: Open, vcan: str, tool: Tool) -> None:
    cansend = tool("cansend")
    bus = open_bus()
    for text in ("000#0105", "080#", "1ABCDEF0#102030"):
        subprocess.run([cansend, vcan, text], check=True, timeout=WAIT)
    assert [content(m) for m in receive(bus, 3)] == [
        (0x000, False, False, 2, b"\x01\x05"),
        (0x080, False, False, 0, b""),
        (0x1ABCDEF0, True, False, 3, b"\x10\x20\x30"),
    ]
