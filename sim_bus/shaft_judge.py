"""The true shaft's motion compared with the run's statements: five rules for a run with wrong reports. Pure.

a  The host never disables a drive whose shaft turns. Excepted: no string hangs on it, the shaft accelerates against
   the quick stop, and the outcome says that the torque was removed.
b  The shaft turns slower than `TURNING_RAD_S` when it is reported to be at rest.
c  An inertia that is `valid` or `valid_wide` has the true one in its total interval. Excepted: a scale changed in the
   run by less than the least change that the run says it can show.
d  The true speed stays below 1.1 times the limit, and what torque limit and friction add in a reaction time.
e  The process ends with a known exit code and a closed log.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bus.cia402 import DISABLED_BY_HOST

TURNING_RAD_S = 0.2
"""A shaft that is faster is not at rest."""

SPEED_SHARE = 1.1
"""Multiple of the speed limit that the true speed may always have."""

REACTION_S = 1.0
"""For how long the drive's torque may act before it is noticed, unless stated otherwise."""

ACCELERATES_RAD_S = 0.3
"""A shaft that gets faster by so much in a stop accelerates against it."""

BEFORE_S = 3.0
"""Before the quick stop of a release above a string: the comparison uses the speed of this time before, s."""

EXIT_CODES = frozenset({0, 3, 4, 5, 6, 7, 8, 9, 12, 130, 143})
"""Exit codes of `tdhil.errors`, except 1 (an internal error) and 2 (an impossible request)."""

_REMOVED = "torque removed"
_STANDS = ("valid", "valid_wide")


@dataclass(frozen=True)
class TrueShaft:
    """The true shaft, from a shaft trace (`sim_bus.trace`)."""

    time_s: NDArray[np.float64]
    speed_rad_s: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    enabled: NDArray[np.bool_]
    """The power stage is on."""
    disabled_s: tuple[float, ...]
    """When the host switched it off."""
    stop_s: float
    """The first quick stop after the shaft has turned; inf without one."""

    def speed_at(self, time_s: float) -> float:
        """The speed's magnitude."""
        return abs(float(np.interp(time_s, self.time_s, self.speed_rad_s))) if len(self.time_s) else 0.0

    def reversed_at(self, time_s: float) -> bool:
        """Return whether the shaft has reversed since the stop began: the drive accelerated it past standstill."""
        then, now = (float(np.interp(at_s, self.time_s, self.speed_rad_s)) for at_s in (self.stop_s, time_s))
        return then * now < 0.0

    @property
    def fastest_rad_s(self) -> float:
        """Magnitude."""
        return float(np.abs(self.speed_rad_s).max(initial=0.0))


_ON = {"operation enabled", "quick stop active", "fault reaction active"}


def read_shaft(path: Path) -> TrueShaft:
    """A trace that is complete."""
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").split("\n")[1:-1]]
    numbers = np.array([[float(cell) for cell in row[:3]] for row in rows]).reshape(-1, 3)
    stops = [float(row[0]) for row in rows if row[4] == "state: quick stop active"]
    return TrueShaft(
        numbers[:, 0], numbers[:, 1], numbers[:, 2], np.array([row[3] in _ON for row in rows], dtype=np.bool_),
        tuple(float(row[0]) for row in rows if row[4] == DISABLED_BY_HOST), stops[0] if stops else inf,
    )


@dataclass(frozen=True)
class ProcessOutcome:
    """How a process ended, and what it said."""

    code: int
    at_rest: bool
    """It reported that the shaft is at rest."""
    seen_s: float | None
    """Control time at which it says to have seen that."""
    verdict: str | None
    low_total: float
    high_total: float
    removed: bool
    """It says that torque was removed from a turning shaft."""
    log_closed: bool
    message: str = ""
    least_scale_change: float = 0.0
    """The least relative change of a signal's scale that the run says it can show; 0: it says nothing."""


