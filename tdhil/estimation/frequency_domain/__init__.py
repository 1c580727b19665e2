"""Route of periodic excitation: from spectral lines to the likelihood of a model, and from there to values and
intervals.
"""

from tdhil.estimation.frequency_domain.before_echo import (
    identify_before_echo as identify_before_echo, refuse_stick_slip as refuse_stick_slip,
    torque_answer as torque_answer,
)
from tdhil.estimation.frequency_domain.compliant import (
    identify_compliant as identify_compliant, may_swing as may_swing, usable_lines as usable_lines,
)
from tdhil.estimation.frequency_domain.compliant import plausible as plausible
from tdhil.estimation.frequency_domain.compliant_fit import (
    fit_compliant as fit_compliant, string_view as string_view, viewed as viewed,
)
from tdhil.estimation.frequency_domain.filter_order import (
    FittedModel as FittedModel, simple_weight as simple_weight,
)
from tdhil.estimation.frequency_domain.frequency_response import (
    ModelCurve as ModelCurve, distortion_warning as distortion_warning, measure_response as measure_response,
    unexplained_distortion as unexplained_distortion,
)
from tdhil.estimation.frequency_domain.inference import (
    AT_BOUND as AT_BOUND, CERTAIN as CERTAIN, contradicted as contradicted, estimate as estimate,
    fisher_tail as fisher_tail, profile_edge as profile_edge,
    student_quantile as student_quantile, torque_scale_line as torque_scale_line,
    widened_most_by_scale as widened_most_by_scale, with_total as with_total,
)
from tdhil.estimation.frequency_domain.likelihood import LEAST_NU as LEAST_NU
from tdhil.estimation.frequency_domain.model import GaussianPrior as GaussianPrior, Model as Model
from tdhil.estimation.frequency_domain.nonlinear_friction import identify_bent as identify_bent
from tdhil.estimation.frequency_domain.optimiser import Box as Box, Fit as Fit, descend as descend
from tdhil.estimation.frequency_domain.rigid import (
    RigidResult as RigidResult, fit_inertia as fit_inertia, fit_parameters as fit_parameters, fit_rigid as fit_rigid,
    known_of as known_of, lag_priors as lag_priors, refuse_count as refuse_count, rigid_finding as rigid_finding,
    simultaneous as simultaneous, unfiltered as unfiltered,
)
from tdhil.estimation.frequency_domain.shafts import (
    ANY_IMPEDANCE as ANY_IMPEDANCE, DELAY_SURER as DELAY_SURER, KnownStringShaft as KnownStringShaft, LOAD as LOAD,
    ShaftModel as ShaftModel, TwoMassShaft as TwoMassShaft, VISCOUS as VISCOUS, shaft_model as shaft_model,
)
from tdhil.estimation.frequency_domain.signal_filters import (
    AVERAGE as AVERAGE, LAG_BOUND_S as LAG_BOUND_S, SHAPE_BOUND as SHAPE_BOUND, SKEW as SKEW,
    SKEW_BOUND_S as SKEW_BOUND_S, SPEED_LAG as SPEED_LAG, SPEED_SHAPE as SPEED_SHAPE, TORQUE_LAG as TORQUE_LAG,
    TORQUE_SHAPE as TORQUE_SHAPE, filters as filters, shared_lag as shared_lag,
)
from tdhil.estimation.frequency_domain.transient import settled_lines as settled_lines
