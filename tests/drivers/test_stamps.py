"""Time stamps of frames and control time: the offset is tracked. A change of the wall clock has no effect."""

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.bus import JUMP_S, FrameStamps
from drivers.clock import MonotonicClock
from drivers.drive import Command, Mode
from tests.drivers.on_wire import prepared
from tests.rigs import DRIVE_LIMITS

WALL_S = 1.7e9


def feed(stamps, wall_s, frames, begin_s=0.0, every_s=0.01, late_s=lambda k: 0.0):
    now_s = begin_s
    for k in range(frames):
        stamps.take(wall_s + now_s - late_s(k), now_s)
        now_s += every_s
    return now_s


def test_the_offset_is_found_in_spite_of_late_frames():
    stamps = FrameStamps()
    feed(stamps, WALL_S, 500, late_s=lambda k: 0.0 if k % 20 == 7 else 0.3)
    assert stamps.offset_s == pytest.approx(WALL_S, abs=1e-3)
    assert stamps.jumps == 0


@pytest.mark.parametrize("jump_s", [-7200.0, -0.5, 0.5, 3600.0])
def test_a_jump_is_counted_once(jump_s):
    stamps = FrameStamps()
    now_s = feed(stamps, WALL_S, 300)
    feed(stamps, WALL_S + jump_s, 300, now_s)
    assert stamps.jumps == 1
    assert stamps.offset_s == pytest.approx(WALL_S + jump_s, abs=1e-3)


def test_a_clock_that_is_slewed_is_no_jump():
    """The clock slews for an hour at 500 ppm, the limit of NTP."""
    stamps = FrameStamps()
    for k in range(36_000):
        stamps.take(WALL_S + 0.1 * k * (1 + 5e-4), 0.1 * k)
    assert stamps.jumps == 0
    assert stamps.offset_s == pytest.approx(WALL_S + 1.8, abs=0.01)


def test_a_host_that_slept_takes_its_old_frames_for_no_jump():
    stamps = FrameStamps()
    now_s = feed(stamps, WALL_S, 300)
    for k in range(1000):                      # frames of ten seconds, all read at once
        stamps.take(WALL_S + now_s + 0.01 * k, now_s + 10.0 + 1e-5 * k)
    feed(stamps, WALL_S, 300, now_s + 10.02)
    assert stamps.jumps == 0


@given(st.lists(st.floats(0.0, 1e8)))
def test_stamps_that_are_no_wall_clocks_are_left_alone(stamped):
    stamps = FrameStamps()
    for k, stamp_s in enumerate(stamped):
        stamps.take(stamp_s, 0.1 * k)
    assert (stamps.offset_s, stamps.jumps) == (None, 0)


@pytest.mark.heavy
@settings(max_examples=50)
@given(st.lists(st.floats(0.0, 0.9 * JUMP_S), min_size=100, max_size=300))
def test_no_delay_below_the_bound_is_a_jump(late_s):
    stamps = FrameStamps()
    feed(stamps, WALL_S, len(late_s), late_s=lambda k: late_s[k])
    assert stamps.jumps == 0


def turned(peer, wire, profile, wall_of):
    """Return the samples of 1000 cycles in fake real time. ``wall_of`` gives the wall clock."""
    receive = wire.recv

    def stamped(timeout=0.0):
        message = receive(timeout)
        if isinstance(message, can.Message):
            message.timestamp = wall_of(wire.time.now_s)
        return message

    wire.recv = stamped
    drive = prepared(wire, profile, DRIVE_LIMITS, MonotonicClock())
    # The scripted drive has no heartbeat.
    drive._bus.watch.allowed_silence_s = 0.0
    samples = [drive.exchange(Command(Mode.SPEED, 0.0, 0.0)) for _ in range(1000)]
    return samples, drive.counters


def test_a_wall_clock_that_is_set_changes_no_sample(fake_time, profile):
    from tests.drivers.scripted_drive import FakeTime, ScriptedBus, ScriptedDrive

    found = []
    for jump_s in (0.0, -3600.0):
        fake_time.now_s = FakeTime().now_s
        wire = ScriptedBus(fake_time)
        begin_s = fake_time.now_s
        peer = ScriptedDrive(wire)
        found.append(turned(peer, wire, profile,
                            lambda now_s, j=jump_s, b=begin_s: WALL_S + now_s + (j if now_s > b + 1.2 else 0.0)))
    (quiet, before), (jumped, after) = found
    assert quiet == jumped
    assert (before.wall_jumps, after.wall_jumps) == (0, 1)
    assert after.wall_offset_s == pytest.approx(before.wall_offset_s - 3600.0, abs=1e-3)
