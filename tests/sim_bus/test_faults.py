"""Scripted faults: syntax, begin and end, and behaviour of the drive on its bus."""

from itertools import pairwise

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from profiles.simulator_marker import CYCLE_ANSWER, CYCLE_ASKED, CYCLE_ID, CYCLE_OVER, CYCLES_END, STAGE_NUMBERS
from sim_bus.canopen.faults import KINDS, make, parse_all
from sim_bus.canopen.simulator import EmbeddedSimulator
from sim_bus.command import main
from sim_bus.fault_script import FaultRefused, Moment, Schedule, Scripted, parse

TIMES = st.integers(0, 99_999).map(lambda ms: f"{ms}ms")


@given(st.sampled_from(sorted(KINDS)), st.sampled_from(["", *STAGE_NUMBERS]), TIMES, st.none() | TIMES)
def test_a_written_script_is_read(name, stage, after, duration):
    text = f"{name}@{stage + '+' if stage else ''}{after}" + (f"/{duration}" if duration else "")
    fault = parse(text)
    assert (fault.name, fault.at.stage, fault.text) == (name, STAGE_NUMBERS.get(stage, 0), text)
    assert fault.at.after_s == pytest.approx(float(after[:-2]) / 1000.0)
    assert fault.duration_s == (pytest.approx(float(duration[:-2]) / 1000.0) if duration else float("inf"))


def test_the_parts_may_be_left_out():
    assert parse("sto") == Scripted("sto", Moment(), text="sto")
    assert parse("sto@hold") == Scripted("sto", Moment(4, 0.0), text="sto@hold")
    fault = parse("frame-loss@acquire+5s=5%/2.5s")
    assert (fault.at, fault.value, fault.duration_s) == (Moment(5, 5.0), "5%", 2.5)


@pytest.mark.parametrize(("text", "said"), [
    ("", "is no fault"), ("STO", "is no fault"), ("sto@", "is no fault"), ("sto@hold+2", "no moment"),
    ("sto@landing+2s", "no moment"), ("sto@-2s", "no moment"),
    ("nothing-such", "no fault is called 'nothing-such'. --fault list shows them"),
    ("heartbeat-loss@hold", "no fault is called 'heartbeat-loss'. Did you mean 'heartbeat-lost'? --fault list shows"),
    ("sto=5", "takes no value"), ("frame-loss=200%", "0% to 100%"), ("frame-loss=x", "SHARE"),
    ("emcy=12345", "four hexadecimal"), ("sdo-abort=6072h:999", "an object"), ("torque-scale=0", "0.01 to 100"),
    ("torque-scale=1.1@setup", "Write torque-scale@setup=1.1"), ("torque-scale=much", "'much' is not a number"),
])
def test_what_is_refused(text, said):
    with pytest.raises(FaultRefused) as caught:
        parse_all([text])
    assert said in str(caught.value)
    assert caught.value.where.startswith("--fault")
    assert caught.value.next_step
    assert caught.value.exit_code == 2


@given(st.text(max_size=40))
def test_no_text_does_worse_than_be_refused(text):
    try:
        parse_all([text])
    except FaultRefused as error:
        assert str(error)


@pytest.mark.parametrize("name", sorted(KINDS))
def test_every_kind_can_be_made_with_its_default(name):
    assert make(Scripted(name)) is not None
    assert 0 <= KINDS[name].row < 200
    assert bool(KINDS[name].takes) is bool(KINDS[name].value)


STEPS = st.lists(st.integers(1, 3_000_000), min_size=1, max_size=30)
FAULTS = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 20), st.integers(1, 20) | st.none()), max_size=5)


