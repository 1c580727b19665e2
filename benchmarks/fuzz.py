"""Hostile input by the hundred thousand, from the corpus in tests/fuzz: python benchmarks/fuzz.py --parser csv

Each parser runs in a child of its own with a bounded address space. An input that raises anything but a proper refusal,
that takes too long or too much, is kept in --findings; the same --seed and number make the same input again.
"""

from __future__ import annotations

import argparse
import logging
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from random import Random

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT)]

from tests.fuzz.mutate import mutated  # noqa: E402
from tests.fuzz.parsers import PARSERS, Parser, try_one  # noqa: E402

LONGEST_S = 10
MEMORY_BYTES = 3 * 2**30               # of address space, with numpy, scipy and matplotlib's libraries in it
SHM = Path("/dev/shm")


class TooLong(BaseException):
    pass


def run(parser: Parser, inputs: int, seed: int, first: int, seconds: float, findings: Path) -> int:
    """Return the number of findings; each is printed and saved."""
    corpus = parser.corpus()
    told = {"taken": 0, "refused": 0}
    found: set[str] = set()
    slowest_s, done = 0.0, 0
    begun_s = time.monotonic()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    signal.signal(signal.SIGALRM, _alarm)
    warnings.simplefilter("ignore")
    logging.disable()
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=SHM if SHM.is_dir() else None) as folder:
        path = Path(folder) / f"input{parser.suffix}"
        for data in corpus:                # imports and caches before memory is measured
            told[try_one(parser, data, path)] += 0
        before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for number in range(first, first + inputs):
            if seconds and time.monotonic() - begun_s > seconds:
                break
            data = mutated(Random(f"{seed} {number}"), corpus, parser.mutations)
            at_s = time.monotonic()
            signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
            try:
                told[try_one(parser, data, path)] += 1
            except (Exception, TooLong, RecursionError) as error:
                signal.setitimer(signal.ITIMER_REAL, 0)
                _keep(parser, data, number, error, found, findings)
            signal.setitimer(signal.ITIMER_REAL, 0)
            slowest_s = max(slowest_s, time.monotonic() - at_s)
            done += 1
        grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb) / 1024
    took_s = time.monotonic() - begun_s
    print(f"{parser.name:<10} {done:>7} inputs in {took_s:.0f} s: {told['taken']} taken, {told['refused']} refused, "
          f"{len(found)} kinds of findings; slowest {slowest_s:.2f} s, memory grown by {grown_mb:.0f} MB", flush=True)
    return len(found)


def _alarm(number: int, frame: object) -> None:
    raise TooLong(f"not done within {LONGEST_S} s")


def _keep(parser: Parser, data: bytes, number: int, error: BaseException, found: set[str], findings: Path) -> None:
    """One file for each kind: the same exception from the same line is the same mistake."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    kind = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}"
    if kind in found:
        return
    found.add(kind)
    findings.mkdir(parents=True, exist_ok=True)
    path = findings / f"{parser.name}_{number}{parser.suffix}"
    path.write_bytes(data)
    print(f"{parser.name}: {kind}: {str(error)[:300]!r}\n    kept as {path}", flush=True)
    print("".join(traceback.format_tb(error.__traceback__, limit=-5))[-1500:], flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parser", choices=(*PARSERS, "all"), default="all")
    parser.add_argument("--inputs", type=int, default=100_000, metavar="N", help="for each parser (default 100000)")
    parser.add_argument("--seconds", type=float, default=0.0, metavar="S", help="at most, for each parser")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first input")
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"), metavar="DIR")
    wish = parser.parse_args()
    if wish.parser != "all":
        return int(run(PARSERS[wish.parser], wish.inputs, wish.seed, wish.first, wish.seconds, wish.findings) > 0)
    code = 0
    for name in PARSERS:
        arguments = ["--parser", name, "--inputs", wish.inputs, "--seed", wish.seed, "--first", wish.first,
                     "--seconds", wish.seconds, "--findings", wish.findings]
        code |= subprocess.run([sys.executable, __file__, *map(str, arguments)], check=False).returncode
    return code


if __name__ == "__main__":
    sys.exit(main())
