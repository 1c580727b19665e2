"""One TPDO1 for a SYNC: which is taken, which are doubted, and which can't be the drive's."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.feedback import Feedback
from drivers.cia402.shape import STANDARD, Shape
from profiles.marker import CYCLE_OVER, CYCLES_END, LAST_CYCLE_OVER

OLD, NEW, OTHER = b"\x01" * 8, b"\x02" * 8, b"\x03" * 8
WIDE = Shape(torque=(0x2000, 0, 32))


def cycles(*frames, feedback=None):
    """What was taken of each cycle, None for nothing; and the feedback."""
    feedback = feedback or Feedback(STANDARD)
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


def test_doubt_is_told_once():
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
    ([[NEW, NEW]], 0),                          # doubled on its way
    ([[NEW, OLD]], 1),
    ([[NEW, OLD, OTHER]], 2),
    ([[NEW], [], [OTHER, NEW]], 0),             # the one that was missing came late
    ([[NEW], [], [OTHER, NEW, NEW], [NEW, OLD]], 2),
    ([[], [], [], [], [NEW, OLD, OLD, OLD, OLD]], 1),
])
def test_contradictions(frames, contradictions):
    _, feedback = cycles([NEW], *frames)
    assert feedback.contradictions == contradictions


def test_the_drive_answers_somebody_elses_sync_too():
    feedback = Feedback(STANDARD)
    for _ in range(10):
        feedback.begin()
        feedback.on_tpdo1(NEW)
        feedback.on_foreign_sync()
        feedback.on_tpdo1(OLD)
    assert feedback.contradictions == 0
    assert feedback.doubted()


@given(st.lists(st.lists(st.sampled_from([OLD, NEW, OTHER]), max_size=4), max_size=20))
def test_a_drive_alone_is_never_doubted_and_more_than_one_always(frames):
    feedback = Feedback(STANDARD)
    for cycle in frames:
        taken, _ = cycles(cycle, feedback=feedback)
        assert taken == [cycle[0] if cycle else None]
        assert feedback.doubted() is (len(cycle) > 1)
    assert feedback.arrived == sum(map(len, frames))
    assert feedback.contradictions <= sum(len(cycle) - 1 for cycle in frames if cycle)


@given(st.lists(st.sampled_from(["in time", "lost", "late"]), max_size=30))
def test_a_slow_drive_contradicts_nothing(fates):
    """Answers that are lost, or come within the next cycle, before that one's own."""
    feedback, late = Feedback(STANDARD), None
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
        feedback = Feedback(WIDE)
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
        assert not feedback.data, "a half of the last cycle must not complete this one"


def test_while_a_peer_tells_where_cycles_end_they_are_waited_for():
    feedback = Feedback(STANDARD)
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
