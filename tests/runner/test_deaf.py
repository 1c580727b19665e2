"""Computation beside the control loop does not delay the stop: the stop begins at once.

The tests use real time and a fake drive. The computation lasts until the shaft is at standstill and the drive is
closed. A stop that waits for it would wait until the time-out.
"""

import signal
import subprocess
import sys
import threading

import pytest

from drivers.drive import Command, Counters, Mode
from drivers.errors import CommunicationLost, LimitHit
from tdhil.errors import Interrupted
from tdhil.runner import adaptive_duration, background, stage_planner
from tdhil.runner.background import Background, thread_computes
from tdhil.runner.settings import ExcitationRequest
from tests.path.path_runs import wait_for
from tests.runner.run_outcomes import assert_at_rest

IN_VAIN_S = 120.0
CYCLES = 5                       # of the wait, before the trouble


class Endless:
    """Computation that ends once the run is over (`released`). `waited_for`: the run waited for its end."""

    def __init__(self, drive):
        self.begun, self.released, self.waited_for = threading.Event(), threading.Event(), False
        self._drive = drive

    def __call__(self, *_):
        self._drive.clock.stepped = False          # from here on; in stepped time a computation takes no cycles
        self.begun.set()
        self.waited_for = not self.released.wait(IN_VAIN_S)
        raise ArithmeticError("the result is no longer needed")


@pytest.mark.parametrize(("trouble", "kind"), [("Ctrl-C", Interrupted), ("guard", LimitHit)])
@pytest.mark.parametrize("wait", ["the plan", pytest.param("--tolerance", marks=pytest.mark.heavy)])
def test_the_stop_does_not_wait_for_arithmetic(world, monkeypatch, wait, trouble, kind):
    here = world()
    endless, seen = Endless(here.drive), []

    def misbehave(drive, sample):
        if endless.begun.is_set():
            seen.append(drive.cycles)
        if len(seen) == CYCLES and trouble == "guard":
            return sample._replace(speed_rad_s=20.0)
        if len(seen) == CYCLES:
            here.stop_request.ask(signal.SIGINT)
        return sample

    here.drive.misbehave = misbehave
    here.log.recording = lambda **_: None
    module, name = (adaptive_duration, "decide") if wait == "--tolerance" else (stage_planner, "plan_acquisition")
    monkeypatch.setattr(module, name, endless)
    request = ExcitationRequest(tolerance=0.05) if wait == "--tolerance" else ExcitationRequest(periods=2)
    result = here.runner(request).run()
    endless.released.set()
    assert isinstance(result.cause, kind), result.cause
    assert not endless.waited_for
    assert_at_rest(here, result)
    calls = here.drive.calls
    assert calls[: calls.index("quick_stop")].count("exchange") == seen[CYCLES - 1]    # not a cycle later


def test_a_process_ends_although_arithmetic_that_was_left_alone_goes_on():
    """Python and numpy are at full load, and the output is complete. With the usual exit, OpenBLAS
    sometimes waited for ever.
    """
    program = """
import threading
import numpy as np
from tdhil.cli.main import leave
from tdhil.runner.background import Background
begun = threading.Event()
def work():
    square = np.eye(200)
    begun.set()
    while True:
        square = square @ square
Background(work); Background(work)
begun.wait()
print("left alone")
leave(3)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout, done.stderr) == (3, "left alone\n", "")


@pytest.fixture
def usual_s():
    """Return the usual switch interval of the interpreter, s, once no computation of earlier tests is running."""
    wait_for("the arithmetic of the tests before", lambda: not thread_computes(), hangs_s=IN_VAIN_S)
    return sys.getswitchinterval()


def test_the_interpreter_switches_sooner_until_the_last_piece_of_arithmetic_is_over(usual_s):
    """An abandoned computation may end before or after the next one."""
    until = [threading.Event() for _ in range(2)]
    first, second = (Background(one.wait) for one in until)
    wait_for("both", lambda: len(background._in_threads) == 2, hangs_s=IN_VAIN_S)
    for one, event in zip((first, second), until, strict=True):
        assert sys.getswitchinterval() == pytest.approx(background.SWITCH_S)
        event.set()
        one.ended.wait(IN_VAIN_S)
    assert sys.getswitchinterval() == usual_s


def test_an_exception_of_the_computation_is_raised_and_the_interpreter_continues(world, usual_s):
    here = world()
    with pytest.raises(SystemExit):
        here.bench.compute(lambda: sys.exit(3), Command(Mode.SPEED, 0.0, 0.0))
    assert sys.getswitchinterval() == usual_s


def test_cycles_that_are_late_beside_arithmetic_do_not_end_the_run(world, monkeypatch):
    """Every cycle is late, for longer than the guard's window. Afterwards the guard checks the rate again."""
    here = world()
    here.drive.clock.stepped = False
    overruns = []
    monkeypatch.setattr(
        type(here.drive), "counters", property(lambda drive: Counters(drive.cycles, overruns=len(overruns)))
    )
    here.drive.misbehave = lambda drive, sample: overruns.append(1) or sample
    rest = Command(Mode.SPEED, 0.0, 0.0)
    here.bench.compute(lambda: [None for _ in iter(lambda: here.drive.cycles > 500, True)], rest)
    with pytest.raises(CommunicationLost, match="was late in"):
        here.bench.hold(rest, 10.0)
