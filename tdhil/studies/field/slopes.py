"""Figure 22: one inertia, four slopes; and the joint fit that finds the one behind the four.

Published are T = 105.379 α + 73.216, 116.557 α + 70.467, 135.622 α + 70.598 and 185.757 α + 73.212 at 0.1, 0.3, 0.5 and
1 Hz. The same method gives about the same four numbers on the simulated rig, whose one inertia does not change: what
changes with the tone is what the reporting lags do to the slope (`tdhil.studies.joint`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tdhil.estimation.identify import identify
from tdhil.estimation.result import Identification
from tdhil.identify.options import Options
from tdhil.recording.recording import FloatArray
from tdhil.studies.field.bench import FieldBench, FieldRun, part_of
from tdhil.studies.field.settings import SlopeSettings
from tdhil.studies.field.tone import excited, line_slope, scatter
from tdhil.studies.study import Progress, ResultTable, StudyOutcome
from tdhil.study.field_draw_slopes import SlopePicture, draw_slopes
from tdhil.study.field_singly import Alone, alone_statements, alone_table, each_alone
from tdhil.study.field_slopes_said import Record, percent, said_of_slopes
from tdhil.study.joint import joined, slope_of


@dataclass
class FieldSlopes:
    """`tdhil study figure22`."""

    bench: FieldBench
    name: str = "figure22"
    title: str = "Field rig: torque over acceleration at four tones, and one inertia behind them"

    @property
    def settings_model(self) -> type[SlopeSettings]:
        return SlopeSettings

    def run(self, settings: SlopeSettings, progress: Progress) -> StudyOutcome:
        """One run a tone, each with a seed of its own; then all records together."""
        count = len(settings.tones)
        recordings, records = [], []
        for index, tone in enumerate(settings.tones):
            wish = FieldRun(
                settings.rig, tone.frequency_hz, settings.kp_nm_s_rad, settings.ki_nm_rad, settings.seed + index,
                mode=tone.mode, periods=tone.periods, rate_hz=settings.rate_hz,
                torque_limit_nm=settings.torque_limit_nm,
            )
            text = f"{tone.frequency_hz:g} Hz, {tone.mode} mode"
            recording = self.bench.run(wish, part_of(progress, index, count + 0.5, text))
            recordings.append(recording)
            mean = float(excited(recording).speed_rad_s.mean())
            records.append(Record(tone.frequency_hz, tone.mode, scatter(recording), line_slope(recording), mean))
        progress(count / (count + 0.5), "joint fit")
        joint = identify(joined(recordings), Options(confidence=settings.confidence))
        alone = each_alone(recordings, joint, settings.confidence)
        progress(1.0, "joint fit")
        simulated_s = sum(float(r.time_s[-1] - r.time_s[0]) for r in recordings)
        return _outcome(self, settings, records, joint, alone, simulated_s)


def _outcome(
    study: FieldSlopes,
    settings: SlopeSettings,
    records: list[Record],
    joint: Identification,
    alone: tuple[Alone, ...],
    simulated_s: float,
) -> StudyOutcome:
    tones = np.array([record.hertz for record in records])
    curve = slope_of(joint, tones)
    picture = SlopePicture(records, joint, settings.rig.inertia_kg_m2)
    return StudyOutcome(
        name=study.name,
        title=study.title,
        tables=(_slope_table(records, curve), _joint_table(settings, joint), alone_table(alone)),
        statements=(
            *said_of_slopes(settings, records, joint, curve), *alone_statements(alone, settings.rig.inertia_kg_m2)
        ),
        document=_document(settings, records, joint),
        simulated_s=simulated_s,
        draw=lambda figure: draw_slopes(figure, picture),
        figure_size_in=(11.0, 5.2),
    )


def _slope_table(records: list[Record], curve: FloatArray | None) -> ResultTable:
    rows = []
    for index, record in enumerate(records):
        fit, (published, intercept) = record.points.fit, record.published
        rows.append((
            record.hertz, record.mode, fit.inertia_kg_m2, published, percent(fit.inertia_kg_m2, published),
            record.at_the_tone, None if curve is None else float(curve[index]), fit.intercept_nm, intercept,
            record.mean_speed_rad_s, fit.r2,
        ))
    columns = (
        "frequency_hz", "mode", "slope_kg_m2", "published_slope_kg_m2", "deviation_percent",
        "slope_without_noise_kg_m2", "joint_fit_slope_kg_m2", "intercept_nm", "published_intercept_nm",
        "mean_speed_rad_s", "r2",
    )
    return ResultTable("slopes", columns, tuple(rows))


def _joint_table(settings: SlopeSettings, joint: Identification) -> ResultTable:
    rig = settings.rig
    rows: list[tuple[str, float | None, float | None, float | None, float]] = []
    for name, found, true in (
        ("inertia_kg_m2", joint.inertia, rig.inertia_kg_m2),
        ("viscous_nm_s_rad", joint.viscous_nm_s_rad, rig.viscous_nm_s_rad),
        ("coulomb_nm", joint.coulomb_nm, rig.coulomb_nm),
        ("speed_lag_s", joint.speed_lag_s, rig.speed_lag_s),
        ("torque_lag_s", joint.torque_lag_s, rig.torque_lag_s),
        ("skew_s", joint.skew_s, 0.0),
    ):
        values = (None, None, None) if found is None else (found.value, found.low, found.high)
        rows.append((name, *values, true))
    return ResultTable("joint_fit", ("quantity", "value", "low", "high", "simulated_rig"), tuple(rows))


def _document(settings: SlopeSettings, records: list[Record], joint: Identification) -> dict[str, object]:
    inertia = joint.inertia
    return {
        "slopes": [
            {
                "frequency_hz": record.hertz, "mode": record.mode, "slope_kg_m2": record.points.fit.inertia_kg_m2,
                "intercept_nm": record.points.fit.intercept_nm, "published_slope_kg_m2": record.published[0],
            }
            for record in records
        ],
        "joint_fit": {
            "verdict": joint.verdict.value,
            "reason": joint.reason,
            "inertia_kg_m2": None if inertia is None
            else {"value": inertia.value, "low": inertia.low, "high": inertia.high, "confidence": inertia.confidence},
            "speed_lag_s": None if joint.speed_lag_s is None else joint.speed_lag_s.value,
            "torque_lag_s": None if joint.torque_lag_s is None else joint.torque_lag_s.value,
            "p_value": None if joint.residual is None else joint.residual.p_value,
        },
        "simulated_rig_inertia_kg_m2": settings.rig.inertia_kg_m2,
    }
