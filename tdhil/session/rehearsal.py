"""The verdict on a rehearsed fault: the reaction that the fault table requires, the observation, pass or fail.

A rehearsal runs on the embedded simulator only, so the true inertia is known. `REQUIRED` is the one place of the
required reactions of all faults that can be scripted; docs/reference/faults.md is made from it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from profiles import MessageCode, with_code
from tdhil.errors import ExitCode, exit_code

if TYPE_CHECKING:
    from sim_bus import Judged, KnownFault, Scripted, TrueShaft
    from tdhil.buses import PeerPlan
    from tdhil.runner import RunOutcome


@dataclass(frozen=True)
class RequiredReaction:
    """Requirement of a row of the fault table. ``codes``: permitted exit codes of the run.

    ``or_covered``: the run may also continue, if the interval of its result covers the true inertia.
    """

    reaction: str
    codes: tuple[int, ...]
    or_covered: bool = False

    @property
    def words(self) -> str:
        """Return the reaction without the abbreviations of the table."""
        return _SHORT.sub(lambda found: _LONG[found[0]], self.reaction)


_LONG: Final = {
    "QS": "stop sequence", "WD": "the drive's own watchdog stops the shaft", "R": "refused before motion",
    "M": "the degraded part is marked",
}
"""Abbreviations of the fault table, in words."""
_SHORT: Final = re.compile(rf"\b(?:{'|'.join(_LONG)})\b")


ANY_STOP: Final = (4, 5, 6, 7, 8, 9)
"""Exit codes of a run that a wrong report has ended. The check that detects the report first determines the code."""

REQUIRED: Final[Mapping[int, RequiredReaction]] = {
    12: RequiredReaction("WD", (8,)),
    17: RequiredReaction("gaps are found, the interval is wider, M", (0, 9)),
    18: RequiredReaction("the frames are found, M", (0, 9)),
    19: RequiredReaction("age limit of the feedback, QS", (5, 8)),
    20: RequiredReaction("QS is attempted", (5,)),
    21: RequiredReaction("abort; the drive is not enabled again", (6,)),
    22: RequiredReaction("abort", (5,)),
    23: RequiredReaction("QS, code decoded", (6,)),
    24: RequiredReaction("object and reason are named; R", (4,)),
    25: RequiredReaction("a limited number of retries, then abort", (5,)),
    26: RequiredReaction("R; QS in motion", (4, 5, 6, 8)),
    29: RequiredReaction("R", (4,)),
    30: RequiredReaction("no reset without the operator: R", (4,)),
    31: RequiredReaction("time-out, QS", (6,)),
    32: RequiredReaction("R; QS if it occurs in motion", (4, 6)),
    33: RequiredReaction("abort with its own message", (6, 7), or_covered=True),
    34: RequiredReaction("QS; the drive's own speed limit was set first", (7,)),
    35: RequiredReaction("QS", (4, 7)),
    36: RequiredReaction("sign probe, QS", (4,)),
    38: RequiredReaction("an error of its own class; busy (6) is repeated", (0, 6, 8, 9)),
    39: RequiredReaction("retries within the time of the watchdog, then QS", (0, 8, 9)),
    40: RequiredReaction("the late reply is discarded, and requests and replies match again", (0, 8, 9)),
    41: RequiredReaction("the sample is dropped, and the connection closed", (5, 8)),
    42: RequiredReaction("the reply is dropped and counted", (0, 8, 9)),
    43: RequiredReaction("WD; no new connection while the drive is enabled", (8,)),
    44: RequiredReaction("check of a known register, R", (4,)),
    45: RequiredReaction("read back, R", (4,)),
    50: RequiredReaction("R, unless the operator accepts it by name", (4,), or_covered=True),
    56: RequiredReaction("a free node ID before motion; QS in motion, for any period", (0, 5)),
    57: RequiredReaction("read back at once, QS", (5,)),
    58: RequiredReaction("read back, QS", (5,)),
    59: RequiredReaction("that RPDO is disabled; QS, standstill", (5,)),
    60: RequiredReaction("QS, standstill", (5,)),
    61: RequiredReaction("reported in the log, in the result and at the end", (0,)),
    82: RequiredReaction("QS", (6,)),
    115: RequiredReaction(
        "found by torque and inertia; QS; a turning shaft is not disabled; torque off if the shaft accelerates",
        ANY_STOP, or_covered=True),
    116: RequiredReaction(
        "QS; standstill by the position, if it is reported; else not confirmed and not disabled", ANY_STOP,
        or_covered=True),
    117: RequiredReaction("QS", ANY_STOP, or_covered=True),
    118: RequiredReaction("QS, no J", ANY_STOP, or_covered=True),
    119: RequiredReaction("QS", ANY_STOP, or_covered=True),
    120: RequiredReaction(
        "no valid state: QS is repeated; the drive is not disabled", ANY_STOP, or_covered=True),
    121: RequiredReaction(
        "two independent signs: torque off, exit 8; above a drill string only beyond the speed limit",
        ANY_STOP, or_covered=True),
    122: RequiredReaction("abort, code decoded; QS if the drive follows", (6,)),
    123: RequiredReaction("abort; WD", (5,)),
    124: RequiredReaction("no sample; M; QS if feedback is missing for too long", (0, 5, 8, 9)),
    125: RequiredReaction("R; in motion QS if watchdog and limits cannot be read back", (4, 5)),
    126: RequiredReaction("R", (4,)),
    127: RequiredReaction("unaffected: the cycle follows the clock", (0, 9)),
}
"""Required reactions by row of docs/reference/faults.md."""

ANY_FAULT: Final = RequiredReaction(
    "the shaft is at standstill, or the missing standstill is reported; no interval of J misses the true inertia",
    ANY_STOP, or_covered=True,
)
"""Required reaction to a fault without a row of its own."""

OTHER_PROGRAMS: Final = (5, 6, 7, 8, 9)
"""Exit codes of rows 97 and 102: any fault while a virtual string, or the drive's impedance, is in the loop."""


