"""One cycle of a run: guard, drive, guard, log. Every stage goes through here, and nothing goes around it."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event
from typing import TypeVar

from drivers import Command, Drive, DriveFault, KeptAlive, Mode, ModeNotConfirmed, PowerState, Sample, Telling
from tdhil.recording import RunLog
from tdhil.runner.background import Background, WorkerProcess
from tdhil.runner.guard import Guard
from tdhil.runner.settings import StopRequest

T = TypeVar("T")

ALIVE_S = 0.2
"""Wall time between two signs of life in stepped time; a simulated peer gives a host a second."""

SWITCH_CYCLES = 10
"""A drive on a slow line gets so many cycles for a switch of its mode: asked, done, seen, and some that were lost."""


NO_WORKER_PROCESS = "arithmetic goes on in a thread beside the control loop, not in a process of its own"
"""Said in the log, with the reason. Cycles may be late meanwhile, and it is no more than that."""


Watcher = Callable[[Command, Sample], None]


class ControlLoop:
    """A drive under guard. ``watch`` sees every cycle (live display); ``stop_request`` is looked at in each."""

    def __init__(
        self, drive: Drive, guard: Guard, log: RunLog, stop_request: StopRequest, watch: Watcher | None = None
    ) -> None:
        self.drive = drive
        self.guard = guard
        self.log = log
        self.period_s = drive.period_s
        self.stop_side_troubles: list[str] = []
        self.last: Sample | None = None
        self.before: Sample | None = None            # the one before it
        self.observer: Watcher | None = None         # what a stage does after every cycle, behind the guard
        self.quiet = False                         # somebody is being asked: the display leaves the terminal alone
        self.worker_process: WorkerProcess | None = None     # does longer arithmetic in real time; None: a thread does
        self.remarks: list[str] = []       # what others did on the drive's bus
        self._telling = drive if isinstance(drive, Telling) else None
        self._stop_request = stop_request
        self._watch = watch

    @property
    def now_s(self) -> float:
        """Control time."""
        return self.drive.clock.now_s()

    def cycle(self, command: Command) -> Sample:
        """One exchange. Raises Interrupted when a stop was asked for, and whatever guard, drive and log raise."""
        self._stop_request.check()
        self.guard.check_command(command)
        sample = self.drive.exchange(command)
        self.log.cycle(command, sample)
        self.before, self.last = self.last, sample
        if self._telling is not None:
            self._note(self._telling)
        self.guard.check_sample(command, sample)
        if self.guard.pace_is_due():
            self.guard.check_pace(self.drive.counters)
        if self.observer is not None:
            self.observer(command, sample)
        if self._watch is not None and not self.quiet:
            self._watch(command, sample)
        return sample

    def stop_cycle(self, command: Command) -> Sample:
        """One exchange of the stop sequence: unguarded, and neither log nor display may keep it from going on."""
        sample = self.drive.exchange(command)
        try:
            self.guard.observer.see(command, sample)
            self.log.cycle(command, sample)
            if self._telling is not None:
                self._note(self._telling)
            if self._watch is not None:
                self._watch(command, sample)
        except Exception as error:
            self.stop_side_troubles.append(f"{type(error).__name__}: {error}")
            del self.stop_side_troubles[10:]
        return sample

    def _note(self, drive: Telling) -> None:
        for line in drive.remarks():
            self.remarks.append(line)
            self.log.event(self.now_s, "bus", line)

    def cycles(self, seconds: float) -> int:
        """How many cycles last that long."""
        return max(1, round(seconds / self.period_s))

    def hold(self, command: Command, seconds: float) -> list[Sample]:
        """Keep one command for a time; the samples."""
        return [self.cycle(command) for _ in range(self.cycles(seconds))]

    def enable(self, mode: Mode, command: Command, timeout_s: float = 3.0) -> Sample:
        """Enable in a mode and wait until the drive says so."""
        self.drive.enable(mode)
        for _ in range(self.cycles(timeout_s)):
            sample = self.cycle(command)
            if sample.state is PowerState.ENABLED and sample.mode is mode:
                self.guard.expected = PowerState.ENABLED
                return sample
            if sample.state is PowerState.FAULT:
                break
        raise DriveFault(
            f"no {mode.value} mode within {timeout_s:g} s of enabling; the drive shows '{sample.state.value}'",
            where=f"statusword {sample.status:04X}h",
            next_step="Look for STO, a missing enable input or a fault on the drive's own panel",
        )

    def switch_mode(self, command: Command, timeout_s: float = 0.5) -> Sample:
        """Go on with ``command.mode`` while enabled; the drive must display the new mode in time, and in ten cycles."""
        for _ in range(max(SWITCH_CYCLES, self.cycles(timeout_s))):
            sample = self.cycle(command)
            if sample.mode is command.mode:
                return sample
        raise ModeNotConfirmed(
            f"the drive did not take over {command.mode.value} mode within {timeout_s:g} s",
            where="modes of operation display 6061h",
            next_step="Check in the drive's manual whether the mode may change while enabled; use --mode speed",
        )

    def compute(self, work: Callable[[], T], command: Command) -> T:
        """Do a longer piece of arithmetic while the drive keeps getting one command."""
        return self.compute_while(work, lambda: self.cycle(command))

    def compute_while(self, work: Callable[[], T], cycle: Callable[[], object]) -> T:
        """Do a longer piece of arithmetic without letting the drive starve of setpoints: ``cycle`` is one of them.

        In stepped time nothing starves, and a number of cycles that depended on the machine's speed would not repeat:
        there, signs of life that move no time on are all that goes out. In real time a process of its own does it
        where one stands ready and understands the ``work`` (`background.WorkerProcess.ask`): a thread shares the
        interpreter, and cycles come late beside it. They may all the same on a computer of one processor, and that
        alone doesn't end the run.

        Whatever ``cycle`` raises goes out at once: nobody waits for work that is not wanted any more, since a shaft
        may be turning without a setpoint meanwhile. A process is killed; a thread goes on by itself, beside the stop,
        and what comes of it is dropped.
        """
        background = Background(work, None if self.drive.clock.stepped else self.worker_process)
        told = False
        self.guard.reckoning = True
        try:
            while not background.ended.is_set():
                if background.instead and not told:
                    self.no_worker_process(background.instead)
                    told = True
                if self.drive.clock.stepped:
                    self._wait_alive(background.ended)
                else:
                    cycle()
        except BaseException:
            background.drop()
            raise
        finally:
            self.guard.reckoning = False
        if background.instead and not told:
            self.no_worker_process(background.instead)
        return background.result()

    def no_worker_process(self, why: str) -> None:
        """Note that arithmetic has to share this process with the control loop."""
        self.log.event(self.now_s, "host", f"{NO_WORKER_PROCESS}: {why}")

    def _wait_alive(self, ended: Event) -> None:
        """Wait for a moment, or until it is done; then the sign of life, of a drive that knows one."""
        self._stop_request.check()
        if not ended.wait(ALIVE_S) and isinstance(self.drive, KeptAlive):
            self.drive.keep_alive()
