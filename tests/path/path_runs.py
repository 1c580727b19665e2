"""Runs of the whole path: the command line in this process or in its own, with a simulated drive.

The assertions do not use wall time. The waits only prevent an endless wait.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import select
import signal
import subprocess
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tdhil.cli.main import main
from tests.rigs import NUMBERS

STAGES = ("setup", "speed", "torque", "hold", "acquire")
QUICK = ("--rate", 50)    # a fifth of the usual rate of the drive, to save computing time
SHORT = ("--simulate", *QUICK, "--seed", 1, "--periods", 3)
TOO_MUCH = ("--excitation", "sine", "--frequency", 0.2, "--amplitude", 3)
"""Motion that a lighter shaft could follow. A run finds in stage 2 that this shaft cannot, and ends with 7."""
POLL_S = 0.02             # polling interval, which must leave the processor to the other process
HANGS_S = 600.0           # wall time after which a process is considered hung, even on a busy computer
HELD = {"operation enabled", "quick stop active"}   # the states in which the drive holds its shaft

# Defaults of the simulated rig (tdhil.config.rig, sim_bus.params).
WATCHDOG_S, QUICK_STOP_RAD_S2, TORQUE_NM = (NUMBERS[key] for key in ("watchdog_s", "quick_stop_rad_s2", "torque_nm"))
INERTIA, SPEED_GAIN = 104.0, 300.0
SETTLING_S = 5.0 * INERTIA / SPEED_GAIN
"""Time by which the drive's speed loop lags the end of its ramp: five times J/K_p."""
LETS_GO_S = 0.02 + 0.01 + 0.002
"""Time that the torque of a stop acts after zero speed: speed filter, torque lag and a control period of the drive."""
SWINGS_IN_RAD_S = TORQUE_NM / INERTIA * LETS_GO_S
"""Largest reverse speed of the shaft by a stop, with the braking torque at its limit.

The true speed depends on speed and torque at the beginning of the stop, and therefore on the time of the signal.
"""


@dataclass
class Finished:
    """End of a run."""

    code: int
    out: str
    err: str
    log: Path | None = None

    @property
    def document(self) -> dict[str, Any]:
        """Return stdout, which must be one JSON document only."""
        found = json.loads(self.out)
        assert isinstance(found, dict)
        return found

    @property
    def outcomes(self) -> list[tuple[str, str]]:
        return [(stage["name"], stage["outcome"]) for stage in self.document["stages"]]


def clean_environment() -> dict[str, str]:
    """Return an environment without the user's CAN settings and terminal sizes."""
    dropped = ("CAN_", "COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR")
    return {name: value for name, value in os.environ.items() if not name.startswith(dropped)}


