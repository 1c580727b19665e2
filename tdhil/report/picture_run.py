"""The picture of a run: speed and torque over time, its stages and the excited segments shaded."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tdhil.recording.recording import FloatArray, Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

_COLUMNS = 1200           # as many as a screen can show: each is a line from the least to the greatest value in it
_SHADES = ("#f2f2f2", "#ffffff")
_SEGMENT = "#1f5fa8"


def draw_run(figure: FigureBase, recording: Recording) -> None:
    """Nothing is smoothed: every column spans all that was reported in its time."""
    speed_axes, torque_axes = figure.subplots(2, 1, sharex=True)
    for axes, signal, label in (
        (speed_axes, recording.speed_rad_s, "speed, rad/s"),
        (torque_axes, recording.torque_nm, "torque, N·m"),
    ):
        _shade(axes, recording)
        time, low, high = envelope(recording.time_s, signal)
        axes.fill_between(time, low, high, color="0.15", lw=0.6, edgecolor="0.15", zorder=3)
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.margins(x=0.0)
    if recording.torque_limit_nm is not None:
        low, high = torque_axes.get_ylim()
        if high > 0.7 * recording.torque_limit_nm:
            torque_axes.axhline(recording.torque_limit_nm, color="#c2410c", lw=1.0, ls="--")
    if recording.stages:
        begin, end = speed_axes.get_xlim()
        length = max(end - begin, 1e-9)
        for number, stage in enumerate(recording.stages):
            middle = 0.5 * (stage.start_s + stage.end_s)
            if stage.end_s > stage.start_s:
                # short stages stand side by side: their names go up and down in turn
                height = 1.02 if stage.end_s - stage.start_s > 0.1 * length or number % 2 == 0 else 1.10
                speed_axes.text(middle, height, stage.name, transform=speed_axes.get_xaxis_transform(), ha="center",
                                va="bottom", fontsize="small")
    torque_axes.set_xlabel("time, s")


def _shade(axes: Axes, recording: Recording) -> None:
    for number, stage in enumerate(recording.stages):
        if stage.end_s > stage.start_s:
            axes.axvspan(stage.start_s, stage.end_s, color=_SHADES[number % 2], lw=0, zorder=0)
    if recording.excitation is not None:
        for segment in recording.excitation.segments:
            settled = min(segment.start_s + segment.settle_periods * segment.period_s, segment.end_s)
            axes.axvspan(segment.start_s, settled, color=_SEGMENT, alpha=0.08, lw=0, zorder=1)
            axes.axvspan(settled, segment.end_s, color=_SEGMENT, alpha=0.20, lw=0, zorder=1)
    for level in recording.levels:
        axes.axvspan(level.start_s, level.end_s, color="#1a7f37", alpha=0.20, lw=0, zorder=1)


def envelope(time_s: FloatArray, signal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least and greatest value in each of at most 1200 stretches of equally many samples; only what is a number."""
    good = np.isfinite(time_s) & np.isfinite(signal)
    time, values = time_s[good], signal[good]
    if len(time) == 0:
        empty = np.zeros(0)
        return empty, empty, empty
    starts = np.unique(np.linspace(0, len(time), min(_COLUMNS, len(time)), endpoint=False).astype(np.intp))
    # each stretch takes the next one's first value along, so that the picture has no seams
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    following = values[np.append(starts[1:], len(values) - 1)]
    return time[starts], np.minimum(low, following), np.maximum(high, following)
