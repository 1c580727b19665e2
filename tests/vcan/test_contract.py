"""Part of the contract of every Drive (tests/drivers/test_drive_contract.py) that depends on a socket of the kernel.

It is the order, the time and the content of the frames, and the remaining settings in the drive. The rest of the
contract does not depend on the bus: the benches of tests/drivers test it.
"""

from __future__ import annotations

from functools import partial

import pytest

from sim_bus.params import RigParams
from tests.drivers.drive_benches import Run, opened
from tests.drivers.test_drive_contract import (  # noqa: F401  (collected here)
    other_mode,
    test_a_quick_stop_brakes_on_the_ramp_and_holds,
    test_counters,
    test_nothing_is_sent_behind_the_loops_back,
    test_samples_are_one_period_apart,
    test_settings_are_given_back,
    test_the_frames_on_the_bus_carry_the_setpoints,
    test_the_frames_on_the_bus_say_what_the_samples_say,
    test_the_tap_sees_every_frame_in_order,
    test_the_whole_order,
)
from tests.vcan.vcan_bench import VcanBench


@pytest.fixture
def make_bench(vcan):
    with opened() as make:
        yield partial(make, VcanBench, vcan)


@pytest.fixture
def run(make_bench):
    return Run(make_bench())


def test_a_seed_repeats_a_run(make_bench):
    """The run repeats as in the contract, except for mode display and torque demand.

    They come with TPDO2 after the feedback that ends a cycle. The kernel determines whether they arrive before the next
    cycle.
"""
    def once(seed):
        run = Run(make_bench(RigParams(), seed=seed))
        run.turning(3.0)
        run.go(1.0, other_mode(run), 3.0, 100.0)
        run.bench.close()              # one interface: two drives would be two nodes with one ID
        return [sample._replace(mode=None, torque_demand_nm=None) for sample in run.samples]

    first = once(7)
    assert once(7) == first
    assert once(8) != first
