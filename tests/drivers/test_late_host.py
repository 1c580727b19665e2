"""Late host or adapter: it is neither reported as another master nor as a silent drive.

The tests use a scripted drive in fake time. Each TPDO1 contains the number of its SYNC.
"""

from dataclasses import replace

import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.clock import LOWER_THE_RATE, MonotonicClock, SteppedClock, Ticks, how_late
from drivers.drive import Command, Mode
from drivers.errors import CommunicationLost
from tests.drivers import on_wire
from tests.drivers.on_wire import TURN, enabled
from tests.rigs import DRIVE_LIMITS

PERIOD_S = 0.004


@pytest.fixture
def drive(wire, peer, profile, fake_time):
    drive = enabled(wire, profile, DRIVE_LIMITS, MonotonicClock())
    for _ in range(10):
        drive.exchange(TURN)
    return drive


def numbers(drive, count):
    samples = [drive.exchange(TURN) for _ in range(count)]
    return [round(sample.torque_nm) if sample.fresh else None for sample in samples]


@pytest.mark.parametrize("held", [2, 5, 20, 60])
def test_an_adapter_that_hands_everything_on_at_once_is_nobody_else(drive, peer, fake_time, held):
    """Every SYNC has one reply, but several replies arrive together, as from a stalled adapter."""
    release_s = fake_time.now_s + (held + 0.5) * PERIOD_S
    peer.answer_sync = lambda cycle: [(max(0.0002, release_s - fake_time.now_s), peer.tpdo(cycle))]
    peer.bus.put(0x701, b"\x05", (held + 0.4) * PERIOD_S)
    found = numbers(drive, held + 5)
    # Each sample belongs to its own SYNC or is missing. All samples in time are present.
    assert all(one in (None, 11 + k) for k, one in enumerate(found)), found
    assert found[-4:] == [11 + held + 1 + k for k in range(4)]
    assert drive.counters.late >= held - 1


def test_a_late_loop_finds_a_reply_that_was_in_time(drive, peer, wire, fake_time):
    """A loop frozen for 30 ms after its SYNC still reads the reply, and assigns it to that SYNC."""
    send = wire.on_send

    def freeze(identifier, data):
        send(identifier, data)
        if identifier == 0x080 and peer.syncs == 13:
            fake_time.sleep(0.03)

    wire.on_send = freeze
    assert numbers(drive, 6) == [11, 12, 13, 14, 15, 16]
    assert drive.counters.missed == 0
    assert drive.counters.overruns == 1


@pytest.mark.parametrize("where", ["before the tick", "after SYNC"])
def test_a_stall_is_told_before_what_the_drive_did_meanwhile(drive, peer, wire, fake_time, where):
    """The watchdog of the drive has acted (EMCY 8130h) and its heartbeat continued. The drive is not the cause."""
    send = wire.on_send

    def asleep():
        fake_time.sleep(3.0)
        wire.put(0x081, bytes.fromhex("3081110000000000"))
        wire.put(0x701, b"\x7f")

    if where == "before the tick":
        asleep()
    else:
        def freeze(identifier, data):
            send(identifier, data)
            if identifier == 0x080:
                wire.on_send = send
                asleep()

        wire.on_send = freeze
    told = []
    for _ in range(6):
        try:
            drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
        except CommunicationLost as error:
            told.append(error)
    assert told[0].what.startswith("the control loop stood still for 3.0")
    assert told[0].where == "host"
    for error in told[1:]:
        assert error.what.startswith("this computer was late: its control loop stood still for 3.0"), error.what
        assert error.where.startswith("host")
        assert error.next_step == LOWER_THE_RATE
    assert any("8130h" in error.what for error in told)
    assert not any("has been missing" in error.what for error in told), "the heartbeat was received but not yet read"


def test_a_short_stall_is_told_before_a_heartbeat_that_is_missing(drive, peer, wire, fake_time):
    """A stall of 0.2 s is tolerated. But the message for a heartbeat that stops then names the stall too."""
    fake_time.sleep(0.2)
    with pytest.raises(CommunicationLost, match=r"still for 0\.20 s. After that: the drive's heart") as e:
        for _ in range(200):
            drive.exchange(TURN)
    assert e.value.next_step == LOWER_THE_RATE


