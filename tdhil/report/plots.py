"""Figures of a result: lines over frequency, budget, friction over speed, all estimates of the inertia."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from tdhil.recording import FloatArray, Recording
from tdhil.report.card import budget_figures

if TYPE_CHECKING:
    from matplotlib.axis import Axis
    from matplotlib.figure import FigureBase


PNG_DPI = 150             # dots per inch of a PNG
CAPTION_SIGNS = 105       # characters in a line of a caption

# ---------------------------------------------------------------------------------------------------------------------
# Figure of a run: speed and torque over time, with its stages and the excited segments shaded.


_COLUMNS = 1200           # columns, as many as a screen can show; each spans the values of its time
_SHADES = ("#f2f2f2", "#ffffff")
_SEGMENT = "#1f5fa8"


def draw_run(figure: FigureBase, recording: Recording) -> None:
    """Draw the run without smoothing: every column spans all reported values of its time."""
    speed_axes, torque_axes = figure.subplots(2, 1, sharex=True)
    for axes, signal, label in (
        (speed_axes, recording.speed_rad_s, "speed, rad/s"),
        (torque_axes, recording.torque_nm, "torque, N·m"),
    ):
        for number, stage in enumerate(recording.stages):
            if stage.end_s > stage.start_s:
                axes.axvspan(stage.start_s, stage.end_s, color=_SHADES[number % 2], lw=0, zorder=0)
        for segment in recording.excitation.segments if recording.excitation is not None else ():
            settled = min(segment.start_s + segment.settle_periods * segment.period_s, segment.end_s)
            axes.axvspan(segment.start_s, settled, color=_SEGMENT, alpha=0.08, lw=0, zorder=1)
            axes.axvspan(settled, segment.end_s, color=_SEGMENT, alpha=0.20, lw=0, zorder=1)
        for level in recording.levels:
            axes.axvspan(level.start_s, level.end_s, color="#1a7f37", alpha=0.20, lw=0, zorder=1)
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
                # short stages are close together: their names alternate in height
                height = 1.02 if stage.end_s - stage.start_s > 0.1 * length or number % 2 == 0 else 1.10
                speed_axes.text(middle, height, stage.name, transform=speed_axes.get_xaxis_transform(), ha="center",
                                va="bottom", fontsize="small")
    torque_axes.set_xlabel("time, s")


def envelope(time_s: FloatArray, signal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return least and greatest value in each of at most 1200 stretches of equally many finite samples."""
    good = np.isfinite(time_s) & np.isfinite(signal)
    time, values = time_s[good], signal[good]
    if len(time) == 0:
        empty = np.zeros(0)
        return empty, empty, empty
    starts = np.unique(np.linspace(0, len(time), min(_COLUMNS, len(time)), endpoint=False).astype(np.intp))
    # each stretch includes the first value of the next one, so that the figure has no gaps
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    following = values[np.append(starts[1:], len(values) - 1)]
    return time[starts], np.minimum(low, following), np.maximum(high, following)


# ---------------------------------------------------------------------------------------------------------------------

OURS, PAPER, DARK, QUIET = "#1f5fa8", "#c2410c", "0.15", "0.55"
Part = Mapping[str, Any]


def level_ticks(axis: Axis) -> None:
    """Give major and minor ticks one length, so that their labels stand on one line."""
    axis.set_tick_params(which="both", length=3.0, pad=3.5)


def plain_ticks(axis: Axis) -> None:
    """Label a logarithmic axis with 0.1, 0.2, 0.5 instead of powers of ten."""
    level_ticks(axis)

    def text(value: float, _: object = None) -> str:
        return f"{value:g}" if f"{value:.0e}"[0] in "125" else ""

    axis.set_major_formatter(text)
    axis.set_minor_formatter(text)


def draw_lines(figure: FigureBase, document: Part) -> None:
    """Draw, above, apparent inertia of every line, the model and J; below, the residuals."""
    points = document["lines"]
    hertz = [point["hertz"] for point in points]
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    seen = [point["apparent_inertia_kg_m2"] for point in points]
    top.plot(hertz, [point["fitted_inertia_kg_m2"] for point in points], "-", color=OURS, lw=1.4, label="model")
    top.errorbar(hertz, [e["value"] for e in seen], _bars(seen), fmt="o", color=DARK, ms=5, capsize=3, lw=1.2,
                 label="each line by itself")
    inertia, paper = document["inertia_kg_m2"], document["paper"]
    if inertia is not None:
        top.axhspan(inertia["low"], inertia["high"], color=OURS, alpha=0.18, lw=0)
        top.axhline(inertia["value"], color=OURS, lw=1.0, ls=":", label="J with its interval")
    if paper is not None and paper["inertia_kg_m2"] is not None:
        top.axhline(paper["inertia_kg_m2"], color=PAPER, lw=1.2, ls="--", label="acceleration regression")
    top.set_ylabel("Im(T/ω) / 2πf, kg·m²")
    top.legend(fontsize="small", loc="best")
    below.bar(hertz, [point["residual_sd"] for point in points], width=_width(hertz), color=QUIET)
    below.axhline(1.0, color=DARK, lw=0.8, ls=":")
    below.set(xlabel="frequency, Hz", ylabel="residual,\nst. dev.")
    for axes in (top, below):
        axes.grid(alpha=0.3)


