"""Chunks read at once by numpy and message by message: the results are bit for bit the same for any content.

The files are built record by record: records of our writer, valid records of another writer of the same messages
(other order of fields, zeros omitted, an additional field), and invalid records.
"""

import random
import struct
import zlib

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.drive import Command, Mode
from tdhil.errors import LogError
from tdhil.file_kind import MAGIC
from tdhil.recording import chunk_table, log_reader
from tdhil.recording.log_format import CAN, CLASSES, COMMAND, EVENT, SAMPLE, STAGE, Event
from tdhil.recording.log_messages import (
    MORE_SIZE,
    SAMPLE_SIZE,
    event_message,
    pack_command,
    pack_frames,
    pack_sample,
    stage_message,
)
from tdhil.recording.log_reader import read_run
from tdhil.recording.mcap_container import LIBRARY
from tdhil.recording.recording import Stage
from tests.recording.log_runs import frames, make_run, same, same_run, sample

FEW = settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
TIMES = st.integers(0, 2**64 - 1)


def record(opcode, body):
    return struct.pack("<BQ", opcode, len(body)) + body


def message(channel, payload, log_time_ns=0):
    return record(5, struct.pack("<HIQQ", channel, 0, log_time_ns, 0) + payload)


def string(text):
    return len(text).to_bytes(4, "little") + text.encode()


def declaration(channel, topic, name):
    schema = record(3, struct.pack("<H", channel) + string(name) + string("protobuf") + string(""))
    return schema + record(4, struct.pack("<HH", channel, channel) + string(topic) + string("protobuf") + bytes(4))



def ours(seed):
    """Return a sample in the layout of our writer, with any bits in the numbers, including every kind of NaN."""
    rng = random.Random(seed)
    one = sample(seed % 5000, rng)
    if seed % 7 == 0:
        odd = [struct.unpack("<d", rng.randbytes(8))[0] for _ in range(3)]
        one = one._replace(time_s=odd[0], speed_rad_s=odd[1], torque_nm=odd[2])
    return pack_sample(one)


def leaving_zeros_away(seed):
    """Return a sample as protobuf writes it, without the field of a zero speed."""
    parsed = CLASSES["Sample"].FromString(ours(seed))
    parsed.speed_rad_s = 0.0
    return parsed.SerializeToString()


def with_one_more_field(seed):
    return ours(seed) + b"\x70\x01"


def in_another_order(seed):
    payload = pack_sample(sample(seed % 5000, random.Random(seed))._replace(torque_demand_nm=None, position_rad=None))
    return payload[9:] + payload[:9]


def with_a_long_flag(seed):
    """Return a sample with `fresh` as two bytes and no status: its length differs by one byte from the usual one."""
    payload = bytearray(ours(seed))
    payload[46] = 0x80
    return bytes(payload)


def of_the_right_length(seed):
    return random.Random(seed).randbytes((66, 75, 84)[seed % 3])


def with_the_angle_first(seed):
    """Return a sample with angle before torque demand, which protobuf accepts too."""
    payload = pack_sample(sample(15, random.Random(seed)))
    assert len(payload) == SAMPLE_SIZE + 2 * MORE_SIZE
    return payload[:SAMPLE_SIZE] + payload[-MORE_SIZE:] + payload[SAMPLE_SIZE:-MORE_SIZE]


WRITERS = (ours, ours, ours, ours, leaving_zeros_away, with_one_more_field, in_another_order, with_a_long_flag,
           of_the_right_length, with_the_angle_first)
EVENTS = event_message(Event(1.0, "warning", "bus")).payload
STAGES = stage_message(Stage("setup", 0.0, 1.0, "ok")).payload
OTHERS = (
    message(COMMAND, pack_command(0.5, Command(Mode.TORQUE, 1.0, 2.0))),
    message(CAN, pack_frames(frames(3, random.Random(3)))),
    message(EVENT, EVENTS), message(STAGE, STAGES), message(EVENT, b"\x0a\xff"), message(77, b"?"),
    record(0x0C, b"metadata, stepped over"), record(0x99, b""), record(5, bytes(10)),
    declaration(SAMPLE, "/sample", "tdhil.Sample"), declaration(12, "/sample", "tdhil.Sample"),
    declaration(SAMPLE, "/other", "tdhil.Sample"), b"\x05\x00", struct.pack("<BQ", 5, 2**63),
    struct.pack("<BQ", 5, 1000),
)
RECORDS = st.one_of(
    st.tuples(st.sampled_from(WRITERS), st.integers(0, 2**20), st.sampled_from((1, 1, 1, 12)), TIMES).map(
        lambda found: message(found[2], found[0](found[1]), found[3])),
    st.tuples(st.integers(0, 2**20), TIMES).map(lambda found: message(SAMPLE, ours(found[0]), found[1])),
    st.sampled_from(OTHERS[:8]),
    st.sampled_from(OTHERS),
)
CHUNKS = st.lists(RECORDS, max_size=12).map(b"".join)


