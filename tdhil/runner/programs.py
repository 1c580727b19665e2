"""The programs `identify` and `offset_impedance`, each a sequence of stages, and the stages that every program has.

`five_stages` connects and checks the drive before the program. The stop sequence follows, however the program ends.
The other two programs are in `virtual_string_program` and `speed_steps_program`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers import Command, Mode, Preflight, Sample
from profiles.quantities import in_nm
from tdhil.recording import Excitation, LagPrior, Ramp, RunLog
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import RigGuess
from tdhil.runner.guard import Guard
from tdhil.runner.interim import Identify, InertiaWatch
from tdhil.runner.planning import Planned, request_of
from tdhil.runner.preconditions import no_torque, with_timing
from tdhil.runner.settings import ControlAssumptions, MachineLimits
from tdhil.runner.speed_check import SpeedWitness
from tdhil.runner.stage_log import StageBook
from tdhil.runner.stage_planner import StagePlanner
from tdhil.runner.stages import (
    MeanSpeedControl,
    OffsetPlan,
    SpeedResult,
    TorqueResult,
    probe_sign,
    run_hold,
    run_offset,
    run_pilot,
    run_plan,
    run_speed,
    run_torque,
    slow_down,
)
from tdhil.runner.stop import QuickStopKind, StopSequence
from tdhil.runner.task import Confirm, ConfirmSpeed, Display, Say, Task

HOLD_AUTHORITY = 0.25
"""Share of the torque limit that the control of the mean speed may add; the same as the ramp of stage 4 needs."""
END_S = 10.0
"""Expected time of stage 5 beside its motion, s: transitions and fading. For the display only."""


def identify(run: Run) -> None:
    """Identify the moment of inertia, or measure the drive's own impedance through its speed reference."""
    begin_motion(run)                                                  # 1 setup, its end
    turning = turn(run)                                                # 2 speed
    drifted = switch_to_torque(run, turning)                           # 3 torque; skipped in speed mode
    planner = StagePlanner(run.loop, run.log, run.display, run.say)
    planned = planner.plan(run.task, turning.speed, run.mode, turning.prior)
    control = hold(run, turning, drifted, planned)                     # 4 hold; skipped in speed mode
    acquire(run, turning, drifted, planned, control, planner)          # 5 acquire


def offset_impedance(run: Run) -> None:
    """Measure the drive's own impedance with a torque offset, in its speed loop."""
    begin_motion(run)                                                  # 1 setup, its end
    turning = turn(run)                                                # 2 speed
    switch_to_torque(run, turning)                                     # 3 torque; skipped: the mode is speed
    plan = run_small_offset(run, turning)                              # 4 hold
    acquire_offset(run, turning, plan)                                 # 5 acquire


# ---------------------------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Run:
    """Data and functions that the stages of one run need. The drive is prepared, and stage 1 has begun.

    ``prior``: knowledge of the reporting lags at standstill. ``armed`` receives the stop sequence, which is due from
    then on. ``end_setup`` ends stage 1. ``identify`` returns the function that identifies the recording.
    """

    task: Task
    mode: Mode
    loop: ControlLoop
    preflight: Preflight
    torque_offset_nm: float
    prior: LagPrior
    book: StageBook
    log: RunLog
    display: Display
    say: Say
    confirm: Confirm
    confirm_speed: ConfirmSpeed
    armed: Callable[[StopSequence], None]
    end_setup: Callable[[], None]
    identify: Callable[[], Identify]

    @property
    def limits(self) -> MachineLimits:
        return self.task.limits

    @property
    def assumptions(self) -> ControlAssumptions:
        return self.task.assumptions

    @property
    def speed_resolution_rad_s(self) -> float:
        return self.preflight.speed_resolution_rad_s


@dataclass(frozen=True)
class Turning:
    """Result of stage 2. ``slow``: samples of steady rotation where stage 3 begins; empty in speed mode."""

    speed: SpeedResult
    slow: tuple[Sample, ...]
    prior: LagPrior

    @property
    def model(self) -> RigGuess:
        """Return the rough model of the rig, from the ramp of stage 2."""
        return self.speed.model


