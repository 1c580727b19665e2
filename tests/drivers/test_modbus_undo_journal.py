"""Settings that a dead host leaves in a Modbus drive: recorded before each change, and restored by the next run.

The twin for CiA 402 is `test_undo_journal`.
"""

from dataclasses import replace

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Command, Identity, Mode
from drivers.errors import PreflightRefused
from drivers.modbus.access import RegisterAccess
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from drivers.preflight import PreflightTable
from drivers.undo_journal import UndoJournal, read
from profiles.library import load_modbus_profile
from profiles.modbus import Register
from tests.drivers.drive_benches import LIMITS
from tests.drivers.modbus_bank import Bank
from tests.drivers.power_machine import OFF

GENERIC = load_modbus_profile("generic/modbus")
ADDRESS = "192.0.2.10-502-unit1-generic-modbus"
FILE = f"drive-left-0-0-0-{ADDRESS}.json"
WIDER = replace(LIMITS, accept_wider=frozenset({"torque", "speed", "quick-stop"}))
OWN_LIMITS = {36: 1000, 37: 0x10000 - 1000, 38: 100, 39: 30, 40: 0}
"""As the owner set them: 100 rpm, both ways; 10 % of 800 N·m; a ramp; no watchdog. The limits are tighter than ours."""
REAL = Identity(0, 0, 0, 0, "bank", False)


@pytest.fixture
def bank():
    bank = Bank(marker=False)
    bank.words |= OWN_LIMITS
    return bank


@pytest.fixture
def make(bank, tmp_path, monkeypatch):
    """Make drives on the bank, in a time without waits. A drive without the marker is refused in stepped time."""
    monkeypatch.setattr("drivers.modbus.drive.refuse_unless_stepped", lambda marker: None)

    def make(folder=tmp_path, **options):
        link = EmbeddedLink(bank.serve, SteppedClock())
        return ModbusDrive(link, GENERIC, unit=1, journal=UndoJournal(folder, ADDRESS), **options)

    return make


def stands(bank):
    return {address: bank.words[address] for address in OWN_LIMITS}


def files(folder):
    return sorted(path.name for path in folder.iterdir())


def run(drive, limits=WIDER):
    drive.connect()
    return drive.preflight(limits)


def test_a_completed_run_leaves_neither_setting_nor_file(make, bank, tmp_path):
    drive = make()
    assert run(drive).refused == ()
    assert files(tmp_path) == [FILE]
    assert stands(bank) != OWN_LIMITS
    drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert drive.close() == ()
    assert stands(bank) == OWN_LIMITS
    assert files(tmp_path) == []


def test_each_is_written_down_before_it_is_changed(make, bank, tmp_path):
    """A host may die between any two of its requests."""
    seen = []

    def written(address, words):
        if address in OWN_LIMITS and [address] not in seen:
            (entry,) = [one for one in read(tmp_path / FILE)[1] if one.where.split()[1] == str(address)]
            assert int.from_bytes(entry.before, "little") == OWN_LIMITS[address]
            assert int.from_bytes(entry.after, "little") == words[0]
            seen.append([address])

    bank.on_write = written
    run(make())
    assert sorted(seen) == [[address] for address in sorted(OWN_LIMITS) if bank.words[address] != OWN_LIMITS[address]]


def test_the_next_run_gives_back_what_a_killed_one_left(make, bank, tmp_path):
    """Therefore the drive keeps its own limit, not the wider one of the dead run."""
    assert run(make()).kept_torque_nm is None           # killed without a close
    bank.machine.state = OFF
    assert bank.words[38] == 375                        # 300 N·m of 800, in 0.1 %
    drive = make()
    found = run(drive, replace(LIMITS, accept_wider=frozenset()))
    assert found.refused == ()
    assert (bank.words[38], bank.words[36]) == (100, 1000)
    assert found.kept_torque_nm == pytest.approx(80.0)
    (row,) = [check for check in found.checks if check.name == "left by an earlier run"]
    assert "register 38 was left at 375; before that run it was 100" in row.found
    drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert drive.close() == ()
    assert stands(bank) == OWN_LIMITS
    assert files(tmp_path) == []


def test_the_drives_own_speed_limit_is_read_again(make, bank):
    """It is lowered against another master, and `close` writes the value that preflight read."""
    run(make())
    bank.machine.state = OFF
    drive = make()
    run(drive)
    assert [before for _, _, before in drive._speed_limits] == [1000, -1000]


