"""Round trip of a log, bit for bit, with tdhil's reader and with MCAP's own reader."""

import math
import random
import tempfile
from collections import Counter
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from drivers.drive import Command, Mode, PowerState
from tdhil.recording.builder import FACTS as FACT_NAMES
from tdhil.recording.builder import RecordingBuilder
from tdhil.recording.log_format import VIRTUAL_COLUMNS, Event
from tdhil.recording.log_reader import read_frames, read_run, read_samples
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.npz_cache import pack_recording, unpack_recording
from tdhil.recording.recording import LagPrior, Recording, Stage, before_abort
from tdhil.recording.run_log import RunLog
from tests.recording.log_runs import CONFIGURATION, FACTS, PERIOD_S, RESULT, STAGES, fill, make_run, same, sample
from tests.recording.test_log_messages import SAMPLES


def test_a_run_survives_a_round_trip(tmp_path):
    path, builder = tmp_path / "run.mcap", RecordingBuilder()
    with RunWriter(path, epoch_ns=0, block=True) as writer:
        logged = fill(writer, builder, 700)
    assert writer.dropped == 0
    run = read_run(path)
    assert (run.complete, run.problems) == (True, ())
    assert same(run.recording, builder.recording())
    assert run.stages == run.recording.stages == STAGES
    assert run.configuration == CONFIGURATION
    assert repr(run.result) == repr(RESULT)
    assert run.events == (Event(700 * PERIOD_S, "warning", "bus error-passive", "Traceback …"),)
    assert list(read_frames(path)) == logged
    rng = random.Random(1)
    for cycle, one in enumerate(read_samples(path)):
        rng.randbytes(8), rng.randbytes(8)
        assert one == sample(cycle, rng)


@settings(max_examples=20, deadline=None)
@given(st.lists(SAMPLES, max_size=20))
def test_any_samples_to_the_bit(samples):
    with tempfile.TemporaryDirectory() as folder:
        path, builder = Path(folder) / "run.mcap", RecordingBuilder()
        with RunWriter(path, epoch_ns=0, block=True) as writer:
            for one in samples:
                writer.sample(one)
                builder.add(one)
        run = read_run(path)
        assert same(run.recording, builder.recording())
        assert repr(list(read_samples(path))) == repr(samples)


def test_every_fact_of_a_recording_is_kept():
    assert set(FACTS) <= FACT_NAMES
    builder = RecordingBuilder()
    builder.learn(**FACTS)
    recording = builder.recording()
    assert recording.torque_limit_nm == 400.0
    assert isinstance(recording.torque_limit_nm, float)
    assert recording.lag_prior == LagPrior(speed_lag_s=0.4, speed_lag_sd_s=0.01, source="drive")
    assert {field.name for field in fields(Recording)} == FACT_NAMES | {
        "time_s", "speed_rad_s", "torque_nm", "fresh", "limited", "excitation", "levels", "ramps", "stages", "complete",
        "commanded_torque_nm", "demanded_torque_nm", "position_rad"}


@pytest.mark.parametrize("batch", [0, 2 * 2**20])
def test_torque_setpoints_are_those_of_the_sample_s_own_command(tmp_path, batch):
    """They exist only in torque mode with an enabled drive. A sample with a lost command has none."""
    path, builder, rng = tmp_path / "run.mcap", RecordingBuilder(), random.Random(4)
    with RunWriter(path, epoch_ns=0, block=True) as writer:
        log = [(Command(rng.choice(list(Mode)), 1.0, rng.gauss(50.0, 9.0), rng.choice((0.0, 2.5))), sample(k, rng))
               for k in range(400)]
        for cycle, (command, one) in enumerate(log):
            kept = cycle % 50 != 7
            if kept:
                writer.command(one.time_s, command)
            writer.sample(one)
            builder.add(one, command if kept else None)
    recording = read_run(path, batch=batch).recording
    assert same(recording, builder.recording())
    for k, (command, one) in enumerate(log):
        enabled = one.state is PowerState.ENABLED
        told = enabled and one.mode is Mode.TORQUE and command.mode is Mode.TORQUE and k % 50 != 7
        assert recording.commanded_torque_nm[k] == command.torque_nm if told else np.isnan(
            recording.commanded_torque_nm[k])
        known = enabled and one.torque_demand_nm is not None
        assert recording.demanded_torque_nm[k] == one.torque_demand_nm if known else np.isnan(
            recording.demanded_torque_nm[k])


def test_angles_are_in_the_samples_that_had_one(tmp_path):
    """Samples without an angle have NaN, live, replayed and packed."""
    path = tmp_path / "run.mcap"
    builder = make_run(path, 700)
    position_rad = read_run(path).recording.position_rad
    assert position_rad is not None and len(position_rad) == 700
    told = [math.nan if one.position_rad is None else one.position_rad for one in read_samples(path)]
    assert np.array_equal(position_rad, told, equal_nan=True)
    assert np.flatnonzero(np.isfinite(position_rad)).tolist() == list(range(0, 700, 5))
    packed = tmp_path / "packed.npz"
    packed.write_bytes(pack_recording(builder.recording(), {}))
    kept = unpack_recording(packed)
    assert kept is not None and same(kept[0], builder.recording())
    assert kept[0].commanded_torque_nm is not None and kept[0].demanded_torque_nm is not None


