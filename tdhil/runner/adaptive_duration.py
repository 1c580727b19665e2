"""Stage 5 with a tolerance: after the pilot and after every extension, is it enough, and if not, how much more?"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

from tdhil.estimation import normal_quantile
from tdhil.recording import Recording
from tdhil.runner.design import LOOKS, MARGIN, MOST_BEHIND, Look, Stopping, interval_of, look
from tdhil.runner.excitation import Plan

Snapshot = Callable[[], Recording]
LEAST_EXTENSION = 2       # periods at each mean speed: fewer are not worth the way back
_SECOND_SHARE = 0.5       # of what is there, behind an interval: the least that may make another say something else
_AT_LAST_SHARE = 1.0      # of what is there: the most that one mean speed alone gets; friction's slope needs both


@dataclass(frozen=True)
class Decision:
    """What a look led to: so many periods more at each mean speed (0: the end), and why.

    ``at_last``: only at the one where the shaft is, which spares the way back and the settling there.
    ``seen``: how many intervals have been looked at and found too wide; ``working_confidence``: of the interval that
    comes of whatever is there when the run ends after this decision. ``interval``: the one that was looked at.
    """

    periods: int
    why: str
    look: Look | None
    seen: int
    working_confidence: float
    interval: float | None = None
    at_last: bool = False

    def plain(self) -> dict[str, Any]:
        """As the run's configuration keeps it."""
        seen = None if self.look is None else {
            name: value if not isinstance(value, float) or math.isfinite(value) else None
            for name, value in asdict(self.look).items()
        }
        interval = self.interval if self.interval is not None and math.isfinite(self.interval) else None
        return asdict(self) | {"look": seen, "interval": interval}


@dataclass
class Enough:
    """Asks, and remembers. ``snapshot`` gives what is recorded so far; ``note`` is told every decision."""

    stopping: Stopping
    plan: Plan
    snapshot: Snapshot
    note: Callable[[Decision], None]
    decisions: list[Decision] = field(default_factory=list)

    def question(self, spent_s: float) -> Callable[[], Decision]:
        """The work of one look, to be done in any thread or process; the samples are taken now."""
        recording, rule = self.snapshot(), self.stopping
        left_s = rule.allowed_s - spent_s
        seen = self.decisions[-1].seen if self.decisions else 0
        return partial(decide, recording, rule, self.plan, left_s, len(self.decisions), seen)

    def decided(self, decision: Decision) -> None:
        """Keep and tell a decision."""
        self.decisions.append(decision)
        self.note(decision)


