"""Soft torque: drill string, speed controllers, margins, damping and critical speeds. Computation only, no bus."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.soft_torque.drill_string import (
        BitFriction as BitFriction, EXACT_STRING as EXACT_STRING, BottomEnd as BottomEnd, DrillString as DrillString,
        WaveLine as WaveLine, PipeSection as PipeSection, StringFile as StringFile,
        identified_string as identified_string, StringTolerance as StringTolerance, ToleranceFile as ToleranceFile,
        line_of as line_of, load_string as load_string, spring_and_mass as spring_and_mass, string_of as string_of,
    )
    from tdhil.soft_torque.controller import (
        ClosedSystem as ClosedSystem, DERIVATIVE_FILTER_S as DERIVATIVE_FILTER_S, Margins as Margins,
        NaturalMode as NaturalMode, SpeedController as SpeedController, TopDrive as TopDrive,
        control_law as control_law, impedance as impedance, inner_lags as inner_lags, margins as margins,
        reflection as reflection, reflection_at as reflection_at, softest_allowed as softest_allowed,
        stiff_controller as stiff_controller, tuned_controller as tuned_controller,
    )
    from tdhil.soft_torque.candidates import SOFTNESS_RANGE as SOFTNESS_RANGE
    from tdhil.soft_torque.crossover import MOST_GAIN_DB as MOST_GAIN_DB
    from tdhil.soft_torque.evaluation import (
        Evaluation as Evaluation, EvaluationCase as EvaluationCase, EvaluationRefused as EvaluationRefused,
        EvaluationOutcome as EvaluationOutcome, Prediction as Prediction, Trial as Trial, RigWindow as RigWindow,
        case_of as case_of, evaluate as evaluate, program_for as program_for,
        check_virtual_string as check_virtual_string,
    )
    from tdhil.soft_torque.own_units import (
        DriveSetting as DriveSetting, drive_settings as drive_settings, notch_settings as notch_settings,
        one_percent_nm_s_rad as one_percent_nm_s_rad,
    )
    from tdhil.soft_torque.roots import RootsLost as RootsLost, count_in as count_in, roots_in as roots_in
    from tdhil.soft_torque.stability import (
        LoopMargins as LoopMargins, NO_MARGINS as NO_MARGINS, RequiredMargins as RequiredMargins,
        below as below, is_stable as is_stable, linear_limit as linear_limit, loop_margins as loop_margins,
    )
    from tdhil.soft_torque.uncertainty import (
        Interval as Interval, DrawnValues as DrawnValues, Truth as Truth, draw_truths as draw_truths,
        independent_axes as independent_axes, joint_draws as joint_draws,
    )
    from tdhil.soft_torque.simulation import (
        Begin as Begin, Grid as Grid, RPM as RPM, SimulationTrace as SimulationTrace, bit_jumps as bit_jumps,
        grid_of as grid_of, has_light_bit as has_light_bit, simulate as simulate,
    )
    from tdhil.soft_torque.critical_speed import (
        CriticalSpeeds as CriticalSpeeds, HIGHEST_NOISY_RPM as HIGHEST_NOISY_RPM, NOISY_RESOLUTION as NOISY_RESOLUTION,
        Search as Search, critical_speeds as critical_speeds, longest_integral_time_s as longest_integral_time_s,
        lowest_turning as lowest_turning, lowest_turning_with_noise as lowest_turning_with_noise,
    )
    from tdhil.soft_torque.recipes import largest_stable_share as largest_stable_share
    from tdhil.soft_torque.tune_case import (
        Advice as Advice, Moved as Moved, TUNING_REFUSED as TUNING_REFUSED, TuneCase as TuneCase, Tuned as Tuned,
        Tuning as Tuning, TuningRefused as TuningRefused, WrongInertia as WrongInertia,
    )
    from tdhil.soft_torque.tuned_figures import (
        BAND_HZ as BAND_HZ, figures_at as figures_at, in_squares as in_squares, least_damping as least_damping,
        lowest_modes_below_hz as lowest_modes_below_hz, recipe_with as recipe_with, string_modes_hz as string_modes_hz,
    )
    from tdhil.soft_torque.tuning import START_DRAWS as START_DRAWS, tune as tune
    from tdhil.soft_torque.depth_schedule import (
        DepthRow as DepthRow, DepthSchedule as DepthSchedule, at_depth as at_depth, schedule as schedule,
    )
    from tdhil.soft_torque.speed_torque_map import OperatorMap as OperatorMap, operator_map as operator_map
    from tdhil.soft_torque.torsional_severity import (
        AT_RISK_INDEX as AT_RISK_INDEX, ReflectionCheck as ReflectionCheck, SeverityCourse as SeverityCourse,
        StickSlipEpisode as StickSlipEpisode, STICK_SLIP_INDEX as STICK_SLIP_INDEX, Severity as Severity,
        SeverityRefused as SeverityRefused, SurfaceRecord as SurfaceRecord, severity as severity,
    )
    from tdhil.soft_torque.bit_noise import (
        BitNoiseEstimate as BitNoiseEstimate, bit_noise_in as bit_noise_in, with_noise as with_noise,
    )
    from tdhil.soft_torque.virtual_string import (
        COLUMNS as COLUMNS, ProgramCourse as ProgramCourse, HostController as HostController, HostLoop as HostLoop,
        RotorObserver as RotorObserver, Phase as Phase, SpeedProgram as SpeedProgram, IdentifiedRig as IdentifiedRig,
        VirtualString as VirtualString,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "drill_string": (
            "BitFriction EXACT_STRING BottomEnd DrillString WaveLine PipeSection StringFile identified_string "
            "StringTolerance load_string spring_and_mass string_of ToleranceFile line_of"
        ),
        "controller": "ClosedSystem DERIVATIVE_FILTER_S Margins NaturalMode SpeedController TopDrive control_law "
                      "impedance inner_lags margins reflection reflection_at softest_allowed stiff_controller "
                      "tuned_controller",
        "candidates": "SOFTNESS_RANGE",
        "crossover": "MOST_GAIN_DB",
        "evaluation": "Evaluation EvaluationCase EvaluationRefused EvaluationOutcome Prediction Trial RigWindow "
                      "case_of evaluate program_for check_virtual_string",
        "own_units": "DriveSetting drive_settings notch_settings one_percent_nm_s_rad",
        "roots": "RootsLost count_in roots_in",
        "stability": "LoopMargins NO_MARGINS RequiredMargins below is_stable linear_limit loop_margins",
        "uncertainty": "Interval DrawnValues Truth draw_truths independent_axes joint_draws",
        "simulation": "Begin Grid RPM SimulationTrace bit_jumps grid_of has_light_bit simulate",
        "critical_speed": "CriticalSpeeds HIGHEST_NOISY_RPM NOISY_RESOLUTION Search critical_speeds "
                          "longest_integral_time_s lowest_turning lowest_turning_with_noise",
        "recipes": "largest_stable_share",
        "tune_case": "Advice Moved TUNING_REFUSED TuneCase Tuned Tuning TuningRefused WrongInertia",
        "tuned_figures": "BAND_HZ figures_at in_squares least_damping lowest_modes_below_hz recipe_with "
                         "string_modes_hz",
        "tuning": "START_DRAWS tune",
        "depth_schedule": "DepthRow DepthSchedule at_depth schedule",
        "speed_torque_map": "OperatorMap operator_map",
        "torsional_severity": "AT_RISK_INDEX ReflectionCheck STICK_SLIP_INDEX Severity SeverityCourse SeverityRefused "
                              "StickSlipEpisode SurfaceRecord severity",
        "bit_noise": "BitNoiseEstimate bit_noise_in with_noise",
        "virtual_string": "COLUMNS ProgramCourse HostController HostLoop RotorObserver Phase SpeedProgram "
                          "IdentifiedRig VirtualString",
    })