def chunk(raw, packing="zstd", crc=None):
    data = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}[packing](raw)
    sum_ = zlib.crc32(raw) if crc is None else crc
    head = struct.pack("<QQQI", 0, 0, len(raw), sum_)
    return record(6, head + string(packing) + len(data).to_bytes(8, "little") + data)


def file_of(chunks, end=True):
    head = MAGIC + record(1, string("") + string(LIBRARY))
    tail = record(0x0F, bytes(4)) + record(2, bytes(20)) + MAGIC if end else b""
    return head + b"".join(chunks) + tail


def both(path, data, batch=log_reader.BATCH):
    """Return the common result of both routes, or None if both refuse the file."""
    path.write_bytes(data)
    told = []
    for size in (batch, 0):
        try:
            told.append(read_run(path, batch=size))
        except LogError as error:
            told.append(str(error))
    assert type(told[0]) is type(told[1])
    assert told[0] == told[1] if isinstance(told[0], str) else same_run(*told)
    return told[0]


@pytest.mark.heavy
@FEW
@given(raw=st.lists(CHUNKS, max_size=20), plain=st.integers(0, 30), packing=st.sampled_from(("zstd", "lz4", "")),
       damaged=st.sets(st.integers(0, 40), max_size=2), end=st.booleans(), batch=st.sampled_from((1, 3000, 2**21)))
def test_both_routes_give_the_same(tmp_path, raw, plain, packing, damaged, end, batch):
    good = [b"".join(message(SAMPLE, ours(k), k) for k in range(n, n + 3)) for n in range(plain)]
    mixed = [one for pair in zip([*raw, *[b""] * plain], [*good, *[b""] * len(raw)], strict=True) for one in pair]
    both(tmp_path / "x.mcap",
         file_of([chunk(one, packing, 1 if k in damaged else None) for k, one in enumerate(mixed)], end), batch)


@pytest.mark.parametrize("writer", WRITERS[3:])
def test_samples_laid_out_otherwise(tmp_path, writer):
    """One such sample in fifty chunks is read by the other route, with the result of protobuf."""
    payloads = [[ours(3 * k + j) for j in range(3)] for k in range(50)]
    payloads[30][1] = writer(1234)
    found = both(tmp_path / "x.mcap", file_of([chunk(b"".join(message(SAMPLE, one) for one in few))
                                               for few in payloads]))
    assert len(found.recording.time_s) + len(found.problems) == 150


def test_a_run_of_our_writer_is_read_at_once(tmp_path, monkeypatch):
    """All chunks are read at once, except for the first one, which declares the channels."""
    builder = make_run(tmp_path / "run.mcap", 2000)
    taken = []
    whole = log_reader._Reading._one_by_one
    monkeypatch.setattr(log_reader._Reading, "_one_by_one", lambda *given: taken.append(1) or whole(*given))
    found = read_run(tmp_path / "run.mcap")
    assert same(found.recording, builder.recording())
    assert len(taken) == 1


def test_chunks_of_very_different_length(tmp_path):
    """They are read together while there are many, and singly when few are left."""
    rng = random.Random(5)
    sizes = [rng.choice((0, 1, 2, 300)) for _ in range(60)]
    found = both(tmp_path / "x.mcap", file_of([
        chunk(b"".join(message(SAMPLE, ours(k)) for k in range(size))) for size in sizes]))
    assert len(found.recording.time_s) == sum(sizes)
    assert found.complete


def test_both_routes_stop_at_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(log_reader, "SAMPLES", 70)
    found = both(tmp_path / "x.mcap", file_of([
        chunk(b"".join(message(SAMPLE, ours(3 * k + j)) for j in range(3)) + message(EVENT, EVENTS))
        for k in range(50)]))
    assert len(found.recording.time_s) == 70
    assert len(found.events) == 23


def test_the_layout_is_the_writer_s():
    """The row of numpy equals the bytes of `pack_sample`, field by field, for a sample with distinct bytes."""
    one = sample(1, random.Random(1))._replace(torque_demand_nm=None, position_rad=None, time_s=0.1, status=0x1234)
    row = np.frombuffer(pack_sample(one), chunk_table._SAMPLE_ROW)[0]
    for name in ("time_s", "speed_rad_s", "torque_nm", "age_s", "half_width_s", "status"):
        assert row[name] == getattr(one, name)
