"""Stop sequence with exceptions, in a call or between two calls."""

import pytest

from tdhil.runner.stop import MOST_INTERRUPTIONS
from tests.runner.fake_drive import lost
from tests.runner.stop_calls import asked


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(3), MemoryError()])
@pytest.mark.parametrize("where", ["exchange", "quick_stop", "disable"])
def test_an_interrupt_in_any_call_does_not_end_it(world, error, where):
    here = world()
    here.turn(5.0)
    plain, left = getattr(here.drive, where), [3]

    def interrupted(*arguments):
        if left[0]:
            left[0] -= 1
            raise error
        return plain(*arguments)

    setattr(here.drive, where, interrupted)
    report = here.stop_sequence().run()
    assert report.confirmed
    assert here.drive.disabled_at == [0.0]
    assert report.trouble == tuple([str(error) or type(error).__name__] * 3)


@pytest.mark.parametrize("times", [1, MOST_INTERRUPTIONS - 1])
def test_an_interrupt_between_the_calls_restarts_it(world, times):
    """A second Ctrl-C may come anywhere, also between two lines of the sequence."""
    here = world()
    here.turn(5.0)
    sequence = here.stop_sequence()
    plain, left = sequence._stays_at_rest, [times]

    def struck():
        if left[0]:
            left[0] -= 1
            raise KeyboardInterrupt
        return plain()

    sequence._stays_at_rest = struck
    report = sequence.run()
    assert report.confirmed
    assert report.trouble == ("KeyboardInterrupt",) * times
    assert here.drive.disabled_at == [0.0]


def test_an_interrupt_that_never_ends_is_reported(world):
    here = world()
    here.turn(5.0)
    sequence = here.stop_sequence()

    def struck():
        raise KeyboardInterrupt

    sequence._decelerate = struck
    report = sequence.run()
    assert (report.confirmed, report.disabled, report.at_rest_s) == (False, False, None)
    assert report.trouble == ("KeyboardInterrupt",) * MOST_INTERRUPTIONS
    assert "disable" not in here.drive.calls


def test_it_is_not_begun_a_second_time_from_inside_itself(world):
    here = world()
    here.turn(5.0)
    sequence, inner = here.stop_sequence(), []
    here.display.on_cycle = lambda *_: inner.append(sequence.run())
    report = sequence.run()
    assert report.confirmed
    assert {(one.confirmed, one.trouble) for one in inner} == {(False, ("the stop sequence is under way already",))}
    assert asked(here.drive) == ["quick_stop", "disable"]
    assert sequence.run() is report


def test_troubles_are_bounded(world):
    here = world()
    here.turn(5.0)
    here.drive.misbehave = lost
    assert len(here.stop_sequence().run().trouble) <= 21