def outcome_of(code: int, document: Mapping[str, Any] | None, said: str, *, log_closed: bool) -> ProcessOutcome:
    """Make the outcome from exit code, JSON document and stderr."""
    document = document or {}
    words = " ".join(said.split())
    inertia, error = document.get("inertia_kg_m2") or {}, document.get("error") or {}
    seen = re.search(r"at rest \(seen at ([\d.]+) s\)", words)
    return ProcessOutcome(
        code, "shaft at rest" in words or seen is not None, float(seen[1]) if seen else None, document.get("verdict"),
        inertia.get("low_total", -inf), inertia.get("high_total", inf), _REMOVED in words.lower(), log_closed,
        error.get("message") or document.get("stop") or document.get("reason") or words[-200:],
        max((one.get("least_scale_change") or 0.0 for one in document.get("second_opinions") or ()), default=0.0),
    )


@dataclass(frozen=True)
class JudgedMachine:
    """The judge's knowledge of the rig. ``torque_nm``: largest torque of the power stage on the shaft."""

    inertia_kg_m2: float
    coulomb_nm: float
    torque_nm: float
    speed_max_rad_s: float
    string: bool


@dataclass(frozen=True)
class Judged:
    """``broken``: rule → what was seen. ``excused``: the same of rules that were not asked."""

    broken: Mapping[str, str]
    excused: Mapping[str, str]
    reaction_s: float
    """How much of the reaction time was used beyond 1.1 times the limit."""
    fastest_rad_s: float


def judge(shaft: TrueShaft, outcome: ProcessOutcome, machine: JudgedMachine, *, not_asked: frozenset[str] = frozenset(),
          scale_change: float | None = None, reaction_s: float = REACTION_S) -> Judged:
    """Which rules a run broke. ``scale_change``: relative change of a scale in mid-run, if that is the lie."""
    if scale_change is not None and scale_change <= outcome.least_scale_change:
        not_asked |= {"c"}
    seen: dict[str, str] = {}
    if said := _disabled(shaft, outcome, machine):
        seen["a"] = said
    if said := _at_rest(shaft, outcome):
        seen["b"] = said
    if outcome.verdict in _STANDS and not outcome.low_total <= machine.inertia_kg_m2 <= outcome.high_total:
        seen["c"] = (f"{outcome.verdict}: J in [{outcome.low_total:.4g}, {outcome.high_total:.4g}], "
                     f"true {machine.inertia_kg_m2:g}")
    beyond = shaft.fastest_rad_s - SPEED_SHARE * machine.speed_max_rad_s
    used_s = max(0.0, beyond) * machine.inertia_kg_m2 / (machine.torque_nm + machine.coulomb_nm)
    if used_s > reaction_s or not isfinite(used_s):
        seen["d"] = f"{shaft.fastest_rad_s:.2f} rad/s, limit {machine.speed_max_rad_s:g}: reaction {used_s:.2f} s"
    if outcome.code not in EXIT_CODES or not outcome.log_closed:
        seen["e"] = f"exit {outcome.code}, log {'closed' if outcome.log_closed else 'not closed'}"
    return Judged({rule: text for rule, text in seen.items() if rule not in not_asked},
                  {rule: text for rule, text in seen.items() if rule in not_asked}, used_s, shaft.fastest_rad_s)


def _disabled(shaft: TrueShaft, outcome: ProcessOutcome, machine: JudgedMachine) -> str:
    turning = [(at_s, shaft.speed_at(at_s)) for at_s in shaft.disabled_s]
    turning = [(at_s, speed) for at_s, speed in turning if speed > TURNING_RAD_S]
    if not turning:
        return ""
    at_s, speed = turning[0]
    accelerated = shaft.stop_s < at_s and (
        speed > shaft.speed_at(shaft.stop_s) + ACCELERATES_RAD_S or shaft.reversed_at(at_s)
    )
    accelerated = accelerated or speed > shaft.speed_at(at_s - BEFORE_S) + ACCELERATES_RAD_S
    beyond = speed > machine.speed_max_rad_s       # above a string torque is removed from such a shaft only
    if accelerated and outcome.removed and (beyond or not machine.string):
        return ""
    return f"disabled at {speed:.2f} rad/s, {at_s:.2f} s" + ", accelerating" * accelerated


def _at_rest(shaft: TrueShaft, outcome: ProcessOutcome) -> str:
    if not outcome.at_rest:
        return ""
    moments = [one for one in (outcome.seen_s, *shaft.disabled_s[-1:]) if one is not None]
    speed = max((shaft.speed_at(at_s) for at_s in moments), default=0.0)
    return f"reported at rest at {speed:.2f} rad/s" if speed > TURNING_RAD_S else ""
