"""Work over several processes: every task once, errors told, nobody left behind."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tdhil.errors import TdhilError
from tdhil.studies.coverage.workers import results

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("count", "processes"), [(0, 2), (1, 3), (7, 2), (5, 1)])
def test_every_task_is_done_once(count, processes):
    assert sorted(results(math.sqrt, [n * n for n in range(count)], processes)) == list(range(count))


def test_an_error_is_raised_here_and_says_where_it_came_from():
    with pytest.raises(ValueError, match="math domain error") as caught:
        list(results(math.sqrt, [4.0, -1.0], 1))
    assert "In a process of its own" in caught.value.__notes__[0]


def test_a_worker_that_dies_is_a_typed_error():
    with pytest.raises(TdhilError, match=r"died \(exit code 3\).*fewer of them"):
        list(results(os._exit, [3], 1))


def test_what_is_printed_is_no_result(capfd):
    assert list(results(print, ["noise"], 1)) == [None]
    assert capfd.readouterr().err == "noise\n"


def workers_of(host):
    return subprocess.run(["ps", "-o", "pid=", "--ppid", str(host)], capture_output=True, text=True).stdout.split()


def gone(worker):
    try:
        return Path(f"/proc/{worker}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def test_closed_in_the_middle_it_leaves_nobody():
    before = set(workers_of(os.getpid()))
    under_way = results(time.sleep, [0.0, 1000.0, 1000.0], 2)
    next(under_way)
    workers = set(workers_of(os.getpid())) - before
    assert len([worker for worker in workers if not gone(worker)]) >= 2
    under_way.close()
    assert all(gone(worker) for worker in workers)


HOST = """
import time
from tdhil.studies.coverage.workers import results
for done in results(time.sleep, [0.0] + [WAIT] * 3, 2):
    print(done, flush=True)
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_host_that_ends_takes_its_workers_along(how):
    """At the latest with the task that they have in hand."""
    wait = "1000" if how == signal.SIGINT else "0.3"
    host = subprocess.Popen([sys.executable, "-c", HOST.replace("WAIT", wait)], cwd=ROOT, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, start_new_session=True)
    assert host.stdout.readline() == b"None\n"
    workers = workers_of(host.pid)
    assert len(workers) == 2
    os.killpg(host.pid, how)
    said = host.communicate(timeout=30)[1]
    assert host.returncode == -how
    assert said.count(b"Traceback") == (how == signal.SIGINT)      # the host's own, and none of a worker
    end_s = time.monotonic() + 30
    while not all(gone(worker) for worker in workers) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert all(gone(worker) for worker in workers)
