"""Cycles that begin late at 250 Hz beside busy loops, one a core, with `--real-time-priority` and without, by turns.

The loop is the run's own (`CanopenDrive.exchange`, and the log's thread beside it) over the simulator's socketcand hub.
The simulated drive is a process of its own that goes before everything, as far as that is allowed: a real one has a
processor of its own. A cycle is missed where it began late by more than half a period, or its feedback wasn't there.
"""

from __future__ import annotations

import argparse
import os
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import can

from drivers.canopen.drive import CanopenDrive
from drivers.clock import MonotonicClock, quantile
from drivers.drive import Command, DriveLimits, Mode
from profiles.library import load_canopen_profile
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.run_log import RunLog
from tdhil.session.real_time import real_time_priority

RATE_HZ = 250.0
LIMITS = DriveLimits(speed_rad_s=10.0, torque_nm=400.0, quick_stop_rad_s2=2.0, watchdog_s=5.0)
REST = Command(Mode.SPEED, 0.0, 0.0)
DRIVE_PRIORITY = 60
HOG = "while True: pass"


@contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Let this many processes compute without end beside the block."""
    hogs = [subprocess.Popen([sys.executable, "-c", HOG]) for _ in range(count)]
    try:
        yield
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def one_round(raised: bool, seconds: float) -> tuple[int, int, int, float, float, str]:
    """(cycles, begun late, without feedback in time, p99.9 and worst of how late, what was had)."""
    late_s: list[float] = []
    with ExitStack() as stack:
        drive_command = [sys.executable, "-m", "sim_bus", "canopen", "--hub", "127.0.0.1:0", "--seed", "1"]
        peer = subprocess.Popen(drive_command, stdout=subprocess.PIPE, text=True)
        stack.callback(peer.wait)
        stack.callback(peer.kill)
        assert peer.stdout is not None
        found = re.search(r"socketcand (\S+):(\d+) channel (\S+) node", peer.stdout.readline())
        assert found
        with suppress(OSError):
            os.sched_setscheduler(peer.pid, os.SCHED_FIFO, os.sched_param(DRIVE_PRIORITY))
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        log = RunLog(RunWriter(Path(folder) / "run.mcap", epoch_ns=0, block=False), {})
        stack.callback(log.close)
        bus = can.Bus(found[3], interface="socketcand", host=found[1], port=int(found[2]), tcp_tune=True)
        drive = CanopenDrive(bus, load_canopen_profile("generic/cia402"), MonotonicClock(), node=1, rate_hz=RATE_HZ,
                            tap=log.frame)
        stack.callback(drive.close)
        drive.connect()
        drive.preflight(LIMITS)
        had = stack.enter_context(real_time_priority(raised))
        for _ in range(round(seconds * RATE_HZ)):
            log.cycle(REST, drive.exchange(REST))
            late_s.append(drive.began_late_s)
        counters = drive.counters
        late_s.sort()
    return (counters.cycles, counters.overruns, counters.missed, quantile(late_s, 0.999), late_s[-1], had.said)


def main() -> int:
    parser = argparse.ArgumentParser(description="Missed cycles at 250 Hz beside hogs, with priority and without.")
    parser.add_argument("--rounds", type=int, default=4, metavar="N", help="of each (default 4)")
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="of a round (default 20)")
    parser.add_argument("--hogs", type=int, default=os.cpu_count() or 2, metavar="N", help="default: one a core")
    options = parser.parse_args()
    shares: dict[bool, list[float]] = {False: [], True: []}
    with busy_loops(options.hogs):
        for number in range(2 * options.rounds):
            raised = bool(number % 2)
            cycles, late, missed, p999_s, worst_s, said = one_round(raised, options.seconds)
            shares[raised].append((late + missed) / cycles)
            print(f"{'with   ' if raised else 'without'} {cycles} cycles: {late} begun late, {missed} without feedback;"
                  f" late by {1e3 * p999_s:.2f} ms (p99.9), {1e3 * worst_s:.2f} ms (worst) {said}", flush=True)
    print("missed, median of rounds: " + ", ".join(
        f"{'with' if raised else 'without'} priority {100 * statistics.median(found):.3f} %"
        for raised, found in shares.items()
    ) + f"; {options.hogs} hogs, {os.cpu_count()} cores, {RATE_HZ:g} Hz")
    return 0


if __name__ == "__main__":
    sys.exit(main())
