"""What is asked once there are lines: a wrong period, a wrong sign, a shaft at rest, other motion than was declared.

The sign comes before the standstill: torque in the place of speed crosses zero too.
"""

import numpy as np

from tdhil.identify.faults.direction import refuse_direction
from tdhil.identify.faults.left_out import left_out_warnings
from tdhil.identify.faults.refusal import Refusal
from tdhil.identify.faults.standstill import refuse_standstill
from tdhil.identify.faults.timebase import refuse_period
from tdhil.identify.faults.undeclared import undeclared_warning
from tdhil.identify.lines.friction import Levels
from tdhil.identify.lines.spectrum import Line, PeriodLines
from tdhil.identify.lines.warming import warming_warning
from tdhil.identify.samples import Samples, Stretch, excited_window
from tdhil.record.recording import Recording


def refuse_lines(
    samples: Samples,
    speed_step: float,
    stretches: tuple[Stretch, ...],
    fits: tuple[PeriodLines, ...],
    every: tuple[Line, ...],
) -> Refusal | None:
    """``speed_step``: resolution, rad/s; of the pooled lines ``every``, those that stand clear tell the direction."""
    found = refuse_period(stretches, fits)
    if found is not None:
        return found
    means = [(fit.speed_mean.mean(), fit.torque_mean.mean()) for fit in fits if len(fit.speed_mean)]
    if means:
        speed, torque = np.mean(means, axis=0)
        found = refuse_direction(tuple(line for line in every if line.excited), float(speed), float(torque))
    if found is not None:
        return found
    parts = [(one.segment, samples.between(*excited_window(one.segment))) for one in stretches]
    return refuse_standstill(parts, speed_step)


def hints(
    recording: Recording, stretches: tuple[Stretch, ...], fits: tuple[PeriodLines, ...], levels: Levels
) -> tuple[str, ...]:
    """Warnings: what is wrong with the data but leaves a number that stands."""
    return (*left_out_warnings(recording), *undeclared_warning(stretches, fits), *warming_warning(levels.warming))
