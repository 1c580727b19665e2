"""The program of `tdhil tune verify`: steps of the set speed in the drive's own speed loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial

from drivers import Command, Mode
from tdhil.recording import Recording
from tdhil.runner.programs import Run, Turning, begin_motion, switch_to_torque, turn
from tdhil.runner.stages import (
    STEPS_RESERVE_S,
    SpeedSteps,
    further_pairs,
    go_to,
    plan_steps,
    plan_steps_before,
    refuse_other_shaft,
)
from tdhil.speed_loop import StepCase, StepProgram, StepRecord, StepVerification, verify_record


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
    """Run stage 5: the steps, and more of them if P or I is not known well enough. Their times go into the log."""
    loop, speed = run.loop, turning.speed.high

    def keep(program: StepProgram) -> None:
        run.log.configure(verification={
            "case": case.plain(), "program": asdict(program), "starts_s": list(steps.starts_s),
            "reference_filter_s": run.task.request.reference_filter_s,
        })

    with run.book.stage("acquire", program.duration_s):
        steps = SpeedSteps(loop, case, program, run.speed_resolution_rad_s, speed.speed_sd_rad_s)
        for number in range(program.pairs + 1):
            steps.run_pair(number)
            keep(program)
        found = _found_so_far(run, case, program, steps.starts_s)
        if isinstance(found, str):
            run.log.event(loop.now_s, "plan", f"the steps so far could not be compared, no more follow: {found}")
            return
        more = further_pairs(found, program, loop.guard.left_s(loop.now_s) - STEPS_RESERVE_S)
        if more:
            text = f"{found.reason}. {more} more pairs follow, {2.0 * program.half_s * (more + 1):.0f} s"
            run.log.event(loop.now_s, "plan", text)
            run.say(text)
            steps.run_pair(0, counts=False)        # it does not begin like the others: the speed was held before it
        longer = replace(program, pairs=program.pairs + more)
        for number in range(program.pairs + 1, longer.pairs + 1):
            steps.run_pair(number)
            keep(longer)


def _found_so_far(run: Run, case: StepCase, program: StepProgram, starts_s: list[float]) -> StepVerification | str:
    """Compare the steps so far, while the shaft turns at the lower speed. Return a text if that is not possible."""
    record = step_record(run.log.recording(complete=True), tuple(starts_s), run.loop.period_s,
                         run.task.request.reference_filter_s)
    command = Command(Mode.SPEED, program.low_rad_s, 0.0)
    return run.loop.compute(partial(_compared, case, program, record), command)


def step_record(
    recording: Recording, starts_s: Sequence[float], period_s: float, reference_filter_s: float
) -> StepRecord:
    """Return the part of a recording that a comparison of the steps uses."""
    return StepRecord(recording.time_s, recording.speed_rad_s, recording.fresh, recording.limited, starts_s, period_s,
                      recording.timing_half_width_s, reference_filter_s)


def _compared(case: StepCase, program: StepProgram, record: StepRecord) -> StepVerification | str:
    """Return the comparison, or its error as text: the steps are recorded, so no error of it ends the run."""
    try:
        return verify_record(case, program, record)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
