"""A Python process that computes for this one: start, messages, end.

`tdhil.process_pool` and `tdhil.runner.background` use it. The process is a new program: it inherits neither sockets
nor signal handlers nor threads. It receives one request at a time over stdin and answers over stdout. A message is a
pickle behind its length. The process shares nothing else, so it can be killed at any time. The end of its stdin ends
it, also during work, for any end of the host. Its process group is its own, so that Ctrl-C in the terminal reaches only
the host.

Two kinds of process differ by nature and do not use it. The service's computations (`tdhil.service.worker`) and its
fleets take one request in JSON and end with the answer, which a page receives as it is. The process of a run is none
that computes for the service: it outlives the service, so no pipe may end it.
"""

from __future__ import annotations

import io
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from struct import Struct
from typing import Any, Final

from tdhil.numerics import ONE_THREAD, prepare

LENGTH: Final = Struct("<Q")
"""Head of a message: the length of its pickle, bytes."""
READY: Final = "ready"
"""First message of a process: it has loaded its modules."""
_READ_BYTES: Final = 2**16      # longest piece of an answer that is read at once: a pipe of Linux holds as much
_NOTE: Final = "In a process of its own:\n"


class NotSent(Exception):
    """The process could not read the request, or its result can't be pickled. The text states the reason."""


class WorkerProcess:
    """A worker process, from the host's side. ``program``: a Python program that calls `serve`.

    ``quiet``: what the process writes to stderr is dropped. ``yields``: on Windows the process has a lower priority;
    elsewhere its program takes one. Raises OSError if it can't be started. The owner calls `kill` and `close`.
    """

    def __init__(self, program: str, *, quiet: bool = False, yields: bool = False) -> None:
        if not sys.executable:
            raise FileNotFoundError("the path of the Python interpreter is unknown")
        # keeps Ctrl-C from the process. It stays in the same session: across sessions nice values have no effect
        own_group: dict[str, Any] = {"process_group": 0}
        if sys.platform == "win32":
            flags = subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW
            own_group = {"creationflags": flags | (subprocess.BELOW_NORMAL_PRIORITY_CLASS if yields else 0)}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", f"import sys; sys.path[:] = {sys.path!r}\n{program}"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL if quiet else None,
            env=os.environ | ONE_THREAD, **own_group,
        )
        assert self._process.stdin is not None
        assert isinstance(self._process.stdout, io.BufferedReader)
        self._stdin, self.stdout = self._process.stdin, self._process.stdout
        self._buffer = bytearray()
        self.pid = self._process.pid

    def send(self, work: Callable[[], Any]) -> None:
        """Send a request. ``work`` is pickled: a function of a module, or a `functools.partial` of one with plain data.

        Raises OSError if the process has ended, and the errors of pickle.
        """
        _send(self._stdin, pickle.dumps(work))

    def received(self) -> bytes | None:
        """Read once from the process; return the next message, or None if it is incomplete. Raises EOFError at the end.

        Two messages may come in one read. The second one is returned by the next call, or by `kept`.
        """
        more = self.stdout.read1(_READ_BYTES)
        if not more:
            raise EOFError("the process has ended")
        self._buffer += more
        return self.kept()

    def kept(self) -> bytes | None:
        """Return a message that is already read completely, or None."""
        if len(self._buffer) < LENGTH.size:
            return None
        end = LENGTH.size + LENGTH.unpack_from(self._buffer)[0]
        if len(self._buffer) < end:
            return None
        message = bytes(self._buffer[LENGTH.size:end])
        del self._buffer[:end]
        return message

    def receive(self) -> bytes:
        """Wait for the next message and return it. Raises EOFError if the process has ended before."""
        message = self.kept()
        while message is None:
            message = self.received()
        return message

    def wait(self, for_s: float | None) -> int | None:
        """Return the exit code, negative for a signal; None if the process has not ended within ``for_s``, s.

        Without ``for_s`` it waits for the end.
        """
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(for_s)
        return None

    def kill(self) -> None:
        """Kill the process in any state; returns at once."""
        with suppress(OSError):
            self._process.kill()

    def close(self) -> None:
        """Close the pipes. A part of a request may be unwritten."""
        for pipe in (self._stdin, self.stdout):
            with suppress(OSError):
                pipe.close()


def result_in(message: bytes) -> Any:
    """Return the result in an answer, or raise the error of the work. Raises NotSent."""
    try:
        kind, answer = pickle.loads(message)
        found = pickle.loads(answer)
    except Exception as error:
        raise NotSent(f"{type(error).__name__}: {error}") from error
    if kind == "not sent":
        raise NotSent(found)
    if kind == "raised":
        raise found
    return found


def _send(stream: Any, message: bytes) -> None:
    stream.write(LENGTH.pack(len(message)) + message)
    stream.flush()


# ---------------------------------------------------------------------------------------------------------------------
# Code of a worker process


def serve(
    load: Callable[[], None] = lambda: None, *, memory_bytes: int | None = None,
    caught: type[BaseException] = Exception,
) -> None:
    """Answer one request after another, until the host closes the pipe or ends.

    ``load`` loads modules before the process is ready. ``memory_bytes``: additional memory once the first work has
    loaded its modules; None: no limit. An error of ``caught`` goes to the host; another one ends the process.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prepare()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)                               # printed output must not come between the answers
    load()
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(sys.stdin.buffer, requests), daemon=True).start()
    with suppress(BrokenPipeError):
        _send(answers, pickle.dumps(READY))
        while True:
            request = requests.get()
            try:
                work = pickle.loads(request)
            except Exception as error:
                _send(answers, _not_sent(f"{type(error).__name__}: {error}"))
                continue
            if memory_bytes is not None:
                # Above the limit of the address space, Python raises MemoryError. A system may have no such limit.
                with suppress(ImportError, OSError, ValueError):
                    import resource

                    with open("/proc/self/statm", encoding="ascii") as file:  # noqa: PTH123
                        now = int(file.read().split()[0]) * resource.getpagesize()
                    _, hard = resource.getrlimit(resource.RLIMIT_AS)
                    wanted = now + memory_bytes
                    resource.setrlimit(resource.RLIMIT_AS, (wanted if hard < 0 else min(wanted, hard), hard))
                memory_bytes = None
            _send(answers, _answer(work, caught))


def _listen(stdin: io.BufferedReader, requests: queue.SimpleQueue[bytes]) -> None:
    """Put received requests into the queue. The end of the host ends this process, also during work."""
    while True:
        head = stdin.read(LENGTH.size)
        if len(head) < LENGTH.size:
            os._exit(0)
        requests.put(stdin.read(LENGTH.unpack(head)[0]))


def _answer(work: Callable[[], Any], caught: type[BaseException]) -> bytes:
    kind = "found"
    try:
        found = work()
    except caught as error:
        error.add_note(_NOTE + "".join(traceback.format_exception(error)))
        kind, found = "raised", error
    try:
        answer = pickle.dumps(found)
        pickle.loads(answer)
    except Exception as error:
        return _not_sent(f"{type(found).__name__} can't be pickled: {error}")
    return pickle.dumps((kind, answer))


def _not_sent(reason: str) -> bytes:
    return pickle.dumps(("not sent", pickle.dumps(reason)))
