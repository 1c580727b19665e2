"""Speed loop in the drive: margins, step response, P and I from J's interval, measured steps. Pure computation."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.speed_loop.loop import (
        LoopPlant as LoopPlant, NotchFilter as NotchFilter, PiGains as PiGains, SpeedLoopMargins as SpeedLoopMargins,
        SpringLoad as SpringLoad, frequency_grid as frequency_grid, loop_response as loop_response,
        speed_loop_margins as speed_loop_margins,
    )
    from tdhil.speed_loop.step import (
        StepFigures as StepFigures, is_stable_loop as is_stable_loop, step_figures as step_figures,
        step_responses as step_responses,
    )
    from tdhil.speed_loop.design import (
        LoopDesign as LoopDesign, LoopRow as LoopRow, LoopTuningRefused as LoopTuningRefused, Range as Range,
        SpeedLoopCase as SpeedLoopCase, UncertainPlant as UncertainPlant, design_speed_loop as design_speed_loop,
    )
    from tdhil.speed_loop.preview import (
        LoopCurve as LoopCurve, MeasuredShaft as MeasuredShaft, deviation_from_model as deviation_from_model,
        loop_at_lines as loop_at_lines, loop_curve as loop_curve, measured_shaft as measured_shaft,
    )
    from tdhil.speed_loop.step_model import (
        StepCase as StepCase, StepProgram as StepProgram, step_case_of as step_case_of, step_length_s as step_length_s,
    )
    from tdhil.speed_loop.verification import (
        LEAST_PAIRS as LEAST_PAIRS, StepOutcome as StepOutcome, StepRecord as StepRecord, StepRow as StepRow,
        StepVerification as StepVerification, step_pairs as step_pairs, verify_record as verify_record,
        verify_steps as verify_steps,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "loop": "LoopPlant NotchFilter PiGains SpeedLoopMargins SpringLoad frequency_grid loop_response "
                "speed_loop_margins",
        "step": "StepFigures is_stable_loop step_figures step_responses",
        "design": "LoopDesign LoopRow LoopTuningRefused Range SpeedLoopCase UncertainPlant design_speed_loop",
        "preview": "LoopCurve MeasuredShaft deviation_from_model loop_at_lines loop_curve measured_shaft",
        "step_model": "StepCase StepProgram step_case_of step_length_s",
        "verification": "LEAST_PAIRS StepOutcome StepRecord StepRow StepVerification step_pairs verify_record "
                        "verify_steps",
    })
