"""Result of `tdhil tune speed`: as a JSON document, on a terminal, as a figure and as a page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text as Words

from profiles import CodedText, MessageCode, entry_of, with_code
from profiles.quantities import printed_interval
from tdhil.errors import UsageError
from tdhil.report.blocks import AnswerBox, Column, Pairs, Picture, Report, ReportSection, Table, Text
from tdhil.report.console import PlainConsole, figures_table, names_and_texts, print_settings
from tdhil.report.document import marks, only_finite
from tdhil.report.graphs import GRAPHS
from tdhil.report.intervals import part_with_interval, table_cell
from tdhil.report.page import repeatable_figures
from tdhil.report.plots import CAPTION_SIGNS, PNG_DPI, plain_ticks
from tdhil.report.schedule import gain_words, setting_words, settings_section
from tdhil.soft_torque import DriveSetting
from tdhil.speed_loop import (
    LoopCurve,
    LoopDesign,
    LoopRow,
    MeasuredShaft,
    NotchFilter,
    Range,
    deviation_from_model,
    loop_at_lines,
    loop_curve,
)
from tdhil.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

Part = Mapping[str, Any]

_COLOURS = {"present": "0.35", "tuned": "#1f5fa8"}
_SIZE_IN = (7.0, 8.4)
"""Size of a figure with all panels, inches."""
_STEP_POINTS = 300
"""Points of a step response in the document."""
_UNLIKE = 3.0
"""Half-widths by which a measured line may differ from the shaft used for the tuning."""
_UNLIKE_REL = 0.1
"""Relative difference below which no line is named in a warning."""
_BEYOND_LINES = 1.01
"""Bandwidth over the highest excited frequency, from which a warning follows. The rounded bandwidth of its advice stays
below."""
_EXPLAINED = {
    "P, I": "gains at the motor shaft, N·m·s/rad and N·m/rad",
    "margins": "of the open loop: best estimate, and the least over all corners of the intervals",
    "peak |S|": "greatest factor by which the loop enlarges a disturbance",
    "bandwidth": "frequency up to which the speed follows the set speed within 3 dB",
    "step": "small step of the set speed, without torque limit, ramp or setpoint filter; settled within 5 %",
}


@dataclass(frozen=True)
class LoopTunedFor:
    """Source of the numbers."""

    source: str
    """Path of the result or log."""
    simulated: bool
    model: str
    profile: str | None
    gear_ratio: float
    lags_from: str = ""
    present_from: str | None = None
    """Source of the present gains, or why they are not known; None: no source."""
    gap_from: str | None = None
    """Source of the inertia of the motor side, which turns alone while a backlash is open; None: no backlash."""
    settings: Mapping[str, tuple[DriveSetting, ...]] = field(default_factory=dict)
    """Settings in the drive's own parameters, by the row's kind."""
    notch_named: bool = False
    """True if the profile names the parameters of the drive's notch."""
    warnings: tuple[str, ...] = ()
    reported_speed_lag_s: Range | None = None
    """Lag of the reported speed, for tune verify; None: unknown."""
    coulomb_nm: Range | None = None
    """Coulomb friction, for the plan of tune verify; None: unknown."""
    rehearsed_faults: tuple[str, ...] = ()
    """Faults that were scripted in the run."""


