"""`tdhil study soft-torque`: use of J on one string: controllers, errors of J, and motion with and without stick-slip.

The figures are compared with those of an earlier prototype (a chain of 50 lumps stepped in time; here: exact lines and
characteristics). Each difference is reported with its reason.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from profiles import DataModel
from tdhil.soft_torque import (
    RPM,
    Begin,
    BottomEnd,
    ClosedSystem,
    CriticalSpeeds,
    DrillString,
    PipeSection,
    Search,
    SimulationTrace,
    SpeedController,
    StringFile,
    TopDrive,
    TuneCase,
    critical_speeds,
    largest_stable_share,
    linear_limit,
    lowest_turning,
    reflection_at,
    simulate,
    stiff_controller,
    string_modes_hz,
    string_of,
    tuned_controller,
)
from tdhil.soft_torque import Interval as InertiaInterval
from tdhil.studies.study import Cell, Progress, ResultTable, Statement, StudyOutcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INERTIA_KG_M2 = 1500.0
ERRORS = (-0.20, -0.0056, 0.0056, 0.04, 0.126, 0.76)
"""Relative errors of the assumed J: −20 %, repeatability, torque scale, the paper's method, the spread of its
slopes.
"""
SHARE_ERRORS = (0.0, 0.04, 0.126, 0.76)
SHORT_LAGS_S = (0.005, 0.002, 0.001)
IDEAL = "ideal, Z = ζ"
SPEED_WITHIN_RPM, DAMPING_WITHIN, REFLECTION_WITHIN = 2.0, 0.005, 0.005


class SoftTorqueSettings(DataModel):
    """Machine, string and bit of the reference case, and the search for critical speeds."""

    length_m: float = Field(default=3000.0, gt=10.0, le=15_000.0)
    bottom_inertia_kg_m2: float = Field(default=374.0, gt=0.0)
    static_nm: float = Field(default=5000.0, gt=0.0)
    coulomb_nm: float = Field(default=2500.0, gt=0.0)
    stribeck_speed_rad_s: float = Field(default=2.5, gt=0.0)
    bit_viscous_nm_s_rad: float = Field(default=20.0, ge=0.0)
    inner_lags_s: tuple[float, ...] = (0.020, 0.010, 0.003)
    duration_s: float = Field(default=100.0, gt=10.0, le=1000.0, description="of each simulation, after the ramp")
    resolution_rpm: float = Field(default=1.0, gt=0.0, le=20.0)
    highest_rpm: float = Field(default=240.0, gt=20.0, le=1000.0)
    lowest_rpm: float = Field(default=8.0, gt=0.0)
    start_ramp_rpm_s: float = Field(default=5.0, gt=0.0)
    shown_at_rpm: float = Field(default=100.0, gt=1.0, description="set speed of the pictures")
    beside: bool = Field(default=True, description="also other ramps and beginnings, for what hangs on them")

    def string(self) -> DrillString:
        """Return the string of 5 inch steel pipe, and the bit."""
        section = PipeSection(length_m=self.length_m, outer_diameter_m=0.127, inner_diameter_m=0.1086)
        bottom = BottomEnd(
            inertia_kg_m2=self.bottom_inertia_kg_m2, friction="stribeck", static_nm=self.static_nm,
            coulomb_nm=self.coulomb_nm, stribeck_speed_rad_s=self.stribeck_speed_rad_s,
            viscous_nm_s_rad=self.bit_viscous_nm_s_rad,
        )
        return string_of(StringFile(sections=(section,), bottom=bottom))

    def drive(self) -> TopDrive:
        """Return the top drive of the reference case."""
        return TopDrive(INERTIA_KG_M2, 8.0, 60.0, self.inner_lags_s)

    def search(self) -> Search:
        """Return the settings of the search for critical speeds."""
        coarse = 8.0 * self.resolution_rpm
        return Search(self.highest_rpm, self.lowest_rpm, coarse, self.resolution_rpm, self.duration_s,
                      min(20.0, 0.3 * self.duration_s), self.start_ramp_rpm_s)


@dataclass(frozen=True)
class PrototypeResult:
    """Values of the prototype for one controller; the linear limit: the eigenvalues of a chain of 50 lumps."""

    reflection: float
    dampings: tuple[float, ...]
    linear_rpm: float
    start_rpm: float
    cure_rpm: float


@dataclass(frozen=True)
class ControllerRow:
    """One controller and its results."""

    name: str
    drive: TopDrive
    law: SpeedController
    expected: PrototypeResult
    reflection: float
    dampings: tuple[float, ...]
    modes_hz: tuple[float, ...]
    critical: CriticalSpeeds | None = None
    linear_rpm: float | None = None
    """Linear stability limit, rpm."""


EXPECTED: Mapping[str, PrototypeResult] = {
    "stiff, phase margin 60°": PrototypeResult(0.992, (0.036,), 53.8, 148, 183),
    "the paper's 300/300, scaled to J": PrototypeResult(0.932, (0.062,), 50.8, 106, 133),
    "soft a = 1": PrototypeResult(0.046, (0.059, 0.083), 47.0, 71, 72),
    "soft a = 0.25": PrototypeResult(0.593, (0.23, 0.27), 41.5, 58, 57),
    "a = 0.35 at 0.84 f₁": PrototypeResult(0.537, (0.14, 0.28), 39.4, 48, 46),
    "the same, half of J compensated": PrototypeResult(0.477, (0.26, 0.53), 40.8, 40, 40),
    IDEAL: PrototypeResult(0.0, (0.80,), 35.9, 30, 20),
}

ERROR_ROWS: Mapping[str, tuple[float | None, ...]] = {
    "stiff": (184, 183, 183, 183, 182, 181),
    "soft a = 1": (94, 72, 73, 75, 84, 131),
    "soft a = 0.25": (50, 57, 57, 59, 62, 94),
    "a = 0.25, half compensated": (51, 53, 53, 54, 56, None),
    "a = 0.25, 0.65 compensated": (51, 52, 52, None, None, None),
}
"""Cure speeds of the prototype by error of J, rpm; None: unstable."""

SHARE_ROWS: Mapping[str, tuple[float, ...]] = {"33 ms": (0.65, 0.60, 0.55, 0.35), "8 ms": (0.70, 0.65, 0.60, 0.35)}


def controllers(settings: SoftTorqueSettings) -> list[ControllerRow]:
    """Return the seven controllers of the reference table, with their theoretical values."""
    string, drive = settings.string(), settings.drive()
    held = string_modes_hz(string)
    paper = 300.0 * INERTIA_KG_M2 / 104.0      # gain for a rig of 104 kg·m², scaled to the same bandwidth
    laws = dict(zip(EXPECTED, (
        stiff_controller(drive, 60.0),
        SpeedController(paper, paper),
        tuned_controller(string, INERTIA_KG_M2, 1.0, held[0]),
        tuned_controller(string, INERTIA_KG_M2, 0.25, held[0]),
        tuned_controller(string, INERTIA_KG_M2, 0.35, 0.84 * held[0]),
        tuned_controller(string, INERTIA_KG_M2, 0.35, 0.84 * held[0], 0.5),
        SpeedController(string.impedance_nm_s_rad, 10.0),
    ), strict=True))
    rows = []
    for name, law in laws.items():
        machine = TopDrive(1.0, 0.0, 0.0, (0.001,)) if name == IDEAL else drive
        modes = ClosedSystem(string, machine, law).modes(float(np.sqrt(held[0] * held[1])))
        swinging = [mode for mode in modes if name != "the paper's 300/300, scaled to J" or mode.damping < 0.5]
        reflected = reflection_at(machine, law, string, np.array([held[0]]))[0]
        rows.append(ControllerRow(name, machine, law, EXPECTED[name], float(reflected),
                                  tuple(sorted(mode.damping for mode in swinging)),
                                  tuple(mode.frequency_hz for mode in swinging),
                                  linear_rpm=linear_limit(string, machine, law) / RPM))
    return rows


class SoftTorqueStudy:
    """Study `tdhil study soft-torque`."""

    name = "soft-torque"
    title = "Soft torque: what J is for, on 3,000 m of 5 inch pipe"
    settings_model = SoftTorqueSettings

    def run(self, settings: SoftTorqueSettings, progress: Progress) -> StudyOutcome:
        """Compute the theory first, then the simulations; the same settings give the same figures."""
        begun_s = time.monotonic()
        string, search = settings.string(), settings.search()
        progress(0.0, "poles and reflection")
        rows = controllers(settings)
        progress(0.03, "critical speeds of seven controllers")
        found = critical_speeds(string, [(row.drive, row.law) for row in rows], search)
        rows = [replace(row, critical=one) for row, one in zip(rows, found, strict=True)]
        progress(0.55, "cure speeds with a wrong J")
        errors = cures_by_error(settings)
        beside: tuple[ResultTable, ...] = ()
        if settings.beside:
            progress(0.75, "other ramps and beginnings")
            beside = (start_by_ramp(rows[:4], settings),)
        progress(0.92, "how much of J can be compensated")
        shares = {name: largest_shares(settings, lags) for name, lags in
                  (("33 ms", settings.inner_lags_s), ("8 ms", SHORT_LAGS_S))}
        progress(0.97, "pictures")
        shown = stick_slip(rows, settings)
        progress(1.0, "done")
        return StudyOutcome(
            self.name, self.title,
            (controller_table(rows), modes_table(rows), error_table(errors), share_table(shares), *beside),
            (*controller_statements(rows), *error_statements(errors), *share_statements(shares)),
            document={"bit": f"{string.bit.describe() if string.bit else ''}, viscous "
                             f"{settings.bit_viscous_nm_s_rad:g} N·m·s/rad"},
            simulation_wall_s=time.monotonic() - begun_s,
            draw=partial(draw, string, rows, shown, settings), figure_size_in=(8.0, 10.0),
        )


SOFT_TORQUE = SoftTorqueStudy()


# ---------------------------------------------------------------------------------------------------------------------
# Computations.


def recipes(settings: SoftTorqueSettings) -> dict[str, Callable[[float], SpeedController]]:
    """Return controllers as functions of the assumed J."""
    string, drive = settings.string(), settings.drive()
    mode_hz = string_modes_hz(string)[0]

    def soft(softness: float, share: float = 0.0) -> Callable[[float], SpeedController]:
        return lambda believed: tuned_controller(string, believed, softness, mode_hz, share)

    return dict(zip(ERROR_ROWS, (
        lambda believed: stiff_controller(drive.with_inertia(believed), 60.0),
        soft(1.0), soft(0.25), soft(0.25, 0.5), soft(0.25, 0.65),
    ), strict=True))


def cures_by_error(settings: SoftTorqueSettings) -> dict[str, tuple[float | None, ...]]:
    """Return the cure speed, rpm, by recipe and error of J; None: unstable. Infinite above the highest speed tried."""
    string, drive = settings.string(), settings.drive()
    laws = {(name, error): recipe((1.0 + error) * INERTIA_KG_M2)
            for name, recipe in recipes(settings).items() for error in ERRORS}
    stable = {key: law for key, law in laws.items() if ClosedSystem(string, drive, law).is_stable()}
    cures = lowest_turning(string, [(drive, law) for law in stable.values()], "stuck", settings.search())
    found = {key: cure if cure is not None else float("inf") for key, cure in zip(stable, cures, strict=True)}
    return {name: tuple(found.get((name, error)) for error in ERRORS) for name in ERROR_ROWS}


def largest_shares(settings: SoftTorqueSettings, lags_s: tuple[float, ...]) -> tuple[float, ...]:
    """Return the largest stable share of the assumed J, in steps of 0.05, a = 0.25, for `SHARE_ERRORS`."""
    string = settings.string()
    mode_hz = string_modes_hz(string)
    shares = []
    for error in SHARE_ERRORS:
        believed = (1.0 + error) * INERTIA_KG_M2
        case = TuneCase(string, TopDrive(INERTIA_KG_M2, 8.0, 60.0, lags_s),
                        InertiaInterval(believed, INERTIA_KG_M2, believed))
        exact = largest_stable_share(case, 0.25, mode_hz, believed_upper=False)
        shares.append(0.05 * np.floor(exact / 0.05 + 1e-9))
    return tuple(float(share) for share in shares)


def start_by_ramp(rows: Sequence[ControllerRow], settings: SoftTorqueSettings) -> ResultTable:
    """Return the table of start speeds with a ramp."""
    ramps = (3.0, 4.0, 5.0, 10.0)
    loops = [(row.drive, row.law) for row in rows]
    string, search = settings.string(), settings.search()
    columns = [lowest_turning(string, loops, "rest", replace(search, start_ramp_rpm_s=ramp)) for ramp in ramps]
    cells: list[tuple[Cell, ...]] = [(row.name, *(column[k] for column in columns)) for k, row in enumerate(rows)]
    return ResultTable("start_by_ramp", ("controller", *(f"rpm_at_{ramp:g}_rpm_s" for ramp in ramps)), tuple(cells))


def stick_slip(rows: Sequence[ControllerRow], settings: SoftTorqueSettings) -> tuple[tuple[str, ...], SimulationTrace]:
    """Return the motion of bit and top with three controllers, from a stuck bit."""
    taken = (rows[0], rows[1], rows[3])
    target = np.full((len(taken), 1), settings.shown_at_rpm * RPM)
    trace = simulate(settings.string(), [(row.drive, row.law) for row in taken], Begin("stuck", target), target, 1.0,
                     min(60.0, settings.duration_s), 0.05)
    return tuple(row.name for row in taken), trace


# ---------------------------------------------------------------------------------------------------------------------
# Tables and statements.


def controller_table(rows: Sequence[ControllerRow]) -> ResultTable:
    """Return the reference table."""
    def cells(row: ControllerRow) -> tuple[Cell, ...]:
        speeds = row.critical
        return (row.name, row.law.gain_nm_s_rad, row.law.integral_nm_rad, row.law.compensated_kg_m2, row.reflection,
                *((row.linear_rpm, speeds.start_rpm, speeds.cure_rpm) if speeds else (None, None, None)))

    return ResultTable("controllers", ("controller", "P_nm_s_rad", "I_nm_rad", "Jc_kg_m2", "reflection",
                                       "linear_limit_rpm", "start_rpm", "cure_rpm"), tuple(cells(row) for row in rows))


def modes_table(rows: Sequence[ControllerRow]) -> ResultTable:
    """Return the table of the lowest modes."""
    cells: list[tuple[Cell, ...]] = []
    for row in rows:
        cells += [(row.name, row.dampings[k], row.expected.dampings[k] if k < len(row.expected.dampings) else None)
                  for k in range(len(row.dampings))]
    return ResultTable("damping", ("controller", "damping", "prototype"), tuple(cells))


def error_table(errors: Mapping[str, Sequence[float | None]]) -> ResultTable:
    """Return the table of cure speeds by error of J."""
    names = tuple(f"J_{100 * error:+.3g}_%" for error in ERRORS)
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (name, *("unstable" if one is None else one for one in row)) for name, row in errors.items())
    return ResultTable("cure_rpm_by_error_of_J", ("controller", *names), rows)


def share_table(shares: Mapping[str, Sequence[float]]) -> ResultTable:
    """Return the table of the largest share of J that can be compensated."""
    names = tuple(f"J_{100 * error:+.3g}_%" for error in SHARE_ERRORS)
    rows: tuple[tuple[Cell, ...], ...] = tuple((name, *row) for name, row in shares.items())
    return ResultTable("largest_stable_share", ("inner_lag", *names), rows)


def controller_statements(rows: Sequence[ControllerRow]) -> list[Statement]:
    """Return two statements for each controller: theory and simulation."""
    found = []
    for row in rows:
        expected = row.expected
        near = abs(row.reflection - expected.reflection) <= REFLECTION_WITHIN
        damped = len(row.dampings) == len(expected.dampings) and all(
            abs(ours - theirs) <= DAMPING_WITHIN
            for ours, theirs in zip(row.dampings, expected.dampings, strict=True))
        ours = f"|r| {row.reflection:.3f}; {_list(row.dampings, 3) or 'no swinging pole below the second mode'}"
        if row.name == IDEAL and not damped:
            ours += (": where nothing comes back from the top there is no lowest mode to be damped; the drag of the "
                     "mud leaves a swing at 0.79 Hz, with 0.61, and what is slowest is the bit's own decay, 0.85 1/s")
        found.append(Statement(f"{row.name}: |r| at f₁ and damping of the lowest modes",
                               f"{expected.reflection:.3f}; {_list(expected.dampings, 3)}", ours, near and damped))
        if row.critical is not None:
            found.append(_speeds(row, row.critical))
    return found


def _speeds(row: ControllerRow, critical: CriticalSpeeds) -> Statement:
    expected = row.expected
    pairs = {
        "linear limit": (row.linear_rpm, expected.linear_rpm), "start": (critical.start_rpm, expected.start_rpm),
        "cure": (critical.cure_rpm, expected.cure_rpm),
    }
    off = [name for name, (ours, theirs) in pairs.items() if ours is None or abs(ours - theirs) > SPEED_WITHIN_RPM]
    text = " / ".join("none" if ours is None else f"{ours:.0f}" for ours, _ in pairs.values())
    if off and row.name == IDEAL:
        text += (": the impedance alone doesn't say what holds the mean torque; here it is an integral of 10 N·m/rad. "
                 "With none, and 5 kN·m of it from the beginning, the cure is 20 rpm")
    elif off:
        text += f": under a loop that hardly damps {' and '.join(off)} hangs on how it begins; see the tables beside"
    return Statement(f"{row.name}: linear limit / start / cure, rpm",
                     f"{expected.linear_rpm:.0f} / {expected.start_rpm:.0f} / {expected.cure_rpm:.0f}", text, not off)


def error_statements(errors: Mapping[str, Sequence[float | None]]) -> list[Statement]:
    """Return one statement for each recipe."""
    found = []
    for name, row in errors.items():
        expected = ERROR_ROWS[name]
        holds = all((ours is None) == (theirs is None) and (ours is None or theirs is None or
                                                            abs(ours - theirs) <= SPEED_WITHIN_RPM)
                    for ours, theirs in zip(row, expected, strict=True))
        found.append(Statement(f"{name}: cure speed with J wrong by −20, ∓0.56, +4, +12.6, +76 %", _cures(expected),
                               _cures(row), holds))
    return found


def share_statements(shares: Mapping[str, Sequence[float]]) -> list[Statement]:
    """Return one statement for each lag."""
    return [
        Statement(f"largest stable share of J with {name} of inner lag, J wrong by 0, +4, +12.6, +76 %",
                  _list(SHARE_ROWS[name], 2), _list(row, 2),
                  all(abs(a - b) < 1e-6 for a, b in zip(row, SHARE_ROWS[name], strict=True)))
        for name, row in shares.items()
    ]


def _list(values: Sequence[float], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _cures(values: Sequence[float | None]) -> str:
    return ", ".join("unstable" if value is None else f"{value:.0f}" for value in values)


# ---------------------------------------------------------------------------------------------------------------------
# Plot of the study.


def draw(
    string: DrillString, rows: Sequence[ControllerRow], shown: tuple[tuple[str, ...], SimulationTrace],
    settings: SoftTorqueSettings,
    figure: Figure,
) -> None:
    """Draw |r(f)| of all controllers, then bit and top over time."""
    names, trace = shown
    every: Any = figure.subplots(1 + len(names), 1, height_ratios=(1.4, *[1.0] * len(names)))
    hertz = np.geomspace(0.02, 2.0, 300)
    top = every[0]
    for row in rows:
        top.semilogx(hertz, reflection_at(row.drive, row.law, string, hertz), lw=1.3, label=row.name)
    for mode in string_modes_hz(string):
        top.axvline(mode, color="0.6", lw=0.8, ls=":")
    top.set(xlabel="frequency, Hz", ylabel="|r|", ylim=(0.0, 1.05), xlim=(hertz[0], hertz[-1]))
    ticks = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
    top.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    top.minorticks_off()
    top.legend(fontsize="x-small", loc="center left")
    top.set_title("what the top drive sends back up the string; dotted: the string's own modes", fontsize="small")
    for k, name in enumerate(names):
        axes = every[1 + k]
        axes.plot(trace.time_s, trace.bit_rad_s[:, k, 0] / RPM, color="#c2410c", lw=1.2, label="bit")
        axes.plot(trace.time_s, trace.top_rad_s[:, k, 0] / RPM, color="0.4", lw=1.0, label="top drive")
        axes.set_ylabel("rpm")
        axes.set_title(f"{name}: a stuck bit, set speed {settings.shown_at_rpm:.0f} rpm", fontsize="small")
        axes.margins(x=0.0)
        axes.legend(fontsize="x-small", loc="upper right")
    for axes in every:
        axes.grid(alpha=0.3)
    every[-1].set_xlabel("time, s")
    figure.subplots_adjust(left=0.08, right=0.98, top=0.96, bottom=0.06, hspace=0.5)
