"""Stage 5 with a tolerance: decision after the pilot and each extension whether to acquire more, and how much."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

from tdhil.estimation import normal_quantile
from tdhil.recording import Recording
from tdhil.runner.design import LOOKS, MARGIN, MOST_BEHIND, Look, Stopping, look
from tdhil.runner.excitation import Plan
from tdhil.runner.interim import Identify, counted_periods, identify_plainly, live_inertia

Snapshot = Callable[[], Recording]
LEAST_EXTENSION = 2       # periods at each mean speed; fewer do not justify the transition back
_SECOND_SHARE = 0.5       # least extension after an interval, share of the acquired periods: the next must differ
_AT_LAST_SHARE = 1.0      # longest extension at one mean speed alone, share of the acquired periods; B needs both


@dataclass(frozen=True)
class Decision:
    """Result of an interim analysis: number of further periods at each mean speed (0: the end), and the reason.

    ``at_last``: only at the present mean speed, which saves the transition back and its settling.
    ``seen``: number of intervals found too wide so far; ``working_confidence``: of the interval that follows if the run
    ends after this decision. ``interval``: half-width of the checked interval, as a share of J.
    """

    periods: int
    why: str
    look: Look | None
    seen: int
    working_confidence: float
    interval: float | None = None
    at_last: bool = False

    def plain(self) -> dict[str, Any]:
        """Return it as plain data for the run's configuration."""
        seen = None if self.look is None else {
            name: value if not isinstance(value, float) or math.isfinite(value) else None
            for name, value in asdict(self.look).items()
        }
        interval = self.interval if self.interval is not None and math.isfinite(self.interval) else None
        return asdict(self) | {"look": seen, "interval": interval}


@dataclass
class Enough:
    """Decisions of one run. ``snapshot`` returns the recording so far; ``note`` receives every decision."""

    stopping: Stopping
    plan: Plan
    snapshot: Snapshot
    note: Callable[[Decision], None]
    decisions: list[Decision] = field(default_factory=list)
    identify: Identify = identify_plainly

    def working(self) -> float:
        """Return the confidence of the interval with which the run would end now."""
        return self.decisions[-1].working_confidence if self.decisions else self.stopping.working(0)

    def question(self, spent_s: float) -> Callable[[], Decision]:
        """Return a function for one interim analysis in any thread or process. The samples are taken now."""
        recording, rule = self.snapshot(), self.stopping
        left_s = rule.allowed_s - spent_s
        seen = self.decisions[-1].seen if self.decisions else 0
        return partial(decide, recording, rule, self.plan, left_s, len(self.decisions), seen, self.identify)

    def decided(self, decision: Decision) -> None:
        """Keep a decision and pass it on."""
        self.decisions.append(decision)
        self.note(decision)