def decide(recording: Recording, rule: Stopping, plan: Plan, left_s: float, looks: int, seen: int) -> Decision:
    """Pure: the decision after ``looks`` extensions, with ``left_s`` seconds left, ``seen`` intervals looked at."""
    segments = len(plan.segments)
    periods = [one.reference.period_s for one in plan.segments]
    room = max(0, math.floor((left_s - plan.extension_s(0)) / sum(periods) + 1e-9)) if looks < LOOKS else 0
    room_at_last = max(0, math.floor(left_s / max(periods) + 1e-9)) if looks < LOOKS and segments > 1 else 0
    counted = _counted(recording)
    room_at_last = min(room_at_last, math.floor(_AT_LAST_SHARE * counted))
    most = (counted + segments * room) / counted if counted else 1.0
    most_at_last = (counted + room_at_last) / counted if counted else 1.0

    def looked(number: int) -> Look | None:
        return look(recording, rule.working(number), rule.tolerance / MARGIN, most, rule.pilot_dof, most_at_last)

    def more(found: Look, share: float | None = None) -> tuple[int, str]:
        """How many, and where. ``share`` of what is there: behind an interval, at least."""
        at, limit, where = (1, room_at_last, "here") if found.at_last else (segments, room, "at each mean speed")
        wanted = math.ceil((found.scale - 1.0) * found.periods / at - 1e-6)
        least = LEAST_EXTENSION if found.enough else 0
        if share is not None:
            least = math.ceil(share * found.periods / at - 1e-6)
            limit = min(limit, math.floor(MOST_BEHIND * found.periods / at + 1e-6))
        return min(limit, max(least, wanted)), f"more periods {where}"

    found = None if rule.by_interval else looked(seen)
    if found is None:
        return _by_interval_alone(recording, rule, counted / segments, room, seen)
    asked, now = f"±{100.0 * rule.tolerance:.3g} %", f"±{100.0 * found.half_width_now:.3g} %"
    if found.half_width_now > rule.tolerance / MARGIN:
        extension, where = more(found)
        if extension >= LEAST_EXTENSION:
            then = f"±{100.0 * found.half_width_then:.3g} %"
            why = f"the scatter says {now}: {extension} {where} for {then}"
            return Decision(extension, why, found, seen, rule.working(seen), at_last=found.at_last)
        why = f"the scatter says {now} instead of {asked}, and the time that is left would change little"
        return Decision(0, why, found, seen, rule.working(seen))
    width = interval_of(recording, rule.working(seen))
    interval = f"the interval is ±{100.0 * width:.3g} %" if math.isfinite(width) else "there is no interval"
    if width <= rule.tolerance:
        return Decision(0, f"{interval}: as tight as {asked}", found, seen, rule.working(seen), width)
    again = looked(seen + 1) if max(room, room_at_last) >= LEAST_EXTENSION else None
    extension, where = 0, ""
    if again is not None:
        stricter = normal_quantile(rule.working(seen + 1)) / normal_quantile(rule.working(seen))
        share = min(max((stricter * width / rule.tolerance) ** 2 - 1.0, _SECOND_SHARE), MOST_BEHIND)
        if again.scale == 1.0:
            again = replace(again, at_last=room_at_last >= min(share * again.periods, segments * room))
        extension, where = more(again, share)
    if again is None or extension < LEAST_EXTENSION:
        why = f"{interval} instead of {asked}, and no time or look is left"
        return Decision(0, why, found, seen, rule.working(seen), width)
    why = f"{interval} instead of {asked}, as other lags are not excluded: {extension} {where}"
    return Decision(extension, why, found, seen + 1, rule.working(seen + 1), width, again.at_last)


def _by_interval_alone(recording: Recording, rule: Stopping, periods: float, room: int, seen: int) -> Decision:
    """Where a rigid shaft with straight friction is not what the scatter is about; ``periods`` at each mean speed.

    Friction that bends, or a shaft that swings, may still have an interval. Each that is looked at costs its share.
    """
    working = rule.working(seen)
    width = interval_of(recording, working)
    if not math.isfinite(width):
        return Decision(0, "what was acquired can't be judged, and has no interval", None, seen, working)
    asked, now = f"±{100.0 * rule.tolerance:.3g} %", f"the interval is ±{100.0 * width:.3g} %"
    if width <= rule.tolerance:
        return Decision(0, f"{now}: as tight as {asked}", None, seen, working, width)
    stricter = normal_quantile(rule.working(seen + 1)) / normal_quantile(working)
    wanted = math.ceil(periods * ((MARGIN * stricter * width / rule.tolerance) ** 2 - 1.0))
    more = min(room, max(LEAST_EXTENSION, min(wanted, math.floor(MOST_BEHIND * periods))))
    if more < LEAST_EXTENSION:
        return Decision(0, f"{now} instead of {asked}, and no time or look is left", None, seen, working, width)
    why = f"{now} instead of {asked}: {more} more periods at each mean speed"
    return Decision(more, why, None, seen + 1, rule.working(seen + 1), width)


def _counted(recording: Recording) -> int:
    """Whole periods behind settling, of all segments."""
    excitation = recording.excitation
    return 0 if excitation is None else sum(
        max(0, round((one.end_s - one.start_s) / one.period_s) - one.settle_periods) for one in excitation.segments
    )
