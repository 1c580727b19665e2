"""Combinations of a drive with wrong reports: fault, moment, rig, bus, and program of tdhil. Pure.

A *program* is a task of tdhil on one simulated rig, short enough for two or three seconds of processor time. `product`
has every combination; `standard` every lie at every moment, with alternating programs; `sample` a seeded part of the
product. `sim_bus.shaft_judge` judges the motion of the true shaft.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from sim_bus.reports import LIES

# ---------------------------------------------------------------------------------------------------------------------
# Programs: the rig as described to tdhil, and the simulated plant.


@dataclass(frozen=True)
class CommandLine:
    """One command line, with ``{folder}`` for the folder that contains `files`."""

    name: str
    arguments: tuple[str, ...]
    inertia_kg_m2: float
    coulomb_nm: float
    torque_nm: float
    """Torque limit of the rig, N·m."""
    speed_max_rad_s: float
    files: Mapping[str, str] = field(default_factory=dict)
    string: bool = False
    position: bool = True
    """True if the drive reports a position."""
    demand: bool = True
    """True if the drive reports its torque demand."""
    modbus: bool = False
    skipped: frozenset[str] = frozenset()
    """Stages that this program does not have."""
    torque_mode: bool = True
    """True if it commands torque while it measures."""


_STRING_PLANT = """\
plant:
  kind: string
  inertia_kg_m2: 1500.0
  length_m: 2300.0
  outer_diameter_m: 0.127
  inner_diameter_m: 0.1086
  drag_nm_s_rad_m: 0.005
  bottom: {inertia_kg_m2: 374.0, viscous_nm_s_rad: 4.0, coulomb_nm: 30.0}
drive:
  rated_torque_nm: 10000.0
  torque_limit_nm: 8000.0
  speed_gain_nm_s_rad: 3000.0
  speed_integral_gain_nm_rad: 2000.0
"""
_PIPE = "load: {kind: string, length_m: 2300, outer_diameter_m: 0.127, inner_diameter_m: 0.1086}\n"
_STRING_RIG = _PIPE + "make_up_torque_nm: 8000\ntorque_ramp_nm_s: 400\n"
_TOP_DRIVE = """\
drive:
  rated_torque_nm: 20000.0
  torque_limit_nm: 30000.0
  speed_limit_rpm: 250.0
  speed_gain_nm_s_rad: 6000.0
  speed_integral_gain_nm_rad: 4000.0
"""
_BIT_PLANT = """\
plant:
  kind: string
  bottom:
    friction: stribeck
    static_nm: 5000.0
    coulomb_nm: 2500.0
    stribeck_speed_rad_s: 2.5
    viscous_nm_s_rad: 20.0
""" + _TOP_DRIVE
_BIT_RIG = _PIPE + """\
make_up_torque_nm: 30000
torque_ramp_nm_s: 400
limits:
  speed_min_rad_s: 15
  speed_max_rad_s: 26
  torque_nm: 15000
  time_s: 1800
  quick_stop_rad_s2: 1.0
  probe_torque_nm: 8000
  probe_travel_rad: 12
"""
_TOP_PLANT = """\
plant: {kind: rigid, inertia_kg_m2: 1500.0, viscous_nm_s_rad: 8.0, coulomb_nm: 60.0}
""" + _TOP_DRIVE
_TOP_RIG = """\
limits:
  speed_min_rad_s: 0.5
  speed_max_rad_s: 15.0
  torque_nm: 15000
  probe_torque_nm: 1000
  probe_travel_rad: 3.0
  time_s: 1500
  quick_stop_rad_s2: 2.0
  watchdog_s: 0.5
"""
_VIRTUAL_STRING = """\
sections:
  - {length_m: 3000, outer_diameter_m: 0.127, inner_diameter_m: 0.1086}
bottom:
  inertia_kg_m2: 374
  friction: stribeck
  static_nm: 5000
  coulomb_nm: 2500
  stribeck_speed_rad_s: 2.5
  viscous_nm_s_rad: 20
