"""The simulated inverter as a drive, without a bus: what the protocol needs of it, and a log in memory.

Stepped time, one exchange a cycle: the command acts, the plant moves on by a cycle, the reports are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drivers.clock import SteppedClock
from drivers.drive import Command, Counters, DriveLimits, Identity, Mode, PowerState, Preflight, Sample
from sim_bus.inverter import RPM, Inverter
from sim_bus.params import RigParams
from tdhil.recording.builder import RecordingBuilder
from tdhil.recording.recording import Excitation, Level, Ramp, Recording, Stage


class InverterDrive:
    """`drivers.drive.Drive` over `sim_bus.inverter.Inverter`."""

    def __init__(self, params: RigParams, seed: int, rate_hz: float = 100.0) -> None:
        self.clock, self.period_s = SteppedClock(), 1.0 / rate_hz
        self.inverter = Inverter(params, np.random.default_rng(seed))
        self._steps = self.inverter.steps(self.period_s)
        self._state = self._wish = PowerState.OFF
        self._mode, self._cycles, self._stop_rad_s2 = Mode.SPEED, 0, 2.0

    @property
    def counters(self) -> Counters:
        return Counters(self._cycles)

    def connect(self) -> Identity:
        return Identity(0, 0, 0, 0, "inverter", True)

    def preflight(self, limits: DriveLimits) -> Preflight:
        params, self._stop_rad_s2 = self.inverter.params, limits.quick_stop_rad_s2
        return Preflight(
            identity=self.connect(), checks=(), modes=frozenset(Mode), switch_while_enabled=True,
            quick_stop_in_torque_mode=True, rated_torque_nm=params.drive.rated_torque_nm,
            torque_resolution_nm=params.reporting.torque_quantum_permille * params.drive.rated_torque_nm / 1000.0,
            speed_resolution_rad_s=params.reporting.speed_quantum_rpm * RPM, watchdog_s=limits.watchdog_s,
            safe_action="quick_stop",
        )

    def reset_fault(self) -> None:
        """It never is in fault."""

    def enable(self, mode: Mode) -> None:
        self._wish, self._mode = PowerState.ENABLED, mode

    def quick_stop(self) -> None:
        self._wish = PowerState.QUICK_STOP

    def disable(self) -> None:
        self._wish = PowerState.OFF

    def close(self) -> tuple[str, ...]:
        return ()

    def exchange(self, command: Command) -> Sample:
        self.clock.wait_until(self.clock.now_s() + self.period_s)
        self._cycles += 1
        self._state, self._mode = self._wish, command.mode
        control = self.inverter.control
        if self._state is PowerState.QUICK_STOP:
            control.stop(self._stop_rad_s2)
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


class MemoryLog:
    """What the runner needs of a log: the recording and the run's configuration, and no file."""

    def __init__(self) -> None:
        self._builder = RecordingBuilder()
        self.run: dict[str, Any] = {}
        self.events: list[str] = []

    def cycle(self, command: Command, sample: Sample) -> None:
        self._builder.add(sample)

    def event(self, time_s: float, kind: str, text: str) -> None:
        self.events.append(text)

    def failure(self, time_s: float, error: BaseException) -> None:
        self.events.append(repr(error))

    def stage(self, stage: Stage) -> Stage:
        self._builder.stage(stage)
        return stage

    def motion(self, excitation: Excitation | None, levels: Sequence[Level] = (), ramps: Sequence[Ramp] = ()) -> None:
        self._builder.excitation(excitation, levels, ramps)

    def learn(self, **facts: Any) -> None:
        self._builder.learn(**facts)

    def configure(self, **run: Any) -> None:
        self.run |= run

    def recording(self, *, complete: bool) -> Recording:
        return self._builder.recording(complete=complete)


class NoDisplay:
    """Nobody watches."""

    def __getattr__(self, name: str) -> Any:
        return lambda *_: None


def default_facts() -> Mapping[str, Any]:
    """What the simulated bench tells a recording."""
    return {"gear_ratio": 1.0, "torque_scale_rel_sd": 0.02}
