"""A run of the whole path in one process, stepped, with a fault in it; and what its true shaft, exit and log must show.

Times are the plant's own, from the simulator's trace.
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
WATCHDOG_S = 0.6               # the drive's own, and a cycle
CONTRADICT = ("contradict each other",)


@dataclass(frozen=True)
class Case:
    """``ends``: refused (nothing moves), held (the drive holds the shaft until it rests), coasts (the drive let go).

    ``backwards_rad_s``: so fast a wrong sensor or power stage may turn the shaft backwards before that is noticed.
    ``free_rad_s``: so fast the shaft may turn while the drive is off.
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
    """One run, over."""

    done: Finished
    shaft: Shaft
    log: Path

    @property
    def message(self):
        """What ended the run: one line with what, where and what next."""
        return self.done.document["error"]["message"]

    @property
    def fault_s(self):
        """When the first scripted fault began."""
        return self.shaft.events("fault: ")[0]

    def standstill_s(self, since_s):
        return self.shaft.at_rest_from() - since_s

    def assert_ended(self, code, *words):
        assert self.done.code == code, self.done.err
        for word in words:
            assert word in self.message, self.message
        assert "Traceback" not in self.done.err
        claimed = "The shaft was stopped" in self.message      # only a confirmed stop may be claimed
        assert not (claimed and code == ExitCode.STOP_NOT_CONFIRMED), self.message

    def assert_nothing_moved(self):
        assert abs(self.shaft.speed_rad_s).max(initial=0.0) < 0.001
        assert "nothing has moved" in self.done.err or "shaft is at standstill" in self.done.err

    def assert_stopped(self, since_s, notice_s, *, held=True, backwards_rad_s=0.3, free_rad_s=0.05):
        """Within the time to notice it, the ramp and the settling; never let go while it turned, but by the drive.

        ``backwards_rad_s``: how fast it may turn backwards; a sign probe the wrong way round is the worst of it where
        the drive's own sensor and power stage are good.
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
        """Ended with the words of a case, and the shaft did as it says; return the time to standstill, if it moved."""
        self.assert_ended(case.code, *case.words)
        if case.ends == "refused":
            self.assert_nothing_moved()
            return None
        return self.assert_stopped(
            self.fault_s, case.notice_s, held=case.ends == "held", backwards_rad_s=case.backwards_rad_s,
            free_rad_s=case.free_rad_s,
        )

    def assert_log_whole(self):
        """Finalised: recovery has nothing to do, and the stages in it are those that were reported."""
        run = read_run(self.log)
        assert run.complete
        assert tdhil("recover", self.log).code == 0
        stages = self.done.document.get("stages")
        assert [(stage.name, stage.outcome) for stage in run.stages] == [(s["name"], s["outcome"]) for s in stages]
        return "whole"


def run(folder, *arguments):
    trace = folder / "shaft.csv"
    # At 50 Hz a run costs a fifth of what it costs at the drive's usual rate; periods decide how long stage 5 is.
    done = identify(folder, "--simulate", "--seed", 1, "--rate", 50, "--periods", 3, "--trace", trace, *arguments)
    return Rehearsed(done, Shaft.read(trace) if trace.exists() else None, folder / "run.mcap")


def at(monkeypatch, stage, after_s, act):
    """Have ``act(sample)`` called once, so long after a stage has begun, between two cycles of the control loop.

    The plant time of that goes into the list that is returned.
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
