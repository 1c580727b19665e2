"""Pure codec, against bytes calculated by hand."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.pdo import STANDARD, Slow, consumer_heartbeat
from drivers.canopen.pdo_mapping import layout
from drivers.cia402.mapping import mapping_entry
from drivers.cia402.process_data import Units, encode_speed, encode_torque
from drivers.errors import CommandRejected
from profiles.canopen import STANDARD_POSITION

RPM = math.pi / 30.0
PLAIN = Units(0.1 * RPM, 1.0)       # 0.1 rpm; 1 ‰ of 1000 N·m
sizes = st.floats(1e-9, 1e6)
relaxed = settings(deadline=None)


@relaxed
@given(st.integers(-(2**31), 2**31 - 1), sizes, st.floats(-0.499, 0.499))
def test_speed_round_trip(count, lsb, beside):
    value = (count + beside * (abs(count) < 2**31 - 1)) * lsb
    assert abs(encode_speed(value, Units(lsb, 1.0)) * lsb - value) <= 0.5 * lsb * (1 + 1e-6)


@relaxed
@given(st.integers(-(2**15), 2**15 - 1), sizes, st.floats(-0.499, 0.499))
def test_torque_round_trip(count, lsb, beside):
    raw = encode_torque((count + beside) * lsb, Units(1.0, lsb))
    assert raw == count


@relaxed
@given(st.floats().filter(lambda x: not abs(x) < 3e9))
def test_values_out_of_range_are_rejected(value):
    """NaN and infinities are rejected too."""
    with pytest.raises(CommandRejected) as caught:
        encode_speed(value, Units(1.0, 1.0))
    assert "60FFh" in caught.value.where
    with pytest.raises(CommandRejected) as caught:
        encode_torque(value, Units(1.0, 1.0))
    assert "6071h" in caught.value.where


@pytest.mark.parametrize(("encode", "lowest", "highest"), [
    (encode_speed, -2147483648, 2147483647), (encode_torque, -32768, 32767),
])
def test_the_edges(encode, lowest, highest):
    one = Units(1.0, 1.0)
    assert encode(lowest, one) == lowest
    assert encode(highest, one) == highest
    for beyond in (lowest - 1, highest + 1):
        with pytest.raises(CommandRejected):
            encode(float(beyond), one)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nan_never_becomes_a_count(value):
    for encode in (encode_speed, encode_torque):
        with pytest.raises(CommandRejected, match="not finite"):
            encode(value, PLAIN)


def test_known_counts():
    assert encode_speed(100.0 * RPM, PLAIN) == 1000
    assert encode_speed(-5.0, PLAIN) == -477              # 5 rad/s = 47.746 rpm
    assert encode_torque(-250.0, PLAIN) == -250


def test_bytes_of_the_cyclic_frames():
    # 6040h = 000Fh · 6071h = -2 ‰ · 60FFh = 100 000
    assert STANDARD.rpdo1.pack((0x000F, -2, 100_000, 0, 0)).hex() == "0f00feffa0860100"
    # 6041h = 1237h · 6077h = 300 ‰ · 606Ch = -1
    assert STANDARD.feedback.unpack(bytes.fromhex("37122c01ffffffff")) == (0x1237, 300, -1)
    assert STANDARD.rpdo2.pack((0, 0, 0, -1, 0)).hex() == "ff"
    assert Slow().unpack(b"\x0a") == (10, None, None)
    assert Slow(demand=True).unpack(bytes.fromhex("0a18fc")) == (10, -1000, None)
    assert Slow(demand=True, position=STANDARD_POSITION).unpack(bytes.fromhex("0a18fcfeffffff")) == (10, -1000, -2.0)
    assert Slow(position=STANDARD_POSITION).unpack(bytes.fromhex("0affffff7f")) == (10, None, 2147483647.0)


@relaxed
@given(st.integers(0, 0xFFFF), st.integers(-(2**15), 2**15 - 1), st.integers(-(2**31), 2**31 - 1))
def test_bytes_of_any_frame(word, torque, speed):
    by_hand = bytes([word & 255, word >> 8]) + torque.to_bytes(2, "little", signed=True)
    by_hand += speed.to_bytes(4, "little", signed=True)
    assert STANDARD.rpdo1.pack((word, torque, speed, 0, 0)) == by_hand
    assert STANDARD.feedback.unpack(by_hand) == (word, torque, speed)


def test_mapping_entries():
    entries = [[f"{mapping_entry(mapped):08X}" for mapped in pdo.mapped] for pdo in layout(Slow(demand=True))]
    assert entries == [
        ["60400010", "60710010", "60FF0020"],
        ["60410010", "60770010", "606C0020"],
        ["60600008"],
        ["60610008", "60740010"],
    ]
    assert [mapping_entry(mapped) for mapped in layout(Slow())[3].mapped] == [0x60610008]
    angle = Slow(demand=True, position=STANDARD_POSITION)
    assert [mapping_entry(mapped) for mapped in layout(angle)[3].mapped] == [0x60610008, 0x60740010, 0x60640020]


def test_mapping_and_frames_are_of_one_length():
    for slow in (Slow(), Slow(demand=True), Slow(position=STANDARD_POSITION), Slow(True, STANDARD_POSITION)):
        check_lengths(slow)


def check_lengths(slow):
    structs = [STANDARD.rpdo1, STANDARD.feedback, STANDARD.rpdo2, slow]
    for pdo, codec in zip(layout(slow), structs, strict=True):
        assert sum(mapping_entry(mapped) & 0xFF for mapped in pdo.mapped) == 8 * codec.size


def test_consumer_heartbeat():
    assert consumer_heartbeat(127, 500) == 0x007F01F4
    assert consumer_heartbeat(1, 65535) == 0x0001FFFF
