"""Program of the worker process: it loads the modules for a plan, then answers one request after another."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import traceback
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread

from tdhil.numerics import prepare
from tdhil.runner.background import NICE, READY


def serve() -> None:
    """Answer one request after the other until the pipe ends. `WorkerProcess` runs this function."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prepare()
    _take_second_place()
    # Printed output must not come between the answers.
    answers = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)

    from tdhil.runner import adaptive_duration, interim, stage_planner  # noqa: F401
    from tdhil.runner.preconditions import quieten

    quieten()
    asked: SimpleQueue[bytes] = SimpleQueue()
    Thread(target=_listen, args=(asked,), daemon=True).start()
    pickle.dump(READY, answers)
    answers.flush()
    while True:
        pickle.dump(_answer(asked.get()), answers)
        answers.flush()


def _listen(asked: SimpleQueue[bytes]) -> None:
    """Wait in a thread for requests, and exit at the end of the pipe, also during work."""
    try:
        while True:
            asked.put(pickle.load(sys.stdin.buffer))
    finally:
        os._exit(0)


def _answer(question: bytes) -> tuple[str, bytes]:
    try:
        work = pickle.loads(question)
    except Exception as error:
        return "unfit", pickle.dumps(f"{type(error).__name__}: {error}")
    kind = "found"
    try:
        found = work()
    except BaseException as error:
        error.add_note("in the process beside the control loop:\n" + "".join(traceback.format_exception(error)))
        kind, found = "raised", error
    try:
        answer = pickle.dumps(found)
        pickle.loads(answer)
    except Exception as error:
        return "unfit", pickle.dumps(f"{type(found).__name__} can't be pickled: {error}")
    return kind, answer


def _take_second_place() -> None:
    """Leave inherited real-time scheduling, and take a lower priority than the control loop."""
    with suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with suppress(AttributeError, OSError):
        os.nice(NICE)
