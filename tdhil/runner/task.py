"""Types that a run shares with its callers: its task, its questions and messages, its outcome."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from drivers import Command, Identity, Preflight, PreflightRefused, Sample
from profiles import MessageCode
from tdhil.recording import Stage
from tdhil.runner.settings import ControlAssumptions, ExcitationRequest, MachineLimits

if TYPE_CHECKING:       # code that only reads logs does not need these modules
    from tdhil.runner.excitation import Plan, SpeedChangePlan
    from tdhil.runner.stop import StopReport
    from tdhil.soft_torque import EvaluationCase
    from tdhil.speed_loop import StepCase

STAGES = ("setup", "speed", "torque", "hold", "acquire")

Idle = Callable[[], None]
"""One idle cycle: it feeds the drive's watchdog while the operator decides."""

Say = Callable[[str], None]
"""Shows one line."""


class Display(Protocol):
    """The display of a run in progress."""

    def preflight(self, preflight: Preflight) -> None: ...

    def stage_started(self, name: str, expected_s: float) -> None: ...

    def cycle(self, command: Command, sample: Sample) -> None: ...

    def planned(self, plan: Plan | SpeedChangePlan) -> None: ...

    def stage_ended(self, stage: Stage) -> None: ...

    def stopped(self, confirmed: bool) -> None: ...


@dataclass(frozen=True)
class RunOutcome:
    """The outcome of a run: its stages, the cause of its end (None = completed), and the stop."""

    stages: tuple[Stage, ...]
    cause: BaseException | None
    stop: StopReport | None            # None: the drive was never enabled
    preflight: Preflight | None


@dataclass(frozen=True)
class Task:
    """The task for a drive. ``facts`` are those of the bench, by their names in Recording."""

    limits: MachineLimits
    request: ExcitationRequest
    facts: Mapping[str, Any] = field(default_factory=dict)
    assumptions: ControlAssumptions = field(default_factory=ControlAssumptions)
    case: EvaluationCase | StepCase | None = None
    """Virtual string or small steps of the set speed in stage 5, in place of an excitation."""
    calibrated: bool = False
    """A torque calibration is applied to the result."""

    @property
    def string_at_motor_nm_s_rad(self) -> float:
        """Return the impedance ζ for the reported |r|, at the motor: requested, or of rig.yaml's pipe; 0: unknown."""
        asked, pipe = self.request.string_nm_s_rad, self.facts.get("pipe")
        if asked is not None:
            return asked / float(self.facts.get("gear_ratio", 1.0)) ** 2
        return 0.0 if pipe is None else float(pipe.impedance_nm_s_rad)


MakeTask = Callable[[Identity], Task]
"""Returns the task for the identified peer; raises PreflightRefused if there is none for it."""

Confirm = Callable[[Task, Preflight, Idle], None]
"""Asks whether the shaft may be moved; raises PreflightRefused if not."""

ConfirmSpeed = Callable[[float, str, Idle], None]
"""Asks whether the motor shaft visibly turns at this speed, rad/s, and states why no signal shows it; raises
PreflightRefused if not. `Idle` is one cycle at that speed."""


def refuse_unconfirmed_speed(speed_rad_s: float, why: str, idle: Idle) -> None:
    """Refuse: a `ConfirmSpeed` without an operator."""
    raise PreflightRefused(
        f"no operator can confirm that the shaft turns at {speed_rad_s:.3g} rad/s ({why})",
        where="unit of speed",
        next_step="Name the drive's position object in the profile (position), or run it at a terminal",
        entry=MessageCode.SPEED_UNIT_NOT_SEEN,
    )
