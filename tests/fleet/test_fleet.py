"""Many logs in one table: complete, truncated, corrupt, foreign, poisoned; interrupted and restarted; each executor."""

import json
import os
import random
import re
import shutil
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tdhil import process_pool
from tdhil.cli import fleet as fleet_command
from tdhil.cli.fleet import _result_text
from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.fleet import (
    FleetRequest,
    FleetRow,
    FleetSettings,
    FleetSummary,
    LogTask,
    compare_document,
    find_logs,
    identified,
    identify_log,
    read_table,
    run_fleet,
    trend_document,
)
from tdhil.fleet import cluster as cluster_module
from tdhil.process_pool import TaskLimits
from tests.fleet import poison
from tests.fleet.killer import Killer, cluster_processes
from tests.fleet.simulated_logs import write_log

pytestmark = pytest.mark.one_worker("fleet")


@pytest.fixture
def calls(tmp_path, monkeypatch):
    path = tmp_path / "calls.txt"
    path.touch()
    monkeypatch.setenv("TDHIL_CALLS", str(path))
    return path


def many(folder, count, bad=()):
    """Write this number of small files that `poison.quick` accepts as logs."""
    folder.mkdir(exist_ok=True)
    for number in range(count):
        (folder / f"{number:03d}.mcap").write_bytes(f"log {number}".encode())
    for number, head in enumerate(bad):
        (folder / f"bad{number}.mcap").write_bytes(head)
    return (str(folder),)


def trace(folder, record):
    """Write the samples of a recording as a CSV with its sidecar."""
    columns = zip(record.time_s, record.speed_rad_s * 60 / 2 / np.pi, record.torque_nm, strict=True)
    (folder / "trace.csv").write_text("t,n,m\n" + "".join(f"{t:.5f},{n:.6f},{m:.6f}\n" for t, n, m in columns))
    (folder / "trace.yaml").write_text(
        "rig: R9\ndate: 2026-05-01T12:00:00\ncolumns: ['time=t:s', 'speed=n:rpm', 'torque=m:Nm']\n"
        "torque_scale_rel_sd: 0.02\n")


def test_one_log_gives_the_result_of_replay(few):
    import tdhil

    done = identify_log(LogTask(str(few / "R1-001.mcap")))
    result = tdhil.identify(tdhil.read(few / "R1-001.mcap"))
    row = done.row
    assert (row.verdict, row.inertia_kg_m2) == (result.verdict.value, result.inertia.value)
    assert (row.inertia_low_kg_m2, row.inertia_high_total_kg_m2) == (result.inertia.low, result.inertia.high_total)
    assert (row.rig, row.drive_serial, row.profile, row.torque_scale_rel_sd) == ("R1", 1, "generic/cia402", 0.03)
    assert row.date == "2026-01-12T08:00:00+00:00"
    assert row.speed_lag_low_s < 0.4 < row.speed_lag_high_s


