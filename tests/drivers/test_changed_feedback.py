"""TPDOs that a tool or a panel changes during a run: mapping, transmission type, COB-ID; and sparse feedback."""

import itertools
import random
import struct

import pytest

from drivers.canopen.pdo_mapping import DISABLED, NO_REMOTE
from drivers.drive import Mode, PowerState
from drivers.errors import CommunicationLost
from tests.drivers.drive_benches import Run

FRAMES = 4 + 4 + 4 + 4                 # 1800h:1, 2, 3, 5; 1A00h:0 to 3; the same of 1801h and 1A01h
TURN_S, GROUPS = 0.5, 3
ROUND_S = TURN_S * GROUPS * FRAMES


@pytest.fixture
def run(bench):
    run = Run(bench)
    run.turning(2.0)
    return run


def panel(run, *writes):
    """Change an object by the panel of the drive, without frames on the bus."""
    store = run.bench.simulated.simulator.node.store
    for index, sub, value in writes:
        store.write(index << 8 | sub, value)


def tool(run, index, sub, value, size):
    """Send the SDO of a tool on the same bus (CiA 301, expedited download)."""
    command = {1: 0x2F, 2: 0x2B, 4: 0x23}[size]
    run.bench.foreign(0x601, struct.pack("<BHBI", command, index, sub, value))


def until_lost(run, seconds):
    begun_s = run.drive.clock.now_s()
    with pytest.raises(CommunicationLost) as caught:
        run.go(seconds, speed=2.0)
    return caught.value, run.drive.clock.now_s() - begun_s


REMAPPED = ((0x1800, 1, DISABLED | 0x181), (0x1A00, 0, 0), (0x1A00, 2, 0x60740010), (0x1A00, 0, 3), (0x1800, 1, 0x181))
"""Mapping with the demanded torque instead of the reported one, in a frame of the same length."""


@pytest.mark.long(but_first=3)
@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("writes", "where", "words"), [
    (REMAPPED, "1A00h:2", ("TPDO1 mapping", "60770010h", "60740010h")),
    (((0x1800, 3, 1),), "1800h:3", ("TPDO1", "0 was set, 1 is there now")),
    (((0x1800, 5, 7),), "1800h:5", ("TPDO1", "0 was set, 7 is there now")),
    (((0x1801, 2, 100),), "1801h:2", ("TPDO2", "5 was set, 100 (64h) is there now")),
    (((0x1801, 1, DISABLED | 0x281),), "1801h:1", ("TPDO2", "80000281h")),
])
def test_a_change_by_the_panel_is_found_within_a_round_and_named(run, writes, where, words):
    if writes[0][1] == 3:
        writes = ((0x1800, 1, DISABLED | 0x181), *writes, (0x1800, 1, NO_REMOTE | 0x181))
    panel(run, *writes)
    error, took_s = until_lost(run, ROUND_S + 3.0)
    assert where in error.where
    for word in words:
        assert word in error.what
    assert took_s <= ROUND_S + 1.0


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("index", "sub", "value", "size"), [
    (0x1800, 2, 10, 1), (0x1801, 2, 100, 1), (0x1800, 5, 7, 2),
])
def test_a_received_write_of_a_tool_is_found_at_once(run, index, sub, value, size):
    tool(run, index, sub, value, size)
    error, took_s = until_lost(run, 1.0)
    assert f"{index:04X}h:{sub}" in error.where
    assert took_s <= 0.1


@pytest.mark.heavy
def test_a_whole_remapping_on_the_bus_is_stopped_while_it_is_under_way(run):
    """The first write disables the TPDO. tdhil finds this and restores the value."""
    tool(run, 0x1800, 1, DISABLED | 0x181, 4)
    error, took_s = until_lost(run, 1.0)
    assert "1800h:1" in error.where
    assert took_s <= 0.1
    assert run.bench.read(0x1800, 1) == NO_REMOTE | 0x181        # as delivered
    assert run.cycle().fresh


@pytest.mark.heavy
def test_frames_of_another_mapping_are_not_believed_any_more(run):
    panel(run, *REMAPPED)
    until_lost(run, ROUND_S + 3.0)
    run.drive.quick_stop()
    samples = [run.cycle() for _ in range(50)]
    assert not any(sample.fresh for sample in samples)
    found = run.drive.poll()
    assert found.state is PowerState.QUICK_STOP
    assert found.speed_rad_s == pytest.approx(run.bench.true_speed_rad_s, abs=0.1)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("every", [3, 8, 100])
def test_feedback_that_is_too_sparse_ends_the_run_within_a_second(run, every):
    """The read-back of this object may come much later."""
    run.drive._read_back._over = True
    panel(run, (0x1800, 2, every))
    error, took_s = until_lost(run, 3.0)
    assert "cycles (1 s) brought no feedback" in error.what
    assert "transmission type" in error.next_step
    assert took_s <= 1.0 + every * run.drive.period_s


@pytest.mark.heavy
def test_standstill_is_polled_by_sdo_while_feedback_is_sparse(run):
    run.drive._read_back._over = True
    number = itertools.count(1)
    run.bench.bus.change = lambda message: (
        [] if message.arbitration_id == 0x181 and next(number) % 8 else [message])
    until_lost(run, 3.0)
    run.drive.quick_stop()
    for _ in range(100):
        for _ in range(10):
            run.cycle()
        found = run.drive.poll()
        assert found is not None and found.fresh
    assert found.state is PowerState.QUICK_STOP
    assert abs(found.speed_rad_s) < 0.02 and abs(run.bench.true_speed_rad_s) < 0.02
    run.drive.disable()
    run.cycle()
    run.drive.poll()
    assert run.drive.poll().state is PowerState.OFF


@pytest.mark.heavy
def test_the_transmission_type_is_restored_for_the_stop(run):
    run.drive._read_back._over = True
    panel(run, (0x1800, 2, 8))
    until_lost(run, 3.0)
    run.drive.quick_stop()
    run.go(0.1)
    assert [run.cycle().fresh for _ in range(20)] == [True] * 20
    assert run.bench.read(0x1800, 2) == 1


@pytest.mark.heavy
@pytest.mark.parametrize("lost", [0.01, 0.1])
def test_a_bus_that_loses_frames_runs_on(run, lost):
    """Row 17: a loss of one to ten percent."""
    rng = random.Random(5)
    run.bench.bus.change = lambda message: [] if message.arbitration_id == 0x181 and rng.random() < lost else [message]
    run.go(ROUND_S, speed=2.0)
    assert run.drive.counters.missed > 0
    assert run.drive.remarks() == ()


@pytest.mark.heavy
def test_a_gap_before_it_is_enabled_is_none_of_this(run):
    run.stop()
    run.drive.disable()
    run.bench.bus.change = lambda message: [] if message.arbitration_id == 0x181 else [message]
    run.go(2.0)
    run.bench.bus.change = lambda message: [message]
    run.drive.enable(Mode.SPEED)
    run.go(1.0, speed=1.0)
    assert run.samples[-1].state is PowerState.ENABLED
