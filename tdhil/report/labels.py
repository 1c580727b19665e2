"""Labels of the result: each quantity has one name in card, report, trend and pages, defined in the glossary.

The keys of the JSON document are a contract and differ from some labels: ``skew_s``, ``second_opinions``, ``paper``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Label:
    """Name and unit of one estimate. ``on_card``: name for a column of only 20 characters."""

    key: str
    name: str
    on_card: str
    unit: str


ESTIMATES: Final = (
    Label("viscous_nm_s_rad", "viscous friction B", "viscous friction B", "N·m·s/rad"),
    Label("coulomb_nm", "Coulomb friction T_c, constant load included", "Coulomb friction T_c", "N·m"),
    Label("speed_lag_s", "lag of the reported speed", "lag, reported speed", "s"),
    Label("torque_lag_s", "lag of the reported torque", "lag, reported torque", "s"),
    Label("skew_s", "time offset between speed and torque", "time offset", "s"),
)
BACKLASH: Final = Label("play_rad", "backlash, from flank to flank at the motor shaft", "backlash", "mrad")
TORQUE_OVER_ANGLE: Final = "torque over angle"
UNCERTAINTY_BUDGET: Final = "uncertainty budget"
MOMENTUM_CROSS_CHECK: Final = "momentum cross-check"
ACCELERATION_REGRESSION: Final = "acceleration regression (Xu 2026)"