@given(FAULTS, STEPS, st.integers(0, 20), st.integers(0, 20))
def test_each_begins_once_and_ends_once_and_never_early(faults, steps, first, second):
    script = tuple(
        Scripted("sto", Moment(stage, float(after)), duration_s=float("inf") if lasts is None else float(lasts))
        for stage, after, lasts in faults
    )
    schedule, now_us = Schedule(script), 0
    began, ended, stages = {}, {}, {0: 0}
    for count, step_us in enumerate([0, *steps]):
        now_us += step_us
        for number, at_count in ((1, first), (2, second)):
            if count == at_count:
                schedule.stage(number, now_us)
                stages.setdefault(number, now_us)
        begin, end = schedule.due(now_us)
        for number in begin:
            assert number not in began
            began[number] = now_us
        for number in end:
            assert number in began and number not in ended
            ended[number] = now_us
    for number, fault in enumerate(script):
        due_us = stages.get(fault.at.stage, 1 << 62) + 1e6 * fault.at.after_s
        assert (number in began) is (now_us >= due_us)
        if number in began:
            assert began[number] >= due_us
            over_us = began[number] + 1e6 * fault.duration_s
            assert (number in ended) is (now_us >= over_us and now_us > began[number])
            assert ended.get(number, over_us) >= over_us


