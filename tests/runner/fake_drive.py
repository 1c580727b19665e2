"""Minimal drive: a first-order shaft, a state machine with a delay of one cycle, and scripted misbehaviour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.clock import SteppedClock
from drivers.drive import Check, Command, Counters, DriveLimits, Identity, Mode, Outcome, PowerState, Preflight, Sample
from drivers.errors import CommunicationLost
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.five_stages import Runner
from tdhil.runner.guard import Guard
from tdhil.runner.settings import ExcitationRequest, MachineLimits, StopRequest
from tdhil.runner.stop import QuickStopKind, StopSequence
from tdhil.runner.task import Task
from tests.rigs import LIMITS

PERIOD_S = 0.02
SPEED_RESOLUTION = 0.01
TORQUE_RESOLUTION = 1.0
NAN = float("nan")

Misbehaviour = Callable[["FakeDrive", Sample], Sample]


@dataclass
class FakeDrive:
    """Drive with J ω' = T − T_c sgn ω − B ω. In speed mode ω follows its setpoint at once, or after ``follow_s``.

    ``misbehave`` may replace every sample or raise; ``calls`` lists the requests to the drive, ``disabled_at`` the true
    speeds at which it was disabled.
    """

    inertia: float = 100.0
    viscous: float = 8.0
    coulomb: float = 60.0
    follow_s: float = 0.1
    quick_stop_in_torque_mode: bool = True
    brakes: bool = True                  # False: no quick stop ever decelerates
    direction: float = 1.0               # -1: encoder the wrong way round
    refused: tuple[Check, ...] = ()
    modes: frozenset[Mode] = frozenset(Mode)
    quick_stop_holds: bool | None = True
    simulated: bool = True
    shaft_locked: bool = False
    misbehave: Misbehaviour | None = None

    clock: SteppedClock = field(default_factory=SteppedClock)
    period_s: float = PERIOD_S
    speed: float = 0.0
    torque: float = 0.0
    mode: Mode = Mode.SPEED
    state: PowerState = PowerState.OFF
    wish: PowerState = PowerState.OFF
    calls: list[str] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    disabled_at: list[float] = field(default_factory=list)
    cycles: int = 0
    missed: int = 0
    closed: bool = False
    left: tuple[str, ...] = ()

    @property
    def counters(self) -> Counters:
        return Counters(self.cycles, self.missed)

    def connect(self) -> Identity:
        self.calls.append("connect")
        return Identity(1, 2, 3, 4, "fake", self.simulated)

    def preflight(self, limits: DriveLimits) -> Preflight:
        self.calls.append("preflight")
        return Preflight(
            identity=Identity(1, 2, 3, 4, "fake", self.simulated), checks=self.refused, modes=self.modes,
            switch_while_enabled=True, quick_stop_in_torque_mode=self.quick_stop_in_torque_mode,
            rated_torque_nm=1000.0, torque_resolution_nm=TORQUE_RESOLUTION, speed_resolution_rad_s=SPEED_RESOLUTION,
            watchdog_s=limits.watchdog_s, safe_action="quick_stop",
            quick_stop_holds=self.quick_stop_holds,
        )

    def reset_fault(self) -> None:
        self.calls.append("reset_fault")
        if self.state is PowerState.FAULT:
            self.state = self.wish = PowerState.OFF

    def enable(self, mode: Mode) -> None:
        self.calls.append(f"enable {mode.value}")
        self.wish = PowerState.ENABLED

    def quick_stop(self) -> None:
        self.calls.append("quick_stop")
        if self.state in (PowerState.ENABLED, PowerState.QUICK_STOP):
            self.wish = PowerState.QUICK_STOP

    def disable(self) -> None:
        self.calls.append("disable")
        self.wish = PowerState.OFF

    def close(self) -> tuple[str, ...]:
        self.calls.append("close")
        self.closed = True
        return self.left

    def exchange(self, command: Command) -> Sample:
        self.calls.append("exchange")
        self.commands.append(command)
        self.clock.wait_until(self.clock.now_s() + self.period_s)
        self.cycles += 1
        if self.state is not PowerState.FAULT and self.state is not self.wish:
            if self.wish is PowerState.OFF:
                self.disabled_at.append(self.speed)
            self.state = self.wish
        if command.mode in self.modes:
            self.mode = command.mode
        self._move(command)
        sample = self.report()
        return sample if self.misbehave is None else self.misbehave(self, sample)

    def report(self) -> Sample:
        return Sample(
            self.clock.now_s(), 0.0, 0.0, True, self.direction * self.speed, self.torque, None, self.mode, self.state,
            self.state is PowerState.QUICK_STOP and abs(self.speed) < 1e-9, False, 0x27,
        )

    def fault(self) -> None:
        """Put the drive into fault; it brakes without the host."""
        self.state = PowerState.FAULT

    def _move(self, command: Command) -> None:
        dt = self.period_s
        braking = self.state is PowerState.QUICK_STOP or (self.state is PowerState.FAULT and self.brakes)
        if braking and self.brakes and (self.mode is Mode.SPEED or self.quick_stop_in_torque_mode):
            self._to(max(0.0, self.speed - 2.0 * dt), strongest_nm=1e9)
        elif self.state is PowerState.ENABLED and self.mode is Mode.SPEED:
            self._to(self.speed + (command.speed_rad_s - self.speed) * min(1.0, dt / self.follow_s), strongest_nm=400.0)
        else:
            self.torque = command.torque_nm if self.state is PowerState.ENABLED else 0.0
            self._push(self.torque)

    def _to(self, speed: float, strongest_nm: float) -> None:
        most = (strongest_nm - self.coulomb - self.viscous * self.speed) / self.inertia * self.period_s
        speed = self.speed + max(-most, min(most, speed - self.speed))
        self.torque = self.inertia * (speed - self.speed) / self.period_s + self.viscous * speed
        self.torque += self.coulomb if speed > 0.0 else 0.0
        self.speed = 0.0 if abs(speed) < 1e-6 else speed

    def _push(self, torque: float) -> None:
        if self.shaft_locked:
            return
        dt = self.period_s
        if self.speed == 0.0 and abs(torque) <= self.coulomb:
            return
        sign = 1.0 if (self.speed or torque) > 0.0 else -1.0
        speed = self.speed + dt * (torque - sign * self.coulomb - self.viscous * self.speed) / self.inertia
        self.speed = 0.0 if speed * sign < 0.0 and abs(torque) <= self.coulomb else speed


@dataclass
class FakeLog:
    """Log in memory; ``on_cycle`` may raise."""

    on_cycle: Callable[[], None] | None = None
    on_stage: Callable[[str], None] | None = None
    events: list[tuple[str, str]] = field(default_factory=list)
    stages: list = field(default_factory=list)
    motions: list = field(default_factory=list)
    facts: dict = field(default_factory=dict)
    run: dict = field(default_factory=dict)
    failures: list[BaseException] = field(default_factory=list)
    cycles: int = 0

    def cycle(self, command: Command, sample: Sample) -> None:
        self.cycles += 1
        if self.on_cycle is not None:
            self.on_cycle()

    def event(self, time_s: float, kind: str, text: str) -> None:
        self.events.append((kind, text))

    def failure(self, time_s: float, error: BaseException) -> None:
        self.failures.append(error)

    def stage(self, stage):
        if self.on_stage is not None:
            self.on_stage(stage.name)
        self.stages.append(stage)
        return stage

    def motion(self, excitation, levels=(), ramps=()) -> None:
        self.motions.append((excitation, levels, ramps))

    def learn(self, **facts) -> None:
        self.facts |= facts

    def configure(self, **run) -> None:
        self.run |= run


@dataclass
class FakeDisplay:
    """Display that counts the cycles of the current stage. It calls ``on_cycle`` with both, which may raise."""

    on_cycle: Callable[[str, int], None] | None = None
    on_started: Callable[[str], None] | None = None
    on_ended: Callable[[str], None] | None = None
    stage: str = ""
    seen: int = 0
    plans: list = field(default_factory=list)
    stops: list[bool] = field(default_factory=list)
    preflights: list = field(default_factory=list)

    def preflight(self, preflight: Preflight) -> None:
        self.preflights.append(preflight)

    def stage_started(self, name: str, expected_s: float) -> None:
        self.stage, self.seen = name, 0
        if self.on_started is not None:
            self.on_started(name)

    def cycle(self, command: Command, sample: Sample) -> None:
        self.seen += 1
        if self.on_cycle is not None:
            self.on_cycle(self.stage, self.seen)

    def planned(self, plan) -> None:
        self.plans.append(plan)

    def stage_ended(self, stage) -> None:
        if self.on_ended is not None:
            self.on_ended(stage.name)

    def stopped(self, confirmed: bool) -> None:
        self.stops.append(confirmed)


class World:
    """One fake drive with everything that a bench or a runner needs."""

    def __init__(self, drive: FakeDrive | None = None, limits: MachineLimits = LIMITS, watch=None) -> None:
        self.drive = drive or FakeDrive()
        self.limits = limits
        self.log = FakeLog()
        self.display = FakeDisplay()
        self.stop_request = StopRequest()
        self.guard = Guard(limits, PERIOD_S, SPEED_RESOLUTION, TORQUE_RESOLUTION)
        self.bench = ControlLoop(self.drive, self.guard, self.log, self.stop_request, watch or self.display.cycle)

    def stop_sequence(self, *, ends_off=False, **options) -> StopSequence:
        quick_stop = QuickStopKind(self.drive.quick_stop_in_torque_mode, ends_off)
        return StopSequence(self.bench, self.limits, SPEED_RESOLUTION, quick_stop, **options)

    def turn(self, speed: float = 5.0, mode: Mode = Mode.SPEED) -> None:
        """Enable the drive and turn the shaft."""
        torque = self.drive.coulomb + self.drive.viscous * speed
        self.bench.enable(mode, Command(mode, 0.0, 0.0))
        self.drive.speed = speed
        self.bench.hold(Command(mode, speed, torque), 0.2)

    def runner(self, request: ExcitationRequest | None = None, confirm=lambda *_: None, *, calibrated=False,
               **options) -> Runner:
        task = Task(self.limits, request or ExcitationRequest(periods=2), {}, calibrated=calibrated)
        return Runner(self.drive, lambda _: task, self.log, self.stop_request, self.display, confirm, **options)


def lost(drive: FakeDrive, sample: Sample) -> Sample:
    """Misbehaviour: raise that the bus is lost."""
    raise CommunicationLost("the bus is gone")


def refused_check() -> Check:
    return Check("watchdog", "armed", "not armed", Outcome.REFUSED, "1016h", "arm it")
