"""Gains over depth, for the document, the terminal and the page; settings of the drive; format of a speed or a gain."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

from rich.text import Text as Words

from tdhil.report.blocks import Column, Picture, ReportSection, Table, Text
from tdhil.report.console import ENTRY_ORDER, PlainConsole, figures_table
from tdhil.report.plots import plain_ticks
from tdhil.soft_torque import (
    HIGHEST_NOISY_RPM,
    NOISY_RESOLUTION,
    DepthRow,
    DepthSchedule,
    DrawnValues,
    DriveSetting,
    SpeedController,
)

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

Part = Mapping[str, Any]


def spread_document(spread: DrawnValues, resolution_share: float) -> dict[str, float | None]:
    """Return median of the sampled true values and 95 % interval; None: above the highest speed tried."""
    median = spread.median
    low, high = spread.interval(resolution_share * (median or 0.0))
    return {"value": median, "low": low, "high": high}


def finite(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values, with None for infinite ones."""
    return {name: value if not isinstance(value, float) or math.isfinite(value) else None
            for name, value in values.items()}


def gain_words(value: float) -> str:
    """Return the gain with four digits, without a power of ten."""
    return f"{value:.0f}" if value >= 1e3 else f"{value:.4g}"


def setting_words(setting: Part) -> str:
    """Return the value of a parameter of the drive with its unit, or why there is none."""
    return str(setting["why"]) if setting["value"] is None else f"{gain_words(setting['value'])} {setting['unit']}"


def settings_section(settings: Sequence[tuple[str, str, str]], order: str = ENTRY_ORDER) -> ReportSection:
    """Return the drive's parameters with values and the confidence of their entries, if any; the order of P and I."""
    how = ("tdhil wrote nothing to the drive. Change one value at a time, at a low speed, with the hard-wired "
           f"emergency stop within reach. {order}")
    if not settings:
        return ReportSection("To be typed into the drive, by hand", (Text(how),))
    return ReportSection("To be typed into the drive, by hand", (
        Table((Column("parameter", 0.4), Column("value", 0.45), Column("confidence", 0.15)), tuple(settings)),
        Text(f"{how} The confidence is that of the profile's entry (docs/reference/profiles.md)."),
    ))


def noisy_speed(part: Part) -> str:
    """Return a critical speed with its interval, rpm."""
    if part["value"] is None:
        return f"> {HIGHEST_NOISY_RPM:.0f}"
    high = f"> {HIGHEST_NOISY_RPM:.0f}" if part["high"] is None else f"{part['high']:.0f}"
    return f"{part['value']:.0f} ({part['low']:.0f}–{high})"


# ---------------------------------------------------------------------------------------------------------------------


def schedule_document(
    found: DepthSchedule, ratio: float, settings_of: Callable[[SpeedController], Sequence[DriveSetting]]
) -> dict[str, Any]:
    """Return the schedule as plain data; gains at the motor shaft and at the main shaft.

    ``settings_of``: the drive's own parameters for gains at the motor shaft.
    """
    def row(one: DepthRow) -> dict[str, Any]:
        law = one.controller
        head = {"depth_m": one.depth_m, "lowest_mode_hz": one.mode_hz, "refused": one.refusal or None}
        if law is None or one.worst is None:
            return head
        return {
            **head, "a": one.softness, "frequency_factor": one.frequency_factor,
            "at_main_shaft": asdict(law), "at_motor": asdict(law.at_shaft(ratio)),
            "drive_parameters": [asdict(setting) for setting in settings_of(law.at_shaft(ratio))],
            "worst_margins": finite(asdict(one.worst)), "failed": list(one.failed),
            "critical_under_noise_rpm": None if one.cure is None else _speeds(one.cure),
            "compared_critical_rpm": None if one.compared is None else _speeds(one.compared),
        }

    return {
        "kind": found.kind, "compared_with": found.compared_with, "rows": [row(one) for one in found.rows],
        "between": [row(one) for one in found.between], "sentence": _worst_between(found),
    }


def _speeds(drawn: DrawnValues) -> dict[str, float | None]:
    return spread_document(drawn, NOISY_RESOLUTION)


def _worst_between(found: DepthSchedule) -> str:
    """Return a text on the worst loss by linear interpolation between the rows."""
    if not found.between:
        return "No two neighbouring depths have gains: nothing can be interpolated."
    margins = [(one.worst.phase_deg, one.depth_m) for one in found.between if one.worst is not None]
    least, at_m = min(margins)
    words = f"Interpolated halfway between rows: least phase margin {least:.0f}° (at {at_m:.0f} m)"
    thin = [one for one in found.between if one.failed]
    words += f", margins too small at {', '.join(f'{one.depth_m:.0f}' for one in thin)} m" if thin else ""
    known = {one.depth_m: one.cure.median for one in (*found.rows, *found.between) if one.cure is not None}
    costs = []
    for one in found.between:
        above = max((row.depth_m for row in found.rows if row.depth_m < one.depth_m and row.controller), default=0.0)
        below = min((row.depth_m for row in found.rows if row.depth_m > one.depth_m and row.controller), default=0.0)
        own, ends = known.get(one.depth_m), (known.get(above), known.get(below))
        if own is not None and ends[0] is not None and ends[1] is not None:
            costs.append((own / max(ends[0], ends[1]) - 1.0, one.depth_m))
    if costs:
        share, at_m = max(costs)
        words += (f"; critical speed at most {100.0 * share:.0f} % above that of the neighbouring rows (at {at_m:.0f}"
                  " m)" if share > NOISY_RESOLUTION else "; critical speed nowhere above that of the neighbouring rows")
    return words + "."