@pytest.mark.heavy
def test_a_result_from_a_part_of_a_run_is_marked(few, tmp_path, capsys):
    """The row, the summary, trend, compare and watch mark it. The row of a whole run has no mark."""
    import tdhil

    logs = tmp_path / "logs"
    logs.mkdir()
    recording = tdhil.read(few / "R1-001.mcap").recording
    for number in range(5):
        write_log(logs / f"{number}.mcap", recording, "R1", number, aborted_by="DriveFault" if number == 3 else None)
    whole = (logs / "4.mcap").read_bytes()
    (logs / "4.mcap").write_bytes(whole[:len(whole) * 9 // 10])
    out = tmp_path / "fleet.sqlite"
    assert main(["fleet", str(logs), "--out", str(out), "--jobs", "1"]) == 0
    text = capsys.readouterr().out
    assert "from a part of the run:" in text
    assert "3.mcap: aborted in stage acquire (DriveFault)" in text
    assert "4.mcap: log cut short" in text
    assert "5 of them SIMULATED" in text
    rows = read_table(out)
    assert [(row.aborted_stage, row.aborted_by, row.complete) for row in rows] == [
        *[(None, None, True)] * 3, ("acquire", "DriveFault", True), (None, None, False)]
    assert [row.verdict in ("valid", "valid_wide") for row in rows] == [True] * 5
    found = trend_document(rows, "R1")
    (note,) = (note for note in found["notes"] if "part" in note)
    assert note.startswith("2 results from a part of the run (") and note.endswith("log cut short): left out")
    assert "3.mcap: aborted in stage acquire (DriveFault)" in note
    assert found["results"] == 3
    compared = compare_document([identified(logs / f"{number}.mcap", FleetSettings()) for number in (2, 3)])
    assert next(one for one in compared["settings"] if one["name"] == "run") == {
        "name": "run", "values": ["whole", "aborted in stage acquire (DriveFault)"], "differs": True}
    assert compared["differences"][0]["text"].endswith("3.mcap: aborted in stage acquire (DriveFault)")
    assert main(["watch", str(logs), "--once", "--out", str(out), "--jobs", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.rpartition(" %")[2] for line in lines] == [
        "", "", "", ", aborted in stage acquire (DriveFault)", ", log cut short"]
    assert re.search(r"^SIMULATED .*0.mcap: valid\w*, J, 95 % interval: \d+\.?\d* \(", lines[0])
    assert max(len(number) for number in re.findall(r"[\d.]+ to|to [\d.]+", lines[0])) <= len("104.5 to")


@pytest.mark.heavy
def test_the_cache_gives_the_same_to_the_last_bit(few, tmp_path):
    task = LogTask(str(few / "R1-000.mcap"), FleetSettings(confidence=0.9), str(tmp_path))
    first, second = identify_log(task), identify_log(task)
    plain = identify_log(replace(task, cache=None))
    assert (first.cached, second.cached) == (False, True)
    assert repr(first.row) == repr(second.row) == repr(plain.row)
    (kept,) = tmp_path.iterdir()
    kept.write_bytes(kept.read_bytes()[:-500])             # damaged: read and written again
    assert repr(identify_log(task).row) == repr(first.row)
    assert identify_log(task).cached
    copy = tmp_path / "copy.mcap"
    shutil.copy(few / "R1-000.mcap", copy)
    again = identify_log(replace(task, log=str(copy)))
    assert again.cached
    assert again.row == replace(first.row, log=str(copy))


@pytest.mark.heavy
def test_one_process_two_or_a_cluster_of_two_give_the_same_table(few, tmp_path):
    """This is a small version of benchmarks/fleet_thousand.py."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed (pip install '.[cluster]')")
    request = FleetRequest((str(few),), tmp_path / "one.csv", cache=False)
    tables = [run_fleet(request).rows, run_fleet(replace(request, out=tmp_path / "two.csv", jobs=2)).rows]
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        there = replace(request, out=tmp_path / "there.csv", scheduler=cluster.scheduler_address)
        tables.append(run_fleet(there).rows)
    assert len({tuple(repr(row) for row in rows) for rows in tables}) == 1


@pytest.mark.heavy
def test_a_cluster_s_processes_killed_at_random(tmp_path, calls):
    """Dask's workers and their processes are killed. No row is lost and none is duplicated."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed (pip install '.[cluster]')")
    import dask

    roots = many(tmp_path / "logs", 60)
    with dask.config.set({"distributed.scheduler.allowed-failures": 10}), distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        killer = Killer(6, lambda: cluster_processes(cluster, workers_too=True))
        request = FleetRequest(roots, tmp_path / "fleet.csv", scheduler=cluster.scheduler_address)
        summary = run_fleet(request, killer, function=poison.quick)
    assert killer.kills == 6
    assert [Path(row.log).name for row in read_table(tmp_path / "fleet.csv")] == [f"{k:03d}.mcap" for k in range(60)]
    assert {row.verdict for row in summary.rows} == {"valid"}


@pytest.mark.heavy
def test_every_kind_of_file_has_its_row(few, tmp_path):
    import tdhil

    folder = tmp_path / "logs"
    shutil.copytree(few, folder)
    trace(folder, tdhil.read(few / "R1-000.mcap").recording)
    (folder / "wrong.csv").write_text("t,n\n1,2\n")
    (folder / "wrong.yaml").write_text("rig: R9\ncolour: red\n")
    summary = run_fleet(FleetRequest((str(folder),), tmp_path / "fleet.csv", jobs=1))
    rows = {Path(row.log).name: row for row in summary.rows}
    assert rows == {Path(row.log).name: row for row in read_table(tmp_path / "fleet.csv")}
    assert {name for name, row in rows.items() if not row.failed} == {
        "R1-000.mcap", "R1-001.mcap", "R1-002.mcap", "cut.mcap", "trace.csv"}
    assert (rows["trace.csv"].rig, rows["trace.csv"].torque_scale_rel_sd) == ("R9", 0.02)
    assert not rows["cut.mcap"].complete
    assert {name: row.error_text for name, row in rows.items() if row.failed} == {
        "empty.mcap": "the file is empty. Give a run.mcap of tdhil, or a trace that ends in .csv",
        "other.mcap": "this is not an MCAP file. Give a run.mcap of tdhil, or a trace that ends in .csv",
        "corrupt.mcap": "an MCAP file, but not a run of this tool. Give a run.mcap of this tool",
        "wrong.csv": rows["wrong.csv"].error_text}
    assert "colour" in rows["wrong.csv"].error_text
    assert (summary.bare_traces, summary.exit_code) == (1, 3)


@pytest.mark.heavy
def test_poisoned_logs_are_isolated(tmp_path, calls, monkeypatch):
    """The time limit counts only while no other log is left, so a slow computer loses no other logs."""
    bad, seen = (poison.KILLS, poison.HANGS, poison.EATS, poison.OUTSIDE), []
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() if len(seen) == 15 else 0.0)
    monkeypatch.setattr(process_pool, "time", clock)
    progress = SimpleNamespace(start=lambda total, done: None, done=seen.append)
    roots = many(tmp_path / "logs", 12, bad)
    limits = TaskLimits(2.0, 300_000_000)
    request = FleetRequest(roots, tmp_path / "fleet.sqlite", jobs=2, limits=limits)
    rows = {Path(row.log).name: row for row in run_fleet(request, progress, function=poison.quick).rows}
    assert len(rows) == 16
    assert {name: row.error_kind for name, row in rows.items() if row.failed} == {
        "bad0.mcap": "ProcessDied", "bad1.mcap": "TimeLimit", "bad2.mcap": "MemoryError", "bad3.mcap": "ProcessDied"}


@pytest.mark.heavy
def test_killed_at_random_no_row_is_lost_or_duplicated(tmp_path, calls):
    rng, pools = random.Random(2), []

    class Killer:
        def start(self, total, done): ...

        def done(self, row):
            if len(pools) < 10 and rng.random() < 0.4:
                children = [int(pid) for pid in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()]
                victims = [pid for pid in children if b"process_pool" in Path(f"/proc/{pid}/cmdline").read_bytes()]
                if victims:
                    os.kill(rng.choice(victims), signal.SIGKILL)
                    pools.append(1)

    roots = many(tmp_path / "logs", 60)
    summary = run_fleet(FleetRequest(roots, tmp_path / "fleet.csv", jobs=2), Killer(), function=poison.quick)
    assert len(pools) == 10
    assert [Path(row.log).name for row in read_table(tmp_path / "fleet.csv")] == [f"{k:03d}.mcap" for k in range(60)]
    assert {row.verdict for row in summary.rows} == {"valid"}


@pytest.mark.heavy
def test_interrupted_and_started_again_only_the_rest_is_done(tmp_path, calls):
    class Impatient:
        seen = 0

        def start(self, total, done): ...

        def done(self, row):
            self.seen += 1
            if self.seen == 15:
                raise KeyboardInterrupt

    request = FleetRequest(many(tmp_path / "logs", 40), tmp_path / "fleet.csv", jobs=2)
    first = run_fleet(request, Impatient(), function=poison.quick)
    assert (first.interrupted, len(first.rows), first.left) == (True, 15, 25)
    assert len(read_table(request.out)) == 15
    calls.write_text("")
    (tmp_path / "logs" / "003.mcap").rename(tmp_path / "logs" / "moved.mcap")      # recognised by its content
    second = run_fleet(request, function=poison.quick)
    assert (len(second.rows), second.left) == (40, 0)
    done = calls.read_text().split()
    assert len(done) == len(set(done)) == 40 - second.done_before
    assert second.done_before == 15
    again = run_fleet(request, function=poison.quick)
    assert (again.done_before, again.rows) == (40, second.rows)
    (tmp_path / "logs" / "004.mcap").write_bytes(b"changed")
    assert run_fleet(request, function=poison.quick).done_before == 39
    assert run_fleet(replace(request, settings=FleetSettings(confidence=0.9)), function=poison.quick).done_before == 0
    assert run_fleet(replace(request, again=True), function=poison.quick).done_before == 0


@pytest.mark.heavy
def test_a_stop_abandons_the_logs_in_progress(tmp_path, calls):
    """This includes a log that hangs. A second call identifies the rest."""
    request = FleetRequest(many(tmp_path / "logs", 30, (poison.HANGS,)), tmp_path / "fleet.csv", jobs=2)
    seen = []

    class Counting:
        def start(self, total, done): ...

        def done(self, row):
            seen.append(row)

    first = run_fleet(request, Counting(), poison.quick, stop=lambda: len(seen) >= 10)
    assert first.interrupted
    assert 10 <= len(first.rows) == 31 - first.left < 30
    (tmp_path / "logs" / "bad0.mcap").unlink()
    second = run_fleet(request, function=poison.quick, stop=lambda: False)
    assert (second.interrupted, second.done_before, second.left) == (False, len(first.rows), 0)


@pytest.mark.heavy
def test_ctrl_c_in_a_terminal_and_the_same_command_again(tmp_path, calls):
    """The whole foreground group receives the signal, as from a keyboard. The worker processes are not in it."""
    pytest.importorskip("pty")
    from tests.fleet.terminal import fleet_with_ctrl_c

    (folder,) = many(tmp_path / "logs", 120)
    out = tmp_path / "fleet.csv"
    arguments = [folder, "--out", str(out), "--jobs", "2"]
    assert fleet_with_ctrl_c("quick_at_first", arguments, lambda: len(calls.read_text().split()) >= 20) == 130
    done = {row.log for row in read_table(out)}
    assert 10 <= len(done) < 120                       # of twenty begun logs, those in progress are lost
    calls.write_text("")
    summary = run_fleet(FleetRequest((folder,), out, jobs=2), function=poison.quick)
    assert (summary.done_before, len(summary.rows)) == (len(done), 120)
    assert sorted(calls.read_text().split()) == sorted({row.log for row in summary.rows} - done)


def test_live_logs_and_pipes_are_ignored(tmp_path):
    fcntl = pytest.importorskip("fcntl")
    many(tmp_path / "logs", 2)
    os.mkfifo(tmp_path / "logs" / "pipe.mcap")
    with (tmp_path / "logs" / "001.mcap").open("ab") as file:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX)
        found = find_logs((str(tmp_path / "logs"),))
    assert [Path(log).name for log in found.logs] == ["000.mcap"]
    assert [Path(log).name for log in found.live] == ["001.mcap"]
    with pytest.raises(UsageError, match="no such file or folder"):
        find_logs((str(tmp_path / "none"),))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="no log is there"):
        run_fleet(FleetRequest((str(tmp_path / "empty"),), tmp_path / "fleet.csv"))


