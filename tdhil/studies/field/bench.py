"""Interface of a bench for field studies: it runs the rig through drive, bus, runner and guard, and returns a
Recording.

A study uses neither bus nor drive nor simulator directly: the command line passes a `FieldBench`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

from tdhil.recording import Recording
from tdhil.studies.field.settings import SimulatedRig
from tdhil.studies.study import Progress

RunProgress = Callable[[float], None]
"""Function that receives the completed share of one run, 0 to 1."""


@dataclass(frozen=True)
class FieldRun:
    """One run: a sine about a mean speed. None: the plan of the run selects the value.

    ``speed_gain_nm_s_rad`` and ``integral_gain_nm_rad`` are the paper's P and I: gains of the drive's own speed loop,
    which act in speed mode. ``torque_limit_nm`` is the limit of drive, plan and guard.
    """

    rig: SimulatedRig
    frequency_hz: float
    speed_gain_nm_s_rad: float
    integral_gain_nm_rad: float
    seed: int
    mode: Literal["speed", "torque"] = "speed"
    amplitude_rad_s: float | None = None
    offset_rad_s: float | None = None
    periods: int | None = None              # including settling
    rate_hz: float = 100.0
    torque_limit_nm: float = 400.0


class FieldBench(Protocol):
    """Bench that runs all five stages. Raises the error that ended the run early (`tdhil.errors`)."""

    def run(self, wish: FieldRun, progress: RunProgress) -> Recording: ...


def part_of(progress: Progress, index: int, count: float, text: str) -> RunProgress:
    """Return the progress of one run as a part of the study's: run ``index`` of ``count``."""
    return lambda share: progress(min(1.0, (index + share) / count), text)