def print_schedule(document: Part, console: PlainConsole) -> None:
    """Print the table of depths and the worst case of interpolation."""
    console.print(Words(f"gains over depth, {document['kind']}: linear in depth between two rows", style="bold"))
    console.print(figures_table(schedule_headings(document), _table(document), left=0))
    thin = any(one.get("failed") for one in document["between"])
    console.print(Words(document["sentence"], style="bold red" if thin else ""))
    for one in document["rows"]:
        if one["refused"]:
            console.print(Words(f"{one['depth_m']:.0f} m refused: {one['refused']}", style="yellow"))
    console.print()


def schedule_section(document: Part) -> ReportSection:
    """Return table and figure of the schedule."""
    headings = schedule_headings(document)
    rows = tuple(tuple(cell.replace("!", "⚠ ") for cell in cells) for cells in _table(document))
    parameters = tuple(
        (f"{one['depth_m']:.0f}", setting["title"], setting_words(setting))
        for one in _with_gains(document) for setting in one["drive_parameters"])
    blocks: list[Table | Text | Picture] = [
        Table(tuple(Column(name, 1.0 / len(headings), number=True) for name in headings), rows),
        Text(document["sentence"]),
        Picture("schedule", partial(draw_schedule, document=document), 3.6,
                "Gains and critical speed over depth. Crosses: interpolated gains, checked halfway between two rows."),
    ]
    if parameters:
        blocks.append(Table((Column("depth, m", 0.15), Column("parameter", 0.55), Column("value", 0.3)), parameters))
    return ReportSection(f"Gains over depth ({document['kind']}, at the motor shaft)", tuple(blocks))


def _with_gains(document: Part) -> list[Part]:
    return [one for one in document["rows"] if not one["refused"]]


def schedule_headings(document: Part) -> list[str]:
    """Return the names of the columns."""
    names = ["depth, m", "f₁, Hz", "P, motor", "I, motor"]
    if any(one["at_motor"]["compensated_kg_m2"] for one in _with_gains(document)):
        names.append("J_c, motor")
    names.append("phase")
    if any(one["critical_under_noise_rpm"] for one in _with_gains(document)):
        names += ["critical, rpm", f"{document['compared_with']}, rpm"]
    return names


def _table(document: Part) -> Iterator[list[str]]:
    names = schedule_headings(document)
    for one in document["rows"]:
        cells = [f"{one['depth_m']:.0f}", f"{one['lowest_mode_hz']:.3f}"]
        if one["refused"]:
            yield cells + ["refused"] + [""] * (len(names) - 3)
            continue
        gains = one["at_motor"]
        cells += [gain_words(gains["gain_nm_s_rad"]), gain_words(gains["integral_nm_rad"])]
        if "J_c, motor" in names:
            cells.append(gain_words(gains["compensated_kg_m2"]))
        phase = one["worst_margins"]["phase_deg"]
        cells.append(("!" if one["failed"] else "") + ("none needed" if phase is None else f"{phase:.0f}°"))
        if "critical, rpm" in names:
            cells += ["–" if one[key] is None else noisy_speed(one[key])
                      for key in ("critical_under_noise_rpm", "compared_critical_rpm")]
        yield cells


def draw_schedule(figure: FigureBase, document: Part) -> None:
    """Draw P and I over depth; below, the critical speed of these gains and of those for comparison."""
    rows, between = _with_gains(document), document["between"]
    noisy = any(one["critical_under_noise_rpm"] for one in rows)
    every = figure.subplots(2 if noisy else 1, 1, sharex=True, squeeze=False)[:, 0]
    depths, halfway = [[one["depth_m"] for one in part] for part in (rows, between)]
    axes = every[0]
    for key, name, colour in (("gain_nm_s_rad", "P, N·m·s/rad", "#1f5fa8"), ("integral_nm_rad", "I, N·m/rad",
                                                                              "#c2410c")):
        axes.plot(depths, [one["at_motor"][key] for one in rows], "o-", ms=3, color=colour, label=name)
        axes.plot(halfway, [one["at_motor"][key] for one in between], "x", ms=4, color=colour)
    axes.set_yscale("log")
    axes.set_ylabel("at the motor")
    plain_ticks(axes.yaxis)
    if noisy:
        axes = every[1]
        for key, name, colour in (("compared_critical_rpm", document["compared_with"], "0.35"),
                                  ("critical_under_noise_rpm", document["kind"], "#1f5fa8")):
            parts = [(one["depth_m"], one[key]) for one in rows if one.get(key)]
            found = [(depth, part) for depth, part in parts if part["value"] is not None]
            depths = [depth for depth, _ in found]
            axes.plot(depths, [part["value"] for _, part in found], "o-", ms=3, color=colour, label=name)
            axes.fill_between(depths, [part["low"] for _, part in found],
                              [part["high"] or HIGHEST_NOISY_RPM for _, part in found], color=colour, alpha=0.15, lw=0)
        crosses = [(one["depth_m"], one["critical_under_noise_rpm"]) for one in between]
        known = [(depth, part["value"]) for depth, part in crosses if part and part["value"] is not None]
        axes.plot([depth for depth, _ in known], [value for _, value in known], "x", ms=4, color="#1f5fa8")
        axes.set_ylabel("critical speed, rpm")
        axes.set_ylim(bottom=0.0)
    for one in every:
        one.grid(alpha=0.3)
        one.legend(fontsize="small")
    every[-1].set_xlabel("depth, m")
