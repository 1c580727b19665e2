"""`--real-time-priority`: the control loop before everything else on this computer, and its memory never paged out.

Of Linux alone. Only the thread that sends setpoints is raised (SCHED_FIFO): threads and programs that it starts are
ordinary ones again, the log's and the display's among them. It sleeps for most of each cycle. Should it ever not, the
kernel says so after ``MOST_CPU_S`` without a pause, and it becomes an ordinary one itself: a computer of two cores
must not hang on account of a mistake of ours.
"""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

PRIORITY = 40
"""Of 99; below the kernel's own interrupt threads (50), among them the adapter's, which must run first."""
MOST_CPU_S = 1.0
LIMITS_FILE = "/etc/security/limits.d/99-tdhil.conf"
HOW = (
    f"as root write the lines '@dialout - rtprio {PRIORITY}' and '@dialout - memlock unlimited' (or another group of "
    f"yours) to {LIMITS_FILE}, then log out and in"
)
_CURRENT, _FUTURE, _ON_FAULT = 1, 2, 4       # sys/mman.h: mlockall
_CAP_IPC_LOCK = 14                           # linux/capability.h


@dataclass(frozen=True)
class Raised:
    """What came of the wish: which of both was had, and in words why not."""

    priority: int = 0                        # SCHED_FIFO; 0: an ordinary thread
    memory_locked: bool = False
    said: str = ""

    def plain(self) -> dict[str, Any]:
        """As the run's configuration keeps it."""
        return asdict(self)


@contextmanager
def real_time_priority(wanted: bool, *, stepped: bool = False) -> Iterator[Raised]:
    """Around the run, in the thread that drives it; everything is as before afterwards. Raises nothing."""
    if not wanted:
        yield Raised()
        return
    if stepped:
        yield Raised(said="stepped time waits for nobody: --real-time-priority changes nothing")
        return
    why_not = _raise_thread()
    locked = _lock_memory()
    said = f"real-time priority: SCHED_FIFO {PRIORITY}" if not why_not else f"no real-time priority: {why_not}"
    said += ", memory locked" if not locked else f"; memory not locked: {locked}"
    if why_not or locked:
        said += f". To allow it, {HOW} (tdhil doctor looks again)"
    try:
        yield Raised(0 if why_not else PRIORITY, not locked, said)
    finally:
        _lower_thread()
        if not locked:
            _libc().munlockall()


def allowed() -> tuple[str, str]:
    """Why priority, and why locked memory, can't be had here; empty where they can. Both are tried, and given back."""
    why_not = _raise_thread()
    if not why_not:
        _lower_thread()
    return why_not, _memory_limit()


def _raise_thread() -> str:
    if not hasattr(os, "sched_setscheduler"):
        return "this system has none that a program may ask for"
    try:
        # Without the flag every thread that is started from here on would be raised as well.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except OSError as error:
        return f"{error.strerror or error}"
    _lower_where_it_runs_away()
    return ""


def _lower_thread() -> None:
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with suppress(OSError, ValueError, AttributeError, ImportError):
        import resource

        unlimited = resource.getrlimit(resource.RLIMIT_RTTIME)[1]
        resource.setrlimit(resource.RLIMIT_RTTIME, (unlimited, unlimited))


def _lower_where_it_runs_away() -> None:
    """RLIMIT_RTTIME: SIGXCPU to a real-time thread that computes for so long without waiting once."""
    with suppress(OSError, ValueError, AttributeError, ImportError):   # no main thread, or no such limit
        import resource

        signal.signal(signal.SIGXCPU, lambda *_: _lower_thread())
        hard = resource.getrlimit(resource.RLIMIT_RTTIME)[1]
        resource.setrlimit(resource.RLIMIT_RTTIME, (round(MOST_CPU_S * 1e6), hard))


def _lock_memory() -> str:
    """Why not; empty where it is locked."""
    if limit := _memory_limit():
        return limit
    try:
        libc = _libc()
        # On fault: what is never touched, such as the far end of a thread's stack, takes no memory.
        failed = libc.mlockall(_CURRENT | _FUTURE | _ON_FAULT)
    except (OSError, AttributeError) as error:
        return str(error)
    return os.strerror(ctypes.get_errno()) if failed else ""


def _memory_limit() -> str:
    """Where only so much may be locked, the next allocation beyond it would fail: in motion, that is worse."""
    try:
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    except (ImportError, AttributeError, OSError):
        return "this system can't"
    if soft == resource.RLIM_INFINITY or _may_lock():
        return ""
    return f"only {soft / 1e6:.3g} MB of it may be"


def _may_lock() -> bool:
    with suppress(OSError, ValueError, IndexError):
        status = Path("/proc/self/status").read_text(encoding="ascii")
        effective = int(status.split("CapEff:")[1].split()[0], 16)
        return bool(effective >> _CAP_IPC_LOCK & 1)
    return False


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