def test_a_watchdog_that_acted_on_many_late_cycles_is_reported_with_them(drive, wire, fake_time):
    """Each delay is short, but their sum makes the watchdog of the drive expire."""
    with pytest.raises(CommunicationLost) as caught:
        for cycle in range(200):
            if cycle % 4 == 0:
                fake_time.sleep(0.02)
            if cycle == 40:
                wire.put(0x081, bytes.fromhex("3081110000000000"))
            drive.exchange(TURN)
    assert "the computer or the adapter is too slow. After that: " in caught.value.what, caught.value.what
    assert "8130h" in caught.value.what
    assert caught.value.where == "host or bus, reported by node 1"
    assert caught.value.next_step == LOWER_THE_RATE


def test_a_watchdog_that_acted_though_the_loop_was_in_time_is_the_hosts_or_the_buss(drive, wire):
    """The frames were sent. The host cannot know whether they arrived, but the drive is not the cause."""
    wire.put(0x081, bytes.fromhex("3081110000000000"))
    with pytest.raises(CommunicationLost, match=r"^host or bus, reported by node 1: the drive's watchdog has tripped"):
        for _ in range(5):
            drive.exchange(TURN)


def test_a_heartbeat_that_is_missing_is_the_drives_where_the_loop_was_in_time(drive):
    with pytest.raises(CommunicationLost, match=r"node 1, 1017h: the drive's heartbeat") as caught:
        for _ in range(200):
            drive.exchange(TURN)
    assert "supply" in caught.value.next_step
    assert drive.host_late() == ""


@pytest.mark.parametrize(("away_s", "refused"), [(0.2, False), (0.3, True), (0.5, True), (2.4, True)])
def test_half_of_the_watchdogs_time_is_the_longest_stall(drive, wire, fake_time, away_s, refused):
    """After a longer stall the watchdog may have acted. An older setpoint must not be sent then."""
    wire.put(0x701, b"\x05", away_s)
    fake_time.sleep(away_s)
    wire.sent.clear()
    if refused:
        with pytest.raises(CommunicationLost, match="stood still"):
            drive.exchange(TURN)
        assert wire.sent == []
    else:
        assert drive.exchange(TURN).fresh


def test_the_lateness_is_reported_in_numbers(drive, peer, wire, fake_time):
    for _ in range(20):
        wire.put(0x701, b"\x05")
        fake_time.sleep(0.01)
        drive.exchange(TURN)
    assert drive.host_late() == (
        "20 of the last 30 cycles were late (99 % of all by at most 8.2 ms): the computer or the adapter is too slow")


def test_late_answers_count_as_late_too(drive, peer, wire):
    peer.answer_sync = lambda cycle: [(1.5 * PERIOD_S, peer.tpdo(cycle))]
    numbers(drive, 60)
    assert drive.host_late().startswith("5")


def test_words_for_lateness():
    assert how_late([], PERIOD_S) == ""
    assert how_late([0.0001] * 1000, PERIOD_S) == ""
    assert how_late([0.0] * 985 + [0.01] * 15, PERIOD_S) == ""
    assert how_late([0.0] * 950 + [0.038] * 50, PERIOD_S) == (
        "50 of the last 1000 cycles were late (99 % of all by at most 38 ms): the computer or the adapter is too slow")


def test_a_stall_is_remembered_for_some_time(fake_time):
    clock = MonotonicClock()
    ticks = Ticks(clock, PERIOD_S, 0.25)
    fake_time.sleep(0.2)
    ticks.wait()
    assert ticks.stood_still_s(1.0) == pytest.approx(0.2, abs=PERIOD_S)
    fake_time.sleep(0.04)
    ticks.wait()
    assert ticks.stood_still_s(0.01) == 0.0
    assert ticks.stood_still_s(1.0) == pytest.approx(0.2, abs=PERIOD_S)
    fake_time.sleep(5.0)
    assert ticks.stood_still_s(1.0) == 0.0


def test_a_stall_is_reported_once_and_the_cycles_continue_from_there(fake_time):
    """The host stops the shaft after a stall. The stop must not be refused because of the same stall."""
    ticks = Ticks(MonotonicClock(), PERIOD_S, 0.25)
    ticks.wait()
    fake_time.sleep(3.0)
    with pytest.raises(CommunicationLost, match=r"still for 3\.00 s"):
        ticks.check()
    ticks.check()
    ticks.check_end()
    back_s = fake_time.now_s
    ticks.wait()
    assert fake_time.now_s == pytest.approx(back_s + PERIOD_S)
    assert ticks.overruns == 0


