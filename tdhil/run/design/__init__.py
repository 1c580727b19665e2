"""What to ask of the shaft: lines, amplitudes, mean speeds and periods for the tightest interval, and when to stop."""

from tdhil.run.design.choice import (
    Choice,
    Knowledge,
    choose,
    refuse_unfit,
)
from tdhil.run.design.prediction import (
    Evidence,
    Noise,
    assumed_noise,
    expected_half_width,
    half_width,
    longer,
    measured_noise,
    predicted,
)
from tdhil.run.design.stopping_rule import (
    LOOKS,
    MARGIN,
    Look,
    Stopping,
    interval_confidence,
    interval_of,
    least_scale,
    look,
    working_confidence,
)

__all__ = [
    "LOOKS",
    "MARGIN",
    "Choice",
    "Evidence",
    "Knowledge",
    "Look",
    "Noise",
    "Stopping",
    "assumed_noise",
    "choose",
    "expected_half_width",
    "half_width",
    "interval_confidence",
    "interval_of",
    "least_scale",
    "longer",
    "look",
    "measured_noise",
    "predicted",
    "refuse_unfit",
    "working_confidence",
]
