"""Histories of a rig: results drawn from their intervals, with a step, a drift or no change."""

import numpy as np

from tdhil.fleet.change_detection import Measured

KINDS = {"none": 0.0, "step 1 %": 0.01, "step 2 %": 0.02, "step 5 %": 0.05, "drift 2 %": 0.02, "drift 5 %": 0.05,
         "ends 2 %": 0.02, "ends 5 %": 0.05}
"""Kinds of histories with the size of their change. ``ends``: a change that ends after a third of the results."""


def draw(rng: np.random.Generator, kind: str, results: int, scatter: float = 1.0) -> tuple[list[Measured], int]:
    """Return one history and the position of its step."""
    size, at = KINDS[kind], int(rng.integers(3, results - 2))
    scale = 1.0 + 0.03 * rng.standard_normal()
    found = []
    for k in range(results):
        share = (k >= at) if kind.startswith("step") else k / (results - 1)
        if kind.startswith("ends"):
            share = results // 3 <= k < 2 * results // 3
        sd = rng.uniform(0.003, 0.008)
        value = 104.0 * scale * (1.0 + size * share) * float(np.exp(scatter * sd * rng.standard_normal()))
        wide = np.exp(1.96 * sd)
        found.append(Measured(value, value / wide, value * wide, 0.95, 0.03, "drive", 7.0 * k))
    return found, at
