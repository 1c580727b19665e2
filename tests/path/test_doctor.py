"""`tdhil doctor`: without a drive, with a drive, and with a faulty one; it never writes to a drive."""

import functools
import json
import math
from types import SimpleNamespace

import pytest

from sim_bus.canopen.simulator import EmbeddedSimulator
from sim_bus.modbus import embedded
from sim_bus.modbus.wrong_maps import Wrong
from sim_bus.params import RigParams
from tdhil.buses import canopen
from tdhil.buses.canopen import link_findings
from tdhil.cli.doctor import disk_finding, jitter_finding, library_findings, naps, timer_finding
from tests.path.path_runs import tdhil
from tests.path.watched_bus import WatchedBus

GRADES = {"ok", "note", "bad"}


def checks(done):
    """Return name → list of (grade, message) with that name."""
    found = {}
    for line in done.out.splitlines():
        grade, _, rest = line.partition(" ")
        if grade in GRADES:
            name, said = rest.strip()[:17].strip(), rest.strip()[17:]
            found.setdefault(name, []).append((grade, said))
    return found


def grades(done, name):
    return {grade for grade, _ in checks(done)[name]}


# -- the computer --------------------------------------------------------------------------------------------


def test_it_works_with_nothing_connected():
    done = tdhil("doctor")
    assert done.code == 0, done.out
    found = checks(done)
    assert {"computer", "python-can", "canopen", "pymodbus", "timer", "scheduling", "disk", "profile", "limits",
            "drive"} <= set(found)
    assert grades(done, "drive") == {"note"}
    assert "no CAN bus is configured" in done.out
    assert done.out.splitlines()[-1] == "no obstacle was found"
    assert "Traceback" not in done.err


def test_json_has_the_same_content():
    document = tdhil("doctor", "--json").document
    assert document["exit_code"] == 0
    assert {one["grade"] for one in document["checks"]} <= GRADES
    assert all(one["do"] for one in document["checks"] if one["grade"] == "bad")


def test_what_a_killed_run_left_in_a_drive_is_named(tmp_path):
    from drivers.drive import Identity
    from drivers.undo_journal import UndoJournal

    book = UndoJournal(tmp_path, "node1")
    book.opened(Identity(0xFB, 0x1, 0, 0x77, "top drive", False))
    book.changing("6072h", b"\x64\x00", b"\x90\x01")
    done = tdhil("doctor", "--log", tmp_path / "run.mcap")
    assert done.code == 4
    assert "top drive, node1: 6072h was left at 400; before that run it was 100" in done.out
    book.given_back("6072h")
    assert tdhil("doctor", "--log", tmp_path / "run.mcap").code == 0


def test_a_rig_is_checked(tmp_path):
    rig = tmp_path / "rig.yaml"
    rig.write_text("limits: {speed_min_rad_s: 1, speed_max_rad_s: 9, torque_nm: 50, time_s: 60, quick_stop_rad_s2: 1, "
                   "probe_torque_nm: 5, probe_travel_rad: 1}\nprofile: mine.yaml\n")
    done = tdhil("doctor", "--rig", rig)
    assert done.code == 4
    (line,) = [line for line in done.out.splitlines() if line.startswith("bad ")]
    assert "mine.yaml: no such file" in line                       # a missing profile hides no earlier check
    rig.write_text(rig.read_text().replace("profile: mine.yaml", "profile: generic/cia402"))
    done = tdhil("doctor", "--rig", rig)
    assert done.code == 0
    assert "9 rad/s, 50 N·m (rig.yaml:1)" in done.out


def test_a_typo_is_one_line():
    for arguments, said in ((("--profile", "generic/cia40"), "did you mean"), (("--node", "300"), "--node"),
                            (("--host", "x", "--unit", "300"), "--unit"), (("--rig", "none.yaml"), "none.yaml")):
        done = tdhil("doctor", *arguments)
        assert done.code in (2, 4)
        assert said in done.out + done.err
        assert "Traceback" not in done.err


def test_libraries():
    found = list(library_findings({"python-can": "4.6.1rc2", "canopen": "2.3.9"}.get))
    assert [one.grade for one in found] == ["ok", "bad", "bad"]
    assert "pip install --upgrade 'canopen>=2.4'" in found[1].do
    assert "is not installed" in found[2].said


def test_timer_and_scheduling():
    assert timer_finding(1e-9).grade == "ok"
    assert timer_finding(0.0156).grade == "note"
    clock = iter([value for nap in range(50) for value in (nap, nap + 0.002 + (0.01 if nap == 7 else 1e-4))])
    late_s = naps(lambda: next(clock), lambda seconds: None)
    assert max(late_s) == pytest.approx(0.01)
    found = jitter_finding(late_s)
    assert found.grade == "note"
    assert "0.10 ms late, at worst 10.00 ms (in 50 tries)" in found.said


def test_disk(tmp_path, monkeypatch):
    from tdhil.cli import doctor

    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: SimpleNamespace(free=80_221_000_000))
    free = disk_finding(tmp_path / "run.mcap")
    assert (free.grade, free.said) == ("ok", f"80 GB free for {tmp_path / 'run.mcap'}")
    monkeypatch.undo()
    assert "Make that folder" in disk_finding(tmp_path / "none" / "run.mcap").do
    monkeypatch.setattr(doctor, "WANTED_FREE_BYTES", math.inf)
    assert disk_finding(tmp_path / "run.mcap").grade == "bad"


