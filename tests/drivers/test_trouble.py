"""What the adapter says of the bus, who else is on it, and that nothing more is sent where that could do harm."""

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.bus import CanLink, Condition, condition, queue_is_full
from drivers.canopen.drive import CanopenDrive
from drivers.canopen.supervision import NodeWatch
from drivers.clock import SteppedClock
from drivers.drive import Command, Mode
from drivers.errors import CommunicationLost, PreflightRefused
from tests.drivers.on_wire import LIMITS, cycles


@pytest.fixture
def link(wire):
    return CanLink(wire, SteppedClock())


def error_frame(wire, identifier, *data):
    wire.put(identifier, bytes(data), is_error_frame=True)


@pytest.mark.parametrize(("identifier", "data", "found"), [
    (0x40, b"", Condition.OFF),                             # CAN_ERR_BUSOFF
    (0x44, bytes(8), Condition.OFF),
    (0x04, bytes([0, 0x10]), Condition.PASSIVE),            # CAN_ERR_CRTL: receiver passive
    (0x04, bytes([0, 0x20]), Condition.PASSIVE),            # transmitter passive
    (0x04, bytes([0, 0x08]), Condition.ERROR),              # warning level
    (0x20, bytes(8), Condition.ERROR),                      # nobody acknowledged
    (0x00, b"", Condition.ERROR),                           # an interface that tells no more
])
def test_error_frames(identifier, data, found):
    assert condition(identifier, data) is found


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))
def test_any_error_frame_is_something(identifier, data):
    assert condition(identifier, data) in Condition


@pytest.mark.parametrize(("error", "full"), [
    (OSError(105, "No buffer space available"), True), (can.CanOperationError("x", error_code=105), True),
    (can.CanOperationError("Transmit buffer full"), True), (OSError(100, "Network is down"), False),
    (BrokenPipeError(32, "Broken pipe"), False),
])
def test_a_full_queue(wire, link, error, full):
    assert queue_is_full(error) is full
    flushed = []
    wire.flush_tx_buffer = lambda: flushed.append(True)
    wire.send_error = error
    with pytest.raises(CommunicationLost):
        link.send(0x201, b"")
    wire.send_error = None
    if full:
        with pytest.raises(CommunicationLost, match="transmission has ended"):
            link.send(0x201, b"")
        with pytest.raises(CommunicationLost):
            link.ask(0x701)
        assert wire.sent == []
    else:
        link.send(0x201, b"")
    assert bool(flushed) is full


def test_bus_off_ends_sending_for_good(wire, link):
    error_frame(wire, 0x40)
    with pytest.raises(CommunicationLost, match="bus-off"):
        link.drain()
    with pytest.raises(CommunicationLost, match="transmission has ended"):
        link.send(0x080, b"")
    error_frame(wire, 0x40)
    wire.put(0x701, b"\x05")
    link.drain()                                  # said once; what still comes is heard
    assert wire.sent == []
    assert link.error_frames == 2


def test_error_passive_is_counted(wire, link):
    error_frame(wire, 0x04, 0, 0x30)
    error_frame(wire, 0x04, 0, 0x04)
    link.drain()
    assert (link.error_frames, link.passive) == (2, 1)


def test_other_programs_of_this_computer_are_heard(wire, link):
    """SocketCAN marks their frames as it marks our own, which come back only to those who ask for them."""
    got = []
    link.handlers[0x080] = got.append
    wire.put(0x080, b"", is_rx=False)
    link.drain()
    assert got == [b""]


def test_a_second_master_is_told_with_its_second_frame_of_a_kind_however_late():
    clock = SteppedClock()
    watch = NodeWatch(1, clock)
    watch.on_foreign("SYNC")                      # left by another run, and still under way
    watch.on_foreign("SYNC")
    watch.start(0.0)
    watch.on_foreign("SYNC")
    watch.on_foreign("setpoints")
    watch.check()
    clock.wait_until(1000.0)
    watch.on_foreign("SYNC")
    with pytest.raises(CommunicationLost, match="second master is on the bus: it sends SYNC"):
        watch.check()
    watch.on_foreign("setpoints")
    watch.check()                                 # it has been told


@pytest.fixture
def drive(wire, peer, profile):
    return CanopenDrive(wire, profile, SteppedClock(), node=1)


@pytest.mark.parametrize("identifier", [0x080, 0x201, 0x301, 0x401, 0x501])
def test_a_second_master_is_found_before_motion(drive, wire, identifier):
    drive.connect()
    for _ in range(3):
        wire.put(identifier, b"")
    with pytest.raises(PreflightRefused, match="second master"):
        drive.preflight(LIMITS)


def test_and_in_motion(drive, wire):
    drive.connect()
    drive.preflight(LIMITS)
    drive.enable(Mode.SPEED)
    for _ in range(2):
        cycles(drive, wire, 200, Command(Mode.SPEED, 0.0, 0.0))         # 0.8 s
        wire.put(0x080, b"")
    with pytest.raises(CommunicationLost, match="second master"):
        drive.exchange(Command(Mode.SPEED, 0.0, 0.0))


def test_two_nodes_of_one_id_are_found_before_anything_is_written(drive, wire, peer):
    plain = wire.put

    def twice(identifier, data, *arguments, **flags):
        plain(identifier, data, *arguments, **flags)
        if identifier == 0x581:
            plain(identifier, data, *arguments, **flags)

    wire.put = twice
    with pytest.raises(PreflightRefused, match="answered twice"):
        drive.connect()
    assert peer.writes == []


@pytest.mark.parametrize("marker", [True, False])
def test_only_a_simulated_peer_is_told_of_stages(wire, peer, profile, marker):
    if not marker:
        del peer.objects[0x5FFE, 1]
    from drivers.clock import MonotonicClock

    drive = CanopenDrive(wire, profile, MonotonicClock(), node=1)
    drive.announce("setup")
    assert wire.sent == []                        # nobody knows yet who is there
    drive.connect()
    drive.announce("hold")
    drive.announce("nothing such")
    told = [data[4] for data in wire.of(0x601) if data[0] == 0x2F and data[1:4] == b"\xfe\x5f\x04"]
    assert told == ([1, 4] if marker else [])
