"""Real-time priority of one thread: set if allowed, reported if not, and restored."""

import ctypes
import errno
import os
import signal
import threading
import time
from types import SimpleNamespace

import pytest

from tdhil.cli.doctor import priority_finding
from tdhil.session import real_time
from tdhil.session.real_time import HOW, real_time_priority

linux = pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="Linux alone has it")


def policy() -> int:
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK


@linux
def test_only_this_thread_is_raised_and_it_is_lowered_again():
    if real_time.allowed()[0]:
        pytest.skip(f"not allowed here: {real_time.allowed()[0]}")
    found = []
    elder = threading.Event()
    before = threading.Thread(target=lambda: (elder.wait(), found.append(policy())))
    before.start()
    with real_time_priority(True) as raised:
        assert policy() == os.SCHED_FIFO
        assert raised.priority == os.sched_getparam(0).sched_priority > 0
        assert raised.said.startswith("real-time priority: SCHED_FIFO")
        elder.set()
        before.join()
        began_inside = threading.Thread(target=lambda: found.append(policy()))
        began_inside.start()
        began_inside.join()
    assert found == [os.SCHED_OTHER, os.SCHED_OTHER]
    assert policy() == os.SCHED_OTHER


@linux
def test_a_loop_that_never_pauses_loses_its_priority(monkeypatch):
    if real_time.allowed()[0]:
        pytest.skip(f"not allowed here: {real_time.allowed()[0]}")
    monkeypatch.setattr(real_time, "MOST_CPU_S", 0.05)      # a whole second would stop all other programs on this core
    usual = signal.getsignal(signal.SIGXCPU)
    try:
        with real_time_priority(True):
            end_s = time.monotonic() + 30.0
            while policy() == os.SCHED_FIFO:
                assert time.monotonic() < end_s
        assert policy() == os.SCHED_OTHER
    finally:
        signal.signal(signal.SIGXCPU, usual)


@linux
def test_without_permission_the_run_continues_with_advice(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(real_time, "_memory_limit", lambda: "only 8.39 MB of it may be")
    with real_time_priority(True) as raised:
        assert (raised.priority, raised.memory_locked) == (0, False)
        assert "no real-time priority: Operation not permitted" in raised.said
        assert "memory not locked: only 8.39 MB" in raised.said
        assert HOW in raised.said
    finding = priority_finding(*real_time.allowed())
    assert finding.grade == "note"
    assert HOW in finding.do


@linux
def test_memory_that_cannot_be_locked_is_reported_with_its_reason(monkeypatch):
    def refuse(_flags: int) -> int:
        ctypes.set_errno(errno.ENOMEM)
        return -1

    monkeypatch.setattr(real_time, "_memory_limit", lambda: "")
    monkeypatch.setattr(real_time, "_libc", lambda: SimpleNamespace(mlockall=refuse, munlockall=lambda: 0))
    with real_time_priority(True) as raised:
        assert not raised.memory_locked
        assert "memory not locked: Cannot allocate memory" in raised.said


def test_without_a_request_or_in_stepped_time():
    with real_time_priority(False) as raised:
        assert raised.said == ""
    with real_time_priority(True, stepped=True) as raised:
        assert "stepped" in raised.said
        assert raised.priority == 0
    assert priority_finding("", "").grade == "ok"
