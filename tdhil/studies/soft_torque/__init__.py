"""Stick-slip of the reference string under stiff, soft and compensated controllers, and what a wrong J costs."""

from typing import TYPE_CHECKING

from profiles import lazy_face

if TYPE_CHECKING:
    from tdhil.studies.soft_torque.study import SOFT_TORQUE as SOFT_TORQUE
else:
    __getattr__, __dir__ = lazy_face(__name__)
