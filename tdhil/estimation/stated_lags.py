"""Check of the stated lags of the reports, after the data contradicted the model that was fitted with them.

A wrong lag in rig.yaml, or a filter that acts otherwise than the drive's object states, leaves residuals as a compliant
load does. So the recording is identified once more without the statement. If the data then allow the model, and give
another lag, the message names the statement. No J is given: the data can not show why the statement is wrong.
"""

import math
from collections.abc import Callable
from dataclasses import replace

from profiles.quantities import printed_interval
from tdhil.estimation.case import Case, Finding
from tdhil.estimation.result import Estimate, doubtful, normal_quantile
from tdhil.recording import LagPrior

_CLEAR_SD = 3.5           # standard deviations between a stated lag and that of the data


def with_lags_checked(case: Case, finding: Finding, again: Callable[[LagPrior], Finding]) -> Finding:
    """Return the finding; if the data contradict its model because of a stated lag, with a text that names this lag.

    ``again``: identifies the same samples with other knowledge of the lags. Raises Refused as it does.
    """
    stated = case.recording.lag_prior
    if not finding.rejected or (stated.speed_lag_s is None and stated.torque_lag_s is None):
        return finding
    free = again(LagPrior(skew_sd_s=stated.skew_sd_s))
    if free.inertia is None or doubtful(free.residual):
        return finding
    sources = [one.strip() for one in (stated.source or "the recording").split(";")]
    states, said = "states" if len(sources) == 1 else "state", []
    for lag_s, sd_s, seen, signal in (
        (stated.speed_lag_s, stated.speed_lag_sd_s, free.speed_lag_s, "speed"),
        (stated.torque_lag_s, stated.torque_lag_sd_s, free.torque_lag_s, "torque"),
    ):
        if lag_s is not None and seen is not None and _contradicts(lag_s, sd_s, seen, case.options.confidence):
            said.append(
                f". {' and '.join(sources)} {states} a lag of the reported {signal} of {lag_s:.3g} s ± {sd_s:.2g} s. "
                f"Without this statement the data give {seen.value:.3g} s ({printed_interval(seen.low, seen.high, 3)})")
    if not said:
        return finding
    words = replace(finding.words, if_rejected="check the filter in the drive, and correct the statement of the lag")
    return replace(finding, words=words, remark=finding.remark + "".join(said))


def _contradicts(lag_s: float, sd_s: float, seen: Estimate, confidence: float) -> bool:
    half = seen.value - seen.low if lag_s < seen.value else seen.high - seen.value
    return abs(lag_s - seen.value) > _CLEAR_SD * math.hypot(sd_s, half / normal_quantile(confidence))
