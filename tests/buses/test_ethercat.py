"""File of the EtherCAT bus: its options, its section in rig.yaml, scan and doctor over a fake segment."""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from drivers import ethercat as driver
from drivers.errors import DataFileError
from drivers.ethercat.segment import EthercatSegment
from profiles.library import load_profile
from tdhil.buses import ethercat
from tdhil.cli.main import main
from tdhil.config.rig import load_rig
from tdhil.errors import UsageError
from tests.drivers.fake_soem import FakeMaster, FakeSlave
from tests.rigs import loaded_rig


@pytest.fixture
def segment(monkeypatch):
    """Put two slaves behind every interface; the second one has an alias."""
    slaves = [FakeSlave(alias=alias, clocks=True) for alias in (0, 7)]
    found = EthercatSegment(FakeMaster(*slaves), "eth9")
    said = SimpleNamespace(driven="", slaves=slaves)

    @contextmanager
    def stations_at(interface):
        yield found.stations, said.driven

    monkeypatch.setattr(driver, "stations_at", stations_at, raising=False)
    return said


def line_of(cli, text=None, tmp_path=None):
    rig = None if text is None else loaded_rig(tmp_path, text)
    return {name: value for name, value, _ in ethercat.ETHERCAT.line(cli, rig, None).rows()}


def test_the_command_line_takes_precedence_over_the_rig(tmp_path):
    rig = "ethercat: {interface: eth1, alias: 5}\n"
    assert line_of({}, rig, tmp_path) == {"interface": "eth1", "alias": "5"}
    assert line_of({"position": 2}, rig, tmp_path) == {"interface": "eth1", "position": "2"}
    assert line_of({"interface": "eth2"}, rig, tmp_path) == {"interface": "eth2", "alias": "5"}
    with pytest.raises(UsageError, match="name one drive twice"):
        line_of({"position": 2, "alias": 5})


def test_a_rig_with_two_addresses_of_one_drive_is_refused(tmp_path):
    with pytest.raises(DataFileError, match="position and alias name one drive twice"):
        loaded_rig(tmp_path, "ethercat: {interface: eth1, position: 0, alias: 5}\n")


def test_position_chooses_the_bus_and_the_interface_is_its_own(capsys, segment):
    assert main(["scan", "-i", "eth9", "--position", "0"]) == 0
    out = capsys.readouterr().out
    assert "position 0: objects behind a mailbox" in out
    assert "position 1" in out
    assert "alias 7" in out


def test_options_of_another_bus_are_refused(capsys):
    assert main(["identify", "--drive", "ethercat", "-i", "eth9", "-c", "can0"]) == 2
    assert "--channel: belongs to CANopen" in " ".join(capsys.readouterr().err.split())
    assert main(["identify", "--drive", "canopen", "--position", "0"]) == 2
    assert "--position: belongs to EtherCAT" in " ".join(capsys.readouterr().err.split())
    assert main(["identify", "--drive", "ethercat", "--position", "300"]) == 2


def test_scan_writes_a_starter_rig(segment, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["scan", "-i", "eth9", "--position", "1", "--write", "rig.yaml"]) == 0
    section = ethercat.ETHERCAT.section_of(load_rig(tmp_path / "rig.yaml"))
    assert (section.interface, section.position) == ("eth9", 1)


def test_doctor_reports_segment_watchdog_and_clocks(segment, capsys):
    main(["doctor", "-i", "eth9", "--position", "1"])
    out = capsys.readouterr().out
    for said in ("2 slaves answer", "PRE-OP", "100 ms are set", "the slave controller has them",
                 "6007h exists"):
        assert said in out
    main(["doctor", "-i", "eth9", "--alias", "99"])
    assert "no slaves are with station alias 99" in capsys.readouterr().out


def test_a_segment_with_another_master_is_not_used(segment, capsys):
    segment.driven = "eth9, position 0: the slave is in OP"
    main(["doctor", "-i", "eth9", "--position", "1"])
    main(["scan", "-i", "eth9", "--position", "1"])
    said = capsys.readouterr()
    assert (said.out + said.err).count("the slave is in OP") == 2
    assert [message for slave in segment.slaves for message in slave.heard] == []


def test_nothing_is_written_by_scan_and_doctor(segment, capsys):
    main(["scan", "-i", "eth9", "--position", "0"])
    main(["doctor", "-i", "eth9", "--position", "0"])
    requests = [data[8] for slave in segment.slaves for manager, data in slave.heard if manager == 0]
    assert set(requests) <= {0x40, 0x60, 0x70}                   # uploads only


def test_simulate_names_its_requirements(monkeypatch, capsys):
    monkeypatch.setattr(ethercat.shutil, "which", lambda *_, **__: None)
    assert main(["scan", "--drive", "ethercat", "--simulate"]) != 0
    err = " ".join(capsys.readouterr().err.split())
    assert "needs a pair of virtual Ethernet interfaces (veth): the program ip is missing" in err
    assert "--drive canopen" in err


def test_a_run_without_an_interface_explains_how_to_name_one(capsys):
    assert main(["stop", "--drive", "ethercat", "--position", "0"]) == 2
    assert "-i eth1" in capsys.readouterr().err


def test_the_lock_is_that_of_the_segment():
    line = ethercat.ETHERCAT.line({"interface": "eth1", "position": 3}, None, None)
    connection = SimpleNamespace(line=line)
    assert ethercat.ETHERCAT.address(None, connection) == "ethercat eth1"


@pytest.mark.parametrize("name", ["generic/cia402-ethercat", "beckhoff/ax8000", "elmo/gold-ethercat",
                                  "maxon/epos4-ethercat"])
def test_the_page_of_a_profile_names_its_pdos(name, capsys):
    assert main(["profiles", "show", name]) == 0
    first = load_profile(name).cyclic.rx_pdos[0]
    assert f"{first:04X}h" in capsys.readouterr().out
