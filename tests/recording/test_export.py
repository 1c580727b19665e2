"""Export of logs: events and layout for viewers, and frames and samples in formats of other programs."""

import csv
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import can
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tdhil.cli.main import main
from tdhil.recording.builder import RecordingBuilder
from tdhil.recording.log_format import CHANNELS, CLASSES, MODBUS, Event
from tdhil.recording.log_reader import read_frames, read_run, read_samples
from tdhil.recording.log_writer import RunWriter
from tests.recording.log_runs import FACTS, PERIOD_S, fill, make_run

EPOCH_NS = 1_780_000_000_000_000_000
LAYOUT = Path(__file__).parents[2] / "examples" / "foxglove_layout.json"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "run.mcap"
    make_run(path, 300, EPOCH_NS)
    return path


def decoded(path, topic):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(schema.name, message.log_time, content)
                for schema, _, message, content in reader.iter_decoded_messages(topics=[topic])]


def test_events_are_a_log_for_viewers(tmp_path):
    path = tmp_path / "run.mcap"
    with RunWriter(path, epoch_ns=EPOCH_NS, block=True) as writer:
        for time_s, kind in ((0.5, "plan"), (1.25, "failure"), (2.0, "bus")):
            writer.event(Event(time_s, kind, f"what {kind} says"))
    found = decoded(path, "/log")
    assert [name for name, *_ in found] == ["foxglove.Log"] * 3
    assert [(one.level, one.message) for _, _, one in found] == [
        (2, "plan: what plan says"), (4, "failure: what failure says"), (3, "bus: what bus says")]
    for _, log_time, one in found:
        assert 10**9 * one.timestamp.seconds + one.timestamp.nanos == log_time
    assert type(found[0][2]).DESCRIPTOR.fields_by_name["level"].enum_type.full_name == "foxglove.Log.Level"
    assert [event.kind for event in read_run(path).events] == ["plan", "failure", "bus"]      # once, by tdhil


def test_a_rehearsal_is_marked_once_for_viewers(tmp_path):
    path = tmp_path / "run.mcap"
    run = {"faults": ["sto@hold+2s", "spike=3"]}
    with RunWriter(path, epoch_ns=EPOCH_NS, block=True) as writer:
        writer.configuration({"faults": []}, {})
        writer.configuration(run, {})
        writer.event(Event(2.0, "plan", "a plan"))
        writer.configuration(run, {})
    first, second = [(one.level, one.message, log_time) for _, log_time, one in decoded(path, "/log")]
    assert first == (3, "FAULT REHEARSAL: sto@hold+2s, spike=3. The drive is simulated. The history of the rig does not"
                     " include this run", EPOCH_NS)
    assert second[1] == "plan: a plan"
    assert [event.kind for event in read_run(path).events] == ["plan"]


def test_the_frequency_response_is_in_arrays_for_viewers(tmp_path):
    path = tmp_path / "run.mcap"

    def estimate(value):
        return {"value": value, "low": 0.9 * value, "high": None}

    lines = [{"hertz": hertz, "magnitude": estimate(1.0 / hertz), "phase_rad": estimate(-1.0),
              "apparent_inertia_kg_m2": estimate(104.0), "noise_rel": 0.01, "distortion_rel": 0.0, "coherence": 1.0}
             for hertz in (0.1, 0.2)]
    document = {"verdict": "valid", "frequency_response": {"lines": lines, "distortion": {"detected": True}}}
    with RunWriter(path, epoch_ns=EPOCH_NS, block=True) as writer:
        fill(writer, RecordingBuilder(), 20)
        writer.result(document)
    ((schema, _, found),) = decoded(path, "/frf")
    assert schema == "tdhil.Response"
    assert list(found.hertz) == [0.1, 0.2] and list(found.magnitude) == [10.0, 5.0]
    assert list(found.magnitude_low) == [9.0, 4.5] and all(math.isnan(one) for one in found.magnitude_high)
    assert found.distortion_detected
    assert read_run(path).result == document           # the read-back data are the document


def test_modbus_bytes_have_their_own_topic(tmp_path):
    path = tmp_path / "run.mcap"
    with RunWriter(path, epoch_ns=0, block=True, frames=MODBUS) as writer:
        logged = fill(writer, RecordingBuilder(), 50)
    assert decoded(path, "/can") == []
    assert sum(len(one.frames) for _, _, one in decoded(path, "/modbus")) == len(logged)
    assert list(read_frames(path)) == logged


def test_a_log_contains_its_start_time(log, tmp_path):
    assert read_run(log).epoch_ns == EPOCH_NS
    make_run(tmp_path / "old.mcap", 10, 0)          # as in older logs of stepped runs
    assert read_run(tmp_path / "old.mcap").epoch_ns == 0


@pytest.mark.parametrize(("to", "reader"), [("candump", can.CanutilsLogReader), ("asc", can.ASCReader)])
def test_frames_for_can_tools(log, tmp_path, to, reader):
    target = tmp_path / "frames"
    assert main(["export", str(log), "--to", to, "-o", str(target)]) == 0
    frames, read = list(read_frames(log)), list(reader(target))
    assert [(one.arbitration_id, bytes(one.data), one.is_rx) for one in read] == [
        (one.identifier, one.data, not one.outgoing) for one in frames]
    first = read[0].timestamp
    for one, frame in zip(read, frames, strict=True):
        assert one.timestamp - first == pytest.approx(frame.time_s - frames[0].time_s, abs=2e-6)
    if to == "candump":
        assert first == pytest.approx(EPOCH_NS / 1e9, abs=1e-5)