def loop_document(design: LoopDesign, shaft: MeasuredShaft | None, tuned_for: LoopTunedFor) -> dict[str, Any]:
    """Return plain data for `json.dumps`, at the motor shaft; null for an infinite value."""
    case, plant = design.case, design.case.plant
    lowest_hz = None if shaft is None else float(shaft.hertz.min())
    warnings = [*tuned_for.warnings, *_warnings(design, shaft, tuned_for)]
    document = {
        "kind": "speed_loop_tuning",
        "tuned_for": {
            "source": tuned_for.source, "simulated": tuned_for.simulated, "model": tuned_for.model,
            "profile": tuned_for.profile, "gear_ratio": tuned_for.gear_ratio, "present_from": tuned_for.present_from,
            "rehearsed_faults": list(tuned_for.rehearsed_faults),
        },
        "plant": {name: None if part is None else [asdict(one) for one in part] if isinstance(part, tuple)
                  else asdict(part) for name, part in vars(plant).items()} | {
            "total_inertia_kg_m2": plant.believed.total_inertia_kg_m2, "lags_from": tuned_for.lags_from,
            "gap_from": tuned_for.gap_from, "coulomb_nm": tuned_for.coulomb_nm and asdict(tuned_for.coulomb_nm),
        },
        "reported_speed_lag_s": None if tuned_for.reported_speed_lag_s is None else asdict(
            tuned_for.reported_speed_lag_s),
        "required": {"phase_deg": case.phase_deg, "gain_db": case.gain_db, "bandwidth_hz": case.bandwidth_hz},
        "controllers": [_controller(row, design, tuned_for.settings.get(row.kind, ())) for row in design.rows],
        "bandwidth_without_notch_hz": design.without_notch_hz,
        "sentence": _sentence(design, open_gap=_misses_gap(design, tuned_for)),
        "gains_by_hand": _gains_by_hand(tuned_for),
        "notch_by_hand": _notch_by_hand(design.tuned.gains.notch, tuned_for),
        "curves": {row.kind: _curves(loop_curve(design, row.gains, lowest_hz)) for row in design.rows},
        "measured": None if shaft is None else {
            "hertz": shaft.hertz.tolist(), "half_rel": shaft.half_rel.tolist(),
            "deviation_rel": deviation_from_model(design, shaft).tolist(),
            "loops": {row.kind: _points(loop_at_lines(design, row.gains, shaft)) for row in design.rows},
        },
        "steps": {row.kind: _step(row) for row in design.rows},
        "warnings": [str(one) for one in warnings],
        "warning_codes": [entry_of(one, MessageCode.RESULT_WARNING).code for one in warnings],
        "tdhil": __version__,
    }
    cleaned = only_finite(document)
    assert isinstance(cleaned, dict)
    return cleaned


def _controller(row: LoopRow, design: LoopDesign, settings: tuple[DriveSetting, ...]) -> dict[str, Any]:
    gains = row.gains
    return {
        "kind": row.kind,
        "gain_nm_s_rad": gains.gain_nm_s_rad, "integral_nm_rad": gains.integral_nm_rad,
        "integral_time_s": gains.gain_nm_s_rad / gains.integral_nm_rad,
        "notch": None if gains.notch is None else asdict(gains.notch) | {
            "width_hz": gains.notch.width_hz, "depth_db": gains.notch.depth_db},
        "drive_parameters": [asdict(one) for one in settings],
        "as_believed": asdict(row.believed), "worst": asdict(row.worst),
        "failed": list(_failed(row, design)),
        **{name: asdict(getattr(row, name)) for name in ("bandwidth_hz", "overshoot_share", "rise_s", "settling_s")},
    }


def _failed(row: LoopRow, design: LoopDesign) -> Iterator[str]:
    """Yield each margin that is below the required one in the worst case."""
    worst, case = row.worst, design.case
    if not worst.stable:
        yield "unstable in the worst case" if row.believed.stable else "unstable, also with the best estimate"
        return
    if worst.conditional:
        yield "unstable with a lower gain, such as at the torque limit"
    if worst.phase_deg < case.phase_deg:
        yield f"phase margin {worst.phase_deg:.0f}° (limit {case.phase_deg:g}°)"
    if worst.gain_db < case.gain_db:
        yield f"gain margin {worst.gain_db:.1f} dB (limit {case.gain_db:g} dB)"


