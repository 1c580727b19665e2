"""A run in motion: runner, control loop, guard, stop, stages, excitations, and the design of the motion."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.runner.design import (
        DesignKnowledge as DesignKnowledge, assumed_noise as assumed_noise, interval_confidence as interval_confidence,
    )
    from tdhil.runner.five_stages import Runner as Runner
    from tdhil.runner.guard import Guard as Guard
    from tdhil.runner.interim import (
        FollowsInertia as FollowsInertia, Identify as Identify, Interim as Interim, interim_answer as interim_answer,
        live_inertia as live_inertia,
    )
    from tdhil.runner.planning import (
        NOTHING_TO_EXPECT as NOTHING_TO_EXPECT, NOT_PREDICTED as NOT_PREDICTED, Planned as Planned,
        plan_acquisition as plan_acquisition, refuse_hopeless as refuse_hopeless,
        refuse_undersampled as refuse_undersampled, refuse_uninformative as refuse_uninformative,
    )
    from tdhil.runner.preconditions import (
        WARM_UP as WARM_UP, precondition_warnings as precondition_warnings, refuse_by_plan as refuse_by_plan,
        stops_from_torque_mode as stops_from_torque_mode,
    )
    from tdhil.runner.settings import (
        ControlAssumptions as ControlAssumptions, ExcitationRequest as ExcitationRequest,
        MEAN_SPEED_SHARES as MEAN_SPEED_SHARES, MachineLimits as MachineLimits, StopRequest as StopRequest,
    )
    from tdhil.runner.speed_check import speed_warnings as speed_warnings
    from tdhil.runner.speed_steps_program import step_record as step_record
    from tdhil.runner.stage_log import stage_warnings as stage_warnings
    from tdhil.runner.stages import course_of as course_of, plan_steps_before as plan_steps_before
    from tdhil.runner.stop import not_confirmed as not_confirmed
    from tdhil.runner.task import (
        Display as Display, Idle as Idle, RunOutcome as RunOutcome, STAGES as STAGES, Task as Task,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "design": "DesignKnowledge assumed_noise interval_confidence",
        "five_stages": "Runner",
        "guard": "Guard",
        "interim": "FollowsInertia Identify Interim interim_answer live_inertia",
        "planning": "NOTHING_TO_EXPECT NOT_PREDICTED Planned plan_acquisition refuse_hopeless refuse_undersampled"
        " refuse_uninformative",
        "preconditions": "WARM_UP precondition_warnings refuse_by_plan stops_from_torque_mode",
        "settings": "ControlAssumptions ExcitationRequest MEAN_SPEED_SHARES MachineLimits StopRequest",
        "speed_check": "speed_warnings",
        "speed_steps_program": "step_record",
        "stage_log": "stage_warnings",
        "stages": "course_of plan_steps_before",
        "stop": "not_confirmed",
        "task": "Display Idle RunOutcome STAGES Task",
    })