# ---------------------------------------------------------------------------------------------------------------------
# Stages 1 to 3: every program has them.


def begin_motion(run: Run) -> None:
    """End stage 1: ask the operator, then move the shaft a little to check its sign.

    Raises PreflightRefused if the operator does not confirm or the shaft moves the wrong way, and what the bench
    raises.
    """
    loop, limits, preflight = run.loop, run.limits, run.preflight
    run.log.learn(torque_offset_nm=run.torque_offset_nm)

    def idle() -> None:
        loop.cycle(Command(Mode.SPEED, 0.0, 0.0))

    run.confirm(run.task, preflight, idle)
    run.armed(StopSequence(
        loop,
        limits,
        preflight.speed_resolution_rad_s,
        QuickStopKind(preflight.quick_stop_in_torque_mode, ends_off=preflight.quick_stop_holds is False),
        run.assumptions,
        torque_resolution_nm=preflight.torque_resolution_nm,
        torque_offset_nm=run.torque_offset_nm,
        watched=preflight.watched,
    ))
    loop.guard.start_clock(loop.now_s)
    breakaway_nm = probe_sign(loop, limits, run.mode, preflight.speed_resolution_rad_s)
    if breakaway_nm is not None:
        run.log.event(loop.now_s, "probe", f"the shaft moved forward at {in_nm(breakaway_nm)}")
    run.end_setup()


def turn(run: Run) -> Turning:
    """Run stage 2: steady rotation at two speeds, and a rough model of the rig. In torque mode slow down after it."""
    loop, limits, log = run.loop, run.limits, run.log
    with run.book.stage("speed", 50.0):
        witness = SpeedWitness(
            run.confirm_speed, run.preflight.identity.simulated, limits.accept_speed_unit, run.say
        )
        speed = run_speed(
            loop, limits, run.assumptions, run.speed_resolution_rad_s, run.torque_offset_nm, witness
        )
        log.motion(None, speed.levels, (speed.ramp,))
        model = speed.model
        log.event(
            loop.now_s,
            "plan",
            f"rough model: J {model.inertia_kg_m2:.4g} kg·m² ± {100 * speed.rough.rel_error:.0f} %, "
            f"B {model.viscous_nm_s_rad:.3g} N·m·s/rad, T_c {model.coulomb_nm:.3g} N·m",
        )
        half_s = sum(sample.half_width_s for sample in speed.last) / max(1, len(speed.last))
        if half_s <= 0.0:
            prior = run.prior
        else:                          # speed and torque may be offset by as much
            prior = with_timing(run.prior, half_s)
            log.learn(timing_half_width_s=half_s, lag_prior=prior)
            text = f"sample times are known to ±{1e3 * half_s:.3g} ms, half the duration of a transaction"
            log.event(loop.now_s, "rate", text)
        slow: tuple[Sample, ...] = ()
        if run.mode is Mode.TORQUE:
            slow, speed = slow_down(loop, limits, speed, run.assumptions, run.speed_resolution_rad_s)
    return Turning(speed, slow, prior)


def switch_to_torque(run: Run, turning: Turning) -> TorqueResult | None:
    """Run stage 3: switch to torque mode and let the speed drift. In speed mode skip it and return None."""
    loop, speed = run.loop, turning.speed
    if run.mode is not Mode.TORQUE:
        run.book.skip("torque", f"{_why_speed(run)}: no switch, and no second estimate of the inertia from a drift")
        return None
    with run.book.stage("torque", 15.0):
        drifted = run_torque(
            loop, run.limits, run.assumptions, speed, turning.slow, run.torque_offset_nm, run.speed_resolution_rad_s,
            run.preflight.torque_setpoint,
        )
        run.log.motion(None, speed.levels, _ramps(turning, drifted))
    if drifted.rough is not None:
        rough = turning.model.inertia_kg_m2
        ratio = drifted.rough.inertia_kg_m2 / rough
        text = f"rough inertia {rough:.4g} kg·m² from the ramp, {ratio:.2f} times that from the drift"
        run.log.event(loop.now_s, "plan", text)
    return drifted


