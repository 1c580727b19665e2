"""Drive on a slow line: the simulated inverter, reached by transactions whose duration varies.

A transaction begins about once a period. At some time within it, the drive takes the setpoint and latches
its reports: both signals at one instant, or (``apart``) each in a separate read. The host knows only the
middle of the transaction, with half its duration as uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.clock import SteppedClock
from drivers.drive import Command, Counters, DriveLimits, Identity, Mode, PowerState, Preflight, Sample
from sim_bus.inverter import RPM, Inverter, Regulation
from sim_bus.params import DriveParams, RigParams
from tdhil.recording.builder import RecordingBuilder, RecordingPart
from tdhil.recording.log_format import LiveInertia
from tdhil.recording.recording import Recording
from tdhil.runner.five_stages import Runner
from tdhil.runner.settings import ExcitationRequest, MachineLimits, StopRequest
from tdhil.runner.task import RunOutcome, Task
from tests.rigs import DRIVE_LIMITS, LIMITS
from tests.runner.fake_drive import FakeDisplay

COARSE = RigParams(drive=DriveParams(control_period_s=0.005))
"""Default rig in steps of 5 ms, with which a run takes less than half the time."""


@dataclass(frozen=True)
class Line:
    """Timing: ``period_s`` between transactions, ``share`` of it that one takes, ``jitter`` of both as a share.

    ``apart``: speed and torque are read one after the other.
    """

    period_s: float
    share: float = 0.8
    jitter: float = 0.1
    apart: bool = False


class OverInverter:
    """Common part of the Drive contract of the drives over `sim_bus.inverter`."""

    params: RigParams
    modes: frozenset[Mode] = frozenset(Mode)
    cycles: int = 0

    _wish = PowerState.OFF
    _limits = DRIVE_LIMITS

    @property
    def counters(self) -> Counters:
        return Counters(self.cycles)

    def connect(self) -> Identity:
        return Identity(1, 2, 3, 4, "inverter", True)

    def preflight(self, limits: DriveLimits) -> Preflight:
        self._limits = limits
        reporting, rated_nm = self.params.reporting, self.params.drive.rated_torque_nm
        return Preflight(
            identity=self.connect(), checks=(), modes=self.modes, switch_while_enabled=True,
            quick_stop_in_torque_mode=True, rated_torque_nm=rated_nm,
            torque_resolution_nm=1e-3 * reporting.torque_quantum_permille * rated_nm,
            speed_resolution_rad_s=reporting.speed_quantum_rpm * RPM, watchdog_s=limits.watchdog_s,
            safe_action="quick_stop",
            torque_offset_resolution_nm=1.0 if limits.torque_offset else 0.0,
        )

    def reset_fault(self) -> None:
        """Do nothing: it is never in fault."""

    def enable(self, mode: Mode) -> None:
        self._wish = PowerState.ENABLED

    def disable(self) -> None:
        self._wish = PowerState.OFF

    def close(self) -> tuple[str, ...]:
        return ()


@dataclass
class LineDrive(OverInverter):
    """Drive on a slow line."""

    line: Line
    params: RigParams = COARSE
    seed: int = 1
    modes: frozenset[Mode] = frozenset(Mode)
    ramp_rad_s2: float = float("inf")

    clock: SteppedClock = field(default_factory=SteppedClock)
    ready: bool = False
    cycles: int = 0
    top_rad_s: float = 0.0
    modes_commanded: set[Mode] = field(default_factory=set)
    disabled_at: list[float] = field(default_factory=list)
    offsets_nm: list[float] = field(default_factory=list)      # as commanded

    def __post_init__(self) -> None:
        self.inverter = Inverter(self.params, np.random.default_rng(self.seed))
        self._line_rng = np.random.default_rng([self.seed, 1])
        self._plant_s = 0.0
        self._slot_s = 0.0
        self._state = PowerState.OFF
        self._mode: Mode = Mode.SPEED

    @property
    def period_s(self) -> float:
        """Period, available once preflight has measured it, as on a real line."""
        assert self.ready, "the period was read before preflight measured it"
        return self.line.period_s

    def preflight(self, limits: DriveLimits) -> Preflight:
        self.ready = True
        return super().preflight(limits)

    def quick_stop(self) -> None:
        if self._state is PowerState.ENABLED:
            self._wish = PowerState.QUICK_STOP

    def exchange(self, command: Command) -> Sample:
        line, rng = self.line, self._line_rng
        self.cycles += 1
        self._slot_s += line.period_s
        late, longer, write, read, other = rng.uniform(0.0, 1.0, 5)
        free = line.period_s * (1.0 - line.share)
        begin = max(self._slot_s + line.jitter * free * late, self.clock.now_s())
        length = line.share * line.period_s * (1.0 - line.jitter * longer)
        # Half of the transaction is the request on the wire; the drive answers somewhere in the rest.
        write_s = begin + (0.4 + 0.1 * write) * length
        read_s = write_s + 0.15 * read * length if not line.apart else begin + (0.55 + 0.1 * read) * length
        other_s = read_s if not line.apart else begin + (0.85 + 0.1 * other) * length
        self._run_to(write_s)
        self._take(command)
        self._run_to(read_s)
        speed = self.inverter.reporting.speed_rad_s
        self._run_to(other_s)
        torque = self.inverter.reporting.torque_nm
        self._run_to(begin + length)
        self.clock.wait_until(begin + length)
        return Sample(
            begin + 0.5 * length, 0.0, 0.5 * length, True, speed, torque, None, self._mode, self._state,
            self._state is PowerState.QUICK_STOP and abs(self.inverter.speed_rad_s) < 0.05, False, 0x27,
        )

    def _take(self, command: Command) -> None:
        control = self.inverter.control
        self.modes_commanded.add(command.mode)
        self.offsets_nm.append(command.torque_offset_nm)
        if self._wish is PowerState.OFF and self._state is not PowerState.OFF:
            self.disabled_at.append(self.inverter.speed_rad_s)
        self._state = self._wish
        if command.mode in self.modes:
            self._mode = command.mode
        enabled = self._state is PowerState.ENABLED and self._mode is Mode.SPEED
        control.offset_nm = float(round(command.torque_offset_nm)) if enabled else 0.0
        if self._state is PowerState.OFF:
            control.off()
        elif self._state is PowerState.QUICK_STOP:
            control.stop(self._limits.quick_stop_rad_s2)
        elif self._mode is Mode.SPEED:
            control.speed(command.speed_rad_s, self.ramp_rad_s2, self.ramp_rad_s2)
        else:
            control.torque(command.torque_nm)

    def _run_to(self, time_s: float) -> None:
        if time_s <= self._plant_s + 1e-9:
            return
        count, step_s = self.inverter.steps(time_s - self._plant_s)
        for _ in range(count):
            self.inverter.step(step_s)
            if self.inverter.control.regulation is not Regulation.STOP:
                self.top_rad_s = max(self.top_rad_s, self.inverter.speed_rad_s)
        self._plant_s = time_s


class BuilderLog:
    """RunLog without a file."""

    def __init__(self) -> None:
        self.builder = RecordingBuilder()
        self.events: list[tuple[str, str]] = []
        self.run: dict[str, Any] = {}
        self.inertias: list[LiveInertia] = []

    def cycle(self, command: Command, sample: Sample) -> None:
        self.builder.add(sample)

    def event(self, time_s: float, kind: str, text: str) -> None:
        self.events.append((kind, text))

    def failure(self, time_s: float, error: BaseException) -> None:
        self.events.append(("failure", str(error)))

    def stage(self, stage: Any) -> Any:
        self.builder.stage(stage)
        return stage

    def motion(self, excitation: Any, levels: Any = (), ramps: Any = ()) -> None:
        self.builder.excitation(excitation, levels, ramps)

    def learn(self, **facts: Any) -> None:
        self.builder.learn(**facts)

    def configure(self, **run: Any) -> None:
        self.run |= run

    def inertia(self, found: LiveInertia) -> None:
        self.inertias.append(found)

    def part(self, after: RecordingPart | None = None) -> RecordingPart:
        return self.builder.part(after)

    def recording(self, *, complete: bool) -> Recording:
        return self.builder.recording(complete=complete)


@dataclass(frozen=True)
class LineRun:
    """A whole run: its outcome, its recording, and its messages."""

    outcome: RunOutcome
    recording: Recording
    log: BuilderLog
    drive: LineDrive
    display: FakeDisplay


def run_line(
    drive: LineDrive, request: ExcitationRequest | None = None, limits: MachineLimits = LIMITS
) -> LineRun:
    """Run all five stages over the line."""
    log, display = BuilderLog(), FakeDisplay()
    task = Task(limits, request or ExcitationRequest(), {"torque_scale_rel_sd": 0.02})
    outcome = Runner(drive, lambda _: task, log, StopRequest(), display, lambda *_: None).run()
    return LineRun(outcome, log.recording(complete=True), log, drive, display)
