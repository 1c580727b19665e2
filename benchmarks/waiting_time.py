"""Time that a user waits for, as ratios in one run: a replay and a simulated run, each beside what it needs at least.

    python benchmarks/waiting_time.py [--rounds 5] [--cycles 73000] [--require-replay R] [--require-run R]

replay  `tdhil replay run.mcap` beside `import numpy, scipy.linalg, scipy.special`, each a process of its own. The
        import has as many threads as numpy takes by itself.
run     `tdhil identify --simulate` beside a loop of python-can alone over as many cycles: RPDO and SYNC out, TPDO in,
        and a thread with python-can alone that answers (loop A of cycle_rate.py).

User CPU time of the child processes (getrusage). The processes take turns, and the median of the rounds counts. Other
programs on this computer change the seconds. The ratios change less.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
IMPORTS = "import numpy, scipy.linalg, scipy.special"
BARE_LOOP = "from benchmarks.cycle_rate import bare; bare({cycles})"


def user_s(command: list[str], environment: Mapping[str, str]) -> float:
    """User CPU seconds of one process and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT, env=environment)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before


def main() -> int:
    """Print the medians and the ratios. Return 1 if a required ratio is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cycles", type=int, default=73_000, help="of the bare loop; those of the default run")
    parser.add_argument("--require-replay", type=float, metavar="R", help="largest ratio of replay to import")
    parser.add_argument("--require-run", type=float, metavar="R", help="largest ratio of run to bare loop")
    wanted = parser.parse_args()
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as folder:
        log = str(Path(folder) / "run.mcap")
        tdhil = [sys.executable, "-m", "tdhil"]
        commands = {
            "run": [*tdhil, "identify", "--drive", "canopen", "--simulate", "--seed", "7", "--json", "--log", log],
            "bare loop": [sys.executable, "-c", BARE_LOOP.format(cycles=wanted.cycles)],
            "replay": [*tdhil, "replay", log],
            "import": [sys.executable, "-c", IMPORTS],
        }
        took: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(wanted.rounds):
            Path(log).unlink(missing_ok=True)
            for name, command in commands.items():
                took[name].append(user_s(command, environment))
    middle = {name: statistics.median(found) for name, found in took.items()}
    ratios = {"replay": middle["replay"] / middle["import"], "run": middle["run"] / middle["bare loop"]}
    for name, found in took.items():
        print(f"{name:10} {middle[name]:7.2f} s of user CPU time ({min(found):.2f} to {max(found):.2f})")
    print(f"replay / import {ratios['replay']:.2f}   run / bare loop {ratios['run']:.2f}")
    limits = {"replay": wanted.require_replay, "run": wanted.require_run}
    return int(any(limit is not None and ratios[name] > limit for name, limit in limits.items()))


if __name__ == "__main__":
    sys.exit(main())
