"""What to ask of the shaft: lines, amplitudes, mean speeds and periods for the tightest interval, and when to stop."""

from tdhil.protocol.design.look import Look, look
from tdhil.protocol.design.noise import Noise, assumed_noise, measured_noise
from tdhil.protocol.design.predicted import expected_half_width, predicted
from tdhil.run.design.choose import Choice, Knowledge, choose
from tdhil.run.design.stopping_rule import LOOKS, interval_confidence, working_confidence

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
