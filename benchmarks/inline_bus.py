"""Cost of a stepped cycle with the simulator in the host's own thread, against a thread of its own.

    python benchmarks/inline_bus.py [--cycles 5000] [--rounds 3] [--require 1.5]

`CanopenDrive.exchange` against the same simulated drive, enabled and turning: over python-can's virtual bus, where host
and simulator hand each frame over, and over `InlineSimulator`, where `send` has the answer. The two take turns in this
process; the median of the rounds counts. `--require` makes the exit code say whether the CPU time is that many times
smaller. The samples of both must be equal.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack

import can

from drivers.canopen.drive import CanopenDrive
from drivers.clock import SteppedClock
from drivers.drive import Command, DriveLimits, Mode, Sample
from profiles.library import load_canopen_profile
from sim_bus.canopen.inline import InlineSimulator
from sim_bus.canopen.simulator import EmbeddedSimulator

LIMITS = DriveLimits(speed_rad_s=10.0, torque_nm=400.0, quick_stop_rad_s2=2.0, watchdog_s=0.5)
TURN = Command(Mode.SPEED, 2.0, 0.0)
Open = Callable[[ExitStack], can.BusABC]


def virtual(stack: ExitStack) -> can.BusABC:
    """The simulator in a thread."""
    simulated = stack.enter_context(EmbeddedSimulator(seed=1))
    return can.Bus(simulated.channel, interface="virtual")


def inline(stack: ExitStack) -> can.BusABC:
    """The simulator in this thread."""
    return stack.enter_context(InlineSimulator(seed=1)).bus


def run(open_bus: Open, cycles: int) -> tuple[float, float, list[Sample]]:
    """Wall and CPU time of a cycle, in µs, and what was seen."""
    with ExitStack() as stack:
        drive = CanopenDrive(open_bus(stack), load_canopen_profile("generic/cia402"), SteppedClock(), node=1)
        stack.callback(drive.close)
        drive.connect()
        drive.preflight(LIMITS)
        drive.enable(Mode.SPEED)
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        samples = [drive.exchange(TURN) for _ in range(cycles)]
        cpu_s, wall_s = time.process_time() - cpu_s, time.perf_counter() - wall_s
    return 1e6 * wall_s / cycles, 1e6 * cpu_s / cycles, samples


def main() -> int:
    """Prints both and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", type=int, default=5000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--require", type=float, default=0.0, metavar="RATIO")
    options = parser.parse_args()
    found: dict[str, list[tuple[float, float]]] = {"virtual bus": [], "inline": []}
    for _ in range(options.rounds):
        seen = []
        for name, open_bus in (("virtual bus", virtual), ("inline", inline)):
            wall_us, cpu_us, samples = run(open_bus, options.cycles)
            found[name].append((wall_us, cpu_us))
            seen.append(samples)
        assert seen[0] == seen[1], "the two don't say the same"
    middle = {name: [statistics.median(column) for column in zip(*rows, strict=True)] for name, rows in found.items()}
    for name, (wall_us, cpu_us) in middle.items():
        print(f"{name:12} {wall_us:7.0f} µs of wall time a cycle, {cpu_us:7.0f} µs of CPU")
    wall, cpu = (a / b for a, b in zip(middle["virtual bus"], middle["inline"], strict=True))
    print(f"virtual / inline: {wall:.2f} in wall time, {cpu:.2f} in CPU")
    return int(cpu < options.require)


if __name__ == "__main__":
    sys.exit(main())
