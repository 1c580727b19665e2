"""Status word without a valid state: zeros, ones, an undefined pattern. It does not disable the drive."""

import struct
from dataclasses import replace

import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.canopen.quick_stop import CanopenTarget
from drivers.cia402.state_machine import State, decode, decode_after
from drivers.clock import SteppedClock
from drivers.drive import Command, Mode, PowerState
from drivers.errors import DriveFault
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from drivers.modbus.quick_stop import ModbusTarget
from drivers.modbus.state_machine import decode as decode_modbus
from drivers.modbus.state_machine import decode_after as decode_modbus_after
from drivers.modbus.state_machine import power_state
from drivers.quick_stop import Ended, bare_stop
from profiles.library import load_profile, profile_names
from profiles.modbus import ModbusProfile
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from tests.drivers.drive_benches import Run
from tests.drivers.modbus_bank import CONTROL, SPEED, STATUS, Bank
from tests.drivers.modbus_bench import driven
from tests.drivers.on_wire import LIMITS, cycles, prepared
from tests.drivers.power_machine import ENABLED, STOPPING
from tests.drivers.scripted_drive import TPDO1
from tests.drivers.test_modbus_drive import GENERIC
from tests.drivers.test_modbus_drive import Run as BankRun
from tests.rigs import DRIVE_LIMITS, QUIET_RIG

MODBUS = [profile for name in profile_names() if isinstance(profile := load_profile(name), ModbusProfile)]
DEAD = (b"\0" * 8, b"\xff" * 8)


@pytest.fixture
def fresh(wire, peer, profile):
    return prepared(wire, profile)


@pytest.fixture
def drive(fresh, wire):
    fresh.enable(Mode.SPEED)
    assert cycles(fresh, wire).state is PowerState.ENABLED
    return fresh


# -- CANopen ----------------------------------------------------------------------------------------------------------


def test_ones_are_no_state_at_any_time_and_zeros_none_after_another_state():
    assert decode(0xFFFF) is decode_after(0xFFFF) is State.UNKNOWN
    assert (decode(0x0000), decode_after(0x0000)) == (State.NOT_READY, State.UNKNOWN)
    assert decode_after(0x0650) is State.SWITCH_ON_DISABLED


@pytest.mark.parametrize("data", DEAD, ids=["zeros", "ones"])
def test_dead_feedback_shows_no_state_and_nothing_is_disabled_on_it(drive, wire, peer, data):
    peer.tpdo = lambda cycle: data
    sample = cycles(drive, wire)
    assert (sample.state, sample.standstill, sample.fresh) == (PowerState.UNKNOWN, False, True)
    drive.quick_stop()
    cycles(drive, wire)
    begin = len(peer.setpoints)
    drive.disable()
    assert cycles(drive, wire, 50).state is PowerState.UNKNOWN
    assert {word for word, _, _ in peer.setpoints[begin:]} == {0x0002}
    assert peer.machine.state == STOPPING


@pytest.mark.parametrize("data", DEAD, ids=["zeros", "ones"])
def test_its_watchdog_stays_armed(drive, wire, peer, data):
    armed = peer.value(0x1016, 1)
    peer.tpdo = lambda cycle: data
    cycles(drive, wire)
    written = len(peer.writes)
    drive.close()
    assert peer.value(0x1016, 1) == armed != 0
    assert len(peer.writes) == written


def test_a_drive_may_be_not_ready_at_its_start(fresh, wire, peer):
    peer.tpdo = lambda cycle: TPDO1.pack(0, 0, 0)
    assert cycles(fresh, wire, 3).state is PowerState.NOT_READY
    del peer.tpdo
    assert cycles(fresh, wire, 3).state is PowerState.OFF
    peer.tpdo = lambda cycle: TPDO1.pack(0, 0, 0)
    assert cycles(fresh, wire, 3).state is PowerState.UNKNOWN


def test_it_may_be_so_again_after_its_boot_up_message(drive, wire, peer):
    wire.put(0x701, b"\x00")
    peer.tpdo = lambda cycle: TPDO1.pack(0, 0, 0)
    with pytest.raises(DriveFault, match="boot-up"):
        cycles(drive, wire, 3)
    assert cycles(drive, wire, 3).state is PowerState.NOT_READY


def test_a_poll_by_sdo_repeats_the_quick_stop_without_a_valid_state(bench):
    run = Run(bench)
    run.turning(2.0)
    store = bench.simulated.simulator.node.store
    store.live[0x6041 << 8] = lambda: 0
    run.drive.quick_stop()
    bench.heard()
    assert run.drive.poll().state is PowerState.UNKNOWN
    words = [struct.unpack("<H", data[4:6])[0] for identifier, data in bench.heard()
             if identifier == 0x601 and data[:3] == b"\x2b\x40\x60"]
    assert words == [0x0002]


def test_a_drive_that_shows_no_state_is_refused(wire, peer, profile):
    peer.machine.__class__ = type("Blank", (type(peer.machine),), {"status": property(lambda self: 0xFFFF)})
    drive = CanopenDrive(wire, profile, SteppedClock(), node=1)
    drive.connect()
    found = drive.preflight(LIMITS)
    state = next(check for check in found.refused if check.name == "state")
    assert state.found == "no valid state"
    assert "gateway" in state.next_step


