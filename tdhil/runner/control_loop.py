"""One cycle of a run: guard, drive, guard, log. Every stage uses it, without exception."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from drivers import (
    Command,
    Drive,
    DriveFault,
    KeptAlive,
    Mode,
    ModeNotConfirmed,
    PowerState,
    ReportsOthers,
    Sample,
    SensorFault,
)
from profiles import MessageCode
from tdhil.recording import RunLog
from tdhil.runner.background import Background, BackgroundProcess
from tdhil.runner.guard import Guard
from tdhil.runner.settings import StopRequest

T = TypeVar("T")

ALIVE_S = 0.2
"""Wall time between two keep-alive messages in stepped time, s; a simulated peer waits 1 s for a host."""

SWITCH_CYCLES = 10
"""Least cycles for a mode switch, for slow lines: request, switch, display, and some lost ones."""


NO_WORKER_PROCESS = "computations run in a thread beside the control loop, not in their own process"
"""Text of the log, before the reason. During a computation cycles may be late; there is no other effect."""

MOST_SIDE_TROUBLES = 10
"""Different errors of log, observer and display that a stop keeps. A text with a counter must not fill the memory."""


Watcher = Callable[[Command, Sample], None]


class ControlLoop:
    """Control loop of a drive under guard. ``watch``: live display of each cycle. ``stop_request``: read each cycle."""

    def __init__(
        self, drive: Drive, guard: Guard, log: RunLog, stop_request: StopRequest, watch: Watcher | None = None
    ) -> None:
        self.drive = drive
        self.guard = guard
        self.log = log
        self.period_s = drive.period_s
        self.stop_side_troubles: list[str] = []     # errors of log, observer and display in the stop, each once
        self.last: Sample | None = None
        self.before: Sample | None = None            # the sample before ``last``
        self.observer: Watcher | None = None         # called by a stage after every cycle, after the guard
        self.quiet = False                         # the operator is being asked: the display stays off the terminal
        self.worker_process: BackgroundProcess | None = None     # long computations in real time; None: a thread
        self.remarks: list[str] = []       # actions of others on the drive's bus
        self._reports_others = drive if isinstance(drive, ReportsOthers) else None
        self._stop_request = stop_request
        self._watch = watch

    @property
    def now_s(self) -> float:
        """Return the control time, s."""
        return self.drive.clock.now_s()

    def cycle(self, command: Command) -> Sample:
        """Do one exchange. Raises Interrupted for a stop request, and the errors of guard, drive and log."""
        self._stop_request.check()
        self.guard.check_command(command)
        sample = self._exchange(command)
        self.log.cycle(command, sample)
        self.before, self.last = self.last, sample
        if self._reports_others is not None:
            for line in self._reports_others.remarks():
                self._note(line)
        self.guard.check_sample(command, sample)
        if self.guard.pace_is_due():
            self.guard.check_pace(self.drive.counters)
        if self.observer is not None:
            self.observer(command, sample)
        if self._watch is not None and not self.quiet:
            self._watch(command, sample)
        return sample

    def stop_cycle(self, command: Command) -> Sample:
        """Do one exchange of the stop sequence: without guard, and no error of log, observer or display interrupts it,
        or keeps the cycle from another of them.
        """
        sample = self._exchange(command)
        for takes in (self.log.cycle, self.guard.observer.see, self._note_remarks, self._watch):
            try:
                if takes is not None:
                    takes(command, sample)
            except Exception as error:
                text, known = f"{type(error).__name__}: {error}", self.stop_side_troubles
                if text not in known and len(known) < MOST_SIDE_TROUBLES:
                    known.append(text)
        return sample

    def _note_remarks(self, command: Command, sample: Sample) -> None:
        if self._reports_others is not None:
            for line in self._reports_others.remarks():
                self._note(line)

    def _exchange(self, command: Command) -> Sample:
        """Exchange with the drive. A fault of its speed sensor also goes to the observer: the stop needs to know it."""
        try:
            return self.drive.exchange(command)
        except SensorFault as error:
            self.guard.observer.sensor_fault(error.what, self.now_s)
            raise

    def _note(self, line: str) -> None:
        self.remarks.append(line)
        self.log.event(self.now_s, "bus", line)

    def cycles(self, seconds: float) -> int:
        """Return the number of cycles in that time."""
        return max(1, round(seconds / self.period_s))

    def hold(self, command: Command, seconds: float) -> list[Sample]:
        """Keep one command for a time. Return the samples."""
        return [self.cycle(command) for _ in range(self.cycles(seconds))]

    def enable(self, mode: Mode, command: Command, timeout_s: float = 3.0) -> Sample:
        """Enable in a mode and wait until the drive reports it."""
        self.drive.enable(mode)
        for _ in range(self.cycles(timeout_s)):
            sample = self.cycle(command)
            if sample.state is PowerState.ENABLED and sample.mode is mode:
                self.guard.expected = PowerState.ENABLED
                return sample
            if sample.state in (PowerState.FAULT, PowerState.FAULT_REACTION):
                break
        raise DriveFault(
            f"{mode.value} mode was not enabled within {timeout_s:g} s; the drive reports '{sample.state.value}'",
            where=f"statusword {sample.status:04X}h",
            next_step="Check STO, the enable input and faults on the drive's own panel",
            entry=MessageCode.ENABLE_FAILED,
        )

    def switch_mode(self, command: Command, timeout_s: float = 0.5) -> Sample:
        """Switch to ``command.mode`` while enabled. The drive must display it in time, or within ten cycles."""
        for _ in range(max(SWITCH_CYCLES, self.cycles(timeout_s))):
            sample = self.cycle(command)
            if sample.mode is command.mode:
                return sample
        raise ModeNotConfirmed(
            f"the drive did not display {command.mode.value} mode within {timeout_s:g} s",
            where="modes of operation display 6061h",
            next_step="Check in the drive's manual whether the mode may change while enabled; use --mode speed",
        )

    def compute(self, work: Callable[[], T], command: Command) -> T:
        """Run a longer computation while the drive keeps receiving one command."""
        return self.compute_while(work, lambda: self.cycle(command))

    def compute_while(self, work: Callable[[], T], cycle: Callable[[], object]) -> T:
        """Run a longer computation while the drive keeps receiving setpoints: ``cycle`` sends one of them.

        In stepped time the drive needs no setpoints, and a number of cycles that depends on the computer's speed would
        not repeat. So only keep-alive messages are sent, which do not advance time. In real time a worker process runs
        the ``work`` if it is ready and accepts it (`background.BackgroundProcess.ask`). Otherwise a thread does, which
        shares the interpreter, and cycles are late. On a computer with one processor they may be late in any case.
        Lateness alone does not end the run meanwhile.

        An error of ``cycle`` is raised at once: a shaft may be turning without a setpoint, so nothing waits for the
        ``work``. A process is killed. A thread continues beside the stop, and its result is dropped.
        """
        background = Background(work, None if self.drive.clock.stepped else self.worker_process)
        self.guard.reckoning = True
        try:
            while not background.ended.is_set():
                if self.drive.clock.stepped:
                    self._stop_request.check()
                    if not background.ended.wait(ALIVE_S) and isinstance(self.drive, KeptAlive):
                        self.drive.keep_alive()
                else:
                    cycle()
        except BaseException:
            background.drop()
            raise
        finally:
            self.guard.reckoning = False
            if background.instead:
                self.no_worker_process(background.instead)
        return background.result()

    def no_worker_process(self, why: str) -> None:
        """Log that computations share this process with the control loop."""
        self.log.event(self.now_s, "host", f"{NO_WORKER_PROCESS}: {why}")
