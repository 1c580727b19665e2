"""Frames derived by hand, compared with the driver and with the simulated drive with the profile.

Both read the same profile, so a common misreading could cancel. These bytes would still show it.
"""

from pathlib import Path

import can
import pytest
import yaml

from drivers.canopen.drive import CanopenDrive
from drivers.clock import SteppedClock
from drivers.drive import Command, DriveLimits, Mode, PowerState
from profiles.library import load_canopen_profile, profile_names, profile_path
from sim_bus.canopen.simulator import EmbeddedSimulator
from sim_bus.params import FAITHFUL, QUIET, DriveParams, RigParams

FOLDER = Path(__file__).parent / "golden_canopen"
GOLDEN = {path.stem: yaml.safe_load(path.read_text(encoding="utf-8")) for path in sorted(FOLDER.glob("*.yaml"))}


def data(text):
    """Return the bytes of '0f 00' or of 75, which YAML reads as a number."""
    return bytes.fromhex(str(text))


class Swapped:
    """Bus that replaces the data of the drive's TPDO1."""

    def __init__(self, bus):
        self.bus, self.channel_info, self.tpdo = bus, bus.channel_info, None

    def send(self, message):
        self.bus.send(message)

    def recv(self, timeout):
        message = self.bus.recv(timeout)
        if message is not None and self.tpdo is not None and message.arbitration_id == 0x181:
            return can.Message(arbitration_id=0x181, data=self.tpdo, is_extended_id=False)
        return message

    def shutdown(self):
        self.bus.shutdown()


class Bench:
    """Driver and simulated drive after preflight, with every frame between them."""

    def __init__(self, golden):
        profile = load_canopen_profile(golden["profile"])
        drive = DriveParams(rated_torque_nm=golden["rated_torque_nm"], torque_limit_nm=golden["torque_limit_nm"])
        rig = RigParams(drive=drive, noise=QUIET, reporting=FAITHFUL)
        self.simulated = EmbeddedSimulator(rig, profile=profile).open()
        self.node = self.simulated.simulator.node
        self.host = can.Bus(interface="virtual", channel=self.simulated.channel)
        self.bus = Swapped(can.Bus(interface="virtual", channel=self.simulated.channel))
        self.frames = []
        self.drive = CanopenDrive(
            self.bus, profile, SteppedClock(), node=1, tap=self.frames.append,
            rated_torque_nm=golden.get("told_rated_torque_nm"),
        )
        self.drive.connect()
        for entry in golden.get("stands", ()):
            self.node.store.write(entry["index"] << 8 | entry["sub"], entry["value"])
        self.found = self.drive.preflight(DriveLimits(**golden["limits"], accept_wider=frozenset({"quick-stop"})))

    def close(self):
        self.host.shutdown()
        self.bus.shutdown()
        self.simulated.close()

    def ask(self, request):
        while self.host.recv(0.0) is not None:
            pass
        self.host.send(can.Message(arbitration_id=0x601, data=request, is_extended_id=False))
        while (message := self.host.recv(2.0)) is not None:
            if message.arbitration_id == 0x581:
                return bytes(message.data)
        raise AssertionError("no answer")


@pytest.fixture(params=sorted(GOLDEN))
def golden(request):
    return GOLDEN[request.param]


@pytest.fixture
def bench(golden):
    bench = Bench(golden)
    yield bench
    bench.close()


def test_every_canopen_profile_has_golden_frames():
    canopen = {name for name in profile_names() if "bus: canopen" in profile_path(name).read_text(encoding="utf-8")}
    assert {entry["profile"] for entry in GOLDEN.values()} == canopen


def test_preflight_sends_and_receives_these_frames(bench, golden):
    assert bench.found.refused == ()
    sent = [(frame.identifier, frame.data) for frame in bench.frames if frame.identifier in (0x601, 0x581)]
    for entry in golden["sdo"]:
        request = (0x601, data(entry["request"]))
        assert request in sent, entry["means"]
        assert sent[sent.index(request) + 1] == (0x581, data(entry["reply"])), entry["means"]


