"""The program of `tdhil tune verify`: steps of the set speed in the drive's own speed loop."""

from __future__ import annotations

from dataclasses import asdict

from tdhil.runner.programs import Run, Turning, begin_motion, switch_to_torque, turn
from tdhil.runner.stages import (
    STEPS_RESERVE_S,
    go_to,
    plan_steps,
    plan_steps_before,
    refuse_other_shaft,
    run_steps,
)
from tdhil.speed_loop import StepCase, StepProgram


def speed_steps(run: Run, case: StepCase) -> None:
    """Compare the drive's speed loop with its tuning, by small steps of the set speed."""
    run.log.configure(verification={"case": case.plain()})
    plan_steps_before(case, run.limits, run.loop.period_s, run.speed_resolution_rad_s)
    begin_motion(run)                                                  # 1 setup, its end
    turning = turn(run)                                                # 2 speed
    switch_to_torque(run, turning)                                     # 3 torque; skipped: the mode is speed
    program = hold_low_speed(run, case, turning)                       # 4 hold
    acquire_steps(run, case, program, turning)                         # 5 acquire


# ---------------------------------------------------------------------------------------------------------------------
# Stages 4 and 5 of `speed_steps`.


def hold_low_speed(run: Run, case: StepCase, turning: Turning) -> StepProgram:
    """Run stage 4: plan the steps for this shaft, and bring it to their lower speed."""
    loop, limits, model = run.loop, run.limits, turning.model
    refuse_other_shaft(case, model)
    middle = 0.5 * (limits.speed_min_rad_s + limits.speed_max_rad_s)
    with run.book.stage("hold", 15.0):
        program = plan_steps(
            case, limits, loop.period_s, run.speed_resolution_rad_s,
            loop.guard.left_s(loop.now_s) - STEPS_RESERVE_S, model.steady_torque_nm(middle))
        text = (f"{program.pairs + 1} pairs of steps between {program.low_rad_s:.3f} and {program.high_rad_s:.3f} rad/s"
                f", {program.duration_s:.0f} s")
        run.log.event(loop.now_s, "plan", text)
        run.say(text)
        go_to(loop, limits, model, program.speeds_rad_s(0)[1], run.speed_resolution_rad_s)
    return program


def acquire_steps(run: Run, case: StepCase, program: StepProgram, turning: Turning) -> None:
    """Run stage 5: the steps. Their times go into the log."""

    def keep(starts: list[float]) -> None:
        run.log.configure(verification={
            "case": case.plain(), "program": asdict(program), "starts_s": list(starts),
            "reference_filter_s": run.task.request.reference_filter_s,
        })

    with run.book.stage("acquire", program.duration_s):
        run_steps(run.loop, case, program, run.speed_resolution_rad_s, turning.speed.high.speed_sd_rad_s, keep)
