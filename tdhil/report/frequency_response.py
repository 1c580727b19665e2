"""Frequency response of a result: its figures, the text below them, and the table on a terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text as Words

from tdhil.report.document import SIMULATED, coded_warnings
from tdhil.report.graphs import GRAPHS
from tdhil.report.page import repeatable_figures
from tdhil.report.plots import CAPTION_SIGNS, DARK, OURS, PAPER, PNG_DPI, QUIET, level_ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

Part = Mapping[str, Any]

_ODD, _EVEN = 0.7, 0.3      # share of odd harmonics: above the first "odd", below the second "even" is named
_COLOURS = (DARK, OURS, PAPER, "#1a7f37", "#7c3aed", "#0e7490")
_SIZE_IN = (7.0, 8.6)       # inches, of a figure with all panels


# ---------------------------------------------------------------------------------------------------------------------
# Sentences


def response_sentences(found: Part) -> tuple[str, ...]:
    """Return sentences on the response: its uncertainty, and noise compared with distortion."""
    lines, distortion = found["lines"], found["distortion"]
    halves = [_half_rel(line) for line in lines]
    known = [half for half in halves if half is not None]
    said = []
    if known:
        below = len(halves) - len(known)
        where = (f"±{min(known):.2g} % at the best and ±{max(known):.2g} % at the worst of {len(lines)} lines"
                 if len(known) > 1 else f"±{known[0]:.2g} % at one of {len(lines)} lines" if below
                 else f"±{known[0]:.2g} % at the only line")
        said.append(f"|ω/T| is known to {where}" + (f"; {below} {'is' if below == 1 else 'are'} below the noise."
                                                    if below else "."))
    else:
        said.append("All lines are below the noise. Raise --amplitude or --periods.")
    harmonics, speeds = len(distortion["harmonics"]), len(found["mean_speeds_rad_s"])
    where = " and ".join(text for text, there in (
        (f"{harmonics} unexcited harmonics", distortion["by_harmonics"] is not None),
        (f"{speeds} mean speeds", distortion["by_speed"] is not None)) if there)
    if distortion["p_value"] is None:
        said.append("Distortion was not tested: the recording has no unexcited harmonic and no second mean speed.")
    elif not distortion["detected"]:
        said.append(f"No nonlinear distortion was detected (p = {distortion['p_value']:.2g}, {where}): "
                    "the scatter is noise.")
    else:
        said.append(f"Nonlinear distortion was detected (p = {distortion['p_value']:.1g}, {where}); "
                    "the intervals include it.")
        said.extend(_causes(distortion))
        if found.get("realisations", 1) == 1:
            said.append("One set of phases does not measure the distortion of the lines themselves: the intervals of "
                        "weak lines may be too narrow. Measure it by a multisine with --realisations 2.")
    return tuple(said)


def _causes(distortion: Part) -> list[str]:
    said = []
    by_harmonics, by_speed, odd = (distortion[key] for key in ("by_harmonics", "by_speed", "odd_share"))
    if by_harmonics is not None and by_harmonics < 0.01 and odd is not None:
        if odd >= _ODD:
            said.append("Odd harmonics dominate: look for a speed that changes its sign, backlash, or a torque limit.")
        elif odd <= _EVEN:
            said.append("Even harmonics dominate: look for friction or torque that differs with speed or direction.")
        else:
            said.append("Odd and even harmonics are present: look for backlash, stick-slip, or a torque limit.")
    if by_speed is not None and by_speed < 0.01:
        said.append("The response differs between the mean speeds: friction, or a limit, changes with the speed.")
    return said


def _half_rel(line: Part) -> float | None:
    """Return the half-width of |ω/T|, %; None if it is open."""
    size = line["magnitude"]
    return None if size["high"] is None else 50.0 * (size["high"] - size["low"]) / size["value"]


# ---------------------------------------------------------------------------------------------------------------------
# Figures


def draw_bode(figure: FigureBase, found: Part) -> None:
    """Draw |ω/T| with noise and distortion below it, and the phase."""
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    _magnitude(top, found, "each line by itself", DARK)
    _phase(below, found, DARK, OURS)
    _finish((top, below))
    top.legend(fontsize="small", loc="best", ncols=2)


def save_responses(parts: Sequence[tuple[str, Part]], path: Path) -> None:
    """Write one figure of several responses: |ω/T|, phase, apparent inertia, residuals, coherence. Raises OSError."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with repeatable_figures(), rc_context({"font.size": 9.0}):
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        draw_responses(figure, parts)
        metadata = {"Date": None, "Creator": None} if path.suffix.lower() == ".svg" else None
        figure.savefig(path, dpi=PNG_DPI, metadata=metadata)


def draw_faults(figure: FigureBase, found: Part) -> None:
    """Draw the two panels that show faults: |ω/T| with noise and distortion, and the apparent inertia."""
    axes = figure.subplots(2, 1, sharex=True)
    _magnitude(axes[0], found, "each line by itself", DARK)
    _inertia(axes[1], found, DARK, OURS)
    _finish(axes)
    axes[0].legend(fontsize="small", loc="best", ncols=2)


