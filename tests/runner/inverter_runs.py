"""Whole runs on the simulated inverter without a bus, in stepped time, identified as `tdhil identify` does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.clock import SteppedClock
from drivers.drive import Command, Mode, PowerState, Sample
from sim_bus.inverter import Inverter
from sim_bus.params import RigParams
from tdhil.runner.five_stages import Runner
from tdhil.runner.settings import ExcitationRequest, StopRequest
from tdhil.runner.task import Task
from tdhil.session.conclusion import conclude
from tests import rigs
from tests.runner.fake_drive import FakeDisplay
from tests.runner.line_drive import BuilderLog, OverInverter

TRUE_KG_M2 = 104.0
LIMITS = replace(rigs.LIMITS, time_s=3600.0)


class InverterDrive(OverInverter):
    """Simulated inverter as a drive without a bus, with one exchange per cycle.

    Each exchange applies the command, advances the plant by one cycle and reads the reports.
    """

    def __init__(self, params: RigParams, seed: int, rate_hz: float = 100.0) -> None:
        self.clock, self.period_s = SteppedClock(), 1.0 / rate_hz
        self.params, self.inverter = params, Inverter(params, np.random.default_rng(seed))
        self._steps = self.inverter.steps(self.period_s)
        self._state, self._mode = PowerState.OFF, Mode.SPEED

    def quick_stop(self) -> None:
        self._wish = PowerState.QUICK_STOP

    def exchange(self, command: Command) -> Sample:
        self.clock.wait_until(self.clock.now_s() + self.period_s)
        self.cycles += 1
        self._state, self._mode = self._wish, command.mode
        control = self.inverter.control
        if self._state is PowerState.QUICK_STOP:
            control.stop(self._limits.quick_stop_rad_s2)
        elif self._state is PowerState.OFF:
            control.off()
        elif command.mode is Mode.TORQUE:
            control.torque(command.torque_nm)
        else:
            control.speed(command.speed_rad_s)
        count, step_s = self._steps
        for _ in range(count):
            self.inverter.step(step_s)
        report = self.inverter.reporting
        still = self._state is PowerState.QUICK_STOP and abs(self.inverter.speed_rad_s) < 0.02
        return Sample(
            self.clock.now_s(), 0.0, 0.0, True, report.speed_rad_s, report.torque_nm, None, self._mode, self._state,
            still, control.limited, 0x27,
        )


@dataclass(frozen=True)
class Result:
    """One run. ``half``: relative half-width; NaN where there is no number."""

    seed: int
    value: float
    low: float
    high: float
    acquire_s: float
    extensions: int
    note: str
    looked: float = float("nan")     # decision of the last interim look

    @property
    def half(self) -> float:
        return 0.5 * (self.high - self.low) / self.value

    @property
    def covers(self) -> bool:
        return self.low <= TRUE_KG_M2 <= self.high


def run(seed: int, tolerance: float | None, fixed_s: float | None = None, params: RigParams | None = None) -> Result:
    """Run once and identify the recording."""
    log = BuilderLog()
    request = ExcitationRequest(tolerance=tolerance if fixed_s is None else None, max_time_s=fixed_s)
    task = Task(LIMITS, request, {"gear_ratio": 1.0, "torque_scale_rel_sd": 0.02})
    drive = InverterDrive(params or RigParams(), seed)
    outcome = Runner(drive, lambda _: task, log, StopRequest(), FakeDisplay(), lambda *_: None).run()
    if outcome.cause is not None:
        return Result(seed, *(float("nan"),) * 4, 0, repr(outcome.cause))
    log.configure(identify={"confidence": 0.95, "tolerance": tolerance or 0.05})
    document = conclude(log.recording(complete=True), log.run, "").document
    stage = next(one for one in outcome.stages if one.name == "acquire")
    decisions: list[dict[str, Any]] = log.run.get("stopping", {}).get("decisions", [])
    looked = decisions[-1]["look"]["half_width_now"] if decisions and decisions[-1]["look"] else float("nan")
    inertia, seconds = document["inertia_kg_m2"], stage.end_s - stage.start_s
    if inertia is None:
        return Result(seed, *(float("nan"),) * 3, seconds, 0, document["reason"])
    extensions = sum(one["periods"] > 0 for one in decisions)
    return Result(
        seed, inertia["value"], inertia["low"], inertia["high"], seconds, extensions, document["verdict"], looked
    )
