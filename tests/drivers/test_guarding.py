"""Node guarding: the toggle alone, then a guarded drive with a silent host or with false replies."""

from itertools import pairwise

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.supervision import Guarding, NodeWatch
from drivers.clock import SteppedClock
from drivers.drive import Mode, PowerState
from drivers.errors import CommunicationLost, DriveFault
from tests.drivers.drive_benches import Run
from tests.drivers.profile_benches import S120Bench

ANSWER = 0x701


class Guarded:
    """Guarding without a bus, with a count of the requests."""

    def __init__(self):
        self.clock = SteppedClock()
        self.watch = NodeWatch(1, self.clock)
        self.asked = 0
        self.guarding = Guarding(self.watch, self.ask)
        self.watch.start(0.5)

    def ask(self):
        self.asked += 1

    def wait(self, duration_s):
        self.clock.wait_until(self.clock.now_s() + duration_s)


def test_answers_that_toggle_are_signs_of_life():
    one = Guarded()
    for number in range(20):
        one.guarding.feed()
        one.guarding.on_frame(bytes([0x85 if number % 2 else 0x05]))
        one.wait(0.4)
        one.watch.check()
    assert (one.asked, one.guarding.answers, one.guarding.repeated) == (20, 20, 0)


@given(st.lists(st.sampled_from([0x05, 0x85]), max_size=30))
def test_an_answer_counts_where_its_toggle_is_new(answers):
    one = Guarded()
    for byte in answers:
        one.guarding.on_frame(bytes([byte]))
    changes = sum(1 for before, now in zip([None, *answers], answers, strict=False) if before != now)
    assert one.guarding.answers == changes


def test_replies_that_do_not_toggle_do_not_count():
    one = Guarded()
    for _ in range(4):
        one.guarding.on_frame(b"\x05")
        one.wait(0.2)
    with pytest.raises(CommunicationLost, match=r"not toggled \(3 alike\)") as caught:
        one.watch.check()
    assert "100Ch" in caught.value.where


def test_no_answers():
    one = Guarded()
    one.guarding.on_frame(b"\x05")
    one.wait(0.6)
    with pytest.raises(CommunicationLost, match="answers to node guarding have been missing"):
        one.watch.check()


@pytest.mark.parametrize(("byte", "kind", "text"), [
    (0x84, CommunicationLost, "stopped"), (0xFF, CommunicationLost, "pre-operational"), (0x00, DriveFault, "restarted"),
])
def test_the_state_in_a_reply_is_checked(byte, kind, text):
    one = Guarded()
    one.guarding.on_frame(b"\x05")
    one.guarding.on_frame(bytes([byte]))
    with pytest.raises(kind, match=text):
        one.watch.check()


def test_an_empty_frame_is_no_reply():
    one = Guarded()
    one.guarding.on_frame(b"")
    assert one.guarding.answers == 0


# -- a drive ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def run(open_bench):
    return Run(open_bench(S120Bench))


def row(found, title):
    return next(check for check in found.checks if check.name == title)


def test_the_drive_is_guarded_often_enough_and_replies(run):
    found = run.ready()
    assert row(found, "watchdog").found == "125 ms x 4, answered"
    assert found.safe_action == "quick_stop"
    run.enable()
    begin = len(run.bench.frames)
    run.go(10.0, speed=3.0)
    frames = run.bench.frames[begin:]
    asked = [frame.time_s for frame in frames if frame.outgoing and frame.identifier & 0x7FF == ANSWER]
    answers = [frame.data[0] for frame in frames if not frame.outgoing and frame.identifier == ANSWER]
    assert 88 <= len(asked) <= 101                          # every 100 ms, at whole cycles of 10 ms
    assert max(later - sooner for sooner, later in pairwise(asked)) <= 0.125
    assert len(answers) == len(asked)
    assert all(a ^ b == 0x80 and a & 0x7F == 0x05 for a, b in pairwise(answers))
    assert not [frame for frame in frames if frame.identifier == 0x77F], "the host also sends a heartbeat"


def test_a_silent_host_is_noticed_by_the_drive_and_the_shaft_stops(run):
    run.turning(5.0)
    speeds = []
    for _ in range(700):                                   # foreign SYNCs advance the time by 10 ms each
        run.bench.foreign(0x080, b"")
        run.bench.heard()
        run.bench.read(0x1000)
        speeds.append(run.bench.true_speed_rad_s)
    assert speeds[38] > 4.9                                # 125 ms x 4 after the last request
    late = next(number for number, speed in enumerate(speeds) if speed < 4.9)
    assert 0.01 * late <= 0.5 + 0.25
    still = next(number for number, speed in enumerate(speeds) if abs(speed) < 0.05)
    assert 0.01 * still <= 0.5 + 5.0 / run.bench.limits.quick_stop_rad_s2 + 0.5
    assert max(map(abs, speeds[still + 50:])) < 0.1
    for _ in range(2):                                     # a foreign SYNC and the drive's reply
        with pytest.raises((CommunicationLost, DriveFault)):
            run.go(1.0, speed=5.0)
    assert run.go(0.5, speed=5.0).state is PowerState.OFF   # and it is not enabled again without a request
    assert abs(run.bench.true_speed_rad_s) < 0.1


def changed(message, data):
    return can.Message(arbitration_id=message.arbitration_id, data=data, is_extended_id=False)


@pytest.mark.parametrize(("change", "text"), [
    (lambda message: [changed(message, b"\x05")], "not toggled"),
    (lambda message: [], "have been missing"),
    (lambda message: [changed(message, bytes([message.data[0] & 0x80 | 0x04]))], "stopped"),
])
def test_false_replies_are_found_within_the_life_time(run, change, text):
    run.turning(2.0)
    run.bench.bus.change = lambda message: change(message) if message.arbitration_id == ANSWER else [message]
    begin_s = run.drive.clock.now_s()
    with pytest.raises(CommunicationLost, match=text):
        run.go(2.0, speed=2.0)
    assert run.drive.clock.now_s() - begin_s <= 0.8
    run.go(0.5, speed=2.0)                                  # once only, so that a stop continues


def test_where_remote_frames_do_not_get_through_it_is_refused(run):
    run.bench.bus.change = lambda message: [] if message.arbitration_id == ANSWER else [message]
    run.drive.connect()
    check = row(run.drive.preflight(run.bench.limits), "watchdog")
    assert "no answer to the remote frame" in check.found
    assert "socketcand" in check.next_step
    assert check.where == "node guarding"


def test_a_drive_without_life_guarding_is_refused(run):
    run.bench.simulated.simulator.node.store.remove(0x100D)
    run.drive.connect()
    found = run.drive.preflight(run.bench.limits)
    assert [check.name for check in found.refused] == ["watchdog"]
    assert "if the host fails" in found.refused[0].next_step
    assert found.refused[0].where == "100Dh"


def test_the_drives_own_heartbeat_is_switched_off(run):
    """A node that produces a heartbeat does not reply to guarding requests (CiA 301)."""
    run.bench.simulated.simulator.node.store.write(0x101700, 100)
    found = run.ready()
    assert row(found, "drive's heartbeat").found == "0 ms"
    run.enable(Mode.SPEED)
    run.drive.quick_stop()
    run.until(run.rests, 5.0)
    run.drive.disable()
    run.go(0.1)
    assert run.drive.close() == ()
    assert run.bench.read(0x1017) == 100