def _warnings(design: LoopDesign, shaft: MeasuredShaft | None, tuned_for: LoopTunedFor) -> Iterator[str]:
    for row in design.rows[:-1]:
        if failed := list(_failed(row, design)):
            what = "The present gains have thin margins:" if row.worst.stable else "The present loop is"
            yield CodedText(f"{what} {', '.join(failed)}.", MessageCode.PRESENT_GAINS_THIN)
    if _misses_gap(design, tuned_for):
        yield CodedText(
            "The coupling or gear behind the motor has backlash. While it is open, the motor turns alone with less "
            "inertia than J, and the margins do not hold. State the inertia of the motor side with --motor-inertia, or "
            "remove the backlash.", MessageCode.LOOP_GAP_OPEN)
    if "assumed" in tuned_for.lags_from:
        yield CodedText(
            "The lags of the speed loop are assumed, and they limit its gains. Measure them with tdhil identify "
            "--impedance, or state --inner-lags and --dead-time.", MessageCode.LOOP_LAGS_ASSUMED)
    if tuned_for.model.startswith("string"):
        yield CodedText("The loop contains only the lowest mode of the string. Use tdhil tune soft-torque for the "
                        "string.", MessageCode.LOOP_ONE_MODE_ONLY)
    if shaft is None:
        return
    highest, bandwidth = float(shaft.hertz.max()), design.tuned.bandwidth_hz.value
    if bandwidth > _BEYOND_LINES * highest:
        yield CodedText(
            f"The bandwidth of {bandwidth:.3g} Hz is above the highest excited frequency of {highest:.3g} Hz. A "
            "resonance in between was not measured. Identify with a higher --frequency, or request --bandwidth "
            f"{highest:.3g}.", MessageCode.LOOP_BEYOND_RESPONSE)
    off = deviation_from_model(design, shaft)
    unlike = (off > _UNLIKE * shaft.half_rel) & (off > _UNLIKE_REL)
    if np.any(unlike):
        at = ", ".join(f"{hertz:.3g}" for hertz in shaft.hertz[unlike])
        yield CodedText(f"The measured response differs from the shaft model of the tuning at {at} Hz, by up to "
                        f"{100.0 * float(off[unlike].max()):.0f} %.", MessageCode.LOOP_UNLIKE_RESPONSE)


def _misses_gap(design: LoopDesign, tuned_for: LoopTunedFor) -> bool:
    """Return whether a backlash was found, and the worst case does not contain the motor side alone."""
    return tuned_for.gap_from is not None and design.case.plant.gap_kg_m2 is None


def _sentence(design: LoopDesign, *, open_gap: bool) -> str:
    """Return the answer. ``open_gap``: the margins do not hold while a backlash is open."""
    tuned, case = design.tuned, design.case
    closed = " while the backlash is closed" if open_gap else ""
    notch = tuned.gains.notch
    with_notch = "" if notch is None else f", with a notch at {notch.hertz:.3g} Hz"
    gains = (f"P = {gain_words(tuned.gains.gain_nm_s_rad)} N·m·s/rad and "
             f"I = {gain_words(tuned.gains.integral_nm_rad)} N·m/rad{with_notch}")
    present = next((row for row in design.rows if row.kind == "present"), None)
    if (present is not None and case.bandwidth_hz is None and present.bandwidth_hz.value >= tuned.bandwidth_hz.value
            and present.worst.keeps(case.phase_deg, case.gain_db)):
        return (f"The present gains keep the margins{closed} and are faster: {present.bandwidth_hz.value:.3g} Hz, "
                f"{present.worst.phase_deg:.0f}° and {_number(present.worst.gain_db, 1)} dB. With I = P²/(4 J), which "
                f"removes a lasting error sooner, the largest bandwidth is {tuned.bandwidth_hz.value:.3g} Hz: {gains}.")
    said = f"Type in {gains}."
    kind = "requested bandwidth" if case.bandwidth_hz is not None else "largest bandwidth with I = P²/(4 J)"
    said += (f" The {kind} is {tuned.bandwidth_hz.value:.3g} Hz, with at least {tuned.worst.phase_deg:.0f}° "
             f"and {_number(tuned.worst.gain_db, 1)} dB in the worst case{closed}.")
    if present is not None and present.worst.stable:
        said += f" The present gains give {present.bandwidth_hz.value:.3g} Hz and {present.worst.phase_deg:.0f}°."
    return said


