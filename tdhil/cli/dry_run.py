"""`--dry-run`: the plan of a run and its expected result. Nothing is connected and nothing moves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from profiles.quantities import RPM, in_nm
from tdhil.cli.results import print_json
from tdhil.config import Rig, RunOptions
from tdhil.session import BEFORE_ACQUIRE_S, Figure, plan_course, plan_document, plan_dry, plan_dry_steps
from tdhil.version import __version__

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from profiles import Profile
    from tdhil.runner import MachineLimits, Planned
    from tdhil.soft_torque import EvaluationCase
    from tdhil.speed_loop import StepCase


def _shown_limits(limits: MachineLimits) -> dict[str, float]:
    return {"speed_min_rad_s": limits.speed_min_rad_s, "speed_max_rad_s": limits.speed_max_rad_s,
            "torque_nm": limits.torque_nm, "time_s": limits.time_s}


def dry_run(options: RunOptions, rig: Rig | None, simulated: bool, profile: Profile) -> int:
    """Plan and print; exit code 0. Raises PreflightRefused if no plan is possible, as a run would."""
    from tdhil.report import working

    with working("planning …"):
        planned, figures, limits = plan_dry(options, rig, simulated, profile)
    if options.json:
        plain = plan_document(planned, figures, limits)
        plain["simulated"] = simulated
        plain["converted"] = [list(row) for row in rig.conversions] if rig is not None else []
        print_json(plain)
        return 0
    from tdhil.report import SIMULATED, PlainConsole

    console = PlainConsole()
    if simulated:
        console.print(f"{SIMULATED}: the simulated rig, with its own limits if rig.yaml has none", style="magenta")
    show(planned, figures, limits, console)
    for key, text, source in rig.conversions if rig is not None else ():
        console.print(f"{key}: {text}  ({source})", markup=False)
    return 0


def dry_run_case(
    options: RunOptions, rig: Rig | None, case: EvaluationCase | StepCase, simulated: bool, rate_hz: float
) -> int:
    """Print the plan of a virtual string, or of steps of the set speed; exit code 0.

    Raises the errors that a run would raise before motion.
    """
    from tdhil.speed_loop import StepCase

    if isinstance(case, StepCase):
        return _dry_run_steps(options, rig, case, simulated, rate_hz)
    return _dry_run_course(options, rig, case, simulated, rate_hz)


def _dry_run_steps(
    options: RunOptions, rig: Rig | None, case: StepCase, simulated: bool, rate_hz: float
) -> int:
    program, limits = plan_dry_steps(case, rig, simulated, rate_hz, options.highest_speed_rad_s)
    step_torque_nm = case.gains.gain_nm_s_rad * program.step_rad_s
    plain = {
        "dry_run": True, "gains": case.kind, "rate_hz": rate_hz, "pairs": program.pairs,
        "step_rad_s": program.step_rad_s, "low_rad_s": program.low_rad_s, "high_rad_s": program.high_rad_s,
        "step_torque_nm": step_torque_nm, "duration_s": program.duration_s,
        "limits": _shown_limits(limits),
        "tdhil": __version__,
    }
    if options.json:
        print_json(plain)
        return 0
    from tdhil.report import SIMULATED, PlainConsole
    from tdhil.runner.stages import MOST_LONGER

    console = PlainConsole()
    console.print("DRY RUN: nothing is connected, nothing moves", style="magenta")
    if simulated:
        console.print(f"{SIMULATED}: the simulated rig, with its own limits if rig.yaml has none", style="magenta")
    console.print(
        f"{program.pairs} pairs of steps of at most {program.step_rad_s:.3g} rad/s ({in_nm(step_torque_nm)}) "
        f"between {program.low_rad_s:.3g} and {program.high_rad_s:.3g} rad/s, {program.duration_s:.0f} s; limits "
        f"{limits.speed_min_rad_s:g} to {limits.speed_max_rad_s:g} rad/s, {limits.torque_nm:g} N·m, "
        f"{limits.time_s:g} s. A run first measures friction, and then plans again. If P or I is not known well enough "
        f"after these pairs, more follow: at most {MOST_LONGER:g} times as many in total, within the time limit.")
    return 0


def _dry_run_course(
    options: RunOptions, rig: Rig | None, case: EvaluationCase, simulated: bool, rate_hz: float
) -> int:
    program, limits = plan_course(case, rig, simulated, rate_hz, options.highest_speed_rad_s)
    ratio, moving_torque_nm = case.rig.gear_ratio, program.peak_nm * case.scale
    plain = {
        "dry_run": True, "controller": case.prediction.kind, "rate_hz": rate_hz,
        "set_speed_rad_s": {"min": program.start_rad_s, "max": program.highest_rad_s},
        "moving_torque_nm": moving_torque_nm, "duration_s": program.longest_s,
        "limits": _shown_limits(limits),
        "tdhil": __version__,
    }
    if options.json:
        print_json(plain)
        return 0
    from rich.text import Text

    from tdhil.report import PlainConsole

    console = PlainConsole()
    console.print(Text("DRY RUN: nothing is connected, nothing moves", style="magenta"))
    table = _table(f"stage 5: virtual string, {case.prediction.kind} controller, {rate_hz:g} cycles per second")
    for heading in ("", "planned", "limit"):
        table.add_column(heading, overflow="fold")
    table.add_row(
        "set speed", f"{RPM.of_si(program.start_rad_s):.1f} to at most {RPM.of_si(program.highest_rad_s):.1f} rpm, "
        "main shaft", f"{RPM.of_si(limits.speed_min_rad_s / ratio):.4g} to "
        f"{RPM.of_si(limits.speed_max_rad_s / ratio):.4g} rpm for the oscillation of the top",
    )
    table.add_row("torque on the rotor", f"up to {in_nm(moving_torque_nm)}, and friction",
                  f"±{limits.torque_nm:g} N·m")
    table.add_row("time, s", f"{program.longest_s:.0f} at most (+ about {BEFORE_ACQUIRE_S:.0f})",
                  f"{limits.time_s:g}")
    console.print(table)
    return 0


def say_before(options: RunOptions, rig: Rig | None, profile: Profile, simulated: bool) -> str | None:
    """Return, before motion, that no interval is expected or that --tolerance can't be reached; else None.

    It refers to the rig that rig.yaml expects, or to a typical one. The measured values of the run are decisive.
    """
    from drivers import PreflightRefused

    if not options.given("tolerance") and not options.given("frequency_hz"):
        return None
    try:
        planned, figures, _ = plan_dry(options, rig, simulated, profile)
    except PreflightRefused:
        return None         # an assumed rig is not a reason to refuse
    if math.isinf(planned.half_width):
        known = ", unless the drive reports its filters" if profile.filters else ""
        return (f"{_conclusions(planned)[0]}{known}. State the lags of the reports in rig.yaml (drive_data), or use"
                " --excitation multisine")
    if planned.stopping is None or planned.stopping.reachable:
        return None
    assumed = " (for an assumed rig; improve it with `expected:` in rig.yaml)"
    return (f"--tolerance: {_conclusions(planned)[1]}. The least possible value is "
            f"±{100.0 * planned.half_width:.2g} % after {planned.duration_s:.0f} s"
            f"{assumed if any(figure.source == 'assumed' for figure in figures) else ''}")


def show(planned: Planned, figures: tuple[Figure, ...], limits: MachineLimits, console: Console) -> None:
    """Print tables, in 80 columns."""
    from rich.text import Text

    console.print(Text("DRY RUN: nothing is connected, nothing moves", style="magenta"))
    plan = planned.plan
    table = _table(f"stage 5: {plan.kind} in {plan.mode} mode")
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
    console.print(table)
    if lines := plan.lines():
        table = _table("lines")
        table.add_column("Hz", justify="right")
        table.add_column("amplitude, rad/s", justify="right")
        for hertz, amplitude in lines:
            table.add_row(f"{hertz:.4g}", f"{amplitude:.3g}")
        console.print(table)
    table = _table("assumptions")
    for heading in ("", "value", "from"):
        table.add_column(heading, overflow="fold")
    for figure in figures:
        table.add_row(figure.name, figure.text,
                      Text("assumed", "yellow") if figure.source == "assumed" else figure.source)
    console.print(table)
    for text in _conclusions(planned):
        console.print(Text(text))
    if figures[0].source == "assumed":
        console.print(Text(f"J of {figures[0].text} is assumed from the limits. For a forecast of your machine, state "
                           "expected.inertia_kg_m2 in rig.yaml."))


def _conclusions(planned: Planned) -> list[str]:
    from tdhil.runner import NOT_PREDICTED, NOTHING_TO_EXPECT

    stopping = planned.stopping
    if not math.isfinite(planned.half_width):
        return [NOT_PREDICTED if math.isnan(planned.half_width) else NOTHING_TO_EXPECT]
    share = f"±{100.0 * planned.half_width:.2g} %"
    found = [f"expected interval of J: {share} after {planned.duration_s:.0f} s (repeatability)"]
    if stopping is not None and not stopping.reachable:
        found.append(f"±{100.0 * stopping.tolerance:.3g} % can't be reached: {stopping.advice}")
    elif stopping is not None:
        found.append(
            f"±{100.0 * stopping.tolerance:.3g} % requested: a pilot of {stopping.pilot_periods} periods at each mean "
            f"speed, about {stopping.expected_periods} in total; the scatter decides"
        )
    found.append("A run first measures friction, inertia and noise, and then plans again.")
    return found


def _table(title: str) -> Table:
    from rich.table import Table

    return Table(title=title, title_justify="left", expand=False)
