"""Every received and sent frame, in order. Each fault of the bus becomes one error with the next step."""

import can
import pytest

from drivers.canopen.bus import PEER_DEAD_S, PEER_STILL_DEAD_S, CanLink
from drivers.clock import SteppedClock
from drivers.errors import CommunicationLost

BROKEN = [
    can.CanOperationError("transmit buffer full"),
    OSError(105, "No buffer space available"),
    BrokenPipeError(32, "Broken pipe"),
    ValueError("file descriptor cannot be a negative integer (-1)"),
]


@pytest.fixture
def frames():
    return []


@pytest.fixture
def link(wire, frames):
    return CanLink(wire, SteppedClock(), frames.append)


@pytest.mark.parametrize("error", BROKEN, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("way", ["send", "receive"])
def test_a_broken_bus(wire, link, frames, error, way):
    setattr(wire, f"{way}_error", error)
    with pytest.raises(CommunicationLost) as caught:
        link.send(0x201, b"") if way == "send" else link.receive(0.1)
    assert caught.value.where == "scripted bus"
    assert "watchdog" in caught.value.next_step
    assert str(error) in caught.value.what
    assert caught.value.__cause__ is error
    assert frames == []


def test_the_tap_sees_all_in_order(wire, link, frames):
    link.send(0x201, b"\x01\x02")
    wire.put(0x181, b"\x03")
    wire.put(0x7FF, b"")
    link.drain()
    link.send(0x080, b"")
    assert [(frame.outgoing, frame.identifier, frame.data) for frame in frames] == [
        (True, 0x201, b"\x01\x02"), (False, 0x181, b"\x03"), (False, 0x7FF, b""), (True, 0x080, b""),
    ]


def test_frames_go_out_as_11_bit_data_frames(wire, link):
    seen = []
    wire.send = seen.append
    link.send(0x67F, bytes(8))
    assert (seen[0].is_extended_id, seen[0].is_remote_frame, seen[0].dlc) == (False, False, 8)


def test_handlers_get_their_identifier_only(wire, link):
    got = []
    link.handlers[0x181] = got.append
    wire.put(0x182, b"other")
    wire.put(0x181, b"mine")
    link.drain()
    assert got == [b"mine"]


@pytest.mark.parametrize("kind", ["is_extended_id", "is_remote_frame", "is_error_frame"])
def test_frames_that_are_no_canopen_data_reach_no_handler(wire, link, kind):
    """The frames are 29-bit with the same number, node guarding of another master, and an error frame."""
    got = []
    link.handlers[0x701] = got.append
    wire.put(0x701, b"", **{kind: True})
    link.drain()
    assert got == []
    assert link.error_frames == (kind == "is_error_frame")


def test_a_receive_without_a_frame_takes_the_stated_time(wire, link, fake_time):
    begin_s = fake_time.now_s
    assert link.receive(0.25) is None
    assert fake_time.now_s - begin_s == pytest.approx(0.25)


def test_pumping_ends_in_time_despite_other_traffic(wire, link, fake_time):
    begin_s = fake_time.now_s
    for k in range(100):
        wire.put(0x123, b"x", 0.01 * k)
    assert not link.pump_until(lambda: False, 0.3)
    assert fake_time.now_s - begin_s == pytest.approx(0.3)


def test_pumping_ends_at_once_when_it_is_done(wire, link, fake_time):
    got = []
    link.handlers[0x181] = got.append
    wire.put(0x181, b"x", 0.1)
    begin_s = fake_time.now_s
    assert link.pump_until(lambda: bool(got), 5.0)
    assert fake_time.now_s - begin_s == pytest.approx(0.1)


def test_in_stepped_time_a_host_that_was_frozen_declares_no_peer_dead(wire, link, fake_time):
    """The peer has replied or will reply. An absence of this computer shows nothing about the peer."""
    got, recv = [], wire.recv
    link.asks, link.handlers[0x181] = True, got.append

    def frozen(timeout):
        wire.recv = recv
        fake_time.sleep(10.0 * PEER_DEAD_S)        # and the wait is over without a received frame
        wire.put(0x181, b"x", 0.001)

    wire.recv = frozen
    assert link.await_answer(lambda: bool(got), 0.1)


def test_in_stepped_time_a_silent_peer_is_finally_dead(wire, link, fake_time):
    link.asks = True
    for waits_s in (PEER_DEAD_S, PEER_STILL_DEAD_S):
        begin_s = fake_time.now_s
        assert not link.await_answer(lambda: False, 0.1)
        assert fake_time.now_s - begin_s == pytest.approx(waits_s, abs=1e-6)


def test_a_stepped_peer_that_replies_at_once_causes_no_wait(wire, frames, fake_time):
    wire.answers_at_once = True
    link, begun_s = CanLink(wire, SteppedClock(), frames.append), fake_time.monotonic()
    link.asks = True
    wire.put(0x181, b"\x01")
    wire.put(0x281, b"\x02")
    assert not link.await_answer(lambda: False, PEER_DEAD_S)
    assert [frame.identifier for frame in frames] == [0x181, 0x281]
    wire.put(0x181, b"\x03")
    assert link.await_answer(lambda: len(frames) == 3, PEER_DEAD_S)
    assert fake_time.monotonic() == begun_s


def test_a_babbling_bus_does_not_hold_the_loop(wire, link, fake_time):
    def babble(timeout):
        fake_time.sleep(0.0001)
        return can.Message(arbitration_id=1, is_extended_id=False)

    wire.recv = babble
    begin_s = fake_time.now_s
    with pytest.raises(CommunicationLost, match="faster") as caught:
        link.drain()
    assert caught.value.next_step
    assert fake_time.now_s - begin_s < 1.0


def test_closing_a_dead_bus(wire, link):
    def fail():
        raise OSError("gone")

    wire.shutdown = fail
    link.close()


def test_over_a_bus_of_python_can():
    with can.Bus(interface="virtual", channel="link test") as other:
        link = CanLink(can.Bus(interface="virtual", channel="link test"), SteppedClock())
        link.send(0x181, b"ab")
        assert bytes(other.recv(1.0).data) == b"ab"
        other.send(can.Message(arbitration_id=0x201, data=b"cd", is_extended_id=False))
        assert link.receive(1.0) == (0x201, b"cd")
        link.close()
        with pytest.raises(CommunicationLost):
            link.send(0x181, b"ab")
