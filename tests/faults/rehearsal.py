"""Run of the whole path in one process, in stepped time, with a fault; and the checks of true shaft, exit and log.

Times are plant times from the simulator's trace.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tdhil.errors import ExitCode
from tdhil.recording.log_reader import read_run
from tdhil.report.live import LiveDisplay
from tests.path.path_runs import QUICK_STOP_RAD_S2, SETTLING_S, Finished, Shaft, identify, tdhil

HELD = {"operation enabled", "quick stop active", "fault reaction active"}
TURNING_RAD_S = 0.02


IN_MOTION = "@speed+15s"       # at 4 rad/s
NOTICED_AT_ONCE_S = 0.1        # five cycles
FEEDBACK_S = 0.4               # a quarter of a second without feedback
WATCHDOG_S = 0.6               # time-out of the drive, and a cycle
CONTRADICT = ("contradict each other",)


@dataclass(frozen=True)
class Case:
    """``ends``: refused (no motion), held (torque until standstill), coasts (the drive is disabled in motion).

    ``backwards_rad_s``: reverse speed that a wrong sensor or power stage may cause before it is found.
    ``free_rad_s``: speed that is allowed while the drive is disabled.
    """

    row: int
    fault: str
    code: int
    words: tuple[str, ...]
    ends: str = "held"
    notice_s: float = NOTICED_AT_ONCE_S
    more: tuple[object, ...] = ()
    confirmed: bool = True
    backwards_rad_s: float = 0.3
    free_rad_s: float = 0.05

    @property
    def id(self):
        return f"{self.row}-{self.fault}"


@dataclass
class Rehearsed:
    """One completed run."""

    done: Finished
    shaft: Shaft
    log: Path

    @property
    def message(self):
        """Return the cause of the end of the run: one line with cause, place and next step."""
        return self.done.document["error"]["message"]

    @property
    def fault_s(self):
        """Return the time at which the first scripted fault began."""
        return self.shaft.events("fault: ")[0]

    def standstill_s(self, since_s):
        return self.shaft.at_rest_from() - since_s

    def assert_ended(self, code, *words):
        assert self.done.code == code, self.done.err
        for word in words:
            assert word in self.message, self.message
        assert "Traceback" not in self.done.err
        claimed = "The shaft was stopped" in self.message      # the report states only a confirmed stop
        assert not (claimed and code == ExitCode.STOP_NOT_CONFIRMED), self.message

    def assert_nothing_moved(self):
        assert abs(self.shaft.speed_rad_s).max(initial=0.0) < 0.001
        assert "nothing has moved" in self.done.err or "shaft is at standstill" in self.done.err

    def assert_stopped(self, since_s, notice_s, *, held=True, backwards_rad_s=0.3, free_rad_s=0.05):
        """Assert a stop within detection time, ramp and settling. Only the drive itself may disable a turning shaft.

        ``backwards_rad_s``: allowed reverse speed. With a good sensor and power stage, the largest is that of a sign
        probe in the wrong direction.
        """
        shaft = self.shaft
        after = shaft.time_s >= since_s
        fastest = np.abs(shaft.speed_rad_s[after]).max()
        ramp_s = fastest / QUICK_STOP_RAD_S2
        if held:
            assert self.standstill_s(since_s) <= notice_s + ramp_s + SETTLING_S
            free = np.array([state not in HELD for state in shaft.state])
            assert not np.any(np.abs(shaft.speed_rad_s[free]) > free_rad_s), "a turning shaft was disabled"
        assert shaft.time_s[-1] - shaft.at_rest_from() >= 1.0
        assert shaft.speed_rad_s.min() > -backwards_rad_s
        return round(self.standstill_s(since_s), 2)

    def assert_as(self, case):
        """Assert message and motion of a case; return the time to standstill if the shaft moved."""
        self.assert_ended(case.code, *case.words)
        if case.ends == "refused":
            self.assert_nothing_moved()
            return None
        return self.assert_stopped(
            self.fault_s, case.notice_s, held=case.ends == "held", backwards_rad_s=case.backwards_rad_s,
            free_rad_s=case.free_rad_s,
        )

    def assert_log_whole(self):
        """Assert a finalised log that needs no recovery, and whose stages are the reported ones."""
        run = read_run(self.log)
        assert run.complete
        assert tdhil("recover", self.log).code == 0
        stages = self.done.document.get("stages")
        assert [(stage.name, stage.outcome) for stage in run.stages] == [(s["name"], s["outcome"]) for s in stages]
        return "whole"


def run(folder, *arguments):
    trace = folder / "shaft.csv"
    # At 50 Hz a run takes a fifth of its usual computing time. The periods determine the length of stage 5.
    done = identify(folder, "--simulate", "--seed", 1, "--rate", 50, "--periods", 3, "--trace", trace, *arguments)
    return Rehearsed(done, Shaft.read(trace) if trace.exists() else None, folder / "run.mcap")


def at(monkeypatch, stage, after_s, act):
    """Call ``act(sample)`` once, at a time after the start of a stage, between two cycles of the control loop.

    The returned list receives the plant time of the call.
    """
    begun, acted = [], []
    started, cycle = LiveDisplay.stage_started, LiveDisplay.cycle

    def on_start(self, name, expected_s):
        if name == stage:
            begun.append(None)
        started(self, name, expected_s)

    def on_cycle(self, command, sample):
        cycle(self, command, sample)
        if begun and begun[0] is None:
            begun[0] = sample.time_s
        if begun and not acted and sample.time_s >= begun[0] + after_s:
            acted.append(sample.time_s)
            act(sample)

    monkeypatch.setattr(LiveDisplay, "stage_started", on_start)
    monkeypatch.setattr(LiveDisplay, "cycle", on_cycle)
    return acted
