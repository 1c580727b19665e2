"""Stick-slip of the reference string with stiff, soft and compensated controllers, and the effect of a wrong J."""

from tdhil.studies.soft_torque.study import SOFT_TORQUE as SOFT_TORQUE
