"""Faults during a run, on the embedded simulator in stepped time and on a scripted drive in fake time."""

import contextlib
import itertools

import can
import pytest

from drivers.clock import MonotonicClock, SteppedClock
from drivers.drive import Command, Mode, PowerState
from drivers.errors import CommunicationLost, DriveFault
from tests.drivers.drive_benches import Run
from tests.drivers.on_wire import LIMITS, enabled, prepared
from tests.drivers.power_machine import ENABLED

PERIOD_S = 0.004


@pytest.fixture
def turning(bench):
    """Turn the shaft at about 2 rad/s."""
    run = Run(bench)
    run.turning(2.0, 2.0)
    return run


def first_error(run, cycles, **setpoint):
    """Return the first error and its cycle. It must not be raised again."""
    for k in range(cycles):
        try:
            run.cycle(speed=2.0)
        except (CommunicationLost, DriveFault) as error:
            for _ in range(50):
                run.cycle(speed=2.0)
            return error, k
    raise AssertionError(f"no error in {cycles} cycles")


def test_the_drives_heartbeat_is_lost(turning, bench):
    bench.bus.change = lambda message: [] if message.arbitration_id == 0x701 else [message]
    error, k = first_error(turning, 200)
    assert isinstance(error, CommunicationLost)
    assert "heartbeat" in error.what
    assert "1017h" in error.where
    assert 100 <= k * PERIOD_S / 0.004 <= 155          # 0.5 s after the last one, which is up to 0.1 s old


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize(("frame", "kind", "text"), [
    ((0x701, b"\x00"), DriveFault, "restarted"),
    ((0x081, bytes.fromhex("1023030000000000")), DriveFault, "EMCY 2310h"),
    ((0x701, b"\x7f"), CommunicationLost, "pre-operational"),
    ((0x701, b"\x04"), CommunicationLost, "stopped"),
])
def test_an_unsolicited_message_of_the_drive_is_raised_once(turning, bench, frame, kind, text):
    bench.bus.put(*frame)
    error, k = first_error(turning, 3)
    assert isinstance(error, kind)
    assert text in error.what
    assert k == 0


def test_a_third_party_puts_the_drive_into_pre_operational(turning, bench):
    """The host does not receive the command, which comes through a gateway."""
    bench.simulated.simulator.node.on_frame(0x000, bytes([0x80, 0x01]))
    with pytest.raises(CommunicationLost, match="pre-operational"):
        for _ in range(3):                                # the frames stop at once; the heartbeat shows the reason
            turning.cycle(speed=2.0)
            bench.bus.put(0x701, b"\x7f")
    assert turning.drive.counters.missed >= 1


def test_a_third_party_resets_the_drive(turning, bench):
    """It restarts and is neither operational nor enabled by the host."""
    bench.foreign(0x000, bytes([0x81, 0x01]))
    with pytest.raises(DriveFault, match="boot-up"):
        turning.cycle(speed=2.0)
    bench.bus.on_sync = lambda: None
    bench.heard()
    turning.cycle(speed=2.0)
    assert [data for identifier, data in bench.heard() if identifier == 0x000] == []
    assert bench.read(0x6041) & 0x6F in (0x40, 0x60)


def test_the_drives_own_fault_is_shown(turning, bench):
    """A short RPDO of another node causes EMCY 8210h."""
    bench.foreign(0x201, b"\x0f\x00")
    error, _ = first_error(turning, 3)
    assert "8210h" in error.what


def test_remote_frames_of_another_master_are_no_trouble(turning, bench):
    for identifier in (0x701, 0x181, 0x081):
        bench.bus.coming.append(can.Message(arbitration_id=identifier, is_remote_frame=True, is_extended_id=False))
    turning.go(0.1, speed=2.0)


def test_a_missed_tpdo(turning, bench):
    before = turning.samples[-1]
    bench.bus.change = lambda message: [] if message.arbitration_id == 0x181 else [message]
    gone = turning.cycle(speed=2.0)
    bench.bus.change = lambda message: [message]
    after = turning.cycle(speed=2.0)
    assert (before.fresh, gone.fresh, after.fresh) == (True, False, True)
    assert (gone.speed_rad_s, gone.torque_nm, gone.status) == (before.speed_rad_s, before.torque_nm, before.status)
    assert turning.drive.counters.missed == 1
    assert turning.drive.counters.cycles == len(turning.samples)
    assert after.time_s - before.time_s == pytest.approx(2 * PERIOD_S)


