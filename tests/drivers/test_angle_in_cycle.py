"""Motor angle in the cyclic data: its instant, its count over wraps, and drives that do not send it."""

import itertools
import math
import struct

import pytest

from drivers.angle import Unwrapped, longest_gap_s
from drivers.canopen.pdo import FrameShape, Slow
from drivers.canopen.slow_feedback import FORGOTTEN, ModeAndDemand, SlowFeedback
from drivers.drive import Mode, Outcome
from drivers.modbus.cycle import plan_cycle
from profiles.canopen import STANDARD_POSITION, CanopenProfile
from profiles.modbus import ModbusProfile
from tests.drivers import drive_benches, modbus_bench
from tests.drivers.drive_benches import CanopenBench, Run
from tests.drivers.modbus_bench import ModbusBench
from tests.drivers.profile_benches import S120Bench
from tests.drivers.test_modbus_plan import GENERIC, texts
from tests.drivers.test_profile_preflight import wide_profile

COUNT_RAD = 2.0 * math.pi / 8192               # of the simulated encoder


@pytest.fixture
def made(open_bench):
    return lambda kind, **options: Run(open_bench(kind, **options))


def inverter(run):
    return run.bench.simulated.simulator.node.inverter


def with_true_angles(run, seconds, **setpoint):
    """Run cycles; return them with the true angle of the shaft at each SYNC, before the drive advances."""
    found = []
    for _ in range(round(seconds / run.drive.period_s)):
        angle_rad = inverter(run).state.angle_rad
        found.append((run.cycle(**setpoint), angle_rad))
    return found


def brought(pairs):
    return [(sample, true) for sample, true in pairs if sample.position_rad is not None]


# -- CANopen ----------------------------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_it_is_of_the_same_sync_as_speed_and_torque(made):
    """They agree to one count. One period later the shaft would be 15 counts further."""
    run = made(CanopenBench)
    found = run.turning(5.0)
    pairs = brought(with_true_angles(run, 2.0, speed=5.0))
    assert len(pairs) == 100                   # with every fifth SYNC of 250 a second
    told = [sample.position_rad - pairs[0][0].position_rad for sample, _ in pairs]
    true = [angle - pairs[0][1] for _, angle in pairs]
    assert true[-1] > 9.0
    assert told == pytest.approx(true, abs=1.01 * COUNT_RAD)
    assert found.state is run.samples[-1].state


def test_it_is_the_angle_in_the_frames(made):
    run = made(CanopenBench)
    run.turning(5.0)
    run.bench.frames.clear()
    run.samples.clear()
    run.go(1.0, speed=5.0)
    counted, cycle = [], -1
    for frame in run.bench.frames:
        if frame.identifier == 0x181:
            cycle += 1
        elif frame.identifier == 0x281:
            counted.append((cycle, struct.unpack("<bhi", frame.data)[2]))
    told = [(k, sample.position_rad) for k, sample in enumerate(run.samples) if sample.position_rad is not None]
    assert [k for k, _ in told] == [k for k, _ in counted]
    for (_, first), (_, second), (_, one), (_, other) in zip(told, told[1:], counted, counted[1:], strict=False):
        assert second - first == pytest.approx((other - one) * COUNT_RAD, abs=1e-9)


@pytest.mark.parametrize(("rate_hz", "apart_s"), [(250.0, 0.02), (100.0, 0.05), (20.0, 0.1), (12.5, 0.08)])
def test_it_comes_every_tenth_of_a_second_at_least(made, rate_hz, apart_s):
    run = made(CanopenBench, rate_hz=rate_hz)
    found = run.ready()
    assert found.position_period_s == pytest.approx(apart_s)
    assert found.position_resolution_rad == pytest.approx(COUNT_RAD)
    run.go(2.0)
    times = [sample.time_s for sample in run.samples if sample.position_rad is not None]
    assert len(times) > 10
    assert [b - a for a, b in itertools.pairwise(times)] == pytest.approx([apart_s] * (len(times) - 1))


