"""Messages encoded by hand, compared with their decoding by protobuf."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.drive import Command, Mode, PowerState, RawFrame, Sample
from tdhil.recording.log_format import CLASSES, MESSAGES, MODES, STATES
from tdhil.recording.log_messages import pack_command, pack_frames, pack_sample

NUMBERS = st.floats(width=64)
SAMPLES = st.builds(
    Sample, NUMBERS, NUMBERS, NUMBERS, st.booleans(), NUMBERS, NUMBERS, st.none() | NUMBERS,
    st.none() | st.sampled_from(Mode), st.sampled_from(PowerState),
    st.booleans(), st.booleans(), st.integers(0, 0xFFFF), st.none() | NUMBERS)
FRAMES = st.builds(
    RawFrame, NUMBERS, st.booleans(), st.integers(0, 2**32 - 1), st.binary(max_size=300))


def bits(value):
    return struct.pack("<d", value)


@given(SAMPLES)
def test_sample(sample):
    message = CLASSES["Sample"].FromString(pack_sample(sample))
    for name in ("time_s", "age_s", "half_width_s", "speed_rad_s", "torque_nm"):
        assert bits(getattr(message, name)) == bits(getattr(sample, name))
    for name in ("fresh", "limit_active", "standstill", "status"):
        assert getattr(message, name) == getattr(sample, name)
    assert (message.mode, message.state) == (MODES[sample.mode], STATES[sample.state])
    assert message.HasField("torque_demand_nm") == (sample.torque_demand_nm is not None)
    if sample.torque_demand_nm is not None:
        assert bits(message.torque_demand_nm) == bits(sample.torque_demand_nm)
    assert message.HasField("position_rad") == (sample.position_rad is not None)
    if sample.position_rad is not None:
        assert bits(message.position_rad) == bits(sample.position_rad)
    assert len(message.ListFields()) <= len(MESSAGES["Sample"])
    assert not leftovers(message, pack_sample(sample))


@given(NUMBERS, st.sampled_from(Mode), NUMBERS, NUMBERS)
def test_command(time_s, mode, speed_rad_s, torque_nm):
    packed = pack_command(time_s, Command(mode, speed_rad_s, torque_nm))
    message = CLASSES["Command"].FromString(packed)
    assert bits(message.time_s) + bits(message.speed_rad_s) + bits(message.torque_nm) == (
        bits(time_s) + bits(speed_rad_s) + bits(torque_nm))
    assert message.mode == MODES[mode]
    assert not leftovers(message, packed)


@given(st.lists(FRAMES, min_size=1, max_size=8))
def test_frames(frames):
    packed = pack_frames(frames)
    message = CLASSES["Frames"].FromString(packed)
    assert bits(message.time_s) == bits(frames[0].time_s)
    assert len(message.frames) == len(frames)
    for one, frame in zip(message.frames, frames, strict=True):
        assert bits(one.time_s) == bits(frame.time_s)
        assert (one.outgoing, one.identifier, one.data) == frame[1:]
    assert not leftovers(message, packed)


def leftovers(message, packed):
    """Return the bytes of fields unknown to protobuf."""
    before = message.ByteSize()
    message.DiscardUnknownFields()
    return before - message.ByteSize() or len(packed) < before


def test_numbers_out_of_range_are_refused():
    with pytest.raises(struct.error):
        pack_frames([RawFrame(0.0, True, 2**32, b"")])


def test_field_numbers_of_old_files_are_kept():
    """New fields are added at the end, so that later releases read a log of today."""
    assert list(MESSAGES["Sample"])[:13] == [
        "time_s", "speed_rad_s", "torque_nm", "age_s", "half_width_s", "fresh", "limit_active", "standstill",
        "state", "mode", "status", "torque_demand_nm", "position_rad"]
    assert list(MESSAGES["Segment"])[:8] == [
        "start_s", "end_s", "period_s", "settle_periods", "offset_rad_s", "lines_hz", "amplitudes_rad_s", "phases_rad"]
    assert list(MESSAGES["Stage"])[:5] == ["name", "start_s", "end_s", "outcome", "detail"]
    assert list(MESSAGES["Excitation"])[:3] == ["kind", "mode", "segments"]
