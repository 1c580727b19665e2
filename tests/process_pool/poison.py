"""Tasks that disturb their process. The functions are in a module, so that the processes find them by name."""

import ctypes
import os
import signal
import time

KILLS, HANGS, EATS, OUTSIDE = b"poison: kills", b"poison: hangs", b"poison: eats", b"poison: outside"


def act(head):
    """Execute the effect of these bytes; do nothing if they are no poison."""
    if head.startswith(KILLS):
        ctypes.string_at(0)                            # SIGSEGV, as from a faulty library
    if head.startswith(HANGS):
        time.sleep(3600)
    if head.startswith(EATS):
        bytearray(4_000_000_000)
    if head.startswith(OUTSIDE):
        os.kill(os.getpid(), signal.SIGKILL)


def work(task):
    """Process a number, a word or a poison."""
    if isinstance(task, bytes):
        act(task)
    if task == "raise":
        raise ValueError("as asked")
    if task == "print":
        print("not an answer")
    if task == "much":
        return b"x" * 3_000_000
    if isinstance(task, float):
        time.sleep(task)
    return task
