"""JSON documents of two checkouts: the same to the last digit, or the keys that differ.

    python benchmarks/same_documents.py OTHER [--tree THIS] [--seeds 20] [--buses canopen,modbus] [--logs RUN.mcap …]
                                        [--within 0]

OTHER and THIS (default: the checkout of this script) are folders of two checkouts, such as a `git worktree` of an
earlier commit. Both run `tdhil identify --simulate --json` with each seed from 1 on each bus, and `tdhil replay --json`
of each log. Both use this interpreter and its packages. The keys of `LEFT_OUT` are not compared: dates, versions, and
the offset of the wall clock. Durations are in control time, which is the same in stepped time.

The exit code is 1 if a value, a key or an exit code differs, or if a command printed no document. With `--within R`,
numbers may differ by the share R; the largest share that occurs is printed for each key.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

THIS = Path(__file__).resolve().parents[1]
LEFT_OUT = {"date", "tdhil", "recorded_by", "wall_offset_s", "wall_jumps"}
"""Keys at any depth whose values depend on the clock of the computer, or on the release."""
LOG = "run.mcap"
ABSENT = "absent"


def document_of(tree: Path, words: Sequence[str], folder: Path) -> tuple[int, Any]:
    """Return exit code and document of a command with the code of this checkout; None if it printed none."""
    done = subprocess.run(
        [sys.executable, "-m", "tdhil", *words, "--json"], cwd=folder, capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"})
    return done.returncode, json.loads(done.stdout) if done.stdout.strip() else None


def share_apart(before: Any, after: Any) -> float:
    """Return the difference of two numbers as a share of the first; infinite for anything else."""
    if not (isinstance(before, float) and isinstance(after, float)):
        return math.inf
    return abs(after - before) / abs(before) if before else math.inf


def differing(before: Any, after: Any, near: dict[str, float], within: float, where: str = "") -> Iterator[str]:
    """Yield the keys whose values differ, each with both values. Numbers within a share are kept in ``near``."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted((before.keys() | after.keys()) - LEFT_OUT):
            yield from differing(before.get(key, ABSENT), after.get(key, ABSENT), near, within,
                                 f"{where}.{key}".lstrip("."))
    elif isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            yield f"{where}: {len(before)} items, {len(after)}"
            return
        for number, pair in enumerate(zip(before, after, strict=True)):
            yield from differing(*pair, near, within, f"{where}[{number}]")
    elif before != after or type(before) is not type(after):
        if (apart := share_apart(before, after)) <= within:
            near[where] = max(apart, near.get(where, 0.0))
            return
        yield f"{where}: {before}, {after}"


def main() -> int:
    """Compare all documents. Return 1 if any differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("other", type=Path, help="folder of the checkout before")
    parser.add_argument("--tree", type=Path, default=THIS, help="folder of the checkout after; this one")
    parser.add_argument("--seeds", type=int, default=20, help="simulated runs on each bus")
    parser.add_argument("--buses", default="canopen,modbus")
    parser.add_argument("--logs", type=Path, nargs="*", default=[], help="logs to replay")
    parser.add_argument("--within", type=float, default=0.0, metavar="R", help="share by which numbers may differ")
    asked = parser.parse_args()
    runs = {f"{bus}, seed {seed}": ["identify", "--simulate", "--drive", bus, "--seed", str(seed), "--log", LOG]
            for bus in asked.buses.split(",") for seed in range(1, asked.seeds + 1)}
    runs |= {f"replay of {log}": ["replay", str(log.resolve())] for log in asked.logs}
    trees, wrong = [asked.other.resolve(), asked.tree.resolve()], 0
    near: dict[str, float] = {}
    for name, words in runs.items():
        found = []
        for tree in trees:
            with tempfile.TemporaryDirectory() as folder:
                found.append(document_of(tree, words, Path(folder)))
        (code, before), (code_now, after) = found
        other = [] if code == code_now else [f"exit code: {code}, {code_now}"]
        absent = before is None or after is None
        other += ["no document"] if absent else list(differing(before, after, near, asked.within))
        wrong += bool(other)
        print(f"{name}: {'the same' if not other else f'{len(other)} differ'}", *other, sep="\n    ", flush=True)
    for key, apart in sorted(near.items()):
        print(f"{key}: at most {apart:.1e} of its value apart")
    print(f"{wrong} of {len(runs)} documents differ")
    return 1 if wrong or not runs else 0


if __name__ == "__main__":
    sys.exit(main())
