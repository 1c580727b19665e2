"""Drive without the simulator's marker, in another process: it moves with the code from the terminal."""

from __future__ import annotations

import re
from types import SimpleNamespace

import pytest

from drivers import Identity, PreflightRefused
from tdhil.service.run_process import RunProcess
from tdhil.service.run_state import Conflict, now
from tdhil.service.start_request import read_rig, run_request
from tdhil.service.store import Store, StoredRequest
from tests.path.path_runs import REAL, Peer, peer
from tests.path.test_real_peer import RIG, enabled
from tests.service.conftest import Service, wait_for


def rig_of(drive: Peer) -> str:
    options = dict(one.split("=") for one in drive.options[5:])
    return (
        f"bus: {{interface: socketcand, channel: {drive.options[3]}, options: {{host: {options['host']},"
        f" port: {options['port']}, tcp_tune: true}}}}\n{RIG}service: {{motion: attended}}\n"
    )


@pytest.mark.parametrize("changed", ["profile.yaml", "rig.yaml"])
def test_a_code_is_void_once_the_rig_s_file_or_its_profile_changes(tmp_path, changed):
    from profiles.library import profile_path

    for name, text in (
        ("profile.yaml", profile_path("generic/modbus").read_text()),
        ("rig.yaml", f"drive: modbus\nprofile: profile.yaml\nmodbus: {{host: 127.0.0.1, port: 1}}\n{RIG}"),
    ):
        (tmp_path / name).write_text(text)
    store = Store(tmp_path / "data")
    store.prepare()
    rig, run = read_rig(tmp_path / "rig.yaml"), store.new_id()
    store.begin(StoredRequest(run, "rig", str(rig.path), rig.sha256, {}, "local", now(), False, "attended"))
    process = RunProcess(store.place(run))
    process._asked = run_request(rig, {})
    found = SimpleNamespace(checks=(), identity=Identity(1, 2, 3, 4, "a drive", False))
    first, second = process._bind(found), process._bind(found)
    first.take(first.code, first.binding, "local")
    path = tmp_path / changed
    for old, new in (("torque_nm: 400.0", "torque_nm: 300.0"), ("per_lsb: 0.1", "per_lsb: 0.2")):
        path.write_text(path.read_text().replace(old, new))
    for _ in range(2):
        with pytest.raises(PreflightRefused, match="was changed"):
            second.take(second.code, second.binding, "local")
    process.board.close()


@pytest.mark.heavy
@pytest.mark.real_time
def test_a_real_drive_moves_with_its_code_and_no_other(tmp_path):
    rigs = tmp_path / "rigs"
    rigs.mkdir()
    with peer(tmp_path, program=REAL) as drive:
        (rigs / "real.yaml").write_text(rig_of(drive))
        service = Service(tmp_path / "data", rigs, fake=False)
        supervisor = service.supervisor
        supervisor.start()

        first = supervisor.start_run("real", {}, "local").request.id
        service.wait(first, "awaiting_confirmation")
        shown = wait_for("the code", lambda: next((one for one in service.said if "type this code" in one), None))
        assert "hard-wired emergency stop tested" in shown
        (code,) = re.findall(r"(\d{3} \d{3})\n", shown)
        with pytest.raises(Conflict, match="another plan"):
            supervisor.confirm(first, code.replace(" ", ""), "0" * 64, "local")
        service.wait(first, "refused")
        assert not enabled(drive)

        wait_for("its end", lambda: not supervisor.live())
        second = supervisor.start_run("real", {}, "local").request.id
        service.wait(second, "awaiting_confirmation")
        asked = f"run {second}. To let it move"
        shown = wait_for("the code", lambda: next((one for one in service.said if asked in one), None))
        with pytest.raises(Conflict, match="the code is wrong"):      # from the run before
            supervisor.confirm(second, code.replace(" ", "") if code not in shown else "000000", None, "local")
        (code,) = re.findall(r"(\d{3} \d{3})\n", shown)
        status = service.store.status(second)
        supervisor.confirm(second, code.replace(" ", ""), status.confirmation.binding, "local")
        wait_for("motion", lambda: enabled(drive))
        assert supervisor.store.status(second).simulated is False
        supervisor.stop(second, "local")
        service.wait(second, "stopped")
        supervisor.close()
        assert (service.store.place(second) / "confirm.json").exists()
        assert not (service.store.place(first) / "confirm.json").exists()
        assert abs(drive.shaft.speed_rad_s[-1]) < 0.05
    stop = service.store.status(second).stop
    assert stop.asked <= stop.seen <= stop.at_rest
    assert service.audit.verify() is None