def draw_responses(figure: FigureBase, parts: Sequence[tuple[str, Part]]) -> None:
    """Draw |ω/T|, phase, apparent inertia, residuals and coherence of each named response, and a line on how to read
    them; a single response also gets its sentences.
    """
    axes = figure.subplots(5, 1, sharex=True, height_ratios=(3, 2, 3, 1, 1))
    for number, (name, found) in enumerate(parts):
        colour = _COLOURS[number % len(_COLOURS)]
        fitted = OURS if len(parts) == 1 else colour
        _magnitude(axes[0], found, name, colour, alone=len(parts) == 1)
        _phase(axes[1], found, colour, fitted)
        _inertia(axes[2], found, colour, fitted)
        axes[4].plot([line["hertz"] for line in found["lines"]], [line["coherence"] for line in found["lines"]], "o",
                     color=colour, ms=4)
        shown = [line for line in found["lines"] if line["residual_sd"] is not None]
        axes[3].plot([line["hertz"] for line in shown], [line["residual_sd"] for line in shown], "o", color=colour,
                     ms=4)
    axes[3].axhline(1.0, color=DARK, lw=0.8, ls=":")
    axes[3].set_ylabel("residual,\nst. dev.")
    axes[3].margins(y=0.25)             # whole markers in a low panel
    axes[3].set_ylim(bottom=0.0)
    axes[4].set_ylabel("coherence")
    below = max(0.01, 1.0 - min(line["coherence"] for _, found in parts for line in found["lines"]))
    axes[4].set_ylim(1.0 - 1.25 * below, 1.0 + 0.25 * below)
    _finish(axes)
    axes[0].legend(fontsize="small", loc="best", ncols=2)
    said = response_sentences(parts[0][1]) if len(parts) == 1 else ()
    reading = GRAPHS["response" if len(parts) == 1 else "compare"].reading
    figure.supxlabel("\n".join(fill(text, CAPTION_SIGNS) for text in (" ".join(said), reading) if text),
                     fontsize="small")


def _finish(every: Sequence[Axes]) -> None:
    for axes in every:
        axes.set_xscale("log")
        axes.grid(alpha=0.3, which="both")
        level_ticks(axes.xaxis)
        for which in ("major", "minor"):
            getattr(axes.xaxis, f"set_{which}_formatter")(_plain_number)
    every[-1].set_xlabel("frequency, Hz")


def _plain_number(value: float, _: object = None) -> str:
    """Return ``0.2``, the label of a logarithmic axis; '' for 7 and 9, which would touch their neighbours."""
    return "" if f"{value:.0e}"[0] in "79" else f"{value:g}"


def _magnitude(axes: Axes, found: Part, name: str, colour: str, alone: bool = True) -> None:
    curve, lines = found["curve"], found["lines"]
    if curve:
        hertz = [point["hertz"] for point in curve]
        axes.fill_between(hertz, *_band(curve, "magnitude"), color=OURS if alone else colour, alpha=0.25, lw=0)
        axes.plot(hertz, [point["magnitude"]["value"] for point in curve], color=OURS if alone else colour, lw=1.3,
                  label=f"model: {found['model']}" if alone else None)
    _errors(axes, lines, "magnitude", colour, name)
    hertz = [line["hertz"] for line in lines]
    for key, label, shade, mark in (("noise_rel", "noise", QUIET, "v"), ("distortion_rel", "distortion", PAPER, "^")):
        size = [line["magnitude"]["value"] * line[key] for line in lines]
        if alone and any(one > 0.0 for one in size):
            entry = label if key == "noise_rel" or found["distortion"]["detected"] else f"{label} (not detected)"
            axes.plot(hertz, [one if one > 0.0 else math.nan for one in size], mark, color=shade, ms=5, label=entry,
                      mfc=shade if key == "noise_rel" or found["distortion"]["detected"] else "none")
    axes.set_yscale("log")
    axes.set_ylabel("|ω/T|, rad/(s·N·m)")


def _phase(axes: Axes, found: Part, colour: str, fitted: str) -> None:
    """Draw the lines in ``colour``, and the model with its band in ``fitted``."""
    curve = found["curve"]
    if curve:
        hertz = [point["hertz"] for point in curve]
        middle = _unwrapped([point["phase_rad"]["value"] for point in curve])
        half = [math.degrees(point["phase_rad"]["high"] - point["phase_rad"]["value"]) for point in curve]
        axes.fill_between(hertz, [m - h for m, h in zip(middle, half, strict=True)],
                          [m + h for m, h in zip(middle, half, strict=True)], color=fitted, alpha=0.25, lw=0)
        axes.plot(hertz, middle, color=fitted, lw=1.3)
    lines = found["lines"]
    middle = _unwrapped([line["phase_rad"]["value"] for line in lines])
    half = [math.degrees(line["phase_rad"]["high"] - line["phase_rad"]["value"]) for line in lines]
    axes.errorbar([line["hertz"] for line in lines], middle, half, fmt="o", color=colour, ms=4, capsize=3, lw=1.1)
    axes.set_ylabel("phase of ω/T, °")


