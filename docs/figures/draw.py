"""Draws the figures of the pages into docs/images: ``python docs/figures/draw.py [NAME ...]``.

Figures of the list RUN are made from one run of the simulated drive (seed 7), the others from formulas alone. A test
draws them again and compares them with the files.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from chosen_names import chosen  # noqa: E402
from drawing import (  # noqa: E402
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PALE_BLUE,
    PALE_GREEN,
    PALE_ORANGE,
    PALE_RED,
    QUIET,
    RED,
    Axes,
    Drawing,
)

IMAGES = ROOT / "docs" / "images"
SEED = 7
SIMULATED_INERTIA_KG_M2 = 104.0  # of the default simulated rig: sim_bus/params.py


# ---------------------------------------------------------------------------------------------------------------------
# From a run


@cache
def run() -> tuple[Any, Mapping[str, Any]]:
    """Return recording and result document of `tdhil identify --simulate --seed 7`."""
    import tdhil

    with tempfile.TemporaryDirectory() as folder:
        with tdhil.simulate(seed=SEED) as drive:
            record = tdhil.run(drive, log=Path(folder) / "run.mcap")
        return record.recording, {**tdhil.identify(record).to_dict(), "log": "run.mcap"}


def five_stages() -> Drawing:
    """Speed and torque as reported over the five stages, and what each of them gives."""
    recording, document = run()
    time, end = recording.time_s - recording.time_s[0], float(recording.time_s[-1] - recording.time_s[0])
    drawing = Drawing(820, 470, "Speed and torque over the five stages of a run on the simulated drive")
    speed = Axes(drawing, (70, 64, 730, 150), (0.0, end), (0.0, 10.0))
    torque = Axes(drawing, (70, 236, 730, 150), (0.0, end), (-320.0, 350.0))
    gives = {"speed": "friction", "torque": "J, roughly", "hold": "", "acquire": "J, lags and their intervals"}
    for number, stage in enumerate(recording.stages):
        a, b = (speed.at(one - float(recording.time_s[0]), 0.0)[0] for one in (stage.start_s, stage.end_s))
        for axes in (speed, torque):
            drawing.rect(a, axes.top, b - a, axes.height, PALE_BLUE if number % 2 == 0 else "#ffffff")
        middle, low = (a + b) / 2, stage.name in ("speed", "acquire")
        side = {"setup": "start", "torque": "end", "hold": "start"}.get(stage.name, "middle")
        at = middle + {"end": 5.0, "start": -4.0}.get(side, 0.0)
        drawing.text(at, 40 if low else 20, f"{number + 1} {stage.name}", anchor=side, bold=True, size=12)
        if not low:
            drawing.line(((middle, 24), (middle, 60)), QUIET, 0.8)
        if gives.get(stage.name) and low:
            drawing.text(middle, 56, gives[stage.name], anchor="middle", size=12, fill=QUIET)
    speed.frame([], [0, 2, 4, 6, 8, 10], ylabel="speed, rad/s")
    torque.frame([0, 60, 120, 180, 240], [-300, -200, -100, 0, 100, 200, 300], "time, s", "torque, N·m")
    for axes, signal, colour in ((speed, recording.speed_rad_s, BLUE), (torque, recording.torque_nm, ORANGE)):
        good = np.isfinite(signal)
        starts = np.unique(np.linspace(0, int(good.sum()), 520, endpoint=False).astype(int))
        low_, high_ = (f.reduceat(signal[good], starts) for f in (np.minimum, np.maximum))
        edge = time[good][starts]
        drawing.area(
            [axes.at(t, v) for t, v in zip(edge, high_, strict=True)]
            + [axes.at(t, v) for t, v in reversed(list(zip(edge, low_, strict=True)))],
            colour,
        )
    inertia = document["inertia_kg_m2"]
    drawing.text(
        70,
        452,
        f"Result: J = {inertia['value']:.1f} kg·m², 95 %: {inertia['low_total']:.1f} to "
        f"{inertia['high_total']:.1f}. The simulated shaft has {SIMULATED_INERTIA_KG_M2:.0f} kg·m².",
        bold=True,
    )
    return drawing


def uncertainty_budget() -> Drawing:
    """The sources of the interval of J, largest on top, and what reduces each."""
    _, document = run()
    cure = {
        "torque scale": "calibrate the torque",
        "lag structure": "state the drive's filters in rig.yaml",
        "lags": "state the drive's filters in rig.yaml",
        "noise": "run longer, or move more",
        "friction model": "run at two mean speeds",
        "timing": "read speed and torque in one frame",
    }
    lines = sorted(
        (one for one in document["budget"] if one["half_width_kg_m2"]), key=lambda one: -float(one["half_width_kg_m2"])
    )
    value = document["inertia_kg_m2"]["value"]
    drawing = Drawing(820, 92 + 34 * len(lines), "Uncertainty budget of one run on the simulated drive")
    drawing.text(20, 28, "half-width that each source alone leaves, % of J", bold=True)
    drawing.text(560, 28, "what reduces it", bold=True)
    widest = max(float(one["half_width_kg_m2"]) for one in lines)
    for number, one in enumerate(lines):
        y, half = 46 + 34 * number, float(one["half_width_kg_m2"])
        drawing.text(150, y + 17, one["source"], anchor="end")
        drawing.rect(160, y + 2, max(1.0, 310 * half / widest), 22, QUIET if one["source"] == "torque scale" else BLUE)
        drawing.text(168 + max(1.0, 310 * half / widest), y + 18, f"{100 * half / value:.2g} %", size=12)
        drawing.text(560, y + 17, cure.get(one["source"], ""), fill=QUIET)
    inertia = document["inertia_kg_m2"]
    drawing.text(
        20,
        80 + 34 * len(lines),
        f"Interval to quote: ±{100 * inertia['half_width_total_rel']:.1f} %. "
        f"Repeatability on this drive, without the torque scale: ±{100 * inertia['repeatability_rel']:.2f} %.",
    )
    return drawing


# ---------------------------------------------------------------------------------------------------------------------
# From formulas


def slope_kg_m2(hertz: float, inertia: float, speed_lag: float, torque_lag: float) -> float:
    """Return the slope of torque over acceleration at one tone, seen through two first-order lags; no friction."""
    omega = 2.0 * pi * hertz
    return inertia * (1.0 + omega**2 * speed_lag * torque_lag) / (1.0 + (omega * torque_lag) ** 2)


def field_fit() -> tuple[float, float, float]:
    """Return J in kg·m² and the lags of speed and torque in s that the four published slopes fit best."""
    from tdhil.studies.field.slopes import PUBLISHED

    def misfit(parameters: Sequence[float]) -> list[float]:
        return [slope_kg_m2(hertz, *parameters) - slope for hertz, (slope, _) in PUBLISHED.items()]

    found = least_squares(misfit, (100.0, 0.3, 0.1))
    return float(found.x[0]), float(found.x[1]), float(found.x[2])


def slope_bends() -> Drawing:
    """Published slopes over frequency, the curve of one inertia behind two lags, and what equal filters would show."""
    from tdhil.studies.field.slopes import PUBLISHED

    inertia, speed_lag, torque_lag = field_fit()
    hertz = np.linspace(0.02, 1.1, 80)
    drawing = Drawing(820, 420, "Slope of torque over acceleration, over frequency")
    axes = Axes(drawing, (80, 30, 420, 320), (0.0, 1.1), (80.0, 200.0))
    axes.frame(
        [0, 0.2, 0.4, 0.6, 0.8, 1.0],
        [80, 100, 120, 140, 160, 180, 200],
        "frequency of the tone, Hz",
        "torque / acceleration, kg·m²",
    )
    axes.curve([(0.0, inertia), (1.1, inertia)], GREEN, 2.5)
    axes.curve([(f, slope_kg_m2(f, inertia, speed_lag, torque_lag)) for f in hertz], ORANGE, 2.5)
    for tone, (slope, _) in PUBLISHED.items():
        x, y = axes.at(tone, slope)
        drawing.dot(x, y)
        drawing.text(x - 6, y - 10, f"{slope:.0f}", anchor="end", bold=True)
    rows = (
        ("published slopes of one rig", INK, "dot"),
        (f"one inertia, J = {inertia:.1f} kg·m²,", ORANGE, "line"),
        (f"   speed reported through a lag of {speed_lag:.2f} s,", ORANGE, ""),
        (f"   torque through a lag of {torque_lag:.2f} s", ORANGE, ""),
        ("the same inertia if both signals pass", GREEN, "line"),
        ("   the same filter, or none", GREEN, ""),
    )
    for number, (text, colour, mark) in enumerate(rows):
        y = 70 + 24 * number
        if mark == "dot":
            drawing.dot(534, y - 5, colour)
        elif mark:
            drawing.line(((522, y - 5), (546, y - 5)), colour, 2.5)
        drawing.text(554, y, text, size=12.5)
    for number, text in enumerate(
        (
            "Noise, a pure delay or friction do not",
            "give this curve. More data do not help:",
            "the error is the same in each sample.",
        )
    ):
        drawing.text(522, 260 + 20 * number, text, size=12.5, fill=QUIET)
    return drawing


def model_choice() -> Drawing:
    """The candidates in the order in which they are tried, and the verdict."""
    drawing = Drawing(820, 520, "How the model is chosen")
    rows = (
        (["rigid shaft, reporting lags", "J, B, two lags, time offset"], "residual test passes?"),
        (["two masses on a spring", "J_r, J_L, k, c"], "residual test passes?"),
        (["distributed string", "wave equation"], "residual test passes?"),
        (["rigid shaft, nonlinear friction", "Stribeck effect, or a fan"], "residual test passes?"),
    )
    drawing.text(150, 30, "candidate, simplest first", anchor="middle", bold=True)
    drawing.text(430, 30, "test", anchor="middle", bold=True)
    drawing.text(690, 30, "if yes", anchor="middle", bold=True)
    for number, (lines, test) in enumerate(rows):
        y = 46 + 92 * number
        drawing.box(20, y, 260, 58, lines, fill=PALE_BLUE)
        drawing.line(((280, y + 29), (318, y + 29)), QUIET, 1.5, arrow=True)
        drawing.box(320, y, 220, 58, [test], fill="#ffffff")
        drawing.line(((540, y + 29), (588, y + 29)), QUIET, 1.5, arrow=True)
        drawing.text(564, y + 22, "yes", size=12, fill=GREEN, anchor="middle")
        below = (430, y + 58), (430, y + 76), (150, y + 76), (150, y + 90)
        if number < len(rows) - 1:
            drawing.line(below, QUIET, 1.5, arrow=True)
            drawing.text(440, y + 73, "no", size=12, fill=RED)
    drawing.box(
        590,
        46,
        210,
        334,
        [
            "J with its interval",
            "",
            "valid, or valid_wide if the",
            "interval is wider than asked",
            "",
            "not_identifiable if the motion",
            "does not separate J from",
            "lags, friction or load",
        ],
        fill=PALE_GREEN,
    )
    drawing.line(((430, 380), (430, 418)), QUIET, 1.5, arrow=True)
    drawing.text(440, 402, "no", size=12, fill=RED)
    drawing.box(320, 420, 220, 58, ["model_rejected", "no number is given"], fill=PALE_RED)
    drawing.text(
        20,
        508,
        "--model asks for one candidate. The acceleration regression (Xu 2026) is always shown beside the result.",
        size=12,
        fill=QUIET,
    )
    return drawing


def what_stops() -> Drawing:
    """Draw the causes of a stop, and what stops the shaft."""
    drawing = Drawing(820, 490, "What stops the shaft when what fails")
    rows = (
        (
            ["end of run, Ctrl-C, limit, fault", "contradicting reports"],
            ["quick stop by the drive", "under its speed control"],
            PALE_GREEN,
        ),
        (
            ["laptop, cable or adapter lost", "tdhil killed or frozen"],
            ["the drive's own watchdog", "armed and read back before motion"],
            PALE_BLUE,
        ),
        (
            ["no deceleration for 3 s", "after the quick stop (string: 10 s)"],
            ["the drive's own watchdog", "tdhil stops its heartbeat"],
            PALE_BLUE,
        ),
        (
            ["shaft accelerates in the stop, or string", "and a contradicted speed report"],
            ["friction", "tdhil removes the torque"],
            PALE_ORANGE,
        ),
        (
            ["STOP NOT CONFIRMED (exit 8)", "drive failed, anything else"],
            ["the operator", "hard-wired emergency stop"],
            PALE_RED,
        ),
    )
    drawing.text(190, 28, "what happens", anchor="middle", bold=True)
    drawing.text(610, 28, "what stops the shaft", anchor="middle", bold=True)
    for number, (cause, brake, fill) in enumerate(rows):
        y = 42 + 80 * number
        drawing.box(20, y, 340, 58, cause)
        drawing.line(((360, y + 29), (438, y + 29)), QUIET, 1.5, arrow=True)
        drawing.box(440, y, 340, 58, brake, fill=fill)
    drawing.text(
        20, 456, "If one of these fails, the operator uses the hard-wired emergency stop.", size=12, fill=QUIET
    )
    drawing.text(
        20, 474, "tdhil disables the drive after standstill only, except in the fourth row.", size=12, fill=QUIET
    )
    return drawing


# ---------------------------------------------------------------------------------------------------------------------
# The report's own graphs

ELASTIC = """plant: {kind: two_mass, inertia_kg_m2: 104.0, stiffness_nm_rad: 184.0, damping_nm_s_rad: 8.0,
        bottom: {inertia_kg_m2: 60.0, viscous_nm_s_rad: 1.0, coulomb_nm: 5.0}}
