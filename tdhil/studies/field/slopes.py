"""Figure 22: four slopes with one inertia, and the joint fit that finds this inertia.

The published lines are T = 105.379 α + 73.216, 116.557 α + 70.467, 135.622 α + 70.598 and 185.757 α + 73.212 at 0.1,
0.3, 0.5 and 1 Hz. The same method gives nearly the same four numbers on the simulated rig, whose inertia is constant:
only the effect of the reporting lags on the slope changes with the frequency (`tdhil.studies.field.slopes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tdhil.estimation import Estimate, Identification, Options, identify, normal_quantile
from tdhil.recording import Excitation, FloatArray, LagPrior, Recording, Segment
from tdhil.studies.field.bench import FieldBench, FieldRun, part_of
from tdhil.studies.field.settings import SlopeSettings
from tdhil.studies.field.tone import PUBLISHED_STYLE, Scatter, colour, excited, line_slope, scatter, tidy
from tdhil.studies.study import Cell, Progress, ResultTable, Statement, StudyOutcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# ---------------------------------------------------------------------------------------------------------------------
# One frequency at a time: not identifiable with unknown lags; with the lags of the joint fit, one J for all.


SPREAD = 0.01
"""Largest spread of the inertias, as a share of their mean; the paper's slopes differ by 76 %."""


@dataclass(frozen=True)
class Alone:
    """Results of one frequency alone: with unknown lags, and with stated lags."""

    hertz: float
    unknown: Identification
    stated: Identification


def stated_lags(joint: Identification, confidence: float) -> LagPrior | None:
    """Return the lags of the joint fit in the form in which a drive states them; None if it has none."""
    if joint.speed_lag_s is None or joint.torque_lag_s is None:
        return None
    speed, torque = joint.speed_lag_s, joint.torque_lag_s
    return LagPrior(
        speed.value, _sd(speed, confidence), torque.value, _sd(torque, confidence), "the joint fit of all tones"
    )


def _sd(one: Estimate, confidence: float) -> float:
    return 0.5 * (one.high - one.low) / normal_quantile(confidence)


def each_alone(recordings: Sequence[Recording], joint: Identification, confidence: float) -> tuple[Alone, ...]:
    """Return every recording identified alone, with unknown and with stated lags; () without a joint fit."""
    prior = stated_lags(joint, confidence)
    if prior is None:
        return ()
    found = []
    for recording in recordings:
        if recording.excitation is None:
            continue
        hertz = recording.excitation.segments[0].lines_hz[0]
        options = Options(confidence=confidence)
        found.append(Alone(hertz, identify(recording, options), identify(replace(recording, lag_prior=prior), options)))
    return tuple(found)


def alone_table(found: Sequence[Alone]) -> ResultTable:
    """Return one row for each frequency."""
    rows: list[tuple[Cell, ...]] = []
    for one in found:
        inertia = one.stated.inertia
        values = (None, None, None) if inertia is None else (inertia.value, inertia.low, inertia.high)
        rows.append((one.hertz, one.unknown.verdict.value, one.stated.verdict.value, *values))
    columns = ("frequency_hz", "verdict_nothing_known", "verdict_lags_stated", "inertia_kg_m2", "low", "high")
    return ResultTable("one_tone_alone", columns, tuple(rows))


def alone_statements(found: Sequence[Alone], true_inertia: float) -> list[Statement]:
    """Return the statements: refused with unknown lags, one J with stated lags."""
    if not found:
        return []
    refused = [one.unknown.inertia is None for one in found]
    inertias = [one.stated.inertia for one in found if one.stated.inertia is not None]
    values = np.array([inertia.value for inertia in inertias])
    spread = float(np.ptp(values) / values.mean()) if len(values) else float("nan")
    covered = sum(inertia.low <= true_inertia <= inertia.high for inertia in inertias)
    return [
        Statement(
            "one tone with nothing known of the lags identifies no inertia", "a number for each of four tones",
            f"{sum(refused)} of {len(found)} refused", all(refused),
        ),
        Statement(
            f"each tone alone, the joint fit's lags stated: one inertia, within {100 * SPREAD:.0f} %",
            "76 % from the lowest tone to the highest",
            f"{', '.join(f'{value:.2f}' for value in values)} kg·m²: {100 * spread:.2f} % apart; "
            f"{covered} of {len(found)} intervals cover the rig's",
            len(inertias) == len(found) and spread <= SPREAD and covered == len(found),
        ),
    ]


