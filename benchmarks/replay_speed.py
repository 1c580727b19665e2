"""Cost of a replay, CPU seconds: reading by each way, from the cache, identifying, and a whole `tdhil replay`.

    python benchmarks/replay_speed.py [--log run.mcap] [--rounds 7]

Without --log a run is simulated first (250 Hz, almost five minutes, 72,000 samples). All in one run, so that the ratios
hold whatever else the machine is doing; the smallest of the rounds counts.
"""

import argparse
import io
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
from mcap.records import Chunk, Message  # noqa: E402
from mcap.stream_reader import StreamReader, breakup_chunk  # noqa: E402
from mcap.writer import CompressionType, Writer  # noqa: E402

import tdhil  # noqa: E402
from tdhil.recording.log_format import SAMPLE  # noqa: E402
from tdhil.recording.log_reader import messages, read_run  # noqa: E402
from tdhil.recording.mcap_container import Container  # noqa: E402
from tdhil.recording.mcap_recovery import CHUNK_LIMIT, walk  # noqa: E402


def cpu_s(act: Callable[[], object], rounds: int) -> float:
    took = []
    for _ in range(rounds):
        began = time.process_time()
        act()
        took.append(time.process_time() - began)
    return min(took)


def walked(path: Path) -> int:
    with path.open("rb") as file:
        size = file.seek(0, 2)
        return sum(1 for _ in walk(file, size))


def streamed(path: Path, inside: bool) -> int:
    """mcap's own reader: chunks as they stand, or all that is in them."""
    count = 0
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True, record_size_limit=CHUNK_LIMIT).records:
            if inside and isinstance(record, Chunk):
                count += sum(1 for one in breakup_chunk(record, validate_crc=True) if isinstance(one, Message))
            else:
                count += 1
    return count


def child_s(command: list[str], rounds: int) -> float:
    """CPU seconds of a process of its own, its start included."""
    took = []
    for _ in range(rounds):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(took)


def write_ours(payloads: list[tuple[int, bytes]], each: int) -> None:
    container = Container(_Sink())
    for n, (time_ns, payload) in enumerate(payloads):
        container.add(SAMPLE, time_ns, payload)
        if n % each == each - 1:
            container.close_chunk()
    container.close_chunk()
    container.finish()


def write_theirs(payloads: list[tuple[int, bytes]], each: int) -> None:
    writer = Writer(io.BytesIO(), chunk_size=2**20, compression=CompressionType.ZSTD)
    writer.start()
    channel = writer.register_channel("/sample", "protobuf", writer.register_schema("tdhil.Sample", "protobuf", b""))
    for n, (time_ns, payload) in enumerate(payloads):
        writer.add_message(channel, time_ns, payload, time_ns)
        if n % each == each - 1:
            writer.flush()
    writer.finish()


class _Sink(io.BytesIO):
    def fileno(self) -> int:
        raise OSError


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--log", type=Path)
    parser.add_argument("--rounds", type=int, default=7)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log = asked.log
        if log is None:
            log = Path(folder) / "run.mcap"
            with tdhil.simulate(seed=7) as drive:
                tdhil.run(drive, log=log)
        measure(log.resolve(), Path(folder), asked.rounds)


def measure(log: Path, folder: Path, rounds: int) -> None:
    recorded = tdhil.read(log)
    kept = folder / "recording.npz"
    arrays = {name: getattr(recorded.recording, name) for name in
              ("time_s", "speed_rad_s", "torque_nm", "fresh", "limited")}
    np.savez(kept, **arrays)

    def from_npz() -> None:
        with np.load(kept) as found:
            for name in arrays:
                found[name]

    quick = cpu_s(lambda: read_run(log), rounds)
    slow = cpu_s(lambda: read_run(log, batch=0), max(2, rounds // 2))
    print(f"{log.stat().st_size / 1e6:.1f} MB, {len(recorded)} samples; CPU s, the smallest of {rounds} rounds")
    tdhil.identify(recorded)               # what is loaded once
    for what, took in (
        ("read, message by message", slow),
        ("read, chunks at once by numpy", quick),
        ("  of it: walking, inflating, CRC", cpu_s(lambda: walked(log), rounds)),
        ("mcap StreamReader(emit_chunks): chunks unopened", cpu_s(lambda: streamed(log, False), rounds)),
        ("  and breakup_chunk: messages undecoded", cpu_s(lambda: streamed(log, True), 2)),
        ("arrays from an npz", cpu_s(from_npz, rounds)),
        ("identify", cpu_s(lambda: tdhil.identify(recorded), rounds)),
        ("tdhil replay, a process of its own",
         child_s([sys.executable, "-m", "tdhil", "replay", str(log), "--json"], max(2, rounds // 2))),
    ):
        print(f"{what:50} {took:7.3f}   {took / quick:6.2f} of the quick read")

    payloads = [(one.log_time_ns, one.payload) for one in messages(log) if getattr(one, "number", 0) == SAMPLE]
    for what, write in (
        ("written by our container", write_ours), ("written by mcap's Writer and flush()", write_theirs),
    ):
        took = cpu_s(lambda write=write: write(payloads, 50), 3)
        print(f"{what:50} {took / len(payloads) * 1e6:7.2f} µs a message, a chunk each 50")


if __name__ == "__main__":
    main()
