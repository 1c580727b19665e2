"""benchmarks/against_peers.py is fair: what ours is held against finds the inertia where nothing stands in its way."""

import numpy as np
import pytest

from benchmarks.against_peers import PEERS, Row, Trace, table


def rigid(inertia):
    """A shaft of 3 N·m·s/rad and 20 N·m without any filter, 100 Hz."""
    t = np.arange(6000) * 0.01
    lines = [(0.05, 0.8), (0.13, 0.5), (0.31, 0.4), (0.7, 0.2)]
    speed = 5.0 + sum(a * np.sin(2.0 * np.pi * f * t) for f, a in lines)
    alpha = sum(2.0 * np.pi * f * a * np.cos(2.0 * np.pi * f * t) for f, a in lines)
    rng = np.random.default_rng(1)
    torque = inertia * alpha + 3.0 * speed + 20.0
    return Trace(t, speed + 1e-5 * rng.standard_normal(len(t)), torque + 0.1 * rng.standard_normal(len(t)))


@pytest.mark.parametrize("name", [name for name in PEERS if not name.startswith("SIPPY")])
def test_a_rigid_shaft_without_filters_is_found(name):
    answer = PEERS[name](rigid(40.0))
    assert answer.inertia == pytest.approx(40.0, rel=0.02)
    if name == "least squares":
        assert answer.low < answer.inertia < answer.high


def test_the_table():
    rows = [Row("ours", 1, "plain", "ramps", error, half, abs(error) <= half, "", 0.5)
            for error, half in ((0.01, 0.02), (-0.03, 0.02), (np.nan, np.nan))]
    rows.append(Row("theirs", 1, "plain", "ramps", 0.2))
    assert list(table(rows))[2:] == [
        "| ours | 2 % | 2.8 % | 33.3 % | 2 % | 50.0 % | 0.50 |", "| theirs | 20 % | 20 % | 0.0 % | – | – | 0.00 |"]
