"""`tdhil identify --dry-run`: the plan and what may be expected of it. Connects to nothing, moves nothing."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from drivers.drive import Identity
from drivers.errors import PreflightRefused
from profiles.quantities import RPM
from tdhil import __version__
from tdhil.cli.task import bench_of, excitation_request, lag_prior, machine_limits
from tdhil.config.options import RunOptions
from tdhil.config.rig import Rig, simulated_default_rig

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tdhil.run import excitation
    from tdhil.run.design import Knowledge
    from tdhil.run.excitation import Plan, RigGuess
    from tdhil.run.planning import Planned
    from tdhil.run.settings import MachineLimits

SPIN_UP_S = 2.5             # assumed J: the torque limit would take so long through the speed window
VISCOUS_SHARE = 0.2         # assumed friction at the highest speed, of the torque limit, …
COULOMB_SHARE = 0.15        # … and at standstill
BEFORE_ACQUIRE_S = 90.0     # stages 1 to 4, about


@dataclass(frozen=True)
class Figure:
    """One thing that the plan rests on. ``source``: assumed, or where it stands in rig.yaml."""

    name: str
    value: float
    unit: str
    source: str

    @property
    def text(self) -> str:
        return f"{self.value:.4g} {self.unit}"


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


def plan_dry(
    options: RunOptions, rig: Rig | None, simulated: bool, can_torque: bool = True, lets_go: bool = False
) -> tuple[Planned, tuple[Figure, ...], MachineLimits]:
    """The plan, what it rests on, and the machine's limits."""
    from tdhil.run.excitation import PlanRefused
    from tdhil.run.planning import plan_acquisition
    from tdhil.run.preconditions import refuse_by_plan

    bench = bench_of(Identity(0, 0, 0, 0, "", simulated), rig)
    limits = machine_limits(bench)
    refuse_by_plan(limits, excitation_request(options), lets_go)
    guess, known, figures = _assumed(bench, limits)
    left_s = limits.time_s - BEFORE_ACQUIRE_S
    try:
        planned = plan_acquisition(
            excitation_request(options), _mode(options, can_torque), _room(options, limits), guess, known, left_s
        )
    except PlanRefused as error:
        raise PreflightRefused(
            str(error), where="plan of stage 5", next_step=error.next_step
        ) from error
    return planned, figures, limits


def refuse_hopeless(options: RunOptions, rig: Rig | None, can_torque: bool) -> None:
    """Before a run touches its drive: PreflightRefused for what no shaft could do within the limits.

    Nothing is known of the shaft yet, nor whether it is a simulated one, whose limits need not be given.
    """
    from tdhil.run import planning
    from tdhil.run.excitation import PlanRefused

    bench = simulated_default_rig(rig)
    limits = machine_limits(bench)
    modes = (options.mode,) if options.mode else ("torque", "speed") if can_torque else ("speed",)
    guess, known, _ = _assumed(bench, limits)
    try:
        planning.refuse_hopeless(excitation_request(options), modes, _room(options, limits), guess, known)
    except PlanRefused as error:
        raise PreflightRefused(str(error), where="plan of stage 5", next_step=error.next_step) from error


def _mode(options: RunOptions, can_torque: bool) -> str:
    wanted: str | None = options.mode
    if wanted == "torque" and not can_torque:
        raise PreflightRefused(
            "torque mode was asked for, but this drive has none that can be entered while it turns",
            where=f"profile {options.profile}",
            next_step="Use --mode speed",
        )
    return wanted or ("torque" if can_torque else "speed")


def _room(options: RunOptions, limits: MachineLimits) -> excitation.MachineLimits:
    """What a plan may use of the limits at the rate that was asked for."""
    from tdhil.run import excitation
    from tdhil.run.guard import Guard
    from tdhil.run.settings import ControlAssumptions

    assumptions = ControlAssumptions()
    if options.rate_hz:
        assumptions = assumptions.at_period(1.0 / options.rate_hz)
    return excitation.MachineLimits(
        limits.speed_min_rad_s, limits.speed_max_rad_s, limits.torque_nm, Guard.foresight_s(assumptions)
    )


def _assumed(bench: Rig, limits: MachineLimits) -> tuple[RigGuess, Knowledge, tuple[Figure, ...]]:
    """The rig, its noise and its lags, and what each of them rests on."""
    from tdhil.run.design import Knowledge, assumed_noise

    guess, figures = _guess(bench, limits)
    stated = bench.expected.load_noise_nm
    noise = assumed_noise(limits.torque_nm, limits.speed_max_rad_s, stated)
    known = Knowledge(noise, lag_prior(bench))
    return guess, known, (
        *figures,
        Figure("disturbing torque (sd)", noise.load_sd_nm, "N·m", _source(bench, "expected.load_noise_nm")),
        Figure("lag of reported speed", known.speed_lag_s, "s", _source(bench, "drive_data.speed_lag_s")),
        Figure("lag of reported torque", known.torque_lag_s, "s", _source(bench, "drive_data.torque_lag_s")),
    )


def _guess(bench: Rig, limits: MachineLimits) -> tuple[RigGuess, tuple[Figure, ...]]:
    """What rig.yaml expects of the shaft; for the rest, a shaft that suits its drive."""
    from tdhil.run.excitation import RigGuess

    expected = bench.expected
    window = limits.speed_max_rad_s - limits.speed_min_rad_s
    inertia = expected.inertia_kg_m2 or SPIN_UP_S * limits.torque_nm / window
    viscous, coulomb = expected.viscous_nm_s_rad, expected.coulomb_nm
    viscous = VISCOUS_SHARE * limits.torque_nm / limits.speed_max_rad_s if viscous is None else viscous
    coulomb = COULOMB_SHARE * limits.torque_nm if coulomb is None else coulomb
    return RigGuess(inertia, viscous, coulomb), (
        Figure("moment of inertia", inertia, "kg·m²", _source(bench, "expected.inertia_kg_m2")),
        Figure("viscous friction", viscous, "N·m·s/rad", _source(bench, "expected.viscous_nm_s_rad")),
        Figure("Coulomb friction", coulomb, "N·m", _source(bench, "expected.coulomb_nm")),
    )


def _source(bench: Rig, at: str) -> str:
    return "assumed" if bench.get(at) is None else bench.source(at) or "rig.yaml"


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
