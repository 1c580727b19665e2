"""Slave information interface: the EEPROM's content by code (ETG.2010), from identity, mailboxes and PDOs.

::

    word 0 PDI · 4 alias · 7 checksum · 8 vendor · 10 product · 12 revision · 14 serial · 24 mailboxes · 28 protocols
         62 size · 64 categories: type, length in words, content; FFFFh ends them
"""

from collections.abc import Sequence
from struct import pack, pack_into
from typing import NamedTuple

STRINGS, GENERAL, FMMUS, SYNC_MANAGERS, INPUTS, OUTPUTS, END = 10, 30, 40, 41, 50, 51, 0xFFFF
SIZE = 2048
_COE = 0x0004
_COE_DETAILS = 0b00001101
"""Supported: SDO, PDO assignment and PDO configuration. Not supported: SDO information, complete access."""


class Area(NamedTuple):
    """Buffer of a SyncManager. ``kind``: 1 and 2 mailbox, 3 outputs, 4 inputs."""

    start: int
    length: int
    control: int
    kind: int


class SiiPdo(NamedTuple):
    """One PDO of a SyncManager. ``entries``: index << 16 | subindex << 8 | bits, and the data type."""

    number: int
    manager: int
    entries: Sequence[tuple[int, int]]


def checksum(head: bytes) -> int:
    """Return the checksum of words 0 to 6: CRC-8, polynomial x⁸ + x² + x + 1, initial value FFh."""
    crc = 0xFF
    for byte in head[:14]:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (0x07 if crc & 0x80 else 0)) & 0xFF
    return crc


def eeprom(identity: Sequence[int], alias: int, name: str, areas: Sequence[Area], pdos: Sequence[SiiPdo]) -> bytes:
    """Return the EEPROM of a slave. ``identity``: vendor, product, revision, serial; ``areas``: SM0 to SM3."""
    words = bytearray(0x80)
    pack_into("<HHHHH", words, 0, 0x0C05, 0, 0, 0, alias)
    words[14] = checksum(bytes(words[:14]))
    pack_into("<4I", words, 16, *identity)
    pack_into("<5H", words, 48, *areas[0][:2], *areas[1][:2], _COE)
    pack_into("<HH", words, 124, SIZE * 8 // 1024 - 1, 1)
    text = name.encode("ascii", "replace")[:255]
    general = bytearray(32)
    general[2], general[3], general[5], general[16] = 1, 1, _COE_DETAILS, 0x01       # port 0 is MII
    content = bytes(words) + _category(STRINGS, bytes((1, len(text))) + text) + _category(GENERAL, bytes(general))
    content += _category(FMMUS, bytes((1, 2)))
    content += _category(SYNC_MANAGERS, b"".join(pack("<HHBBBB", *one[:3], 0, 1, one.kind) for one in areas))
    for kind, manager in ((INPUTS, 3), (OUTPUTS, 2)):
        packed = b""
        for pdo in pdos:
            if pdo.manager == manager:
                packed += pack("<HBBBBH", pdo.number, len(pdo.entries), manager, 0, 0, 0)
                packed += b"".join(pack("<HBBBBH", one >> 16, one >> 8 & 0xFF, 0, data_type, one & 0xFF, 0)
                                   for one, data_type in pdo.entries)
        content += _category(kind, packed)
    return (content + pack("<HH", END, END)).ljust(SIZE, b"\xff")


def _category(kind: int, content: bytes) -> bytes:
    content += b"\0" * (len(content) % 2)
    return pack("<HH", kind, len(content) // 2) + content
