"""The pure register codec against `struct`, over the whole range of every type."""

import math
import struct
from types import SimpleNamespace

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from drivers.errors import CommandRejected
from drivers.modbus.codec import RANGES, from_words, register_name, settle, to_counts, to_words
from profiles.modbus import Register

FORMATS = {"u16": ">H", "i16": ">h", "u32": ">I", "i32": ">i"}
ORDERS = ("high_first", "low_first")


@st.composite
def numbers(draw):
    kind = draw(st.sampled_from(sorted(FORMATS)))
    bits = 8 * struct.calcsize(FORMATS[kind])
    low = -(1 << bits - 1) if kind[0] == "i" else 0
    number = draw(st.integers(low, low + (1 << bits) - 1) | st.sampled_from([low, low + (1 << bits) - 1, 0, 1]))
    return kind, number


@given(numbers(), st.sampled_from(ORDERS))
def test_words_are_the_bytes_of_struct(drawn, order):
    kind, number = drawn
    data = struct.pack(FORMATS[kind], number)
    wanted = [int.from_bytes(data[k : k + 2], "big") for k in range(0, len(data), 2)]
    if order == "low_first":
        wanted.reverse()
    assert list(to_words(number, kind, order)) == wanted
    assert from_words(wanted, kind, order) == number


@given(st.lists(st.integers(0, 0xFFFF), min_size=2, max_size=2), st.sampled_from(ORDERS))
def test_every_pattern_of_words_survives_a_round_trip(words, order):
    for kind in ("u32", "i32"):
        assert list(to_words(from_words(words, kind, order), kind, order)) == words
    for kind in ("u16", "i16"):
        assert list(to_words(from_words(words[:1], kind, order), kind, order)) == words[:1]


@pytest.mark.parametrize("kind", sorted(FORMATS))
def test_one_beyond_the_range_is_rejected(kind):
    low, high = RANGES[kind]
    for number in (low - 1, high + 1):
        with pytest.raises(CommandRejected):
            to_words(number, kind, "high_first")


@given(st.sampled_from(sorted(FORMATS)), st.floats(1e-6, 1e3), st.floats(-1e12, 1e12))
def test_counts_are_rounded_to_the_nearest(kind, per_lsb, value):
    register = Register(address=1, type=kind)
    low, high = RANGES[kind]
    counts = value / per_lsb
    assume(not (low - 1 < counts < low) and not (high < counts < high + 1))     # the result depends on rounding here
    if low <= counts <= high:
        found = to_counts(value, per_lsb, register, "here")
        assert low <= found <= high
        assert abs(found * per_lsb - value) <= 0.5 * per_lsb * (1.0 + 1e-9) + 1e-9 * abs(value)
    else:
        with pytest.raises(CommandRejected) as caught:
            to_counts(value, per_lsb, register, "here")
        assert caught.value.where == "here"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, -1e300])
def test_a_value_that_is_no_number_is_rejected(value):
    with pytest.raises(CommandRejected):
        to_counts(value, 1.0, Register(address=1, type="i32"), "here")


def test_names():
    assert register_name(Register(address=99, reference="40100")) == "register 99 (40100)"
    assert register_name(Register(address=7, table="input")) == "input register 7"


def test_a_setting_whose_factor_comes_later_in_the_file_is_found():
    first, second = (SimpleNamespace(name=name, per_lsb=per_lsb, factor=factor)
                     for name, per_lsb, factor in (("ramp", 0.01, "speed"), ("speed", 0.1, None)))
    both = SimpleNamespace(parameters=(first, second))
    assert settle(both, {"ramp": 50, "speed": 200}, {}) == {"speed": 20.0, "ramp": 10.0}
    assert settle(both, {"ramp": 50}, {"speed": 30.0}) == {"speed": 30.0, "ramp": 15.0}
    assert settle(both, {"ramp": 50}, {}) == {}
