"""One tone at a time: not identifiable with nothing known of the lags, and with the joint fit's lags one J for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation import Estimate, Identification, Options, identify
from tdhil.recording.recording import LagPrior, Recording
from tdhil.studies.study import Cell, ResultTable, Statement
from tdhil.study.coverage_said import normal_quantile

SPREAD = 0.01
"""How far apart the tones' inertias may be, as a share of their mean; the paper's slopes are 76 % apart."""


@dataclass(frozen=True)
class Alone:
    """A tone by itself: with nothing known of the lags, and with them stated."""

    hertz: float
    unknown: Identification
    stated: Identification


def stated_lags(joint: Identification, confidence: float) -> LagPrior | None:
    """The joint fit's lags as a drive would state them; None where it has none."""
    if joint.speed_lag_s is None or joint.torque_lag_s is None:
        return None
    speed, torque = joint.speed_lag_s, joint.torque_lag_s
    return LagPrior(
        speed.value, _sd(speed, confidence), torque.value, _sd(torque, confidence), "the joint fit of all tones"
    )


def _sd(one: Estimate, confidence: float) -> float:
    return 0.5 * (one.high - one.low) / normal_quantile(confidence)


def each_alone(recordings: Sequence[Recording], joint: Identification, confidence: float) -> tuple[Alone, ...]:
    """Every recording identified by itself, twice; () without a joint fit."""
    prior = stated_lags(joint, confidence)
    if prior is None:
        return ()
    found = []
    for recording in recordings:
        if recording.excitation is None:
            continue
        hertz = recording.excitation.segments[0].lines_hz[0]
        options = Options(confidence=confidence)
        found.append(Alone(hertz, identify(recording, options), identify(replace(recording, lag_prior=prior), options)))
    return tuple(found)


def alone_table(found: Sequence[Alone]) -> ResultTable:
    """One row a tone."""
    rows: list[tuple[Cell, ...]] = []
    for one in found:
        inertia = one.stated.inertia
        values = (None, None, None) if inertia is None else (inertia.value, inertia.low, inertia.high)
        rows.append((one.hertz, one.unknown.verdict.value, one.stated.verdict.value, *values))
    columns = ("frequency_hz", "verdict_nothing_known", "verdict_lags_stated", "inertia_kg_m2", "low", "high")
    return ResultTable("one_tone_alone", columns, tuple(rows))


def alone_statements(found: Sequence[Alone], true_inertia: float) -> list[Statement]:
    """Refused where nothing is known; one J where the lags are."""
    if not found:
        return []
    refused = [one.unknown.inertia is None for one in found]
    inertias = [one.stated.inertia for one in found if one.stated.inertia is not None]
    values = np.array([inertia.value for inertia in inertias])
    spread = float(np.ptp(values) / values.mean()) if len(values) else float("nan")
    covered = sum(inertia.low <= true_inertia <= inertia.high for inertia in inertias)
    return [
        Statement(
            "one tone with nothing known of the lags identifies no inertia", "a number for each of four tones",
            f"{sum(refused)} of {len(found)} refused", all(refused),
        ),
        Statement(
            f"each tone alone, the joint fit's lags stated: one inertia, within {SPREAD:.0%}",
            "76 % from the lowest tone to the highest",
            f"{', '.join(f'{value:.2f}' for value in values)} kg·m²: {spread:.2%} apart; {covered} of {len(found)} "
            "intervals cover the rig's",
            len(inertias) == len(found) and spread <= SPREAD and covered == len(found),
        ),
    ]
