"""Program of a run's background process: it loads the modules for a plan, then answers one request after another."""

from __future__ import annotations

import os
from contextlib import suppress

from tdhil.runner.background import NICE
from tdhil.worker_process import serve


def main() -> None:
    """Answer one request after the other until the pipe ends. `BackgroundProcess` runs this function."""
    # Leave inherited real-time scheduling, and take a lower priority than the control loop.
    with suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with suppress(AttributeError, OSError):
        os.nice(NICE)
    serve(_load, caught=BaseException)


def _load() -> None:
    from tdhil.runner import adaptive_duration, interim, stage_planner  # noqa: F401
    from tdhil.runner.preconditions import load_before_motion

    load_before_motion()
