"""Log writer: interface, queue, thread, and disks that are slow, full or lost."""

import errno
import io
import os
import random
import threading
import time

import pytest
from mcap.reader import make_reader

from drivers.drive import Command, Mode
from tdhil.errors import ExitCode, LogBroken, LogError, exit_code
from tdhil.recording import log_writer
from tdhil.recording.builder import RecordingBuilder
from tdhil.recording.log_format import CHANNELS, Event
from tdhil.recording.log_reader import read_run, read_samples
from tdhil.recording.log_writer import CHUNK_LOG_NS, LAG_S, WAKE_S, Backlog, RunWriter
from tdhil.recording.mcap_container import Container, LogGone
from tdhil.recording.recording import Stage
from tdhil.recording.run_log import RunLog
from tests.recording.log_runs import RESULT, fill, frames, make_run, sample

HANGS_S = 60.0
"""Wall time after which a call is considered hung."""


class Disk(io.FileIO):
    """File whose writes block while its gate is closed, and which is full after a number of bytes."""

    def __init__(self, path, room=10**9):
        super().__init__(path, "wb")
        self.gate = threading.Event()
        self.gate.set()
        self.room = room

    def write(self, data):
        self.gate.wait()
        part = bytes(data)[:self.room]
        if not part:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.room -= len(part)
        return super().write(part)


def test_a_full_queue_makes_stepped_time_wait(tmp_path):
    disk = Disk(tmp_path / "run.mcap")
    writer = RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True, queue_size=10, opener=lambda _: disk)
    disk.gate.clear()
    done = threading.Event()

    def run():
        rng = random.Random(1)
        for cycle in range(3000):
            writer.sample(sample(cycle, rng))
        done.set()

    thread = threading.Thread(target=run)
    thread.start()
    assert not done.wait(0.3)
    disk.gate.set()
    thread.join()
    writer.close()
    assert writer.dropped == 0
    assert len(read_run(tmp_path / "run.mcap").recording.time_s) == 3000


def test_a_full_queue_drops_in_real_time_and_says_so(tmp_path):
    disk = Disk(tmp_path / "run.mcap")
    writer = RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=False, queue_size=100, opener=lambda _: disk)
    disk.gate.clear()
    rng = random.Random(1)
    for cycle in range(10_000):
        writer.sample(sample(cycle, rng))
    writer.event(Event(1.0, "warning", "rare records keep a place"))
    dropped = writer.dropped
    assert dropped >= 1000
    disk.gate.set()
    writer.close()
    writer.close()
    run = read_run(tmp_path / "run.mcap")
    assert run.complete
    assert len(run.recording.time_s) == 10_000 - dropped
    assert sum(int(event.text.split()[0]) for event in run.events if event.kind == "dropped") == dropped
    assert "warning" in [event.kind for event in run.events]


def test_a_full_disk_is_reported_once_and_the_rest_is_complete(tmp_path):
    path, rng = tmp_path / "run.mcap", random.Random(1)
    disk = Disk(path, room=60_000)
    writer = RunWriter(path, epoch_ns=0, block=True, opener=lambda _: disk)
    raised = []
    for cycle in range(5000):
        try:
            for frame in frames(cycle, rng):
                writer.frame(frame)
            writer.sample(sample(cycle, rng))
        except LogError as error:
            raised.append(error)
    with pytest.raises(LogError) as at_close:
        writer.close()
    assert len(raised) <= 1
    for error in (*raised, at_close.value):
        assert str(error).startswith(f"{path}: the log can't be written any more: No space left on device. Free")
    run = read_run(path)
    assert 0 < len(run.recording.time_s) < 5000
    assert path.stat().st_size <= 60_000


def test_a_full_disk_while_closing_leaves_the_samples(tmp_path):
    path = tmp_path / "run.mcap"
    make_run(tmp_path / "whole.mcap", 500)
    disk = Disk(path, room=(tmp_path / "whole.mcap").stat().st_size - 10)
    with pytest.raises(LogError), RunWriter(path, epoch_ns=0, block=True, opener=lambda _: disk) as writer:
        fill(writer, RecordingBuilder(), 500)
    run = read_run(path)
    assert (len(run.recording.time_s), run.complete, repr(run.result)) == (500, False, repr(RESULT))


