"""Bus errors of the adapter, other nodes, and the end of transmission after bus-off."""

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
    (0x20, bytes(8), Condition.ERROR),                      # no acknowledgement
    (0x00, b"", Condition.ERROR),                           # an interface without details
])
def test_error_frames(identifier, data, found):
    assert condition(identifier, data) is found


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))
def test_any_error_frame_has_a_text(identifier, data):
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
    link.drain()                                  # reported once; frames are still received
    assert wire.sent == []
    assert link.error_frames == 2


def test_error_passive_is_counted(wire, link):
    error_frame(wire, 0x04, 0, 0x30)
    error_frame(wire, 0x04, 0, 0x04)
    link.drain()
    assert (link.error_frames, link.passive) == (2, 1)


def test_frames_of_other_programs_on_this_computer_are_received(wire, link):
    """SocketCAN marks their frames like our own. Own frames return only on request."""
    got = []
    link.handlers[0x080] = got.append
    wire.put(0x080, b"", is_rx=False)
    link.drain()
    assert got == [b""]


def test_another_master_is_reported_with_its_second_frame_of_a_kind_at_any_time():
    clock = SteppedClock()
    watch = NodeWatch(1, clock)
    watch.on_foreign("SYNC")                      # from an earlier run, and still on the way
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
    watch.check()                                 # already reported


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
def test_stages_are_sent_to_a_simulated_peer_only(wire, peer, profile, marker):
    if not marker:
        del peer.objects[0x5FFE, 1]
    from drivers.clock import MonotonicClock

    drive = CanopenDrive(wire, profile, MonotonicClock(), node=1)
    drive.announce("setup")
    assert wire.sent == []                        # the peer is not identified yet
    drive.connect()
    drive.announce("hold")
    drive.announce("nothing such")
    told = [data[4] for data in wire.of(0x601) if data[0] == 0x2F and data[1:4] == b"\xfe\x5f\x04"]
    assert told == ([1, 4] if marker else [])
