"""Settings that a dead host leaves in a drive: recorded before each change, and restored by the next run."""

import json
from dataclasses import replace

import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.clock import MonotonicClock
from drivers.drive import Command, Mode
from drivers.errors import PreflightRefused
from drivers.undo_journal import UndoJournal, read
from tests.drivers import on_wire
from tests.drivers.scripted_drive import ScriptedDrive, u

ALL = frozenset({"torque", "speed", "quick-stop"})
LIMITS = replace(on_wire.LIMITS, accept_wider=ALL)
FOUND = {0x6072: 100, 0x6080: 40, 0x6085: 1910, 0x605A: 2, 0x6007: 1}


@pytest.fixture
def real(wire):
    peer = ScriptedDrive(wire, marker=False)
    for index, raw in FOUND.items():
        peer.objects[index, 0] = u(raw, len(peer.objects[index, 0]))
    return peer


@pytest.fixture
def make(wire, profile, tmp_path):
    def make():
        return CanopenDrive(wire, profile, MonotonicClock(), node=1, journal=UndoJournal(tmp_path, "node1"))

    return make


def stands(peer):
    return {index: peer.value(index) for index in FOUND}


def files(folder):
    return sorted(path.name for path in folder.iterdir())


def run(drive, limits=LIMITS):
    drive.connect()
    return drive.preflight(limits)


def test_a_completed_run_leaves_neither_setting_nor_file(make, real, tmp_path):
    drive = make()
    assert run(drive).refused == ()
    assert files(tmp_path) == ["drive-left-11-22-44-node1.json"]
    assert stands(real) != FOUND
    for _ in range(5):
        drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert drive.close() == ()
    assert stands(real) == FOUND
    assert files(tmp_path) == []


def test_each_is_written_down_before_it_is_changed(make, real, tmp_path):
    """A host may die between any two of its frames."""
    seen = []

    def poll(request):
        if request[0] & 0xE3 == 0x23:
            index, sub = int.from_bytes(request[1:3], "little"), request[3]
            if index in FOUND:
                (path,) = tmp_path.iterdir()
                (entry,) = [one for one in read(path)[1] if one.where == f"{index:04X}h"]
                assert sub == 0
                assert int.from_bytes(entry.before, "little") == FOUND[index]
                seen.append(index)

    real.before_answer = poll
    run(make())
    assert sorted(set(seen)) == sorted(FOUND)


def test_the_next_run_gives_back_what_a_killed_one_left(make, real, wire, tmp_path):
    """Therefore the drive keeps its own limit, not the wider one of the dead run."""
    run(make())                                    # killed without a close
    real.machine.state = "switch on disabled"
    assert real.value(0x6072) == 300
    drive = make()
    found = run(drive, on_wire.LIMITS)
    assert (real.value(0x6072), real.value(0x6080), real.value(0x6085)) == (100, 40, 1910)
    assert found.kept_torque_nm == pytest.approx(100.0)
    (row,) = [check for check in found.checks if check.name == "left by an earlier run"]
    assert "6072h was left at 300; before that run it was 100" in row.found
    for _ in range(5):
        drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    drive.close()
    assert stands(real) == FOUND
    assert files(tmp_path) == []


def test_a_setting_that_was_changed_since_is_kept(make, real, tmp_path):
    run(make())
    real.objects[0x6072, 0] = u(77, 2)
    run(make(), on_wire.LIMITS)
    assert real.value(0x6072) == 77


def test_another_drive_does_not_receive_the_settings(make, real, wire, tmp_path):
    run(make())
    real.objects[0x1018, 4] = u(0x45, 4)
    real.objects[0x6072, 0] = u(300, 2)
    run(make(), on_wire.LIMITS)
    assert real.value(0x6072) == 300


def test_there_is_no_file_for_a_simulated_drive(wire, profile, tmp_path):
    ScriptedDrive(wire)
    drive = CanopenDrive(wire, profile, MonotonicClock(), node=1, journal=UndoJournal(tmp_path, "node1"))
    run(drive)
    assert files(tmp_path) == []


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"drive": "x", "settings": [{"where": "6072h"}]}', "\x00\xff"])
def test_an_invalid_file_refuses_the_run_and_is_named(make, real, tmp_path, text):
    path = tmp_path / "drive-left-11-22-44-node1.json"
    path.write_text(text)
    drive = make()
    drive.connect()
    with pytest.raises(PreflightRefused) as caught:
        drive.preflight(LIMITS)
    assert caught.value.where == str(path)
    assert stands(real) == FOUND


def test_a_read_only_folder_refuses_before_any_change(wire, profile, real, tmp_path):
    drive = CanopenDrive(wire, profile, MonotonicClock(), node=1, journal=UndoJournal(tmp_path / "gone", "node1"))
    drive.connect()
    with pytest.raises(PreflightRefused, match="can't be written: "):
        drive.preflight(LIMITS)
    assert stands(real) == FOUND


def test_the_file_is_plain(make, real, tmp_path):
    run(make())
    (path,) = tmp_path.iterdir()
    document = json.loads(path.read_text())
    assert document["drive"] == "scripted, node1"
    assert {"where": "6072h", "before": "6400", "after": "2c01"} in document["settings"]