def tdhil(*arguments: object) -> Finished:
    """Run `tdhil …` in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
    return Finished(code, out.getvalue(), err.getvalue())


def identify(folder: Path, *arguments: object, log: str = "run.mcap") -> Finished:
    """Run `tdhil identify --json …` in this process, with its log in ``folder``."""
    path = folder / log
    finished = tdhil("identify", "--json", "--log", path, *arguments)
    finished.log = path
    return finished


# -- the shaft trace -----------------------------------------------------------------------------------------


@dataclass
class Shaft:
    """True shaft: N rows of plant time, speed and torque, with states and events."""

    time_s: np.ndarray
    speed_rad_s: np.ndarray
    torque_nm: np.ndarray
    state: list[str]
    event: list[str]

    @classmethod
    def read(cls, path: Path) -> Shaft:
        return ShaftTrace(path).read()

    def events(self, text: str) -> list[float]:
        """Return the plant times of the events that contain a text."""
        return [float(t) for t, event in zip(self.time_s, self.event, strict=True) if text in event]

    def at_rest_from(self) -> float:
        """Return the plant time from which the shaft is at standstill until the end of the trace."""
        turning = np.flatnonzero(np.abs(self.speed_rad_s) > 0.02)
        return float(self.time_s[turning[-1]]) if len(turning) else 0.0

    def speed_at(self, time_s: float) -> float:
        return float(np.interp(time_s, self.time_s, self.speed_rad_s))

    def assert_never_let_go(self) -> None:
        """Assert that no row has a turning shaft with a disabled drive."""
        free = [state not in HELD for state in self.state]
        assert not np.any(np.abs(self.speed_rad_s[np.array(free)]) > 0.05), "a turning shaft was disabled"

    def assert_enabled(self, expected: bool) -> None:
        assert ("operation enabled" in self.state) is expected

    def assert_at_rest(self) -> None:
        """Assert standstill for at least a second at the end, and that the drive was never disabled in motion."""
        assert self.at_rest_from() <= self.time_s[-1] - 1.0
        self.assert_never_let_go()

    def assert_stopped_by_watchdog(self, cycle_s: float) -> float:
        """Assert that the drive detects the silent host and brakes on its ramp in time; return the start of silence."""
        (silent_s,), (lost_s,) = self.events("running on in own time"), self.events("host heartbeat lost")
        assert lost_s - silent_s <= WATCHDOG_S + cycle_s
        assert self.at_rest_from() - lost_s <= self.speed_at(lost_s) / QUICK_STOP_RAD_S2 + SETTLING_S
        assert self.state[-1] == "quick stop active"        # enabled until the next host
        self.assert_at_rest()
        return silent_s

    def assert_stopped_within_settings(self) -> float:
        """Assert a quick stop by the host on the ramp of the settings; return its start."""
        begun_s = self.events("state: quick stop active")[-1]
        allowed_s = abs(self.speed_at(begun_s)) / QUICK_STOP_RAD_S2 + SETTLING_S
        assert self.at_rest_from() - begun_s <= allowed_s
        self.assert_at_rest()
        return begun_s


@dataclass
class ShaftTrace:
    """Trace of a shaft that still turns. Each `read` parses only the rows added since the last one.

    A wait reads the trace many times per second while the drive writes it.
    """

    path: Path
    _size: int = 0
    _head: bool = False
    _numbers: array[float] = field(default_factory=lambda: array("d"))
    _state: list[str] = field(default_factory=list)
    _event: list[str] = field(default_factory=list)

    def read(self) -> Shaft:
        """Return the whole shaft, up to the last complete row."""
        with self.path.open("rb") as file:
            file.seek(self._size)
            text, end, _ = file.read().rpartition(b"\n")
        self._size += len(text) + len(end)
        lines = text.decode().split("\n") if end else []
        for line in lines if self._head else lines[1:]:
            row = line.split(",")
            if len(row) == 5:
                self._numbers.extend(map(float, row[:3]))
                self._state.append(row[3])
                self._event.append(row[4])
        self._head = self._head or bool(lines)
        time_s, speed_rad_s, torque_nm = np.array(self._numbers).reshape(-1, 3).T.copy()
        return Shaft(time_s, speed_rad_s, torque_nm, list(self._state), list(self._event))


def tail_time(trace: Path) -> float:
    """Return the plant time of the last complete row."""
    size = trace.stat().st_size
    with trace.open("rb") as file:
        file.seek(max(0, size - 300))
        lines = file.read().decode().split("\n")
    return next((float(line.split(",")[0]) for line in reversed(lines[1:-1])), 0.0)


def wait_for(
    what: str, done: Callable[[], bool], alive: subprocess.Popen | None = None, hangs_s: float = HANGS_S
) -> bool:
    """Poll until done; return False if ``alive`` ends before. A hang is an error."""
    end = time.monotonic() + hangs_s
    while not done():
        if alive is not None and alive.poll() is not None:
            return done()
        assert time.monotonic() < end, f"hangs: {what}"
        time.sleep(POLL_S)
    return True


PLAIN = ("-m", "sim_bus")
PATIENT = (Path(__file__).with_name("simulator.py"), "patient")
REAL = (Path(__file__).with_name("simulator.py"), "patient,real")


# -- processes -----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def process(*command: object, **options: Any) -> Iterator[subprocess.Popen]:
    """Yield a child process that ends with the test."""
    child = subprocess.Popen(
        [str(part) for part in command], env=clean_environment() | options.pop("env", {}), text=True, **options
    )
    try:
        yield child
    finally:
        child.kill()
        child.wait()
        for stream in (child.stdin, child.stdout, child.stderr):
            if stream is not None:
                stream.close()


@dataclass
class Traced:
    """Simulated drive that writes a trace of its shaft."""

    trace: Path

    @cached_property
    def _follower(self) -> ShaftTrace:
        return ShaftTrace(self.trace)

    @property
    def shaft(self) -> Shaft:
        """Return the motion of the shaft so far."""
        return self._follower.read()

    def rests_after_watchdog(self) -> bool:
        """Return whether the drive's reaction is over and the shaft is at standstill for more than a second."""
        shaft = self.shaft
        lost = shaft.events("host heartbeat lost")
        return bool(lost) and shaft.time_s[-1] > shaft.at_rest_from() + 1.5 and shaft.at_rest_from() >= lost[0]


@dataclass
class Peer(Traced):
    """Simulated drive in its own process, and its address."""

    options: tuple[str, ...]
    child: subprocess.Popen

    @property
    def port(self) -> str:
        """Return the port of a Modbus drive."""
        return self.options[-1]