# -- CANopen -------------------------------------------------------------------------------------------------


def test_a_drive_on_the_bus_is_read_and_never_written_to(monkeypatch):
    with EmbeddedSimulator(RigParams(), node_id=3, stepped=True) as simulated:
        bus = WatchedBus(simulated.channel)
        monkeypatch.setattr(canopen, "open_bus", lambda config: bus)
        done = tdhil("doctor", "-i", "virtual", "-c", simulated.channel, "--node", 3)
    assert done.code == 0, done.out
    assert bus.identifiers == {0x603}
    assert bus.only_reads
    assert "node 3 answers: a CiA 402 drive" in done.out
    assert "1016h:1 exists" in done.out
    assert "SIMULATED" in done.out
    assert grades(done, "bit rate") == {"note"}


def test_no_drive_on_the_bus():
    done = tdhil("doctor", "-i", "virtual", "-c", "nobody", "--node", 9)
    assert done.code == 4
    (line,) = [line for line in done.out.splitlines() if line.startswith("bad ")]
    assert "node 9 does not answer" in line


def test_the_wrong_profile():
    with EmbeddedSimulator(RigParams(), stepped=True) as simulated:
        done = tdhil("doctor", "-i", "virtual", "-c", simulated.channel, "--profile", "maxon/epos4")
    assert done.code == 4
    assert grades(done, "identity") == {"bad"}
    assert "--profile" in done.out


def test_a_drive_in_fault():
    with EmbeddedSimulator(RigParams(), stepped=True) as simulated:
        simulated.simulator.node.application.fault()
        done = tdhil("doctor", "-i", "virtual", "-c", simulated.channel)
    assert done.code == 4
    assert grades(done, "state") == {"bad"}
    assert "--reset-fault" in done.out


def link(state="ERROR-ACTIVE", bitrate=250000, sent=0, received=0):
    data = {"state": state, "bittiming": {"bitrate": bitrate}, "berr_counter": {"tx": sent, "rx": received}}
    return json.dumps([{"ifname": "can0", "flags": ["UP"], "linkinfo": {"info_kind": "can", "info_data": data}}])


def test_kernel_reports_of_a_link():
    assert [(one.grade, one.name) for one in link_findings(link(), "can0")] == [
        ("ok", "bit rate"), ("ok", "bus state"), ("ok", "error counters"),
    ]
    worse = list(link_findings(link("ERROR-PASSIVE", sent=128), "can0"))
    assert [one.grade for one in worse] == ["ok", "bad", "note"]
    assert "errors sent 128, received 0" in worse[2].said
    off = list(link_findings(link("BUS-OFF"), "can0"))[1]
    assert off.do.endswith("sudo ip link set can0 down && sudo ip link set can0 up")


@pytest.mark.parametrize("text", [None, "", "{}", "[]", "[1]", "null", '[{"ifname": "can0", "linkinfo": 3}]'])
def test_invalid_kernel_reports(text):
    assert all(one.grade == "note" for one in link_findings(text, "can0"))


def test_a_missing_link():
    done = tdhil("doctor", "-i", "socketcan", "-c", "nocan77")
    assert done.code == 4
    assert "nocan77" in done.out
    assert "→" in done.out


# -- Modbus --------------------------------------------------------------------------------------------------


def test_every_register_beside_its_meaning():
    done = tdhil("doctor", "--drive", "modbus", "--simulate")
    assert done.code == 0, done.out
    for said in ("all 26 of profile generic/modbus can be read", "SIMULATED", "rated torque: 1000 N·m",
                 "42 (002Ah)", "305419896", "name plate", "0.4 s"):
        assert said in done.out
    document = tdhil("doctor", "--drive", "modbus", "--simulate", "--json").document
    registers = {one["name"]: one for one in document["registers"]}
    assert registers["parameters.rated_torque"]["value"] == pytest.approx(1000.0)
    assert registers["parameters.check_sign"]["counts"] == -12345


def test_a_check_of_a_modbus_drive_writes_nothing(monkeypatch):
    asked = []
    serve = embedded.EmbeddedModbusDrive.serve

    def watched(self, unit, pdu, now_s):
        asked.append(pdu[0])
        return serve(self, unit, pdu, now_s)

    monkeypatch.setattr(embedded.EmbeddedModbusDrive, "serve", watched)
    assert tdhil("doctor", "--drive", "modbus", "--simulate").code == 0
    assert tdhil("scan", "--drive", "modbus", "--simulate").code == 0
    assert set(asked) <= {3, 4, 0x2B}


@pytest.mark.parametrize("wrong", ["word_order", "scale_10", "address_off_by_one", "unsigned"])
def test_a_drive_that_differs_from_its_profile(monkeypatch, wrong):
    twisted = functools.partial(embedded.EmbeddedModbusDrive, wrongs=(Wrong(wrong),))
    monkeypatch.setattr(embedded, "EmbeddedModbusDrive", twisted)
    done = tdhil("doctor", "--drive", "modbus", "--simulate")
    assert done.code == 4, done.out
    assert any(line.startswith("bad ") for line in done.out.splitlines())
    assert "Traceback" not in done.err


def test_nobody_listens_there():
    done = tdhil("doctor", "--host", "127.0.0.1", "--port", 1)
    assert done.code == 4
    (line,) = [line for line in done.out.splitlines() if line.startswith("bad ")]
    assert "127.0.0.1:1" in line
