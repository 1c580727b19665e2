"""Slave information interface: the EEPROM's content by code (ETG.2010), from identity, mailboxes and PDOs.

::

    word 0 PDI · 4 alias · 7 checksum · 8 vendor · 10 product · 12 revision · 14 serial · 24 mailboxes · 28 protocols
         62 size · 64 categories: type, length in words, content; FFFFh ends them
"""

from collections.abc import Sequence
from dataclasses import dataclass

STRINGS, GENERAL, FMMUS, SYNC_MANAGERS, INPUTS, OUTPUTS, END = 10, 30, 40, 41, 50, 51, 0xFFFF
SIZE = 2048
_COE = 0x0004
_COE_DETAILS = 0b00001111
"""SDO, SDO information, PDO assignment and PDO configuration; no complete access."""


@dataclass(frozen=True)
class Area:
    """Buffer of a SyncManager. ``kind``: 1 and 2 mailbox, 3 outputs, 4 inputs."""

    start: int
    length: int
    control: int
    kind: int


@dataclass(frozen=True)
class PdoEntry:
    """One entry of a PDO."""

    index: int
    subindex: int
    data_type: int
    bits: int


@dataclass(frozen=True)
class Pdo:
    """One PDO of a SyncManager."""

    index: int
    manager: int
    entries: Sequence[PdoEntry]


def checksum(head: bytes) -> int:
    """Return the checksum of words 0 to 6: CRC-8, polynomial x⁸ + x² + x + 1, initial value FFh."""
    crc = 0xFF
    for byte in head[:14]:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (0x07 if crc & 0x80 else 0)) & 0xFF
    return crc


def eeprom(identity: tuple[int, int, int, int], alias: int, name: str, areas: Sequence[Area],
           pdos: Sequence[Pdo]) -> bytes:
    """Return the EEPROM of a slave. ``identity``: vendor, product, revision, serial; ``areas``: SM0 to SM3."""
    words = bytearray(0x80)
    _put(words, 0, 0x0C05)
    _put(words, 4, alias)
    _put(words, 7, checksum(bytes(words[:14])))
    for number, value in enumerate(identity):
        words[16 + 4 * number:20 + 4 * number] = value.to_bytes(4, "little")
    for number, area in enumerate(areas[:2]):
        _put(words, 24 + 2 * number, area.start)
        _put(words, 25 + 2 * number, area.length)
    _put(words, 28, _COE)
    _put(words, 62, SIZE * 8 // 1024 - 1)
    _put(words, 63, 1)
    text = name.encode("ascii", "replace")[:255]
    content = bytes(words) + _category(STRINGS, bytes((1, len(text))) + text)
    general = bytearray(32)
    general[2] = general[3] = 1
    general[5] = _COE_DETAILS
    general[16] = 0x01                  # port 0 is MII
    content += _category(GENERAL, bytes(general)) + _category(FMMUS, bytes((1, 2)))
    content += _category(SYNC_MANAGERS, b"".join(_manager(area) for area in areas))
    for kind, manager in ((INPUTS, 3), (OUTPUTS, 2)):
        content += _category(kind, b"".join(_pdo(pdo) for pdo in pdos if pdo.manager == manager))
    return (content + END.to_bytes(2, "little") * 2).ljust(SIZE, b"\xff")


def _put(words: bytearray, number: int, value: int) -> None:
    words[2 * number:2 * number + 2] = value.to_bytes(2, "little")


def _category(kind: int, content: bytes) -> bytes:
    content += b"\0" * (len(content) % 2)
    return kind.to_bytes(2, "little") + (len(content) // 2).to_bytes(2, "little") + content


def _manager(area: Area) -> bytes:
    place = area.start.to_bytes(2, "little") + area.length.to_bytes(2, "little")
    return place + bytes((area.control, 0, 1, area.kind))


def _pdo(pdo: Pdo) -> bytes:
    entries = b"".join(
        one.index.to_bytes(2, "little") + bytes((one.subindex, 0, one.data_type, one.bits, 0, 0)) for one in pdo.entries
    )
    return pdo.index.to_bytes(2, "little") + bytes((len(pdo.entries), pdo.manager, 0, 0, 0, 0)) + entries