def test_a_long_exchange_is_no_stall(fake_time):
    """A wait for a reply beyond the next tick is reported by its own error, if at all."""
    ticks = Ticks(MonotonicClock(), PERIOD_S, 0.25)
    ticks.wait()
    fake_time.sleep(1.0)
    ticks.done()
    ticks.wait()
    assert ticks.stood_still_s(10.0) == 0.0


def test_time_of_an_sdo_is_no_lateness(fake_time):
    """An SDO beside the cycle may take some time. It is no missed tick."""
    ticks = Ticks(MonotonicClock(), PERIOD_S, 0.25)
    ticks.wait()
    fake_time.sleep(0.1)
    ticks.put_off()
    ticks.wait()
    assert ticks.overruns == 0
    assert ticks.late_s[-1] == 0.0


# -- another rate ---------------------------------------------------------------------------------------------------


@pytest.fixture
def prepared(wire, peer, profile, fake_time):
    peer.objects[0x1006, 0] = bytes(4)
    return on_wire.prepared(wire, profile, DRIVE_LIMITS, MonotonicClock())


def test_another_rate_is_written_before_anything_is_enabled(prepared, peer, wire, fake_time):
    assert prepared.rates_hz == (250.0, 200.0, 125.0, 100.0, 50.0, 25.0, 20.0)
    numbers(prepared, 5)
    prepared.set_rate(50.0, measuring=True)
    assert peer.value(0x1006) == 20_000
    assert prepared.period_s == 0.02
    assert peer.operational
    wire.sent.clear()
    begun_s, counted = fake_time.now_s, peer.syncs
    samples = [prepared.exchange(Command(Mode.SPEED, 0.0, 0.0)) for _ in range(20)]
    assert all(sample.fresh for sample in samples)
    assert peer.syncs == counted + 20
    assert fake_time.now_s - begun_s == pytest.approx(20 * 0.02, abs=0.02)
    assert len(wire.of(0x77F)) >= 3                       # feeding of the watchdog continues
    assert (prepared.counters.cycles, prepared.counters.missed) == (20, 0)


def test_standing_still_is_no_error_while_a_rate_is_tried_and_one_afterwards(prepared, wire, fake_time):
    for measuring in (True, False):
        prepared.set_rate(100.0, measuring=measuring)
        prepared.exchange(TURN)
        wire.put(0x701, b"\x05", 0.3)
        fake_time.sleep(0.3)
        if measuring:
            prepared.exchange(TURN)
            assert prepared.began_late_s == pytest.approx(0.3, abs=0.01)
        else:
            with pytest.raises(CommunicationLost, match="stood still"):
                prepared.exchange(TURN)


def test_a_short_watchdog_leaves_no_slow_rate(wire, peer, profile, fake_time):
    drive = on_wire.prepared(wire, profile, replace(DRIVE_LIMITS, watchdog_s=0.06), MonotonicClock())
    assert drive.rates_hz == (250.0, 200.0, 125.0, 100.0)


def test_a_named_rate_and_stepped_time_leave_no_choice(wire, peer, profile, fake_time):
    assert CanopenDrive(wire, profile, MonotonicClock(), node=1, rate_hz=250.0).rates_hz == ()
    assert CanopenDrive(wire, profile, SteppedClock(), node=1).rates_hz == ()


# -- a stall and bus-off afterwards ------------------------------------------------------------------------------------


@pytest.mark.parametrize("behind_s", [0.0, 0.001, 0.5])
def test_a_long_stall_and_a_bus_that_is_off_afterwards(drive, peer, wire, fake_time, behind_s):
    """After a stall of 25 s the adapter is bus-off. The stall is reported first, and no more frames are sent."""
    peer.silent = True
    fake_time.now_s += 25.0
    wire.put(0x040, bytes(8), behind_s, is_error_frame=True)
    wire.sent.clear()
    told = []
    for _ in range(200):
        try:
            drive.exchange(TURN)
        except CommunicationLost as error:
            told.append(error.what)
            drive.quick_stop()
    assert "stood still for 25" in told[0]
    assert any("bus-off" in text for text in told)
    assert [data for data in wire.of(0x201) if data[0] & 0x0F == 0x0F] == [], "an enabling word after a stall"
    wire.sent.clear()
    with pytest.raises(CommunicationLost, match="bus-off: transmission has ended"):
        drive.poll()
    assert wire.sent == []
