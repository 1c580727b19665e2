"""Reported-signal filters, read from the objects that a profile names."""

import math
import struct

import pytest

from drivers.canopen.bus import CanLink
from drivers.canopen.sdo import SdoObjects
from drivers.cia402.preflight import lag_seconds, read_filters
from drivers.clock import SteppedClock
from drivers.errors import ObjectRefused
from profiles.canopen import ReportingFilter


def entry(signal="speed", index=0x2504, kind="u16", quantity="time_constant_s", per_lsb=0.001):
    return ReportingFilter(
        signal=signal, index=index, type=kind, quantity=quantity, per_lsb=per_lsb, source="manual", confidence="likely"
    )


@pytest.mark.parametrize(("kind", "data"), [
    ("u8", "c8"), ("u16", "c800"), ("u32", "c8000000"), ("i16", "c800"), ("i32", "c8000000"), ("f32", "00004843"),
])
def test_types(kind, data):
    assert lag_seconds(entry(kind=kind), bytes.fromhex(data)) == pytest.approx(0.2)


def test_a_cut_off_frequency():
    assert lag_seconds(entry(quantity="cutoff_hz", per_lsb=0.1), b"\x0a\x00") == pytest.approx(1.0 / (2.0 * math.pi))
    assert lag_seconds(entry(quantity="cutoff_hz"), b"\0\0") == 0.0


@pytest.mark.parametrize(("kind", "data"), [
    ("i16", b"\xff\xff"), ("f32", struct.pack("<f", math.nan)), ("f32", struct.pack("<f", math.inf)), ("u32", b"\1\0"),
])
def test_invalid_filter_settings(kind, data):
    with pytest.raises(ObjectRefused) as caught:
        lag_seconds(entry(kind=kind), data)
    assert caught.value.where == "2504h"


def test_reading(wire, peer, profile):
    peer.objects[0x2504, 0] = b"\x90\x01"
    speed, torque = entry(), entry("torque", 0x2505)
    notes = []
    found = read_filters(
        lambda *row: notes.append(row), SdoObjects(CanLink(wire, SteppedClock()), 1),
        profile.model_copy(update={"filters": (speed, torque)}),
    )
    assert (found.speed_lag_s, found.torque_lag_s) == (pytest.approx(0.4), None)
    assert "2504h" in found.source
    assert notes == [
        ("speed filter", "400 ms", "2504h"), ("torque filter", "not reported by the drive", "2505h"),
    ]
