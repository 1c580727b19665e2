"""Damaged logs: truncated files, flipped bits, decompression bombs, and files of other kinds."""

import random
import resource
import struct
import subprocess
import sys
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, Chunk, DataEnd, Footer, Header, Metadata
from mcap.writer import Writer

from tdhil.errors import LogError
from tdhil.file_kind import MAGIC
from tdhil.recording.log_reader import read_frames, read_run, read_samples
from tdhil.recording.mcap_container import LIBRARY
from tdhil.recording.mcap_recovery import Contents, walk
from tests.recording.log_runs import make_run, same_run

QUIET = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def good(whole):
    return whole.read_bytes(), read_run(whole), list(read_samples(whole)), list(read_frames(whole))


def read_damaged(path, data):
    """Return the run, or None if the file is refused. Any other exception than LogError is a failure."""
    path.write_bytes(data)
    try:
        samples, frames = list(read_samples(path)), list(read_frames(path))
        return read_run(path), samples, frames
    except LogError as error:
        assert "\n" not in str(error)
        assert str(error).startswith(str(path))
        return None


def samples_left(path, data):
    """Return the remaining samples only; the tests of cuts and flips check the rest."""
    path.write_bytes(data)
    return list(read_samples(path))


def is_part(part, everything):
    if part == everything[:len(part)]:
        return True
    rest = iter(everything)
    return all(any(one == other for other in rest) for one in part)


@pytest.mark.heavy
@QUIET
@given(share=st.floats(0, 1))
def test_cut_anywhere(good, tmp_path, share):
    data, _, samples, frames = good
    cut = int(share * (len(data) - 1))
    got = read_damaged(tmp_path / "cut.mcap", data[:cut])
    if got is None:
        assert cut < 64
        return
    run, some, few = got
    assert same_run(run, read_run(tmp_path / "cut.mcap", batch=0))
    assert not run.complete
    assert not run.recording.complete
    assert run.problems
    assert some == samples[:len(some)]
    assert few == frames[:len(few)]
    assert len(run.recording.time_s) == len(some)


