"""The register bank: request PDUs in, reply PDUs out (Modbus application protocol V1.1b3, sections 6.3 to 6.17).

::

    03, 04  address count                                     → bytes, words
    06      address word                                      → the same
    08      000Eh 0 (requests to this drive so far)           → the same, the count
    16      address count bytes words                         → address count
    23      read address count, write address count bytes …   → bytes, words; the writing comes first
    else    exception 1; unknown address 2; bad count or value 3; not now 4

A read takes all registers of one moment. A write checks everything before anything acts.
"""

from collections.abc import Callable, Mapping
from struct import Struct
from typing import NamedTuple

from sim_bus.modbus.errors import IllegalAddress, IllegalFunction, IllegalValue, Refused
from sim_bus.modbus.slots import Slot

_REQUESTS_SO_FAR = 0x000E
_PAIR = Struct(">HH")
_WRITE = Struct(">HHB")
_BOTH = Struct(">HHHHB")


class Answer(NamedTuple):
    """A reply, and what the request did."""

    pdu: bytes
    wrote: bool = False
    commanded: bool = False
    """Wrote to the control word or a setpoint."""


class Bank:
    """What stands at which address, for the functions that the drive knows."""

    def __init__(self, slots: Mapping[tuple[str, int], Slot], functions: tuple[int, ...], written: Callable[[], None],
                 *, largest_read: int, largest_write: int) -> None:
        self._slots = slots
        self._written = written         # lets what has been written take effect
        self._largest_read = largest_read
        self._largest_write = largest_write
        known: dict[int, Callable[[bytes], Answer]] = {
            3: lambda data: Answer(self._read("holding", data)),
            4: lambda data: Answer(self._read("input", data)),
            6: self._write_one,
            8: self._diagnostics,
            16: self._write_many,
            23: self._read_and_write,
        }
        self._asked = 0
        self._known = {code: known[code] for code in {3, *functions}}

    def answer(self, pdu: bytes) -> Answer:
        """The reply to one request; never raises."""
        code = pdu[0] if pdu else 0
        self._asked += 1
        try:
            if code not in self._known:
                raise IllegalFunction
            answer = self._known[code](pdu[1:])
        except Refused as refused:
            return Answer(bytes((code | 0x80, refused.code)))
        return answer._replace(pdu=pdu[:1] + answer.pdu)

    def _diagnostics(self, data: bytes) -> Answer:
        if len(data) != _PAIR.size or _PAIR.unpack(data) != (_REQUESTS_SO_FAR, 0):
            raise IllegalValue
        return Answer(_PAIR.pack(_REQUESTS_SO_FAR, self._asked & 0xFFFF))

    def _read(self, table: str, data: bytes) -> bytes:
        if len(data) != _PAIR.size:
            raise IllegalValue
        address, count = _PAIR.unpack(data)
        if not 1 <= count <= self._largest_read:
            raise IllegalValue
        words = [self._word(table, at) for at in range(address, address + count)]
        return bytes((2 * count,)) + b"".join(word.to_bytes(2, "big") for word in words)

    def _word(self, table: str, address: int) -> int:
        slot = self._slots.get((table, address))
        if slot is None:
            raise IllegalAddress
        return slot.layout.words(slot.read())[address - slot.layout.address]

    def _write_one(self, data: bytes) -> Answer:
        if len(data) != _PAIR.size:
            raise IllegalValue
        address, word = _PAIR.unpack(data)
        return Answer(data, True, self._write(address, [word]))

    def _write_many(self, data: bytes) -> Answer:
        if len(data) < _WRITE.size:
            raise IllegalValue
        address, count, _ = _WRITE.unpack_from(data)
        commanded = self._write(address, self._words_of(data[_WRITE.size - 1 :], count))
        return Answer(data[: _PAIR.size], True, commanded)

    def _read_and_write(self, data: bytes) -> Answer:
        if len(data) < _BOTH.size:
            raise IllegalValue
        read, read_count, write, write_count, _ = _BOTH.unpack_from(data)
        words = self._words_of(data[_BOTH.size - 1 :], write_count)
        self._read("holding", data[: _PAIR.size])      # refused before anything is written
        commanded = self._write(write, words)
        return Answer(self._read("holding", _PAIR.pack(read, read_count)), True, commanded)

    def _words_of(self, data: bytes, count: int) -> list[int]:
        """The words after their byte count."""
        if not 1 <= count <= self._largest_write or data[0] != 2 * count or len(data) != 1 + 2 * count:
            raise IllegalValue
        return [int.from_bytes(data[at : at + 2], "big") for at in range(1, len(data), 2)]

    def _write(self, address: int, words: list[int]) -> bool:
        """Writes registers; True where one of them commands. Half of a 32-bit number leaves the other half."""
        images: dict[int, tuple[Slot, list[int]]] = {}
        for at, word in enumerate(words, address):
            slot = self._slots.get(("holding", at))
            if slot is None or slot.write is None:
                raise IllegalAddress
            first = slot.layout.address
            image = images.setdefault(first, (slot, list(slot.layout.words(slot.read()))))[1]
            image[at - first] = word
        numbers = [(slot, slot.layout.number(tuple(image))) for slot, image in images.values()]
        for slot, number in numbers:
            if slot.refuses is not None:
                slot.refuses(number)
        for slot, number in numbers:
            if slot.write is not None:
                slot.write(number)
        self._written()
        return any(slot.commands for slot, _ in numbers)