def decide(
    recording: Recording, rule: Stopping, plan: Plan, left_s: float, looks: int, seen: int,
    identify: Identify = identify_plainly,
) -> Decision:
    """Return the decision after ``looks`` extensions, ``seen`` checked intervals, and ``left_s`` seconds left. Pure."""
    segments = len(plan.segments)
    periods = [one.reference.period_s for one in plan.segments]
    room = max(0, math.floor((left_s - plan.extension_s(0)) / sum(periods) + 1e-9)) if looks < LOOKS else 0
    room_at_last = max(0, math.floor(left_s / max(periods) + 1e-9)) if looks < LOOKS and segments > 1 else 0
    counted = counted_periods(recording.excitation)
    room_at_last = min(room_at_last, math.floor(_AT_LAST_SHARE * counted))
    most = (counted + segments * room) / counted if counted else 1.0
    most_at_last = (counted + room_at_last) / counted if counted else 1.0

    def looked(number: int) -> Look | None:
        return look(recording, rule.working(number), rule.tolerance / MARGIN, most, rule.pilot_dof, most_at_last)

    def more(found: Look, share: float | None = None) -> tuple[int, str]:
        """Return the number of further periods, and a text. ``share``: least extension after an interval."""
        at, limit, where = (1, room_at_last, "here") if found.at_last else (segments, room, "at each mean speed")
        wanted = math.ceil((found.scale - 1.0) * found.periods / at - 1e-6)
        least = LEAST_EXTENSION if found.enough else 0
        if share is not None:
            least = math.ceil(share * found.periods / at - 1e-6)
            limit = min(limit, math.floor(MOST_BEHIND * found.periods / at + 1e-6))
        return min(limit, max(least, wanted)), f"more periods {where}"

    found = None if rule.by_interval else looked(seen)
    if found is None:
        return _by_interval_alone(recording, rule, counted / segments, room, seen, identify)
    asked, now = f"±{100.0 * rule.tolerance:.3g} %", f"±{100.0 * found.half_width_now:.3g} %"
    if found.half_width_now > rule.tolerance / MARGIN:
        extension, where = more(found)
        if extension >= LEAST_EXTENSION:
            then = f"±{100.0 * found.half_width_then:.3g} %"
            why = f"the scatter gives {now}: {extension} {where} for {then}"
            return Decision(extension, why, found, seen, rule.working(seen), at_last=found.at_last)
        why = f"the scatter gives {now} instead of {asked}, and the remaining time would change little"
        return Decision(0, why, found, seen, rule.working(seen))
    width = interval_of(recording, rule.working(seen), identify)
    interval = f"the interval is ±{100.0 * width:.3g} %" if math.isfinite(width) else "there is no interval"
    if width <= rule.tolerance:
        return Decision(0, f"{interval}: within the requested {asked}", found, seen, rule.working(seen), width)
    again = looked(seen + 1) if max(room, room_at_last) >= LEAST_EXTENSION else None
    extension, where = 0, ""
    if again is not None:
        stricter = normal_quantile(rule.working(seen + 1)) / normal_quantile(rule.working(seen))
        share = min(max((stricter * width / rule.tolerance) ** 2 - 1.0, _SECOND_SHARE), MOST_BEHIND)
        if again.scale == 1.0:
            again = replace(again, at_last=room_at_last >= min(share * again.periods, segments * room))
        extension, where = more(again, share)
    if again is None or extension < LEAST_EXTENSION:
        why = f"{interval} instead of {asked}, and no time or interim analysis is left"
        return Decision(0, why, found, seen, rule.working(seen), width)
    why = f"{interval} instead of {asked}, as other lags are not excluded: {extension} {where}"
    return Decision(extension, why, found, seen + 1, rule.working(seen + 1), width, again.at_last)


def _by_interval_alone(
    recording: Recording, rule: Stopping, periods: float, room: int, seen: int, identify: Identify
) -> Decision:
    """Decide by the interval alone, if a rigid shaft with linear friction does not explain the scatter.

    With nonlinear friction or an oscillating shaft there may still be an interval. Each check costs a share of the
    confidence. ``periods``: at each mean speed.
    """
    working = rule.working(seen)
    width = interval_of(recording, working, identify)
    if not math.isfinite(width):
        return Decision(0, "the acquired data give no interval and no prediction", None, seen, working)
    asked, now = f"±{100.0 * rule.tolerance:.3g} %", f"the interval is ±{100.0 * width:.3g} %"
    if width <= rule.tolerance:
        return Decision(0, f"{now}: within the requested {asked}", None, seen, working, width)
    stricter = normal_quantile(rule.working(seen + 1)) / normal_quantile(working)
    wanted = math.ceil(periods * ((MARGIN * stricter * width / rule.tolerance) ** 2 - 1.0))
    more = min(room, max(LEAST_EXTENSION, min(wanted, math.floor(MOST_BEHIND * periods))))
    if more < LEAST_EXTENSION:
        why = f"{now} instead of {asked}, and no time or interim analysis is left"
        return Decision(0, why, None, seen, working, width)
    why = f"{now} instead of {asked}: {more} more periods at each mean speed"
    return Decision(more, why, None, seen + 1, rule.working(seen + 1), width)


def interval_of(recording: Recording, confidence: float, identify: Identify) -> float:
    """Return the relative half-width of the interval with which the run would end; infinite if there is none."""
    return live_inertia(identify(recording, confidence), recording, confidence).relative_half_width
