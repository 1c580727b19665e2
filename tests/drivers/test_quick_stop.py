"""`tdhil stop` on a CANopen drive in torque mode, where its quick stop coasts."""

from contextlib import suppress

import can
import pytest

from drivers import quick_stop
from drivers.canopen.bus import CanLink
from drivers.canopen.quick_stop import BURST, BURST_PAUSE_S, BY_RPDO_TRIES, BY_SDO_TRIES, CanopenTarget
from drivers.canopen.sdo import ANSWER_S as AT_REST_S
from drivers.canopen.sdo import TRIES, SdoObjects
from drivers.cia402 import ANSWER_S
from drivers.clock import MonotonicClock
from drivers.errors import CommunicationLost, DriveFault, ObjectRefused
from drivers.quick_stop import Ended
from profiles.library import load_canopen_profile
from sim_bus.canopen.simulator import EmbeddedSimulator
from sim_bus.params import FAITHFUL, QUIET, RigParams
from sim_bus.plant.rigid import Params
from tests.drivers.scripted_drive import ScriptedDrive, u


@pytest.fixture(scope="module")
def epos4():
    return load_canopen_profile("maxon/epos4")


@pytest.fixture
def turning(epos4, tmp_path):
    """Drive with a light shaft in cyclic torque mode, at more than 2 rad/s, in real time."""
    trace = tmp_path / "shaft.csv"
    params = RigParams(plant=Params(inertia_kg_m2=30.0), noise=QUIET, reporting=FAITHFUL)
    with EmbeddedSimulator(params, profile=epos4, stepped=False, trace=trace) as simulated:
        bus = can.Bus(interface="virtual", channel=simulated.channel)
        objects = SdoObjects(CanLink(bus, MonotonicClock()), 1)
        objects.write(0x6060, 0, 10, 8)
        for word in (0x06, 0x07, 0x0F):
            objects.write(0x6040, 0, word, 16)
        objects.write(0x6071, 0, 250, 16)
        while simulated.simulator.speed_rad_s < 2.0:
            assert objects.read(0x6041) & 0x6F == 0x27
        yield simulated.simulator, can.Bus(interface="virtual", channel=simulated.channel), trace
        bus.shutdown()


@pytest.mark.heavy
def test_in_torque_mode_it_is_braked_and_never_let_go_while_it_turns(turning, epos4):
    simulator, bus, trace = turning
    target = CanopenTarget(bus, epos4, MonotonicClock(), node=1)
    report = quick_stop.bare_stop(target, MonotonicClock())
    target.close()
    assert report.ended is Ended.AT_REST
    assert abs(simulator.speed_rad_s) < 0.05
    assert any("speed mode at zero came first" in line for line in report.remarks)
    rows = [line.split(",") for line in trace.read_text().splitlines()[1:] if line.count(",") == 4]
    let_go = [row for row in rows if abs(float(row[1])) > 0.2 and row[3] == "switch on disabled"]
    assert not let_go


@pytest.fixture
def scripted(wire):
    peer = ScriptedDrive(wire, marker=False)
    peer.machine.state = "operation enabled"
    peer.objects |= {(0x6060, 0): u(10, 1), (0x6061, 0): u(10, 1), (0x606C, 0): bytes(4), (0x605A, 0): u(6, 2)}
    return peer


def order(peer):
    return [(index, int.from_bytes(data, "little")) for index, _, data in peer.writes]


def test_speed_mode_comes_before_the_quick_stop(wire, scripted, epos4):
    CanopenTarget(wire, epos4, MonotonicClock(), node=1).ask(1)
    assert order(scripted) == [(0x60FF, 0), (0x6060, 9), (0x6040, 0x02)]


def test_a_drive_that_refuses_speed_mode_gets_the_quick_stop_and_a_message(wire, scripted, epos4):
    scripted.deaf_to.add((0x6061, 0))
    target = CanopenTarget(wire, epos4, MonotonicClock(), node=1)
    target.ask(1)
    target.ask(2)
    assert order(scripted).count((0x6040, 0x02)) == 2
    assert order(scripted).count((0x6060, 9)) == 1          # no more attempts
    assert any("stays in torque mode" in line for line in target.remarks())


