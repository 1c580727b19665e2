"""`tdhil scan`: found drives, matching profiles, and messages without a reply."""

import re
import threading
import time

import can
import pytest

from drivers.errors import PreflightRefused
from drivers.modbus.scan import parse_identification
from profiles.canopen import CanopenProfile
from profiles.library import load_canopen_profile, load_profile, profile_names
from sim_bus.canopen.simulator import EmbeddedSimulator, Simulator
from sim_bus.params import RigParams
from tdhil.buses import FoundDrive, canopen, modbus
from tdhil.buses.canopen import match
from tdhil.buses.modbus import parse_units
from tdhil.config.rig import load_rig, require_limits
from tdhil.session import starter
from tests.path.path_runs import tdhil
from tests.path.scan_lines_scripted import Answering, Garbled, Silent
from tests.path.watched_bus import WatchedBus
from tests.rigs import NUMBERS, rig_file

pytestmark = pytest.mark.real_time         # time-out of a reply, wall time
QUICK = ("--listen", 0.5)


def filled(path):
    """Return the completed starter file: without '#', and with a value after each key."""
    text = re.sub(r"^#( *[a-z_0-9]+:)", r"\1", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    text = re.sub(r"^(name:)", r"\1 bench 3", text, flags=re.MULTILINE)
    for name, value in (NUMBERS | {"torque_scale_rel_sd": 0.02, "rated_torque_nm": 1000.0}).items():
        text = re.sub(rf"^(  {name}:)", rf"\1 {value}", text, flags=re.MULTILINE)
    text = re.sub(r"^(    [a-z_0-9]+:)", r"\1 1.5", text, flags=re.MULTILINE)
    text = re.sub(r"^(profile:) +#", r"\1 generic/modbus    #", text, flags=re.MULTILINE)
    path.write_text(text, encoding="utf-8")
    return load_rig(path)


# -- CANopen -------------------------------------------------------------------------------------------------


def test_a_node_reports_its_identity(tmp_path):
    with EmbeddedSimulator(RigParams(), node_id=42, stepped=True) as simulated:
        done = tdhil("scan", "-i", "virtual", "-c", simulated.channel, *QUICK)
        document = tdhil("scan", "-i", "virtual", "-c", simulated.channel, *QUICK, "--json").document
    assert done.code == 0, done.err
    assert "node 42: Generic CiA 402 drive · SIMULATED" in done.out
    (found,) = document["found"]
    assert found["address"] == 42
    assert found["simulated"] is True
    assert found["profile"] == "generic/cia402"


def test_scanning_writes_nothing_to_a_drive(monkeypatch):
    with EmbeddedSimulator(RigParams(), node_id=3, stepped=True) as simulated:
        bus = WatchedBus(simulated.channel)
        monkeypatch.setattr(canopen, "open_bus", lambda config: bus)
        done = tdhil("scan", "-i", "virtual", "-c", simulated.channel, *QUICK)
    assert done.code == 0, done.err
    assert bus.identifiers == {0x600 + node for node in range(1, 128)}
    assert bus.only_reads


@pytest.mark.heavy
def test_two_nodes_and_a_starter_for_one_of_them(tmp_path):
    with EmbeddedSimulator(RigParams(), node_id=5, stepped=True) as simulated:
        bus = can.Bus(interface="virtual", channel=simulated.channel)
        second = Simulator(bus, RigParams(), node_id=42, stepped=True, profile=load_canopen_profile("maxon/epos4"))
        stop = threading.Event()
        thread = threading.Thread(target=second.run, args=(stop,), daemon=True)
        thread.start()
        try:
            options = ("scan", "-i", "virtual", "-c", simulated.channel, *QUICK)
            found = {one["address"]: one for one in tdhil(*options, "--json").document["found"]}
            unclear = tdhil(*options, "--write", tmp_path / "a.yaml")
            chosen = tdhil(*options, "--node", 42, "--write", tmp_path / "b.yaml")
        finally:
            stop.set()
            thread.join()
            bus.shutdown()
    assert set(found) == {5, 42}
    assert found[42]["profile"] == "maxon/epos4"
    assert "vendor" in found[42]["why"]
    assert unclear.code == 2
    assert "2 drives were found" in unclear.err
    assert "--node" in unclear.err
    assert not (tmp_path / "a.yaml").exists()
    assert chosen.code == 0, chosen.err
    text = (tmp_path / "b.yaml").read_text(encoding="utf-8")
    assert load_rig(tmp_path / "b.yaml").limits is None            # unchanged, it permits no motion of a real drive
    with pytest.raises(PreflightRefused):
        require_limits(load_rig(tmp_path / "b.yaml"))
    rig = filled(tmp_path / "b.yaml")
    assert require_limits(rig).torque_nm == 400.0
    assert (rig.drive, rig.node, rig.profile) == ("canopen", 42, "maxon/epos4")
    assert (rig.bus.interface, rig.bus.channel) == ("virtual", simulated.channel)
    assert "(SIMULATED)" in text


def test_an_existing_file_is_never_overwritten(tmp_path):
    path = rig_file(tmp_path, "node: 3\n")
    done = tdhil("scan", "--simulate", *QUICK, "--write", path)
    assert done.code == 2
    assert "not overwritten" in done.err
    assert path.read_text() == "node: 3\n"


def test_nobody_there(monkeypatch):
    done = tdhil("scan", "-i", "virtual", "-c", "nobody", *QUICK)
    assert done.code == 5
    assert "no frame was received" in done.err
    assert "termination" in done.err
    assert len(done.err.splitlines()) == 1


def test_no_bus_is_named():
    done = tdhil("scan")
    assert done.code == 2
    assert "no CAN bus is configured" in done.err
    assert "--serial" in done.err


class ErrorFrames:
    """Adapter at a wrong bit rate: error frames, and no reply."""

    channel_info = "an adapter"

    def __init__(self):
        self.sent = 0
        self._pending = 0

    def send(self, message, timeout=None):
        self.sent += 1
        self._pending += 1

    def recv(self, timeout=0.0):
        if not self._pending:
            time.sleep(min(timeout or 0.0, 0.01))
            return None
        self._pending -= 1
        return can.Message(is_error_frame=True, arbitration_id=0x4)

    def shutdown(self):
        pass


class Full(ErrorFrames):
    """Bus without an acknowledgement: the transmit queue stays full (ENOBUFS)."""

    def send(self, message, timeout=None):
        raise can.CanOperationError("No buffer space available", 105)


@pytest.mark.long(but_first=2)
@pytest.mark.heavy
@pytest.mark.parametrize("command", ["scan", "doctor", "identify"])
@pytest.mark.parametrize("bus", [ErrorFrames, Full])
def test_a_wrong_bit_rate(monkeypatch, command, bus):
    monkeypatch.setattr(canopen, "open_bus", lambda config: bus())
    more = QUICK if command == "scan" else ()
    done = tdhil(command, "-i", "virtual", "-c", "x", *more)
    said = done.err + done.out
    assert done.code in (4, 5)
    assert "Traceback" not in said
    if bus is Full:
        assert "No buffer space" in said
        assert "adapter and cable" in said or "no other node acknowledges" in said
    elif command == "identify":
        assert "its node-ID and bit rate" in said
    else:
        assert "error frames were received" in said
        assert "bit rate is most likely wrong" in said


@pytest.mark.parametrize("name", [name for name in profile_names() if isinstance(load_profile(name), CanopenProfile)])
def test_a_profile_with_an_identity_is_matched_by_it(name):
    profiles = [profile for one in profile_names() if isinstance(profile := load_profile(one), CanopenProfile)]
    wanted = load_canopen_profile(name).identity
    found, _ = match(0x00020192, (wanted.vendor, wanted.product, wanted.revision), profiles)
    assert found == name if wanted.vendor is not None else found == "generic/cia402"
    assert match(0x00020192, (0xDEAD, 1, 1), profiles)[0] == "generic/cia402"
    assert match(0x00020191, (0xDEAD, 1, 1), profiles) == (None, "not a CiA 402 drive (device type 00020191h)")


# -- Modbus --------------------------------------------------------------------------------------------------


def test_the_embedded_modbus_drive(tmp_path):
    done = tdhil("scan", "--drive", "modbus", "--simulate", "--unit", 7, "--write", tmp_path / "rig.yaml")
    assert done.code == 0, done.err
    assert "unit 7: Modbus device · SIMULATED" in done.out
    assert "generic/modbus (all registers answer, and a name plate that fits" in done.out
    rig = filled(tmp_path / "rig.yaml")
    assert (rig.drive, rig.modbus.unit, rig.profile) == ("modbus", 7, "generic/modbus")
    assert require_limits(rig).speed_max_rad_s == 10.0


def test_a_named_profile_is_in_the_starter(tmp_path):
    done = tdhil("scan", "--simulate", "--profile", "siemens/g120", "--write", tmp_path / "rig.yaml")
    assert done.code == 0, done.err
    text = (tmp_path / "rig.yaml").read_text(encoding="utf-8")
    assert "profile: siemens/g120    # as given: --profile" in text
    assert "# - p1300" in text                                    # settings at the drive
    assert filled(tmp_path / "rig.yaml").profile == "siemens/g120"


def test_a_serial_line_is_scanned_at_the_usual_settings_until_a_reply(tmp_path, monkeypatch):
    opened = []

    def open_wire(line, clock):
        opened.append((line.baud, line.parity, line.stop_bits))
        return Answering(clock) if opened[-1] == (9600, "N", 1) else Silent(clock)

    monkeypatch.setattr(modbus, "open_wire", open_wire)
    done = tdhil("scan", "--serial", "/dev/ttyUSB9", "--units", "2-4", "--write", tmp_path / "rig.yaml")
    assert done.code == 0, done.err
    assert opened[0] == (115200, "E", 1)                          # as in the profile
    assert opened[-1] == (9600, "N", 1)
    assert "unit 3: FC 302 · SIMULATED" not in done.out
    assert "unit 3: FC 302" in done.out
    assert "Danfoss FC 302 8.1" in done.out
    rig = filled(tmp_path / "rig.yaml")
    line = rig.modbus
    assert (line.serial, line.baud, line.parity, line.stop_bits, line.unit) == ("/dev/ttyUSB9", 9600, "N", 1, 3)
    assert rig.profile == "generic/modbus"                        # chosen by the engineer: no profile matched


def test_stated_settings_of_the_line_are_not_varied(monkeypatch):
    opened = []

    def open_wire(line, clock):
        opened.append((line.baud, line.parity, line.stop_bits))
        return Silent(clock)

    monkeypatch.setattr(modbus, "open_wire", open_wire)
    done = tdhil("scan", "--serial", "/dev/ttyUSB9", "--baud", 38400, "--parity", "O", "--unit", 1)
    assert done.code == 5
    assert opened == [(38400, "O", 1)]
    assert "no unit answers (units 1)" in done.err


def test_garbled_replies_point_to_the_line(monkeypatch):
    monkeypatch.setattr(modbus, "open_wire", lambda line, clock: Garbled(clock))
    done = tdhil("scan", "--host", "192.0.2.10", "--units", "1-2")
    assert done.code == 5
    assert "2 garbled replies" in done.err
    assert "parity" in done.err


def test_no_server(monkeypatch):
    done = tdhil("scan", "--host", "127.0.0.1", "--port", 1)
    assert done.code in (4, 5)
    assert "127.0.0.1:1" in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize(("text", "units"), [("1-3,247", (1, 2, 3, 247)), ("7", (7,)), ("2,1-2", (2, 1))])
def test_unit_numbers(text, units):
    assert parse_units(text) == units


@pytest.mark.parametrize("text", ["", "1-", "a", "5-2", "256", "-1"])
def test_invalid_unit_numbers(text):
    with pytest.raises(ValueError):
        parse_units(text)
    assert tdhil("scan", "--drive", "modbus", "--simulate", f"--units={text or 'x'}").code == 2


def test_device_identification_is_read_as_in_the_specification():
    """The reply of section 6.21 has MEI 0Eh, code 01, conformity 01, no more to follow, 3 objects (V1.1b3)."""
    pdu = bytes.fromhex("2b 0e 01 01 00 00 03") + b"\x00\x07Danfoss" + b"\x01\x06FC 302" + b"\x02\x038.1"
    assert parse_identification(pdu) == ("Danfoss", "FC 302", "8.1")
    for size in range(len(pdu)):
        parse_identification(pdu[:size])                          # truncated anywhere, it is no error
    assert parse_identification(bytes((0xAB, 1))) == ("", "", "")


@pytest.mark.parametrize("name", profile_names())
def test_a_starter_loads_for_every_profile_unchanged_and_completed(tmp_path, name):
    profile = load_profile(name)
    found = FoundDrive(profile.bus, 7, "drive", "vendor 1h", False, name, "why")
    path = tmp_path / "rig.yaml"
    line = {"canopen": {"interface": "socketcan", "channel": "can0"}, "ethercat": {"interface": "eth1", "position": 7},
            "modbus": {"host": "192.0.2.10"}}[profile.bus]
    path.write_text(starter(found, line, profile), encoding="utf-8")
    assert load_rig(path).limits is None
    rig = filled(path)
    assert require_limits(rig).time_s == 900.0
    assert rig.profile == name
    untold = {one.name for one in profile.parameters if getattr(one, "register_", one) is None}
    assert set(rig.drive_data.parameters) == untold
    assert (rig.accept_unverified == ()) == bool(profile.below("likely") or profile.below("unverified"))


def test_names_of_drives_break_no_file():
    found = FoundDrive("modbus", 1, "a\nnode: 3\x1b[31m", "x\r\nlimits: {}", False)
    text = starter(found, {"host": "on", "port": 502, "unit": 1}, None)
    assert "\nnode:" not in text
    assert "\nlimits:" not in text
    assert 'host: "on"' in text