def _gains_by_hand(tuned_for: LoopTunedFor) -> str | None:
    """Return the units of P and I if no parameters of the drive are known; else None."""
    if tuned_for.settings.get("tuned"):
        return None
    who = (f"The profile {tuned_for.profile} names no parameters of the speed loop for this drive." if tuned_for.profile
           else "The drive's parameters of the speed loop are not known without a profile.")
    return (f"{who} P is given in N·m·s/rad, I in N·m/rad and T_I in s, at the motor shaft. Look up the drive's "
            "parameters and units in its manual, and convert.")


def _notch_by_hand(notch: NotchFilter | None, tuned_for: LoopTunedFor) -> str | None:
    """Return the notch in plain units if the profile does not name the drive's; None without a notch."""
    if notch is None or tuned_for.notch_named:
        return None
    width = "" if notch.width_hz is None else f", width {notch.width_hz:.3g} Hz at −3 dB"
    said = f"Notch: frequency {notch.hertz:.3g} Hz{width}, depth {notch.depth_db:.3g} dB."
    if tuned_for.profile is None:
        return f"{said} The drive's notch is not known without a profile. Look up its parameters in the manual."
    return (f"{said} The profile {tuned_for.profile} does not describe the drive's notch. Look up its parameters in "
            "the manual, or add --no-notch if the drive has none.")


def _curves(curve: LoopCurve) -> dict[str, Any]:
    names = ("value", "low", "high")
    return {"hertz": curve.hertz.tolist()} | {
        name: {end: part.tolist() for end, part in zip(names, getattr(curve, name), strict=True)}
        for name in ("gain", "phase_deg", "sensitivity")}


def _points(loop: np.ndarray[Any, np.dtype[np.complex128]]) -> dict[str, list[float]]:
    phase = np.degrees(np.angle(loop))
    phase = np.where(phase > 45.0, phase - 360.0, phase)
    return {"gain": np.abs(loop).tolist(), "phase_deg": phase.tolist(),
            "sensitivity": np.abs(1.0 / (1.0 + loop)).tolist()}


