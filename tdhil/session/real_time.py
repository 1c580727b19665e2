"""`--real-time-priority`: real-time priority for the control loop, and locked memory.

It exists on Linux only. Only the thread that sends setpoints gets SCHED_FIFO. Threads and programs that it starts keep
ordinary priority, among them the log and the display. The thread sleeps for most of each cycle. If it computes for
``MOST_CPU_S`` without a pause, the kernel signals this and the thread returns to ordinary priority. So a mistake in
tdhil can't hang a computer of two cores.
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
"""SCHED_FIFO priority, 1 to 99. The kernel's interrupt threads (50), the adapter's among them, must run first."""
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
    """Result of the request: granted priority and memory lock, and the reasons for a refusal."""

    priority: int = 0                        # SCHED_FIFO; 0: an ordinary thread
    memory_locked: bool = False
    said: str = ""

    def plain(self) -> dict[str, Any]:
        """Return it as plain data for the run's configuration."""
        return asdict(self)


@contextmanager
def real_time_priority(wanted: bool, *, stepped: bool = False) -> Iterator[Raised]:
    """Apply the priority around the run, in the thread that drives it, and undo it afterwards. Raises nothing."""
    if not wanted:
        yield Raised()
        return
    if stepped:
        yield Raised(said="--real-time-priority has no effect in stepped time")
        return
    why_not = _raise_thread()
    locked = _lock_memory()
    said = f"real-time priority: SCHED_FIFO {PRIORITY}" if not why_not else f"no real-time priority: {why_not}"
    said += ", memory locked" if not locked else f"; memory not locked: {locked}"
    if why_not or locked:
        said += f". To allow it, {HOW} (then check with tdhil doctor)"
    try:
        yield Raised(0 if why_not else PRIORITY, not locked, said)
    finally:
        _lower_thread()
        if not locked:
            _libc().munlockall()


def allowed() -> tuple[str, str]:
    """Return why priority and locked memory are not available; empty if they are. Both are tried and undone."""
    why_not = _raise_thread()
    if not why_not:
        _lower_thread()
    return why_not, _memory_limit()


def _raise_thread() -> str:
    if not hasattr(os, "sched_setscheduler"):
        return "this system offers no such call to a program"
    try:
        # Without the flag every thread that is started from here on would get the priority too.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except OSError as error:
        return f"{error.strerror or error}"
    # The kernel sends SIGXCPU to a real-time thread that computes for this time without a pause.
    with suppress(OSError, ValueError, AttributeError, ImportError):   # no main thread, or no such limit
        import resource

        signal.signal(signal.SIGXCPU, lambda *_: _lower_thread())
        hard = resource.getrlimit(resource.RLIMIT_RTTIME)[1]
        resource.setrlimit(resource.RLIMIT_RTTIME, (round(MOST_CPU_S * 1e6), hard))
    return ""


def _lower_thread() -> None:
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with suppress(OSError, ValueError, AttributeError, ImportError):
        import resource

        unlimited = resource.getrlimit(resource.RLIMIT_RTTIME)[1]
        resource.setrlimit(resource.RLIMIT_RTTIME, (unlimited, unlimited))


def _lock_memory() -> str:
    """Lock the memory. Return why not; empty if it is locked."""
    if limit := _memory_limit():
        return limit
    try:
        libc = _libc()
        # On fault: pages that are never used, such as the far end of a thread's stack, take no memory.
        failed = libc.mlockall(_CURRENT | _FUTURE | _ON_FAULT)
    except (OSError, AttributeError) as error:
        return str(error)
    return os.strerror(ctypes.get_errno()) if failed else ""


def _memory_limit() -> str:
    """Return why memory can't be locked without limit. An allocation above the limit would fail during motion."""
    try:
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    except (ImportError, AttributeError, OSError):
        return "this system does not support it"
    if soft == resource.RLIM_INFINITY:
        return ""
    with suppress(OSError, ValueError, IndexError):
        status = Path("/proc/self/status").read_text(encoding="ascii")
        effective = int(status.split("CapEff:")[1].split()[0], 16)
        if effective >> _CAP_IPC_LOCK & 1:
            return ""
    return f"at most {soft / 1e6:.3g} MB may be locked"


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