@pytest.mark.skipif(shutil.which("log2asc") is None, reason="no log2asc (can-utils) here")
def test_can_utils_reads_the_candump_log(log, tmp_path):
    target = tmp_path / "frames.log"
    assert main(["export", str(log), "--to", "candump", "-o", str(target)]) == 0
    done = subprocess.run(["log2asc", "can0"], input=target.read_bytes(), capture_output=True, check=True)
    lines = [line for line in done.stdout.decode().splitlines() if " d " in line]
    assert len(lines) == len(list(read_frames(log)))


def test_samples_as_csv_to_the_last_bit(log, tmp_path):
    target = tmp_path / "samples.csv"
    assert main(["export", str(log), "--to", "csv", "-o", str(target)]) == 0
    with target.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    samples = list(read_samples(log))
    assert [(float(r["time_s"]), float(r["speed_rad_s"]), float(r["torque_nm"])) for r in rows] == [
        (one.time_s, one.speed_rad_s, one.torque_nm) for one in samples]
    assert [r["position_rad"] for r in rows] == ["" if one.position_rad is None else repr(one.position_rad)
                                                for one in samples]
    assert [r["state"] for r in rows] == [one.state.value for one in samples]
    assert {r["commanded_torque_nm"] for r in rows} == {"100.0"}
    assert {r["simulated"] for r in rows} == {"1"}
    assert float(rows[1]["time_s"]) == PERIOD_S


def test_samples_as_parquet(log, tmp_path):
    duckdb = pytest.importorskip("duckdb")
    target = tmp_path / "samples.parquet"
    assert main(["export", str(log), "--to", "parquet", "-o", str(target)]) == 0
    found = duckdb.sql(f"SELECT * FROM read_parquet('{target}')")
    types = dict(zip(found.columns, map(str, found.types), strict=True))
    assert (types["torque_nm"], types["state"], types["fresh"]) == ("DOUBLE", "VARCHAR", "BIGINT")
    table = dict(zip(found.columns, zip(*found.fetchall(), strict=True), strict=True))
    samples = list(read_samples(log))
    for name in ("time_s", "speed_rad_s", "torque_nm", "torque_demand_nm", "position_rad"):
        assert list(table[name]) == [getattr(one, name) for one in samples]


def test_missing_data_are_reported_in_one_line(log, tmp_path, capsys, monkeypatch):
    there = tmp_path / "there.csv"
    there.write_text("mine")
    monkeypatch.setitem(sys.modules, "duckdb", None)
    modbus = tmp_path / "modbus.mcap"
    with RunWriter(modbus, epoch_ns=0, block=True, frames=MODBUS) as writer:
        writer.configuration({"drive": "modbus"}, {})
        fill(writer, RecordingBuilder(), 5)
        writer.configuration({"drive": "modbus"}, {"simulated": FACTS["simulated"]})
    for arguments, said in (
        ([str(log), "--to", "csv", "-o", str(there)], "already exists"),
        ([str(log), "--to", "parquet", "-o", str(tmp_path / "a")], "pip install 'duckdb"),
        ([str(tmp_path / "no.mcap"), "--to", "csv"], "this log does not exist"),
        ([str(modbus), "--to", "candump", "-o", str(tmp_path / "b")], "contains no CAN frames"),
    ):
        assert main(["export", *arguments]) == 2
        err = capsys.readouterr().err
        assert said in err
        assert err.count("\n") == 1
    assert there.read_text() == "mine"
    assert not (tmp_path / "b").exists()


def test_a_truncated_log_exports_its_data(log, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-9000])
    assert main(["export", str(cut), "--to", "csv"]) == 3
    assert len((tmp_path / "cut.csv").read_text().splitlines()) > 50
    assert "cut or damaged" in capsys.readouterr().err


def test_the_layout_names_the_topics_of_a_log():
    layout = json.loads(LAYOUT.read_text(encoding="utf-8"))
    panels = layout["configById"]
    known = {topic: CLASSES[message].DESCRIPTOR.fields_by_name for topic, message in CHANNELS.values()}
    paths = [one["value"] for panel in panels.values() for one in panel.get("paths", ())]
    paths += [panel["xAxisPath"]["value"] for panel in panels.values() if "xAxisPath" in panel]
    paths += [panel[name] for panel in panels.values() for name in ("topicToRender", "topicPath") if name in panel]
    assert len(paths) > 8
    assert {"/frf", "/live_inertia"} <= {path.partition(".")[0] for path in paths}
    for path in paths:
        topic, _, field = path.removesuffix("[:]").partition(".")
        assert not field or field in known[topic], path

    def leaves(node):
        return [node] if isinstance(node, str) else [*leaves(node["first"]), *leaves(node["second"])]

    assert sorted(leaves(layout["layout"])) == sorted(panels)
