"""One TPDO1 per SYNC: frames that are used, frames in doubt, and frames that cannot be from the drive."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.pdo import STANDARD, FrameShape, PdoFeedback
from profiles.simulator_marker import CYCLE_OVER, CYCLES_END, LAST_CYCLE_OVER

OLD, NEW, OTHER = b"\x01" * 8, b"\x02" * 8, b"\x03" * 8
WIDE = FrameShape(torque=(0x2000, 0, 32))


def cycles(*frames, feedback=None):
    """Return the value used in each cycle, or None, and the feedback object."""
    feedback = feedback or PdoFeedback(STANDARD)
    taken = []
    for cycle in frames:
        feedback.begin()
        for data in cycle:
            feedback.on_tpdo1(data)
        taken.append(feedback.data or None)
    return taken, feedback


def test_the_first_of_a_cycle_is_taken_and_the_next_begins_with_none():
    taken, feedback = cycles([NEW], [], [OLD, NEW])
    assert taken == [NEW, None, OLD]
    assert feedback.arrived == 3


def test_doubt_is_reported_once():
    _, feedback = cycles([NEW], [OLD, NEW])
    assert feedback.doubted()
    assert not feedback.doubted()


def test_one_that_comes_after_its_cycle_is_doubted_in_the_next():
    _, feedback = cycles([OLD])
    assert not feedback.doubted()
    feedback.on_tpdo1(NEW)
    feedback.begin()
    feedback.on_tpdo1(NEW)
    assert feedback.doubted()


@pytest.mark.parametrize(("frames", "contradictions"), [
    ([[NEW, NEW]], 0),                          # duplicated on the way
    ([[NEW, OLD]], 1),
    ([[NEW, OLD, OTHER]], 2),
    ([[NEW], [], [OTHER, NEW]], 0),             # the one that was missing came late
    ([[NEW], [], [OTHER, NEW, NEW], [NEW, OLD]], 2),
    ([[], [], [], [], [NEW, OLD, OLD, OLD, OLD]], 0),      # the replies to five SYNCs
    ([[], [], [], [], [NEW, OLD, OLD, OLD, OLD, OTHER]], 1),
    ([[]] * 60 + [[OLD] * 60 + [NEW]], 0),
    ([[]] * 60 + [[OLD] * 60 + [NEW, OTHER]], 1),
])
def test_contradictions(frames, contradictions):
    _, feedback = cycles([NEW], *frames)
    assert feedback.contradictions == contradictions


def test_the_drive_also_replies_to_a_foreign_sync():
    feedback = PdoFeedback(STANDARD)
    for _ in range(10):
        feedback.begin()
        feedback.on_tpdo1(NEW)
        feedback.on_foreign_sync()
        feedback.on_tpdo1(OLD)
    assert feedback.contradictions == 0
    assert feedback.doubted()


@given(st.lists(st.lists(st.sampled_from([OLD, NEW, OTHER]), max_size=4), max_size=20))
def test_a_drive_alone_is_never_doubted_and_more_than_one_always(frames):
    feedback = PdoFeedback(STANDARD)
    for cycle in frames:
        taken, _ = cycles(cycle, feedback=feedback)
        assert taken == [cycle[0] if cycle else None]
        assert feedback.doubted() is (len(cycle) > 1)
    assert feedback.arrived == sum(map(len, frames))
    assert feedback.contradictions <= sum(len(cycle) - 1 for cycle in frames if cycle)


@given(st.lists(st.sampled_from(["in time", "lost", "late"]), max_size=30))
def test_a_slow_drive_contradicts_nothing(fates):
    """Replies are lost, or arrive in the next cycle before the reply of that cycle."""
    feedback, late = PdoFeedback(STANDARD), None
    for number, fate in enumerate(fates):
        feedback.begin()
        if late is not None:
            feedback.on_tpdo1(late)
        own = number.to_bytes(8, "little")
        late = own if fate == "late" else None
        if fate == "in time":
            feedback.on_tpdo1(own)
    assert feedback.contradictions == 0


@pytest.mark.parametrize("data", [b"", bytes(7), bytes(9)])
def test_another_length_is_no_feedback(data):
    assert cycles([data, NEW])[0] == [NEW]


def test_halves_of_one_sync_are_joined_in_either_order():
    for order in ("status first", "data first"):
        feedback = PdoFeedback(WIDE)
        feedback.begin()
        if order == "status first":
            feedback.on_status(b"\x27\x02")
            feedback.on_tpdo1(NEW[:WIDE.data_size()])
        else:
            feedback.on_tpdo1(NEW[:WIDE.data_size()])
            feedback.on_status(b"\x27\x02")
        assert feedback.data == b"\x27\x02" + NEW[:WIDE.data_size()]
        feedback.begin()
        feedback.on_status(b"\x27\x02")
        assert not feedback.data, "a half from the last cycle must not complete this one"


def test_the_end_of_a_cycle_is_waited_for_while_a_peer_marks_it():
    feedback = PdoFeedback(STANDARD)
    feedback.begin()
    feedback.on_cycle_end(CYCLES_END)
    feedback.on_tpdo1(NEW)
    assert not feedback.done
    feedback.on_tpdo1(NEW)
    feedback.on_cycle_end(CYCLE_OVER)
    assert feedback.done
    assert feedback.second == 1
    feedback.on_cycle_end(LAST_CYCLE_OVER)
    feedback.begin()
    assert not feedback.done
    feedback.on_tpdo1(NEW)
    assert feedback.done


# -- in real time: replies may arrive after their cycle, in the order of their SYNCs --------------------------

PERIOD_S, ANSWER_S = 0.004, 0.0003


class Wire:
    """Cycles in real time: each SYNC has a number, and its reply arrives at the time in ``fates`` (None: lost).

    `given`: the number that was used in each cycle, or None.
    """

    def __init__(self):
        self.now_s = 0.0
        self.feedback = PdoFeedback(STANDARD, lambda: self.now_s, PERIOD_S)
        self.given = []
        self._coming = []
        self._last_s = 0.0

    def cycle(self, answer_s=ANSWER_S, foreign=()):
        number, begun_s = len(self.given), self.now_s
        if answer_s is not None:
            self._last_s = max(self._last_s, begun_s + answer_s)       # the order of the queue is kept
            self._coming.append((self._last_s, number.to_bytes(8, "little")))
        self._coming += [(begun_s + after_s, data) for after_s, data in foreign]
        self._coming.sort(key=lambda entry: entry[0])
        self.feedback.begin(begun_s)
        self._listen(begun_s + 0.8 * PERIOD_S, in_cycle=True)
        if not self.feedback.done:
            self.feedback.settle()
        data = self.feedback.data
        self.given.append(int.from_bytes(data, "little") if data else None)
        self._listen(begun_s + PERIOD_S)
        self.now_s = begun_s + PERIOD_S

    def _listen(self, until_s, in_cycle=False):
        while self._coming and self._coming[0][0] <= until_s and not (in_cycle and self.feedback.done):
            self.now_s, data = max(self.now_s, self._coming[0][0]), self._coming.pop(0)[1]
            self.feedback.on_tpdo1(data)
        self.now_s = max(self.now_s, until_s if not (in_cycle and self.feedback.done) else self.now_s)


def held_back(wire, cycles):
    """Return the times of an adapter that holds all frames for some cycles and then delivers them at once, in order."""
    for number in range(cycles):
        wire.cycle((cycles - number) * PERIOD_S + ANSWER_S)


@pytest.mark.parametrize("cycles", [1, 2, 5, 30, 60])
def test_a_burst_after_a_late_adapter_is_assigned_to_its_syncs(cycles):
    wire = Wire()
    for _ in range(5):
        wire.cycle()
    held_back(wire, cycles)
    wire.cycle(ANSWER_S + 1e-4)
    assert wire.feedback.contradictions == 0
    assert wire.given[5:] == [None] * cycles + [5 + cycles]
    assert wire.feedback.older == cycles
    wire.cycle()
    assert wire.given[-1] == 6 + cycles


@pytest.mark.parametrize("lost", [1, 2, 30])
def test_after_lost_replies_one_more_cycle_is_doubtful(lost):
    wire = Wire()
    for fate in [ANSWER_S] * 5 + [None] * lost + [ANSWER_S] * 5:
        wire.cycle(fate)
    assert wire.given == [*range(5)] + [None] * (lost + 1) + [*range(6 + lost, 10 + lost)]
    assert wire.feedback.contradictions == 0


def test_a_drive_that_is_always_a_cycle_late_is_never_paired_with_the_wrong_sync():
    """The reply time is known from the first SYNC, which has a longer time-out (`CanopenDrive`)."""
    wire = Wire()
    wire.feedback.begin(0.0)
    wire.now_s = 1.2 * PERIOD_S
    wire.feedback.on_tpdo1(NEW)
    assert wire.feedback.data == NEW
    for _ in range(200):
        wire.cycle(1.2 * PERIOD_S)
    assert wire.given == [None] * 200
    assert wire.feedback.contradictions == 0


@given(st.lists(st.tuples(st.integers(1, 5), st.floats(0.0, 12.0)), max_size=12), st.floats(0.05, 0.7))
def test_a_late_answer_is_never_another_syncs(holds, answer):
    """Held replies arrive together: repeated pairs of (cycles in time, number of held cycles)."""
    wire, until_s = Wire(), 0.0
    for in_time, held in [(3, 0.0), *holds]:
        for _ in range(in_time):
            wire.cycle(max(answer * PERIOD_S, until_s - wire.now_s))
        until_s = wire.now_s + held * PERIOD_S
        while wire.now_s < until_s:
            wire.cycle(max(answer * PERIOD_S, until_s - wire.now_s))
    assert wire.feedback.contradictions == 0
    assert all(given in (None, number) for number, given in enumerate(wire.given)), wire.given
    assert wire.given[:3] == [0, 1, 2]


@given(st.lists(st.sampled_from([ANSWER_S, 0.001, 0.0012, None]), max_size=120))
def test_with_any_losses_no_sample_is_assigned_to_another_sync(fates):
    wire = Wire()
    for fate in [0.001] * 3 + fates:
        wire.cycle(fate)
    assert wire.feedback.contradictions == 0
    assert all(given in (None, number) for number, given in enumerate(wire.given))


def test_somebody_who_sends_too_is_found_however_late_the_host_was():
    wire = Wire()
    for _ in range(3):
        wire.cycle()
    held_back(wire, 40)
    for _ in range(5):
        wire.cycle(ANSWER_S + 1e-4, foreign=[(0.0, OTHER)])
    assert wire.feedback.contradictions >= 3


def test_without_a_sync_no_reply_is_expected():
    wire = Wire()
    for _ in range(3):
        wire.cycle()
    for _ in range(50):
        wire.feedback.begin(wire.now_s, sync=False)
        wire.now_s += PERIOD_S
    wire.feedback.on_tpdo1(OLD)
    assert wire.feedback.contradictions == 1


def test_halves_of_a_burst_keep_together():
    now = [0.0]
    feedback = PdoFeedback(WIDE, lambda: now[0], PERIOD_S)
    size = WIDE.data_size()
    for _ in range(3):
        feedback.begin(now[0])
        now[0] += PERIOD_S
    for number in range(3):
        feedback.on_tpdo1(bytes([number]) * size)
        feedback.on_status(bytes([number]) * 2)
    assert feedback.data == bytes([2]) * (2 + size)
    assert feedback.older == 2
