"""Growing log, read by another process: each record once, in order, at any time of reading."""

from __future__ import annotations

import random

import numpy as np
import pytest

from drivers import Command, Mode, PowerState, Sample
from tdhil.recording import LogTail, RunWriter, Stage, log_tail, read_run
from tdhil.recording.log_format import Event, LiveInertia

COMMAND = Command(Mode.SPEED, 1.0, 0.0)


def sample(number: int) -> Sample:
    demand = 3.0 if number % 2 else None
    return Sample(0.01 * number, 0.0, 0.0, True, 0.1 * number, -0.2 * number, demand, Mode.SPEED, PowerState.ENABLED,
                  False, False, 0x1237)


def write(path, count=200):
    writer = RunWriter(path, epoch_ns=10**18, block=True)
    writer.configuration({"seed": 7}, {})
    for number in range(count):
        writer.command(0.01 * number, COMMAND)
        writer.sample(sample(number))
        if number == count // 2:
            writer.event(Event(0.01 * number, "plan", "half of it"))
    writer.stage(Stage("setup", 0.0, 1.0, "ok"))
    writer.result({"verdict": "valid"})
    writer.close()


def collected(tail):
    samples, events, stages, last = [], [], [], {}
    while True:
        news = tail.read()
        samples.append(news.samples)
        events += news.events
        stages += news.stages
        last |= {name: got for name in ("configuration", "result", "epoch_ns") if (got := getattr(news, name))}
        if not news.more:
            return np.concatenate(samples), events, stages, last


def test_a_file_that_grows_byte_by_byte_is_read_like_a_whole_one(tmp_path):
    write(tmp_path / "whole.mcap")
    data, growing = (tmp_path / "whole.mcap").read_bytes(), tmp_path / "run.mcap"
    whole = read_run(tmp_path / "whole.mcap")
    tail, dice, written = LogTail(growing), random.Random(3), 0
    assert not len(tail.read().samples)        # the file does not exist yet
    seen, events, stages, last = [], [], [], {}
    with growing.open("wb", buffering=0) as file:
        while written < len(data):
            piece = data[written:written + dice.choice((1, 5, 40, 900))]
            file.write(piece)
            written += len(piece)
            more, *others, found = collected(tail)
            seen.append(more)
            events += others[0]
            stages += others[1]
            last |= found
    samples = np.concatenate(seen)
    assert np.array_equal(samples[:, 0], whole.recording.time_s)
    assert np.array_equal(samples[:, 1], whole.recording.speed_rad_s)
    assert np.array_equal(samples[:, 2], whole.recording.torque_nm)
    assert tuple(events) == whole.events
    assert [stage.name for stage in stages] == ["setup"]
    assert last["configuration"]["run"] == {"seed": 7}
    assert last["result"] == {"verdict": "valid"}
    assert last["epoch_ns"] == 10**18
    assert tail.closed
    assert not len(tail.read().samples)


@pytest.mark.parametrize("place", [0.3, 0.6, 0.9])
def test_a_changed_byte_costs_its_chunk_at_most(tmp_path, place):
    path = tmp_path / "run.mcap"
    write(path)
    data = bytearray(path.read_bytes())
    whole = read_run(path)
    first = data.index(b"\x04\0\0\0zstd")
    data[first + 40 + int(place * 200)] ^= 0x55
    path.write_bytes(data)
    samples, *_ = collected(LogTail(path))
    assert len(samples) >= len(whole.recording.time_s) - 60
    assert set(samples[:, 0]) <= set(whole.recording.time_s)


def test_a_late_reader_gets_the_log_in_parts(tmp_path, monkeypatch):
    write(tmp_path / "run.mcap")
    monkeypatch.setattr(log_tail, "MOST", 500)
    tail = LogTail(tmp_path / "run.mcap")
    first = tail.read()
    assert first.more
    samples, *_ = collected(tail)
    assert len(first.samples) + len(samples) == 200


def test_interim_answers_are_read_as_they_were_written(tmp_path):
    known = LiveInertia(77.0, 5, 0.95, "valid", "because", 104.2, 103.1, 105.3, 100.0, 108.4, 0.41, 0.01, 0.0)
    unknown = LiveInertia(57.0, 3, 0.95, "not_identifiable", "2 periods")
    writer = RunWriter(tmp_path / "run.mcap", epoch_ns=10**18, block=True)
    writer.sample(sample(1))
    for one in (unknown, known):
        writer.inertia(one)
    writer.close()
    assert LogTail(tmp_path / "run.mcap").read().inertias == (unknown, known)
    assert read_run(tmp_path / "run.mcap").problems == ()
