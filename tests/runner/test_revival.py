"""Reported speed after a contradiction: test of whether it falls as that of a shaft under a quick stop."""

import pytest

from tdhil.runner.observer.revival import Revival


@pytest.mark.parametrize(("fall_rad_s2", "alive"), [(1.0, True), (50.0, False)])
def test_a_speed_that_falls_at_once_is_lost(fall_rad_s2, alive):
    revival = Revival(steady=True, from_s=1e9, stop_rad_s2=1.0, still_rad_s=0.01)
    for k in range(60):
        revival.see(0.1 * k, max(0.0, 5.0 - fall_rad_s2 * 0.1 * max(0, k - 5)))
    assert revival.alive is revival.falling is alive