@pytest.mark.parametrize("refused", [(0x60FF, 0), (0x6060, 0), (0x6061, 0)])
def test_whatever_the_drive_refuses_before_it_the_quick_stop_is_written(wire, scripted, epos4, refused):
    scripted.refuse_write[refused] = scripted.refuse_read[refused] = 0x08000022     # not in this state of the device
    target = CanopenTarget(wire, epos4, MonotonicClock(), node=1)
    for attempt in range(1, BY_SDO_TRIES + 3):
        with suppress(ObjectRefused, DriveFault):
            target.ask(attempt)
    assert order(scripted).count((0x6040, 0x02)) == BY_SDO_TRIES + 2


@pytest.mark.parametrize("refused", [(0x6060, 0), (0x6061, 0), (0x6041, 0)])
def test_whatever_the_drive_refuses_the_rpdo_of_another_master_is_switched_off(wire, scripted, epos4, refused):
    """The other master holds the drive in torque mode, and enables it after each quick stop."""
    scripted.refuse_write[refused] = scripted.refuse_read[refused] = 0x08000022     # not in this state of the device
    scripted.objects |= {(0x606C, 0): u(400, 4), (0x1400, 1): u(0x201, 4)}
    attempts = []

    def enables_again(request):
        if not scripted.value(0x1400, 1) >> 31:
            scripted.machine.state = "operation enabled"

    scripted.before_answer = enables_again

    class Target(CanopenTarget):
        def enforce(self, attempt):
            attempts.append(attempt)
            super().enforce(attempt)

    report = quick_stop.bare_stop(Target(wire, epos4, MonotonicClock(), node=1), MonotonicClock(), 5.0)
    most = BY_SDO_TRIES + BY_RPDO_TRIES
    assert attempts[: most + 1] == list(range(1, most + 2))
    assert len(wire.of(0x201)) >= BURST
    assert scripted.value(0x1400, 1) == 0x80000201
    assert scripted.machine.state == "quick stop active"
    assert any(f"{refused[0]:04X}h" in line for line in report.remarks)        # the first error of each attempt


@pytest.mark.parametrize("name", ["kollmorgen/akd", "lenze/i950"])
def test_a_drive_that_keeps_its_mode_while_enabled_gets_the_quick_stop_alone(wire, scripted, name):
    target = CanopenTarget(wire, load_canopen_profile(name), MonotonicClock(), node=1)
    target.ask(1)
    target.ask(2)
    assert order(scripted) == [(0x6040, 0x02)] * 2
    (said,) = target.remarks()
    assert "stays in torque mode" in said


def test_a_drive_that_does_not_answer_gets_the_quick_stop_soon(wire, scripted, epos4):
    """Frames arrive, and answers are lost. Only the first step waits as long as at standstill."""
    sent = []
    wire.on_send = lambda identifier, data: sent.append((wire.time.now_s, data[:4]))
    begun_s = wire.time.now_s
    with pytest.raises(CommunicationLost, match="node 1 does not answer"):
        CanopenTarget(wire, epos4, MonotonicClock(), node=1).ask(BY_SDO_TRIES + BY_RPDO_TRIES + 1)
    words = [time_s for time_s, head in sent if head == bytes.fromhex("2b406000")]
    assert len(words) == TRIES
    assert words[0] - begun_s <= TRIES * AT_REST_S + 3 * ANSWER_S


def test_a_quick_stop_option_whose_write_is_lost_is_written_again(wire, scripted):
    scripted.objects[0x605A, 0] = u(0, 2)
    target, writes = target_of(wire), []

    def loses(identifier, data):
        writes.append(data[:4] == bytes.fromhex("2b5a6000"))
        if not writes[-1] or sum(writes) > TRIES:
            scripted.on_frame(identifier, data)

    wire.on_send = loses
    with pytest.raises(CommunicationLost):
        target.ask(1)
    assert scripted.value(0x605A) == 0
    target.ask(2)
    assert scripted.value(0x605A) == 6


@pytest.mark.parametrize("name", ["generic/cia402", "maxon/epos4"])
def test_if_speed_mode_is_not_needed_only_the_quick_stop_is_written(wire, scripted, name):
    """The drive is in speed mode, or its quick stop decelerates in torque mode too."""
    if name == "maxon/epos4":
        scripted.objects[0x6061, 0] = u(9, 1)
    CanopenTarget(wire, load_canopen_profile(name), MonotonicClock(), node=1).ask(1)
    assert order(scripted) == [(0x6040, 0x02)]


def target_of(wire, profile="generic/cia402"):
    return CanopenTarget(wire, load_canopen_profile(profile), MonotonicClock(), node=1)


