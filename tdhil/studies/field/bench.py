"""The interface of a bench for field studies: one run of the rig through drive, bus, runner and guard; a Recording
back.

A study knows neither bus nor drive nor simulator: the command line passes in a `FieldBench`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

from tdhil.recording import Recording
from tdhil.studies.field.settings import SimulatedRig
from tdhil.studies.study import Progress

RunProgress = Callable[[float], None]
"""Share of one run that is done, 0 to 1."""


@dataclass(frozen=True)
class FieldRun:
    """One run: a sine about a mean speed. None leaves the choice to the plan of the run.

    ``speed_gain_nm_s_rad`` and ``integral_gain_nm_rad`` are the paper's P and I: gains of the drive's own speed loop,
    which act in speed mode. ``torque_limit_nm`` is that of drive, plan and guard alike.
    """

    rig: SimulatedRig
    frequency_hz: float
    speed_gain_nm_s_rad: float
    integral_gain_nm_rad: float
    seed: int
    mode: Literal["speed", "torque"] = "speed"
    amplitude_rad_s: float | None = None
    offset_rad_s: float | None = None
    periods: int | None = None              # settling included
    rate_hz: float = 100.0
    torque_limit_nm: float = 400.0


class FieldBench(Protocol):
    """Runs all five stages. Raises what ended the run, if it wasn't its end (`tdhil.errors`)."""

    def run(self, wish: FieldRun, progress: RunProgress) -> Recording: ...


def part_of(progress: Progress, index: int, count: float, text: str) -> RunProgress:
    """One run's progress as a part of the study's: run ``index`` of ``count``."""
    return lambda share: progress(min(1.0, (index + share) / count), text)
