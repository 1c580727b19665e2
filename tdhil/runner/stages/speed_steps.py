"""Stages 4 and 5 of `tdhil tune verify`: small steps of the set speed, up and down, in the drive's own speed loop.

The step follows from the limits: its torque is a share of what friction leaves of the torque limit, its size a share of
the speed window. The guard checks every cycle. In addition, a speed that overshoots far more than predicted ends the
run.
"""

from __future__ import annotations

from drivers import Command, LimitHit, Mode, PreflightRefused
from profiles import MessageCode
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import RigGuess
from tdhil.runner.settings import MachineLimits
from tdhil.runner.stages.speed import mean_speeds
from tdhil.speed_loop import LEAST_PAIRS, StepCase, StepProgram, StepVerification, step_length_s

FEWEST_PAIRS, MOST_PAIRS, PAIRS_S = 24, 60, 160.0
"""Number of evaluated pairs of steps, and their time, s. Fast loops have smaller steps and need more pairs."""
MOST_LONGER, HOPELESS = 2.5, 4.7
"""Largest number of pairs if the intervals of P and I are still too wide, as a multiple of the planned one; and the
needed multiple above which even that number would not do: the half-width of ln P or ln I would stay above 0.22."""
TORQUE_SHARE = 0.45
"""Share of the torque between friction and limit that a step uses; noise and overshoot need the rest."""
SPEED_SHARE = 0.25
"""Largest step, as a share of the speed window."""
LEAST_COUNTS = 2
"""Least step, in counts of the reported speed."""
STEPS_RESERVE_S, BEFORE_S = 20.0, 100.0
"""Time that is reserved of the time limit, s: for the stop, and for stages 1 to 4."""
OVERSHOOTS = 3.0
"""Permitted overshoot, as a multiple of the predicted one, plus `OVERSHOOT_SHARE` of the step."""
OVERSHOOT_SHARE = 0.5
"""Part of the permitted overshoot that does not depend on the prediction, as a share of the step."""
STRANGE_COUNTS, STRANGE_SDS = 8.0, 6.0
"""Deviation that rounding and noise of the reported speed explain, in counts and in standard deviations."""


def plan_steps(
    case: StepCase, limits: MachineLimits, period_s: float, resolution_rad_s: float, left_s: float,
    friction_nm: float = 0.0,
) -> StepProgram:
    """Return the steps within the limits. Raises PreflightRefused if there is no room for them.

    ``left_s``: time that is left for them; ``friction_nm``: steady torque at the mean speed, 0 before it is known.
    """
    if limits.load != "none":
        raise _refused(f"steps of the set speed are requested, but load is {limits.load}", "load in rig.yaml",
                       "Verify the gains without the string")
    width = limits.speed_max_rad_s - limits.speed_min_rad_s
    torque_nm = TORQUE_SHARE * (limits.torque_nm - abs(friction_nm))
    step = min(SPEED_SHARE * width, torque_nm / case.gains.gain_nm_s_rad)
    if resolution_rad_s > 0.0:
        counts = int(step / resolution_rad_s)
        if counts < LEAST_COUNTS:
            raise _refused(
                f"the limits permit a step of {step:.3g} rad/s, and one count of the reported speed is"
                f" {resolution_rad_s:.3g} rad/s (at least {LEAST_COUNTS} counts are needed)",
                "limits.torque_nm in rig.yaml", "Raise it within the machine's limits, or tune for a lower --bandwidth")
        step = counts * resolution_rad_s
    half_s = max(2, round(step_length_s(case) / period_s)) * period_s
    pair_s = 2.0 * half_s
    wanted = min(MOST_PAIRS, max(FEWEST_PAIRS, int(PAIRS_S / pair_s)))
    pairs = min(wanted, int(left_s / pair_s) - 1)
    if pairs < LEAST_PAIRS:
        raise _refused(
            f"{LEAST_PAIRS} pairs of steps take {pair_s * (LEAST_PAIRS + 1):.0f} s, and the time limit leaves"
            f" {max(0.0, left_s):.0f} s", "limits.time_s in rig.yaml", "Raise it")
    low = limits.speed_min_rad_s + 0.5 * (width - step)
    return StepProgram(low, low + step, half_s, pairs, resolution_rad_s)