def _inertia(axes: Axes, found: Part, colour: str, fitted: str) -> None:
    curve = found["curve"]
    if curve:
        hertz = [point["hertz"] for point in curve]
        axes.fill_between(hertz, *_band(curve, "apparent_inertia_kg_m2"), color=fitted, alpha=0.25, lw=0)
        axes.plot(hertz, [point["apparent_inertia_kg_m2"]["value"] for point in curve], color=fitted, lw=1.3)
    _errors(axes, found["lines"], "apparent_inertia_kg_m2", colour, None)
    axes.set_ylabel("Im(T/ω) / 2πf, kg·m²")


def _errors(axes: Axes, lines: Sequence[Part], key: str, colour: str, name: str | None) -> None:
    """Draw values with bars; a line with an open interval has a hollow mark and no bar."""
    for whole, face in ((True, colour), (False, "none")):
        shown = [line for line in lines if (line[key]["high"] is not None) is whole]
        if not shown:
            continue
        values = [line[key]["value"] for line in shown]
        bars = [[value - line[key]["low"] for value, line in zip(values, shown, strict=True)],
                [line[key]["high"] - value for value, line in zip(values, shown, strict=True)]] if whole else None
        axes.errorbar([line["hertz"] for line in shown], values, bars, fmt="o", color=colour, mfc=face, ms=4, capsize=3,
                      lw=1.1, label=(name if whole else "open interval"))


def _band(curve: Sequence[Part], key: str) -> tuple[list[float], list[float]]:
    return [point[key]["low"] for point in curve], [point[key]["high"] for point in curve]


def _unwrapped(phases_rad: Sequence[float]) -> list[float]:
    """Return phases without jumps, in degrees."""
    found: list[float] = []
    for phase in phases_rad:
        turned = math.degrees(phase)
        if found:
            turned += 360.0 * round((found[-1] - turned) / 360.0)
        found.append(turned)
    return found


# ---------------------------------------------------------------------------------------------------------------------
# Table on a terminal, in 80 columns; in a narrower one, as two tables below each other

_COLUMNS = (("Hz", 8), ("|ω/T|", 9), ("±%", 7), ("phase °", 7), ("±°", 6), ("kg·m²", 9), ("noise%", 6), ("dist.%", 6),
            ("coh.", 5), ("resid.", 6))
_WHOLE = sum(width + 1 for _, width in _COLUMNS) - 1
_STACKED = ((0, 1, 2, 3, 4), (0, 5, 6, 7, 8, 9))        # columns of the two tables


def print_responses(responses: Sequence[Part], console: Console) -> None:
    """Print each log's response as a table with sentences and warnings; if a log has no response, print the reason.

    The legend of the tables follows once, at the end.
    """
    for number, one in enumerate(responses):
        if number:
            console.print()
        simulated = f"{SIMULATED} · " if one["simulated"] else ""
        console.print(Words(f"frequency response ω/T · {simulated}{one['log']}", style="bold"))
        found = one["frequency_response"]
        if found is None:
            console.print(f"none: {one['reason']}")
        else:
            _print_lines(found, console)
            for sentence in response_sentences(found):
                console.print(sentence)
        for warning in coded_warnings(one):
            console.print(Words(f"! {warning}", style="yellow"))
    if any(one["frequency_response"] for one in responses):
        console.print()
        console.print(Words("± is half the interval, torque scale taken as exact. kg·m²: apparent inertia Im(T/ω)/2πf. "
                            "noise, dist.: standard uncertainty by noise and by distortion; –: no distortion was "
                            "detected. coh.: coherence of speed and torque. resid.: in standard deviations from the "
                            "model.", style="dim"))


def _print_lines(found: Part, console: Console) -> None:
    """Print the lines as a table, and below it the confidence and the model."""
    rows = [_row(line, found["distortion"]["detected"]) for line in found["lines"]]
    for columns in (range(len(_COLUMNS)),) if console.width >= _WHOLE else _STACKED:
        console.print(Words(" ".join(f"{_COLUMNS[at][0]:>{_COLUMNS[at][1]}}" for at in columns), style="dim"))
        for row in rows:
            console.print(" ".join(f"{row[at]:>{_COLUMNS[at][1]}}" for at in columns))
    model = "no model is fitted" if found["model"] == "none" else f"model: {found['model']}"
    console.print(Words(f"{100.0 * found['confidence']:g} % intervals; {model}", style="dim"))


def _row(line: Part, distorted: bool) -> list[str]:
    """Return the cells of a line, in the order of `_COLUMNS`."""
    half, turn = _half_rel(line), math.degrees(line["phase_rad"]["high"] - line["phase_rad"]["value"])
    residual = line["residual_sd"]
    return [f"{line['hertz']:.4g}", f"{line['magnitude']['value']:.4g}", "open" if half is None else f"{half:.2g}",
            f"{math.degrees(line['phase_rad']['value']):.1f}", f"{turn:.2g}",
            f"{line['apparent_inertia_kg_m2']['value']:.5g}", f"{100.0 * line['noise_rel']:.2g}",
            f"{100.0 * line['distortion_rel']:.2g}" if distorted else "–", f"{line['coherence']:.3f}",
            "–" if residual is None else f"{residual:.2g}"]
