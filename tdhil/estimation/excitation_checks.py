"""What is asked once there are lines: a wrong period, a wrong sign, a shaft at rest, other motion than was declared.

The sign comes before the standstill: torque in the place of speed crosses zero too.
"""

import numpy as np

from tdhil.estimation.case import PeriodicCase
from tdhil.estimation.frequency_domain.friction_levels import Levels
from tdhil.estimation.frequency_domain.spectrum import PeriodLines
from tdhil.estimation.samples import Stretch, excited_window
from tdhil.identify.faults.direction import check_direction
from tdhil.identify.faults.left_out import left_out_warnings
from tdhil.identify.faults.standstill import check_standstill
from tdhil.identify.faults.timebase import check_period
from tdhil.identify.faults.undeclared import undeclared_warning
from tdhil.identify.lines.warming import warming_warning
from tdhil.recording.recording import Recording


def check_lines(case: PeriodicCase) -> None:
    """Raise Refused for what can't be so; of the pooled lines, those that stand clear tell the direction."""
    check_period(case.stretches, case.fits)
    means = [(fit.speed_mean.mean(), fit.torque_mean.mean()) for fit in case.fits if len(fit.speed_mean)]
    if means:
        speed, torque = np.mean(means, axis=0)
        check_direction(tuple(line for line in case.every if line.excited), float(speed), float(torque))
    parts = [(one.segment, case.samples.between(*excited_window(one.segment))) for one in case.stretches]
    check_standstill(parts, case.recording.speed_resolution_rad_s)


def hints(
    recording: Recording, stretches: tuple[Stretch, ...], fits: tuple[PeriodLines, ...], levels: Levels
) -> tuple[str, ...]:
    """Warnings: what is wrong with the data but leaves a number that stands."""
    return (*left_out_warnings(recording), *undeclared_warning(stretches, fits), *warming_warning(levels.warming))
