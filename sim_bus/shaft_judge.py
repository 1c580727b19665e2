"""Comparison of the true shaft's motion with the run's statements: six rules for a run with faults. Pure.

a  The host never disables a drive whose shaft turns. Exception: there is no string, the shaft accelerates against the
   quick stop or is as slow as in a sign probe, and the outcome states that the torque was removed.
b  The shaft turns slower than `TURNING_RAD_S` when it is reported to be at standstill, and when its drive is disabled
   unless by that exception.
c  An inertia that is `valid` or `valid_wide` has the true one in its total interval. Exception: a scale changed in the
   run by less than the least change that the run states it can show.
d  The true speed stays below 1.1 times the limit, plus the effect of torque limit and friction in a reaction time.
e  The process ends with a known exit code and a closed log.
f  The shaft does not turn under torque at the end of the trace, after the drive has been alone.
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
from sim_bus.trace import HEADER

TURNING_RAD_S = 0.2
"""Least speed of a turning shaft, rad/s. A slower one counts as at standstill."""

PROBE_SHARE = 0.1
"""Speed of a sign probe, as a share of the speed limit: friction stops such a shaft at once."""

SPEED_SHARE = 1.1
"""Multiple of the speed limit that the true speed may always have."""

REACTION_S = 1.0
"""Time for which the drive's torque may act before it is detected, s, unless stated otherwise."""

ACCELERATES_RAD_S = 0.3
"""Least increase of the speed in a stop that counts as an acceleration against it, rad/s."""

BEFORE_S = 3.0
"""Time before the quick stop of a release above a string, s. The comparison uses the speed at that time."""

EXIT_CODES = frozenset({0, 3, 4, 5, 6, 7, 8, 9, 12, 130, 143})
"""Exit codes of `tdhil.errors`, except 1 (an internal error) and 2 (an impossible request)."""

_REMOVED = "torque removed"
_STANDSTILL = "shaft at standstill, drive disabled"
"""End of a live display. A rehearsal names what was required in words of its own."""
_STANDS = ("valid", "valid_wide")


@dataclass(frozen=True)
class TrueShaft:
    """The true shaft, from a shaft trace (`sim_bus.trace`)."""

    time_s: NDArray[np.float64]
    speed_rad_s: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    enabled: NDArray[np.bool_]
    """True while the power stage is on."""
    disabled_s: tuple[float, ...]
    """Times at which the host switched it off, s."""
    stop_s: float
    """Time of the first quick stop after the shaft has turned, s; inf without one."""

    def speed_at(self, time_s: float) -> float:
        """Return the magnitude of the speed, rad/s."""
        return abs(float(np.interp(time_s, self.time_s, self.speed_rad_s))) if len(self.time_s) else 0.0

    def reversed_at(self, time_s: float) -> bool:
        """Return whether the shaft has reversed since the stop began: the drive accelerated it past standstill."""
        then, now = (float(np.interp(at_s, self.time_s, self.speed_rad_s)) for at_s in (self.stop_s, time_s))
        return then * now < 0.0

    @property
    def fastest_rad_s(self) -> float:
        """Largest magnitude of the speed, rad/s."""
        return float(np.abs(self.speed_rad_s).max(initial=0.0))

    @property
    def largest_torque_nm(self) -> float:
        """Largest magnitude of the torque on the shaft, N·m."""
        return float(np.abs(self.torque_nm).max(initial=0.0))

    @property
    def driven_rad_s(self) -> float:
        """Magnitude of the speed at the end while the power stage is on, rad/s; else 0."""
        return abs(float(self.speed_rad_s[-1])) if len(self.time_s) and self.enabled[-1] else 0.0


_COLUMNS = len(HEADER.split(","))
_ON = {"operation enabled", "quick stop active", "fault reaction active"}


def read_shaft(path: Path) -> TrueShaft:
    """Return the true shaft of a complete trace. Raises OSError, and ValueError for a file that is no trace."""
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").split("\n")[1:-1]]
    if any(len(row) != _COLUMNS for row in rows):
        raise ValueError(f"a row of {path.name} does not have {_COLUMNS} columns")
    numbers = np.array([[float(cell) for cell in row[:3]] for row in rows]).reshape(-1, 3)
    stops = [float(row[0]) for row in rows if row[4] == "state: quick stop active"]
    return TrueShaft(
        numbers[:, 0], numbers[:, 1], numbers[:, 2], np.array([row[3] in _ON for row in rows], dtype=np.bool_),
        tuple(float(row[0]) for row in rows if row[4] == DISABLED_BY_HOST), stops[0] if stops else inf,
    )


