"""What to ask of the shaft: lines, amplitudes, mean speeds and periods for the tightest interval, and when to stop."""

from tdhil.run.design.choose import Choice, Knowledge, choose
from tdhil.run.design.prediction import Noise, assumed_noise, expected_half_width, measured_noise, predicted
from tdhil.run.design.stopping_rule import LOOKS, Look, interval_confidence, look, working_confidence

__all__ = [
    "LOOKS",
    "Choice",
    "Knowledge",
    "Look",
    "Noise",
    "assumed_noise",
    "choose",
    "expected_half_width",
    "interval_confidence",
    "look",
    "measured_noise",
    "predicted",
    "working_confidence",
]
