"""The contract of every Drive (tests/drivers/test_drive_contract.py), on a real SocketCAN interface."""

from __future__ import annotations

import pytest

from sim_bus.params import RigParams
from tests.drivers.drive_benches import Run
from tests.drivers.test_drive_contract import *  # noqa: F403
from tests.drivers.test_drive_contract import other_mode
from tests.vcan.vcan_bench import VcanBench


@pytest.fixture
def make_bench(vcan):
    made = []

    def make(*args, **options):
        made.append(VcanBench(vcan, *args, **options))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


@pytest.fixture
def run(make_bench):
    return Run(make_bench())


def test_a_seed_repeats_a_run(make_bench):
    """As in the contract, but for mode display and torque demand: they come with TPDO2, behind the feedback that ends
    a cycle, and whether they are there at the next cycle is the kernel's business."""
    def once(seed):
        run = Run(make_bench(RigParams(), seed=seed))
        run.turning(3.0)
        run.go(1.0, other_mode(run), 3.0, 100.0)
        run.bench.close()              # one interface: two drives on it would be two nodes of one ID
        return [sample._replace(mode=None, torque_demand_nm=None) for sample in run.samples]

    first = once(7)
    assert once(7) == first
    assert once(8) != first
