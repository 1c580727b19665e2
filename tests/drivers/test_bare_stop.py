"""`tdhil stop` on a CANopen drive that is in torque mode, where its quick stop lets go of the shaft."""

import can
import pytest
from scripted_drive import ScriptedDrive, u

from drivers import bare_stop
from drivers.bare_stop import Ended
from drivers.cia402.bare_stop import Cia402Target
from drivers.cia402.link import CanLink
from drivers.cia402.sdo import Objects
from drivers.clock import MonotonicClock
from profiles.library import load_canopen_profile
from sim_bus.params import FAITHFUL, QUIET, RigParams
from sim_bus.plant import Params
from sim_bus.simulator import EmbeddedSimulator


@pytest.fixture(scope="module")
def epos4():
    return load_canopen_profile("maxon/epos4")


@pytest.fixture
def turning(epos4, tmp_path):
    """A light shaft in cyclic torque mode, at more than 2 rad/s, in real time."""
    trace = tmp_path / "shaft.csv"
    params = RigParams(plant=Params(inertia_kg_m2=30.0), noise=QUIET, reporting=FAITHFUL)
    with EmbeddedSimulator(params, profile=epos4, stepped=False, trace=trace) as simulated:
        bus = can.Bus(interface="virtual", channel=simulated.channel)
        objects = Objects(CanLink(bus, MonotonicClock()), 1)
        objects.write(0x6060, 0, 10, 8)
        for word in (0x06, 0x07, 0x0F):
            objects.write(0x6040, 0, word, 16)
        objects.write(0x6071, 0, 250, 16)
        while simulated.simulator.speed_rad_s < 2.0:
            assert objects.read(0x6041) & 0x6F == 0x27
        yield simulated.simulator, can.Bus(interface="virtual", channel=simulated.channel), trace
        bus.shutdown()


def test_in_torque_mode_it_is_braked_and_never_let_go_while_it_turns(turning, epos4):
    simulator, bus, trace = turning
    target = Cia402Target(bus, epos4, MonotonicClock(), node=1)
    report = bare_stop.bare_stop(target, MonotonicClock())
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
    Cia402Target(wire, epos4, MonotonicClock(), node=1).ask(1)
    assert order(scripted) == [(0x60FF, 0), (0x6060, 9), (0x6040, 0x02)]


def test_a_drive_that_does_not_take_it_gets_the_quick_stop_all_the_same_and_that_is_said(wire, scripted, epos4):
    scripted.deaf_to.add((0x6061, 0))
    target = Cia402Target(wire, epos4, MonotonicClock(), node=1)
    target.ask(1)
    target.ask(2)
    assert order(scripted).count((0x6040, 0x02)) == 2
    assert order(scripted).count((0x6060, 9)) == 1          # no more time is spent on it
    assert any("stays in torque mode" in line for line in target.remarks())


@pytest.mark.parametrize("name", ["generic/cia402", "maxon/epos4"])
def test_where_it_is_not_needed_nothing_is_written_but_the_quick_stop(wire, scripted, name):
    """In speed mode, or where a quick stop decelerates in torque mode too."""
    if name == "maxon/epos4":
        scripted.objects[0x6061, 0] = u(9, 1)
    Cia402Target(wire, load_canopen_profile(name), MonotonicClock(), node=1).ask(1)
    assert order(scripted) == [(0x6040, 0x02)]
