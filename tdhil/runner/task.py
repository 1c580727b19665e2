"""What a run is given, what it asks and tells those around it, and how it went: the types that others share with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from drivers import Command, Identity, Preflight, PreflightRefused, Sample
from tdhil.recording import Stage
from tdhil.runner.settings import ControlAssumptions, ExcitationRequest, MachineLimits

if TYPE_CHECKING:       # whoever only reads of a run in its log has no use for what they load
    from tdhil.runner.excitation import Plan, SwingPlan
    from tdhil.runner.stop import StopReport
    from tdhil.soft_torque import EvaluationCase

STAGES = ("setup", "speed", "torque", "hold", "acquire")

Idle = Callable[[], None]
"""One cycle of nothing, which keeps the drive's watchdog fed while somebody makes up his mind."""

Say = Callable[[str], None]
"""Tells whoever watches one line."""


class Display(Protocol):
    """Whoever shows a run as it goes."""

    def preflight(self, preflight: Preflight) -> None: ...

    def stage_started(self, name: str, expected_s: float) -> None: ...

    def cycle(self, command: Command, sample: Sample) -> None: ...

    def planned(self, plan: Plan | SwingPlan) -> None: ...

    def stage_ended(self, stage: Stage) -> None: ...

    def stopped(self, confirmed: bool) -> None: ...


@dataclass(frozen=True)
class RunOutcome:
    """How a run went: its stages, what ended it (None = it went to its end), and how the stop went."""

    stages: tuple[Stage, ...]
    cause: BaseException | None
    stop: StopReport | None            # None: the drive was never enabled
    preflight: Preflight | None


@dataclass(frozen=True)
class Task:
    """What to do with a drive. ``facts`` are those of the bench, by their names in Recording."""

    limits: MachineLimits
    request: ExcitationRequest
    facts: Mapping[str, Any] = field(default_factory=dict)
    assumptions: ControlAssumptions = field(default_factory=ControlAssumptions)
    evaluation: EvaluationCase | None = None       # a virtual string in stage 5, in place of an excitation


MakeTask = Callable[[Identity], Task]
"""The task for whoever turned out to be at the other end; raises PreflightRefused if he can't have one."""

Confirm = Callable[[Task, Preflight, Idle], None]
"""Asks whether the shaft may be moved; raises PreflightRefused if not."""

ConfirmSpeed = Callable[[float, str, Idle], None]
"""Asks whether the motor's shaft is seen to turn at this speed, rad/s, and says why nothing else tells; raises
PreflightRefused if not. `Idle` is one cycle at that speed."""


def nobody_sees(speed_rad_s: float, why: str, idle: Idle) -> None:
    """A `ConfirmSpeed` with nobody there."""
    raise PreflightRefused(
        f"nobody is there to see whether the shaft turns at {speed_rad_s:.3g} rad/s ({why})",
        where="unit of speed",
        next_step="Say in the profile where the drive tells its angle (position), or run it at a terminal",
    )
