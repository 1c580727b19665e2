"""How many control cycles a second: python-can alone, our drive in lock step, and the whole run path.

Four loops take turns, A B C D A B C D …, in this one process on python-can's virtual bus:

A  bare     RPDO1 and SYNC out, TPDO1 in, struct both ways; a thread with python-can alone answers each SYNC.
B  drive    `CanopenDrive.exchange` against the embedded simulator: stepped, enabled, turning, with all its noise.
C  run      the same under `ControlLoop.cycle`: guard, every frame, command and sample logged, the file closed. The
            observer knows J and friction, so that it compares all that it compares in motion.
D  blind    C with an observer that sees nothing and doubts nothing: what it costs is the difference.

One more round of C is timed piece by piece, as CPU time of each thread. Absolute figures drift with the machine, so
ratios are what counts: `--require 0.5` makes the exit code say whether B reaches that share of A, and
`--observer-costs 0.03` whether C/A is at most so much below D/A. Beside other work, `--cpu` counts the processor time
of all threads of this process instead of wall time: the waits for the other work drop out.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from struct import Struct
from typing import Any

import can
from can.interfaces.virtual import VirtualBus

from drivers.canopen.drive import CanopenDrive
from drivers.clock import SteppedClock
from drivers.drive import Command, DriveLimits, FrameTap, Mode, PowerState, Preflight, Sample
from profiles.library import load_canopen_profile
from sim_bus.canopen.simulator import EmbeddedSimulator
from sim_bus.params import RigParams
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.run_log import RunLog
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import RigGuess
from tdhil.runner.guard import Guard
from tdhil.runner.observer import Observer
from tdhil.runner.settings import MachineLimits, StopRequest

RATE_HZ = 250.0
LIMITS = DriveLimits(speed_rad_s=10.0, torque_nm=400.0, quick_stop_rad_s2=2.0, watchdog_s=0.5)
TURN = Command(Mode.SPEED, 2.0, 0.0)
KNOWN = RigGuess(RigParams().plant.inertia_kg_m2, RigParams().plant.viscous_nm_s_rad, RigParams().plant.coulomb_nm)
"""Result of stage 2 for the default rig."""
RPDO = Struct("<Hhi")
SYNC, RPDO_ID, TPDO_ID = 0x080, 0x201, 0x181
LOOPS = ("A bare", "B drive", "C run", "D blind")


class Watch:
    """The time of a loop, s: of the wall, or of the processor in all threads."""

    now_s: Callable[[], float] = staticmethod(time.perf_counter)


# -- A: python-can and struct, nothing of ours ------------------------------------------------------------------------


def message(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False, check=False)


def answer_syncs(bus: can.BusABC, stop: threading.Event) -> None:
    feedback = RPDO.pack(0x1637, 100, 191)
    while not stop.is_set():
        got = bus.recv(0.1)
        if got is not None and got.arbitration_id == SYNC:
            bus.send(message(TPDO_ID, feedback))


def bare(cycles: int) -> float:
    stop = threading.Event()
    with can.Bus("bare", interface="virtual") as far, can.Bus("bare", interface="virtual") as near:
        peer = threading.Thread(target=answer_syncs, args=(far, stop), name="peer")
        peer.start()
        try:
            begin = Watch.now_s()
            for number in range(cycles):
                near.send(message(RPDO_ID, RPDO.pack(0x1F, number & 0xFF, 191)))
                near.send(message(SYNC))
                got = near.recv(1.0)
                assert got is not None and got.arbitration_id == TPDO_ID
                RPDO.unpack(got.data)
            return cycles / (Watch.now_s() - begin)
        finally:
            stop.set()
            peer.join()


# -- B and C: ours ----------------------------------------------------------------------------------------------------


@contextmanager
def turning_drive(tap: FrameTap | None = None) -> Iterator[tuple[EmbeddedSimulator, CanopenDrive, Preflight]]:
    """The default simulated rig, enabled in speed mode."""
    with EmbeddedSimulator(RigParams(), seed=1) as simulator:
        bus = can.Bus(simulator.channel, interface="virtual")
        profile = load_canopen_profile("generic/cia402")
        drive = CanopenDrive(bus, profile, SteppedClock(), node=1, rate_hz=RATE_HZ, tap=tap)
        try:
            drive.connect()
            preflight = drive.preflight(LIMITS)
            drive.enable(Mode.SPEED)
            while drive.exchange(TURN).state is not PowerState.ENABLED:
                pass
            yield simulator, drive, preflight
        finally:
            drive.close()


def lock_step(cycles: int) -> float:
    with turning_drive() as (_, drive, _):
        begin = Watch.now_s()
        for _ in range(cycles):
            drive.exchange(TURN)
        rate = cycles / (Watch.now_s() - begin)
        assert drive.counters.missed == 0
    return rate


class BlindObserver(Observer):
    """It is asked as the observer is, and sees nothing."""

    def see(self, command: Command, sample: Sample) -> None:
        pass


def run_path(cycles: int, clock: Clockwork | None = None, *, blind: bool = False) -> float:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cycle-rate-")))
        log = RunLog(RunWriter(folder / "run.mcap", epoch_ns=0, block=True), {})
        stack.callback(log.close)
        simulator, drive, preflight = stack.enter_context(turning_drive(clock.tap(log.frame) if clock else log.frame))
        limits = MachineLimits(0.5, LIMITS.speed_rad_s, LIMITS.torque_nm, 1e6)
        guard = Guard(limits, drive.period_s, preflight.speed_resolution_rad_s, preflight.torque_resolution_nm)
        if blind:
            guard.observer = BlindObserver(limits, drive.period_s, preflight.speed_resolution_rad_s)
        guard.know(KNOWN)
        bench = ControlLoop(drive, guard, log, StopRequest())
        if clock:
            clock.attach(simulator, guard, log)
        begin = Watch.now_s()
        for _ in range(cycles):
            bench.cycle(TURN)
        if clock:
            clock.stop()
        log.close()
        return cycles / (Watch.now_s() - begin)


# -- where the time goes ----------------------------------------------------------------------------------------------


class Clockwork:
    """CPU time of one round of C, by thread and piece. What a piece calls of another piece is not its own."""

    def __init__(self) -> None:
        self.own_ns: dict[tuple[str, str], int] = {}
        self.total_ns: dict[str, int] = {}
        self._inner = threading.local()
        self._running = False
        self._begin_ns: dict[str, int] = {}

    def timed(self, piece: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **named: Any) -> Any:
            if not self._running:
                return function(*args, **named)
            outer = getattr(self._inner, "ns", 0)
            self._inner.ns = 0
            begin = time.thread_time_ns()
            try:
                return function(*args, **named)
            finally:
                took = time.thread_time_ns() - begin
                key = (threading.current_thread().name, piece)
                self.own_ns[key] = self.own_ns.get(key, 0) + took - self._inner.ns
                self._inner.ns = outer + took
        return call

    def tap(self, tap: FrameTap) -> FrameTap:
        return self.timed("log, the control loop's share", tap)

    def attach(self, simulator: EmbeddedSimulator, guard: Guard, log: RunLog) -> None:
        node = simulator.simulator.node
        parts: list[tuple[Any, str, str]] = [
            (node, "advance_us", "plant and inverter steps"),
            (node, "on_frame", "SYNC, PDOs: decode, encode"),
            (guard, "check_command", "guard"),
            (guard, "check_sample", "guard"),
            (guard.observer, "see", "observer"),
            (log, "cycle", "log, the control loop's share"),
        ]
        for owner, name, piece in parts:
            setattr(owner, name, self.timed(piece, getattr(owner, name)))
        self._begin_ns = self._cpu_ns()
        self._running = True

    def stop(self) -> None:
        self._running = False
        self.total_ns = {name: ns - self._begin_ns.get(name, 0) for name, ns in self._cpu_ns().items()}

    @staticmethod
    def _cpu_ns() -> dict[str, int]:
        return {
            thread.name: time.clock_gettime_ns(time.pthread_getcpuclockid(thread.ident))
            for thread in threading.enumerate() if thread.ident is not None
        }


@contextmanager
def watched_bus(clock: Clockwork) -> Iterator[None]:
    """python-can's two calls, timed in whichever thread makes them."""
    send, receive = VirtualBus.send, can.BusABC.recv
    VirtualBus.send = clock.timed("python-can send", send)  # type: ignore[method-assign]
    can.BusABC.recv = clock.timed("python-can recv", receive)  # type: ignore[method-assign]
    try:
        yield
    finally:
        VirtualBus.send = send  # type: ignore[method-assign]
        can.BusABC.recv = receive  # type: ignore[method-assign]


