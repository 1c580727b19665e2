"""Points of the comparison: means over a block of cycles, with integrals up to its middle. Pure."""

from __future__ import annotations

POINT_S = 0.04
"""Time between two points of the comparison, s; a slow line has one for each cycle."""

SLOPE_S = 0.12
"""Time for a slope of the reported speed, s: three points."""

AROUND_S = 0.25
"""Time around an end of a window, s: slope and torque at the end are bounded by their values within it, because a
dead time hides later ones."""

IN_A_ROW = 2
"""Number of consecutive points at which a test must fail."""

STALE_S = 1.0
"""Age of a report, s, from which it has no information on the present."""


class Point:
    """Means over one block of cycles, with integrals up to its middle. Units: s, rad/s, N·m, N·m·s, rad."""

    __slots__ = (
        "friction_high", "friction_low", "impulse", "load_high", "load_low", "rough", "slope", "slope_high",
        "slope_low", "speed", "still", "time_s", "torque", "torque_high", "torque_least", "torque_low", "torque_most",
    )

    time_s: float
    speed: float
    still: float
    torque: float
    impulse: float
    rough: float
    friction_low: float
    friction_high: float
    slope: float
    slope_low: float
    slope_high: float
    torque_low: float
    torque_high: float
    torque_least: float
    torque_most: float
    load_low: float
    load_high: float
