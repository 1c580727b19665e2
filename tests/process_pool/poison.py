"""What a task may do to the process that has it. A module's functions, so that the processes find them by name."""

import ctypes
import os
import signal
import time

KILLS, HANGS, EATS, OUTSIDE = b"poison: kills", b"poison: hangs", b"poison: eats", b"poison: outside"


def act(head):
    """What so many bytes ask for; nothing where they are no poison."""
    if head.startswith(KILLS):
        ctypes.string_at(0)                            # SIGSEGV, as a library at fault would
    if head.startswith(HANGS):
        time.sleep(3600)
    if head.startswith(EATS):
        bytearray(4_000_000_000)
    if head.startswith(OUTSIDE):
        os.kill(os.getpid(), signal.SIGKILL)


def work(task):
    """What a number, a word or a poison asks for."""
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