def show_pieces(cycles: int) -> float:
    """Print the pieces. Return the observer's share of the processor time of all threads."""
    clock = Clockwork()
    with watched_bus(clock):
        rate = run_path(cycles, clock)
    wall_us = 1e6 / rate
    print(f"\nWhere the time goes in C: CPU µs a cycle, of {wall_us:.0f} µs of wall time with the timers in")
    rest_name = {
        "MainThread": "drive: state machine, decode, waits",
        "simulated drive": "the simulator's loop",
        "tdhil-log": "layout, compression, writing",
    }
    for thread, rest in rest_name.items():
        total = clock.total_ns.get(thread, 0)
        own = {piece: ns for (name, piece), ns in clock.own_ns.items() if name == thread}
        own[rest] = total - sum(own.values())
        print(f"  {thread:<44}{total / cycles / 1e3:7.1f}")
        for piece, ns in sorted(own.items(), key=lambda item: -item[1]):
            print(f"    {piece:<42}{ns / cycles / 1e3:7.1f}")
    whole_ns = sum(clock.total_ns.values())
    print(f"  {'all threads':<44}{whole_ns / cycles / 1e3:7.1f}")
    return clock.own_ns.get(("MainThread", "observer"), 0) / whole_ns


# ---------------------------------------------------------------------------------------------------------------------


