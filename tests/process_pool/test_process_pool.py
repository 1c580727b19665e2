"""Process pool: every task gets one result or one loss, with any fault of its processes."""

import os
import pickle
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from tdhil import process_pool
from tdhil.errors import TdhilError
from tdhil.process_pool import Loss, Pool, TaskLimits
from tdhil.worker_process import LENGTH, READY
from tests.process_pool import poison

LIMITS = TaskLimits(60.0, 500_000_000)


def test_every_task_is_answered_once():
    tasks = [*range(40), "print", "much", "word"]
    with Pool(poison.work, 2, LIMITS) as pool:
        found = dict(pool.run(tasks))
        assert found == {task: b"x" * 3_000_000 if task == "much" else task for task in tasks}
        assert dict(pool.run([1])) == {1: 1}           # the processes are kept
        pids = pool.pids()
    assert len(pids) == 2
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_result_that_arrives_with_the_first_message_is_found_at_once():
    """Both arrive in one read. Without this rule the pool would wait for more data until the time-out of the task."""
    fcntl, termios = pytest.importorskip("fcntl"), pytest.importorskip("termios")
    worker = process_pool._Worker(LIMITS)
    worker.give(poison.work, process_pool._Job(7), 30.0)
    both = 2 * LENGTH.size + len(pickle.dumps(READY)) + len(pickle.dumps(("found", pickle.dumps(7))))
    while int.from_bytes(fcntl.ioctl(worker.process.stdout, termios.FIONREAD, bytes(4)), sys.byteorder) < both:
        time.sleep(0.01)
    assert worker.take() == 7
    worker.kill()


@pytest.mark.heavy
def test_a_task_that_ends_its_process_or_hangs_is_isolated_and_the_rest_continues(monkeypatch):
    """The time limit counts only while no other task is left, so a slow computer loses no other tasks."""
    bad = [poison.KILLS, poison.HANGS, poison.OUTSIDE]
    found, wanted = {}, 11 + len(bad)
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() if len(found) == wanted - 1 else 0.0)
    monkeypatch.setattr(process_pool, "time", clock)
    with Pool(poison.work, 2, TaskLimits(3.0, 500_000_000)) as pool:
        found.update(pool.run([1, *bad, *range(2, 12)]))
    assert {task for task, result in found.items() if not isinstance(result, Loss)} == set(range(1, 12))
    assert {task: found[task].kind for task in bad} == {
        poison.KILLS: "ProcessDied", poison.HANGS: "TimeLimit", poison.OUTSIDE: "ProcessDied"}
    assert "SIGSEGV" in found[poison.KILLS].text
    assert "2 tries" in found[poison.KILLS].text
    assert "5 tries" in found[poison.OUTSIDE].text


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is limited where /proc tells what is in use")
def test_memory_is_limited():
    with Pool(poison.work, 1, TaskLimits(60.0, 200_000_000)) as pool, pytest.raises(MemoryError):
        list(pool.run([poison.EATS]))


def test_an_exception_of_the_function_is_raised_here():
    with Pool(poison.work, 1, LIMITS) as pool, pytest.raises(ValueError, match="as asked") as caught:
        list(pool.run(["raise"]))
    assert "In a process of its own" in caught.value.__notes__[0]


def test_without_limits():
    with Pool(poison.work, 2, TaskLimits(None, None)) as pool:
        assert sorted(task for task, _ in pool.run(range(7))) == list(range(7))


@pytest.mark.heavy
def test_processes_killed_at_random():
    """With twelve kills in sixty tasks, some while idle, no task is lost and none has two results."""
    rng = random.Random(3)
    with Pool(poison.work, 2, LIMITS) as pool:
        found, kills = [], 0
        for task, result in pool.run(0.01 + k / 1e4 for k in range(60)):
            assert result == task
            found.append(task)
            if kills < 12 and rng.random() < 0.5 and (pids := pool.pids()):
                os.kill(rng.choice(pids), signal.SIGKILL)
                kills += 1
    assert kills == 12
    assert sorted(found) == [0.01 + k / 1e4 for k in range(60)]


def test_processes_that_never_start_end_the_pool(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with Pool(poison.work, 2, LIMITS) as pool, pytest.raises(TdhilError, match="end before they begin"):
        list(pool.run(range(50)))


HOST = """
from tests.process_pool import poison
from tdhil.process_pool import Pool, TaskLimits
with Pool(poison.work, 1, TaskLimits()) as pool:
    for _ in pool.run([1, poison.HANGS]):
        print(*pool.pids(), flush=True)
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_the_processes_end_with_their_host(how):
    """This includes a process within a task. Ctrl-C goes to the group of the host and does not reach it."""
    with subprocess.Popen([sys.executable, "-c", HOST], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          cwd=Path(__file__).parents[2], start_new_session=True) as host:
        pid = int(host.stdout.readline())
        os.killpg(host.pid, how)
        said = host.stderr.read()
    assert host.returncode == -how
    assert said.count(b"Traceback") == (how == signal.SIGINT)      # only that of the host, none of the process
    for _ in range(1200):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        if "zombie" in Path(f"/proc/{pid}/status").read_text():
            return
        time.sleep(0.05)
    pytest.fail("it lives on")