def test_a_setting_that_was_changed_since_is_kept(make, bank):
    run(make())
    bank.words[38] = 77
    found = run(make(), LIMITS)
    assert bank.words[38] == 77
    assert any("register 38: changed since by another tool" in check.found for check in found.checks)


def test_a_setting_that_the_drive_refuses_stays_in_the_file(make, bank, tmp_path):
    run(make())
    write = bank._write

    def refuse(function, address, words):
        return bytes((function | 0x80, 4)) if (address, *words) == (38, 100) else write(function, address, words)

    bank._write = refuse
    found = run(make())
    assert any("register 38 was left at 375" in check.found and check.next_step == "Set it at the drive"
               for check in found.checks)
    (entry,) = [one for one in read(tmp_path / FILE)[1] if one.where == "register 38"]
    assert int.from_bytes(entry.before, "little") == 100


def test_another_address_does_not_receive_the_settings(make, bank, tmp_path):
    run(make())
    drive = make()
    drive._journal = UndoJournal(tmp_path, ADDRESS.replace("unit1", "unit2"))
    run(drive, LIMITS)
    assert bank.words[38] == 375


def test_there_is_no_file_for_a_simulated_drive(tmp_path):
    drive = ModbusDrive(EmbeddedLink(Bank().serve, SteppedClock()), GENERIC, unit=1,
                        journal=UndoJournal(tmp_path, ADDRESS))
    run(drive)
    assert files(tmp_path) == []


def test_nothing_is_restored_while_the_shaft_turns(make, bank, tmp_path):
    """A tighter torque limit would weaken a braking drive."""
    run(make())
    bank.feedback = lambda: (2000, 50)
    before = stands(bank)
    assert run(make()).refused
    assert stands(bank) == before
    assert files(tmp_path) == [FILE]


@pytest.mark.parametrize("text", ["", "[]", '{"drive": "x", "settings": [{"where": "register 38"}]}'])
def test_an_invalid_file_refuses_the_run_and_is_named(make, bank, tmp_path, text):
    (tmp_path / FILE).write_text(text)
    with pytest.raises(PreflightRefused) as caught:
        run(make())
    assert caught.value.where == str(tmp_path / FILE)
    assert stands(bank) == OWN_LIMITS


def test_a_read_only_folder_refuses_before_any_change(make, bank, tmp_path):
    found = run(make(tmp_path / "gone"))
    assert any("can't be written" in check.found for check in found.refused)
    assert stands(bank) == OWN_LIMITS


@pytest.mark.parametrize("order", ["high_first", "low_first"])
@pytest.mark.parametrize(("kind", "before", "after"), [
    ("u16", 100, 0xFFFF), ("i16", -300, -1), ("u32", 100_000, 0xFFFF_0001), ("i32", -100_000, 70_000),
])
def test_numbers_of_each_type_come_back(tmp_path, order, kind, before, after):
    bank, register = Bank(marker=False), Register(address=52, type=kind)
    bank.words |= {52: 0, 53: 0}

    def access():
        return RegisterAccess(EmbeddedLink(bank.serve, SteppedClock()), 1, order, frozenset({3, 16}))

    dead, journal = access(), UndoJournal(tmp_path, "x")
    dead.write(register, before)
    words = bank.words[52], bank.words[53]
    dead.restore_from(PreflightTable(), journal, REAL)
    assert dead.change(register, after) == after
    assert access().restore_from(PreflightTable(), UndoJournal(tmp_path, "x"), REAL)
    assert (bank.words[52], bank.words[53]) == words
    assert files(tmp_path) == []


def test_a_change_in_motion_is_recorded_and_never_fails(tmp_path):
    """A disk error must not end a stop."""
    bank, register = Bank(marker=False), Register(address=36, type="u16")
    access = RegisterAccess(EmbeddedLink(bank.serve, SteppedClock()), 1, "high_first", frozenset({3, 6, 16}))
    folder = tmp_path / "log"
    folder.mkdir()
    access.restore_from(PreflightTable(), UndoJournal(folder, "x"), REAL)
    access.press(register, 500, 3000, 0.1)
    (path,) = folder.iterdir()
    (entry,) = read(path)[1]
    assert entry.text == "register 36 was left at 500; before that run it was 3000"
    path.unlink()
    folder.rmdir()
    access.press(register, 400, 3000, 0.1)
    assert bank.words[36] == 400
    assert access.restore() == ()
    assert bank.words[36] == 3000
