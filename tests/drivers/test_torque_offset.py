"""Torque offset (60B2h, CiA 402-2): mapped on request, sent in every cycle, and removed first in every stop."""

import struct
from dataclasses import replace

import pytest

from drivers.canopen.quick_stop import CanopenTarget
from drivers.clock import SteppedClock
from drivers.drive import Command, Mode, PowerState
from drivers.errors import CommandRejected
from profiles.library import load_canopen_profile
from tests.drivers.drive_benches import LIMITS, Run

OFFSET = (0x60B2, 0)
WITH_OFFSET = replace(LIMITS, torque_offset=True)


@pytest.fixture
def bench(bench):
    bench.limits = WITH_OFFSET
    return bench


def turning(bench):
    run = Run(bench)
    run.turning(5.0)
    return run


def offsets(bench):
    """Return the offsets in RPDO2, in per mille of 1000 N·m."""
    return [struct.unpack("<bh", frame.data)[1] for frame in bench.frames if frame.identifier == 0x301]


def push(run, offset_nm, cycles=1, speed=5.0):
    for _ in range(cycles):
        sample = run.drive.exchange(Command(Mode.SPEED, speed, 0.0, offset_nm))
    return sample


@pytest.mark.heavy
def test_it_acts_with_the_cycle_and_is_added_to_the_speed_loop(bench):
    run = turning(bench)
    before = push(run, 0.0)
    after = push(run, 100.0, 5)
    # 100 N·m after the drive's lag of 10 ms, before speed and integral change much
    assert after.torque_nm - before.torque_nm == pytest.approx(100.0 * 0.8, abs=12.0)
    assert offsets(bench)[-5:] == [100] * 5
    assert bench.read(*OFFSET) == 100


@pytest.mark.heavy
def test_it_is_zero_in_the_cycle_of_a_quick_stop_for_any_command(bench):
    run = turning(bench)
    push(run, 100.0, 50)
    run.drive.quick_stop()
    push(run, 100.0)
    assert offsets(bench)[-1] == 0
    assert bench.read(*OFFSET) == 0
    run.stop()
    assert bench.true_speed_rad_s == pytest.approx(0.0, abs=1e-6)


@pytest.mark.heavy
def test_it_is_zero_in_torque_mode(bench):
    run = turning(bench)
    push(run, 100.0, 5)
    run.drive.exchange(Command(Mode.TORQUE, 5.0, 60.0, 100.0))
    assert offsets(bench)[-1] == 0


@pytest.mark.heavy
def test_it_is_refused_without_a_request(bench):
    bench.limits = LIMITS
    run = turning(bench)
    with pytest.raises(CommandRejected, match="none is mapped"):
        push(run, 1.0)
    assert all(len(frame.data) == 1 for frame in bench.frames if frame.identifier == 0x301)


def test_preflight_refuses_a_drive_without_one(bench):
    bench.drive._profile = bench.drive._profile.model_copy(update={"torque_offset": None})
    bench.drive.connect()
    refused = bench.drive.preflight(WITH_OFFSET).refused
    assert [check.name for check in refused] == ["torque offset"]
    assert "--impedance reference" in refused[0].next_step


def test_what_a_dead_host_left_is_gone_with_the_next_run_and_with_a_stop_from_outside(bench):
    def leave(counts):
        bench.foreign(0x601, struct.pack("<BHBhxx", 0x2B, 0x60B2, 0, counts))
        assert bench.read(*OFFSET) == counts

    leave(70)
    target = CanopenTarget(
        bench.simulated.station(), load_canopen_profile("generic/cia402"), SteppedClock(), node=1
    )
    target.ask(1)
    assert bench.read(*OFFSET) == 0
    target.close()
    leave(70)
    bench.limits = LIMITS
    Run(bench).ready()
    assert bench.read(*OFFSET) == 0


@pytest.mark.heavy
def test_a_stop_by_sdo_removes_it_first(bench):
    run = turning(bench)
    push(run, 100.0, 50)
    bench.drive._stand()
    bench.drive.quick_stop()
    bench.frames.clear()
    push(run, 100.0, 12)
    asked = [frame.data[1:4] for frame in bench.frames if frame.identifier == 0x601 and frame.data[0] == 0x2B]
    assert asked[0] == struct.pack("<HB", *OFFSET)
    assert bench.read(*OFFSET) == 0
    run.until(lambda sample: sample.state is PowerState.QUICK_STOP, 2.0)
