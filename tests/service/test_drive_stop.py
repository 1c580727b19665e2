"""Stop of the drive of a run: its target, its readings, and the identity of the drive."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers import BareStopReport, Ended, Identity
from tdhil.buses import Connection
from tdhil.buses.modbus import MODBUS
from tdhil.service import drive_stop
from tdhil.service.store import write_json
from tdhil.session import kept_connection
from tests.service.conftest import Service


class OneDrive:
    """Bus with one drive at standstill."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, identity: Identity | None, ended: Ended) -> None:
        self.asked: list[str] = []

        @contextlib.contextmanager
        def opened(options: object, connection: Connection, clock: object) -> Iterator[object]:
            self.asked.append(connection.bus.address(options, connection) or "")
            yield SimpleNamespace() if identity is None else SimpleNamespace(identity=lambda: identity)

        monkeypatch.setattr("tdhil.buses.modbus.MODBUS", replace(MODBUS, open_target=opened))
        monkeypatch.setattr(drive_stop, "bare_stop",
                            lambda target, clock: BareStopReport(ended, None, None, 1.0, 1, ()))


@pytest.fixture
def kept_file(service: Service, tmp_path: Path) -> Path:
    path = tmp_path / "connection.json"
    write_json(path, kept_connection(*service.supervisor.rigs.get("real").way()))
    return path


@pytest.mark.parametrize(("numbers", "wanted", "ended", "code"), [
    ((1, 2, 3, 4), "1,2,3,4", Ended.AT_REST, 0), ((1, 2, 3, 5), "1,2,3,4", Ended.AT_REST, 8),
    ((1, 2, 3, 4), "1,2,3,4", Ended.TURNING, 8), ((1, 2, 3, 5), "0,0,0,0", Ended.AT_REST, 0),
    ((1, 2, 3, 4), None, Ended.NO_ANSWER, 8), (None, "1,2,3,4", Ended.AT_REST, 0),
])
def test_the_stop_of_a_run_s_drive_reads_its_identity(kept_file, monkeypatch, capsys, numbers, wanted, ended, code):
    there = None if numbers is None else Identity(*numbers, "a drive", False)
    drive = OneDrive(monkeypatch, there, ended)
    assert drive_stop.main([str(kept_file), *([wanted] if wanted else [])]) == code
    found = json.loads(capsys.readouterr().out)
    assert len(drive.asked) == 1
    assert drive.asked[0].startswith("modbus tcp 127.0.0.1 port ")
    assert (found["at_rest"], found["error"]) == (ended is Ended.AT_REST, "")
    assert found["same_drive"] is (numbers is None or wanted in (None, "0,0,0,0") or numbers[3] == 4)


def test_an_unreachable_drive_is_not_at_standstill(kept_file, tmp_path, capsys):
    assert drive_stop.main([str(kept_file)]) == 8                  # no reply at this address
    found = json.loads(capsys.readouterr().out)
    assert found["ended"] == "not reached"
    assert "127.0.0.1:" in found["error"]
    assert drive_stop.main([str(tmp_path / "nothing.json")]) == 8
    found = json.loads(capsys.readouterr().out)
    assert (found["at_rest"], found["error"]) == (False, "KeyError: 'drive'")