@pytest.mark.heavy
def test_every_byte_that_is_cut_costs_at_most_a_chunk(good, tmp_path):
    data, _, samples, _ = good
    lengths = []
    for cut in range(len(data) // 2, len(data), 997):
        some = samples_left(tmp_path / "cut.mcap", data[:cut])
        lengths.append(len(some))
    assert lengths == sorted(lengths)
    assert lengths[-1] == len(samples)
    assert max(b - a for a, b in pairwise(lengths)) <= 101   # 0.4 s at 250 Hz


@pytest.mark.heavy
@QUIET
@given(seed=st.integers(0, 2**32), flips=st.integers(1, 4))
def test_flipped_bits(good, tmp_path, seed, flips):
    data, _, samples, frames = good
    rng, damaged = random.Random(seed), bytearray(data)
    for _ in range(flips):
        damaged[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    got = read_damaged(tmp_path / "flip.mcap", bytes(damaged))
    if got is None:
        assert damaged[:64] != data[:64]
        return
    run, some, few = got
    assert same_run(run, read_run(tmp_path / "flip.mcap", batch=0))
    assert len(some) >= len(samples) - flips * 202
    assert is_part(some, samples)
    assert is_part(few, frames)
    assert run.complete == (not run.problems)
    assert not run.complete or len(some) == len(samples)


@pytest.mark.heavy
def test_every_flip_in_the_heads_of_records(good, tmp_path):
    """The test flips each bit of the lengths and kinds of records around the third chunk and its indexes."""
    data, _, samples, _ = good
    rng = random.Random(2)
    start = data.index(b"\x04\0\0\0zstd", 8000) - 37
    places = [*range(start, start + 60)]
    end = start + 9 + int.from_bytes(data[start + 1:start + 9], "little")
    places += [*range(end, end + 15)]
    for place in places:
        damaged = bytearray(data)
        damaged[place] ^= 1 << rng.randrange(8)
        some = samples_left(tmp_path / "flip.mcap", bytes(damaged))
        assert len(some) >= len(samples) - 101
        assert is_part(some, samples)


def test_a_gap_in_the_middle_is_skipped(good, tmp_path):
    data, _, samples, _ = good
    run, some, _ = read_damaged(tmp_path / "hole.mcap", data[:20_000] + bytes(5000) + data[25_000:])
    assert some[0].time_s == samples[0].time_s
    assert some[-1].time_s == samples[-1].time_s
    assert len(some) >= len(samples) - 303
    assert run.configuration
    assert run.result
    assert any("byte" in problem for problem in run.problems)


def test_the_first_chunk_lost_costs_only_itself(good, tmp_path):
    """It declares the channels. A file of our writer can still be read by their numbers."""
    data, _, samples, _ = good
    damaged = bytearray(data)
    damaged[data.index(b"zstd") + 40] ^= 1
    run, some, _ = read_damaged(tmp_path / "first.mcap", bytes(damaged))
    assert not run.complete
    assert run.result
    assert len(some) == len(samples)


@pytest.mark.parametrize(("data", "says"), [
    (b"", "empty"),
    (b"not an mcap", "not an MCAP file"),
    (MAGIC, "not a run of this tool"),
    (MAGIC + bytes(1000), "not a run of this tool"),
    (MAGIC + b"\xff" * 1000, "not a run of this tool"),
])
def test_other_files(tmp_path, data, says):
    (tmp_path / "x.mcap").write_bytes(data)
    with pytest.raises(LogError, match=says):
        read_run(tmp_path / "x.mcap")


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "none.mcap", tmp_path):
        with pytest.raises(LogError, match="can't be read"):
            read_run(path)


def test_an_mcap_file_of_another_tool(tmp_path):
    with (tmp_path / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("their.Sample", "protobuf", b"")
        channel = writer.register_channel("/sample", "protobuf", schema)
        writer.add_message(channel, 0, b"\x09" + bytes(8), 0)
        writer.finish()
    with pytest.raises(LogError, match="not a run of this tool"):
        read_run(tmp_path / "x.mcap")


def _with_records(data, *records):
    """Return a log with foreign records before its first chunk, between two chunks, and before the end of its data."""
    found = [one.offset for one in walk(BytesIO(data), len(data)) if isinstance(one, Contents)]
    end = data.rindex(struct.pack("<BQ", 0x0F, 4))
    for at in (end, found[len(found) // 2], found[0]):
        data = data[:at] + b"".join(records) + data[at:]
    return data


def _record(one):
    builder = RecordBuilder()
    one.write(builder)
    return builder.end()


ATTACHMENT = _record(Attachment(create_time=1, log_time=2, name="photo.jpg", media_type="image/jpeg", data=b"x" * 5000))
METADATA = _record(Metadata(name="site", metadata={"rig": "R7", "well": "W1"}))


def test_attachments_and_metadata_of_other_tools_are_no_damage(good, tmp_path):
    data, run, samples, frames = good
    nested = _record(Attachment(create_time=1, log_time=2, name="a.mcap", media_type="", data=data))
    read, some, few = read_damaged(tmp_path / "added.mcap", _with_records(data, ATTACHMENT, METADATA, nested))
    assert read.problems == run.problems == () and read.complete
    assert same_run(read, run) and some == samples and few == frames


@pytest.mark.parametrize("record", [ATTACHMENT, METADATA], ids=["attachment", "metadata"])
def test_an_attachment_with_lengths_that_disagree_is_damage(good, tmp_path, record):
    data, _, samples, _ = good
    for at in (9 + 16, 9 + 16 + 4 + 9) if record is ATTACHMENT else (9, 9 + 4 + 4):
        wrong = record[:at] + b"\xff" + record[at + 1:]
        read, some, _ = read_damaged(tmp_path / "wrong.mcap", _with_records(data, wrong))
        assert any("not a record" in str(one) for one in read.problems) and some == samples
    cut = data[:data.rindex(struct.pack("<BQ", 0x0F, 4))] + record[:-3]
    assert any("not closed" in str(one) for one in read_damaged(tmp_path / "cut.mcap", cut)[0].problems)


def bomb(compression, size, declared, chunks=1):
    packed = zstandard.compress(bytes(size), 3) if compression == "zstd" else lz4.frame.compress(bytes(size))
    builder = RecordBuilder()
    Header("", LIBRARY).write(builder)
    for _ in range(chunks):
        Chunk(compression=compression, data=packed, message_start_time=0, message_end_time=0, uncompressed_crc=0,
              uncompressed_size=declared).write(builder)
    DataEnd(0).write(builder)
    Footer(0, 0, 0).write(builder)
    return MAGIC + builder.end() + MAGIC


@pytest.mark.heavy
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("declared", [500_000_000, 1000, 2**63])
def test_a_bomb_is_refused_in_little_memory(tmp_path, compression, declared):
    path = tmp_path / "bomb.mcap"
    path.write_bytes(bomb(compression, 500_000_000, declared))
    lines = read_in_a_small_process(path)
    assert lines[0] == "0 False"
    assert "refused" in lines[1] or "size it declares" in lines[1]
    assert int(lines[-1]) < 100_000             # KiB above what the imports took


@pytest.mark.heavy
def test_many_small_bombs_are_bounded_too(tmp_path):
    """The chunks are within the limit and contain apparently empty samples. The sum is limited."""
    record = b"\x05" + (22).to_bytes(8, "little") + b"\x01\0" + bytes(20)
    chunk = record * (CHUNK // len(record))
    builder = RecordBuilder()
    Header("", LIBRARY).write(builder)
    for _ in range(3):
        Chunk(compression="zstd", data=zstandard.compress(chunk), message_start_time=0, message_end_time=0,
              uncompressed_crc=0, uncompressed_size=len(chunk)).write(builder)
    path = tmp_path / "many.mcap"
    path.write_bytes(MAGIC + builder.end())
    lines = read_in_a_small_process(path, "reader.SAMPLES = 100_000")
    assert lines[0] == "100000 False"
    assert "more than 100000 samples" in lines[1]
    assert int(lines[-1]) < 100_000


CHUNK = 4 * 2**20
CHILD = """
import resource, sys
from pathlib import Path
from tdhil.recording import log_reader as reader
{before}
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
run = reader.read_run(Path(sys.argv[1]))
print(len(run.recording.time_s), run.complete)
print(*run.problems, sep="\\n")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak)
"""


def read_in_a_small_process(path, before=""):
    def cap():
        resource.setrlimit(resource.RLIMIT_AS, (2 * 2**30, 2 * 2**30))

    done = subprocess.run(
        [sys.executable, "-c", CHILD.format(before=before), str(path)], preexec_fn=cap, capture_output=True, text=True,
        cwd=Path(__file__).parents[2], timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_random_bytes_after_the_magic(tmp_path):
    for seed in range(30):
        read_damaged(tmp_path / "x.mcap", MAGIC + random.Random(seed).randbytes(5000))


@pytest.mark.heavy
@pytest.mark.parametrize("apart", [
    283, pytest.param(71, marks=pytest.mark.heavy), pytest.param(29, marks=pytest.mark.long),
])
def test_a_short_run_cut_every_few_bytes(tmp_path, apart):
    make_run(tmp_path / "short.mcap", 3)
    data = (tmp_path / "short.mcap").read_bytes()
    for cut in range(0, len(data), apart):
        read_damaged(tmp_path / "cut.mcap", data[:cut])