def main() -> int:
    parser = argparse.ArgumentParser(description="Cycles a second, bare and ours, in one run.")
    parser.add_argument("--rounds", type=int, default=11, metavar="N", help="of each loop (default 11)")
    parser.add_argument("--cycles", type=int, default=4000, metavar="N", help="in a round (default 4000)")
    parser.add_argument("--require", type=float, metavar="SHARE", help="exit 1 if B is below this share of A")
    parser.add_argument("--observer-costs", type=float, metavar="SHARE", help="exit 1 if C/A is further below D/A")
    parser.add_argument("--cpu", action="store_true", help="by processor time instead of wall time")
    options = parser.parse_args()
    if options.cpu:
        Watch.now_s = staticmethod(time.process_time)
    rates: dict[str, list[float]] = {name: [] for name in LOOPS}
    loops: tuple[Callable[[int], float], ...] = (bare, lock_step, run_path, partial(run_path, blind=True))
    for loop in loops:
        loop(200)  # imports, caches
    for _ in range(options.rounds):
        for name, loop in zip(LOOPS, loops, strict=True):
            rates[name].append(loop(options.cycles))
    print(f"python-can {can.__version__}, virtual bus, {RATE_HZ:g} Hz stepped, {options.rounds} rounds of "
          f"{options.cycles} cycles, by {'processor' if options.cpu else 'wall'} time, load {os.getloadavg()[0]:.1f}")
    middle = {name: statistics.median(found) for name, found in rates.items()}
    for name, found in rates.items():
        print(f"  {name:<8}{middle[name]:8.0f} cycles/s   ({min(found):.0f} to {max(found):.0f})")
    shares = {
        name: statistics.median(ours / base for ours, base in zip(rates[name], rates[LOOPS[0]], strict=True))
        for name in LOOPS[1:]
    }
    print("  " + "   ".join(f"{name[0]}/A {share:.2f}" for name, share in shares.items()) + "   (median of rounds)")
    ours, blind = (rates[name] for name in LOOPS[2:])
    costs = [(without - found) / base for found, without, base in zip(ours, blind, rates[LOOPS[0]], strict=True)]
    cost = statistics.median(costs)
    print(f"  the observer lowers C/A by {cost:.3f} ({min(costs):.3f} to {max(costs):.3f})")
    share = show_pieces(options.cycles)
    alike = shares[LOOPS[2]] * share / (1.0 - share)
    print(f"the observer takes {100.0 * share:.1f} % of the processor time of C: without it, C/A is {alike:.3f} higher")
    if options.observer_costs is not None and cost > options.observer_costs:
        print(f"the observer costs {cost:.3f}, more than {options.observer_costs:g}", file=sys.stderr)
        return 1
    if options.require is not None and shares[LOOPS[1]] < options.require:
        print(f"B/A is {shares[LOOPS[1]]:.2f}, below {options.require:g}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
