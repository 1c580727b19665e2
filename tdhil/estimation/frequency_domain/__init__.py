"""Periodic excitation: samples to lines, lines to a model's likelihood, likelihood to values and intervals."""

from typing import TYPE_CHECKING

from profiles import lazy_face

if TYPE_CHECKING:
    from tdhil.estimation.frequency_domain.before_echo import torque_answer as torque_answer
    from tdhil.estimation.frequency_domain.filter_order import simple_weight as simple_weight
    from tdhil.estimation.frequency_domain.friction_levels import (
        Levels as Levels, ViscousConstraint as ViscousConstraint, measure_levels as measure_levels,
        tie_viscous as tie_viscous, warming_warning as warming_warning,
    )
    from tdhil.estimation.frequency_domain.identify import (
        clear_lines as clear_lines, identify_lines as identify_lines, measured as measured,
    )
    from tdhil.estimation.frequency_domain.inference import (
        doubtful as doubtful, fisher_tail as fisher_tail, profile_edge as profile_edge, rejects as rejects,
        student_quantile as student_quantile,
        torque_scale_line as torque_scale_line, widened_most_by_scale as widened_most_by_scale,
        with_total as with_total,
    )
    from tdhil.estimation.frequency_domain.model import GaussianPrior as GaussianPrior, Model as Model
    from tdhil.estimation.frequency_domain.optimiser import Box as Box, Fit as Fit, descend as descend
    from tdhil.estimation.frequency_domain.rigid import (
        fit_inertia as fit_inertia, known_of as known_of, lag_priors as lag_priors,
        refuse_count as refuse_count, simultaneous as simultaneous,
    )
    from tdhil.estimation.frequency_domain.shafts import VISCOUS as VISCOUS, shaft_model as shaft_model
    from tdhil.estimation.frequency_domain.signal_filters import (
        AVERAGE as AVERAGE, LAG_BOUND_S as LAG_BOUND_S, SHAPE_BOUND as SHAPE_BOUND, SKEW as SKEW,
        SKEW_BOUND_S as SKEW_BOUND_S, SPEED_LAG as SPEED_LAG, SPEED_SHAPE as SPEED_SHAPE, TORQUE_LAG as TORQUE_LAG,
        TORQUE_SHAPE as TORQUE_SHAPE, shared_lag as shared_lag, unseen_lag as unseen_lag,
    )
    from tdhil.estimation.frequency_domain.spectrum import (
        ComplexArray as ComplexArray, Line as Line, PeriodLines as PeriodLines, period_lines as period_lines,
        pooled_lines as pooled_lines,
    )
else:
    __getattr__, __dir__ = lazy_face(__name__)
