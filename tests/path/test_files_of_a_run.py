"""Logs, traces, reports: a live log is never moved, the last good one keeps its name, and no foreign file changes."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from sim_bus.trace import HEADER, NotATrace, ShaftTrace
from tdhil.errors import UsageError
from tdhil.recording.log_reader import read_run
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.mcap_container import MAGIC
from tdhil.recording.recording import Stage
from tdhil.session.log_files import LogPlace, is_live
from tests.path.path_runs import identify, tdhil

REFUSED = ("--simulate", "--seed", 1, "--fault", "wrong-identity", "--profile", "maxon/epos4")


def log_with(path: Path, *stages: str) -> Path:
    with RunWriter(path, epoch_ns=0, block=True) as writer:
        for number, name in enumerate(stages):
            writer.stage(Stage(name, float(number), number + 1.0, "ok"))
    return path


def open_at(path: Path) -> tuple[LogPlace, RunWriter]:
    place = LogPlace(path)
    return place, RunWriter(path, epoch_ns=0, block=True, opener=place.open)


def test_a_live_log_is_never_moved(tmp_path):
    first, writer = open_at(tmp_path / "run.mcap")
    writer.stage(Stage("setup", 0.0, 1.0, "ok"))
    other, second = open_at(tmp_path / "run.mcap")
    assert is_live(first.path)
    assert other.live
    assert other.path != first.path
    assert other.older is None
    for one in (second, writer):
        one.close()
    assert [stage.name for stage in read_run(first.path).stages] == ["setup"]
    assert not is_live(first.path)
    third, writer = open_at(tmp_path / "run.mcap")
    writer.close()
    assert (third.path, third.live) == (tmp_path / "run.mcap", False)
    assert third.older is not None


def test_runs_begun_at_once_share_no_file(tmp_path):
    taken: list[tuple[LogPlace, RunWriter]] = []
    gate = threading.Barrier(8)

    def begin() -> None:
        gate.wait()
        taken.append(open_at(tmp_path / "run.mcap"))

    threads = [threading.Thread(target=begin) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    paths = {place.path for place, _ in taken}
    assert len(paths) == 8
    assert all(place.older is None for place, _ in taken)
    assert set(tmp_path.iterdir()) == paths
    for _, writer in taken:
        writer.close()


def test_a_second_run_in_the_folder_of_a_live_one_says_where_its_log_is(tmp_path):
    held, writer = open_at(tmp_path / "run.mcap")
    done = identify(tmp_path, *REFUSED)
    writer.close()
    (own,) = [path for path in tmp_path.glob("run*.mcap") if path != held.path]
    assert done.document["log"] == str(own)
    assert own.name in done.err.replace("\n", "")
    assert "another run writes" in done.err
    assert held.path == tmp_path / "run.mcap"
    assert read_run(own).complete


def test_a_refusal_leaves_the_last_good_log_in_its_place(tmp_path):
    good = log_with(tmp_path / "run.mcap", "setup", "speed", "torque")
    before = good.read_bytes()
    for _ in range(2):
        done = identify(tmp_path, *REFUSED)
        assert done.code == 4, done.err
        assert good.read_bytes() == before
        assert sorted(path.name for path in tmp_path.glob("*.mcap")) == ["run.mcap", "run.refused.mcap"]
        assert done.document["log"] == str(tmp_path / "run.refused.mcap")
        assert "run.refused.mcap" in done.err.replace("\n", "")
    assert read_run(tmp_path / "run.refused.mcap").complete


def test_a_refusal_that_follows_a_refusal_is_the_newer_log(tmp_path):
    log_with(tmp_path / "run.mcap", "setup")
    done = identify(tmp_path, *REFUSED)
    assert done.document["log"] == str(tmp_path / "run.mcap")
    assert not (tmp_path / "run.refused.mcap").exists()
    assert len(list(tmp_path.glob("run-*.mcap"))) == 1


def test_a_bus_that_can_not_be_opened_is_no_reason_to_lose_the_last_log_s_name(tmp_path):
    good = log_with(tmp_path / "run.mcap", "setup", "speed")
    before = good.read_bytes()
    done = tdhil("identify", "--log", good, "-i", "socketcan", "-c", "no_such_can")
    assert done.code == 4
    assert good.read_bytes() == before
    assert "was kept as" not in done.err      # it has its former name
    replayed = tdhil("replay", tmp_path / "run.refused.mcap")
    assert replayed.code == 4
    assert "nothing to identify from: no_such_can" in replayed.err


# -- foreign files ------------------------------------------------------------------------------


@pytest.fixture
def bench(tmp_path):
    (tmp_path / "rig.yaml").write_text("node: 1\nrun: {seed: 1}\n")
    (tmp_path / "notes.txt").write_text("mine")
    log_with(tmp_path / "other.mcap", "setup")
    return tmp_path


@pytest.mark.parametrize(("option", "name", "said"), [
    ("--log", "rig.yaml", "is also the file of --rig"),
    ("--log", "notes.txt", "is not a log; it was left unchanged"),
    ("--report", "rig.yaml", "already exists and was not overwritten"),
    ("--report", "run.mcap", "the log itself"),
    ("--report", "notes.txt", "already exists and was not overwritten"),
    ("--report", "other.mcap", "already exists and was not overwritten"),
    ("--trace", "rig.yaml", "is also the file of --rig"),
    ("--trace", "run.mcap", "is also the file of --log"),
    ("--trace", "notes.txt", "holds something else"),
    ("--trace", "other.mcap", "holds something else"),
])
def test_no_file_of_somebody_else_is_touched(bench, monkeypatch, option, name, said):
    monkeypatch.chdir(bench)
    before = {path: path.read_bytes() for path in bench.iterdir()}
    done = tdhil("identify", "--simulate", "--rig", "rig.yaml", option, name)
    assert done.code == 2, done.err
    assert said in done.err.replace("\n", " ")
    assert name in done.err
    assert {path: path.read_bytes() for path in bench.iterdir()} == before      # nor was a log started


def test_a_replay_s_report_goes_over_nothing_either(bench, monkeypatch):
    monkeypatch.chdir(bench)
    done = tdhil("replay", "other.mcap", "--report", "rig.yaml")
    assert (done.code, (bench / "rig.yaml").read_text()) == (2, "node: 1\nrun: {seed: 1}\n")
    assert "Name another file, or move the existing one" in " ".join(done.err.split())


def test_a_report_created_during_the_run_is_not_overwritten(tmp_path, monkeypatch):
    from tdhil.report import html

    monkeypatch.setattr(html, "report_of", lambda *_: None)
    monkeypatch.setattr(html, "replace", lambda report, **_: report)
    monkeypatch.setattr(html, "report_page", lambda *_: "page")
    (tmp_path / "r.html").write_text("mine")
    (tmp_path / "r-2.html").write_text("mine too")
    assert html.write_report({"log": "run.mcap"}, None, tmp_path / "r.html") == tmp_path / "r-3.html"
    assert [(tmp_path / f"r{n}.html").read_text() for n in ("", "-2", "-3")] == ["mine", "mine too", "page"]


def test_a_recovered_copy_overwrites_no_other_file(bench):
    done = tdhil("recover", bench / "other.mcap", "-o", bench / "notes.txt")
    assert (done.code, (bench / "notes.txt").read_text()) == (2, "mine")


def test_a_trace_overwrites_an_older_trace_only(tmp_path):
    path = tmp_path / "shaft.csv"
    path.write_text(HEADER + "0.01,1,2,ready,\n")
    ShaftTrace(path).close()
    assert path.read_text() == HEADER
    path.write_text("")
    ShaftTrace(path).close()
    path.write_text("time_s,mine\n")
    with pytest.raises(NotATrace, match="holds something else"):
        ShaftTrace(path)
    assert path.read_text() == "time_s,mine\n"


def test_a_log_does_not_overwrite_a_foreign_file(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text("kind: sine\n")
    with pytest.raises(UsageError, match="is not a log"):
        LogPlace(path).open(path)
    path.write_bytes(MAGIC)      # a log under another name is a log
    LogPlace(path).open(path).close()