def test_a_log_that_may_not_be_read_has_a_row(tmp_path, few, monkeypatch):
    """It is tried again the next time, since its content is unknown."""
    log = tmp_path / "locked.mcap"
    shutil.copy(few / "R1-000.mcap", log)
    from tdhil.fleet import task

    def refuse(path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(task, "content_hash", refuse)
    row = identify_log(LogTask(str(log))).row
    assert (row.error_kind, row.error_text, row.sha256) == ("PermissionError", "can't be read: Permission denied", None)


@pytest.fixture
def bucket(few):
    """Put two logs and another file into fsspec's memory, which only this process has."""
    memory = pytest.importorskip("fsspec").filesystem("memory")
    memory.put(str(few / "R1-000.mcap"), "/logs/R1-000.mcap")
    memory.pipe({"/logs/below/empty.mcap": b"", "/logs/read.me": b"no log"})
    yield "memory://logs"
    memory.rm("/logs", recursive=True)


@pytest.mark.heavy
def test_logs_behind_an_address(few, bucket, monkeypatch):
    assert find_logs((bucket,)).logs == ("memory:///logs/R1-000.mcap", "memory:///logs/below/empty.mcap")
    assert find_logs((f"{bucket}/R1-000.mcap",)).logs == ("memory:///logs/R1-000.mcap",)
    here, there = (identify_log(LogTask(log)).row for log in (str(few / "R1-000.mcap"), f"{bucket}/R1-000.mcap"))
    assert repr(replace(there, log=here.log)) == repr(here)
    assert identify_log(LogTask(f"{bucket}/below/empty.mcap")).row.error_text.startswith("the file is empty")
    assert identify_log(LogTask(f"{bucket}/none.mcap")).row.error_kind == "FileNotFoundError"
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(UsageError, match=r"library for this address is missing.*\[s3\]"):
        find_logs(("s3://bucket/logs",))


def test_an_unreachable_address_is_no_bug(bucket, monkeypatch):
    from fsspec.implementations.memory import MemoryFileSystem

    class NoCredentials(Exception):
        """Exception without a known base class, as boto raises."""

    def refuse(*_, **__):
        raise NoCredentials("no credentials")

    monkeypatch.setattr(MemoryFileSystem, "_open", refuse)
    row = identify_log(LogTask(f"{bucket}/R1-000.mcap")).row
    assert (row.error_kind, row.sha256) == ("LogError", None)
    assert "can't be fetched: no credentials" in row.error_text
    monkeypatch.setattr(MemoryFileSystem, "isfile", refuse)
    with pytest.raises(UsageError, match="can't be listed"):
        find_logs((bucket,))


@pytest.mark.heavy
def test_an_identified_log_behind_an_address_is_not_fetched_again(tmp_path, calls):
    """The address is file://, which the processes of the pool also reach."""
    pytest.importorskip("fsspec")
    (folder,) = many(tmp_path / "logs", 4)
    request = FleetRequest((f"file://{folder}",), tmp_path / "fleet.csv", jobs=1)
    first = run_fleet(request, function=poison.quick_anywhere)
    assert [row.log for row in first.rows] == [f"file://{folder}/{k:03d}.mcap" for k in range(4)]
    (tmp_path / "logs" / "002.mcap").write_bytes(b"another")
    second = run_fleet(request, function=poison.quick_anywhere)
    assert (second.done_before, len(second.rows)) == (3, 4)


@pytest.mark.heavy
def test_a_cluster_gives_the_same_table(tmp_path, calls, monkeypatch):
    """Dask's scheduler and a worker run in this process. The log is read in another process, as always."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed (pip install '.[cluster]')")
    roots = many(tmp_path / "logs", 6, (poison.KILLS,))
    here = run_fleet(FleetRequest(roots, tmp_path / "here.csv", jobs=1), function=poison.quick)
    how = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(**how) as cluster:
        request = FleetRequest(roots, tmp_path / "there.csv", scheduler=cluster.scheduler_address)
        there = run_fleet(request, function=poison.quick)
        assert [repr(row) for row in there.rows] == [repr(row) for row in here.rows]
        stopped = run_fleet(replace(request, again=True), function=poison.quick, stop=lambda: True)
        assert (stopped.interrupted, stopped.left) == (True, 7)
        monkeypatch.setattr(cluster_module, "versions", their_versions)
        with pytest.raises(UsageError, match=r"has numpy 1.0 \(here 2"):
            run_fleet(replace(request, again=True), function=poison.quick)
    with pytest.raises(UsageError, match="no Dask scheduler answers"):
        run_fleet(replace(request, again=True), function=poison.quick)


def test_a_result_is_printed_with_the_coverage_of_its_interval():
    """With --confidence 0.5, intervals of 50 % looked like those of 95 %."""
    row = FleetRow("run.mcap", "valid", inertia_kg_m2=104.0, inertia_low_total_kg_m2=100.0,
                   inertia_high_total_kg_m2=108.0, confidence=0.5)
    assert _result_text(row) == "valid, J, 50 % interval: 104.0 (100.0 to 108.0) kg·m²  ±3.9 %"
    assert _result_text(replace(row, confidence=None)).startswith("valid, J 104.0 (")      # a row without it


def test_a_run_refused_before_motion_is_no_failure_of_the_fleet(tmp_path):
    """The log run.refused.mcap of tdhil is complete. It has no result, and none is expected."""
    rows = (FleetRow("run.mcap", "valid"),
            FleetRow("run.refused.mcap", "unread", error_kind="NothingRecorded"))
    assert FleetSummary(rows, tmp_path / "fleet.csv").exit_code == 0
    assert FleetSummary(rows[1:], tmp_path / "fleet.csv").exit_code == 10
    cut = FleetRow("cut.mcap", "unread", error_kind="NothingRecoverable")
    assert FleetSummary((*rows, cut), tmp_path / "fleet.csv").exit_code == 3


def their_versions(asked=[]):  # noqa: B006  (who asks first is the host: both are in one process here)
    asked.append(1)
    return OURS if len(asked) == 1 else OURS | {"numpy": "1.0"}


OURS = cluster_module.versions()


@pytest.mark.heavy
def test_the_command(few, tmp_path, capsys, monkeypatch):
    out = tmp_path / "fleet.csv"
    arguments = ["fleet", str(few), "--out", str(out), "--jobs", "1"]
    assert main([*arguments, "--json"]) == 3
    document = json.loads(capsys.readouterr().out)
    assert (document["logs"], document["verdicts"], document["failed"]) == (
        7, document["verdicts"], {"NothingRecoverable": 3})
    assert sum(document["verdicts"].values()) == 4
    assert main(arguments) == 3
    text = capsys.readouterr().out
    assert "7 logs (7 of them finished before)" in text
    assert re.search(r"R1-000.mcap: valid\w*, J, 95 % interval: \d", text)
    assert "empty.mcap: the file is empty" in text
    assert "skipped: 1 CSV file without" in text
    for wrong in (["--jobs", "0"], ["--confidence", "1.5"], ["--time-limit", "0"], ["--memory-limit", "1"]):
        assert main(["fleet", str(few), "--out", str(out), *wrong]) == 2
    assert main(["fleet", str(few), "--out", str(tmp_path / "fleet.txt")]) == 2
    capsys.readouterr()
    assert main(["fleet", f"{few}x", "--out", str(out)]) == 2
    assert f"there is no such file or folder. Did you mean {few}?" in capsys.readouterr().err
    fleet_command._print(FleetSummary((), out, left=2, wall_s=1.0, interrupted=True), as_json=False)
    assert capsys.readouterr().out.startswith(
        f"0 of 2 logs in 1.0 s: {out}\ninterrupted: 2 remaining; run the same command again\n")
    assert main(["watch", str(few), "--out", str(out), "--once", "--jobs", "1"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 7


@pytest.mark.heavy
def test_watch_reads_complete_logs_and_waits_for_growing_ones(tmp_path):
    from tdhil.cli.fleet import FolderWatch

    folder = tmp_path / "logs"
    many(folder, 2)
    watch = FolderWatch(FleetRequest((str(folder),), tmp_path / "fleet.csv", jobs=1))
    assert watch.look() == []                              # found for the first time: it may be growing
    growing = folder / "growing.mcap"
    growing.write_bytes(b"half")
    assert [Path(row.log).name for row in watch.look()] == ["000.mcap", "001.mcap"]
    growing.write_bytes(b"half and more")
    assert watch.look() == []
    assert [Path(row.log).name for row in watch.look()] == ["growing.mcap"]
    assert watch.look() == []
    assert len(read_table(tmp_path / "fleet.csv")) == 3