def test_the_first_error_is_kept(tmp_path):
    disk = Disk(tmp_path / "run.mcap", room=1000)
    writer = RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True, opener=lambda _: disk)
    with pytest.raises(KeyError), writer:
        writer.sample(sample(0, random.Random(1)))
        raise KeyError


def test_a_record_that_cannot_be_laid_out_ends_the_log_with_its_reason(tmp_path):
    path, rng = tmp_path / "run.mcap", random.Random(1)
    writer = RunWriter(path, epoch_ns=0, block=True)
    writer.sample(sample(0, rng))
    writer.sample(sample(1, rng)._replace(status=-1))
    with pytest.raises(LogError, match="can't be written any more: error"):
        writer.close()
    with path.open("rb") as file:
        assert len(list(make_reader(file, validate_crcs=True).iter_messages())) == 1


def test_little_space_at_the_start_is_refused(tmp_path):
    with pytest.raises(LogError, match=r"MB free for the log, 1000000000000 MB wanted. Free some space"):
        RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True, min_free_bytes=10**18)
    assert not (tmp_path / "run.mcap").exists()


def test_paths_that_cannot_be_written(tmp_path):
    for path in (tmp_path / "none" / "run.mcap", tmp_path):
        with pytest.raises(LogError, match="can't be opened"):
            RunWriter(path, epoch_ns=0, block=True)
    (tmp_path / "old.mcap").write_bytes(b"old")
    with pytest.raises(LogError, match="File exists"):
        RunWriter(tmp_path / "old.mcap", epoch_ns=0, block=True, overwrite=False)


def test_a_value_that_is_no_json_is_refused_at_the_call(tmp_path):
    with RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True) as writer:
        with pytest.raises(LogError, match="JSON"):
            writer.result({"a": object()})
        with pytest.raises(LogError, match="too long"):
            writer.result({"a": "x" * 5_000_000})
    assert read_run(tmp_path / "run.mcap").complete


def test_after_close_records_are_ignored_without_an_exception(tmp_path):
    writer = RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True)
    writer.close()
    writer.sample(sample(0, random.Random(1)))
    writer.event(Event(0.0, "late", ""))
    writer.close()
    assert (writer.dropped, writer.failure) == (0, None)
    assert list(read_samples(tmp_path / "run.mcap")) == []


def test_close_waits_for_a_bounded_time(tmp_path):
    disk = Disk(tmp_path / "run.mcap")
    writer = RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True, opener=lambda _: disk)
    disk.gate.clear()
    writer.sample(sample(0, random.Random(1)))
    with pytest.raises(LogError, match=r"has not taken the log within 0\.1 s"):
        writer.close(timeout_s=0.1)
    disk.gate.set()
    writer.close()


def test_a_file_that_is_a_little_behind_causes_no_wait():
    backlog = Backlog(10, block=True)
    backlog.ended = True                               # so that a wait would return
    backlog.keep_up(0.5 * (WAKE_S + LAG_S))
    assert (backlog.wake.is_set(), backlog.hurry) == (True, False)
    backlog.keep_up(LAG_S)
    assert backlog.hurry


def test_a_chunk_ends_by_log_time_and_its_content_is_known(tmp_path):
    """A second of stepped time takes milliseconds, so the wall clock closes no chunk."""
    path = tmp_path / "run.mcap"
    writer = RunWriter(path, epoch_ns=0, block=True)
    rng = random.Random(1)
    samples = [sample(cycle, rng) for cycle in range(1000)]
    for one in samples:
        writer.sample(one)
    writer.close()
    first_s, last_s = samples[0].time_s, samples[-1].time_s
    assert writer._backlog.saved_s == last_s
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    assert len(chunks) >= 0.9 * (last_s - first_s) / (1e-9 * CHUNK_LOG_NS)


def test_a_quiet_run_reaches_the_disk_too(tmp_path):
    """One frame has no sample to close its chunk, so the wall clock closes it."""
    path = tmp_path / "run.mcap"
    writer = RunWriter(path, epoch_ns=0, block=False)
    before = path.stat().st_size
    writer.frame(frames(0, random.Random(1))[0])
    end = time.monotonic() + HANGS_S
    while path.stat().st_size == before and time.monotonic() < end:
        time.sleep(0.02)
    assert path.stat().st_size > before
    writer.close()