@pytest.mark.parametrize("way", ["send", "receive"])
def test_the_bus_fails_in_mid_cycle(turning, bench, way):
    setattr(bench.bus, f"{way}_error", can.CanOperationError("bus off"))
    with pytest.raises(CommunicationLost, match="bus off"):
        turning.cycle(speed=2.0)
    setattr(bench.bus, f"{way}_error", None)
    turning.cycle(speed=2.0)


def test_an_adapter_that_only_sends_still_gets_the_quick_stop_out(turning, bench):
    """Each cycle of the stop waits for its tick, sends, and then reports that nothing is received."""
    words, begun_s, send = [], turning.drive.clock.now_s(), bench.bus.send

    def sends(message):
        words.extend([bytes(message.data[:2])] if message.arbitration_id == 0x201 else [])
        send(message)

    bench.bus.send, bench.bus.receive_error = sends, can.CanOperationError("overrun")
    turning.drive.quick_stop()
    for _ in range(10):
        with pytest.raises(CommunicationLost, match="overrun"):
            turning.cycle(speed=0.0)
    bench.bus.receive_error = None
    assert words == [b"\x02\x00"] * 10
    assert turning.drive.clock.now_s() - begun_s == pytest.approx(10 * PERIOD_S, abs=PERIOD_S)


def test_closing_on_a_dead_bus_does_not_raise(turning, bench):
    turning.stop()
    bench.bus.send_error = bench.bus.receive_error = OSError("unplugged")
    turning.drive.close()


# -- on a scripted drive: each TPDO contains the number of its SYNC -------------------------------------------


@pytest.fixture(params=["stepped", "real time"])
def numbered(request, wire, peer, profile, fake_time):
    return enabled(wire, profile, clock=SteppedClock() if request.param == "stepped" else MonotonicClock())


@pytest.fixture
def stepped_drive(wire, peer, profile, fake_time):
    return enabled(wire, profile)


@pytest.fixture
def in_real_time(wire, peer, profile, fake_time):
    drive = enabled(wire, profile, clock=MonotonicClock())
    for _ in range(10):
        drive.exchange(Command(Mode.SPEED, 1.0, 0.0))
    return drive


def exchange(drive, count, speed=1.0):
    return [drive.exchange(Command(Mode.SPEED, speed, 0.0)) for _ in range(count)]


def numbers(samples):
    """Return the SYNC number of each sample; None without a sample."""
    return [round(sample.torque_nm) if sample.fresh else None for sample in samples]


def test_each_sample_is_of_its_own_sync(numbered):
    assert numbers(exchange(numbered, 50)) == list(range(1, 51))
    assert numbered.counters.late == numbered.counters.missed == numbered.counters.overruns == 0


def test_a_late_tpdo_is_counted_and_not_assigned_to_the_next_cycle(in_real_time, peer):
    """It arrives after the time-out of its cycle and before the next SYNC."""
    late_s = 0.9 * PERIOD_S
    peer.answer_sync = lambda cycle: [(late_s if cycle == 15 else 0.0002, peer.tpdo(cycle))]
    assert numbers(exchange(in_real_time, 10)) == [11, 12, 13, 14, None, 16, 17, 18, 19, 20]
    assert (in_real_time.counters.late, in_real_time.counters.missed) == (1, 1)


@pytest.mark.parametrize("late_s", [0.06, 0.6, 3.0])
def test_in_stepped_time_nothing_is_late(stepped_drive, peer, late_s):
    """A busy computer may take any time: the run is the same."""
    peer.answer_sync = lambda cycle: [(late_s if cycle % 5 == 0 else 0.0002, peer.tpdo(cycle))]
    assert numbers(exchange(stepped_drive, 20)) == list(range(1, 21))
    assert (stepped_drive.counters.late, stepped_drive.counters.missed) == (0, 0)


def answered_questions(wire, send, after_s):
    """A lost frame is known once the peer answers a later request (6FEh, 03h and a number)."""
    def on_send(identifier, data):
        if identifier == 0x6FE:
            assert data[:1] == b"\x03"
            wire.put(0x6FE, b"\x04" + data[1:], after_s)
        send(identifier, data)

    return on_send