def plan_steps_before(
    case: StepCase, limits: MachineLimits, period_s: float, resolution_rad_s: float
) -> StepProgram:
    """Return the largest steps that the limits permit, before motion. Raises PreflightRefused if none fit, or if
    friction exceeds the torque limit.
    """
    fastest = mean_speeds(limits)[1]
    friction_nm = case.friction_nm(fastest)
    if friction_nm >= limits.torque_nm:
        raise _refused(
            f"steady rotation at {fastest:.3g} rad/s needs {friction_nm:.4g} N·m against friction, and the torque "
            f"limit is {limits.torque_nm:.4g} N·m", "limits in rig.yaml",
            "Raise limits.torque_nm within the machine's limits, or lower limits.speed_max_rad_s")
    middle = 0.5 * (limits.speed_min_rad_s + limits.speed_max_rad_s)
    return plan_steps(case, limits, period_s, resolution_rad_s, limits.time_s - BEFORE_S - STEPS_RESERVE_S,
                      case.friction_nm(middle))


def refuse_other_shaft(case: StepCase, model: RigGuess) -> None:
    """Raise PreflightRefused if the turning shaft can't be the shaft for which the gains were tuned."""
    tuned = case.plant.believed.total_inertia_kg_m2
    if model.excludes(tuned):
        raise _refused(
            f"the gains were tuned for {tuned:.4g} kg·m² at the motor, and this shaft has about"
            f" {model.inertia_kg_m2:.4g}", case.source or "tune.json", "Identify this rig, then tune with that result")


def _refused(what: str, where: str, next_step: str) -> PreflightRefused:
    return PreflightRefused(what, where=where, next_step=next_step, entry=MessageCode.VERIFICATION_REFUSED)


def further_pairs(found: StepVerification, program: StepProgram, left_s: float) -> int:
    """Return the number of further pairs from which P and I may be known well enough; 0 if they are, or if none helps.

    ``left_s``: time that is left for them, and for one more pair that does not count.
    """
    needed = found.needed_pairs
    if needed is None or needed > HOPELESS * program.pairs:
        return 0
    more = min(needed, int(MOST_LONGER * program.pairs)) - program.pairs
    return more if 2.0 * program.half_s * (more + 1) <= left_s else 0


class SpeedSteps:
    """Steps of stage 5, pair by pair, from steady rotation at the lower speed. ``starts_s``: of all steps that count.

    ``noise_rad_s``: standard deviation of the reported speed.
    """

    def __init__(
        self, loop: ControlLoop, case: StepCase, program: StepProgram, resolution_rad_s: float, noise_rad_s: float
    ) -> None:
        self.starts_s: list[float] = []
        self._loop = loop
        self._program = program
        self._cycles = loop.cycles(program.half_s)
        self._allowed = (OVERSHOOTS * case.overshoot_share.high + OVERSHOOT_SHARE) * program.step_rad_s + max(
            STRANGE_COUNTS * resolution_rad_s, STRANGE_SDS * noise_rad_s)

    def run_pair(self, number: int, *, counts: bool = True) -> None:
        """Run a step up and the step down. Raises LimitHit if the speed overshoots, and what the bench raises."""
        program, allowed = self._program, self._allowed
        for speed in program.speeds_rad_s(number):
            for at in range(self._cycles):
                sample = self._loop.cycle(Command(Mode.SPEED, speed, 0.0))
                if at == 0 and counts:
                    self.starts_s.append(sample.time_s)
                if not program.low_rad_s - allowed <= sample.speed_rad_s <= program.high_rad_s + allowed:
                    raise LimitHit(
                        f"speed {sample.speed_rad_s:.3f} rad/s after a step from {program.low_rad_s:.3f} to"
                        f" {program.high_rad_s:.3f} rad/s: the overshoot is above the limit of {allowed:.3g} rad/s",
                        where=f"step at {sample.time_s:.1f} s", stops=True,
                        next_step="Compare the gains in the drive with the tuned ones. If they agree, lower I",
                        entry=MessageCode.STEP_OVERSHOOTS)
