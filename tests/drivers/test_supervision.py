"""Unsolicited messages of the drive: heartbeat and EMCY."""

import pytest

from drivers.canopen.supervision import NodeWatch
from drivers.cia402.supervision import emcy_text
from drivers.clock import SteppedClock
from drivers.errors import CommunicationLost, DriveFault, SensorFault

OPERATIONAL = b"\x05"


@pytest.fixture
def clock():
    return SteppedClock()


@pytest.fixture
def watch(clock):
    watch = NodeWatch(5, clock)
    watch.start(0.5)
    watch.on_heartbeat(OPERATIONAL)
    return watch


def raised_by(watch):
    try:
        watch.check()
    except (CommunicationLost, DriveFault) as error:
        return error
    return None


EVENTS = [
    (lambda watch: watch.on_heartbeat(b"\x00"), DriveFault, "restarted"),
    (lambda watch: watch.on_heartbeat(b"\x7f"), CommunicationLost, "pre-operational"),
    (lambda watch: watch.on_heartbeat(b"\x04"), CommunicationLost, "stopped"),
    (lambda watch: watch.on_heartbeat(b"\xff"), CommunicationLost, "pre-operational"),      # toggle bit
    (lambda watch: watch.on_heartbeat(b"\x33"), CommunicationLost, "51"),
    (lambda watch: watch.on_emcy(bytes.fromhex("0573810000000000")), DriveFault, "EMCY 7305h, sensor"),
]


@pytest.mark.parametrize(("event", "kind", "text"), EVENTS, ids=lambda part: str(part)[:12])
def test_each_trouble_once(watch, event, kind, text):
    event(watch)
    error = raised_by(watch)
    assert isinstance(error, kind)
    assert text in error.what
    assert "node 5" in error.where
    assert error.next_step
    event(watch)
    assert raised_by(watch) is None


@pytest.mark.parametrize("event", [event for event, _, _ in EVENTS])
def test_before_the_start_and_after_the_end_nothing_is_trouble(clock, event):
    watch = NodeWatch(5, clock)
    event(watch)
    clock.wait_until(100.0)
    watch.check()
    watch.start(0.5)
    watch.check()
    watch.stop()
    event(watch)
    clock.wait_until(200.0)
    watch.check()


def test_a_drive_is_given_a_moment_to_become_operational(clock):
    """A heartbeat sent before the start still shows pre-operational. A later one shows the true state."""
    watch = NodeWatch(5, clock)
    watch.start(0.0)
    watch.on_heartbeat(b"\x7f")
    watch.check()
    clock.wait_until(5.0)
    watch.on_heartbeat(b"\x7f")
    assert isinstance(raised_by(watch), CommunicationLost)


def test_a_heartbeat_that_keeps_coming(watch, clock):
    for k in range(100):
        clock.wait_until(0.4 * k)
        watch.on_heartbeat(OPERATIONAL)
        watch.check()


def test_silence_once(watch, clock):
    clock.wait_until(0.5)
    watch.check()
    clock.wait_until(0.51)
    error = raised_by(watch)
    assert isinstance(error, CommunicationLost)
    assert "0.51 s" in error.what
    assert "1017h" in error.where
    clock.wait_until(10.0)
    assert raised_by(watch) is None


def test_without_a_heartbeat_there_is_no_timeout(clock):
    watch = NodeWatch(5, clock)
    watch.start(0.0)
    clock.wait_until(100.0)
    watch.check()


def test_the_first_trouble_comes_first(watch):
    watch.on_emcy(bytes.fromhex("1081110000000000"))
    watch.on_heartbeat(b"\x7f")
    assert "8110h" in raised_by(watch).what


def test_an_all_clear_is_no_trouble(watch):
    watch.on_emcy(bytes(8))
    watch.check()
    assert watch.emcy_code == 0


@pytest.mark.parametrize("data", [b"", b"\x05"])
def test_an_emcy_cut_short(watch, data):
    watch.on_emcy(data)
    watch.check()


def test_an_emcy_of_two_bytes_is_one(watch):
    watch.on_emcy(b"\x30\x81")
    assert "8130h" in raised_by(watch).what


def test_a_heartbeat_without_a_byte_is_ignored(watch):
    watch.on_heartbeat(b"")
    watch.check()


def test_manufacturers_bytes_are_shown(watch):
    watch.on_emcy(bytes.fromhex("11ff80aabb000000"))
    assert "aa bb 00 00 00" in raised_by(watch).what


@pytest.mark.parametrize(("code", "text"), [
    (0x8130, "communication"), (0x2310, "output side"), (0x3220, "DC link"), (0x4310, "motor temperature"),
    (0x7305, "sensor"), (0x8611, "positioning"), (0x5441, "STO"), (0x1000, "generic"), (0xFF01, "additional"),
    (0xA123, "manufacturer"), (0x2456, "current"),
])
def test_emcy_text(code, text):
    assert emcy_text(code).startswith(f"EMCY {code:04X}h, ")
    assert text in emcy_text(code)


@pytest.mark.parametrize("first", ["8084110000000000", "0573810000000000"])
def test_a_sensor_s_message_is_not_lost_beside_another_one(watch, first):
    """A drive with a broken encoder may report its following error (8480h) first, then the sensor (7305h)."""
    for data in (first, "8084110000000000", "0573810000000000"):
        watch.on_emcy(bytes.fromhex(data))
    kinds = {type(raised_by(watch)), type(raised_by(watch))}
    assert kinds == {DriveFault, SensorFault}
    assert raised_by(watch) is None