def test_a_lost_frame_leaves_a_gap_and_no_wrong_angle(made):
    run = made(CanopenBench)
    run.turning(5.0)
    lost = iter((True, False, True, True, False, False) * 100)
    run.bench.bus.change = lambda message: [] if message.arbitration_id == 0x281 and next(lost) else [message]
    pairs = brought(with_true_angles(run, 1.0, speed=5.0))
    assert len(pairs) == 25
    assert [sample.position_rad - true for sample, true in pairs] == pytest.approx(
        [pairs[0][0].position_rad - pairs[0][1]] * 25, abs=1.01 * COUNT_RAD)


@pytest.mark.heavy
def test_an_angle_without_its_feedback_is_dropped(made):
    run = made(CanopenBench)
    run.turning(5.0)
    run.bench.bus.change = lambda message: [] if message.arbitration_id == 0x181 else [message]
    samples = [run.cycle(speed=5.0) for _ in range(20)]
    assert not any(sample.fresh for sample in samples)
    assert [sample.position_rad for sample in samples] == [None] * 20


@pytest.mark.heavy
def test_a_foreign_sync_shifts_it_and_it_is_found_again(made):
    run = made(CanopenBench)
    run.turning(5.0)
    run.bench.foreign(0x080, b"")
    pairs = brought(with_true_angles(run, 1.0, speed=5.0))
    assert len(pairs) >= 40
    assert [sample.position_rad - true for sample, true in pairs] == pytest.approx(
        [pairs[0][0].position_rad - pairs[0][1]] * len(pairs), abs=1.01 * COUNT_RAD)


def refusing(bench):
    """Make the drive abort with 'cannot be mapped' (06040041h) for 6064h in a PDO."""
    store = bench.simulated.simulator.node.store
    store.variable(0x6064, 0).pdo_mappable = False


def test_a_drive_without_that_mapping_is_polled_as_before(made):
    run = made(CanopenBench)
    refusing(run.bench)
    found = run.ready()
    assert found.refused == ()
    note = next(check for check in found.checks if check.name == "angle in the cycle")
    assert note.outcome is Outcome.NOTE
    assert "1A01h" in note.where
    mapping = next(check for check in found.checks if check.name == "PDO mapping")
    assert mapping.found == "as wanted, without the angle"
    assert run.bench.settings(((0x1A01, 0), (0x1A01, 1), (0x1A01, 2))) == {
        "1A01h:0": 2, "1A01h:1": 0x60610008, "1A01h:2": 0x60740010}
    assert found.position_period_s is None
    assert found.position_resolution_rad == pytest.approx(COUNT_RAD)
    run.enable()
    run.go(1.0, speed=2.0)
    assert {sample.position_rad for sample in run.samples} == {None}
    assert run.samples[-1].mode is Mode.SPEED
    assert run.drive.read_position() is not None


def test_it_restores_the_mapping(made):
    run = made(CanopenBench)
    run.drive.connect()
    used = [(index, sub) for index, sub in CanopenBench.MAPPING if sub < 2 or index & 0xFF00 in (0x1400, 0x1800)]
    before = run.bench.settings(used)
    run.drive.preflight(run.bench.limits)
    assert run.bench.settings(((0x1A01, 3),)) == {"1A01h:3": 0x60640020}
    run.go(0.1)
    run.drive.close()
    assert run.bench.settings(used) == before


def test_a_wide_drive_has_no_room_for_both(made):
    """Statusword, mode, demand and angle need nine bytes. The rule leaves the demand out."""
    wide = FrameShape(torque=(0x5830, 0, 32))
    assert Slow.fitting(True, STANDARD_POSITION, wide) == Slow(False, STANDARD_POSITION, True)
    assert Slow.fitting(True, None, wide) == Slow(True, None, True)
    assert Slow.fitting(True, STANDARD_POSITION, FrameShape()) == Slow(True, STANDARD_POSITION, False)