@pytest.mark.parametrize("refused", [False, True])
def test_a_quick_stop_set_to_coast_is_changed_or_replaced_by_the_halt_bit(wire, scripted, refused):
    scripted.objects[0x605A, 0] = u(0, 2)
    if refused:
        scripted.refuse_write[0x605A, 0] = 0x06010002
    target = target_of(wire)
    target.ask(1)
    target.ask(2)
    word = 0x010F if refused else 0x0002          # CiA 402: bit 8, halt, with enable operation; or quick stop
    assert order(scripted) == [(0x605A, 6), (0x6040, word), (0x6040, word)]
    (said,) = target.remarks()
    assert ("the halt bit was used instead" if refused else "605Ah was changed from 0 to 6") in said


@pytest.mark.parametrize("state", ["switched on", "ready to switch on", "switch on disabled"])
def test_the_halt_bit_enables_no_drive(wire, scripted, state):
    """010Fh takes a drive that is switched on to operation enabled (CiA 402, transition 4)."""
    scripted.machine.state = state
    scripted.objects[0x605A, 0] = u(0, 2)
    scripted.refuse_write[0x605A, 0] = 0x06010002
    target_of(wire).ask(1)
    assert order(scripted)[-1] == (0x6040, 0x0002)
    assert scripted.machine.state != "operation enabled"


def test_an_rpdo_that_reverses_it_is_answered_by_rpdo_and_finally_disabled(wire, scripted):
    """RPDO2 has 6040h after one other byte. RPDO1 is disabled, and RPDO3 has no controlword."""
    scripted.objects |= {
        (0x1401, 1): u(0x301, 4), (0x1601, 0): u(2, 1), (0x1601, 1): u(0x60600008, 4), (0x1601, 2): u(0x60400010, 4),
        (0x1402, 1): u(0x401, 4), (0x1602, 0): u(1, 1), (0x1602, 1): u(0x60FF0020, 4),
    }
    target = target_of(wire)
    for attempt in range(1, BY_SDO_TRIES + 1):
        target.ask(attempt)
    assert wire.of(0x301) == []
    begun_s = wire.time.now_s
    target.ask(BY_SDO_TRIES + 1)
    assert wire.of(0x301) == [b"\x00\x02\x00"] * BURST
    assert wire.time.now_s - begun_s >= BURST * BURST_PAUSE_S
    assert wire.of(0x201) == wire.of(0x401) == []
    target.ask(BY_SDO_TRIES + BY_RPDO_TRIES + 1)
    assert scripted.value(0x1401, 1) == 0x80000301
    assert scripted.value(0x1402, 1) == 0x401
    assert len(wire.of(0x301)) == BURST
    assert any("1401h:1 = 80000301h" in line for line in target.remarks())
    assert order(scripted)[-1] == (0x6040, 0x0002)
    with pytest.raises(DriveFault, match="no RPDO carries the controlword"):
        target.ask(BY_SDO_TRIES + 1)


def test_readings_of_the_drive(wire, scripted):
    scripted.objects[0x606C, 0] = u(500, 4)
    target = target_of(wire)
    seen = target.poll()
    assert seen.speed == pytest.approx(50.0 * 2.0 * 3.14159265 / 60.0, rel=1e-6)      # 0.1 rpm
    assert (seen.unit, seen.near_zero, seen.standstill, seen.follows) == ("rad/s", False, False, True)
    scripted.objects[0x606C, 0] = u(-3, 4)
    assert target.poll().near_zero
    target.ask(1)
    seen = target.poll()
    assert "quick stop active" in seen.text
    assert not seen.follows


@pytest.mark.parametrize("foreign", [0x080, 0x201, 0x301, 0x401, 0x501, 0x601])
def test_another_master_is_reported(wire, scripted, foreign):
    target = target_of(wire)
    assert target.remarks() == ()
    wire.put(foreign, b"\x0f\x00")
    target.ask(1)
    (said,) = target.remarks()
    frames, syncs = (0, 1) if foreign == 0x080 else (1, 0)
    assert f"{frames} frames to node 1 and {syncs} SYNC" in said


@pytest.mark.parametrize("other_steps", [False, True])
def test_a_simulated_drive_in_stepped_time_continues_in_its_own_time(wire, other_steps):
    """It stays stepped while a host steps it."""
    peer = ScriptedDrive(wire)
    peer.objects[0x605A, 0] = u(6, 2)
    if other_steps:
        wire.put(0x080, b"", 0.1)
    target_of(wire).ask(1)
    assert peer.value(0x5FFE, 2) == (1 if other_steps else 0)