@pytest.mark.parametrize("slow_s", [0.0, 0.04, 0.4, 3.0])
def test_in_stepped_time_what_is_lost_is_lost_on_any_computer(stepped_drive, peer, wire, slow_s):
    """Replies are slow, and one in five is lost. Only the replies of the peer determine the result."""
    wire.on_send = answered_questions(wire, wire.on_send, slow_s)
    peer.answer_sync = lambda cycle: [] if cycle % 5 == 0 else [(slow_s, peer.tpdo(cycle))]
    assert numbers(exchange(stepped_drive, 20)) == [None if k % 5 == 0 else k for k in range(1, 21)]
    assert stepped_drive.counters.missed == 4


def test_an_answer_to_an_older_question_ends_no_cycle(stepped_drive, peer, wire):
    """The TPDO arrives, and then the reply to a request of an earlier cycle."""
    wire.on_send = answered_questions(wire, wire.on_send, 0.3)
    peer.answer_sync = lambda cycle: [(0.2 if cycle == 5 else 0.0002 if cycle < 6 else 0.15, peer.tpdo(cycle))]
    assert numbers(exchange(stepped_drive, 10)) == list(range(1, 11))


def test_a_dead_peer_ends_a_wait_and_costs_little_from_then_on(stepped_drive, peer, wire, fake_time):
    exchange(stepped_drive, 5)
    peer.silent = True
    begun_s = fake_time.now_s
    assert numbers(exchange(stepped_drive, 1)) == [None]
    assert fake_time.now_s - begun_s == pytest.approx(4.0, abs=0.1)
    begun_s = fake_time.now_s
    for _ in range(100):
        with contextlib.suppress(CommunicationLost):      # its heartbeat is missing
            exchange(stepped_drive, 1)
    assert fake_time.now_s - begun_s < 6.0
    peer.silent = False
    assert numbers(exchange(stepped_drive, 3)) == [6, 7, 8]


def test_sync_requests_to_the_simulator_are_not_in_the_log(wire, peer, profile, fake_time):
    frames = []
    drive = prepared(wire, profile, tap=frames.append)
    wire.on_send = answered_questions(wire, wire.on_send, 0.01)
    peer.answer_sync = lambda cycle: []
    exchange(drive, 5)
    assert wire.of(0x6FE)
    assert not [frame for frame in frames if frame.identifier == 0x6FE]


def test_a_real_drive_receives_no_simulator_requests(in_real_time, peer, wire):
    peer.answer_sync = lambda cycle: []
    with contextlib.suppress(CommunicationLost):
        exchange(in_real_time, 300)
    assert wire.of(0x6FE) == []


def test_a_duplicate_is_counted_and_not_assigned_to_the_next_cycle(numbered, peer):
    def twice(cycle):
        return [(0.0002, peer.tpdo(cycle))] + [(0.0004, peer.tpdo(cycle))] * (cycle == 5)

    peer.answer_sync = twice
    samples = exchange(numbered, 5)
    peer.bus.time.sleep(0.001 if numbered.clock.stepped else 0.0)
    assert numbers(samples + exchange(numbered, 5)) == list(range(1, 11))
    assert (numbered.counters.late, numbered.counters.missed) == (1, 0)


@pytest.mark.parametrize("data", [b"", bytes(7), bytes(4)])
def test_a_tpdo_of_another_length_is_no_feedback(numbered, peer, data):
    peer.answer_sync = lambda cycle: [(0.0002, data if cycle == 5 else peer.tpdo(cycle))]
    assert numbers(exchange(numbered, 7)) == [1, 2, 3, 4, None, 6, 7]
    assert (numbered.counters.late, numbered.counters.missed) == (0, 1)


def test_invalid_frames_before_the_right_one(numbered, peer):
    peer.answer_sync = lambda cycle: [(0.0001, b"\1\2\3"), (0.0002, peer.tpdo(cycle))]
    assert numbers(exchange(numbered, 7)) == list(range(1, 8))


def test_the_last_state_stays_while_feedback_is_missing(numbered, peer):
    exchange(numbered, 10)
    assert peer.machine.state == ENABLED
    peer.answer_sync = lambda cycle: []
    sample = exchange(numbered, 1)[0]
    assert sample.state is PowerState.ENABLED
    assert not sample.fresh


def test_a_mode_frame_that_was_lost_is_repeated(numbered, peer, wire):
    exchange(numbered, 10)
    lost = [True]
    wire.on_send = lambda identifier, data: (
        None if identifier == 0x301 and lost and lost.pop() else peer.on_frame(identifier, data)
    )
    wire.sent.clear()
    for _ in range(60):
        sample = numbered.exchange(Command(Mode.TORQUE, 0.0, 0.0))
    assert sample.mode is Mode.TORQUE
    assert 2 <= len(wire.of(0x301)) <= 3


