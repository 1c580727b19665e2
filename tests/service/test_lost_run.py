"""A run's process is killed while it turns a drive in another process: what then stops the shaft, and what is kept."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tdhil.recording import read_run
from tdhil.service.run_state import State
from tests.service.conftest import Service, wait_for

LIMITS = ("name: bench 3\nlimits: {speed_min_rad_s: 0.5, speed_max_rad_s: 10.0, torque_nm: 400.0, time_s: 900.0,"
          " quick_stop_rad_s2: 2.0, watchdog_s: 5.0, probe_torque_nm: 200.0, probe_travel_rad: 3.0}\n")


@contextlib.contextmanager
def simulated_drive(trace: Path) -> Iterator[int]:
    """The port of one; behind a wire it is a drive like any other but for its marker."""
    with subprocess.Popen(
        [sys.executable, "-m", "tdhil", "simulate", "modbus", "--tcp", "127.0.0.1:0", "--trace", str(trace)],
        stdout=subprocess.PIPE, text=True,
    ) as child:
        assert child.stdout is not None
        found = re.search(r"127\.0\.0\.1:(\d+)", child.stdout.readline())
        assert found
        try:
            yield int(found.group(1))
        finally:
            child.kill()


def speed_rad_s(trace: Path) -> float:
    """The shaft's, as it is now."""
    lines = trace.read_text().splitlines()
    return float(lines[-2].split(",")[1]) if len(lines) > 3 else 0.0


@pytest.mark.heavy
@pytest.mark.real_time
def test_the_shaft_comes_to_rest_the_run_is_told_of_and_its_log_kept(tmp_path):
    rigs, trace = tmp_path / "rigs", tmp_path / "shaft.csv"
    rigs.mkdir()
    with simulated_drive(trace) as port:
        (rigs / "real.yaml").write_text(
            f"rate_hz: 10\nmodbus: {{host: 127.0.0.1, port: {port}}}\n{LIMITS}service: {{motion: attended}}\n")
        service = Service(tmp_path / "data", rigs, fake=False)
        service.supervisor.start()
        run = service.supervisor.start_run("real", {}, "local").request.id
        wait_for("motion", lambda: speed_rad_s(trace) > 1.0)
        holder = service.supervisor.holder(service.supervisor.rigs.get("real"))
        assert holder is not None
        assert holder.pid == service.store.status(run).pid
        os.kill(holder.pid, signal.SIGKILL)
        service.wait(run, "interrupted")
        assert abs(speed_rad_s(trace)) < 0.1
        wait_for("what is left of the log", (service.store.place(run) / "recovered.mcap").exists)
        service.supervisor.close()
    status = service.store.status(run)
    assert status.stop.confirmed is True
    assert "tdhil stop confirmed standstill" in status.error.what
    assert status.history[-2].state is State.MOVING
    assert len(read_run(service.store.place(run) / "recovered.mcap").recording.time_s) > 10
    with pytest.raises(FileNotFoundError):
        (service.store.place(run) / "confirm.json").read_bytes()       # a drive with the marker asks nobody


@pytest.mark.heavy
@pytest.mark.real_time
def test_a_rig_s_file_that_names_another_drive_by_then_does_not_get_that_one_stopped(tmp_path):
    """The issue's own case: the other drive was stopped, and its rest was taken for that of the run's."""
    rigs = tmp_path / "rigs"
    rigs.mkdir()
    with simulated_drive(tmp_path / "own.csv") as port, simulated_drive(tmp_path / "other.csv") as other:
        text = f"rate_hz: 10\nmodbus: {{host: 127.0.0.1, port: {port}}}\n{LIMITS}service: {{motion: attended}}\n"
        (rigs / "real.yaml").write_text(text)
        service = Service(tmp_path / "data", rigs, fake=False)
        service.supervisor.start()
        run = service.supervisor.start_run("real", {}, "local").request.id
        wait_for("motion", lambda: speed_rad_s(tmp_path / "own.csv") > 1.0)
        (rigs / "real.yaml").write_text(text.replace(str(port), str(other)))
        os.kill(service.store.status(run).pid, signal.SIGKILL)
        service.wait(run, "stop_not_confirmed", "interrupted")
        assert abs(speed_rad_s(tmp_path / "own.csv")) < 0.1
        assert "quick stop" in (tmp_path / "own.csv").read_text()
        assert "quick stop" not in (tmp_path / "other.csv").read_text()
        service.supervisor.close()
    status = service.store.status(run)
    assert (status.state, status.stop.confirmed) == (State.STOP_NOT_CONFIRMED, False)
    assert f"port {port}" in status.error.what
    assert service.supervisor.blocked("real") == run