def test_how_a_log_that_fails_ends_the_run(tmp_path):
    """The run is refused before motion or gives a partial result, without an internal error."""
    with pytest.raises(LogError) as refused:
        RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True, min_free_bytes=10**18)
    with pytest.raises(LogError) as nowhere:
        RunWriter(tmp_path / "none" / "run.mcap", epoch_ns=0, block=True)

    def full(path):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(LogError) as at_once:
        RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True, opener=full)
    disk = Disk(tmp_path / "run.mcap", room=1000)
    with pytest.raises(LogError) as broken, RunWriter(
            tmp_path / "run.mcap", epoch_ns=0, block=True, opener=lambda _: disk) as writer:
        fill(writer, RecordingBuilder(), 500)
    codes = [exit_code(error.value) for error in (refused, nowhere, at_once, broken)]
    assert codes == [ExitCode.REFUSED, ExitCode.USAGE, ExitCode.REFUSED, ExitCode.PARTIAL]


class Unsynced(Disk):
    """Disk that accepts every byte, and reports only at a sync that it could not store them."""

    def __init__(self, path, number):
        super().__init__(path)
        self.number = number

    def fileno(self):
        raise OSError(self.number, "what the disk says")


def test_a_disk_that_cannot_store_accepted_data_ends_the_log(tmp_path):
    disk = Unsynced(tmp_path / "run.mcap", errno.EIO)
    with pytest.raises(LogBroken, match="what the disk says"), RunWriter(
            tmp_path / "run.mcap", epoch_ns=0, block=True, opener=lambda _: disk) as writer:
        fill(writer, RecordingBuilder(), 500)
    assert disk.closed
    assert len(read_run(tmp_path / "run.mcap").recording.time_s) > 0


def test_a_file_that_is_no_disk_needs_no_sync(tmp_path):
    disk = Unsynced(tmp_path / "run.mcap", errno.EINVAL)
    with RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True, opener=lambda _: disk) as writer:
        fill(writer, RecordingBuilder(), 50)
    assert read_run(tmp_path / "run.mcap").complete


def test_a_slow_sync_delays_only_the_end(tmp_path, monkeypatch):
    asked, gate = threading.Event(), threading.Event()

    def slow(number):
        asked.set()
        gate.wait()

    monkeypatch.setattr(log_writer, "_data_to_disk", slow)
    path = tmp_path / "run.mcap"
    writer = RunWriter(path, epoch_ns=0, block=True)
    fill(writer, RecordingBuilder(), 2000)
    assert asked.wait(HANGS_S)
    written = len(read_run(path).recording.time_s)
    with pytest.raises(LogBroken, match="has not taken the log"):
        writer.close(timeout_s=0.05)
    gate.set()
    writer.close()
    assert written >= 2000 - 102               # all data except for the last 0.4 s are already in the file
    assert read_run(path).complete


def test_a_stage_that_lost_records_is_marked_so_in_the_log(tmp_path):
    disk = Disk(tmp_path / "run.mcap")
    writer = RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=False, queue_size=100, opener=lambda _: disk)
    log, rng = RunLog(writer, {}), random.Random(1)
    assert log.stage(Stage("speed", 0.0, 1.0, "ok")) == Stage("speed", 0.0, 1.0, "ok")
    disk.gate.clear()
    for cycle in range(3000):
        log.cycle(Command(Mode.SPEED, 1.0, 0.0), sample(cycle, rng))
    lost = writer.dropped
    said = [log.stage(Stage(name, 1.0, 2.0, outcome, "x")) for name, outcome in (("hold", "ok"), ("acquire", "ok"))]
    disk.gate.set()
    log.close()
    assert lost > 0
    assert said[0] == Stage("hold", 1.0, 2.0, "degraded", f"x; {lost} records found no place in the log")
    assert said[1].outcome == "ok"
    run = read_run(tmp_path / "run.mcap")
    assert run.stages[1:] == tuple(said)
    assert log.recording(complete=True).stages == run.stages


