"""The undo journal of a Modbus drive: its place and name, and its lines in `tdhil doctor`."""

from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import pytest

from drivers.clock import SteppedClock
from drivers.modbus.link import EmbeddedLink
from profiles.library import load_modbus_profile
from tdhil.buses import modbus
from tdhil.cli.main import main
from tests.drivers.drive_benches import LIMITS
from tests.drivers.modbus_bank import Bank

GENERIC = load_modbus_profile("generic/modbus")


def line(**cli):
    return modbus.modbus_line(cli, None, GENERIC)


@pytest.mark.parametrize(("cli", "address"), [
    ({"host": "192.0.2.10"}, "192.0.2.10-502-unit1-generic-modbus"),
    ({"host": "192.0.2.10", "port": 1502, "unit": 7}, "192.0.2.10-1502-unit7-generic-modbus"),
    ({"host": "2001:db8::5"}, "2001-db8-5-502-unit1-generic-modbus"),
    ({"serial": "/dev/ttyUSB0", "unit": 3}, "dev-ttyUSB0-unit3-generic-modbus"),
    ({"serial": "COM3"}, "COM3-unit1-generic-modbus"),
])
def test_a_drive_is_known_by_its_place_its_unit_and_its_profile(cli, address):
    assert modbus.journal_address(line(**cli), GENERIC) == address


@pytest.fixture
def opened(monkeypatch):
    """Return a function that opens a drive on a bank of registers, as a run opens it."""
    bank = Bank(marker=False)
    bank.words[38] = 100               # the owner's torque limit, 10 % of 800 N·m
    monkeypatch.setattr("drivers.modbus.drive.refuse_unless_stepped", lambda marker: None)

    @contextmanager
    def wire(plan, connection, data, clock, trace=None):
        yield modbus.OpenLine(EmbeddedLink(bank.serve, clock), GENERIC, None, {})

    monkeypatch.setattr(modbus, "open_line", wire)

    def opened(log, *, left_in=None, embedded=False):
        return modbus.MODBUS.open(SimpleNamespace(
            plan=SimpleNamespace(embedded=embedded, left_in=left_in),
            options=SimpleNamespace(log=str(log), rate_hz=None),
            connection=SimpleNamespace(line=line(host="192.0.2.10"), profile=GENERIC),
            data=None, clock=SteppedClock(), trace=None, tap=None,
        ))

    opened.bank = bank
    return opened


def test_doctor_names_what_a_killed_run_left(opened, tmp_path, capsys):
    log = tmp_path / "run.mcap"
    with opened(log) as drive:         # killed without a close
        drive.connect()
        drive.preflight(replace(LIMITS, accept_wider=frozenset({"torque", "quick-stop"})))
    assert opened.bank.words[38] == 375
    assert main(["doctor", "--log", str(log)]) == 4
    said = " ".join(capsys.readouterr().out.split())
    assert "192.0.2.10-502-unit1-generic-modbus: " in said
    assert "register 38 was left at 375; before that run it was 100" in said
    opened.bank.machine.state = "switch on disabled"
    with opened(log) as drive:
        drive.connect()
        found = drive.preflight(LIMITS)
        drive.close()
    assert found.kept_torque_nm == pytest.approx(80.0)
    assert main(["doctor", "--log", str(log)]) == 0


def test_the_service_names_its_own_folder(opened, tmp_path):
    site = tmp_path / "site"
    site.mkdir()
    with opened(tmp_path / "run.mcap", left_in=site) as drive:
        drive.connect()
        drive.preflight(LIMITS)
    assert [path.parent for path in tmp_path.rglob("drive-left-*.json")] == [site]


def test_an_embedded_drive_has_no_journal(opened, tmp_path):
    with opened(tmp_path / "run.mcap", embedded=True) as drive:
        drive.connect()
        drive.preflight(LIMITS)
    assert list(tmp_path.iterdir()) == []
