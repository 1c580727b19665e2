"""Request and reply PDUs: examples of the specification, and pymodbus as the peer."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.pdu import DecodePDU

from drivers.errors import ObjectRefused, PreflightRefused
from drivers.modbus import pdu
from drivers.modbus.pdu import BadReply, CycleRefused, RegisterRefused, exception_text
from profiles import MessageCode

WORDS = st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=100)
OTHER_SIDE = DecodePDU(True)


def h(text):
    return bytes.fromhex(text)


# Modbus Application Protocol V1.1b3, sections 6.3, 6.4, 6.6, 6.12 and 6.17: request, reply, registers.
EXAMPLES = [
    (pdu.read(3, 0x6B, 3), "03 006b 0003", "03 06 022b 0000 0064", (0x22B, 0, 100)),
    (pdu.read(4, 0x08, 1), "04 0008 0001", "04 02 000a", (10,)),
    (pdu.write_one(1, 3), "06 0001 0003", "06 0001 0003", ()),
    (pdu.write_many(1, (0x0A, 0x102)), "10 0001 0002 04 000a 0102", "10 0001 0002", ()),
    (pdu.read_write(3, 6, 0x0E, (255, 255, 255)), "17 0003 0006 000e 0003 06 00ff 00ff 00ff",
     "17 0c 00fe 0acd 0001 0003 000d 00ff", (0xFE, 0xACD, 1, 3, 13, 255)),
]


@pytest.mark.parametrize(("request_pdu", "bytes_out", "bytes_in", "words"), EXAMPLES)
def test_the_specifications_examples(request_pdu, bytes_out, bytes_in, words):
    assert request_pdu == h(bytes_out)
    assert pdu.words_of(request_pdu, h(bytes_in)) == words
    assert pdu.reply_length(h(bytes_in)) == len(h(bytes_in))
    assert pdu.answers(request_pdu, h(bytes_in))


@given(st.integers(0, 0xFF00), WORDS, st.integers(0, 0xFF00), st.integers(1, 125))
def test_pymodbus_decodes_the_requests(address, words, read_address, count):
    seen = OTHER_SIDE.decode(pdu.write_many(address, words))
    assert (seen.function_code, seen.address, list(seen.registers)) == (16, address, words)
    seen = OTHER_SIDE.decode(pdu.write_one(address, words[0]))
    assert (seen.function_code, seen.address, seen.registers) == (6, address, words[:1])
    seen = OTHER_SIDE.decode(pdu.read(4, read_address, count))
    assert (seen.function_code, seen.address, seen.count) == (4, read_address, count)
    seen = OTHER_SIDE.decode(pdu.read_write(read_address, count, address, words))
    assert (seen.read_address, seen.read_count, seen.write_address, list(seen.write_registers)) == (
        read_address, count, address, words,
    )


@pytest.mark.parametrize("code", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("request_pdu", [entry[0] for entry in EXAMPLES])
def test_exceptions_are_typed_and_named(request_pdu, code):
    reply = bytes((request_pdu[0] | 0x80, code))
    assert pdu.reply_length(reply) == 2
    with pytest.raises(RegisterRefused) as caught:
        pdu.words_of(request_pdu, reply, "register 5")
    assert caught.value.code == code
    assert exception_text(code) in caught.value.what
    assert caught.value.where == "register 5"
    assert caught.value.next_step
    assert isinstance(caught.value, ObjectRefused)
    assert isinstance(caught.value, PreflightRefused)
    assert CycleRefused(code, "there").next_step


@given(st.sampled_from([entry[0] for entry in EXAMPLES]), st.binary(max_size=20))
def test_no_random_bytes_are_accepted_as_a_reply(request_pdu, reply):
    count = {3: 3, 4: 1, 6: 0, 16: 0, 23: 6}[request_pdu[0]]
    try:
        words = pdu.words_of(request_pdu, reply)
    except (BadReply, RegisterRefused):
        return
    assert len(words) == count
    assert reply[0] == request_pdu[0]
    assert len(reply) == (2 + 2 * count if count else 5)


@pytest.mark.parametrize(("request_pdu", "bytes_out", "bytes_in", "words"), EXAMPLES)
def test_a_flipped_bit_in_the_header_is_found(request_pdu, bytes_out, bytes_in, words):
    good = h(bytes_in)
    head = len(good) if not words else 2
    for bit in range(8 * head):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        with pytest.raises((BadReply, RegisterRefused)):
            pdu.words_of(request_pdu, bytes(bad))
    for short in range(len(good)):
        with pytest.raises((BadReply, RegisterRefused)):
            pdu.words_of(request_pdu, good[:short])


@pytest.mark.parametrize(("address", "count"), [(0, 0), (0, 126), (0xFFFF, 2), (-1, 1)])
def test_invalid_read_requests(address, count):
    with pytest.raises(ValueError, match="not possible in one request"):
        pdu.read(3, address, count)


def test_the_count_of_requests_is_that_of_the_drive():
    """Section 6.8: the reply has function and sub-function, then the count."""
    asked = pdu.count_requests()
    assert asked == h("08 000e 0000")
    assert pdu.words_of(asked, h("08 000e a537")) == (0xA537,)
    for other in ("08 000d a537", "08 010e a537", "08 000e a5", "08 000e a537 00", "08"):
        with pytest.raises(BadReply, match="to diagnostics"):
            pdu.words_of(asked, h(other))


@pytest.mark.parametrize("made", [
    lambda: pdu.write_many(0xFFFF, (1, 2)), lambda: pdu.write_many(0, ()), lambda: pdu.write_many(0, (0,) * 124),
    lambda: pdu.read_write(0, 126, 0, (1,)), lambda: pdu.read_write(0, 1, 0xFFFF, (1, 2)),
    lambda: pdu.read_write(0, 1, 0, (0,) * 122),
])
def test_invalid_write_requests(made):
    with pytest.raises(ValueError, match="not possible in one request"):
        made()


def test_each_fault_of_a_line_has_its_own_message():
    errors = (pdu.NoReply, BadReply, pdu.LinkLost)
    assert [one.entry for one in errors] == [MessageCode.NO_REPLY, MessageCode.BAD_REPLY, MessageCode.LINK_LOST]