# -- Modbus -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", MODBUS, ids=lambda one: one.name)
def test_in_every_family_ones_are_no_state_and_zeros_none_after_an_enable(profile):
    assert power_state(decode_modbus(profile.control, 0xFFFF)) is PowerState.UNKNOWN
    assert power_state(decode_modbus_after(profile.control, 0xFFFF)) is PowerState.UNKNOWN
    assert power_state(decode_modbus_after(profile.control, 0x0000)) is PowerState.UNKNOWN


@pytest.mark.heavy(but_first=3)
@pytest.mark.parametrize("profile", MODBUS, ids=lambda one: one.name)
def test_a_good_run_of_every_family_shows_a_valid_state_in_every_cycle(profile):
    """The simulated drive follows the manual of its family, not the profile."""
    simulated = EmbeddedModbusDrive(QUIET_RIG, profile)
    drive = driven(simulated, profile)
    drive.connect()
    assert not drive.preflight(replace(DRIVE_LIMITS, watchdog_s=1.0)).refused
    states = []

    def go(seconds, speed=0.0):
        command = Command(Mode.SPEED, speed, 0.0)
        states.extend(drive.exchange(command).state for _ in range(round(seconds / drive.period_s)))

    go(0.5)
    drive.enable(Mode.SPEED)
    go(4.0, 2.0)
    assert states[-1] is PowerState.ENABLED
    drive.quick_stop()
    go(6.0)
    drive.disable()
    go(1.0)
    simulated.close()
    assert states[-1] in (PowerState.OFF, PowerState.READY)
    assert PowerState.UNKNOWN not in states


@pytest.mark.parametrize("status", [0x0000, 0xFFFF])
def test_modbus_dead_feedback_shows_no_state_and_nothing_is_disabled_on_it(status):
    run = BankRun().enabled()
    run.bank.on_show = lambda words: words.update({STATUS: status, SPEED: 0, SPEED + 1: 0})
    assert run.cycle().state is PowerState.UNKNOWN
    run.drive.quick_stop()
    run.cycle()
    run.bank.writes.clear()
    run.drive.disable()
    samples = [run.cycle() for _ in range(60)]
    assert {(one.state, one.standstill) for one in samples} == {(PowerState.UNKNOWN, False)}
    assert set(run.controlwords()) == {0x0002}
    assert run.bank.machine.state == STOPPING


def test_modbus_left_to_its_watchdog_it_is_not_disabled_either():
    """Reading feeds no watchdog. The drive may be disabled at standstill, but not with a state of zeros."""
    run = BankRun().enabled()
    run.bank.on_show = lambda words: words.update({STATUS: 0, SPEED: 0, SPEED + 1: 0})
    run.drive.quick_stop()
    run.cycle()
    run.drive.stop_feeding()
    run.bank.writes.clear()
    run.drive.disable()
    for _ in range(60):
        run.cycle()
    assert run.bank.writes == []


def test_modbus_a_poll_writes_the_quick_stop_without_a_valid_state():
    run = BankRun().enabled()
    run.bank.on_show = lambda words: words.update({STATUS: 0})
    run.drive.quick_stop()
    run.bank.writes.clear()
    assert run.drive.poll().state is PowerState.UNKNOWN
    assert [(address, list(words)) for address, words in run.bank.writes] == [(CONTROL, [0x0002])]


def test_modbus_one_that_shows_no_state_is_refused():
    bank = Bank()
    bank.on_show = lambda words: words.update({STATUS: 0xFFFF})
    drive = ModbusDrive(EmbeddedLink(bank.serve, SteppedClock()), GENERIC, unit=1)
    drive.connect()
    state = next(check for check in drive.preflight(LIMITS).refused if check.name == "state")
    assert state.found.startswith("no valid state")


# -- a stop from outside ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("status", [0x0000, 0xFFFF])
def test_a_stop_from_outside_accepts_no_standstill_with_a_blank_status(status):
    bank, clock = Bank(), SteppedClock()
    bank.machine.state = ENABLED
    bank.on_show = lambda words: words.update({STATUS: status, SPEED: status, SPEED + 1: status})
    report = bare_stop(ModbusTarget(EmbeddedLink(bank.serve, clock), GENERIC, unit=1), clock)
    assert report.ended is Ended.TURNING
    assert report.asked > 100
    assert bank.machine.state == STOPPING
    assert any("no valid state" in line or f"{status:04X}h" in line for line in report.remarks)


@pytest.mark.heavy
def test_a_stop_from_outside_on_canopen_too(bench):
    run = Run(bench)
    run.turning(2.0)
    store = bench.simulated.simulator.node.store
    store.live[0x6041 << 8] = store.live[0x606C << 8] = lambda: 0
    target = CanopenTarget(bench.simulated.station(), run.drive._profile, SteppedClock(), node=1)
    report = bare_stop(target, SteppedClock())
    assert report.ended is Ended.TURNING
    assert any("0000h" in line for line in report.remarks)