# ---------------------------------------------------------------------------------------------------------------------
# Statements of figure 22, whether tdhil confirms them, and contradictions within the paper.


PUBLISHED = {0.1: (105.379, 73.216), 0.3: (116.557, 70.467), 0.5: (135.622, 70.598), 1.0: (185.757, 73.212)}
"""Published slope, kg·m², and intercept, N·m, by frequency, Hz (figure 22)."""

CLOSE = 0.03
"""Largest relative difference between published slopes and those of tdhil."""

CURVE_CLOSE = 0.01
"""Largest relative difference between the joint fit's curve and tdhil's slopes without the effect of noise in α."""


@dataclass(frozen=True)
class Record:
    """One frequency as recorded, with the result of the paper's method."""

    hertz: float
    mode: str
    points: Scatter
    at_the_tone: float                 # kg·m²; slope without the reduction by noise in α
    mean_speed_rad_s: float

    @property
    def published(self) -> tuple[float | None, float | None]:
        return PUBLISHED.get(round(self.hertz, 6), (None, None))


def said_of_slopes(
    settings: SlopeSettings, records: list[Record], joint: Identification, curve: FloatArray | None
) -> tuple[Statement, ...]:
    """Return statements on the slopes, the common inertia, and open points. ``curve``: the joint fit at the
    frequencies.
    """
    found = []
    for record in records:
        ours, published = record.points.fit.inertia_kg_m2, record.published[0]
        if published is not None:
            text = f"the paper's method gives the published slope at {record.hertz:g} Hz, within {100 * CLOSE:.0f} %"
            found.append(Statement(
                text, f"{published:g} kg·m²", f"{ours:.3f} kg·m² ({percent(ours, published):+.2f} %)",
                abs(ours / published - 1.0) <= CLOSE,
            ))
    ordered = [record.points.fit.inertia_kg_m2 for record in sorted(records, key=lambda record: record.hertz)]
    growth = ordered[-1] / ordered[0] - 1.0
    found.append(Statement(
        "the fitted slope grows with the tone", "by 76 % from 0.1 to 1 Hz, on one rig",
        f"by {100 * growth:.0f} %, on one rig", bool(np.all(np.diff(ordered) > 0.0)),
    ))
    true, one_inertia = settings.rig.inertia_kg_m2, joint.inertia
    text = "one inertia behind all records: the joint fit's interval covers the rig's"
    if one_inertia is None or curve is None:
        return (*found, Statement(text, "none given", f"no number: {joint.reason}", False), *_open(records))
    value = f"{one_inertia.value:.2f} ({one_inertia.low:.2f} to {one_inertia.high:.2f}) kg·m² for {true:g}"
    off = float(np.max(np.abs(curve / np.array([record.at_the_tone for record in records]) - 1.0)))
    noise = max(1.0 - record.points.fit.inertia_kg_m2 / record.at_the_tone for record in records)
    return (
        *found,
        Statement(text, "no reference inertia is published", value, one_inertia.low <= true <= one_inertia.high),
        Statement(
            "one line, with that inertia and the reporting lags, passes through all slopes",
            "J 103.75, lags 0.403 and 0.151 s: 0.10 kg·m² RMS from the four",
            f"within {100 * off:.1f} % of ours, lags {_value(joint.speed_lag_s)} and {_value(joint.torque_lag_s)} s; "
            f"noise in α takes up to {100 * noise:.1f} % more off the fitted slopes",
            off <= CURVE_CLOSE,
        ),
        *_open(records),
    )


def percent(ours: float, published: float | None) -> float | None:
    """Return the deviation of ``ours`` in percent; None without a published value."""
    return None if published is None else 100.0 * (ours / published - 1.0)


def _open(records: list[Record]) -> list[Statement]:
    """Return contradictions and missing data in the paper."""
    lowest = min(records, key=lambda record: record.hertz)
    level = f"{lowest.points.fit.intercept_nm:.1f} N·m at a mean of {lowest.mean_speed_rad_s:.2f} rad/s"
    return [
        Statement(
            "a lower tone identifies the inertia better",
            "section 5.2 says so; Table 6 shows the reverse (885.6 at 0.1 Hz, 895.3 at 1 Hz, of 900)",
            "both are right: lags bend the field slopes at high tones, the start from rest the simulated ones at low",
            None,
        ),
        Statement(
            "the intercept is the damping", "70.5 to 73.2 N·m",
            f"it is Coulomb friction + B · mean speed, {level}; the paper's mean speed is not given", None,
        ),
        Statement(
            "tones of the field test", "0.05, 0.1, 0.5, 1 Hz in the text; the fits are at 0.1, 0.3, 0.5, 1 Hz",
            "those of the fits are used", None,
        ),
    ]