class RehearsalVerdict(StrEnum):
    """Verdict on the rehearsed faults of one run."""

    PASS = "pass"
    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"      # not triggered, ended by the operator, or without the shaft's motion


_KEPT_CODES = frozenset({
    ExitCode.INTERNAL, ExitCode.PARTIAL, ExitCode.STOP_NOT_CONFIRMED, ExitCode.INTERRUPTED, ExitCode.TERMINATED,
})
"""Exit codes that a failed rehearsal does not replace, because they state more."""


@dataclass(frozen=True)
class RehearsedFault:
    """One fault of the script. ``row`` of the fault table; 0: it has none."""

    fault: str
    row: int
    required: str
    codes: tuple[int, ...]
    verdict: RehearsalVerdict


@dataclass(frozen=True)
class Rehearsal:
    """Verdict on all faults of one run, and the observation."""

    verdict: RehearsalVerdict
    seen: str
    faults: tuple[RehearsedFault, ...]

    def plain(self) -> dict[str, Any]:
        """Return the rehearsal as plain data for the log and the document."""
        return {**asdict(self), "faults": [{**asdict(one), "codes": list(one.codes)} for one in self.faults]}

    def exit_code(self, code: int) -> int:
        """Return the exit code of the run: its own, or `NOT_PASSED` instead."""
        return code_with(self.plain(), code)

    @property
    def _code(self) -> str:
        return MessageCode.REHEARSAL_FAILED.code if self.verdict is RehearsalVerdict.FAIL else ""

    @property
    def lines(self) -> tuple[str, ...]:
        """Return the rehearsal as lines for a terminal."""
        rows = any(one.row for one in self.faults)
        return (
            with_code(f"rehearsal: {self.verdict}{' (rows of docs/reference/faults.md)' if rows else ''}", self._code),
            *(f"{one.fault}: {one.verdict}; required ({row_name(one.row)}): {one.required}" for one in self.faults),
            f"seen: {self.seen}",
        )