def test_age_is_from_sync_to_feedback(in_real_time, peer):
    peer.answer_sync = lambda cycle: [(0.0015, peer.tpdo(cycle))]
    for sample in exchange(in_real_time, 5):
        assert sample.age_s == pytest.approx(0.0015)


def test_real_time_keeps_the_period(in_real_time):
    times = [sample.time_s for sample in exchange(in_real_time, 100)]
    assert times[-1] - times[0] == pytest.approx(99 * PERIOD_S)


@pytest.mark.parametrize("cycles", [1, 3, 200])
def test_a_silent_drive_costs_less_than_a_cycle_each(in_real_time, peer, fake_time, cycles):
    peer.silent = True
    begin_s = fake_time.now_s
    for _ in range(cycles):
        try:
            exchange(in_real_time, 1)
        except CommunicationLost as error:
            assert "heartbeat" in error.what
    assert fake_time.now_s - begin_s <= (cycles + 1) * PERIOD_S
    assert in_real_time.counters.missed == cycles


@pytest.mark.parametrize("after", [0x77F, 0x201])
def test_frozen_between_two_frames_of_a_cycle_it_sends_no_more_of_them(in_real_time, peer, wire, fake_time, after):
    """It sends no setpoint after its heartbeat, and no SYNC after the setpoint, which would activate it."""
    exchange(in_real_time, 30)
    send, sent = wire.on_send, []

    def freeze(identifier, data):
        sent.append(identifier)
        send(identifier, data)
        if identifier == after:
            fake_time.sleep(3.0)

    wire.on_send = freeze
    with pytest.raises(CommunicationLost, match="stood still"):
        exchange(in_real_time, 60)
    assert sent[-1] == after
    wire.on_send = send
    wire.put(0x701, b"\x05")
    in_real_time.quick_stop()
    with contextlib.suppress(CommunicationLost):           # its heartbeat has been missing meanwhile
        exchange(in_real_time, 1, 0.0)
    exchange(in_real_time, 1, 0.0)
    assert peer.setpoints[-1][0] & 0x0F == 0x02


def test_the_host_heartbeat_keeps_the_watchdog_fed(in_real_time, wire, fake_time):
    beats = []
    send = wire.on_send
    wire.on_send = lambda identifier, data: (
        beats.append(fake_time.now_s) if identifier == 0x77F else None, send(identifier, data)
    )
    for _ in range(500):
        with contextlib.suppress(CommunicationLost):     # the scripted drive has no heartbeat
            exchange(in_real_time, 1)
    gaps = [later - sooner for sooner, later in itertools.pairwise(beats)]
    assert max(gaps) <= 0.5 * LIMITS.watchdog_s
    assert len(beats) >= 20


def test_feedback_as_on_the_wire(numbered, peer):
    # 6041h = 1237h enabled, 6077h = -3 ‰ of 1000 N·m, 606Ch = -30 · 0.1 rpm
    peer.answer_sync = lambda cycle: [(0.0002, bytes.fromhex("3712fdffe2ffffff"))]
    sample = exchange(numbered, 1)[-1]
    assert (sample.status, sample.state) == (0x1237, PowerState.ENABLED)
    assert sample.torque_nm == pytest.approx(-3.0)
    assert sample.speed_rad_s == pytest.approx(-0.3141592653589793)
    assert not sample.limit_active


@pytest.mark.parametrize(("status", "limited", "standstill"), [
    (0x0A37, True, False), (0x0607, False, True), (0x0207, False, False), (0x0637, False, False),
])
def test_status_bits(numbered, peer, status, limited, standstill):
    """Bit 11 is the internal limit. In quick stop active, bit 10 shows standstill."""
    peer.answer_sync = lambda cycle: [(0.0002, status.to_bytes(2, "little") + bytes(6))]
    sample = exchange(numbered, 1)[-1]
    assert (sample.limit_active, sample.standstill) == (limited, standstill)


def test_speed_zero_counts_in_profile_velocity_only(wire, peer, profile):
    """Bit 12 has another meaning in the cyclic modes."""
    for supported, standstill in ((1 << 2, True), (1 << 8, False)):
        peer.objects[0x6502, 0] = supported.to_bytes(4, "little")
        drive = prepared(wire, profile)
        peer.answer_sync = lambda cycle: [(0.0002, bytes.fromhex("37120000") + bytes(4))]
        assert exchange(drive, 12)[-1].standstill is standstill
