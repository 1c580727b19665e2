"""Count of missing feedback in recent cycles: incremental, compared with a full count."""

import random

from drivers.cia402.drive import _Cycles


def test_the_count_of_missing_feedback_is_that_of_the_recent_cycles():
    rng, cycles = random.Random(5), _Cycles.at(0.02)
    for number in range(1000):
        cycles.note(rng.random() < 0.7)
        assert cycles.missed_lately == cycles.recent.count(False)
        if number % 300 == 299:
            cycles.forget()
            assert (cycles.missed_lately, len(cycles.recent)) == (0, 0)
    assert len(cycles.recent) == cycles.recent.maxlen