def _value(estimate: object) -> str:
    value = getattr(estimate, "value", None)
    return "-" if value is None else f"{value:.3f}"


# ---------------------------------------------------------------------------------------------------------------------
# Four recordings of one rig, one frequency each: each alone leaves the inertia open, together they determine it.
#
# One frequency gives two equations for the five unknowns J, B, τ_w, τ_T and skew. The recordings are joined in time to
# one Recording with a segment for each, and identified like any other: the same likelihood, on the lines of all four,
# with the levels of their mean speeds for the friction.


_BETWEEN_S = 10.0      # s; gap between two records
_AROUND_S = 1.0        # s; time kept before and after a record's segments


def joined(recordings: Sequence[Recording]) -> Recording:
    """Return one Recording of all: times are shifted, and each torque has its own offset subtracted.

    Levels, ramps, commanded and demanded torque and the angle are left out: a slope needs none of them.
    """
    times, speeds, torques, fresh, limited = [], [], [], [], []
    segments: list[Segment] = []
    begin_s = 0.0
    for recording in recordings:
        if recording.excitation is None or not recording.excitation.segments:
            raise ValueError("a record without excitation can't be joined to others")
        own = recording.excitation.segments
        first_s, last_s = own[0].start_s - _AROUND_S, own[-1].end_s + _AROUND_S
        keep = (recording.time_s >= first_s) & (recording.time_s <= last_s)
        shift_s = begin_s - first_s
        times.append(recording.time_s[keep] + shift_s)
        speeds.append(recording.speed_rad_s[keep])
        torques.append(recording.torque_nm[keep] - recording.torque_offset_nm)
        fresh.append(recording.fresh[keep])
        limited.append(recording.limited[keep])
        segments += [replace(part, start_s=part.start_s + shift_s, end_s=part.end_s + shift_s) for part in own]
        begin_s += last_s - first_s + _BETWEEN_S
    kinds = {recording.excitation.kind for recording in recordings if recording.excitation is not None}
    modes = {recording.excitation.mode for recording in recordings if recording.excitation is not None}
    return replace(
        recordings[0],
        time_s=np.concatenate(times),
        speed_rad_s=np.concatenate(speeds),
        torque_nm=np.concatenate(torques),
        fresh=np.concatenate(fresh),
        limited=np.concatenate(limited),
        excitation=Excitation(kinds.pop() if len(kinds) == 1 else "mixed", "+".join(sorted(modes)), tuple(segments)),
        levels=(),
        ramps=(),
        stages=(),
        torque_offset_nm=0.0,
        commanded_torque_nm=None,
        demanded_torque_nm=None,
        position_rad=None,
    )


def expected_slope(
    hertz: FloatArray, inertia: float, viscous: float, speed_lag_s: float, torque_lag_s: float, skew_s: float
) -> FloatArray:
    """Return the slope of T = slope·α + b that least squares finds at one frequency, kg·m², (K,).

    For a sinusoidal T and α = dω/dt, both as reported, the slope is Re(T α*)/|α|² = Re(G(s)/s) at s = jω; without skew

        J (1 + ω² τ_w τ_T)/(1 + ω² τ_T²) + B (τ_w − τ_T)/(1 + ω² τ_T²).

    Averaging both over the same 0.1 s does not change it.
    """
    s = (2j * np.pi * np.asarray(hertz, dtype=np.float64)).astype(np.complex128)
    seen = (inertia * s + viscous) * (1.0 + speed_lag_s * s) / (1.0 + torque_lag_s * s) * np.exp(-skew_s * s)
    slope: FloatArray = (seen / s).real
    return slope


