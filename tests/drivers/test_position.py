"""`Positioned`: the reported angle, compared with the true angle of the simulated shaft."""

import itertools
import math

import pytest

from drivers.drive import Mode, Positioned
from tests.drivers.drive_benches import CanopenBench, Run
from tests.drivers.modbus_bench import ModbusBench


@pytest.fixture(params=[CanopenBench, ModbusBench])
def run(request, open_bench):
    return Run(open_bench(request.param))


def true_angle(bench):
    simulated = bench.simulated
    machine = simulated.simulator.node if isinstance(bench, CanopenBench) else simulated.machine
    return machine.inverter.state.angle_rad


@pytest.mark.heavy(but_first=1)
def test_it_follows_the_true_shaft(run):
    run.ready()
    run.enable(Mode.SPEED)
    run.go(3.0, speed=2.0)
    assert isinstance(run.drive, Positioned)
    pairs = []
    for _ in range(4):
        reading = run.drive.read_position()
        pairs.append((reading.position_rad, true_angle(run.bench), reading.time_s))
        run.go(1.0, speed=2.0)
    told = [b[0] - a[0] for a, b in itertools.pairwise(pairs)]
    true = [b[1] - a[1] for a, b in itertools.pairwise(pairs)]
    assert told == pytest.approx(true, abs=0.01)
    assert min(true) > 1.5
    assert reading.wraps_rad == pytest.approx(2.0 * math.pi * 2**32 / {True: 8192, False: 4096}[
        isinstance(run.bench, CanopenBench)
    ])


def test_it_takes_no_cycle(run):
    run.ready()
    run.enable(Mode.SPEED)
    before = run.drive.counters
    for _ in range(50):
        assert run.drive.read_position() is not None
        run.cycle(Mode.SPEED)
    after = run.drive.counters
    assert after.cycles == before.cycles + 50
    assert (after.missed, after.overruns) == (before.missed, before.overruns)


def test_a_drive_that_does_not_reply_gives_none(run):
    run.ready()
    run.enable(Mode.SPEED)
    if isinstance(run.bench, CanopenBench):
        run.bench.bus.change = lambda message: [] if message.arbitration_id == 0x581 else [message]
    else:
        run.bench.simulated.serve = lambda unit, pdu, now_s: (None, now_s)
    assert run.drive.read_position() is None