def draw_impedance(figure: FigureBase, found: Part) -> None:
    """Draw |Z| over frequency, of the lines and of the fitted loop; |r| below, if a string is known."""
    points, zeta = found["points"], found["string_nm_s_rad"]
    hertz = [point["hertz"] for point in points]
    real, imaginary = (np.array([point[key]["value"] for point in points])
                       for key in ("real_nm_s_rad", "imaginary_nm_s_rad"))
    seen = [(point["hertz"], np.hypot(*point["measured_nm_s_rad"])) for point in points if point["measured_nm_s_rad"]]
    axes = figure.subplots(2 if zeta else 1, 1, sharex=True, squeeze=False)[:, 0]
    top = axes[0]
    top.loglog(hertz, np.hypot(real, imaginary), color=OURS, lw=1.4, label="|Z| of the loop found")
    top.loglog([one for one, _ in seen], [size for _, size in seen], "o", color=DARK, ms=5, label="each line by itself")
    if zeta:
        top.axhline(zeta, color=QUIET, lw=1.0, ls=":", label="ζ of the string")
        parts = [point["reflection_total"] for point in points]
        below = axes[1]
        below.fill_between(hertz, [part["low"] for part in parts], [part["high"] for part in parts], color=OURS,
                           alpha=0.25, lw=0)
        below.semilogx(hertz, [part["value"] for part in parts], color=OURS, lw=1.4)
        below.set(ylabel="|r|", ylim=(0.0, 1.05))
    top.set_ylabel("|Z|, N·m·s/rad")
    top.legend(fontsize="small")
    axes[-1].set_xlabel("frequency, Hz")
    plain_ticks(axes[-1].xaxis)
    for one in axes:
        one.grid(alpha=0.3, which="both")


def draw_budget(figure: FigureBase, document: Part) -> None:
    """Draw one bar for each source, the largest on top."""
    lines = sorted((line for line in document["budget"] if line["half_width_kg_m2"] is not None),
                   key=lambda line: float(line["half_width_kg_m2"]))
    axes = figure.subplots()
    halves = [line["half_width_kg_m2"] for line in lines]
    colours = [QUIET if line["source"].startswith(("torque scale", "speed scale")) else OURS for line in lines]
    bars = axes.barh([line["source"] for line in lines], halves, color=colours)
    axes.bar_label(bars, [budget_figures(half, max(halves))[0] for half in halves], padding=4, fontsize="small")
    axes.margins(x=0.12)
    axes.set_xlabel("half-width that it alone leaves, kg·m²")
    axes.grid(axis="x", alpha=0.3)


def draw_friction(figure: FigureBase, document: Part) -> None:
    """Draw the points, and the straight line of T_c and B through them."""
    points = document["friction_curve"]
    speeds = [point["speed_rad_s"] for point in points]
    torques = [point["torque_nm"] for point in points]
    axes = figure.subplots()
    axes.errorbar(speeds, [e["value"] for e in torques], _bars(torques), fmt="o", color=DARK, ms=5, capsize=3, lw=1.2,
                  label="at steady speed")
    viscous, coulomb = document["viscous_nm_s_rad"], document["coulomb_nm"]
    if viscous is not None and coulomb is not None and min(speeds) * max(speeds) > 0.0:
        sign = 1.0 if max(speeds) > 0.0 else -1.0
        ends = [min(speeds, key=abs), max(speeds, key=abs)]
        axes.plot(ends, [sign * coulomb["value"] + viscous["value"] * end for end in ends], color=OURS, lw=1.4,
                  label="T$_c$ + B ω of the result")
    axes.set(xlabel="speed, rad/s", ylabel="friction torque, N·m")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3)


def draw_opinions(figure: FigureBase, document: Part) -> None:
    """Draw each estimate of the inertia from this run on one axis."""
    rows: list[tuple[str, Part, str]] = []
    inertia, paper = document["inertia_kg_m2"], document["paper"]
    if inertia is not None:
        total = {"value": inertia["value"], "low": inertia["low_total"], "high": inertia["high_total"]}
        rows.append(("result", total, OURS))
        rows.append(("repeatability", inertia, QUIET))
    if document["compliant"] is not None and document["compliant"]["total_inertia_kg_m2"] is not None:
        rows.append(("J_r + J_L", document["compliant"]["total_inertia_kg_m2"], OURS))
    rows += [(f"cross-check, {opinion['route']}", opinion["inertia_kg_m2"],
              PAPER if opinion["agrees"] is False else DARK) for opinion in document["second_opinions"]]
    if paper is not None and paper["inertia_kg_m2"] is not None:
        alone = paper["inertia_kg_m2"]
        rows.append(("acceleration regression", {"value": alone, "low": alone, "high": alone}, PAPER))
    axes = figure.subplots()
    for at, (_, part, colour) in enumerate(rows):
        axes.errorbar([part["value"]], [at], xerr=_bars([part]), fmt="o", color=colour, ms=6, capsize=4, lw=1.6)
    if inertia is not None:
        axes.axvspan(inertia["low"], inertia["high"], color=OURS, alpha=0.12, lw=0)
    axes.set_yticks(range(len(rows)), [title for title, _, _ in rows])
    axes.invert_yaxis()
    axes.margins(y=0.15)
    axes.set_xlabel("kg·m² at the motor shaft")
    axes.grid(axis="x", alpha=0.3)


def _bars(estimates: Sequence[Part]) -> list[list[float]]:
    """Return distances down and up for errorbar; an open side has no bar."""
    down = [0.0 if e["low"] is None else max(0.0, e["value"] - e["low"]) for e in estimates]
    up = [0.0 if e["high"] is None else max(0.0, e["high"] - e["value"]) for e in estimates]
    return [down, up]


def _width(hertz: Sequence[float]) -> float:
    gaps = [b - a for a, b in pairwise(hertz)]
    return 0.4 * min(gaps) if gaps and min(gaps) > 0.0 else 0.02
