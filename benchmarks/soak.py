"""Hours of simulated time with faults at random, run after run in one process: does anything stay behind?

    python benchmarks/soak.py                        # two simulated hours on each bus; 1 if anything is wrong
    python benchmarks/soak.py --bus modbus --hours 0.2 --seed 3
    python benchmarks/soak.py --seconds 600          # as far as it comes in ten minutes of wall time, for each bus

Each run is a `tdhil identify --simulate` in stepped time with a rate, an excitation and a mode drawn at random. Two
of three runs suffer: on CANopen a fault of `--fault list` at a random moment of a random stage, for a while or for
good; on Modbus replies that fail to come, come damaged, are late ones, or are exceptions; on both, Ctrl-C. After each
run: threads, sockets and open files as many as before it, an exit code of the table and never 1, no traceback.
Resident memory is read after a garbage collection and malloc_trim; its slope, in bytes a run, is a straight line's
through the second half of the runs (before it are imports, caches, and each excitation's first time). Allowed:
--slope bytes a run.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import functools
import gc
import io
import os
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

STAGES = ("setup", "speed", "torque", "hold", "acquire")
CODES = {0, 3, 4, 5, 6, 7, 8, 9, 130}
SLOPE_BYTES = 50_000
SHARE_OF_FAULTY = 2 / 3
EXCITATIONS = ("multisine", "multisine", "multisine", "step", "pulses", "sine", "coast-down")
FATES = ("fault", "fault", "fault", "Ctrl-C")


@dataclass(frozen=True)
class Standing:
    """Resources of this process."""

    threads: int
    sockets: int
    files: int
    resident_bytes: int


def standing() -> Standing:
    gc.collect()
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)               # glibc: free memory is returned, so that only used memory counts
    targets = []
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            targets.append(str(entry.readlink()))         # the listing's own is gone by now
    threads = len(list(Path("/proc/self/task").iterdir()))
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    sockets = sum(target.startswith("socket:") for target in targets)
    return Standing(threads, sockets, len(targets), pages * os.sysconf("SC_PAGE_SIZE"))


class Course:
    """The run that is under way: how far it has come in plant time, and what shall happen to it."""

    def __init__(self) -> None:
        self.time_s = 0.0
        self.interrupt_at_s = float("inf")

    def begin(self, interrupt_at_s: float) -> None:
        self.time_s, self.interrupt_at_s = 0.0, interrupt_at_s

    def watch(self) -> None:
        from tdhil.report.live import LiveDisplay

        plain = LiveDisplay.cycle

        def cycle(display, command, sample):
            self.time_s = sample.time_s
            if sample.time_s >= self.interrupt_at_s:
                self.interrupt_at_s = float("inf")
                signal.raise_signal(signal.SIGINT)     # its handler only notes the wish
            plain(display, command, sample)

        LiveDisplay.cycle = cycle


# -- faults ----------------------------------------------------------------------------------------------------------


def canopen_fault(rng: Random) -> str:
    from sim_bus.canopen.faults import KINDS

    name = rng.choice(sorted(KINDS))
    moment = f"@{rng.choice(STAGES)}+{rng.uniform(0.0, 8.0):.2f}s"
    lasting = f"/{rng.uniform(0.1, 5.0):.2f}s" if rng.random() < 0.5 else ""
    return name + moment + lasting


MODBUS_FAULTS = ("silent", "damaged", "cut short", "late reply", "exception 1", "exception 2", "exception 4",
                 "exception 6")


def modbus_fault(rng: Random) -> str:
    begin_s = rng.uniform(0.0, 60.0)
    return f"{rng.choice(MODBUS_FAULTS)}@{begin_s:.2f}/{rng.choice((0.1, 1.0, 5.0, 1e9))}/{rng.uniform(0.05, 1.0):.2f}"


@contextlib.contextmanager
def modbus_suffers(text: str | None, rng: Random) -> Iterator[None]:
    """The embedded drive answers wrongly, or not, for a while: NAME@BEGIN/DURATION/SHARE of the replies."""
    from sim_bus.modbus import embedded

    plain = embedded.EmbeddedModbusDrive.serve
    last: list[bytes] = []

    def spoilt(name: str, pdu: bytes, reply: bytes) -> bytes | None:
        if name.startswith("exception"):
            return bytes((pdu[0] | 0x80, int(name[-1])))
        if name == "damaged":
            place = rng.randrange(len(reply))
            return reply[:place] + bytes((reply[place] ^ 1 << rng.randrange(8),)) + reply[place + 1 :]
        if name == "cut short":
            return reply[: rng.randrange(1, len(reply))] if len(reply) > 1 else None
        if name == "late reply" and last:
            return last[0]
        return None

    def serve(drive, unit, pdu, now_s):
        reply, took_s = plain(drive, unit, pdu, now_s)
        if text and reply:
            name, rest = text.split("@")
            begin_s, duration_s, share = map(float, rest.split("/"))
            if begin_s <= now_s < begin_s + duration_s and rng.random() < share:
                return spoilt(name, pdu, reply), took_s
            last[:] = [reply]
        return reply, took_s

    embedded.EmbeddedModbusDrive.serve = serve
    try:
        yield
    finally:
        embedded.EmbeddedModbusDrive.serve = plain


# -- runs ------------------------------------------------------------------------------------------------------------


@dataclass
class Done:
    """One run. ``told`` is what it complained of last."""

    number: int
    fault: str
    code: int
    simulated_s: float
    took_s: float
    wrong: list[str]
    after: Standing
    told: str


def options(bus: str, rng: Random) -> list[str]:
    drawn = ["--seed", str(rng.randrange(2**31)), "--periods", str(rng.randint(3, 6)),
             "--excitation", rng.choice(EXCITATIONS)]
    if rng.random() < 0.3:
        drawn += ["--mode", rng.choice(("torque", "speed"))]
    return drawn + (["--rate", rng.choice(("50", "100", "250"))] if bus == "canopen" else ["--drive", "modbus"])


def one_run(bus: str, number: int, seed: int, course: Course, folder: Path) -> Done:
    from tdhil.cli.main import main

    rng = Random(f"{seed} {bus} {number}")
    drawn = options(bus, rng)
    fate = rng.choice(FATES) if rng.random() < SHARE_OF_FAULTY else ""
    text = None
    if fate == "fault":
        text = canopen_fault(rng) if bus == "canopen" else modbus_fault(rng)
    course.begin(rng.uniform(0.0, 100.0) if fate == "Ctrl-C" else float("inf"))
    before, began_s = standing(), time.monotonic()
    out, err = io.StringIO(), io.StringIO()
    log = folder / "run.mcap"
    suffers = contextlib.nullcontext() if bus == "canopen" else modbus_suffers(text, rng)
    if text and bus == "canopen":
        drawn += ["--fault", text]
    with suffers, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(["identify", "--simulate", "--json", "--log", str(log), *drawn])
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
    log.unlink(missing_ok=True)
    told, wrong = err.getvalue(), []
    del out, err
    after = standing()
    if code not in CODES:
        wrong.append(f"exit code {code}")
    if "Traceback" in told:
        wrong.append("a traceback")
    wrong += [
        f"{what}: {getattr(before, what)} before, {getattr(after, what)} after"
        for what in ("threads", "sockets", "files") if getattr(after, what) > getattr(before, what)
    ]
    if wrong:
        wrong.append(" ".join(drawn))
    last = [line for line in told.splitlines() if line.startswith("tdhil: ")]
    shown = told if "Traceback" in told or code == 1 else "".join(last[:1])
    return Done(number, text or fate or "-", code, course.time_s, time.monotonic() - began_s, wrong, after, shown)


def slope(values: list[int]) -> float:
    """Return the slope of the straight line through the values, per step."""
    import numpy as np

    return float(np.polyfit(np.arange(len(values)), np.array(values, float), 1)[0]) if len(values) > 1 else 0.0


def soak(bus: str, hours: float, seconds: float, seed: int, say: Callable[[str], None]) -> tuple[list[Done], float]:
    """The runs, and the slope of resident memory in bytes a run."""
    runs: list[Done] = []
    simulated_s, began_s = 0.0, time.monotonic()
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        os.environ["HOME"] = folder                # no bus of the user's own files
        os.chdir(folder)
        while simulated_s < hours * 3600.0 and not (seconds and time.monotonic() - began_s > seconds):
            done = one_run(bus, len(runs), seed, course, Path(folder))
            runs.append(done)
            simulated_s += done.simulated_s
            if done.wrong:
                say(f"{bus} {done.number}: WRONG: {'; '.join(done.wrong)}\n    fault {done.fault}\n{done.told}")
            if len(runs) % 10 == 0:
                at = done.after
                took_s = time.monotonic() - began_s
                say(f"{bus} {len(runs):>4} runs, {simulated_s / 3600:.2f} h simulated in {took_s:.0f} s:"
                    f" {at.resident_bytes / 2**20:.1f} MiB resident, {at.threads} threads, {at.sockets} sockets,"
                    f" {at.files} files")
        os.chdir(ROOT)
    settled = runs[len(runs) // 2 :]
    return runs, slope([done.after.resident_bytes for done in settled])


course = Course()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bus", choices=("canopen", "modbus", "both"), default="both")
    parser.add_argument("--hours", type=float, default=2.0, metavar="H", help="simulated, for each bus (default 2)")
    parser.add_argument("--seconds", type=float, default=0.0, metavar="S", help="of wall time at most, for each bus")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--slope", type=float, default=SLOPE_BYTES, metavar="BYTES", help="a run, at most")
    wish = parser.parse_args()
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        del os.environ[name]
    course.watch()
    failed = False
    for bus in ("canopen", "modbus") if wish.bus == "both" else (wish.bus,):
        runs, bytes_a_run = soak(bus, wish.hours, wish.seconds, wish.seed, functools.partial(print, flush=True))
        wrong = sum(bool(done.wrong) for done in runs)
        simulated_s, took_s = sum(done.simulated_s for done in runs), sum(done.took_s for done in runs)
        codes = ", ".join(f"{code}: {count}" for code, count in sorted(Counter(done.code for done in runs).items()))
        faulty = sum(done.fault != "-" for done in runs)
        print(f"{bus}: {len(runs)} runs ({faulty} with a fault), {simulated_s / 3600:.2f} h simulated in"
              f" {took_s:.0f} s; exit codes {codes}; {wrong} wrong; resident memory"
              f" {runs[0].after.resident_bytes / 2**20:.1f} to {runs[-1].after.resident_bytes / 2**20:.1f} MiB,"
              f" slope {bytes_a_run:+.0f} bytes a run; {threading.active_count()} threads", flush=True)
        failed |= wrong > 0 or bytes_a_run > wish.slope
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
