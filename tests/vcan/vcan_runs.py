"""Runs on a real interface with host and simulated drive in this process, since a guest starts programs slowly."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import can

from sim_bus.canopen.simulator import Simulator
from sim_bus.params import RigParams
from tests.path.path_runs import (
    HANGS_S,
    INERTIA,
    SWINGS_IN_RAD_S,
    TORQUE_NM,
    Finished,
    Shaft,
    Traced,
    identify,
    wait_for,
)

RATE_HZ = 25.0
"""Rate of the runs. A guest needs milliseconds per cycle, and plant time is the same at any rate."""
TURNING_RAD_S = 1.0
FASTEST_RAD_S = 10.0                      # the simulated rig's speed window
NOTICED_S = 30.0
"""Plant time after which a host that has not detected the fault never will."""


def root_s_ip() -> str | None:
    """Return ip(8) for root, since other users may not change links."""
    return shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin") if os.geteuid() == 0 else None


def run(*command: object) -> None:
    """Run a system tool; its error fails the test."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=HANGS_S)
    assert done.returncode == 0, f"{command}: {done.stderr or done.stdout}"


@dataclass
class Drive(Traced):
    """Simulated drive in a thread of the test."""

    simulator: Simulator

    def rests(self) -> bool:
        """Return whether the shaft is at standstill for more than a second of plant time."""
        shaft = self.shaft
        return bool(len(shaft.time_s)) and shaft.time_s[-1] > shaft.at_rest_from() + 1.5


@contextmanager
def simulated(folder: Path, interface: str, *, stepped: bool = True) -> Iterator[Drive]:
    """Yield a stepped drive for which a host counts as lost only after a long silence."""
    trace, ended = folder / "shaft.csv", threading.Event()
    with can.Bus(interface="socketcan", channel=interface) as bus:
        simulator = Simulator(bus, RigParams(), seed=1, trace=trace, stepped=stepped, silence_s=HANGS_S)
        thread = threading.Thread(target=simulator.run, args=(ended,), daemon=True)
        thread.start()
        try:
            wait_for("its boot-up", lambda: trace.exists() and b"power on" in trace.read_bytes())
            yield Drive(trace, simulator)
        finally:
            ended.set()
            thread.join()


def run_into(trouble: Callable[[], None], folder: Path, drive: Drive, interface: str) -> tuple[Finished, bool]:
    """Run `tdhil identify` with a fault once the shaft turns; return its end, and whether it needed Ctrl-C."""
    over = threading.Event()
    found: dict[str, bool | BaseException] = {"by itself": True}

    def meddle() -> None:
        try:
            wait_for("motion", lambda: drive.simulator.speed_rad_s > TURNING_RAD_S or over.is_set())
            if over.is_set():
                return
            drive.simulator._time.silence_s = 1.0           # from here on the drive must detect a lost host
            trouble()
            due_s = drive.simulator.time_s + NOTICED_S
            wait_for("the end", lambda: over.is_set() or drive.simulator.time_s > due_s)
        except BaseException as error:         # raised in the test's own thread
            found["failure"] = error
        if not over.is_set():
            found["by itself"] = False
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=meddle, daemon=True)
    thread.start()
    try:
        done = identify(folder, "-i", "socketcan", "-c", interface, "--stepped", "--rate", RATE_HZ, "--periods", 40)
    finally:
        over.set()
        thread.join()
    if "failure" in found:
        raise AssertionError(done.err) from found["failure"]     # type: ignore[misc]
    return done, bool(found["by itself"])


def assert_safe(drive: Drive) -> Shaft:
    """Assert standstill, no disable in motion, no reverse rotation, and a speed within the window."""
    drive.shaft.assert_enabled(True)
    end_s = time.monotonic() + HANGS_S
    while not drive.rests():
        assert time.monotonic() < end_s, "the shaft does not come to standstill"
        time.sleep(0.1)
    shaft = drive.shaft
    shaft.assert_at_rest()
    assert shaft.speed_rad_s.max() < FASTEST_RAD_S + 0.5 * TORQUE_NM / INERTIA
    assert shaft.speed_rad_s.min() > -SWINGS_IN_RAD_S
    return shaft
