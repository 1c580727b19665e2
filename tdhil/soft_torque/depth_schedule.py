"""Gain schedule over the depth of the well: tuned at each depth, and checked halfway between two depths.

As the well gets deeper, the topmost section of the string gets longer. The drive, or its operator, interpolates P, I
and J_c linearly between the rows. Halfway between two rows, the interpolated gains are checked like those of a row:
against the required margins, and by a simulation under bit noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

from tdhil.soft_torque.controller import SpeedController
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.recipes import compensated, soft, stiff
from tdhil.soft_torque.stability import LoopMargins
from tdhil.soft_torque.truth_margins import TruthMargins
from tdhil.soft_torque.tune_case import TuneCase
from tdhil.soft_torque.tuned_figures import string_modes_hz
from tdhil.soft_torque.tuning import best_by_simulation, noisy_cures
from tdhil.soft_torque.uncertainty import DrawnValues

ScheduledKind = Literal["soft", "compensated"]


@dataclass(frozen=True)
class DepthRow:
    """Gains at one depth. If they are refused, ``controller`` is None and ``refusal`` gives the reason."""

    depth_m: float
    """Length of the whole string."""
    mode_hz: float
    """Frequency of the lowest mode with the top held."""
    controller: SpeedController | None
    refusal: str = ""
    softness: float | None = None
    frequency_factor: float | None = None
    """Frequency factor φ. None, as for ``softness`` (a): the gains are interpolated."""
    worst: LoopMargins | None = None
    """Least value of each margin over all sampled truths."""
    failed: tuple[str, ...] = ()
    """Margins that are below the required ones on a sampled truth, with their values."""
    cure: DrawnValues | None = None
    """Critical speed under bit noise, rpm."""
    compared: DrawnValues | None = None
    """Critical speed under bit noise with the present gains, or with the stiff controller, rpm."""


@dataclass(frozen=True)
class DepthSchedule:
    """Gain schedule: rows from the shallowest depth to the deepest."""

    kind: ScheduledKind
    compared_with: str
    """Controller to which the critical speeds are compared: present, or stiff."""
    rows: tuple[DepthRow, ...]
    between: tuple[DepthRow, ...]
    """Rows with the interpolated gains, each halfway between two rows that both have gains."""


def at_depth(string: DrillString, depth_m: float) -> DrillString:
    """Return the string with a total length of ``depth_m``: its topmost section gets longer or shorter.

    Raises ValueError if the sections below the topmost one are longer than ``depth_m``.
    """
    first, *rest = string.lines
    length_m = depth_m - sum(line.length_m for line in rest)
    if length_m <= 0.0:
        raise ValueError(f"what hangs below the topmost section is {depth_m - length_m:.4g} m long")
    return replace(string, lines=(replace(first, length_m=length_m), *rest))


def schedule(
    case: TuneCase, depths_m: Sequence[float], kind: ScheduledKind, *, simulated: bool = True,
    report: Callable[[str], None] = lambda text: None,
) -> DepthSchedule:
    """Tune at each depth, and check the interpolated gains. Raises the errors of `at_depth` and `tune`.

    If ``simulated`` is False or no bit is stated, no critical speeds are computed. ``report`` receives progress texts.
    """
    rows, between = [], []
    for depth_m in depths_m:
        report(f"gains at {depth_m:.0f} m")
        rows.append(_row(replace(case, string=at_depth(case.string, depth_m)), depth_m, kind, simulated))
    for above, below in pairwise(rows):
        one, other = above.controller, below.controller
        if one is not None and other is not None:
            depth_m = 0.5 * (above.depth_m + below.depth_m)
            report(f"interpolated gains at {depth_m:.0f} m")
            own = replace(case, string=at_depth(case.string, depth_m))
            halfway = replace(
                one, gain_nm_s_rad=0.5 * (one.gain_nm_s_rad + other.gain_nm_s_rad),
                integral_nm_rad=0.5 * (one.integral_nm_rad + other.integral_nm_rad),
                compensated_kg_m2=0.5 * (one.compensated_kg_m2 + other.compensated_kg_m2))
            between.append(_judged(own, DepthRow(depth_m, string_modes_hz(own.string)[0], halfway), simulated))
    return DepthSchedule(kind, "present" if case.present is not None else "stiff", tuple(rows), tuple(between))


def _row(case: TuneCase, depth_m: float, kind: ScheduledKind, simulated: bool) -> DepthRow:
    held = string_modes_hz(case.string)
    samples = TruthMargins(case)
    pool = (soft if kind == "soft" else compensated)(case, held, samples)
    if simulated and case.string.bit is not None:
        pool = best_by_simulation([pool], samples, held)[0]
    best = pool[0]
    row = DepthRow(depth_m, held[0], best.controller, best.refusal, best.softness, best.frequency_factor)
    return row if row.controller is None else _judged(case, row, simulated, samples)


def _judged(case: TuneCase, row: DepthRow, simulated: bool, samples: TruthMargins | None = None) -> DepthRow:
    """Return the row with its margins, and its critical speeds if they are simulated."""
    assert row.controller is not None
    samples = samples or TruthMargins(case)
    worst = samples.every(row.controller)
    row = replace(row, worst=worst, failed=case.required.failed(worst))
    other = stiff(case).controller
    if not simulated or case.string.bit is None or (case.present is None and other is None):
        return row
    laws = [row.controller, None if case.present is not None else other]
    cure, compared = noisy_cures(samples.truths, laws, (row.mode_hz,))
    return replace(row, cure=cure, compared=compared)
