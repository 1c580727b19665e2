"""What is known of the lags in what a drive reports: from rig.yaml, the drive's own filters, and timing. Pure."""

import math
from dataclasses import replace

from drivers.drive import ReportingFilters
from tdhil.recording.recording import LagPrior
from tdhil.run.settings import ControlAssumptions

READ_FILTER_SD_SHARE = 0.1
READ_FILTER_SD_S = 0.001
"""How exactly a filter setting that the drive tells is the lag that it causes."""


def with_read_filters(prior: LagPrior, filters: ReportingFilters) -> LagPrior:
    """What rig.yaml states goes before what the drive tells of itself."""
    speed, torque = prior.speed_lag_s, prior.torque_lag_s
    sources = [prior.source] if prior.source else []
    if speed is None and filters.speed_lag_s is not None:
        sd = READ_FILTER_SD_SHARE * filters.speed_lag_s + READ_FILTER_SD_S
        prior = replace(prior, speed_lag_s=filters.speed_lag_s, speed_lag_sd_s=sd)
    if torque is None and filters.torque_lag_s is not None:
        sd = READ_FILTER_SD_SHARE * filters.torque_lag_s + READ_FILTER_SD_S
        prior = replace(prior, torque_lag_s=filters.torque_lag_s, torque_lag_sd_s=sd)
    if filters.source:
        sources.append(filters.source)
    return replace(prior, source="; ".join(sources))


def with_known_lag(assumptions: ControlAssumptions, prior: LagPrior) -> ControlAssumptions:
    """Reports that are known to lag further than usual are reckoned with by guard, control and stop."""
    known_s = 0.0 if prior.speed_lag_s is None else prior.speed_lag_s + 2.0 * prior.speed_lag_sd_s
    return replace(assumptions, largest_speed_lag_s=max(assumptions.largest_speed_lag_s, known_s))


def with_timing(prior: LagPrior, half_width_s: float) -> LagPrior:
    """A sample's time may be off by so many seconds; torque and speed may be apart by as much."""
    return replace(prior, skew_sd_s=math.hypot(prior.skew_sd_s, half_width_s))