def test_from_a_wide_drive_it_comes_in_every_cycle(made, monkeypatch):
    monkeypatch.setattr(drive_benches, "load_canopen_profile", lambda name: wide_profile("i32"))
    run = made(S120Bench)
    found = run.ready()
    assert found.position_period_s == pytest.approx(run.drive.period_s)
    run.enable()
    run.go(4.0, speed=5.0)
    pairs = with_true_angles(run, 1.0, speed=5.0)
    assert len(brought(pairs)) == len(pairs) == 100
    told = [sample.position_rad - pairs[0][0].position_rad for sample, _ in pairs]
    assert told == pytest.approx([angle - pairs[0][1] for _, angle in pairs], abs=0.002)


def narrow_profile(**position):
    data = drive_benches.load_canopen_profile("generic/cia402").model_dump()
    data["position"] = {**data["position"], "index": 0x2A00, "counts_per_turn": 4096.0, **position}
    return CanopenProfile.model_validate(data)


@pytest.mark.heavy
def test_a_counter_that_wraps_continues_to_count(made, monkeypatch):
    """With 16 bits and 4096 counts per turn it wraps every 16 turns, or 100 rad."""
    profile = narrow_profile(type="u16")
    monkeypatch.setattr(drive_benches, "load_canopen_profile", lambda name: profile)
    monkeypatch.setattr(CanopenBench, "WORN", True)
    run = made(CanopenBench)
    found = run.ready()
    assert found.position_gap_s == pytest.approx(0.5 * 65536 / 4096 * 2.0 * math.pi / (2.0 * 15.0))
    run.enable()
    pairs = brought(with_true_angles(run, 30.0, speed=8.0))
    told = [sample.position_rad - pairs[0][0].position_rad for sample, _ in pairs]
    true = [angle - pairs[0][1] for _, angle in pairs]
    assert true[-1] > 200.0
    assert told == pytest.approx(true, abs=0.004)


def test_without_unique_turns_no_angle_is_given(made, monkeypatch):
    """The range is half a turn. Twice the limit takes 52 ms for half of that; at 20 Hz it comes every 0.1 s."""
    profile = narrow_profile(type="u16", wrap_counts=2048.0)
    monkeypatch.setattr(drive_benches, "load_canopen_profile", lambda name: profile)
    monkeypatch.setattr(CanopenBench, "WORN", True)
    often, seldom = made(CanopenBench), made(CanopenBench, rate_hz=20.0)
    assert often.ready().position_period_s == pytest.approx(0.02)
    assert seldom.ready().position_period_s is None
    assert brought([(sample, 0.0) for sample in [seldom.cycle() for _ in range(40)]])[1:] == []
    assert seldom.drive.read_position() is not None


@pytest.mark.heavy
def test_a_poll_contains_it_too(made):
    run = made(CanopenBench)
    run.turning(5.0)
    first = brought(with_true_angles(run, 0.1, speed=5.0))[-1]
    found, true = run.drive.poll(), inverter(run).state.angle_rad
    assert found.position_rad - first[0].position_rad == pytest.approx(true - first[1], abs=1.01 * COUNT_RAD)
    run.bench.bus.change = lambda message: [message] if message.data[1:3] != b"\x64\x60" else []
    assert run.drive.poll().position_rad is None


# -- when TPDO2 is waited for ------------------------------------------------------------------------------------------


def frame(counts):
    return struct.pack("<bhi", 9, 5, counts)


def test_it_is_waited_for_in_the_cycle_in_which_it_is_due():
    slow = SlowFeedback(Slow(True, STANDARD_POSITION), 5)
    slow.begin()
    assert not slow.due                        # the time of its arrival is unknown
    slow.take(frame(7), True)
    waited = []
    for cycle in range(1, 40):
        slow.end()
        slow.begin()
        if slow.due:
            waited.append(cycle)
    assert waited == [5 * k for k in range(1, FORGOTTEN + 1)]
    assert slow.take(frame(8), False) == ModeAndDemand(9, 5)       # from the SYNC before
    for _ in range(3):
        slow.begin()
        assert not slow.due
    slow.begin()
    assert slow.due


