"""Objects over a hand-typed SDO server: requests, aborts, and frames that are no replies."""

import pytest
from canopen.sdo import SdoAbortedError
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.bus import CanLink
from drivers.canopen.sdo import SdoObjects
from drivers.cia402.objects import name
from drivers.cia402.preflight import read_identity
from drivers.cia402.sdo_client import LONGEST_UPLOAD_S
from drivers.cia402.sdo_message import abort_text, is_answer
from drivers.clock import SteppedClock
from drivers.errors import CommunicationLost, ObjectRefused


@pytest.fixture
def objects(wire, peer):
    return SdoObjects(CanLink(wire, SteppedClock()), 1)


def test_bytes_on_the_wire(objects, wire, peer):
    objects.write(0x6072, 0, 300, 16)
    assert objects.read(0x6072) == 300
    assert [data.hex() for data in wire.of(0x601)] == ["2b7260002c010000", "4072600000000000"]


@pytest.mark.parametrize(("bits", "value", "raw"), [
    (8, 10, "0a"), (8, -3, "fd"), (16, -2, "feff"), (32, 70000, "70110100"), (32, -1, "ffffffff"),
])
def test_widths_and_signs(objects, peer, bits, value, raw):
    peer.objects[0x2000, 5] = bytes(bits // 8)
    objects.write(0x2000, 5, value, bits)
    assert peer.objects[0x2000, 5].hex() == raw
    assert objects.read(0x2000, 5, signed=value < 0) == value


@pytest.mark.parametrize("length", [5, 7, 8, 14, 40])
def test_segmented_upload(objects, peer, length):
    peer.objects[0x1008, 0] = bytes(range(length))
    assert objects.read_bytes(0x1008) == bytes(range(length))


@pytest.mark.parametrize("announced", [True, False])
def test_an_endless_upload_is_aborted_in_little_time(objects, peer, wire, fake_time, announced):
    """The scripted drive sends endless segments, each just before the time-out of its request."""
    head = bytes.fromhex("41081000ffff0000" if announced else "4008100000000000")

    def answer(request):
        if request[0] == 0x80:
            return
        wire.put(0x581, head if request[0] == 0x40 else bytes((request[0] & 0x10,)) + b"endless", 0.45)

    wire.on_send = lambda identifier, data: answer(data) if identifier == 0x601 else None
    begin_s = fake_time.now_s
    with pytest.raises(CommunicationLost, match="node 1 announces" if announced else "node 1 sent") as caught:
        objects.read_bytes(0x1008)
    assert caught.value.where == "1008h" and "ended the transfer" in caught.value.what
    assert fake_time.now_s - begin_s < (1.0 if announced else LONGEST_UPLOAD_S + 1.0)
    assert wire.of(0x601)[-1].hex() == ("8008100005000405" if announced else "8008100000000405")
    wire.on_send = peer.on_frame
    assert objects.read(0x1000) == 0x00020192             # client and drive continue to work


def test_the_time_for_an_upload_is_bounded_in_motion_too(objects, peer, wire, fake_time):
    begin_s, sent = fake_time.now_s, len(wire.sent)
    peer.objects[0x2000, 0] = bytes(2000)
    with objects.answered_within(0.05), pytest.raises(CommunicationLost, match="2000 bytes"):
        objects.read(0x2000)
    assert fake_time.now_s - begin_s < 0.05 and len(wire.sent) - sent == 2        # request and abort


def test_the_text_of_an_abort_is_that_of_the_standard():
    for code in (*SdoAbortedError.CODES, 0x12345678):
        assert abort_text(code) == str(SdoAbortedError(code))


@pytest.mark.parametrize("code", [0x06010002, 0x06020000, 0x06090030, 0x08000022])
def test_an_abort_names_object_and_code(objects, peer, code):
    peer.refuse_read[0x6072, 0] = peer.refuse_write[0x1016, 1] = code
    for work, where in ((lambda: objects.read(0x6072), "6072h"), (lambda: objects.write(0x1016, 1, 9, 32), "1016h:1")):
        with pytest.raises(ObjectRefused) as caught:
            work()
        assert caught.value.where == where
        assert f"{code:08X}" in caught.value.what.upper()


def test_a_refused_write_names_the_value(objects, peer):
    peer.refuse_write[0x6072, 0] = 0x06090031
    with pytest.raises(ObjectRefused, match="65000"):
        objects.write(0x6072, 0, 65000, 16)


def test_a_value_too_large_for_the_object_is_refused_without_a_frame(objects, wire):
    with pytest.raises(ObjectRefused) as caught:
        objects.write(0x6072, 0, 70000, 16)
    assert caught.value.where == "6072h"
    assert wire.sent == []


def test_the_absence_of_an_optional_object_is_no_error(objects, peer):
    assert objects.read_if_there(0x6999) is None
    peer.silent = True
    with pytest.raises(CommunicationLost):
        objects.read_if_there(0x6999)


def test_a_silent_node_is_given_up_after_a_bounded_time(objects, peer, wire, fake_time):
    peer.silent = True
    begin_s = fake_time.now_s
    with pytest.raises(CommunicationLost) as caught:
        objects.read(0x1000)
    assert fake_time.now_s - begin_s <= 2.0
    requests = [data for data in wire.of(0x601) if data[0] != 0x80]
    assert 1 < len(requests) <= 5
    assert caught.value.where == "1000h"
    assert "node 1" in caught.value.what
    assert "bit rate" in caught.value.next_step


def test_a_lost_reply_is_requested_again(objects, peer, wire):
    lost = [True]

    def lose(request):
        peer.silent = bool(lost)

    wire.on_send = lambda identifier, data: None if lost and lost.pop() else peer.on_frame(identifier, data)
    assert objects.read(0x6076) == 1_000_000


RUBBISH = [
    "", "00", "43", "4300100092010200ff"[:14],          # short
    "ffffffffffffffff", "0000000000000000", "e0e0e0e0e0e0e0e0",
    "4376600001000000",                                   # the reply to a foreign read of 6076h
    "6072600000000000",                                   # to a foreign write of 6072h
    "8076600000000206",                                   # to a foreign abort
]


@pytest.mark.parametrize("rubbish", RUBBISH)
def test_invalid_frames_are_not_accepted_as_the_reply(objects, wire, peer, rubbish):
    peer.before_answer = lambda request: wire.put(0x581, bytes.fromhex(rubbish))
    assert objects.read(0x1000) == 0x00020192
    peer.before_answer = lambda request: wire.put(0x581, bytes.fromhex(rubbish))
    objects.write(0x1006, 0, 4000, 32)
    assert peer.value(0x1006) == 4000


@pytest.mark.parametrize("old", ["6072600000000000", "4f00100007000000"])
def test_an_answer_that_comes_after_its_time_out_is_dropped(objects, wire, peer, old):
    """It may have the same object: it is on the bus before the new request."""
    wire.put(0x581, bytes.fromhex(old))
    assert objects.read(0x1000) == 0x00020192
    wire.put(0x581, bytes.fromhex("6072600000000000"))
    peer.silent = True
    with pytest.raises(CommunicationLost):
        objects.write(0x6072, 0, 1, 16)


@settings(deadline=None)
@given(st.binary(max_size=9), st.sampled_from(["40", "23", "60", "70", "00"]))
def test_only_eight_bytes_of_the_right_kind_are_an_answer(frame, command):
    request = bytes.fromhex(command + "72600000000000")
    answer = is_answer(request, frame)
    if answer:
        assert len(frame) == 8
        kinds = {"40": range(0x40, 0x60), "23": range(0x60, 0x80), "60": range(0x20), "70": range(0x20),
                 "00": range(0x20, 0x40)}
        assert frame[0] == 0x80 or frame[0] in kinds[command]


def test_change_and_restore(objects, peer):
    assert objects.change(0x6072, 0, 500, 16) == 500        # 900 before
    assert objects.change(0x6080, 0, 100, 32) == 100        # as it was: not written
    assert objects.change(0x6085, 0, 70, 32) == 70          # 50 before
    assert objects.change(0x6072, 0, 600, 16) == 600
    peer.writes.clear()
    assert objects.restore() == ()
    assert peer.writes == [(0x6085, 0, bytes.fromhex("32000000")), (0x6072, 0, bytes.fromhex("8403"))]
    peer.writes.clear()
    assert objects.restore() == ()
    assert peer.writes == []


def test_a_change_that_is_not_stored_is_found(objects, peer):
    peer.deaf_to.add((0x6072, 0))
    assert objects.change(0x6072, 0, 500, 16) == 900


def test_a_negative_option_code_reads_back_as_itself(objects, peer):
    assert objects.change(0x605A, 0, -1, 16) == -1
    objects.restore()
    assert peer.value(0x605A) == 2


def test_restore_continues_after_a_refusal_and_reports_it(objects, peer):
    objects.change(0x6072, 0, 500, 16)
    objects.change(0x6085, 0, 70, 32)
    peer.refuse_write[0x6085, 0] = 0x08000022
    failed = objects.restore()
    assert len(failed) == 1
    assert "6085h" in failed[0]
    assert peer.value(0x6072) == 900


def test_restore_to_a_silent_drive_ends(objects, peer, fake_time):
    objects.change(0x6072, 0, 500, 16)
    objects.change(0x6085, 0, 70, 32)
    peer.silent = True
    begin_s = fake_time.now_s
    assert len(objects.restore()) == 1
    assert fake_time.now_s - begin_s < 2.0


def test_names():
    assert (name(0x6040), name(0x1016, 1), name(0x1A00, 0)) == ("6040h", "1016h:1", "1A00h")


def test_the_software_version_is_read_where_the_drive_has_it(objects, peer):
    assert read_identity(objects).firmware == ""
    peer.objects[0x100A, 0] = b"V2.1 build 7 \0"
    assert read_identity(objects).firmware == "V2.1 build 7"
    peer.objects.pop((0x1008, 0))
    assert read_identity(objects).name == "CiA 402 drive"