def _step(row: LoopRow) -> dict[str, list[float]]:
    """Return the response until twice the settling time, as `_STEP_POINTS` points."""
    settled = row.settling_s.high
    end = len(row.time_s) if not math.isfinite(settled) else int(np.searchsorted(row.time_s, 2.0 * settled)) + 1
    every = max(1, end // _STEP_POINTS)
    return {name: getattr(row, part)[:end:every].tolist() for name, part in
            (("time_s", "time_s"), ("value", "speed"), ("low", "lowest"), ("high", "highest"))}


# ---------------------------------------------------------------------------------------------------------------------
# Output on a terminal


def print_loop_tuning(document: Part, console: PlainConsole) -> None:
    """Print gains, margins, step response and their conditions, in 80 columns."""
    simulated = f" · {found}" if (found := marks(document["tuned_for"])) else ""
    console.print(Words(document["sentence"], style="bold green"))
    console.print()
    console.print(Words(f"speed loop of the drive{simulated}", style="bold"))
    console.print(names_and_texts(_rests_on(document)))
    console.print()
    console.print(figures_table(("at the motor shaft", *(one["kind"] for one in document["controllers"])),
                                ((name, *cells) for name, cells in _rows(document))))
    console.print(names_and_texts(_EXPLAINED.items(), quiet=True))
    console.print()
    if document["gains_by_hand"] is not None:
        console.print(Words(document["gains_by_hand"]))
    print_settings(list(_setting_rows(document)), console)
    if document["notch_by_hand"] is not None:
        console.print()
        console.print(Words(document["notch_by_hand"]))
    if document["warnings"]:
        console.print()
    for warning, code in zip(document["warnings"], document["warning_codes"], strict=True):
        console.print(Words(with_code(warning, code), style="yellow"))


def _rests_on(document: Part) -> Iterator[tuple[str, str]]:
    plant = document["plant"]
    name = "J" if plant["resonance_hz"] is None else "J, motor side"
    yield name, part_with_interval(plant["inertia_kg_m2"], "kg·m²")
    yield "viscous friction", part_with_interval(plant["viscous_nm_s_rad"], "N·m·s/rad")
    if plant["resonance_hz"] is not None:
        yield "antiresonance", part_with_interval(plant["antiresonance_hz"], "Hz")
        yield "resonance", part_with_interval(plant["resonance_hz"], "Hz")
    yield "lags in the loop", f"{_lag_words(plant)}; {plant['lags_from']}"
    if plant["gap_from"] is not None:
        gap = plant["gap_kg_m2"]
        yield "backlash, open", plant["gap_from"] if gap is None else (
            f"motor alone with {part_with_interval(gap, 'kg·m²')}; {plant['gap_from']}")
    if document["tuned_for"]["present_from"] is not None:
        yield "present gains", document["tuned_for"]["present_from"]
    required = document["required"]
    yield "required margins", f"{required['phase_deg']:g}° and {required['gain_db']:g} dB in the worst case"
    if document["measured"]:
        off, hertz, known = (document["measured"][key] for key in ("deviation_rel", "hertz", "half_rel"))
        # the line that contradicts this shaft most, not the one that is known worst
        most = max(range(len(off)), key=lambda k: off[k] / known[k] if known[k] else 0.0)
        sure = "not bounded" if known[most] is None else f"known to ±{_percent(known[most])} %"
        yield "measured response", (
            f"{len(hertz)} lines from {min(hertz):.3g} to {max(hertz):.3g} Hz; without the lags of the reports, the "
            f"line at {hertz[most]:.3g} Hz is farthest from this shaft: by {_percent(off[most])} %, {sure}")


def _lag_words(plant: Part) -> str:
    """Return the lags, ms: each with its interval if only their sum is known well."""
    dead, together = plant["dead_time_s"], plant["lag_sum_s"]
    lags = " + ".join(f"{1e3 * lag['value']:.3g}" + ("" if together is None else
                      f" ({printed_interval(1e3 * lag['low'], 1e3 * lag['high'], 3)})") for lag in plant["lags_s"])
    if together is not None:
        low, high = 1e3 * together["low"], 1e3 * together["high"]
        return (f"{lags} ms, together {printed_interval(low, high, 3)} ms, up to {1e3 * dead['high']:.3g} ms of it as "
                "dead time")
    low, high = (1e3 * (dead[end] + sum(lag[end] for lag in plant["lags_s"])) for end in ("low", "high"))
    return f"{lags} ms, dead time {1e3 * dead['value']:.3g} ms; together {printed_interval(low, high, 3)} ms"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f}" if share > 0.1 else f"{100.0 * share:.2g}"


def _rows(document: Part) -> Iterator[tuple[str, list[str]]]:
    """Yield the name of each figure and its values, one for each controller; "!" before an insufficient margin."""
    every = document["controllers"]
    yield "P, N·m·s/rad", [gain_words(one["gain_nm_s_rad"]) for one in every]
    yield "I, N·m/rad", [gain_words(one["integral_nm_rad"]) for one in every]
    yield "T_I = P/I, s", [gain_words(one["integral_time_s"]) for one in every]
    notches = [one["notch"] for one in every]
    if any(notches):
        yield "notch, Hz; dampings", ["–" if one is None else f"{one['hertz']:.3g}; {one['numerator_damping']:g} / "
                                      f"{one['denominator_damping']:g}" for one in notches]
        yield "notch: width, Hz; depth, dB", ["–" if one is None else "; ".join(
            "–" if one[key] is None else f"{one[key]:.3g}" for key in ("width_hz", "depth_db")) for one in notches]
    limits = document["required"]
    for name, key, digits, unit in (("phase margin", "phase_deg", 0, "°"), ("gain margin", "gain_db", 1, " dB")):
        yield f"{name}, best estimate", [_margin(one["as_believed"], key, digits, unit) for one in every]
        yield f"{name}, worst", [
            ("!" if not one["worst"]["stable"] or (one["worst"][key] or math.inf) < limits[key] else "")
            + _margin(one["worst"], key, digits, unit) for one in every]
    yield "peak |S|, worst", [_number(one["worst"]["peak_sensitivity"], 2) if one["worst"]["stable"] else "!unstable"
                              for one in every]
    yield "bandwidth, Hz", [table_cell(one["bandwidth_hz"]) for one in every]
    yield "step: overshoot, %", [table_cell(one["overshoot_share"], 100.0) for one in every]
    yield "step: rise 10–90 %, s", [table_cell(one["rise_s"]) for one in every]
    yield "step: settling, s", [table_cell(one["settling_s"]) for one in every]


