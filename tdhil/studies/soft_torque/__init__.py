"""Stick-slip of the reference string under stiff, soft and compensated controllers, and what a wrong J costs."""

from tdhil.studies.soft_torque.study import SOFT_TORQUE as SOFT_TORQUE
