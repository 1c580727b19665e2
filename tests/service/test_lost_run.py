"""A run's process is killed while it turns a drive in another process: what then stops the shaft, and what is kept."""

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
"""Behind a wire it is a drive like any other but for its marker."""


def attended_rig(port: object) -> str:
    """Return the rig.yaml of a Modbus drive that a person at the shaft releases."""
    return (f"name: bench 3\nrate_hz: 10\nmodbus: {{host: 127.0.0.1, port: {port}}}\n{PATIENT_LIMITS}"
            "service: {motion: attended}\n")


def speed_rad_s(trace: Path) -> float:
    """The shaft's, as it is now."""
    lines = trace.read_text().splitlines()
    return float(lines[-2].split(",")[1]) if len(lines) > 3 else 0.0


@pytest.mark.heavy
@pytest.mark.real_time
def test_the_shaft_comes_to_rest_the_run_is_told_of_and_its_log_kept(tmp_path):
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
        (service.store.place(run) / "confirm.json").read_bytes()       # a drive with the marker asks nobody


@pytest.mark.heavy
@pytest.mark.real_time
def test_a_rig_s_file_that_names_another_drive_by_then_does_not_get_that_one_stopped(tmp_path):
    """The issue's own case: the other drive was stopped, and its rest was taken for that of the run's."""
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
