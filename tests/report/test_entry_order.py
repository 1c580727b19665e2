"""Order of entry of P and I into a drive: the loop in between keeps a phase margin, by python-control."""

import numpy as np

from tdhil.report.console import ENTRY_ORDER
from tdhil.speed_loop import LoopPlant, PiGains
from tests.speed_loop.by_control import true_margins


def _margin_deg(plant: LoopPlant, gain: float, integral: float) -> float:
    found = true_margins(plant, PiGains(gain, integral))
    return found.phase_deg if found.stable else -np.inf


def test_between_the_entries_the_loop_keeps_the_smaller_phase_margin_of_both_pairs() -> None:
    rng = np.random.default_rng(57)
    worst = np.inf
    for _ in range(30):
        plant = LoopPlant(float(rng.uniform(50.0, 2000.0)), lags_s=tuple(rng.uniform(0.003, 0.03, 2)),
                          dead_time_s=0.003)
        pairs = []
        while len(pairs) < 2:
            gain = plant.inertia_kg_m2 * float(np.exp(rng.uniform(np.log(0.2), np.log(15.0))))
            integral = gain**2 / plant.inertia_kg_m2 * float(rng.uniform(0.02, 0.5))
            if _margin_deg(plant, gain, integral) >= 30.0:
                pairs.append((gain, integral))
        present, new = pairs
        both = min(_margin_deg(plant, *pair) for pair in pairs)
        right, other = (present[0], new[1]), (new[0], present[1])
        if new[1] > present[1]:
            right, other = other, right
        assert _margin_deg(plant, *right) >= both - 0.1
        worst = min(worst, _margin_deg(plant, *other))
    assert worst < 15.0, "the order matters"


def test_the_sentence_names_this_order() -> None:
    assert ENTRY_ORDER.startswith("If I becomes smaller, type it in first; otherwise type in P first.")
