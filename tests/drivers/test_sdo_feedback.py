"""Poll beside the cycle, for every drive; and what a poll may write to a drive out of operation."""

import math
import struct

import pytest

from drivers.canopen import bus
from drivers.drive import Polled, PowerState
from drivers.errors import CommunicationLost, DriveFault
from tests.drivers.drive_benches import Run
from tests.drivers.modbus_bank import CONTROL
from tests.drivers.power_machine import ENABLED, STOPPING
from tests.drivers.test_modbus_drive import Run as BankRun

STATUS, SPEED = b"\x40\x41\x60\x00", b"\x40\x6c\x60\x00"      # SDO upload of 6041h and 606Ch (CiA 301)


@pytest.fixture
def turning(bench, monkeypatch):
    monkeypatch.setattr(bus, "PEER_DEAD_S", 0.5)
    monkeypatch.setattr(bus, "PEER_STILL_DEAD_S", 0.001)
    run = Run(bench)
    run.turning(2.0, 2.0)
    return run


def requests(bench):
    return [data for identifier, data in bench.heard() if identifier == 0x601]


def quietly(run, cycles, **setpoint):
    """Run cycles and ignore the errors that a stop ignores; return the fresh samples."""
    found = []
    for _ in range(cycles):
        try:
            found.append(run.cycle(**setpoint))
        except (CommunicationLost, DriveFault):
            continue
    return [sample for sample in found if sample.fresh]


def test_a_poll_agrees_with_the_cycle(run):
    run.ready()
    run.enable()
    sample = run.go(3.0, speed=2.0)
    poll = run.drive.poll()
    assert isinstance(run.drive, Polled)
    assert poll.fresh and poll.state is PowerState.ENABLED
    assert poll.speed_rad_s == pytest.approx(sample.speed_rad_s, abs=0.01 + 3.0 * run.bench.speed_lsb)
    assert math.isfinite(poll.torque_nm)
    assert abs(poll.torque_nm - sample.torque_nm) < 60.0
    # The poll requests no change of state: the run continues.
    assert run.cycle(speed=2.0).state is PowerState.ENABLED


@pytest.mark.heavy
def test_in_pre_operational_it_finds_standstill_and_disables(turning, bench):
    bench.foreign(0x000, bytes((0x80, 1)))
    quietly(turning, 10, speed=2.0)
    turning.drive.quick_stop()
    bench.heard()
    for _ in range(60):                                   # 2 rad/s at 1 rad/s²
        assert quietly(turning, 10) == []
        poll = turning.drive.poll()
    assert poll.speed_rad_s == pytest.approx(0.0, abs=0.05)
    assert abs(bench.true_speed_rad_s) < 0.01
    turning.drive.disable()
    turning.drive.poll()
    quietly(turning, 2)
    assert turning.drive.poll().state is PowerState.OFF
    words = [struct.unpack("<H", data[4:6])[0] for data in requests(bench) if data[1:4] == b"\x40\x60\x00"]
    assert words and all(word & 0x0F != 0x0F for word in words)


def test_a_stopped_node_is_polled_in_pre_operational(turning, bench):
    bench.foreign(0x000, bytes((0x02, 1)))
    quietly(turning, 40, speed=2.0)
    turning.drive.quick_stop()
    bench.heard()
    poll = turning.drive.poll()
    commands = [data for identifier, data in bench.heard() if identifier == 0]
    assert commands == [bytes((0x80, 1))]
    assert poll is not None and poll.state is not PowerState.ENABLED


@pytest.mark.heavy
def test_after_a_restart_nothing_is_enabled(turning, bench):
    bench.foreign(0x000, bytes((0x81, 1)))
    quietly(turning, 10, speed=2.0)
    turning.drive.quick_stop()
    bench.heard()
    first = turning.drive.poll()
    assert first.state is PowerState.OFF
    for _ in range(200):
        quietly(turning, 10)
        last = turning.drive.poll()
    assert abs(last.speed_rad_s) < 0.05 < abs(first.speed_rad_s)      # it coasted, and its time continued
    assert not any(data[1:4] == b"\x40\x60\x00" for data in requests(bench))


def test_an_enabled_drive_gets_the_quick_stop_by_sdo(turning, bench):
    """The drive receives no RPDO, but it is still in operation and turns."""
    send = bench.bus.send
    bench.bus.send = lambda message: None if message.arbitration_id == 0x201 else send(message)
    turning.drive.quick_stop()
    assert turning.cycle().state is PowerState.ENABLED
    turning.drive.poll()
    turning.go(0.1)
    assert turning.drive.poll().state is PowerState.QUICK_STOP
    turning.go(4.0)
    assert abs(bench.true_speed_rad_s) < 0.01


@pytest.mark.parametrize("head", [STATUS, SPEED])
def test_without_a_reply_there_is_no_sample_and_no_second_request(turning, bench, head):
    bench.bus.change = lambda message: [
        message for _ in range(1) if message.arbitration_id != 0x581 or bytes(message.data[1:4]) != head[1:]
    ]
    bench.heard()
    assert turning.drive.poll() is None
    assert sum(data[:4] == head for data in requests(bench)) == 1


def test_a_lost_bus(turning, bench):
    bench.bus.send_error = OSError("gone")
    with pytest.raises(CommunicationLost):
        turning.drive.poll()


# -- Modbus: plain reads ------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", [1, 2, 4])
def test_a_drive_that_accepts_no_writes_is_still_polled(code):
    run = BankRun().enabled()
    run.bank.refuse = {6: code, 16: code, 23: code}
    run.drive.quick_stop()
    with pytest.raises(DriveFault):
        run.cycle()
    run.bank.requests.clear()
    poll = run.drive.poll()
    assert poll.fresh and poll.state is PowerState.ENABLED
    assert [pdu[0] for pdu in run.bank.requests] == [3, 6, 3]        # read, the word in a separate write, the angle
    run.bank.machine.state = STOPPING
    assert run.drive.poll().state is PowerState.QUICK_STOP


def test_the_quick_stop_word_is_sent_alone():
    run = BankRun().enabled()
    run.bank.refuse = {23: 4}
    run.drive.quick_stop()
    with pytest.raises(DriveFault):
        run.cycle()
    assert run.bank.machine.state == ENABLED
    run.bank.writes.clear()
    run.drive.poll()
    assert run.drive.poll().state is PowerState.QUICK_STOP
    assert [address for address, _ in run.bank.writes] == [CONTROL]


@pytest.mark.parametrize("silent", [True, False])
def test_a_drive_without_readable_registers(silent):
    run = BankRun().enabled()
    run.bank.silent = silent
    run.bank.refuse = {} if silent else dict.fromkeys((3, 6, 16, 23), 2)
    assert run.drive.poll() is None