@pytest.mark.parametrize("kind", ["canopen"])
def test_the_list(kind, capsys):
    assert main([kind, "--fault", "list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in KINDS)
    assert len(out.splitlines()) == len(KINDS) + 4      # outside a terminal each fault has one line


def test_the_list_is_wrapped_at_the_width_of_the_terminal():
    found = KINDS.listing(80)
    assert max(map(len, found.splitlines())) <= 80
    assert found.count("row: number of the row in docs/reference/faults.md") == 1
    assert " ".join(found.split()) == " ".join(KINDS.listing(1000).split())


def test_an_unknown_fault_gives_one_line(capsys):
    assert main(["canopen", "--hub", "127.0.0.1:0", "--fault", "stoo@hold"]) == 2
    err = capsys.readouterr().err
    assert "no fault is called 'stoo'" in err
    assert len(err.splitlines()) == 1


# -- on a bus ------------------------------------------------------------------------------------------------


class Host:
    """Host that sends raw frames to a stepped drive and collects the replies per SYNC."""

    def __init__(self, *faults):
        self.simulated = EmbeddedSimulator(faults=parse_all(faults)).open()
        self.bus = can.Bus(interface="virtual", channel=self.simulated.channel)
        for request in (b"\x23\x06\x10\x00\x10\x27\0\0", b"\x2b\x17\x10\x00\x64\0\0\0"):   # 1006h 10 ms, 1017h 100 ms
            self.ask(request)

    def send(self, identifier, data):
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def ask(self, request):
        self.send(0x601, request)
        while (message := self.bus.recv(2.0)) is not None:
            if message.arbitration_id == 0x581:
                return bytes(message.data)
        return None

    def stage(self, number):
        return self.ask(bytes((0x2F, 0xFE, 0x5F, 0x04, number, 0, 0, 0)))

    def syncs(self, count):
        """Return the frames (identifier, data) of a number of SYNCs. An SDO reply marks the end of earlier frames."""
        for _ in range(count):
            self.send(0x080, b"")
        self.send(0x601, b"\x40\x00\x10\x00\0\0\0\0")
        frames = []
        while (message := self.bus.recv(2.0)) is not None and message.arbitration_id != 0x581:
            frames.append((message.arbitration_id, bytes(message.data)))
        return frames

    def close(self):
        self.bus.shutdown()
        self.simulated.close()


@pytest.fixture
def host():
    made = []

    def make(*faults):
        made.append(Host(*faults))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_a_stage_is_accepted_and_starts_the_clock_of_its_faults(host):
    drive = host("emcy@hold+200ms=4310h")
    drive.syncs(100)
    assert drive.stage(4)[0] == 0x60
    before = [frame for frame in drive.syncs(20) if frame[0] == 0x081]
    after = [frame for frame in drive.syncs(2) if frame[0] == 0x081]
    assert (before, [data[:2] for _, data in after]) == ([], [b"\x10\x43"])


def test_without_a_script_the_ends_of_cycles_are_not_marked(host):
    drive = host()
    drive.stage(5)
    assert CYCLE_ID not in {identifier for identifier, _ in drive.syncs(50)}


def test_until_the_last_fault_is_over_each_cycle_has_its_end(host):
    """Messages at the begin of a fault are in its cycle on any computer, from the first cycle on."""
    drive = host("heartbeat-lost@100ms/200ms")
    ends = [data for identifier, data in drive.syncs(60) if identifier == CYCLE_ID]
    assert ends[0] == CYCLES_END
    assert set(ends[1:-1]) == {CYCLE_OVER}
    assert ends[-1] == b"\0"
    assert len(ends) == pytest.approx(31, abs=1)


@pytest.mark.heavy
def test_a_sync_request_is_answered_after_all_earlier_frames(host):
    """This holds with all other frames lost, and without a script. Real time is not included."""
    for fault in ((), ("bus-dead@100ms",), ("frame-loss@100ms=100%",)):
        drive = host(*fault)
        drive.syncs(20)
        for _ in range(20):
            drive.send(0x080, b"")
        drive.send(CYCLE_ID, CYCLE_ASKED + b"\x2a")
        seen = []
        while not seen or seen[-1] != (CYCLE_ID, CYCLE_ANSWER + b"\x2a"):
            message = drive.bus.recv(20.0)
            assert message is not None
            seen.append((message.arbitration_id, bytes(message.data)))
        if fault:
            assert drive.simulated.simulator.time_s == pytest.approx(0.4)
        if "bus-dead@100ms" in fault:
            assert {identifier for identifier, _ in seen} == {CYCLE_ID}


def test_heartbeats_end_and_come_again(host):
    drive = host("heartbeat-lost@305ms/400ms")
    counts = [sum(identifier == 0x701 for identifier, _ in drive.syncs(10)) for _ in range(10)]
    assert counts[4:7] == [0, 0, 0]
    assert all(count == 1 for count in [*counts[1:3], *counts[8:]])


def test_time_advances_with_a_lost_sync(host):
    """All frames before the 51st SYNC are lost, including the SYNCs."""
    drive = host("frame-loss@100ms=100%/400ms")
    drive.syncs(60)
    assert drive.simulated.simulator.time_s == pytest.approx(0.6)


@pytest.mark.parametrize(("fault", "request_", "answer"), [
    ("sdo-abort=6072h", b"\x40\x72\x60\x00\0\0\0\0", "80 72 60 00 20 00 00 08"),
    ("write-not-kept=6080h", b"\x23\x80\x60\x00\x01\0\0\0", "60 80 60 00 00 00 00 00"),
    ("reads-back-otherwise=6076h", b"\x40\x76\x60\x00\0\0\0\0", "43 76 60 00 44 42 0f 00"),
])
def test_replies_of_sdo(fault, request_, answer, host):
    """6076h of the default rig is 1,000,000 mN·m = 000F4240h."""
    assert host(fault).ask(request_).hex(" ") == answer


def test_a_write_that_is_not_kept_leaves_the_former_value(host):
    drive = host("watchdog-not-armed")
    assert drive.ask(b"\x23\x16\x10\x01\xf4\x01\x7f\0")[0] == 0x60
    assert drive.ask(b"\x40\x16\x10\x01\0\0\0\0")[4:] == bytes(4)


def test_two_nodes_with_one_id_both_reply(host):
    drive = host("duplicate-node")
    drive.bus.recv(0.1)
    drive.send(0x601, b"\x40\x00\x10\x00\0\0\0\0")
    answers = []
    while (message := drive.bus.recv(0.3)) is not None:
        answers.append(bytes(message.data))
    assert answers[-1] == answers[-2]
    assert answers[-1][4:] == b"\x92\x01\x02\x00"


def test_a_dead_bus_is_silent_and_its_plant_continues(host):
    drive = host("bus-dead@100ms")
    for _ in range(100):
        drive.send(0x080, b"")
    seen = []
    while (message := drive.bus.recv(0.3)) is not None:
        seen.append(message.arbitration_id)
    assert seen.count(0x701) <= 2
    assert drive.simulated.simulator.time_s == pytest.approx(1.0)


def test_a_script_repeats_frame_for_frame(host):
    runs = []
    for _ in range(2):
        drive = host("frame-loss@50ms=30%", "duplicate-frames@0s=50%")
        drive.send(0x000, b"\x01\x01")
        runs.append(drive.syncs(100))
    assert all(one == other for one, other in pairwise(runs))
    assert len(runs[0]) > 20