def test_missing_objects_of_the_drive_are_missing(bench, golden):
    """The drive aborts with 06020000h, and the driver works without the object."""
    for index in golden.get("absent", ()):
        reply = bench.ask(bytes([0x40, index & 255, index >> 8, 0, 0, 0, 0, 0]))
        assert reply == bytes([0x80, index & 255, index >> 8, 0, 0x00, 0x00, 0x02, 0x06]), f"{index:04X}h"


def test_guarding(bench, golden):
    boot_up = b"\x00"              # also received if the node starts late
    answers = [frame.data for frame in bench.frames
               if frame.identifier == 0x701 and not frame.outgoing and frame.data != boot_up]
    asked = [frame.data for frame in bench.frames if frame.identifier == 0x701 and frame.outgoing]
    wanted = golden.get("guarding")
    assert asked == ([] if wanted is None else [b""])
    assert answers[:1] == ([] if wanted is None else [data(wanted)])


def enabled(bench):
    bench.drive.enable(Mode.SPEED)
    for _ in range(20):
        if bench.drive.exchange(Command(Mode.SPEED, 0.0, 0.0)).state is PowerState.ENABLED:
            return
    raise AssertionError("not enabled")


def test_the_driver_sends_these_setpoints_and_the_drive_decodes_them(bench, golden):
    enabled(bench)
    application = bench.node.application
    for entry in golden["rpdo1"]:
        begin = len(bench.frames)
        bench.drive.exchange(Command(Mode.SPEED, entry["speed_rad_s"], entry["torque_nm"] or 0.0))
        sent = [frame.data for frame in bench.frames[begin:] if frame.outgoing and frame.identifier == 0x201]
        assert sent == [data(entry["bytes"])], entry["means"]
        # The decoded value equals the setpoint within half a count.
        assert application.target_speed_rad_s == pytest.approx(
            entry["speed_rad_s"], abs=0.51 * bench.found.speed_resolution_rad_s
        ), entry["means"]
        if entry["torque_nm"] is not None:
            assert application.target_torque_nm == pytest.approx(
                entry["torque_nm"], abs=0.51 * bench.found.torque_resolution_nm
            ), entry["means"]


def test_the_driver_decodes_this_feedback(bench, golden):
    enabled(bench)
    for entry in golden["tpdo1"]:
        bench.bus.tpdo = data(entry["bytes"])
        sample = bench.drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
        assert sample.status == entry["status"], entry["means"]
        assert sample.torque_nm == pytest.approx(entry["torque_nm"], rel=1e-8), entry["means"]
        assert sample.speed_rad_s == pytest.approx(entry["speed_rad_s"], rel=1e-8), entry["means"]


def test_the_simulated_drive_reports_this_feedback(bench, golden):
    """The same numbers in its reports give these bytes, except for its own statusword."""
    for entry in golden["tpdo1"]:
        reporting = bench.node.inverter.reporting
        reporting.torque_nm, reporting.speed_rad_s = entry["torque_nm"], entry["speed_rad_s"]
        assert bench.node._transmit[0].pack()[2:] == data(entry["bytes"])[2:], entry["means"]


def test_a_drive_behind_a_gateway_has_no_watchdog_and_is_refused(monkeypatch):
    """Its watchdog supervises EtherCAT, so the CAN side has none. It is accepted by override only."""
    monkeypatch.setitem(GOLDEN["beckhoff-ax8000-gateway"]["limits"], "accept_no_watchdog", False)
    bench = Bench(GOLDEN["beckhoff-ax8000-gateway"])
    assert [check.name for check in bench.found.refused] == ["watchdog"]
    bench.close()


def test_a_scaling_with_another_setting_is_refused():
    golden = GOLDEN["beckhoff-ax8000-gateway"]
    bench = Bench(golden | {"stands": [{"index": 0x3005, "sub": 2, "value": 8448}]})
    assert [check.name for check in bench.found.refused] == ["3005h:02 Scaling index velocity NC"]
    bench.close()
