"""Cross-checks of a result: J by other routes through the same run, and the friction curve."""

from tdhil.estimation.cross_checks.angle_agreement import (
    RATIOS_ALIKE as RATIOS_ALIKE, AngleRatio as AngleRatio, angle_checked as angle_checked,
    angle_ratios as angle_ratios, mean_speed as mean_speed,
)
from tdhil.estimation.cross_checks.friction_by_speed import Inertia as Inertia, friction_curve as friction_curve
from tdhil.estimation.cross_checks.level_torque import level_checked as level_checked
from tdhil.estimation.cross_checks.second_opinion import cross_checked as cross_checked
from tdhil.estimation.cross_checks.speed_jump import jump_checked as jump_checked
from tdhil.estimation.cross_checks.torque_agreement import (
    torque_contradiction as torque_contradiction, torque_ratios as torque_ratios,
    torques_compared as torques_compared, torques_judged as torques_judged,
)
