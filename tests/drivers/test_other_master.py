"""Actions of another node, master or tool, on the scripted drive: reported, refused, or raised."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.canopen.other_master import ForeignTraffic
from drivers.clock import MonotonicClock, SteppedClock
from drivers.drive import Command, Mode
from drivers.errors import CommunicationLost, PreflightRefused
from drivers.preflight import PreflightTable
from tests.drivers.on_wire import LIMITS, enabled, prepared
from tests.drivers.scripted_drive import u


@pytest.fixture
def make(wire, peer, profile):
    def make(clock=None, **options):
        return CanopenDrive(wire, profile, clock or SteppedClock(), node=1, **options)

    return make


def ready(drive):
    drive.connect()
    found = drive.preflight(LIMITS)
    assert found.refused == ()
    return found


def go(drive, wire, seconds, mode=Mode.SPEED, speed=0.0, torque=0.0):
    for _ in range(round(seconds / drive.period_s)):
        wire.put(0x701, b"\x05")
        sample = drive.exchange(Command(mode, speed, torque))
    return sample


def beats(wire, number, every_s, until_s, begin_s=0.0):
    for k in range(int((until_s - begin_s) / every_s) + 1):
        wire.put(0x700 + number, b"\x05", begin_s + k * every_s)


# -- the host's number -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("every_s", [0.1, 1.0, 2.5])
def test_a_number_that_another_node_bears_is_not_taken(make, wire, peer, every_s):
    """Its heartbeat may take up to three seconds. The next node number is in use too."""
    beats(wire, 127, every_s, 60.0, begin_s=0.4)
    beats(wire, 126, 1.0, 60.0)
    found = ready(make(MonotonicClock()))
    assert peer.value(0x1016, 1) == 0x007D0190
    assert wire.of(0x77D)
    assert not wire.of(0x77F)
    (row,) = [check for check in found.checks if check.name == "host's node number"]
    assert "125" in row.found
    assert "127" in row.found


def test_the_number_of_the_drive_itself_is_not_taken():
    """Some drives have node number 127 as delivered. With it, the drive would supervise itself."""
    link = SimpleNamespace(handlers={}, remote_handlers={}, drain=lambda: None)
    table = PreflightTable()
    traffic = ForeignTraffic(link, None, SteppedClock(), node=127, number=127)
    assert traffic.settle_number(table) == traffic.number == 126
    assert "the drive itself has 127" in table.checks[0].found


def test_the_host_listens_to_the_bus_for_three_seconds(make, wire, peer, fake_time):
    begun_s = fake_time.now_s
    ready(make(MonotonicClock()))
    assert fake_time.now_s - begun_s >= 3.0
    assert peer.value(0x1016, 1) >> 16 == 127


def test_no_free_number(make, wire, peer):
    for number in range(2, 128):
        wire.put(0x700 + number, b"\x05", 0.5)
    drive = make(MonotonicClock())
    drive.connect()
    with pytest.raises(PreflightRefused, match="none is free"):
        drive.preflight(LIMITS)


def test_one_that_comes_before_motion_is_refused(make, wire):
    drive = make()
    ready(drive)
    go(drive, wire, 0.5)
    wire.put(0x77F, b"\x05")
    go(drive, wire, 0.1)
    with pytest.raises(PreflightRefused, match="uses this host's number 127"):
        drive.enable(Mode.SPEED)


def test_one_that_comes_in_motion_ends_the_run_with_its_second_beat(make, wire):
    drive = make()
    ready(drive)
    drive.enable(Mode.SPEED)
    wire.put(0x77F, b"\x05")
    go(drive, wire, 5.0)
    assert any("77Fh" in line for line in drive.remarks())
    assert drive.remarks() == ()
    wire.put(0x77F, b"\x05")
    with pytest.raises(CommunicationLost, match=r"77Fh.*would feed the drive's watchdog if this host fails"):
        go(drive, wire, 0.1)


def test_heartbeats_of_other_nodes_are_ignored(make, wire):
    drive = make()
    ready(drive)
    drive.enable(Mode.SPEED)
    for _ in range(20):
        wire.put(0x70A, b"\x05")
        go(drive, wire, 0.2)
    assert drive.remarks() == ()


# -- read back in motion -----------------------------------------------------------------------------------------


@pytest.fixture
def running(make, wire, peer):
    drive = make()
    ready(drive)
    drive.enable(Mode.SPEED)
    go(drive, wire, 3.0)
    return drive


WATCHED = [(0x1016, 1, 0, 4), (0x6007, 0, 0, 2), (0x605A, 0, 0, 2), (0x6072, 0, 900, 2), (0x6080, 0, 3000, 4),
           (0x6085, 0, 1, 4)]


@pytest.mark.parametrize(("index", "sub", "value", "size"), WATCHED, ids=[f"{row[0]:04X}h" for row in WATCHED])
def test_a_setting_that_somebody_changes_in_motion_ends_the_run(running, wire, peer, index, sub, value, size):
    before = int.from_bytes(peer.objects[index, sub], "little")
    peer.objects[index, sub] = u(value, size)
    with pytest.raises(CommunicationLost) as caught:
        go(running, wire, 20.0)
    assert f"{index:04X}h" in caught.value.where
    assert f"{before}" in caught.value.what
    assert f"{value}" in caught.value.what
    assert "another master" in caught.value.what


def test_a_quick_stop_option_that_the_profile_does_not_set_is_read_back_and_restored_too(wire, peer, profile):
    stop = profile.quick_stop.model_copy(update={"option_code": None})
    drive = enabled(wire, profile.model_copy(update={"quick_stop": stop}))
    go(drive, wire, 3.0)
    assert not [entry for entry in peer.writes if entry[0] == 0x605A]
    peer.objects[0x605A, 0] = u(0, 2)
    with pytest.raises(CommunicationLost, match="the quick-stop option was changed"):
        go(drive, wire, 20.0)
    drive.quick_stop()
    assert peer.value(0x605A) == 2


def test_the_watchdog_and_the_objects_of_the_stop_are_read_every_other_second(running, wire):
    wire.sent.clear()
    go(running, wire, 20.0)
    asked = [data[1:4].hex() for data in wire.of(0x601)]
    assert 39 <= len(asked) <= 41
    assert sum(asked.count(one) for one in ("161001", "076000", "5a6000")) >= 13
    assert sum(one[2:4] not in ("18", "1a") for one in asked) >= 26
    assert {data[0] for data in wire.of(0x601)} == {0x40}         # reads without a wait


def test_an_object_that_a_tool_writes_is_read_back_next(running, wire, peer):
    peer.objects[0x6085, 0] = u(1, 4)
    wire.put(0x601, bytes.fromhex("2385600001000000"))
    with pytest.raises(CommunicationLost, match="191"):
        go(running, wire, 0.1)
    assert any("6085h = 1h" in line for line in running.remarks())


def test_a_value_that_differs_once_is_read_again(running, wire, peer):
    good = peer.objects[0x6072, 0]
    asked = []

    def lie_once(request):
        if request[:4] == bytes.fromhex("40726000"):
            asked.append(request)
            peer.objects[0x6072, 0] = b"\x07\x00" if len(asked) == 1 else good

    peer.before_answer = lie_once
    go(running, wire, 20.0)
    assert len(asked) >= 2


@pytest.mark.heavy
def test_a_drive_that_never_replies_to_sdo_runs_on_with_a_report(make, wire, peer):
    drive = make()
    ready(drive)
    wire.on_send = lambda identifier, data: None if identifier == 0x601 else peer.on_frame(identifier, data)
    drive.enable(Mode.SPEED)
    go(drive, wire, 30.0)
    (line,) = drive.remarks()
    assert "were not read back" in line


def test_a_drive_that_stops_replying_for_good_is_lost(running, wire, peer):
    wire.on_send = lambda identifier, data: None if identifier == 0x601 else peer.on_frame(identifier, data)
    go(running, wire, 5.0)
    with pytest.raises(CommunicationLost, match="in a row"):
        go(running, wire, 30.0)


@pytest.mark.heavy
def test_one_that_refuses_an_object_in_motion_is_not_asked_for_it_any_more(running, wire, peer):
    peer.refuse_read[0x6080, 0] = 0x08000022
    peer.feedback = lambda cycle: (0, 0)
    go(running, wire, 200.0)
    wire.sent.clear()
    go(running, wire, 40.0)
    assert "806000" not in {data[1:4].hex() for data in wire.of(0x601)}
    assert any("6080h" in line for line in running.remarks())


# -- setpoints -----------------------------------------------------------------------------------------------------


def echo(peer):
    """Make the drive show the last setpoint in 60FFh."""

    def before(request):
        _, _, speed = peer.setpoints[-1]
        peer.objects[0x60FF, 0] = u(speed, 4)

    peer.before_answer = before


@pytest.mark.heavy
def test_a_speed_in_the_drive_that_is_not_ours_ends_the_run(running, wire, peer):
    echo(peer)
    go(running, wire, 15.0, speed=1.0)
    peer.before_answer = lambda request: peer.objects.__setitem__((0x60FF, 0), u(500, 4))
    with pytest.raises(CommunicationLost, match="target velocity is not what this host sent: 500"):
        go(running, wire, 20.0, speed=1.0)


@pytest.mark.heavy
def test_a_drive_that_does_not_show_its_setpoint_is_not_judged_by_it(running, wire, peer):
    peer.objects[0x60FF, 0] = u(77, 4)
    go(running, wire, 30.0, speed=1.0)


def test_a_setpoint_that_changes_in_every_cycle_is_not_foreign(running, wire, peer):
    echo(peer)
    for k in range(5000):
        go(running, wire, running.period_s, speed=1.0 + 0.01 * (k % 97))


@pytest.mark.parametrize("identifier", [0x201, 0x301, 0x401, 0x501])
def test_the_second_foreign_setpoint_ends_the_run(running, wire, identifier):
    wire.put(identifier, bytes(8))
    go(running, wire, 2.0)
    assert any(f"{identifier:03X}h" in line for line in running.remarks())
    wire.put(identifier, bytes(8))
    with pytest.raises(CommunicationLost, match="second master"):
        go(running, wire, 0.1)


def test_two_foreign_writes_are_reported_and_a_third_shows_another_master(running, wire):
    wire.put(0x601, bytes.fromhex("2b40600006000000"))
    go(running, wire, 1.0)
    wire.put(0x601, bytes.fromhex("2f60600004000000"))
    go(running, wire, 1.0)
    assert running.remarks() == (
        "another master wrote 6040h = 6h by SDO", "another master wrote 6060h = 4h by SDO",
    )
    assert [line[:13] for line in running.summary()] == ["6040h = 6h wa", "6060h = 4h wa"]
    wire.put(0x601, bytes.fromhex("2b40600006000000"))
    with pytest.raises(CommunicationLost, match="writes setpoints by SDO"):
        go(running, wire, 0.1)


def test_a_tool_that_only_reads_is_no_trouble(running, wire):
    for _ in range(20):
        wire.put(0x601, bytes.fromhex("4041600000000000"))
        go(running, wire, 0.1)
    assert running.remarks() == running.summary() == ()


# -- RPDOs of others --------------------------------------------------------------------------------------------


def more_rpdos(peer, **identifiers):
    for number, cob_id in identifiers.items():
        peer.objects[0x1400 + int(number[1:]) - 1, 1] = u(cob_id, 4)


def test_other_rpdos_are_switched_off_and_given_back(make, peer):
    more_rpdos(peer, n3=0x401, n4=0x8000_0501, n8=0x123, n9=0x40000124, n10=0x8000_0001)
    drive = make()
    found = ready(drive)
    assert [peer.value(0x1400 + n - 1, 1) for n in (3, 4, 8, 9)] == [0x80000401, 0x80000501, 0x80000123, 0xC0000124]
    (row,) = [check for check in found.checks if check.name == "other RPDOs"]
    for text in ("RPDO3 (401h)", "RPDO8 (123h)", "RPDO9 (124h)"):
        assert text in row.found
    for _ in range(5):
        drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    drive.close()
    assert [peer.value(0x1400 + n - 1, 1) for n in (3, 4, 8, 9)] == [0x401, 0x80000501, 0x123, 0x40000124]


def test_an_rpdo_that_stays_enabled_is_refused(make, peer):
    more_rpdos(peer, n3=0x401)
    peer.deaf_to.add((0x1402, 1))
    drive = make()
    drive.connect()
    (row,) = drive.preflight(LIMITS).refused
    assert (row.name, row.where) == ("other RPDOs", "1402h:1")
    assert "stays on" in row.found


def test_its_frames_are_found_by_their_identifier(make, wire, peer):
    more_rpdos(peer, n5=0x123)
    drive = make()
    ready(drive)
    drive.enable(Mode.SPEED)
    for _ in range(2):
        wire.put(0x123, bytes(8))
    with pytest.raises(CommunicationLost, match=r"setpoints \(RPDO5, 123h\)"):
        go(drive, wire, 0.1)


# -- the mode ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [4.0, 50.0, 250.0])
def test_a_mode_that_was_lost_shows_within_a_tenth_of_a_second_or_a_cycle(wire, peer, profile, rate_hz):
    prepared(wire, profile, replace(LIMITS, watchdog_s=3.0), rate_hz=rate_hz)
    syncs = peer.value(0x1801, 2)
    assert 1 <= syncs <= 5
    assert syncs / rate_hz <= max(0.1, 1.0 / rate_hz) + 1e-9


def test_a_mode_that_is_not_displayed_any_more_is_not_known(running, wire, peer):
    assert go(running, wire, 0.1).mode is Mode.SPEED
    plain = wire.put
    wire.put = lambda identifier, *rest, **flags: None if identifier == 0x281 else plain(identifier, *rest, **flags)
    assert go(running, wire, 0.3).mode is Mode.SPEED
    assert go(running, wire, 0.4).mode is None


# -- the host's sign of life -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("watchdog_s", [0.1, 0.2, 0.4, 2.0])
def test_a_short_watchdog_is_fed_five_times_in_its_time(wire, peer, profile, fake_time, watchdog_s):
    drive = prepared(wire, profile, replace(LIMITS, watchdog_s=watchdog_s), MonotonicClock())
    sent, plain = [], wire.on_send
    wire.on_send = lambda identifier, data: (
        sent.append(fake_time.now_s) if identifier == 0x77F else None, plain(identifier, data)
    )
    go(drive, wire, 3.0)
    gaps = [later - sooner for sooner, later in itertools.pairwise(sent)]
    assert max(gaps) <= min(0.1, watchdog_s / 5.0) + 2 * drive.period_s


def test_after_stop_feeding_no_frame_feeds_the_watchdog(running, wire):
    running.quick_stop()
    go(running, wire, 0.2)
    running.stop_feeding()
    running.stop_feeding()
    wire.sent.clear()
    sample = go(running, wire, 2.0)
    assert sample.fresh                            # in stepped time SYNC and feedback continue
    assert {identifier for identifier, _ in wire.sent} == {0x080}
    running.poll()
    assert not wire.of(0x77F)


def test_in_real_time_not_even_the_sync_is_sent(make, wire, peer):
    drive = make(MonotonicClock())
    ready(drive)
    drive.enable(Mode.SPEED)
    go(drive, wire, 0.5)
    drive.quick_stop()
    drive.stop_feeding()
    wire.sent.clear()
    assert not go(drive, wire, 0.5).fresh
    assert wire.sent == []
    peer.objects |= {(0x606C, 0): bytes(4), (0x6077, 0): bytes(2)}
    assert drive.poll() is not None
    assert {identifier for identifier, _ in wire.sent} == {0x601}


# -- a quick stop that is reversed -----------------------------------------------------------------------------------


def undo(wire, peer):
    """Let another master reverse the quick stop after each frame of the host, through RPDO1."""
    def before_sync(identifier, data):
        if identifier == 0x080 and not peer.value(0x1400, 1) >> 31:
            peer.on_frame(0x201, bytes.fromhex("0f00") + bytes(6))
        if peer.value(0x1400, 1) >> 31:            # a disabled RPDO has no effect
            peer._latched = (peer.machine.word, 0, 0)
            if identifier == 0x201:
                return
        peer.on_frame(identifier, data)

    wire.on_send = before_sync


def test_a_quick_stop_that_is_reversed_is_enforced(running, wire, peer):
    undo(wire, peer)
    running.quick_stop()
    go(running, wire, 1.0)
    assert peer.machine.state == "quick stop active"
    assert peer.value(0x1400, 1) >> 31
    assert peer.value(0x1401, 1) >> 31
    assert any("reversed or not executed" in line for line in running.remarks())
    running.disable()
    go(running, wire, 0.5)
    assert peer.machine.state == "switch on disabled"
    running.close()
    assert peer.value(0x1400, 1) == 0x80000201        # as found


def test_a_quick_stop_that_is_kept_changes_no_rpdo(running, wire, peer):
    running.quick_stop()
    go(running, wire, 2.0)
    assert not peer.value(0x1400, 1) >> 31
    assert running.remarks() == ()