"""


def _interval(value: float, low: float, high: float) -> dict[str, float]:
    return {"value": value, "low": low, "high": high}


_TUNING = json.dumps({
    "identified": {
        "inertia_kg_m2": {"value": 1500.0}, "viscous_nm_s_rad": {"value": 8.0}, "coulomb_nm": {"value": 60.0},
        "speed_lag_s": _interval(0.4, 0.39, 0.41), "torque_lag_s": _interval(0.15, 0.14, 0.16), "gear_ratio": 1.0,
    },
    "main_shaft": {"inertia_kg_m2": _interval(1500.0, 1440.0, 1560.0), "viscous_nm_s_rad": 8.0, "coulomb_nm": 60.0,
                   "inner_lags_s": [0.02, 0.01, 0.003]},
    "string": {
        "impedance_nm_s_rad": 296.5008069870491, "stiffness_nm_rad": 314.1278126990153, "echo_s": 1.8877717604148878,
        "modes_hz": [0.1299478, 0.566667, 1.0790772], "bottom_inertia_kg_m2": 374.0,
        "bit": {"coulomb_nm": 2500.0, "static_nm": 5000.0},
    },
    "controllers": [{
        "kind": "soft", "refused": None,
        "at_main_shaft": {"gain_nm_s_rad": 1186.0032, "integral_nm_rad": 999.9749, "compensated_kg_m2": 0.0,
                          "derivative_filter_s": 0.05},
        "least_damping": _interval(0.2256, 0.2125, 0.2398),
        "critical_rpm": {"cure": _interval(57.0, 56.0, 59.0)},
    }],
})
"""Document of `tdhil tune --json` for this string below this top drive, with the keys that `tdhil evaluate` reads."""

_IDENTIFY = ("identify", "--simulate")
_PLANT, _RIG = ("--plant", "{folder}/plant.yaml"), ("--rig", "{folder}/rig.yaml")
_RATE = ("--rate", "20")
_SPEED_ONLY = frozenset({"torque", "hold"})
_SHORT = ("--periods", "4")

PROGRAMS: Mapping[str, CommandLine] = {one.name: one for one in (
    CommandLine("identify", (*_IDENTIFY, *_RATE, *_SHORT), 104.0, 20.0, 400.0, 10.0),
    CommandLine("identify, Modbus", (*_IDENTIFY, "--drive", "modbus", *_RATE, *_SHORT), 104.0, 20.0, 400.0, 10.0,
                demand=False, modbus=True),
    CommandLine("identify, speed mode, Modbus", (*_IDENTIFY, "--profile", "schneider/atv320", *_RATE, *_SHORT),
                104.0, 20.0, 400.0, 10.0, position=False, demand=False, modbus=True, skipped=_SPEED_ONLY,
                torque_mode=False),
    CommandLine("identify, no position", (*_IDENTIFY, "--profile", "elmo/gold", *_RATE, *_SHORT),
                104.0, 20.0, 400.0, 10.0, position=False, demand=False, skipped=_SPEED_ONLY, torque_mode=False),
    CommandLine("identify, string", (*_IDENTIFY, *_RATE, *_SHORT, *_PLANT, *_RIG), 1500.0, 60.0, 4000.0, 10.0,
                {"plant.yaml": _STRING_PLANT, "rig.yaml": _STRING_RIG}, string=True),
    CommandLine("identify, string, Modbus", (*_IDENTIFY, "--drive", "modbus", *_RATE, *_SHORT, *_PLANT, *_RIG),
                1500.0, 60.0, 4000.0, 10.0, {"plant.yaml": _STRING_PLANT, "rig.yaml": _STRING_RIG}, string=True,
                demand=False, modbus=True),
    CommandLine("impedance", (*_IDENTIFY, "--rate", "50", "--impedance", "offset", "--string-impedance", "20.56",
                              "--periods", "8"), 104.0, 20.0, 400.0, 10.0, skipped=frozenset({"torque"}),
            torque_mode=False),
    CommandLine("prbs, string", (*_IDENTIFY, *_RATE, "--excitation", "prbs", "--max-time", "160", *_PLANT, *_RIG),
                1500.0, 60.0, 15000.0, 26.0, {"plant.yaml": _BIT_PLANT, "rig.yaml": _BIT_RIG}, string=True),
    CommandLine("virtual string", ("evaluate", "--simulate", "--virtual-string", "{folder}/string.yaml", "--controller",
                                   "{folder}/tune.json", "--use", "soft", "--rate", "50", *_PLANT, *_RIG),
            1500.0, 60.0, 15000.0, 15.0,
            {"plant.yaml": _TOP_PLANT, "rig.yaml": _TOP_RIG, "string.yaml": _VIRTUAL_STRING, "tune.json": _TUNING}),
)}

# ---------------------------------------------------------------------------------------------------------------------
# Lies with their values. An amount is a share of a limit of the rig.


_FROM_START, _IN_STOP = frozenset({"", "setup+2s"}), frozenset({"stop", "stop+500ms"})
_SCALES = ("-scale", "torque-constant")


@dataclass(frozen=True)
class LieWithValue:
    """A lie with a value. ``of``: the limit of which the amount is a share."""

    name: str
    value: str = ""
    of: str = ""

    def text(self, program: CommandLine) -> str:
        """Return the value for the fault script."""
        if not self.of:
            return self.value
        whole = program.speed_max_rad_s if self.of == "speed" else program.torque_nm
        return f"{float(self.value) * whole:g}"


def _each(name: str, *values: str, of: str = "") -> tuple[LieWithValue, ...]:
    return tuple(LieWithValue(name, value, of) for value in values)


TOLD: tuple[LieWithValue, ...] = (
    *(LieWithValue(f"{signal}-{way}") for signal in ("speed", "torque", "demand", "position", "sensor")
      for way in ("lost", "frozen", "sign")),
    *(LieWithValue(f"{signal}-ones") for signal in ("speed", "torque", "demand", "position")),
    *_each("speed-scale", "0.1", "0.5", "0.9", "2", "10"),
    *_each("torque-scale", "0.1", "0.5", "0.9", "1.1", "2", "10"),
    *_each("demand-scale", "0.5", "2"), *_each("position-scale", "0.5", "2"),
    *_each("sensor-scale", "0.1", "0.5", "0.9", "2", "10"),
    *_each("speed-offset", "-0.3", "-0.1", "0.1", "0.3", of="speed"),
    *_each("sensor-offset", "-0.3", "0.3", of="speed"),
    *_each("torque-offset", "-0.2", "0.2", of="torque"), *_each("demand-offset", "0.2", of="torque"),
    *_each("position-offset", "3"),
    *_each("speed-delay", "300ms", "1s", "3s"), *_each("torque-delay", "300ms", "1s"), *_each("demand-delay", "1s"),
    *_each("position-delay", "1s"), *_each("sensor-delay", "100ms", "500ms"), *_each("feedback-delay", "500ms", "2s"),
    *_each("speed-coarse", "0.1", of="speed"), *_each("sensor-coarse", "0.1", of="speed"),
    *_each("torque-coarse", "0.2", of="torque"), *_each("demand-coarse", "0.2", of="torque"),
    *_each("position-coarse", "3"), *_each("sensor-slips", "30%", "80%"),
    *(LieWithValue(name) for name in (
        "speed-swapped", "torque-swapped", "speed-torque-swapped", "status-zero", "status-ones", "status-frozen",
        "feedback-zero", "feedback-ones", "frozen-feedback", "motor-polarity", "quick-stop-inverted")),
    *_each("torque-constant", "0.5", "0.9", "1.1", "2"), *_each("torque-stuck", "-0.3", "0.3", of="torque"),
    # new ones go to the end: the number of a combination is its seed
    *_each("demand-scale", "0.1", "10"), *_each("position-scale", "0.1", "10"), *_each("sensor-slips", "10%"),
)

MOMENTS = ("", "setup+2s", "speed+12s", "torque+3s", "hold+3s", "acquire+20s", "stop", "stop+500ms")
"""Moments at which a lie begins; '' is power-on, so it acts from the start."""

_EARLY_STOP = "emcy@acquire+5s=3210h"
"""A harmless cause of a stop, so that a lie during the stop needs no whole run."""


@dataclass(frozen=True)
class Combination:
    """One run with one lie."""

    number: int
    program: CommandLine
    told: LieWithValue
    moment: str

    @property
    def seed(self) -> int:
        """Seed of the simulated rig."""
        return 1 + self.number % 9973

    @property
    def fault(self) -> str:
        """Fault as in the script."""
        when, value = self.moment and f"@{self.moment}", self.told.text(self.program)
        return f"{self.told.name}{when}" + (f"={value}" if value else "")

    @property
    def where(self) -> str:
        """Wrong part of the drive."""
        if self.told.name.startswith("sensor"):
            return "sensor"
        return "power stage" if self.told.name in _POWER_STAGE else "report"

    @property
    def scale_change(self) -> float | None:
        """Relative change of a scale during the run, as the larger of f − 1 and 1/f − 1; None for another lie."""
        if self.moment in _FROM_START or not self.told.name.endswith(_SCALES):
            return None
        factor = float(self.told.value)
        return max(abs(factor - 1.0), abs(1.0 / factor - 1.0))

    @property
    def ends_early(self) -> bool:
        """True if a harmless cause stops the run: in half of the runs whose lie begins in the stop, if the bus offers
        one.
        """
        return self.moment.startswith("stop") and not self.program.modbus and self.number % 2 == 0

    def arguments(self, folder: str) -> list[str]:
        """Return the command line without log, trace and format."""
        faults = [self.fault, *[_EARLY_STOP] * self.ends_early]
        options = [part for fault in faults for part in ("--fault", fault)]
        return [one.replace("{folder}", folder) for one in self.program.arguments] + [
            "--seed", str(self.seed), *options]

    @property
    def largest_torque_nm(self) -> float:
        """Largest torque of the power stage on the shaft, N·m."""
        share = float(self.told.value) if self.told.name == "torque-constant" else 1.0
        return self.program.torque_nm * max(1.0, share)

    def __str__(self) -> str:
        return f"{self.number}: {self.program.name}: {self.fault}" + " (early stop)" * self.ends_early


_POWER_STAGE = {"torque-constant", "motor-polarity", "quick-stop-inverted", "torque-stuck"}


@dataclass(frozen=True)
class Unknowable:
    """A lie that no arithmetic on the reports can detect, and the rules that are then not applied to it."""

    reason: str
    rules: frozenset[str]


@dataclass(frozen=True)
class Blind:
    """Cases in which no arithmetic on the reports can detect a lie: starts of names, moments, and the load."""

    lies: tuple[str, ...]
    unknowable: Unknowable
    moments: frozenset[str] = frozenset()      # empty: at any moment
    string: bool | None = None                 # None: with or without a string
    demand: bool | None = None                 # True: torque is commanded or its demand reported; False: neither
    position: bool | None = None               # True: the drive reports its position; False: it does not

    @property
    def words(self) -> str:
        """Description of these combinations."""
        load = {None: "", True: ", above a string", False: ", without a string"}[self.string]
        position = {None: "", True: ", beside a position", False: ", without a position"}[self.position]
        when = f", {' or '.join(sorted(one or 'from the start' for one in self.moments))}" if self.moments else ""
        return " and ".join(name.rstrip("-") for name in self.lies) + load + position + when

    def holds(self, told: LieWithValue, moment: str, program: CommandLine) -> bool:
        """Return whether a combination is one of these."""
        known = program.torque_mode or program.demand
        return (
            told.name.startswith(self.lies)
            and (not self.moments or moment in self.moments)
            and (self.string is None or self.string is program.string)
            and (self.demand is None or self.demand is known)
            and (self.position is None or self.position is program.position)
        )


UNKNOWABLE: tuple[Blind, ...] = (
    Blind(("torque-constant",), Unknowable(
        "demanded, reported and commanded torque agree, and all are the same factor off: J is that factor off",
        frozenset("c")), _FROM_START),
    Blind(("sensor-scale", "sensor-slips"), Unknowable(
        "the drive's speed control, its speed limiter and its position counter follow one wrong sensor",
        frozenset("cd")), _FROM_START),
    Blind(("sensor-slips",), Unknowable(
        "speed and position go up and down together with the slip, as those of a shaft that accelerates",
        frozenset("a")), _FROM_START),
    Blind(("torque-scale",), Unknowable(
        "in speed mode no torque is commanded, and this drive reports no torque demand", frozenset("c")),
        _FROM_START, demand=False),
    Blind(("sensor-",), Unknowable(
        "above a drill string neither J nor the load is known before stage 2 ends: a torque at its limit may be a bit"
        " that sticks, and how long a shaft runs out without torque is not known", frozenset("abd")),
        _FROM_START | {"speed+12s"}, string=True),
    Blind(("sensor-offset",), Unknowable(
        "the drive holds the shaft at the offset with a torque that static friction could hold as well; once that is"
        " off, the reported speed changes, and the run ends with exit 8", frozenset("a")), string=False),
    Blind(("sensor-coarse",), Unknowable(
        "a shaft that is slower than half a step of the sensor is reported at rest by speed, position and torque",
        frozenset("ab"))),
    Blind(("speed-coarse",), Unknowable(
        "a shaft that is slower than half a step of the report is reported at rest, and no position shows its motion",
        frozenset("ab")), position=False),
    Blind(("motor-polarity", "torque-sign"), Unknowable(
        "the reports are those of a lost encoder and a torque that pushes the shaft on: the torque is removed",
        frozenset("a")), _IN_STOP, string=False),
)
"""Lies that can't be detected. `docs/explanation/stop.md` names each. If one begins later in a run than stated, it is a
change, which can be detected."""


def unknowable(combination: Combination) -> Unknowable | None:
    """Return why a combination can't be detected; None if it can. If several reasons apply, their rules are
    combined.
    """
    found = [one.unknowable for one in UNKNOWABLE
             if one.holds(combination.told, combination.moment, combination.program)]
    if not found:
        return None
    return Unknowable("; ".join(one.reason for one in found), frozenset().union(*(one.rules for one in found)))


# ---------------------------------------------------------------------------------------------------------------------


@cache
def product() -> tuple[Combination, ...]:
    """Return every combination, numbered."""
    found: list[Combination] = []
    for told in TOLD:
        if told.name not in LIES and told.name != "frozen-feedback":
            raise ValueError(f"no lie is called {told.name}")
        signal = told.name.split("-", maxsplit=1)[0]
        for moment in MOMENTS:
            for program in PROGRAMS.values():
                # The drive must report that signal, and the run must have that moment.
                reported = {"position": program.position, "demand": program.demand}.get(signal, True)
                if reported and moment.split("+", maxsplit=1)[0] not in program.skipped:
                    found.append(Combination(len(found), program, told, moment))
    return tuple(found)


def standard() -> Iterator[Combination]:
    """Yield every lie at every moment once, with alternating programs."""
    groups: dict[tuple[LieWithValue, str], list[Combination]] = {}
    for one in product():
        groups.setdefault((one.told, one.moment), []).append(one)
    for number, group in enumerate(groups.values()):
        yield group[number % len(group)]


def sample(count: int, seed: int) -> list[Combination]:
    """Return a seeded part of the product."""
    rng = np.random.default_rng((seed, 0x25))
    return [product()[number] for number in sorted(rng.choice(len(product()), count, replace=False).tolist())]