def slope_of(identification: Identification, hertz: FloatArray) -> FloatArray | None:
    """Return the same slope for the parameters of a joint fit; None if the fit gave no number."""
    found = identification
    parts = (found.viscous_nm_s_rad, found.speed_lag_s, found.torque_lag_s, found.skew_s)
    if found.inertia is None or any(part is None for part in parts):
        return None
    viscous, speed_lag, torque_lag, skew = (part.value for part in parts if part is not None)
    return expected_slope(hertz, found.inertia.value, viscous, speed_lag, torque_lag, skew)


# ---------------------------------------------------------------------------------------------------------------------
# Plot of figure 22: left as in the paper, right the common inertia behind the four slopes.


@dataclass(frozen=True)
class SlopePicture:
    """Data of the plot; ``true_inertia`` is that of the simulated rig, kg·m²."""

    records: Sequence[Record]
    joint: Identification
    true_inertia: float


def draw_slopes(figure: Figure, picture: SlopePicture) -> None:
    """Draw the scatter with its fitted lines, and the slope over frequency with the curve of the joint fit."""
    left, right = figure.subplots(1, 2)
    _scatter(left, picture)
    _slopes(right, picture)
    figure.tight_layout()


def _scatter(axes: Axes, picture: SlopePicture) -> None:
    for index, record in enumerate(picture.records):
        alpha, fit = record.points.acceleration_rad_s2, record.points.fit
        axes.plot(alpha, record.points.torque_nm, ".", color=colour(index), markersize=2.5, alpha=0.35, rasterized=True)
    for index, record in enumerate(picture.records):
        alpha, fit = record.points.acceleration_rad_s2, record.points.fit
        ends = np.array([alpha.min(), alpha.max()])
        label = f"{record.hertz:g} Hz: T = {fit.inertia_kg_m2:.1f} α + {fit.intercept_nm:.1f}"
        axes.plot(ends, fit.inertia_kg_m2 * ends + fit.intercept_nm, color=colour(index), linewidth=1.8, label=label)
    axes.legend(fontsize=8, loc="upper left", framealpha=0.9)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.28 * (high - low))
    tidy(axes, "reported acceleration α, rad/s²", "reported torque T, N·m", "The paper's method, tone by tone")


def _slopes(axes: Axes, picture: SlopePicture) -> None:
    records, joint = picture.records, picture.joint
    known = [(record.hertz, record.published[0]) for record in records if record.published[0] is not None]
    highest = max(record.hertz for record in records)
    tones = np.linspace(0.02, 1.08 * highest, 300)
    curve = slope_of(joint, tones)
    if curve is not None and joint.inertia is not None:
        lags = ""
        if joint.speed_lag_s is not None and joint.torque_lag_s is not None:
            lags = f", lags {joint.speed_lag_s.value:.2f} and {joint.torque_lag_s.value:.2f} s"
        axes.plot(tones, curve, color="#444444", linewidth=1.6, label=f"joint fit of all records: one J{lags}")
        found = joint.inertia
        axes.axhspan(found.low, found.high, color="#2e8b57", alpha=0.35, linewidth=0)
        label = f"its J: {found.value:.1f} ({found.low:.1f} to {found.high:.1f}) kg·m²"
        axes.axhline(found.value, color="#2e8b57", linewidth=1.2, label=label)
    axes.axhline(picture.true_inertia, color="black", linewidth=0.8, linestyle=":",
                 label=f"the simulated rig's J: {picture.true_inertia:g} kg·m²")
    for index, record in enumerate(records):
        label = "slope of the paper's method, ours" if index == 0 else ""
        axes.plot(record.hertz, record.points.fit.inertia_kg_m2, "o", color=colour(index), markersize=7, label=label)
    if known:
        axes.plot(*zip(*known, strict=True), label="published slope", **PUBLISHED_STYLE)
    axes.set_xlim(0.0, 1.1 * highest)
    axes.legend(fontsize=8, loc="upper left")
    tidy(axes, "tone, Hz", "slope, kg·m²", "One inertia, seen through two reporting lags")


# ---------------------------------------------------------------------------------------------------------------------

@dataclass
class FieldSlopes:
    """Study `tdhil study figure22`."""

    bench: FieldBench
    name: str = "figure22"
    title: str = "Field rig: torque over acceleration at four tones, and one inertia behind them"
    settings_model: type[SlopeSettings] = SlopeSettings

    def run(self, settings: SlopeSettings, progress: Progress) -> StudyOutcome:
        """Do one run for each frequency, each with its own seed; then identify all records together."""
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