def test_values_of_a_tpdo2_that_was_waited_for_count_from_the_next_cycle_on():
    """This is the same as without the wait, so a run repeats to the last bit."""
    slow = SlowFeedback(Slow(True, STANDARD_POSITION), 1)
    slow.begin()
    slow.take(frame(7), True)
    slow.end()
    slow.begin()
    assert slow.due
    slow.wait()
    assert slow.take(frame(8), True) is None
    assert slow.counts == 8.0
    assert slow.end() == ModeAndDemand(9, 5)
    assert slow.end() is None
    slow.begin()
    assert slow.counts is None


# -- Modbus -----------------------------------------------------------------------------------------------------------


def beside(address):
    data = {**GENERIC, "position": {**GENERIC["position"], "register": {"address": address, "type": "i32"}}}
    return ModbusProfile.model_validate(data)


def test_it_is_read_beside_the_speed_if_that_costs_no_request():
    assert texts(plan_cycle(beside(21), position=True).cycle) == ["23 writes 0+5 reads 16+7"]
    assert plan_cycle(beside(21), position=True).has_position
    for plan in (plan_cycle(beside(21)), plan_cycle(beside(22), position=True), plan_cycle(beside(52), position=True)):
        assert texts(plan.cycle) == ["23 writes 0+5 reads 16+5"]
        assert not plan.has_position


@pytest.mark.heavy
def test_on_modbus_it_comes_with_every_cycle(made, monkeypatch):
    monkeypatch.setattr(modbus_bench, "load_modbus_profile", lambda name: beside(21))
    run = made(ModbusBench)
    found = run.ready()
    assert found.position_period_s == pytest.approx(run.drive.period_s)
    assert found.position_resolution_rad == pytest.approx(2.0 * math.pi / 4096)
    run.enable()
    run.go(4.0, speed=5.0)
    machine = run.bench.simulated.machine
    pairs = []
    for _ in range(250):
        sample = run.cycle(speed=5.0)
        pairs.append((sample.position_rad, machine.inverter.state.angle_rad))
    told = [position - pairs[0][0] for position, _ in pairs]
    assert told == pytest.approx([angle - pairs[0][1] for _, angle in pairs], abs=1.01 * found.position_resolution_rad)
    assert run.drive.poll().position_rad is not None
    run.bench.simulated.serve = lambda unit, pdu, now_s: (None, now_s)
    assert run.cycle(speed=5.0).position_rad is None


def test_on_modbus_it_does_not_come_where_it_would_cost_a_request(made):
    run = made(ModbusBench)
    found = run.ready()
    assert found.position_period_s is None
    assert found.position_resolution_rad == pytest.approx(2.0 * math.pi / 4096)
    run.enable()
    run.go(1.0, speed=2.0)
    assert {sample.position_rad for sample in run.samples} == {None}
    assert run.drive.poll().position_rad == 0.0            # the first reading


# -- turns ------------------------------------------------------------------------------------------------------------


def test_turns_are_counted_both_ways():
    angle = Unwrapped(10.0, 15.0)
    assert angle.longest_gap_s == pytest.approx(10.0 / 60.0)
    told = [angle.take(0.1 * k, value) for k, value in enumerate((7.0, 9.5, 2.0, 6.0, 0.5, 8.0))]
    assert told == pytest.approx([0.0, 2.5, 5.0, 9.0, 13.5, 11.0])


def test_after_a_gap_one_reading_is_unknown_and_the_next_ones_may_lack_whole_turns():
    angle = Unwrapped(10.0, 15.0)
    assert angle.take(0.0, 1.0) == 0.0
    assert angle.take(1.0, 4.0) is None
    assert angle.take(1.1, 5.0) == pytest.approx(4.0)
    assert angle.take(1.2, math.nan) is None
    assert angle.take(1.2, 6.0) == pytest.approx(5.0)


def test_a_counter_without_a_wrap_tolerates_any_gap():
    angle = Unwrapped(None, 15.0)
    assert longest_gap_s(None, 15.0) == longest_gap_s(10.0, 0.0) == math.inf
    assert [angle.take(0.0, 3.0), angle.take(1e6, 5003.0)] == [0.0, 5000.0]
