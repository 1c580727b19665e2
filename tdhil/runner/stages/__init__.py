"""The five stages of a run (section 5.1 of the paper), and the braking probe that may come before the third."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.runner.stages.acquire import run_plan as run_plan
    from tdhil.runner.stages.braking_probe import NOT_YET as NOT_YET, slow_down as slow_down
    from tdhil.runner.stages.hold import MeanSpeedControl as MeanSpeedControl, run_hold as run_hold
    from tdhil.runner.stages.impedance import (
        OffsetPlan as OffsetPlan, reference_plan as reference_plan, run_offset as run_offset, run_pilot as run_pilot,
    )
    from tdhil.runner.stages.set_speed import go_to as go_to
    from tdhil.runner.stages.setup import measure_torque_offset as measure_torque_offset, probe_sign as probe_sign
    from tdhil.runner.stages.speed import RampCourse as RampCourse, SpeedResult as SpeedResult, run_speed as run_speed
    from tdhil.runner.stages.speed_steps import (
        MOST_LONGER as MOST_LONGER, STEPS_RESERVE_S as STEPS_RESERVE_S, SpeedSteps as SpeedSteps,
        further_pairs as further_pairs, plan_steps as plan_steps, plan_steps_before as plan_steps_before,
        refuse_other_shaft as refuse_other_shaft,
    )
    from tdhil.runner.stages.torque import TorqueResult as TorqueResult, run_torque as run_torque
    from tdhil.runner.stages.virtual_string import (
        course_of as course_of, refuse_other_rig as refuse_other_rig, run_virtual_string as run_virtual_string,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "acquire": "run_plan",
        "braking_probe": "NOT_YET slow_down",
        "hold": "MeanSpeedControl run_hold",
        "impedance": "OffsetPlan reference_plan run_offset run_pilot",
        "set_speed": "go_to",
        "setup": "measure_torque_offset probe_sign",
        "speed": "RampCourse SpeedResult run_speed",
        "speed_steps": "MOST_LONGER STEPS_RESERVE_S SpeedSteps further_pairs plan_steps plan_steps_before "
                       "refuse_other_shaft",
        "torque": "TorqueResult run_torque",
        "virtual_string": "course_of refuse_other_rig run_virtual_string",
    })
