"""Meaning of every figure on the cards and pages of tune soft-torque, severity and evaluate.

Each figure is explained here once. Terminal, page and docs/reference/figures.md show the same words.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from rich.text import Text as Words

from tdhil.report.blocks import Pairs, ReportSection, Text
from tdhil.report.console import PlainConsole, names_and_texts
from tdhil.soft_torque import AT_RISK_INDEX, BAND_HZ, START_DRAWS, STICK_SLIP_INDEX

HEADING: Final = "Meaning of the figures"
MORE: Final = "docs/reference/figures.md"
"""Page with all figures. `tdhil docs` prints its folder."""


@dataclass(frozen=True)
class FigureMeaning:
    """A figure with its meaning. ``also``: other names of the same figure on a card or a page."""

    name: str
    words: str
    also: tuple[str, ...] = ()


FIGURES: Final = (
    FigureMeaning("in brackets", "95 % interval over J and all tolerances (string.md)"),
    FigureMeaning("draws", "machines and strings, drawn at random within tolerances"),
    FigureMeaning("*", "95 % interval over J alone, the string as stated"),
    FigureMeaning("J", "moment of inertia of the top drive", ("tuned for",)),
    FigureMeaning("lags in the loop", "time constants in the speed loop: filter, torque, sampling"),
    FigureMeaning("loop", "place of the speed loop: in the drive, or in a host"),
    FigureMeaning("ζ", "characteristic impedance: torque of a wave over its speed"),
    FigureMeaning("echo", "time of a wave from the top down to the bit and back"),
    FigureMeaning("modes", "natural frequencies with the top held; ω: the lowest, rad/s"),
    FigureMeaning("f₁", "the lowest natural frequency with the top held"),
    FigureMeaning("bit", "friction: static at rest, Coulomb when fast, Stribeck between"),
    FigureMeaning("bit noise", "random torque of the bit: rms, and how long it is correlated"),
    FigureMeaning("present gains", "source of the gains in the column present"),
    FigureMeaning("present", "the gains in the drive now"),
    FigureMeaning("stiff", "the stiffest PI with the phase margin of --phase-margin"),
    FigureMeaning("soft", "PI that absorbs waves; least critical speed within margins"),
    FigureMeaning("compensated", "soft, and the measured acceleration cancels a part of J"),
    FigureMeaning("broadband", "absorbs waves of more than one mode"),
    FigureMeaning("depth", "depth of the well: the topmost section gets longer"),
    FigureMeaning("P, I, J_c", "gains, N·m·s/rad and N·m/rad; compensated inertia, kg·m²",
           ("P", "I", "J_c", "inertia compensated")),
    FigureMeaning("critical", "lowest set speed that frees a stuck bit and keeps it turning", ("critical speed",)),
    FigureMeaning("by ramp", f"the same after a ramp from standstill, {START_DRAWS} of the draws"),
    FigureMeaning("linear", "speed below which steady rotation is unstable, without noise"),
    FigureMeaning("phase margin", "further phase lag to instability, lowest of all draws", ("phase",)),
    FigureMeaning("gain margin", "factor on all gains to instability, lowest; 6 dB: 2 or 1/2"),
    FigureMeaning("dead time", "reserve: further dead time to instability, lowest"),
    FigureMeaning("P/I, s", "integral time: a long one makes the speed return slowly"),
    FigureMeaning("a, φ", "softness, frequency factor: P = ζ/a, I = (φω)² (J − J_c)"),
    FigureMeaning("J compensated", "share of J that the speed loop compensates"),
    FigureMeaning("|r|, mean", f"reflection |r| at the lowest mode; mean, {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz"),
    FigureMeaning("|r|", "share of a wave that the top sends back: 0 none, 1 all"),
    FigureMeaning("damping *", "least damping ratio below the second mode; 0: no decay",
           ("least damping", "least damping of the lowest modes")),
    FigureMeaning("no noise *", "critical speed without noise of the bit"),
    FigureMeaning("J wrong", "damping, and critical speed, if J is wrong by this much"),
    FigureMeaning("errors of J", "examples: both are errors of the acceleration regression"),
    FigureMeaning("from", "file that J is from: a result, or the log of a run"),
    FigureMeaning("profile", "drive profile: names and units of the drive's own gains"),
    FigureMeaning("bit torque", "torque of a bit that turns fast"),
    FigureMeaning("stable", "the bit turns, and comes free if it was stuck"),
    FigureMeaning("at risk", "the bit keeps turning; once stuck, it stays stuck"),
    FigureMeaning("stick-slip", "the bit sticks and slips, again and again"),
    FigureMeaning("level", "highest of: smooth, at risk, stick-slip"),
    FigureMeaning("record", "file, and time of rotation in it"),
    FigureMeaning("before", "the first record"),
    FigureMeaning("after", "the record of --against"),
    FigureMeaning("severity index",
           f"bit speed, amplitude over mean; {AT_RISK_INDEX:g}: at risk, {STICK_SLIP_INDEX:g}: stick-slip"),
    FigureMeaning("oscillation", "period and frequency of the torsional vibration"),
    FigureMeaning("downhole speed", "bit speed, computed from waves at the top; ±: amplitude"),
    FigureMeaning("string torque", "T − J α at its top, α: acceleration; ±: amplitude"),
    FigureMeaning("verdict", "agreement of the run with tune"),
    FigureMeaning("why", "reason for the verdict"),
    FigureMeaning("measured", "value of this run"),
    FigureMeaning("tune", "prediction of tdhil tune", ("by tune",)),
    FigureMeaning("torque at the top", "drive torque about its mean, sticking and turning bit"),
    FigureMeaning("trials", "set speeds tried from a stuck bit, and whether it then turns"),
    FigureMeaning("last stick on the ramp", "set speed at which the bit last stood still"),
    FigureMeaning("unknown torque", "torque on the shaft that no command explains; its energy",
           ("torque without a command", "energy by the loop's own errors")),
    FigureMeaning("real machine", "machine of this run, and the factor applied to its torques"),
    FigureMeaning("torque limit", "torque limit of the drive; if it acts, the result is invalid"),
    FigureMeaning("reported less observed speed", "difference between reported and computed speed"),
    FigureMeaning("log", "file of the run"),
)
"""Every figure in the order in which a card shows it."""


def meaning(name: str) -> tuple[FigureMeaning, str] | None:
    """Return figure and label of a row or column; None: not explained. Unit, shaft and a percentage do not count."""
    name = re.sub(r" [+−-]?[\d.]+ %", "", name).strip()
    return next(((one, label) for label in (name, name.split(",")[0]) for one in FIGURES
                 if label in (one.name, *one.also)), None)


def words_of(name: str) -> str:
    """Return the meaning as a sentence. Raises StopIteration for an unknown figure."""
    words = next(one.words for one in FIGURES if one.name == name)
    return f"{words[0].upper()}{words[1:]}."


def explained(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the figures of the named rows and columns, each once, with their meanings in the order of `FIGURES`.

    A figure with one label has this label, and a figure with several ones its own name.
    """
    labels: dict[FigureMeaning, set[str]] = {}
    for figure, label in filter(None, map(meaning, names)):
        labels.setdefault(figure, set()).add(label)
    return [(one.name if len(labels[one]) > 1 else min(labels[one]), one.words) for one in FIGURES if one in labels]


def print_meanings(names: Iterable[str], console: PlainConsole) -> None:
    """Print one line for each named row and column."""
    console.print(Words(f"{HEADING.lower()} ({MORE}, see tdhil docs)", style="bold"))
    console.print(names_and_texts(explained(names), quiet=True))


def meanings_section(names: Iterable[str]) -> ReportSection:
    """Return the meanings of the named rows and columns as a section of the page."""
    return ReportSection(HEADING, (Pairs(tuple(explained(names))), Text(f"More: {MORE} (see tdhil docs).")))
