"""An hour of `benchmarks/identify_speed.py` with an angle: what only so many turns show."""

from benchmarks.identify_speed import synthesised
from tdhil.estimation import identify


def test_the_rounding_of_the_angle_is_no_harmonic():
    """Rounding repeats with the angle: in an hour it stood out as three orders of 2 to 3 N·m."""
    found = identify(synthesised(1.0, 100.0, angle=True))
    assert found.harmonics == ()
    assert found.inertia.low <= 104.0 <= found.inertia.high