@contextlib.contextmanager
def peer(folder: Path, *arguments: object, program: tuple[object, ...] = PATIENT) -> Iterator[Peer]:
    """Yield a simulator with its own socketcand hub, unless ``arguments`` name another bus."""
    trace = folder / "shaft.csv"
    own_hub = "-i" not in arguments
    hub = ("--hub", "127.0.0.1:0") if own_hub else ()
    with process(
        sys.executable, *program, "canopen", *hub, "--trace", trace, *arguments, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        ready = child.stdout.readline()
        assert ready.startswith("ready: "), ready
        if own_hub:
            found = re.search(r"socketcand (\S+):(\d+) channel (\S+) node", ready)
            assert found
            host, port, channel = found.groups()
            options = ("-i", "socketcand", "-c", channel, "--bus-kwargs", f"host={host}", f"port={port}",
                       "tcp_tune=True")
        else:
            options = tuple(str(argument) for argument in arguments[:4])     # -i … -c …
        yield Peer(trace, options, child)


@contextlib.contextmanager
def modbus_peer(trace: Path, *arguments: object, program: tuple[object, ...] = PLAIN) -> Iterator[Peer]:
    """Yield a simulated Modbus drive on a free TCP port."""
    with process(sys.executable, *program, "modbus", "--tcp", "127.0.0.1:0", "--trace", trace, *arguments,
                 stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        found = re.search(r"127\.0\.0\.1:(\d+)", child.stdout.readline())
        assert found
        yield Peer(trace, ("--host", "127.0.0.1", "--port", found.group(1)), child)


@dataclass
class Host:
    """`tdhil identify` in its own process, with its stderr."""

    child: subprocess.Popen
    log: Path
    lines: list[str] = field(default_factory=list)

    @property
    def err(self) -> str:
        return "\n".join(self.lines)

    def wait_for_line(self, text: str) -> bool:
        """Wait for a line; return False if the process ends without it."""
        return wait_for(f"line {text!r}", lambda: any(text in line for line in self.lines), self.child)

    def signal(self, number: int) -> None:
        if self.child.poll() is None:
            self.child.send_signal(number)

    def finish(self) -> Finished:
        assert self.child.stdout is not None
        out = self.child.stdout.read()
        code = self.child.wait(HANGS_S)
        self._follower.join(HANGS_S)
        return Finished(code, out, self.err, self.log)

    def follow(self) -> None:
        def read() -> None:
            assert self.child.stderr is not None
            with contextlib.suppress(ValueError):       # closed at the end of a failed test
                for line in self.child.stderr:
                    self.lines.append(line.rstrip("\n"))

        self._follower = threading.Thread(target=read, daemon=True)
        self._follower.start()


@contextlib.contextmanager
def host(folder: Path, *arguments: object, command: str = "identify", **options: Any) -> Iterator[Host]:
    """Yield `python -m tdhil identify --json …`, or another command that runs a drive, with its log in ``folder``."""
    log = folder / "run.mcap"
    with process(
        sys.executable, "-m", "tdhil", command, "--json", "--log", log, *arguments,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=options.pop("stdin", subprocess.DEVNULL), **options,
    ) as child:
        running = Host(child, log)
        running.follow()
        yield running


class Terminal:
    """Program on its own terminal with 80 columns."""

    def __init__(self, *command: object, columns: int = 80, cwd: Path | None = None) -> None:
        import fcntl
        import pty
        import struct
        import termios

        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
        self.child = subprocess.Popen(
            [str(part) for part in command], stdin=slave, stdout=slave, stderr=slave, cwd=cwd,
            env=clean_environment() | {"TERM": "xterm-256color"}, start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # noqa: PLW1509
        )
        os.close(slave)
        self.output = b""

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *exc: object) -> None:
        self.child.kill()
        self.child.wait()
        os.close(self.master)

    def read_until(self, wanted: str) -> bool:
        """Read the output until it contains a text; return False if the program ends without it."""
        end = time.monotonic() + HANGS_S
        while wanted not in self.plain:
            assert time.monotonic() < end, f"hangs before {wanted!r}:\n{self.plain}"
            if not self._read():
                return wanted in self.plain
        return True

    def finish(self) -> int:
        """Read to its end; return the exit code."""
        end = time.monotonic() + HANGS_S
        while self._read():
            assert time.monotonic() < end, f"hangs:\n{self.plain}"
        return self.child.wait(HANGS_S)

    def type(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    def signal(self, number: int) -> None:
        self.child.send_signal(number)

    @property
    def plain(self) -> str:
        """Return the output without escape sequences."""
        return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self.output.decode("utf-8", "replace"))

    def _read(self) -> bool:
        ready, _, _ = select.select([self.master], [], [], 0.1)
        if not ready:
            return self.child.poll() is None
        try:
            data = os.read(self.master, 65536)
        except OSError:           # the last process on the terminal has ended
            return False
        self.output += data
        return bool(data)


INTERRUPTING = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 143}
