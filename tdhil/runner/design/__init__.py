"""Design of the excitation: frequencies, amplitudes, mean speeds and periods for the narrowest interval, and the
stopping rule.
"""

from tdhil.runner.design.choice import (
    SOON_COUNTED as SOON_COUNTED, Choice as Choice, DesignKnowledge as DesignKnowledge, choose as choose,
    choose_soonest as choose_soonest, refuse_unfit as refuse_unfit,
)
from tdhil.runner.design.prediction import (
    Evidence as Evidence, NoiseDensity as NoiseDensity, assumed_noise as assumed_noise,
    expected_half_width as expected_half_width, half_width as half_width, longer as longer,
    measured_noise as measured_noise, predicted as predicted,
)
from tdhil.runner.design.stopping_rule import (
    LOOKS as LOOKS, MARGIN as MARGIN, MOST_BEHIND as MOST_BEHIND, Look as Look, Stopping as Stopping,
    interval_confidence as interval_confidence, least_scale as least_scale, look as look,
    working_confidence as working_confidence,
)
