"""Cost of a simulated second of the paper's loop, and its growth with the number of parallel runs.

    python benchmarks/study_batch.py [--steps 5000]

Every doubling of the runs may at most double the time of a batch: the cost per simulated second then never rises.
"""

from __future__ import annotations

import argparse
import sys
import time

from tdhil.studies.paper.loop import LoopSettings, simulate
from tdhil.studies.registry import simulated_studies

RUNS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
NOISE = 1.15      # of the clock, not of the claim


def batch_s(runs: int, steps: int) -> float:
    """The best of three."""
    settings = [LoopSettings(duration_s=steps * 0.001, kp_nm_s_rad=2500.0 + 10.0 * run) for run in range(runs)]
    best = float("inf")
    for _ in range(3):
        begun = time.perf_counter()
        simulate(settings)
        best = min(best, time.perf_counter() - begun)
    return best


def main() -> int:
    """0 if the cost grows at most linearly and both tables together stay under 20 s."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--steps", type=int, default=5000)
    steps = parser.parse_args().steps
    print("runs   batch, s   ms per simulated s")
    good, before = True, 0.0
    for runs in RUNS:
        took = batch_s(runs, steps)
        linear = before == 0.0 or took <= 2.0 * NOISE * before
        good, before = good and linear, took
        cost_ms = 1000.0 * took / (runs * steps * 0.001)
        print(f"{runs:>4} {took:>10.3f} {cost_ms:>12.3f}{'' if linear else '   MORE THAN LINEAR'}")
    total = 0.0
    for study in simulated_studies():
        if study.name in {"table6", "table7"}:
            begun = time.perf_counter()
            outcome = study.run(study.settings_model(), lambda share, what: None)
            took = time.perf_counter() - begun
            total += took
            print(f"{study.name}: {took:.1f} s, {outcome.cost_ms_per_simulated_s:.2f} ms per simulated s")
    print(f"both tables: {total:.1f} s (bound 20 s)")
    return 0 if good and total < 20.0 else 1


if __name__ == "__main__":
    sys.exit(main())
