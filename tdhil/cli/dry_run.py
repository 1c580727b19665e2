"""`tdhil identify --dry-run`: the plan and what may be expected of it. Connects to nothing, moves nothing."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from profiles.quantities import RPM
from tdhil.config.options import RunOptions
from tdhil.config.rig import Rig
from tdhil.session.plan_ahead import BEFORE_ACQUIRE_S, Figure, plan_dry
from tdhil.version import __version__

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tdhil.run.excitation import Plan
    from tdhil.run.planning import Planned
    from tdhil.run.settings import MachineLimits


def dry_run(
    options: RunOptions, rig: Rig | None, simulated: bool, can_torque: bool = True, lets_go: bool = False
) -> int:
    """Plan and print; exit code 0. Raises PreflightRefused where there is nothing to plan, as a run would.

    ``can_torque``: the drive can regulate torque; without it stage 5 is planned in speed mode. ``lets_go``: by its
    profile the drive's torque is off after a quick stop.
    """
    planned, figures, limits = plan_dry(options, rig, simulated, can_torque, lets_go)
    if options.json:
        plain = document(planned, figures, limits)
        plain["converted"] = [list(row) for row in rig.conversions] if rig is not None else []
        json.dump(plain, sys.stdout, ensure_ascii=False, indent=2, allow_nan=False)
        sys.stdout.write("\n")
        return 0
    from tdhil.report.console import PlainConsole

    console = PlainConsole()
    show(planned, figures, limits, console)
    for key, text, source in rig.conversions if rig is not None else ():
        console.print(f"{key}: {text}  ({source})", markup=False)
    return 0


def document(planned: Planned, figures: tuple[Figure, ...], limits: MachineLimits) -> dict[str, Any]:
    """The plan as plain data."""
    from tdhil.run.excitation import SwingPlan

    plan, stopping = planned.plan, planned.stopping
    return {
        "dry_run": True,
        "excitation": plan.kind,
        "mode": plan.mode,
        "segments": [
            {
                "offset_rad_s": one.reference.offset_rad_s,
                "period_s": one.reference.period_s,
                "periods": one.periods,
                "settle_periods": one.settle_periods,
                "lines_hz": list(one.reference.lines_hz),
                "amplitudes_rad_s": list(one.reference.amplitudes_rad_s),
            }
            for one in plan.segments
        ] if not isinstance(plan, SwingPlan) else [],
        "ways": [
            {"from_rad_s": way.from_rad_s, "to_rad_s": way.to_rad_s, "duration_s": way.duration_s,
             "coasting": way.coasting}
            for way in plan.ways
        ] if isinstance(plan, SwingPlan) else [],
        "duration_s": planned.duration_s,
        "speed_rad_s": {"min": plan.speed_min_rad_s, "max": plan.speed_max_rad_s},
        "torque_nm": {"min": plan.torque_min_nm, "max": plan.torque_max_nm},
        "limits": {
            "speed_min_rad_s": limits.speed_min_rad_s,
            "speed_max_rad_s": limits.speed_max_rad_s,
            "torque_nm": limits.torque_nm,
        },
        "rests_on": [asdict(figure) for figure in figures],
        "expected_half_width": planned.half_width if math.isfinite(planned.half_width) else None,
        "stopping": None if stopping is None else stopping.plain(),
        "tdhil": __version__,
    }


def show(planned: Planned, figures: tuple[Figure, ...], limits: MachineLimits, console: Console) -> None:
    """Tables for people, in 80 columns."""
    from rich.text import Text

    from tdhil.run.excitation import SwingPlan

    console.print(Text("DRY RUN: nothing is connected to, nothing moves", style="magenta"))
    console.print(_motion_table(planned, limits))
    if not isinstance(planned.plan, SwingPlan):
        console.print(_lines_table(planned.plan))
    console.print(_figures_table(figures))
    for text in _conclusions(planned):
        console.print(Text(text))


def _motion_table(planned: Planned, limits: MachineLimits) -> Table:
    from tdhil.run.excitation import SwingPlan
    from tdhil.run.excitation.pulses import CALM_S

    plan, table = planned.plan, _table(f"stage 5: {planned.plan.kind} in {planned.plan.mode} mode")
    for heading in ("", "planned", "limit"):
        table.add_column(heading, overflow="fold")
    table.add_row(
        "speed, rad/s", f"{plan.speed_min_rad_s:.3g} to {plan.speed_max_rad_s:.3g}",
        f"{limits.speed_min_rad_s:.4g} to {limits.speed_max_rad_s:.4g}\n"
        f"{RPM.of_si(limits.speed_min_rad_s):.4g} to {RPM.of_si(limits.speed_max_rad_s):.4g} rpm",
    )
    table.add_row(
        "torque, N·m", f"{plan.torque_min_nm:.3g} to {plan.torque_max_nm:.3g}", f"±{limits.torque_nm:g}"
    )
    table.add_row("time, s", f"{planned.duration_s:.0f} (+ about {BEFORE_ACQUIRE_S:.0f})", f"{limits.time_s:g}")
    if isinstance(plan, SwingPlan):
        ways = f"{len(plan.ways)} ways up and down, each with {CALM_S:g} s of calm behind it"
        table.add_row(f"{plan.speed_min_rad_s:.3g} to {plan.speed_max_rad_s:.3g} rad/s", ways, "")
        return table
    for one in plan.segments:
        counted = f"{one.periods} periods of {one.reference.period_s:.3g} s, {one.settle_periods} to settle"
        table.add_row(f"at {one.reference.offset_rad_s:.3g} rad/s", counted, "")
    return table


def _lines_table(plan: Plan) -> Table:
    reference, table = plan.segments[0].reference, _table("lines")
    table.add_column("Hz", justify="right")
    table.add_column("amplitude, rad/s", justify="right")
    for hertz, amplitude in zip(reference.lines_hz, reference.amplitudes_rad_s, strict=True):
        table.add_row(f"{hertz:.4g}", f"{amplitude:.3g}")
    return table


def _figures_table(figures: tuple[Figure, ...]) -> Table:
    from rich.text import Text

    table = _table("it rests on")
    for heading in ("", "value", "from"):
        table.add_column(heading, overflow="fold")
    for figure in figures:
        assumed = figure.source == "assumed"
        table.add_row(figure.name, figure.text, Text("assumed", "yellow") if assumed else figure.source)
    return table


def _conclusions(planned: Planned) -> list[str]:
    from tdhil.run.planning import NOT_PREDICTED, NOTHING_TO_EXPECT

    stopping = planned.stopping
    if not math.isfinite(planned.half_width):
        return [NOT_PREDICTED if math.isnan(planned.half_width) else NOTHING_TO_EXPECT]
    share = f"±{100.0 * planned.half_width:.2g} %"
    found = [f"expected interval of J: {share} after {planned.duration_s:.0f} s (repeatability)"]
    if stopping is not None and not stopping.reachable:
        found.append(f"±{100.0 * stopping.tolerance:.3g} % is not to be expected: {stopping.advice}")
    elif stopping is not None:
        found.append(
            f"±{100.0 * stopping.tolerance:.3g} % asked for: a pilot of {stopping.pilot_periods} periods at each mean "
            f"speed, some {stopping.expected_periods} in all; the scatter decides"
        )
    found.append("A run measures friction, inertia and noise first, and plans again from that.")
    return found


def _table(title: str) -> Table:
    from rich.table import Table

    return Table(title=title, title_justify="left", expand=False)