def row_name(row: int) -> str:
    """Return ``row 33``, or a text for a fault without a row."""
    return f"row {row}" if row else "no row of its own"


def code_with(rehearsal: Mapping[str, Any] | None, code: int) -> int:
    """Return the exit code of a run with this rehearsal. A code that states more than the rehearsal stays."""
    failed = rehearsal is not None and rehearsal.get("verdict") == RehearsalVerdict.FAIL
    return int(ExitCode.NOT_PASSED) if failed and code not in _KEPT_CODES else code


def required_reaction(kind: KnownFault) -> RequiredReaction:
    """Return the required reaction to a fault."""
    return REQUIRED.get(kind.row, ANY_FAULT)


_OF_THE_CYCLE = ("6040h", "6060h", "6071h", "60FFh")
_STRAY_WRITE = 61


def _row(fault: Scripted, kinds: Mapping[str, KnownFault]) -> int:
    """Return the row of a scripted fault. A stray write to an object that each cycle writes has a row of its own."""
    if fault.name == "tool-writes" and fault.value.startswith(_OF_THE_CYCLE):
        return _STRAY_WRITE
    return kinds[fault.name].row


@dataclass(frozen=True)
class RehearsedShaft:
    """Motion of the simulated shaft, and the speed limit of the run.

    ``missing``: reason why the motion is not known; a rehearsal that has one does not pass.
    """

    motion: TrueShaft | None = None
    missing: str = ""
    speed_max_rad_s: float = math.inf


def judge_rehearsal(
    peer: PeerPlan, drive: str, outcome: RunOutcome, document: Mapping[str, Any] | None = None,
    own_code: int | None = None, *, other_program: bool = False, shaft: RehearsedShaft,
) -> Rehearsal:
    """Return the verdict on the faults of this run.

    ``document``: the result, None if the run ended early; ``own_code``: exit code of the result; ``other_program``:
    the run has a virtual string or measures the drive's impedance. A ``shaft`` without motion and without a reason for
    its absence leaves the verdict to code and result.
    """
    from tdhil.buses import bus_named

    kinds = {one.name: one for one in bus_named(drive).faults()}
    code = _code(outcome) if own_code is None else own_code
    by_hand = code in (ExitCode.INTERRUPTED, ExitCode.TERMINATED)
    truth = None               # of a rigid shaft, kg·m²; of any other plant, J is only a part
    plant = None if peer.plant is None else peer.plant.plant
    if plant is not None and plant.kind == "rigid" and not any(one.name == "load-lost" for one in peer.faults):
        truth = float(plant.inertia_kg_m2 + plant.added_inertia_kg_m2)
    inertia = None if document is None else document.get("inertia_kg_m2")
    covered = None
    if inertia is not None and truth is not None:
        covered = bool(inertia["low_total"] <= truth <= inertia["high_total"])
    triggered = [one for one in peer.faults if one.text not in peer.never_came]
    required = [REQUIRED.get(_row(one, kinds), ANY_FAULT) for one in triggered]
    allowed = {known for one in required for known in one.codes} | (set(OTHER_PROGRAMS) if other_program else set())
    short = any(math.isfinite(one.duration_s) for one in triggered)
    if short or 0 in allowed or any(one.or_covered for one in required):
        allowed |= {0, 9}                  # a result, or the statement that there is none
    moved = None if shaft.motion is None else _judge_shaft(
        peer, outcome, shaft.motion, code, shaft.speed_max_rad_s)
    unsafe = moved is not None and bool(moved.broken)
    passed = code in allowed and covered is not False and not unsafe
    judged = tuple(
        RehearsedFault(
            one.text, row, REQUIRED.get(row, ANY_FAULT).words, REQUIRED.get(row, ANY_FAULT).codes,
            RehearsalVerdict.INCONCLUSIVE
            if (by_hand and not unsafe) or (shaft.missing and passed) or one.text in peer.never_came
            else RehearsalVerdict.PASS if passed else RehearsalVerdict.FAIL,
        ) for one in peer.faults for row in (_row(one, kinds),)
    )
    found = {one.verdict for one in judged}
    worst = next(one for one in (RehearsalVerdict.FAIL, RehearsalVerdict.INCONCLUSIVE, RehearsalVerdict.PASS)
                 if one in found)
    never = f". Not triggered: {', '.join(peer.never_came)}" if peer.never_came else ""
    seen = _seen(outcome, document, code, truth, covered)
    if shaft.motion is not None and moved is not None:
        seen += _shaft_seen(shaft.motion, moved)
    if shaft.missing:
        seen += f"; the motion of the simulated shaft is not known ({shaft.missing})"
    return Rehearsal(worst, seen + never, judged)


