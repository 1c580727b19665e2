"""Identification of the inertia from a recording. Pure numpy and scipy; needs no drive and no file."""

from tdhil.estimation.cross_checks import (
    RATIOS_ALIKE as RATIOS_ALIKE, AngleRatio as AngleRatio, angle_ratios as angle_ratios, mean_speed as mean_speed,
    torque_contradiction as torque_contradiction, torque_ratios as torque_ratios,
)
from tdhil.estimation.data_checks import (
    SAMPLED_SHARE as SAMPLED_SHARE, aliased as aliased, least_samples as least_samples,
    too_few_a_period as too_few_a_period,
)
from tdhil.estimation.frequency_domain import (
    torque_answer as torque_answer, unexplained_distortion as unexplained_distortion, with_total as with_total,
)
from tdhil.estimation.friction_levels import (
    Levels as Levels, measure_levels as measure_levels, tie_viscous as tie_viscous,
)
from tdhil.estimation.identification import identify as identify
from tdhil.estimation.paper_method import STEP_S as STEP_S, line_fit as line_fit, paper_estimate as paper_estimate
from tdhil.estimation.impedance import CONTROL_PERIOD_S as CONTROL_PERIOD_S
from tdhil.estimation.result import (
    BudgetLine as BudgetLine, Compliant as Compliant, DistortionTest as DistortionTest, Estimate as Estimate,
    FrequencyResponse as FrequencyResponse, FrictionPoint as FrictionPoint,
    Identification as Identification, InertiaEstimate as InertiaEstimate, LineFit as LineFit, Options as Options,
    PaperEstimate as PaperEstimate, Refused as Refused, ResidualTest as ResidualTest, SecondOpinion as SecondOpinion,
    ResponseLine as ResponseLine, ShaftCovariance as ShaftCovariance, Verdict as Verdict,
    normal_quantile as normal_quantile,
    response_columns as response_columns, unit_of as unit_of,
)
from tdhil.estimation.rough_estimates import (
    RoughFriction as RoughFriction, RoughInertia as RoughInertia, rough_friction as rough_friction,
    rough_inertia as rough_inertia, rough_inertia_before_echo as rough_inertia_before_echo,
)
from tdhil.estimation.samples import (
    STICK_SLIP_REGULAR as STICK_SLIP_REGULAR, STICK_SLIP_SHARE as STICK_SLIP_SHARE, Samples as Samples,
    downhole_swing_rad_s as downhole_swing_rad_s,
    Stretch as Stretch, excited_window as excited_window, repeats as repeats, stretches as stretches,
    usable_samples as usable_samples,
)
from tdhil.estimation.setpoint_sampling import worst_share as worst_share
from tdhil.estimation.shared_filters import FittedTogether as FittedTogether, identify_together as identify_together
from tdhil.estimation.spectrum import (
    SpectralLine as SpectralLine, period_lines as period_lines, pooled_lines as pooled_lines,
)
from tdhil.estimation.string_impedance import (
    MeasuredString as MeasuredString, measure_lines as measure_lines, measure_string as measure_string,
)
