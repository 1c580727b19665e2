"""A drive without the simulator's marker, in another process: it moves with the code that stood on the terminal."""

from __future__ import annotations

import re

import pytest

from tdhil.service.states import Conflict
from tests.path.path_runs import REAL, Peer, peer
from tests.path.test_real_peer import RIG, enabled
from tests.service.conftest import Service, wait_for


def rig_of(drive: Peer) -> str:
    options = dict(one.split("=") for one in drive.options[5:])
    return (
        f"bus: {{interface: socketcand, channel: {drive.options[3]}, options: {{host: {options['host']},"
        f" port: {options['port']}, tcp_tune: true}}}}\n{RIG}service: {{motion: attended}}\n"
    )


@pytest.mark.heavy
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
        shown = wait_for("the code", lambda: next((one for one in service.said if f"run {second})" in one), None))
        with pytest.raises(Conflict, match="isn't the code"):      # of the run before
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