@pytest.mark.parametrize("left", [0, 5, 1000])
def test_a_truncation_just_before_a_write_is_reported_at_the_next(tmp_path, left):
    class Cutting(io.FileIO):          # between the container's check of the file and its write
        armed = False

        def write(self, data):
            if self.armed:
                os.truncate(self.name, left)
                Cutting.armed = False
            return super().write(data)

    container = Container(Cutting(tmp_path / "log.mcap", "x+"))

    def one_chunk():
        container.add(min(CHANNELS), 1_000_000_000, bytes(100))
        container.close_chunk()

    for _ in range(3):
        one_chunk()
    Cutting.armed = True
    one_chunk()
    with pytest.raises(LogGone, match="was cut to less than"):
        one_chunk()


def test_a_file_truncated_before_the_check_is_reported_with_its_size(tmp_path):
    path = tmp_path / "log.mcap"
    container = Container(io.FileIO(path, "x+"))

    def one_chunk():
        container.add(min(CHANNELS), 1_000_000_000, bytes(100))
        container.close_chunk()

    one_chunk()
    size = path.stat().st_size
    os.truncate(path, size - 10)
    with pytest.raises(LogGone, match=f"was cut to {size - 10} of {size} bytes"):
        one_chunk()


# -- a log that is removed -----------------------------------------------------------------------------------


@pytest.mark.parametrize("block", [True, False])
@pytest.mark.parametrize(("how", "said"), [
    ("removed", "removed while it was being written"), ("replaced", "removed while"),
    ("cut", "was cut to (0|less than .*) of"),
    ("shortened", "was cut to"),
])
def test_a_log_that_was_taken_away_is_told_at_once(tmp_path, block, how, said):
    path = tmp_path / "run.mcap"
    writer = RunWriter(path, epoch_ns=0, block=block)
    rng = random.Random(1)
    for cycle in range(500):
        writer.sample(sample(cycle, rng))
    written_from = time.monotonic()
    while path.stat().st_size < 2000 and time.monotonic() - written_from < HANGS_S:
        time.sleep(0.02)
    if how == "removed":
        path.unlink()
    elif how == "replaced":
        other = tmp_path / "other"
        other.write_bytes(b"x" * 10**6)
        other.replace(path)
    else:
        with path.open("r+b") as file:
            file.truncate(0 if how == "cut" else 1000)
    with pytest.raises(LogBroken, match=said) as caught:
        for cycle in range(500, 500_000):
            writer.sample(sample(cycle, rng))
            time.sleep(1e-4)
    assert exit_code(caught.value) is ExitCode.PARTIAL
    assert "Leave the log alone" in caught.value.next_step and str(path) == caught.value.where
    # Once; the stop continues without a log, and the end reports it again.
    for cycle in range(1000):
        writer.sample(sample(cycle, rng))
    with pytest.raises(LogBroken, match=said):
        writer.close()


def test_a_log_that_was_moved_is_whole(tmp_path):
    """The file has only another name."""
    path, other = tmp_path / "run.mcap", tmp_path / "elsewhere.mcap"
    writer = RunWriter(path, epoch_ns=0, block=True)
    rng = random.Random(1)
    for cycle in range(2000):
        writer.sample(sample(cycle, rng))
        if cycle == 1000:
            path.rename(other)
    writer.close()
    assert read_run(other).complete


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize(("block", "where"), [(True, "at work"), (False, "at work"), (False, "between")])
def test_a_log_whose_thread_died_is_told_within_a_second(tmp_path, monkeypatch, block, where):
    """Calls do not wait for it without a limit, and do not continue as if it were written."""
    writer = RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=block)

    def die(*_arguments):
        raise SystemExit("killed")

    if where == "at work":
        monkeypatch.setattr(writer._pump, "_drain", die)
    else:
        monkeypatch.setattr(writer._pump, "_guarded", die)
        writer._backlog.ended = True
        writer._thread.join(HANGS_S)
        writer._backlog.ended = False              # as if it had been killed without a report
        writer._backlog._alert = 256
    rng = random.Random(1)
    with pytest.raises(LogBroken, match="killed" if where == "at work" else "thread has ended"):
        for cycle in range(100_000):
            writer.sample(sample(cycle, rng))
            if where == "at work":
                time.sleep(1e-4)
    # The thread is checked once per second of control time. A dead one that reported it accepts the first sample.
    assert cycle * 0.004 <= 1.1 if where == "between" else cycle < 50_000
    with pytest.raises(LogBroken):
        writer.close()
