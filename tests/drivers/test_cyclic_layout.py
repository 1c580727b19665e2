"""Common code of both CiA 402 buses, against bytes typed by hand: places of values in cyclic data, and SDO messages."""

import pytest

from drivers.cia402.mapping import CyclicLayout
from drivers.cia402.sdo_client import SdoClient
from drivers.cia402.sdo_message import is_answer, uploaded
from drivers.errors import CommunicationLost, ObjectRefused

WORD, STATUS, TORQUE, SPEED, MODE = (0x6040, 0, 16), (0x6041, 0, 16), (0x6077, 0, 16), (0x60FF, 0, 32), (0x6060, 0, 8)
GAP, OTHER, BIT = (0, 0, 8), (0x6064, 0, 32), (0x2000, 1, 1)


@pytest.mark.parametrize(("mapped", "data"), [
    ((WORD, SPEED), "0f00feffffff"),
    ((SPEED, WORD), "feffffff0f00"),
    ((GAP, OTHER, WORD, MODE, SPEED, GAP), "0000000000" "0f00" "0a" "feffffff" "00"),
    ((WORD, BIT, BIT, SPEED), "0f00" "0000000000"),                  # SPEED is on no whole byte: no place
    ((SPEED, SPEED, WORD), "feffffff" "00000000" "0f00"),            # the first place counts
])
def test_setpoints_in_any_order(mapped, data):
    layout = CyclicLayout(mapped, (WORD, SPEED, MODE, None))
    assert layout.pack((0x000F, -2, 10, 0)).hex() == data
    assert layout.size == len(data) // 2


def test_values_of_any_order_and_type():
    layout = CyclicLayout((GAP, TORQUE, STATUS), (STATUS, TORQUE, SPEED, None))
    assert layout.unpack(bytes.fromhex("ff" "feff" "37ff")) == (0xFF37, -2, None, None)
    number = (0x2000, 0, 32)
    assert CyclicLayout((number,), (number,), {number: "f32"}).unpack(bytes.fromhex("0000c03f")) == (1.5,)
    assert CyclicLayout((number,), (number,), {number: "u32"}).unpack(b"\xff" * 4) == (0xFFFFFFFF,)


def test_an_object_of_another_length_has_no_place():
    layout = CyclicLayout(((0x6041, 0, 8), TORQUE), (STATUS, TORQUE))
    assert layout.missing((STATUS, TORQUE)) == ["6041h"]


class Client(SdoClient):
    """Client whose drive gives these replies."""

    def __init__(self, *answers, normal):
        super().__init__(0.5, (3, 1), normal=normal, drive="node 5")
        self.answers, self.asked, self.told = list(answers), [], []

    def tell(self, message):
        self.told.append(message.hex())

    def call(self, request, where, answer_s, tries):
        self.asked.append((request.hex(), tries))
        answer = bytes.fromhex(self.answers.pop(0))
        assert is_answer(request, answer[:8])
        return answer


def test_a_long_write_goes_in_segments_of_seven():
    client = Client("6008100000000000", "2000000000000000", "3000000000000000", normal=False)
    client.write_bytes(0x1008, 0, b"ABCDEFGHIJ")
    assert [data for data, _ in client.asked] == ["210810000a000000", "0041424344454647", "1948494a00000000"]


def test_a_normal_transfer_has_its_data_behind_the_first_eight_bytes():
    client = Client("6008100000000000", normal=True)
    client.write_bytes(0x1008, 0, b"ABCDEFGHIJ")
    assert client.asked == [("210810000a000000" "4142434445464748494a", 3)]
    assert Client("4108100006000000" "414243444546", normal=True).read_bytes(0x1008) == b"ABCDEF"


@pytest.mark.parametrize("normal", [False, True])
def test_an_announced_length_above_the_limit_is_aborted_at_once(normal):
    client = Client("41081000ffffffff", normal=normal)
    with pytest.raises(CommunicationLost, match="1008h: node 5 announces 4294967295 bytes, and the limit is 1024"):
        client.read_bytes(0x1008)
    assert client.told == ["8008100005000405"] and len(client.asked) == 1
    number = Client("4141600009000000", normal=normal)
    with pytest.raises(CommunicationLost, match="6041h: node 5 announces 9 bytes, and the limit is 8"):
        number.read(0x6041)


@pytest.mark.parametrize(("normal", "parts", "what"), [
    (False, ["0041424344454647", "1041424344454647"] * 100, "sends more than 1024 bytes"),
    (False, ["0e00000000000000"], "without data"),
    (True, ["00" + "41" * 600, "10" + "41" * 600], "sends more than 1024 bytes"),
    (True, ["0e00000000000000"], "without data"),
])
def test_segments_without_an_end_are_aborted(normal, parts, what):
    client = Client("40081000ff030000", *parts, normal=normal)
    with pytest.raises(CommunicationLost, match=what) as caught:
        client.read_bytes(0x1008)
    assert caught.value.entry.code == "TDH-513" and client.told == ["8008100005000405"]


def test_in_motion_an_object_comes_in_one_message():
    client = Client("4108100009000000", normal=False)
    with client.answered_within(0.05), pytest.raises(CommunicationLost, match="while the shaft may turn"):
        client.read_bytes(0x1008)
    assert client.asked == [("4008100000000000", 1)] and client.told == ["8008100005000405"]
    normal = Client("4110600004000000" "01020304", normal=True)
    with normal.answered_within(0.05):
        assert normal.read(0x6010) == 0x04030201
    assert Client("4108100009000000", "0041424344454647", "1b48490000000000", normal=False).read_bytes(0x1008)


@pytest.mark.parametrize("normal", [False, True])
def test_a_read_in_segments(normal):
    client = Client("4108100009000000", "0041424344454647", "1b48490000000000", normal=normal)
    assert client.read_bytes(0x1008) == b"ABCDEFGHI"
    assert client.asked[1:] == [("6000000000000000", 1), ("7000000000000000", 1)]


def test_a_segment_with_the_toggle_of_the_last_one_is_no_answer():
    assert not is_answer(bytes.fromhex("7000000000000000"), bytes.fromhex("0041424344454647"))


def test_a_refusal_names_the_value_or_the_read_request():
    refused = "8072600011000906"
    with pytest.raises(ObjectRefused, match="refused the value 300: Code 0x06090011, Subindex does not exist"):
        Client("4b72600000000000", refused, normal=False).change(0x6072, 0, 300, 16)
    with pytest.raises(ObjectRefused, match="refused the read request: Code 0x06090011"):
        Client(refused, normal=True).read(0x6072)


@pytest.mark.parametrize(("message", "found"), [
    ("4b72600034120000", (0x6072, 0, b"\x34\x12")),
    ("8072600000000206", (0x6072, 0, None)),
    ("4108100009000000", None),                                      # its data are in segments
    ("6072600000000000", None),
    ("4b", None),
])
def test_an_answer_to_any_client(message, found):
    assert uploaded(bytes.fromhex(message)) == found
