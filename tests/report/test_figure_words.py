"""Meanings of every row and column on the cards and pages of tune, severity and evaluate, in one line each."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from tdhil.report import (
    PlainConsole,
    evaluation_report,
    map_document,
    print_evaluation,
    print_severity,
    schedule_document,
    severity_document,
    severity_report,
    tuning_document,
)
from tdhil.report.blocks import Pairs, Picture, Table
from tdhil.report.figure_words import FIGURES, HEADING, meaning
from tdhil.report.operator_map import print_map
from tdhil.report.tuning import TunedFor, print_tuning, tuning_report
from tdhil.soft_torque import (
    DepthRow,
    DepthSchedule,
    DrawnValues,
    Interval,
    OperatorMap,
    SpeedController,
    SurfaceRecord,
    TuneCase,
    loop_margins,
    severity,
    tune,
)
from tests.report.test_evaluation import document as evaluation
from tests.soft_torque.cases import DRIVE, SOFT_035, STRING
from tests.soft_torque.test_evaluation import rows

OWN_NAMES = {"Run", "Trials", "To be typed into the drive, by hand"}
"""Sections whose names are those of the run or of the drive."""
OF_PAGE = {"from", "profile"}
"""Rows of a page that a card does not have."""


def speeds(rpm):
    return DrawnValues((rpm, 1.05 * rpm))


@pytest.fixture(scope="module")
def tuned():
    """Return the document of a tuning with all parts: present gains that fail a margin, a schedule and a map."""
    present = SpeedController(300.0, 1000.0)
    tuning = tune(TuneCase(STRING, DRIVE, Interval(1500.0, 1440.0, 1560.0), present=present, draws=4), None)
    tuning = replace(tuning, tuned=tuple(replace(one, cure=speeds(60.0), start=speeds(62.0), linear_limit=speeds(40.0))
                                         for one in tuning.tuned))
    document = tuning_document(tuning, TunedFor("result.json", True, None, 10.0, "bus", "as stated", "as stated"))
    document["critical_speeds"] = {"highest_rpm": 240.0}
    for one in document["controllers"]:
        one["critical_rpm"] = {"cure": {"value": 57.0, "low": 56.0, "high": 58.0}}
    gains = DepthRow(3000.0, 0.13, replace(SOFT_035, compensated_kg_m2=100.0), "", 0.35, 0.84,
                     loop_margins(DRIVE, SOFT_035, STRING), (), speeds(46.0), speeds(90.0))
    document["schedule"] = schedule_document(
        DepthSchedule("compensated", "present", (gains,), ()), 10.0, lambda law: ())
    states = dict.fromkeys(("present", "stiff", "soft"), (("stick-slip", "at risk", "stable"),) * 2)
    document["map"] = map_document(OperatorMap((20.0, 40.0, 60.0), (2500.0, 3000.0), states, (100.0, 120.0)))
    return document


def names_of(page):
    """Return the names of all rows and columns of a page, and those that its section of meanings explains."""
    shown, explained = [], []
    for section in page.sections:
        for block in section.blocks:
            if section.heading == HEADING and isinstance(block, Pairs):
                explained += [name for name, _ in block.rows]
            elif section.heading in OWN_NAMES:
                continue
            elif isinstance(block, Pairs):
                shown += [name for name, _ in block.rows]
            elif isinstance(block, Table) and "parameter" not in [column.title for column in block.columns]:
                shown += [column.title for column in block.columns]
                if section.heading != "The operator's map" and "depth, m" not in shown[-len(block.columns):]:
                    shown += [row[0] for row in block.rows]
    return [name for name in shown if name], explained


def figures_of(names):
    return {meaning(name)[0] for name in names}


def check(page, printed, own=()):
    """Check that the page explains each of its names, and the card each figure of ``own``, in one line of 80."""
    shown, explained = names_of(page)
    assert [name for name in shown if meaning(name) is None] == []
    assert figures_of(shown) <= figures_of(explained)
    lines = printed.splitlines()
    assert max(map(len, lines)) <= 80
    begin = next(at for at, line in enumerate(lines) if line.startswith(HEADING.lower()))
    block = [line.split("  ")[0] for line in lines[begin + 1 :]]
    block = block[: next((at for at, name in enumerate(block) if meaning(name) is None), None)]
    for name, line in zip(block, lines[begin + 1 :], strict=False):
        assert line.strip().endswith(meaning(name)[0].words)
    assert figures_of(own) <= figures_of(block)


def shown_by(print_card, document):
    printed = io.StringIO()
    console = PlainConsole(printed)
    console.width = 80
    print_card(document, console)
    return printed.getvalue()


def test_each_figure_is_explained_once():
    names = [name for one in FIGURES for name in (one.name, *one.also)]
    assert len(names) == len(set(names))


@pytest.mark.heavy
def test_figures_of_a_tuning(tuned):
    text = shown_by(print_tuning, tuned)
    page = tuning_report(tuned, None)
    check(page, text, [name for name in names_of(page)[0] if name not in OF_PAGE])
    assert set(names_of(page)[1]) >= {*OF_PAGE, "errors of J"}
    assert "examples: both are errors of the acceleration regression" in text
    assert "bit noise" in text and "200 N·m rms" in text and "reserve" in text
    assert "ψ" not in text          # a symbol of damping in other texts, not the mark of a footnote
    words = " ".join(text.split())
    assert "static at rest, Coulomb when fast" in words and "least damping ratio below the second mode" in words
    assert any("least one below the second mode" in block.caption for section in page.sections
               for block in section.blocks if isinstance(block, Picture) and block.graph == "modes")


@pytest.mark.heavy
def test_a_small_margin_is_red_with_its_value_and_its_limit(tuned):
    """The present gains keep too little phase: their cell is red, and a red line has the limit."""
    red = "\x1b[1;31m"
    printed = io.StringIO()
    print_tuning(tuned, Console(file=printed, force_terminal=True, color_system="standard", width=80))
    present = tuned["controllers"][0]["margins"]
    degrees = f"{present['worst']['phase_deg']:.0f}°"
    (row,) = [line for line in printed.getvalue().splitlines() if line.startswith("phase margin ") and degrees in line]
    assert row.split(red)[1].split("\x1b")[0].strip() == degrees and row.count(red) == 1
    line = next(line for line in printed.getvalue().splitlines() if "present: thin margins" in line)
    assert line.startswith(red) and f"phase margin {degrees} (limit 30°)" in line
    page = tuning_report(tuned, None)
    (cells,) = [row for row in page.sections[0].blocks[0].rows if row[0] == "phase margin"]
    assert [cell.startswith("⚠") for cell in cells[1:]].count(True) == 1 and cells[1] == f"⚠ {degrees}"


def test_figures_of_an_evaluation():
    log = rows(57.0, (60.0, 56.3, 57.2), damping=0.22)
    found = evaluation(log)
    text = shown_by(print_evaluation, found)
    card = text.splitlines()[1 : text.splitlines().index(next(one for one in text.splitlines() if not one.strip()))]
    check(evaluation_report(found, log), text,
          [line.split("  ")[0] for line in card if line[:1].strip()])


@pytest.mark.parametrize("names", [("before.csv",), ("before.csv", "after.csv")])
def test_figures_of_a_severity(names):
    time_s = 0.05 * np.arange(6000)
    swing = 5600.0 * np.sin(2.0 * np.pi * time_s / 8.16)
    inertia = Interval(1500.0, 1440.0, 1560.0)
    found = severity(SurfaceRecord(time_s, 10.5 - 1e-5 * swing, 3000.0 + swing), STRING, inertia)
    document = severity_document([(found, name) for name in names], ["the bit sticks"] * len(names), STRING, inertia,
                                 simulated=False, warnings=())
    page = severity_report(document, [found] * len(names))
    in_figures = [block.rows for block in page.sections[0].blocks]
    check(page, shown_by(print_severity, document), [row[0] for row in in_figures[0]])


def test_the_map_in_words_agrees_with_its_cells():
    """A row states the speed from which all cells are stable, and the highest speed with stick-slip."""
    speeds_rpm = (20.0, 40.0, 60.0, 80.0)
    stiff = (("stick-slip", "stable", "at risk", "stable"), ("stick-slip", "stick-slip", "at risk", "at risk"))
    found = map_document(OperatorMap(speeds_rpm, (2500.0, 3000.0), {"stiff": stiff}))
    lines = [" ".join(line.split()) for line in shown_by(print_map, found).splitlines()]
    assert [line for line in lines if "kN·m" in line] == [
        "2.5 kN·m stable from 80 rpm, stick-slip up to 20", "3 kN·m not stable up to 80 rpm, stick-slip up to 40"]
    assert "Yellow: The bit keeps turning" in found["how_to_read"]
    assert ".." not in found["how_to_read"]