def _why_speed(run: Run) -> str:
    return no_torque(run.task.request.mode, run.limits, run.preflight)


def _ramps(turning: Turning, drifted: TorqueResult | None) -> tuple[Ramp, ...]:
    return (turning.speed.ramp,) if drifted is None else (turning.speed.ramp, drifted.ramp)


def _announcer(run: Run, turning: Turning, drifted: TorqueResult | None) -> Callable[[Excitation], None]:
    levels, ramps = turning.speed.levels, _ramps(turning, drifted)
    return lambda motion: run.log.motion(motion, levels, ramps)


def mean_speed_control(run: Run, model: RigGuess) -> MeanSpeedControl:
    """Return the host's control of the mean speed."""
    return MeanSpeedControl(model, HOLD_AUTHORITY * run.limits.torque_nm, run.assumptions)


# ---------------------------------------------------------------------------------------------------------------------
# Stages 4 and 5 of `identify`.


def hold(run: Run, turning: Turning, drifted: TorqueResult | None, planned: Planned) -> MeanSpeedControl | None:
    """Run stage 4: bring the mean speed to the start of the plan. In speed mode skip it and return None."""
    if drifted is None:
        run.book.skip("hold", f"{_why_speed(run)}: the drive's own speed control holds the mean speed")
        return None
    with run.book.stage("hold", 15.0):
        control = mean_speed_control(run, turning.model)
        run_hold(
            run.loop, run.limits, turning.model, control, planned.plan.start_rad_s, drifted.speed_rad_s,
            run.speed_resolution_rad_s, turning.speed.wander_rad_s,
        )
    return control


def acquire(
    run: Run, turning: Turning, drifted: TorqueResult | None, planned: Planned, control: MeanSpeedControl | None,
    planner: StagePlanner,
) -> None:
    """Run stage 5: the planned excitation, for a fixed time or until J is known to the tolerance."""
    identify = run.identify()
    enough = planner.enough(planned, identify)
    asked = run.task.request
    watch = InertiaWatch(
        run.loop, run.log, run.display, identify, asked.confidence,
        None if enough is None else enough.working, None if enough is None else asked.tolerance,
    )
    with run.book.stage("acquire", planned.duration_s + END_S):
        run_plan(
            run.loop, run.limits, planned.plan, control, run.assumptions, _announcer(run, turning, drifted),
            enough, run.speed_resolution_rad_s, watch,
        )


# ---------------------------------------------------------------------------------------------------------------------
# Stages 4 and 5 of `offset_impedance`.


def run_small_offset(run: Run, turning: Turning) -> OffsetPlan:
    """Run stage 4: a pilot with a small torque offset. Plan stage 5 from it."""
    loop, log, task = run.loop, run.log, run.task
    room = Guard.room(run.limits, run.assumptions)
    with run.book.stage("hold", 60.0):
        found = run_pilot(
            loop, run.limits, room, turning.model, run.assumptions, request_of(task.request, Mode.SPEED.value),
            task.string_at_motor_nm_s_rad, run.speed_resolution_rad_s,
        )
        plan = found.plan
        run.display.planned(plan)
        text = (
            f"torque offset of up to {in_nm(found.peak_nm)}, {plan.duration_s:.0f} s, speed"
            f" {plan.speed_min_rad_s:.2f} to {plan.speed_max_rad_s:.2f} rad/s"
        )
        log.event(loop.now_s, "plan", text)
        run.say(text)
        log.configure(plan=plan.plain() | {"torque_amplitudes_nm": list(found.torque_amplitudes_nm)})
    return found


def acquire_offset(run: Run, turning: Turning, found: OffsetPlan) -> None:
    """Run stage 5: the planned torque offset."""
    with run.book.stage("acquire", found.plan.duration_s + END_S):
        run_offset(run.loop, found, _announcer(run, turning, None), run.speed_resolution_rad_s)