def _margin(part: Part, key: str, digits: int, unit: str) -> str:
    return f"{_number(part[key], digits)}{unit}" if part["stable"] and part[key] is not None else (
        "no limit" if part["stable"] else "unstable")


def _number(value: float | None, digits: int) -> str:
    return "∞" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _setting_rows(document: Part) -> Iterator[tuple[str, str, str]]:
    """Yield (parameter, value to enter, confidence), of the tuned gains."""
    for one in document["controllers"][-1]["drive_parameters"]:
        yield one["title"], setting_words(one), one["confidence"]


# ---------------------------------------------------------------------------------------------------------------------
# Figures and the page


def save_loop_picture(document: Part, path: Path) -> None:
    """Write loop, sensitivity and step response as one figure. Raises UsageError if it cannot be written."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with repeatable_figures(), rc_context({"font.size": 9.0}):
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        grid = figure.add_gridspec(2, 1, height_ratios=(5, 2))
        for part, draw, name in ((grid[0], draw_loop, "open_loop"), (grid[1], draw_step, "step")):
            place = figure.add_subfigure(part)
            draw(place, document)
            place.supxlabel(fill(GRAPHS[name].reading, CAPTION_SIGNS), fontsize="small")
        metadata = {"Date": None, "Creator": None} if path.suffix.lower() == ".svg" else None
        try:
            figure.savefig(path, dpi=PNG_DPI, metadata=metadata)
        except OSError as error:
            raise UsageError(f"can't be written ({error.strerror or error})", where=f"--plot {path}",
                             entry=MessageCode.FILE_NOT_WRITABLE) from error


def draw_loop(figure: FigureBase, document: Part) -> None:
    """Draw |L|, its phase, and |S|, with the band of all corners and the measured lines."""
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 2))
    measured = document["measured"]
    for one in document["controllers"]:
        kind = one["kind"]
        curve, colour = document["curves"][kind], _COLOURS[kind]
        for place, name in zip(axes, ("gain", "phase_deg", "sensitivity"), strict=True):
            part = curve[name]
            place.fill_between(curve["hertz"], part["low"], part["high"], color=colour, alpha=0.2, lw=0)
            place.plot(curve["hertz"], part["value"], color=colour, lw=1.4, label=kind)
            if measured:
                place.plot(measured["hertz"], measured["loops"][kind][name], "o", color=colour, ms=4,
                           label=f"{kind}, at measured lines")
    required = document["required"]
    axes[0].axhline(1.0, color="0.3", lw=0.8)
    axes[0].set(yscale="log", ylabel="|L|")
    axes[1].axhline(-180.0, color="0.3", lw=0.8)
    for side, label in ((1.0, f"{required['phase_deg']:g}° margin"), (-1.0, None)):
        axes[1].axhline(-180.0 + side * required["phase_deg"], color="#c2410c", lw=0.9, ls="--", label=label)
    rigid = document["plant"]["resonance_hz"] is None
    axes[1].set(ylabel="phase of L, °", ylim=(-270.0, -30.0 if rigid else 90.0),
                yticks=(-270, -225, -180, -135, -90, -45) if rigid else (-270, -180, -90, 0, 90))
    axes[2].axhline(1.0, color="0.3", lw=0.8)
    axes[2].set(yscale="log", ylabel="|S|", xlabel="frequency, Hz")
    hertz = document["curves"]["tuned"]["hertz"]
    axes[2].set_xlim(hertz[0], hertz[-1])
    axes[2].set_xscale("log")
    for place in axes:
        place.grid(alpha=0.3, which="both")
    plain_ticks(axes[2].xaxis)
    axes[0].legend(fontsize="small", loc="lower left")
    axes[1].legend(handles=[line for line in axes[1].lines if "margin" in str(line.get_label())], fontsize="small",
                   loc="lower left")


def draw_step(figure: FigureBase, document: Part) -> None:
    """Draw the response to a unit step of the set speed, with the band of all corners."""
    axes = figure.subplots()
    longest = 0.0
    for one in document["controllers"]:
        kind, colour = one["kind"], _COLOURS[one["kind"]]
        step = document["steps"][kind]
        if step["value"][0] is None:
            continue
        axes.fill_between(step["time_s"], step["low"], step["high"], color=colour, alpha=0.2, lw=0)
        axes.plot(step["time_s"], step["value"], color=colour, lw=1.4, label=kind)
        settled = one["settling_s"]["high"]
        longest = max(longest, 1.6 * settled if settled is not None else step["time_s"][-1])
    axes.axhline(1.0, color="0.3", lw=0.8)
    axes.set(xlabel="time, s", ylabel="speed / step of set speed", xlim=(0.0, longest or None))
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="lower right")


def loop_report(document: Part) -> Report:
    """Return the blocks of the page."""
    every = document["controllers"]
    tuned = every[-1]
    share = 0.6 / len(every)
    table = Table((Column("at the motor shaft", 0.4), *(Column(one["kind"], share, number=True) for one in every)),
                  tuple((name, *(cell.replace("!", "⚠ ") for cell in cells)) for name, cells in _rows(document)))
    sections = [
        ReportSection("Gains and margins", (table, Pairs(tuple(_EXPLAINED.items())))),
        ReportSection("Open loop and sensitivity", (
            Picture("open_loop", partial(draw_loop, document=document), 5.2,
                    "Lines: best estimate. Bands: all corners of the intervals. Points: the measured shaft without the "
                    "lags of the reports."),
        )),
        ReportSection("Step of the set speed", (
            Picture("step", partial(draw_step, document=document), 2.4,
                    "Speed of the motor after a small step, without torque limit, ramp or setpoint filter."),
        )),
    ]
    if document["gains_by_hand"] is not None:
        sections.append(ReportSection("Units of the gains", (Text(document["gains_by_hand"]),)))
    sections.append(settings_section(list(_setting_rows(document))))
    if document["notch_by_hand"] is not None:
        sections.append(ReportSection("Notch filter, to be set by hand", (Text(document["notch_by_hand"]),)))
    tuned_for = document["tuned_for"]
    sections.append(ReportSection("Basis of the result", (Pairs((
        *_rests_on(document), ("from", tuned_for["source"]), ("model", tuned_for["model"]),
        ("profile", tuned_for["profile"] or "none"))),)))
    worst = tuned["worst"]
    return Report(
        title="Speed loop of the drive",
        subtitle=f"tuned for a bandwidth of {tuned['bandwidth_hz']['value']:.3g} Hz",
        simulated=f"{marks(tuned_for)}: the result is that of a simulated rig" if tuned_for["simulated"] else "",
        answer=AnswerBox(
            "green", f"P = {gain_words(tuned['gain_nm_s_rad'])} N·m·s/rad, "
            f"I = {gain_words(tuned['integral_nm_rad'])} N·m/rad", ("at the motor shaft",),
            f"keeps {_number(worst['phase_deg'], 0)}° and {_number(worst['gain_db'], 1)} dB in the worst case"
            + (" while the backlash is closed" if MessageCode.LOOP_GAP_OPEN.code in document["warning_codes"] else ""),
            document["sentence"], ""),
        warnings=tuple(map(with_code, document["warnings"], document["warning_codes"])),
        sections=tuple(sections),
        footer=f"tdhil {document['tdhil']}",
    )