@dataclass(frozen=True)
class ProcessOutcome:
    """End of a process, and its statements."""

    code: int
    at_rest: bool
    """True if it reported standstill."""
    seen_s: float | None
    """Control time of the standstill that it reports, s."""
    verdict: str | None
    low_total: float
    high_total: float
    removed: bool
    """True if it reports that torque was removed from a turning shaft."""
    log_closed: bool
    message: str = ""
    least_scale_change: float = 0.0
    """Least relative change of a signal's scale that the run states it can show; 0: no statement."""


def outcome_of(code: int, document: Mapping[str, Any] | None, said: str, *, log_closed: bool) -> ProcessOutcome:
    """Make the outcome from exit code, JSON document and stderr."""
    document = document or {}
    words = " ".join(said.split())
    inertia, error = document.get("inertia_kg_m2") or {}, document.get("error") or {}
    seen = re.search(r"at standstill \(seen at ([\d.]+) s\)", words)
    confirmed = _STANDSTILL in words or seen is not None
    return ProcessOutcome(
        code, confirmed, float(seen[1]) if seen else None, document.get("verdict"),
        inertia.get("low_total", -inf), inertia.get("high_total", inf), _REMOVED in words.lower(), log_closed,
        error.get("message") or document.get("stop") or document.get("reason") or words[-200:],
        max((one.get("least_scale_change") or 0.0 for one in document.get("second_opinions") or ()), default=0.0),
    )


@dataclass(frozen=True)
class JudgedMachine:
    """Data of the rig for the judge. ``torque_nm``: largest torque of the power stage on the shaft."""

    inertia_kg_m2: float
    coulomb_nm: float
    torque_nm: float
    speed_max_rad_s: float
    string: bool


@dataclass(frozen=True)
class Judged:
    """Result. ``broken``: rule → observation. ``excused``: the same for rules that were not applied."""

    broken: Mapping[str, str]
    excused: Mapping[str, str]
    reaction_s: float
    """Used part of the reaction time beyond 1.1 times the limit, s."""
    fastest_rad_s: float


def judge(shaft: TrueShaft, outcome: ProcessOutcome, machine: JudgedMachine, *, not_asked: frozenset[str] = frozenset(),
          scale_change: float | None = None, reaction_s: float = REACTION_S) -> Judged:
    """Return the rules that a run broke. ``scale_change``: relative change of a scale in mid-run, if that
    is the lie.
    """
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
    used_s = 0.0 if beyond <= 0.0 else beyond * machine.inertia_kg_m2 / (machine.torque_nm + machine.coulomb_nm)
    if used_s > reaction_s or not isfinite(used_s):
        seen["d"] = (f"it reached {shaft.fastest_rad_s:.2f} rad/s, the limit is {machine.speed_max_rad_s:g} rad/s: the"
                     f" torque acted for {used_s:.2f} s")
    if outcome.code not in EXIT_CODES or not outcome.log_closed:
        seen["e"] = f"exit {outcome.code}, log {'closed' if outcome.log_closed else 'not closed'}"
    if shaft.driven_rad_s > TURNING_RAD_S:
        seen["f"] = f"it still turned under torque at the end, at {shaft.driven_rad_s:.2f} rad/s"
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
    beyond = speed > machine.speed_max_rad_s       # above a string torque is removed only beyond the limit
    slow = speed <= PROBE_SHARE * machine.speed_max_rad_s and not machine.string
    if (accelerated or slow) and outcome.removed and (beyond or not machine.string):
        return ""
    return f"the drive was disabled at {speed:.2f} rad/s, {at_s:.2f} s" + ", while it accelerated" * accelerated


def _at_rest(shaft: TrueShaft, outcome: ProcessOutcome) -> str:
    if not outcome.at_rest:
        return ""
    disabled_s = () if outcome.removed else shaft.disabled_s[-1:]
    moments = [one for one in (outcome.seen_s, *disabled_s) if one is not None]
    speed = max((shaft.speed_at(at_s) for at_s in moments), default=0.0)
    return f"standstill was reported at {speed:.2f} rad/s" if speed > TURNING_RAD_S else ""
