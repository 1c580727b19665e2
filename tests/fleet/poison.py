"""Logs that disturb the process that reads them. The first bytes of a file select the effect.

The functions are in a module, so that processes of a pool or cluster find them by name.
"""

import os
import time
from dataclasses import replace
from pathlib import Path

from tdhil.fleet.rows import FleetRow, failure_row
from tdhil.fleet.task import Done, LogTask, content_hash, identify_log, local_copy
from tests.process_pool.poison import EATS, HANGS, KILLS, OUTSIDE, act

__all__ = ["EATS", "HANGS", "KILLS", "OUTSIDE", "act"]


def head_of(path):
    try:
        with Path(path).open("rb") as file:
            return file.read(32)
    except OSError:
        return b""


def identify(task: LogTask) -> Done:
    """Identify as `identify_log` does, except for poisoned logs."""
    try:
        act(head_of(task.log))
    except MemoryError as error:
        facts = {"sha256": content_hash(Path(task.log))}
        return Done(failure_row(task.log, "MemoryError", str(error), task.settings, **facts))
    return identify_log(task)


def quick(task: LogTask) -> Done:
    """Return a row without identification, and record each call in the file that TDHIL_CALLS names."""
    head = head_of(task.log)
    if head.startswith(b"poison") or not Path(task.log).is_file():
        return identify(task)
    with Path(os.environ["TDHIL_CALLS"]).open("a") as file:
        file.write(task.log + "\n")
    time.sleep(0.01)
    path = Path(task.log)
    return Done(FleetRow(log=task.log, verdict="valid", sha256=content_hash(path), size_bytes=path.stat().st_size))


def quick_at_first(task: LogTask) -> Done:
    """Act as `quick` for twenty calls; later calls wait until their process is ended."""
    if len(Path(os.environ["TDHIL_CALLS"]).read_text().split()) >= 20:
        time.sleep(3600)
    return quick(task)


def quick_anywhere(task: LogTask) -> Done:
    """Act as `quick` for a log behind an address."""
    with local_copy(task.log) as path:
        return replace(done := quick(replace(task, log=str(path))), row=replace(done.row, log=task.log))
