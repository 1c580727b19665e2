"""SIGKILL at a few of the fifty random moments; all of them: `python benchmarks/kill_at_random.py`."""

from dataclasses import replace

import pytest

from benchmarks.kill_at_random import plan_of, row, trial


@pytest.mark.heavy
@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.long), 2])   # planned in setup, speed, torque
def test_a_killed_host_leaves_a_shaft_at_rest_and_a_log(tmp_path, number):
    plan = replace(plan_of(number, seed=1, real_time=False), rate_hz=50.0)      # the quickest
    found = trial(plan, tmp_path)
    assert not found.wrong, row(found)
