"""Computation in the worker process: results, exceptions, failures, and no process left afterwards.

The waits are time-outs only. The functions are in modules that the worker process can also load.
"""

import functools
import math
import operator
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drivers.drive import Command, Mode
from tdhil.errors import Interrupted
from tdhil.runner import background, stage_planner
from tdhil.runner.background import BackgroundProcess, Gone, begin
from tdhil.runner.excitation import PlanRefused
from tdhil.runner.settings import ExcitationRequest

HANGS_S = 60.0
REST = Command(Mode.SPEED, 0.0, 0.0)
LIGHT = background._PROGRAM.replace(
    "from tdhil", "import tdhil.runner.preconditions as rate; rate.load_before_motion = lambda: None\nfrom tdhil"
)
"""Worker program without the usual preloading: these tests do not examine late cycles."""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="checks processes by POSIX signals")


def never():
    return False


def nothing():
    pass


def texts(here):
    return [text for kind, text in here.log.events if kind == "host"]


def gone(pid):
    """Return whether the process no longer exists, not even as a zombie."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def within(condition):
    until = time.monotonic() + HANGS_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.005)


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Allow more time: a busy computer removes a dead process later."""
    monkeypatch.setattr(background, "_REAPED_S", HANGS_S)


@pytest.fixture
def worker_process():
    found, why = begin(nothing, never, program=LIGHT)
    assert found is not None, why
    yield found
    found.close()
    assert gone(found.pid)


@pytest.fixture
def live(world, worker_process):
    """Bench in real time with a worker process."""
    here = world()
    here.drive.clock.stepped = False
    here.bench.worker_process = worker_process
    return here


@pytest.mark.heavy
def test_it_returns_the_result_of_the_function_or_raises_its_exception(live):
    compute = functools.partial(live.bench.compute, command=REST)
    assert compute(functools.partial(math.hypot, 3.0, 4.0)) == 5.0
    assert compute(os.getpid) == live.bench.worker_process.pid
    with pytest.raises(ZeroDivisionError):
        compute(functools.partial(operator.truediv, 1.0, 0.0))
    with pytest.raises(SystemExit) as ended:
        compute(functools.partial(sys.exit, 3))
    assert ended.value.code == 3
    with pytest.raises(PlanRefused, match="too long") as refused:
        compute(functools.partial(exec, "import tdhil.runner.excitation as e; raise e.PlanRefused('too long', 'or')"))
    assert refused.value.next_step == "or"
    assert compute(functools.partial(print, "between the answers")) is None
    assert compute(functools.partial(max, 1, 2)) == 2                         # after all of that
    assert texts(live) == []


@pytest.mark.heavy
@pytest.mark.parametrize(
    "wish", [
        ExcitationRequest(periods=2, mode="speed"),
        pytest.param(ExcitationRequest(tolerance=0.05, frequency_hz=0.5), marks=pytest.mark.heavy),
    ]
)
def test_the_plan_is_the_one_that_a_thread_makes(world, worker_process, monkeypatch, wish):
    """The plan and its log entries agree to the last bit."""
    asked = []

    def compute(bench, work, command):
        asked.append(work)
        raise Interrupted(signal.SIGINT)

    monkeypatch.setattr(stage_planner.ControlLoop, "compute", compute)
    world().runner(wish).run()
    (work,) = asked
    there, here = worker_process.ask(work), work()
    assert pickle.dumps(there.plain()) == pickle.dumps(here.plain())
    assert pickle.dumps(there.plan.segments) == pickle.dumps(here.plan.segments)


@pytest.mark.heavy
def test_its_linear_algebra_keeps_to_one_core_so_that_the_control_loop_has_the_others(monkeypatch, request):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    worker_process = request.getfixturevalue("worker_process")      # begins now
    assert worker_process.ask(functools.partial(os.getenv, "OPENBLAS_NUM_THREADS")) == "1"


@pytest.mark.heavy
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_if_the_process_dies_during_work_a_thread_takes_over_and_the_log_states_it(live, tmp_path, end):
    begun = tmp_path / "begun"
    program = f"""
import os, pathlib, time
pathlib.Path({str(begun)!r}).touch()
while os.getpid() != {os.getpid()}:
    time.sleep(0.01)
"""
    pid = live.bench.worker_process.pid
    live.drive.misbehave = lambda drive, sample: (begun.exists() and os.kill(pid, end), sample)[1]
    live.bench.compute(functools.partial(exec, program), REST)
    live.drive.misbehave = None
    (event,) = texts(live)
    assert "in a thread" in event
    assert "EOFError" in event
    assert live.bench.compute(functools.partial(max, 1, 2), REST) == 2        # it is not restarted; the run continues


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("work", "kind"), [(lambda: 3, "int"), (functools.partial(compile, "3", "", "eval"), "code")]
)
def test_work_that_cannot_be_pickled_is_done_by_a_thread(live, work, kind):
    assert type(live.bench.compute(work, REST)).__name__ == kind
    (event,) = texts(live)
    assert "in a thread" in event


def test_a_stop_is_not_held_up_and_the_process_is_killed(live):
    asked = []

    def stop(drive, sample):
        if drive.cycles == 5:
            live.stop_request.ask(signal.SIGINT)
            asked.append(drive.cycles)
        return sample

    live.drive.misbehave = stop
    with pytest.raises(Interrupted):
        live.bench.compute(functools.partial(time.sleep, HANGS_S), REST)
    assert live.drive.cycles == asked[0]                  # not a cycle later
    assert live.bench.worker_process._process.wait(HANGS_S) == -signal.SIGKILL
    assert texts(live) == []                                                  # and no thread continued the work


