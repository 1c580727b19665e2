"""The small tables of the result card: budget, second opinions, friction over speed, a compliant shaft."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from tdhil.report.numbers import percent, plus_minus, with_interval

_AGREES = {True: ("agrees", "green"), False: ("DOES NOT AGREE", "bold red"), None: ("nothing to compare with", "dim")}

_NOTHING = 1e-5           # of J: a source of less than that is none

Row = tuple[str, Text | str]


def compliant_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    """What turns behind the spring; a quantity that the data leave open is said to be so."""
    shaft = document["compliant"]
    if shaft is None:
        return
    yield "shaft", "compliant: J above is the motor's side, J_r"
    for title, key, unit in (
        ("J_L behind the spring", "load_inertia_kg_m2", "kg·m²"),
        ("J_r + J_L", "total_inertia_kg_m2", "kg·m²"),
        ("spring k", "stiffness_nm_rad", "N·m/rad"),
        ("damping c", "damping_nm_s_rad", "N·m·s/rad"),
        ("resonance", "resonance_hz", "Hz"),
        ("antiresonance", "antiresonance_hz", "Hz"),
    ):
        part = shaft[key]
        yield title, "left open by the data" if part is None else estimate_text(part, unit)


def opinion_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    """Every second opinion, and whether it agrees with the result."""
    for opinion in document["second_opinions"]:
        word, style = _AGREES[opinion["agrees"]]
        value = estimate_text(opinion["inertia_kg_m2"], "kg·m²")
        yield "second opinion", Text.assemble(f"{value}  ", (word, style), f", {opinion['route']}")


def friction_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    """Friction torque at every steady speed of the run, two to a line."""
    points = [f"{p['speed_rad_s']:.2f} rad/s: {_plus_minus(p['torque_nm'])}" for p in document["friction_curve"]]
    if points:
        width = max(len(point) for point in points)
        pairs = [points[k : k + 2] for k in range(0, len(points), 2)]
        yield "friction, N·m", "\n".join("   ".join(f"{point:<{width}}" for point in pair).rstrip() for pair in pairs)


def budget_table(budget: Sequence[Mapping[str, Any]], value: float) -> Table:
    """Where the interval comes from, line by line, largest first."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    table.add_column(style="dim", overflow="fold")
    table.add_row(Text("what makes it unsure", style="italic"), Text("± kg·m²", style="dim"), Text("± %", style="dim"))
    for line in sorted(budget, key=lambda line: -(line["half_width_kg_m2"] or 0.0)):
        half = line["half_width_kg_m2"]
        if half is None:
            table.add_row(line["source"], "open", "", line["note"])
        elif half < _NOTHING * value:
            table.add_row(line["source"], "0", "0", line["note"])
        else:
            table.add_row(line["source"], f"{half:.2g}", percent(half, value).strip("±% "), line["note"])
    return table


def estimate_text(part: Mapping[str, Any], unit: str) -> str:
    """An estimate of the document with its interval; an open side is said."""
    if part["low"] is None or part["high"] is None:
        return f"{part['value']:.4g} {unit}, open on {'both sides' if part['low'] == part['high'] else 'one side'}"
    return with_interval(part["value"], part["low"], part["high"], unit)


def inertia_text(part: Mapping[str, Any], kind: str = "") -> str:
    """J with the interval that includes the torque scale (``_total``), or that of the repeatability."""
    value, low, high = part["value"], part["low" + kind], part["high" + kind]
    return f"{with_interval(value, low, high, 'kg·m²')}  {percent(0.5 * (high - low), value)}"


def _plus_minus(part: Mapping[str, Any]) -> str:
    return plus_minus(part["value"], 0.5 * (part["high"] - part["low"]))
