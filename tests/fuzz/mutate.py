"""Seeded inputs made from valid ones: flips, cuts, splices, and changes specific to the kind of file.

A mutation of plain bytes rarely passes a checksum or a scanner. So text is changed by lines, keys and values too,
and an MCAP file by the messages inside its chunks, with corrected lengths and checksums.
"""

import random
import re
import struct
import zlib
from collections.abc import Callable, Sequence

import zstandard

LARGEST = 64 * 1024
NUMBERS = [b"0", b"-1", b"1e308", b"-1e400", b".nan", b"nan", b"inf", b"-.inf", b"1_000", b"0x10", b"010", b"1,5",
           b"1e3", b"99999999999999999999999999", b"0.0000000000000000000001", b"-0", b"2147483648", b"''", b"1.",
           b"--1"]
Mutation = Callable[[bytearray, random.Random, Sequence[bytes]], bytes]


def flip(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    for _ in range(rng.choice((1, 1, 2, 8))):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def overwrite(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    if data:
        start = rng.randrange(len(data))
        count = rng.choice((1, 2, 4, 8))
        data[start:start + count] = rng.choice((b"\0" * count, b"\xff" * count, rng.randbytes(count)))
    return bytes(data)


def cut(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    return bytes(data[:rng.randrange(len(data) + 1)])


def remove(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    start = rng.randrange(len(data) + 1)
    del data[start:start + rng.choice((1, 2, 8, 64, 512))]
    return bytes(data)


def repeat(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    start = rng.randrange(len(data) + 1)
    part = data[start:start + rng.choice((1, 4, 32, 256))]
    return bytes(data[:start] + part * rng.choice((1, 2, 30)) + data[start:])


def splice(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    start = rng.randrange(len(other) + 1)
    at = rng.randrange(len(data) + 1)
    length = rng.choice((8, 64, len(other)))
    return bytes(data[:at] + other[start:start + length] + data[at + rng.choice((0, length)):])


def lines(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    rows = bytes(data).split(b"\n")
    at = rng.randrange(len(rows))
    how = rng.randrange(5)
    if how == 0:
        del rows[at]
    elif how == 1:
        rows.insert(rng.randrange(len(rows) + 1), rows[at])
    elif how == 2:
        other = rng.choice(others).split(b"\n")
        rows.insert(at, rng.choice(other))
    elif how == 3:
        rows[at] = b" " * rng.choice((1, 2, 4)) + rows[at]
    else:
        rng.shuffle(rows)
    return b"\n".join(rows)


def number(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    found = list(re.finditer(rb"-?\d[\d.eE+-]*", data))
    if not found:
        return bytes(data)
    one = rng.choice(found)
    return bytes(data[:one.start()]) + rng.choice(NUMBERS) + bytes(data[one.end():])


def tokens(words: Sequence[bytes]) -> Mutation:
    """Insert one of ``words``, or replace another word by it."""
    def put(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
        found = list(re.finditer(rb"[\w./%-]+", data))
        word = rng.choice(words)
        if found and rng.random() < 0.7:
            one = rng.choice(found)
            return bytes(data[:one.start()]) + word + bytes(data[one.end():])
        at = rng.randrange(len(data) + 1)
        return bytes(data[:at]) + word + bytes(data[at:])
    return put


_CHUNK_HEAD = struct.Struct("<BQQQQII4sQ")


def inside_chunks(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Change the contents of one chunk of an MCAP file and pack it again, like a hostile writer."""
    places = [match.start() - 37 for match in re.finditer(rb"\x04\0\0\0zstd", data) if match.start() >= 37]
    if not places:
        return flip(data, rng, others)
    start = rng.choice(places)
    try:
        opcode, _, begin, end, _, _, name_length, name, length = _CHUNK_HEAD.unpack_from(data, start)
        after = start + _CHUNK_HEAD.size + length
        raw = zstandard.ZstdDecompressor().decompress(
            bytes(data[start + _CHUNK_HEAD.size:after]), max_output_size=2**20)
    except (struct.error, zstandard.ZstdError):
        return flip(data, rng, others)
    raw = rng.choice((flip, flip, overwrite, overwrite, cut, remove, repeat, number))(bytearray(raw), rng, [raw])
    packed = zstandard.compress(raw[:2**20], 1)
    declared = len(raw[:2**20]) if rng.random() < 0.9 else rng.choice((0, 2**31, 2**63, len(raw) + 1))
    crc = zlib.crc32(raw[:2**20]) if rng.random() < 0.9 else 0
    head = _CHUNK_HEAD.pack(opcode, 40 + len(packed), begin, end, declared, crc, name_length, name, len(packed))
    return bytes(data[:start]) + head + packed + bytes(data[after:])


def records(data: bytearray, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Add records of 12 bytes for `replies.Script`, near each other or far apart."""
    found = [bytes(data[start:start + 12]) for start in range(0, len(data), 12)]
    apart = rng.choice((0, 3, 30, 255))
    for _ in range(rng.choice((1, 3, 10, 40))):
        body = rng.choice((bytes(8), b"\xff" * 8, rng.randbytes(8), rng.randbytes(1) + bytes(7)))
        kind = rng.choice((0, 0, 3, 4, 5, 5, 6, 6, 7, 128, 129, 130))
        head = bytes((rng.randint(0, apart), kind, rng.randrange(12), rng.choice((8, 8, rng.randrange(9)))))
        found.insert(rng.randint(0, len(found)), head + body)
    return b"".join(found)


BYTES: tuple[Mutation, ...] = (flip, overwrite, cut, remove, repeat, splice)


def mutated(rng: random.Random, corpus: Sequence[bytes], known: Sequence[Mutation]) -> bytes:
    """Apply one to five mutations to one file of the corpus."""
    data = rng.choice(corpus)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 5))):
        data = rng.choice(known)(bytearray(data), rng, corpus)[:LARGEST]
    return data
