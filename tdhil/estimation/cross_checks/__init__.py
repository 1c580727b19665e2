"""What stands beside a result: J by other routes through the same run, and the friction curve."""

from typing import TYPE_CHECKING

from profiles import lazy_face

if TYPE_CHECKING:
    from tdhil.estimation.cross_checks.friction_by_speed import Inertia as Inertia, friction_curve as friction_curve
    from tdhil.estimation.cross_checks.second_opinion import cross_checked as cross_checked
else:
    __getattr__, __dir__ = lazy_face(__name__)
