"""The program of `tdhil tune evaluate`: a speed controller with a virtual string."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial

from drivers import Command, Mode, PreflightRefused
from profiles import MessageCode
from tdhil.runner.guard import Guard
from tdhil.runner.programs import Run, Turning, begin_motion, mean_speed_control, switch_to_torque, turn
from tdhil.runner.stages import TorqueResult, course_of, go_to, refuse_other_rig, run_hold, run_virtual_string
from tdhil.soft_torque import EvaluationCase, SpeedProgram


def virtual_string(run: Run, case: EvaluationCase) -> None:
    """Evaluate a speed controller with a virtual string."""
    program = speed_program(run, case)
    begin_motion(run)                                                  # 1 setup, its end
    turning = turn(run)                                                # 2 speed
    drifted = switch_to_torque(run, turning)                           # 3 torque; skipped in speed mode
    refuse_unfit_rig(run, case, turning, drifted)
    hold_first_speed(run, case, program, turning, drifted)             # 4 hold
    acquire_virtual_string(run, case, program, turning)                # 5 acquire


# ---------------------------------------------------------------------------------------------------------------------
# Checks of `virtual_string` before motion, and its stages 4 and 5.


def speed_program(run: Run, case: EvaluationCase) -> SpeedProgram:
    """Return the virtual string's speed program, before motion. Raises an error if it is refused."""
    if case.own_loop and run.preflight.torque_offset_resolution_nm <= 0.0:
        raise PreflightRefused(
            "the profile names no torque offset of the drive, which --own-loop needs to apply the string's torque",
            where="--own-loop", next_step="Remove --own-loop: the host's controller in torque mode needs none",
            entry=MessageCode.VIRTUAL_STRING_REFUSED,
        )
    course = partial(course_of, case, run.limits, run.loop.period_s, Guard.foresight_s(run.assumptions))
    program = run.loop.compute(course, Command(Mode.SPEED, 0.0, 0.0))
    run.log.configure(evaluation={"case": case.plain(), "program": asdict(program)})
    return program


def refuse_unfit_rig(run: Run, case: EvaluationCase, turning: Turning, drifted: TorqueResult | None) -> None:
    """Raise PreflightRefused if the shaft is not that of the result, or if torque mode does not brake it."""
    refuse_other_rig(case, turning.model)
    guard = run.loop.guard
    if drifted is not None and guard.no_braking:
        raise PreflightRefused(
            f"a virtual string needs braking torque: {guard.no_braking}", where="braking probe",
            next_step=guard.to_brake,
            entry=MessageCode.BRAKING_UNCLEAR,
        )


def hold_first_speed(
    run: Run, case: EvaluationCase, program: SpeedProgram, turning: Turning, drifted: TorqueResult | None
) -> None:
    """Run stage 4: bring the shaft to the first speed of the program, in the mode of stage 5."""
    loop, limits, model = run.loop, run.limits, turning.model
    start_rad_s = program.start_rad_s * case.rig.gear_ratio
    with run.book.stage("hold", 15.0):
        if drifted is None:
            go_to(loop, limits, model, start_rad_s, run.speed_resolution_rad_s)
        else:
            run_hold(
                loop, limits, model, mean_speed_control(run, model), start_rad_s, drifted.speed_rad_s,
                run.speed_resolution_rad_s,
            )


def acquire_virtual_string(run: Run, case: EvaluationCase, program: SpeedProgram, turning: Turning) -> None:
    """Run stage 5: the speed program with the string's torque on the shaft."""
    with run.book.stage("acquire", program.longest_s):
        run_virtual_string(
            run.loop, run.limits, case, program, run.log.virtual, run.say, run.speed_resolution_rad_s,
            turning.speed.high.speed_sd_rad_s,
        )
