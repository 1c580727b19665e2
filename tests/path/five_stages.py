"""Five stages over any bus: a fixture ``bus`` gives the options that reach the drive.

`test_five_stages` runs them over a virtual bus in one process and over two processes through the socketcand hub,
tests/vcan/test_five_stages over a real SocketCAN interface.
"""

from __future__ import annotations

from contextlib import AbstractContextManager

from tdhil.recording.log_reader import read_frames, read_run, read_samples
from tests.path.path_runs import (
    HANGS_S,
    INERTIA,
    QUICK,
    STAGES,
    SWINGS_IN_RAD_S,
    Finished,
    Host,
    Peer,
    Shaft,
    identify,
    peer,
    tdhil,
)

SEED = 1
PERIODS = 3


class FiveStages:
    """Tests of the path with a short excitation, not of the last digit."""

    replayed = True
    """Whether the run is also replayed, which takes as long as its identification."""

    def test_the_five_stages_identify_the_inertia(self, bus, tmp_path):
        done, shaft = bus(tmp_path, *QUICK, "--periods", PERIODS)
        assert done.code == 0, done.err
        document = done.document
        assert document["verdict"] in ("valid", "valid_wide")
        assert done.outcomes == [(name, "ok") for name in STAGES]
        assert all(stage["duration_s"] > 0.0 for stage in document["stages"])
        inertia = document["inertia_kg_m2"]
        assert abs(inertia["value"] / INERTIA - 1.0) < 0.03
        assert inertia["low"] < inertia["value"] < inertia["high"]
        shaft.assert_never_let_go()
        assert shaft.at_rest_from() < shaft.time_s[-1] - 1.0
        assert shaft.state[-1] == "switch on disabled"
        assert shaft.speed_rad_s.max() < 10.0
        assert shaft.speed_rad_s.min() > -SWINGS_IN_RAD_S

        # SIMULATED on every surface: JSON, progress, log, card
        assert document["simulated"] is True
        progress = [line for line in done.err.splitlines() if "stage speed" in line or "stage acquire" in line]
        assert len(progress) == 4
        assert all(line.startswith("SIMULATED") for line in progress)
        run = read_run(done.log)
        assert run.complete
        assert run.recording.simulated
        assert run.result == document
        assert {name for name, _ in done.outcomes} == {stage.name for stage in run.stages}

        # the log has the frames too: one SYNC per sample
        syncs = sum(frame.identifier == 0x080 and frame.outgoing for frame in read_frames(done.log))
        assert syncs == sum(1 for _ in read_samples(done.log))
        if not self.replayed:
            return

        card = tdhil("replay", done.log)
        assert card.code == 0
        assert "SIMULATED" in card.out

        # a replay gives the same document except for the path
        moved = done.log.rename(tmp_path / "elsewhere.mcap")
        replayed = tdhil("replay", "--json", moved)
        assert replayed.code == 0
        assert replayed.document == document | {"log": str(moved)}

    def test_ctrl_c_in_the_torque_stage_stops_the_shaft(self, interrupted_bus, tmp_path):
        with interrupted_bus(tmp_path) as (drive, running):
            assert running.wait_for_line("stage torque …"), running.err
            running.signal(2)
            done = running.finish()
            assert done.code == 130, done.err
            drive.shaft.assert_stopped_within_settings()
            assert done.outcomes[-1][1] == "aborted"


def over_a_peer(folder, *arguments, on=()) -> tuple[Finished, Shaft]:
    """Run the host in this process and the simulated drive in another one."""
    with peer(folder, *on, "--seed", SEED, "--stepped") as drive:
        done = identify(folder, *drive.options, "--stepped", *arguments)
        drive.child.terminate()
        drive.child.wait(HANGS_S)
        return done, drive.shaft


def interrupted(folder, *, on=()) -> AbstractContextManager[tuple[Peer, Host]]:
    """Run host and simulated drive in separate processes."""
    from contextlib import contextmanager

    from tests.path.path_runs import host

    @contextmanager
    def both():
        with peer(folder, *on, "--seed", SEED, "--stepped") as drive, host(
            folder, *drive.options, "--stepped", *QUICK, "--periods", 20
        ) as running:
            yield drive, running

    return both()
