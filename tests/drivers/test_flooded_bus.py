"""Bus with more frames than the computer can read: the quick stop is still sent at once."""

from contextlib import suppress

import can
import pytest

from drivers.canopen.bus import STOP_DRAIN_S, CanLink
from drivers.canopen.quick_stop import CanopenTarget
from drivers.clock import MonotonicClock, SteppedClock
from drivers.drive import Command, Mode
from drivers.errors import CommunicationLost
from tests.drivers.on_wire import cycles, enabled

READ_S = 0.0001
"""Time to read one frame, s."""
AT_ONCE_S = 4.0 * STOP_DRAIN_S
"""Longest time from the request to the frame with the quick stop, s: some drains, each with its bound."""
QUICK_STOP = bytes.fromhex("2b40600002000000")


def flood(wire):
    """Let each read return a frame of a babbling node, before any reply of the drive."""

    def recv(timeout=0.0):
        wire.time.sleep(READ_S)
        return can.Message(arbitration_id=0x7E0, is_extended_id=False)

    wire.recv = recv


def times(wire):
    """Return a list that gets (time, identifier, data) of each frame sent from now on."""
    sent, on_send = [], wire.on_send

    def note(identifier, data):
        sent.append((wire.time.now_s, identifier, data))
        on_send(identifier, data)

    wire.on_send = note
    return sent


@pytest.fixture
def running(wire, peer, profile):
    drive = enabled(wire, profile, clock=MonotonicClock())
    cycles(drive, wire, 100, Command(Mode.SPEED, 0.0, 0.0))
    return drive


def test_before_the_stop_it_ends_the_run(running, wire):
    flood(wire)
    with pytest.raises(CommunicationLost, match="faster than this computer can read"):
        running.exchange(Command(Mode.SPEED, 0.0, 0.0))


def test_in_a_stop_each_cycle_sends_the_quick_stop(running, wire):
    flood(wire)
    running.quick_stop()
    sent = times(wire)
    for _ in range(50):
        begun_s = wire.time.now_s
        sent.clear()
        with suppress(CommunicationLost):
            running.exchange(Command(Mode.SPEED, 0.0, 0.0))
        words = [time_s for time_s, identifier, data in sent if identifier == 0x201 and data[:2] == b"\x02\0"]
        syncs = [time_s for time_s, identifier, _ in sent if identifier == 0x080]
        assert words and syncs and max(words[0], syncs[0]) - begun_s < running.period_s + AT_ONCE_S


def test_a_poll_writes_the_quick_stop_before_it_reads(running, wire):
    flood(wire)
    running.quick_stop()
    sent, begun_s = times(wire), wire.time.now_s
    assert running.poll() is None
    requests = [(time_s, data) for time_s, identifier, data in sent if identifier == 0x601]
    assert requests[0][1] == QUICK_STOP
    assert requests[0][0] - begun_s < AT_ONCE_S


def test_the_bare_quick_stop_is_sent(wire, peer, profile):
    peer.machine.state = "operation enabled"
    flood(wire)
    target = CanopenTarget(wire, profile, MonotonicClock(), node=1)
    with pytest.raises(CommunicationLost):
        target.ask(1)
    assert QUICK_STOP in wire.of(0x601)


def test_a_drain_of_a_stop_has_an_end(wire):
    flood(wire)
    link = CanLink(wire, SteppedClock())
    link.stopping, begun_s = True, wire.time.now_s
    link.drain()
    assert wire.time.now_s - begun_s <= STOP_DRAIN_S + 2.5 * READ_S