_OF_THE_SHAFT = frozenset("abdf")
"""Rules of `sim_bus.shaft_judge` on the motion of the shaft. The other two are on the result and the process."""


def _judge_shaft(
    peer: PeerPlan, outcome: RunOutcome, shaft: TrueShaft, code: int, speed_max_rad_s: float
) -> Judged:
    """Return the rules that the simulated shaft broke."""
    from sim_bus import JudgedMachine, ProcessOutcome, judge

    stop, plant = outcome.stop, peer.plant.plant
    machine = JudgedMachine(
        plant.inertia_kg_m2 + plant.added_inertia_kg_m2, 0.0, shaft.largest_torque_nm, speed_max_rad_s,
        string=plant.kind == "string",
    )
    # In real time the host's clock is not that of the simulation.
    seen_s = stop.at_rest_s if stop is not None and peer.stepped else None
    ended = ProcessOutcome(
        code, stop is not None and stop.confirmed, seen_s, None, -math.inf, math.inf,
        removed=stop is not None and stop.torque_removed, log_closed=True,
    )
    found = judge(shaft, ended, machine)
    return replace(found, broken={rule: text for rule, text in found.broken.items() if rule in _OF_THE_SHAFT})


def _shaft_seen(shaft: TrueShaft, moved: Judged) -> str:
    """Return the motion of the simulated shaft, as it continues the line of `_seen`."""
    from sim_bus import TURNING_RAD_S

    if moved.broken:
        return f"; UNSAFE, the simulated shaft: {'; '.join(moved.broken.values())}"
    ended = "stood still" if shaft.speed_at(math.inf) <= TURNING_RAD_S else "turned without torque"
    return f"; the simulated shaft reached {moved.fastest_rad_s:.2f} rad/s and {ended} at the end"


def _code(outcome: RunOutcome) -> int:
    if outcome.stop is not None and not outcome.stop.confirmed:
        return int(ExitCode.STOP_NOT_CONFIRMED)
    return int(ExitCode.OK if outcome.cause is None else exit_code(outcome.cause))


def _seen(
    outcome: RunOutcome, document: Mapping[str, Any] | None, code: int, truth: float | None, covered: bool | None
) -> str:
    """Return how the run ended, in one line."""
    from tdhil.report import text_of, with_interval

    stop = outcome.stop
    stood = "nothing moved" if stop is None else (
        "standstill confirmed" if stop.confirmed else "standstill NOT confirmed, and reported")
    degraded = [stage.name for stage in outcome.stages if stage.outcome == "degraded"]
    marked = f"; degraded: {', '.join(degraded)}" if degraded else ""
    if document is None:
        cause = text_of(str(outcome.cause)) if outcome.cause is not None else "the stop was not confirmed"
        at = f"in stage {outcome.stages[-1].name}" if outcome.stages else "before the first stage"
        return f"ended {at} with exit {code}: {cause}; {stood}{marked}"
    inertia = document.get("inertia_kg_m2")
    result = "no J"
    if inertia is not None:
        result = "J " + with_interval(inertia["value"], inertia["low_total"], inertia["high_total"], "kg·m²")
        if covered is not None:
            where = 'inside' if covered else 'OUTSIDE'
            result += f", and the simulated shaft has {truth:g} kg·m²: {where} the interval"
    return f"the run went on to its end (exit {code}): {document['verdict']}, {result}; {stood}{marked}"
