"""Stage 5 with torque pulses or coast-down: every way of the plan, and the calm behind each.

A powered way follows its reference like any other motion. Coasting is zero torque until the shaft, by what the reports
may be late, is about to reach its lower speed; time alone would have to trust the rough friction.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.drive import Command, Mode
from tdhil.protocol.control import MeanSpeedControl
from tdhil.recording.recording import Excitation
from tdhil.run.control_loop import Bench
from tdhil.run.excitation import RigGuess
from tdhil.run.excitation.pulses import CALM_S, SwingPlan, Way
from tdhil.run.settings import ControlAssumptions, MachineLimits
from tdhil.run.stages.acquire import AcquireResult, Announce, Follower

_LONGEST = 2.0            # times the planned coasting, at most: friction may have been taken too high


def run_swings(
    bench: Bench,
    limits: MachineLimits,
    plan: SwingPlan,
    control: MeanSpeedControl | None,
    assumptions: ControlAssumptions,
    announce: Announce,
) -> AcquireResult:
    """All of it. Raises what the bench raises. The slow loop stands still while the shaft coasts."""
    excitation = Excitation(plan.kind, plan.mode)
    announce(excitation)
    follower = Follower(bench, limits, Mode(plan.mode), control)
    follower.follow(_calm(plan.start_rad_s, plan.guess), CALM_S)
    for way in plan.ways:
        if way.coasting:
            _coast(bench, way, follower, assumptions)
            follower.follow(_calm(way.to_rad_s, plan.guess), CALM_S)
        else:
            follower.follow(way.reference, way.duration_s + CALM_S)
    return AcquireResult(excitation)


def _calm(speed_rad_s: float, guess: RigGuess) -> Callable[[float], tuple[float, float]]:
    steady = speed_rad_s, guess.steady_torque_nm(speed_rad_s)
    return lambda _: steady


def _coast(bench: Bench, way: Way, follower: Follower, assumptions: ControlAssumptions) -> None:
    """Zero torque down to the lower speed."""
    command = Command(Mode.TORQUE, way.to_rad_s, 0.0)
    # The report comes late, so that the shaft is slower already: by half of the longest plausible lag, say.
    late_s = 0.5 * assumptions.largest_speed_lag_s + bench.period_s
    stop_at = way.to_rad_s + late_s * way.guess.steady_torque_nm(way.to_rad_s) / way.guess.inertia_kg_m2
    end_s = follower.time_s + _LONGEST * way.duration_s
    while follower.time_s < end_s:
        sample = bench.cycle(command)
        follower.saw(sample, way.to_rad_s)
        if sample.fresh and sample.speed_rad_s <= stop_at:
            return