"""
"""A simulated shaft with a load on a spring, for a rigid model that does not fit."""


@cache
def elastic_run() -> Mapping[str, Any]:
    """Return the document of a rigid model on a shaft with two masses."""
    import tdhil

    with tempfile.TemporaryDirectory() as folder:
        plant = Path(folder) / "plant.yaml"
        plant.write_text(ELASTIC, encoding="utf-8")
        with tdhil.simulate(seed=SEED, plant=plant) as drive:
            record = tdhil.run(drive, log=Path(folder) / "run.mcap")
        found: Mapping[str, Any] = tdhil.identify(record, model="rigid").to_dict()
        return found


def graph(name: str) -> str:
    """Return a graph of the report as SVG, drawn by the code of the report."""
    from tdhil.report import plots
    from tdhil.report.page import inline_svg

    draw, document, high_in, names_left = {
        "graph_lines_good": (plots.draw_lines, lambda: run()[1], 3.0, False),
        "graph_lines_bad": (plots.draw_lines, elastic_run, 3.0, False),
        "graph_inertias": (plots.draw_opinions, lambda: run()[1], 1.5, True),
        "graph_budget": (plots.draw_budget, lambda: run()[1], 1.6, True),
        "graph_friction": (plots.draw_friction, lambda: run()[1], 1.8, False),
    }[name]
    return inline_svg(partial(draw, document=document()), (7.0, high_in), names_left=names_left) + "\n"


def card() -> str:
    """Return the card of the run, as a terminal of 80 columns shows it."""
    from tdhil.report.card import card_text

    return "\n".join(line.rstrip() for line in card_text(run()[1], 80).strip("\n").splitlines())


def with_card(text: str) -> str:
    """Return a page with the card of the run in the block below its mark."""
    return re.sub(r"(?<=<!-- card -->\n```text\n).*?(?=\n```\n)", lambda _: card(), text, flags=re.DOTALL)


RUN = {"five_stages": five_stages, "uncertainty_budget": uncertainty_budget}
FORMULA = {"slope_bends": slope_bends, "model_choice": model_choice, "what_stops": what_stops}
GRAPHS = ("graph_lines_good", "graph_lines_bad", "graph_inertias", "graph_budget", "graph_friction")
WITH_CARD = (ROOT / "README.md", ROOT / "docs" / "tutorials" / "read-a-result.md")


def main(names: Sequence[str]) -> int:
    """Draw the named figures, or all; ``card`` writes the card into the pages that show it."""
    texts = {name: partial(_svg, draw) for name, draw in (RUN | FORMULA).items()}
    texts |= {name: partial(graph, name) for name in GRAPHS}
    for name, text in texts.items():
        if not names or name in names:
            (IMAGES / f"{name}.svg").write_text(text(), encoding="utf-8")
            print(f"docs/images/{name}.svg: {(IMAGES / f'{name}.svg').stat().st_size} bytes")
    for page in WITH_CARD if not names or "card" in names else ():
        page.write_text(with_card(page.read_text(encoding="utf-8")), encoding="utf-8")
        print(f"{page.relative_to(ROOT)}: card")
    return 0


def _svg(draw: Callable[[], Drawing]) -> str:
    return draw().svg()


if __name__ == "__main__":
    sys.exit(main(chosen(__doc__, (*RUN, *FORMULA, *GRAPHS, "card"), sys.argv[1:])))