def test_a_log_without_angles_has_none(tmp_path):
    """This log is from a release before this field existed."""
    old = read_run(Path(__file__).parents[1] / "fuzz" / "corpus" / "mcap" / "valid_run.mcap")
    assert len(old.recording.time_s) > 0
    assert old.recording.position_rad is None
    packed = tmp_path / "packed.npz"
    packed.write_bytes(pack_recording(old.recording, {}))
    kept = unpack_recording(packed)
    assert kept is not None and kept[0].position_rad is None


def test_the_rest_of_an_aborted_run_has_its_angles_and_setpoints(tmp_path):
    builder = RecordingBuilder()
    for cycle in range(1000):
        builder.add(sample(cycle, random.Random(cycle)), Command(Mode.TORQUE, 3.0, 100.0))
    builder.stage(Stage("hold", 0.0, 3.0, "aborted"))
    kept = before_abort(builder.recording())
    assert len(kept.time_s) == 500
    for signal in (kept.position_rad, kept.commanded_torque_nm, kept.demanded_torque_nm):
        assert signal is not None and len(signal) == 500


def test_numpy_numbers_do_not_make_the_live_run_differ(tmp_path):
    builder = RecordingBuilder()
    builder.learn(torque_offset_nm=np.float64(0.1), gear_ratio=np.int64(3), lag_prior=LagPrior(np.float32(0.25)))
    with RunWriter(tmp_path / "run.mcap", epoch_ns=0, block=True) as writer:
        writer.configuration({}, builder.facts)
    assert same(read_run(tmp_path / "run.mcap").recording, builder.recording())


def test_a_fact_that_no_recording_has_is_refused():
    with pytest.raises(TypeError, match="has no speed_of_light"):
        RecordingBuilder().learn(speed_of_light=1)


def test_collecting_continues_after_a_recording_was_taken():
    builder, rng = RecordingBuilder(), random.Random(3)
    builder.add(sample(0, rng))
    first = builder.recording()
    builder.add(sample(1, rng))
    assert (len(first.time_s), len(builder.recording().time_s)) == (1, 2)


def test_mcap_reads_it_and_the_times_are_right(tmp_path):
    path, epoch_ns = tmp_path / "run.mcap", 1_700_000_000_123_456_789
    make_run(path, 500, epoch_ns)
    counts = Counter()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().library.startswith("tdhil ")
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            assert schema.name == type(decoded).DESCRIPTOR.full_name
            assert message.log_time == message.publish_time
            if channel.topic in ("/sample", "/command", "/can"):
                assert message.log_time == epoch_ns + round(decoded.time_s * 1e9)
        statistics = reader.get_summary().statistics
    assert counts == {"/sample": 500, "/command": 500, "/can": 500, "/stage": 2, "/excitation": 2, "/event": 1,
                      "/log": 1, "/configuration": 1, "/result": 1}
    assert statistics.message_count == counts.total()
    assert statistics.message_start_time == epoch_ns
    assert statistics.chunk_count >= 500 * PERIOD_S / 0.5


def test_a_simulated_run_repeats_in_content(tmp_path):
    contents = []
    for name in ("one", "two"):
        make_run(tmp_path / name, 400)
        with (tmp_path / name).open("rb") as file:
            contents.append([
                (message.channel_id, message.log_time, message.data)
                for _, _, message in make_reader(file).iter_messages(log_time_order=False)])
    assert contents[0] == contents[1]


@pytest.mark.parametrize("time_s", [math.nan, math.inf, -5.0, 1e300])
def test_an_invalid_time_is_logged_as_the_one_before(tmp_path, time_s):
    path, rng = tmp_path / "run.mcap", random.Random(5)
    with RunWriter(path, epoch_ns=0, block=True) as writer:
        writer.sample(sample(100, rng))
        writer.command(time_s, Command(Mode.SPEED, 1.0, 0.0))
        writer.event(Event(time_s, "warning", "odd \udcff name"))
    with path.open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
    assert max(times) == 400_000_000
    assert read_run(path).events[0].text == "odd ? name"


def test_a_virtual_string_survives_a_round_trip_bit_for_bit(tmp_path):
    rng = random.Random(4)
    rows = [(PERIOD_S * cycle, *(rng.gauss(0.0, 1e3) for _ in VIRTUAL_COLUMNS[1:])) for cycle in range(700)]
    path = tmp_path / "virtual.mcap"
    with RunWriter(path, epoch_ns=0, block=True) as writer:
        log = RunLog(writer, {})
        for cycle, row in enumerate(rows):
            log.cycle(Command(Mode.TORQUE, 3.0, 100.0), sample(cycle, rng))
            log.virtual(row)
    for batch in (0, 2**21):
        found = read_run(path, batch=batch)
        assert found.virtual_string.tolist() == [list(row) for row in rows] == log.virtual_string.tolist()
        assert len(found.recording.time_s) == len(rows)
    make_run(tmp_path / "plain.mcap")
    assert read_run(tmp_path / "plain.mcap").virtual_string.shape == (0, len(VIRTUAL_COLUMNS))
