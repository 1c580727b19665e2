"""How often `tdhil trend` sees a change that is there, and one that isn't: 200 simulated histories of each kind.

    python benchmarks/trend_power.py [--histories 200] [--results 24]

A result is drawn from its interval: repeatability 0.3 to 0.8 % (1 sd), and the torque scale of the rig's drive, 3 %,
once for each history. Steps come at a place drawn evenly, drifts go over the whole history. ``scatter``: by how much
the true scatter exceeds what the intervals say.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from tdhil.fleet.change_detection import difference, history
from tests.fleet.drawn_histories import KINDS, draw


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--histories", type=int, default=200)
    parser.add_argument("--results", type=int, default=24)
    asked = parser.parse_args()
    print("history      scatter   changed  as what: step, drift   place within 1   size's interval covers")
    for scatter in (1.0, 0.6, 1.5):
        for kind, size in KINDS.items():
            rng = np.random.default_rng([17, list(KINDS).index(kind), round(10 * scatter)])
            seen, steps, drifts, placed, covered, sized = 0, 0, 0, 0, 0, 0
            for _ in range(asked.histories):
                results, at = draw(rng, kind, asked.results, scatter)
                found = history(results)
                seen += found.changed
                drifts += found.drift_change is not None
                steps += bool(found.changes)
                if kind.startswith("step") and len(found.changes) == 1:
                    (one,) = found.changes
                    placed += abs(one.at - at) <= 1
                    sized += 1
                    covered += one.change.low <= size <= one.change.high
            n = asked.histories
            print(f"{kind:12} {scatter:7.1f}   {seen / n:6.1%}   {steps / n:6.1%} {drifts / n:6.1%}"
                  + (f"   {placed / n:15.1%}   {covered}/{sized}" if kind.startswith("step") else ""))
    rng = np.random.default_rng(5)
    hits = 0
    for _ in range(asked.histories):
        results, at = draw(rng, "step 2 %", asked.results)
        told = difference(results[at - 1], results[at])
        hits += told.low <= 0.02 <= told.high
    print(f"difference of the two results beside a step of 2 %: its interval covers in {hits / asked.histories:.1%}")


if __name__ == "__main__":
    main()
