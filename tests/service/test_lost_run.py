"""Killed process of a run that turns a drive in another process: stop of the shaft, and kept data."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from tdhil.recording import read_run
from tdhil.service.run_state import State
from tests.path.path_runs import modbus_peer
from tests.rigs import PATIENT_LIMITS, rig_file
from tests.service.conftest import Service, wait_for

simulated_drive = partial(modbus_peer, program=("-m", "tdhil", "simulate"))
"""Simulated drive in another process: a drive like any other except for its marker."""


def attended_rig(port: object) -> str:
    """Return the rig.yaml of a Modbus drive whose motion an operator confirms."""
    return (f"name: bench 3\nrate_hz: 10\nmodbus: {{host: 127.0.0.1, port: {port}}}\n{PATIENT_LIMITS}"
            "service: {motion: attended}\n")


def speed_rad_s(trace: Path) -> float:
    """Return the present speed of the shaft."""
    lines = trace.read_text().splitlines()
    return float(lines[-2].split(",")[1]) if len(lines) > 3 else 0.0


@pytest.mark.heavy
@pytest.mark.real_time
def test_the_shaft_comes_to_standstill_and_the_run_is_reported_with_its_log(tmp_path):
    rigs, trace = tmp_path / "rigs", tmp_path / "shaft.csv"
    rigs.mkdir()
    with simulated_drive(trace) as drive:
        rig_file(rigs, attended_rig(drive.port), name="real.yaml")
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
        (service.store.place(run) / "confirm.json").read_bytes()       # a drive with the marker needs no confirmation


@pytest.mark.heavy
@pytest.mark.real_time
def test_if_the_rig_s_file_names_another_drive_that_one_is_not_stopped(tmp_path):
    """The other drive was stopped in the reported case, and its standstill was attributed to the drive of the run."""
    rigs = tmp_path / "rigs"
    rigs.mkdir()
    with simulated_drive(tmp_path / "own.csv") as drive, simulated_drive(tmp_path / "other.csv") as other:
        rig_file(rigs, attended_rig(drive.port), name="real.yaml")
        service = Service(tmp_path / "data", rigs, fake=False)
        service.supervisor.start()
        run = service.supervisor.start_run("real", {}, "local").request.id
        wait_for("motion", lambda: speed_rad_s(tmp_path / "own.csv") > 1.0)
        rig_file(rigs, attended_rig(other.port), name="real.yaml")
        os.kill(service.store.status(run).pid, signal.SIGKILL)
        service.wait(run, "stop_not_confirmed", "interrupted")
        assert abs(speed_rad_s(tmp_path / "own.csv")) < 0.1
        assert "quick stop" in (tmp_path / "own.csv").read_text()
        assert "quick stop" not in (tmp_path / "other.csv").read_text()
        service.supervisor.close()
    status = service.store.status(run)
    assert (status.state, status.stop.confirmed) == (State.STOP_NOT_CONFIRMED, False)
    assert f"port {drive.port}" in status.error.what
    assert service.supervisor.blocked("real") == run