def test_ctrl_c_at_the_terminal_does_not_reach_it(worker_process):
    assert os.getpgid(worker_process.pid) != os.getpgid(0)
    assert os.getsid(worker_process.pid) == os.getsid(0)         # of one session: its nice counts beside this process
    os.kill(worker_process.pid, signal.SIGINT)
    assert worker_process.ask(functools.partial(max, 1, 2)) == 2


@pytest.mark.heavy
def test_it_has_a_lower_priority_than_the_loop_and_inherits_only_its_pipes(worker_process, tmp_path):
    assert worker_process.ask(functools.partial(os.nice, 0)) >= os.nice(0) + background.NICE
    assert worker_process.ask(functools.partial(os.sched_getscheduler, 0)) == os.SCHED_OTHER
    with (tmp_path / "ours").open("w") as ours:
        os.set_inheritable(ours.fileno(), True)
        found, why = begin(nothing, never, program=LIGHT)
    assert found is not None, why
    try:
        opened = {os.path.realpath(one) for one in Path(f"/proc/{found.pid}/fd").iterdir()}
    finally:
        found.close()
    assert {name for name in opened if "/pipe:" not in name} == {os.devnull}


@pytest.mark.heavy
@pytest.mark.skipif(not hasattr(os, "sched_setscheduler") or os.geteuid() != 0, reason="needs to be allowed SCHED_FIFO")
def test_a_real_time_priority_is_not_inherited():
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    try:
        found, why = begin(nothing, never, program=LIGHT)
    finally:
        os.sched_setscheduler(0, *before)
    assert found is not None, why
    try:
        assert found.ask(functools.partial(os.sched_getscheduler, 0)) == os.SCHED_OTHER
    finally:
        found.close()


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("work", ["idle", "at work"])
def test_it_ends_when_this_process_is_killed(tmp_path, work):
    said = tmp_path / "pid"
    program = f"""
import functools, pathlib, threading, time
from tdhil.runner.background import begin
found, why = begin(lambda: None, lambda: False, program={LIGHT!r})
spin = functools.partial(exec, "while True: pass")
if {work!r} == "at work":
    threading.Thread(target=found.ask, args=(spin,), daemon=True).start()
    time.sleep(0.2)
pathlib.Path({str(said)!r}).write_text(str(found.pid) + " ")
time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", program]) as parent:
        try:
            within(lambda: said.exists() and said.read_text().endswith(" "))
        finally:
            parent.kill()
    within(lambda: dead(int(said.read_text())))


def dead(pid):
    """Return whether the process is gone or a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.parametrize(
    ("program", "said"),
    [("import os; os._exit(1)", "died"), ("print('no pickle')", "died"), ("import time; time.sleep(600)", "not ready")],
)
def test_a_failed_start_is_reported_and_leaves_no_process(program, said):
    done = []
    found, why = begin(lambda: done.append(1), never, within_s=0.2 if said == "not ready" else HANGS_S, program=program)
    assert found is None
    assert said in why
    assert done == [1]


def test_a_computer_without_room_for_a_process_runs_without(monkeypatch):
    def full(*_, **__):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(subprocess, "Popen", full)
    assert begin(nothing, never) == (None, "it can't be started: [Errno 24] Too many open files")


def test_a_stop_request_ends_the_wait_for_it():
    assert begin(nothing, lambda: True, program="import time; time.sleep(600)") == (None, "a stop was requested")


@pytest.mark.heavy
@pytest.mark.parametrize("ready", [True, False])
def test_a_run_has_one_in_real_time_and_leaves_none_behind(world, monkeypatch, ready):
    """It starts before the drive is armed. It is killed before the stop begins, for each end of the run."""
    made, calls = [], []

    def start(meanwhile, stopped):
        calls.extend(here.drive.calls)
        meanwhile()
        found, why = begin(nothing, stopped, program=LIGHT) if ready else (None, "no room")
        made.append(found)
        return found, why

    from tdhil.runner import five_stages

    monkeypatch.setattr(five_stages, "begin", start)
    monkeypatch.setattr(five_stages, "load_before_motion", nothing)
    here = world()
    here.drive.clock.stepped = False
    # The clock of the fake drive is stepped here too. A stop interrupts the plan.
    here.drive.misbehave = lambda drive, sample: (
        drive.cycles == 200 and here.stop_request.ask(signal.SIGINT), sample)[1]
    result = here.runner(ExcitationRequest(periods=2)).run()
    assert isinstance(result.cause, Interrupted), result.cause
    assert "preflight" not in calls
    (found,) = made
    if found is not None:
        assert gone(found.pid)
        with pytest.raises(Gone):
            found.ask(nothing)
    assert any("no room" in text for text in texts(here)) is not ready


def test_stepped_time_has_none(world, monkeypatch):
    from tdhil.runner import five_stages

    monkeypatch.setattr(five_stages, "begin", lambda *_: pytest.fail("started"))
    here = world()
    here.drive.misbehave = lambda drive, sample: (
        drive.cycles == 200 and here.stop_request.ask(signal.SIGINT), sample)[1]
    here.runner(ExcitationRequest(periods=2)).run()


def test_a_worker_process_without_a_python_is_an_os_error(monkeypatch):
    monkeypatch.setattr(sys, "executable", "")
    with pytest.raises(OSError, match="is unknown"):
        BackgroundProcess()
