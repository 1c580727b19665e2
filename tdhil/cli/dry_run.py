"""`--dry-run`: the plan of a run and what may be expected of it. Connects to nothing, moves nothing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from profiles.quantities import RPM
from tdhil.cli.results import print_json
from tdhil.config import Rig, RunOptions
from tdhil.session import BEFORE_ACQUIRE_S, Figure, plan_course, plan_document, plan_dry
from tdhil.version import __version__

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tdhil.runner import MachineLimits, Planned
    from tdhil.session import Connection
    from tdhil.soft_torque import EvaluationCase


def dry_run(
    options: RunOptions, rig: Rig | None, simulated: bool, can_torque: bool = True, lets_go: bool = False
) -> int:
    """Plan and print; exit code 0. Raises PreflightRefused where there is nothing to plan, as a run would.

    ``can_torque``: the drive can regulate torque; without it stage 5 is planned in speed mode. ``lets_go``: by its
    profile the drive's torque is off after a quick stop.
    """
    planned, figures, limits = plan_dry(options, rig, simulated, can_torque, lets_go)
    if options.json:
        plain = plan_document(planned, figures, limits)
        plain["simulated"] = simulated
        plain["converted"] = [list(row) for row in rig.conversions] if rig is not None else []
        print_json(plain)
        return 0
    from tdhil.report import SIMULATED, PlainConsole

    console = PlainConsole()
    if simulated:
        console.print(f"{SIMULATED}: the embedded rig, its own limits where rig.yaml has none", style="magenta")
    show(planned, figures, limits, console)
    for key, text, source in rig.conversions if rig is not None else ():
        console.print(f"{key}: {text}  ({source})", markup=False)
    return 0


def dry_run_course(
    options: RunOptions, rig: Rig | None, case: EvaluationCase, simulated: bool, rate_hz: float
) -> int:
    """A virtual string's course within the limits; exit code 0. Raises what a run would raise before it moves."""
    program, limits = plan_course(case, rig, simulated, rate_hz)
    ratio = case.rig.gear_ratio
    plain = {
        "dry_run": True, "controller": case.prediction.kind, "rate_hz": rate_hz,
        "set_speed_rad_s": {"min": program.start_rad_s, "max": program.highest_rad_s},
        "moving_torque_nm": program.peak_nm * case.scale, "duration_s": program.longest_s,
        "limits": {"speed_min_rad_s": limits.speed_min_rad_s, "speed_max_rad_s": limits.speed_max_rad_s,
                   "torque_nm": limits.torque_nm, "time_s": limits.time_s},
        "tdhil": __version__,
    }
    if options.json:
        print_json(plain)
        return 0
    from rich.text import Text

    from tdhil.report import PlainConsole

    console = PlainConsole()
    console.print(Text("DRY RUN: nothing is connected to, nothing moves", style="magenta"))
    table = _table(f"stage 5: virtual string, {case.prediction.kind} controller, {rate_hz:g} cycles a second")
    for heading in ("", "planned", "limit"):
        table.add_column(heading, overflow="fold")
    table.add_row(
        "set speed", f"{RPM.of_si(program.start_rad_s):.1f} to at most {RPM.of_si(program.highest_rad_s):.1f} rpm, "
        "main shaft", f"{RPM.of_si(limits.speed_min_rad_s / ratio):.4g} to "
        f"{RPM.of_si(limits.speed_max_rad_s / ratio):.4g} rpm for the top's swing",
    )
    table.add_row("torque on the rotor", f"up to {plain['moving_torque_nm']:.0f} N·m, and friction",
                  f"±{limits.torque_nm:g} N·m")
    table.add_row("time, s", f"{program.longest_s:.0f} at the longest (+ about {BEFORE_ACQUIRE_S:.0f})",
                  f"{limits.time_s:g}")
    console.print(table)
    return 0


def say_unreachable(options: RunOptions, rig: Rig | None, connection: Connection, simulated: bool) -> str | None:
    """Before anything moves: that --tolerance is not to be expected, and the least that is; None where it may be.

    On the rig as rig.yaml expects it, or as it suits its drive: what the run measures decides in the end.
    """
    from drivers import PreflightRefused

    if not options.given("tolerance"):
        return None
    try:
        planned, figures, _ = plan_dry(
            options, rig, simulated, connection.profile.can_torque, connection.profile.quick_stop.ends == "off"
        )
    except PreflightRefused:
        return None         # a rig that is only assumed refuses nothing
    if planned.stopping is None or planned.stopping.reachable:
        return None
    assumed = " (a rig that is assumed; `expected:` in rig.yaml says more)"
    return (f"--tolerance: {_conclusions(planned)[1]}. The least to be expected is "
            f"±{100.0 * planned.half_width:.2g} % after {planned.duration_s:.0f} s"
            f"{assumed if any(figure.source == 'assumed' for figure in figures) else ''}")


def show(planned: Planned, figures: tuple[Figure, ...], limits: MachineLimits, console: Console) -> None:
    """Tables for people, in 80 columns."""
    from rich.text import Text

    console.print(Text("DRY RUN: nothing is connected to, nothing moves", style="magenta"))
    console.print(_motion_table(planned, limits))
    if lines := planned.plan.lines():
        console.print(_lines_table(lines))
    console.print(_figures_table(figures))
    for text in _conclusions(planned):
        console.print(Text(text))


def _motion_table(planned: Planned, limits: MachineLimits) -> Table:
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
    for where, what in plan.parts():
        table.add_row(where, what, "")
    return table


def _lines_table(lines: list[tuple[float, float]]) -> Table:
    table = _table("lines")
    table.add_column("Hz", justify="right")
    table.add_column("amplitude, rad/s", justify="right")
    for hertz, amplitude in lines:
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
    from tdhil.runner import NOT_PREDICTED, NOTHING_TO_EXPECT

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
