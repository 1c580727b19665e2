"""Kinds of unusable, faulty or malformed records, by name. Each makes one from a good record, with a seed."""

from tests.estimation.hopeless_family import families
from tests.estimation.hopeless_motions import MOTIONS
from tests.estimation.hopeless_signals import SIGNALS
from tests.estimation.hopeless_times import TIMES

SEVERAL, family, _ = families()
SINGLE = [*SIGNALS, *TIMES, *MOTIONS]
RECORD_FAULTS = [f for f in SINGLE if f.spoil is not None and f.name not in ("words", "lengths_differ", "nonsense")]


@family()
def two_faults(r, rng):
    """Apply two random faults, one after the other."""
    for number in rng.choice(len(RECORD_FAULTS), 2, replace=False):
        if r.excitation is None or not r.excitation.segments or len(r.time_s) < 3000:
            break
        r = RECORD_FAULTS[number].spoil(r, rng)
    return r


FAMILIES = [*SINGLE, *SEVERAL]
