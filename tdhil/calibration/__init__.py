"""Calibration of a drive's torque and speed: from known bodies, a reference sensor, a known pipe, or counted turns.
Pure.
"""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.calibration.added_body import (
        BodyRun as BodyRun, CalibrationCase as CalibrationCase, CalibrationLine as CalibrationLine,
        FactorLine as FactorLine, MeasuredValue as MeasuredValue, RunPlan as RunPlan,
        TorqueCalibration as TorqueCalibration, calibrate_torque as calibrate_torque, plan_bodies as plan_bodies,
    )
    from tdhil.calibration.known_pipe import (
        KnownPipe as KnownPipe, KnownPipeFit as KnownPipeFit, PipeInput as PipeInput,
        calibrate_known_pipe as calibrate_known_pipe,
    )
    from tdhil.calibration.pairs import (
        PairsFit as PairsFit, TorquePairs as TorquePairs, calibrate_pairs as calibrate_pairs,
        line_with_errors_in_both as line_with_errors_in_both,
    )
    from tdhil.calibration.reference import (
        ReferenceFit as ReferenceFit, TorqueRecord as TorqueRecord, calibrate_reference as calibrate_reference,
        scale_of_reference as scale_of_reference,
    )
    from tdhil.calibration.speed import (
        CountedTurns as CountedTurns, SpeedBudgetLine as SpeedBudgetLine, SpeedCalibration as SpeedCalibration,
        calibrate_by_position as calibrate_by_position, calibrate_by_turns as calibrate_by_turns,
    )
    from tdhil.calibration.stored import (
        OWN_LOG as OWN_LOG, CalibrationUnusable as CalibrationUnusable, StoredCalibration as StoredCalibration,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "added_body": "BodyRun CalibrationCase CalibrationLine FactorLine MeasuredValue RunPlan TorqueCalibration "
                      "calibrate_torque plan_bodies",
        "known_pipe": "KnownPipe KnownPipeFit PipeInput calibrate_known_pipe",
        "pairs": "PairsFit TorquePairs calibrate_pairs line_with_errors_in_both",
        "reference": "ReferenceFit TorqueRecord calibrate_reference scale_of_reference",
        "speed": "CountedTurns SpeedBudgetLine SpeedCalibration calibrate_by_position calibrate_by_turns",
        "stored": "OWN_LOG CalibrationUnusable StoredCalibration",
    })
