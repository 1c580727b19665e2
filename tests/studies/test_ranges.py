"""Range analysis, compared with a case by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdhil.studies.paper.orthogonal_design import is_saturated, main_effects, ranking, runs_from_means, shipped_arrays

L4 = [(1, 1, 1), (1, 2, 2), (2, 1, 2), (2, 2, 1)]


def test_by_hand():
    """Runs 10, 14, 20, 36 have the means 12|28, 15|25, 23|17 and the ranges 16, 10, 6."""
    effects = main_effects(L4, [10.0, 14.0, 20.0, 36.0])
    assert [effect.means for effect in effects] == [(12.0, 28.0), (15.0, 25.0), (23.0, 17.0)]
    assert [effect.range for effect in effects] == [16.0, 10.0, 6.0]
    assert ranking([effect.range for effect in effects]) == (1, 2, 3)
    assert ranking([2.0, 5.0, 2.0]) == (2, 1, 3)


@given(st.lists(st.floats(-1e3, 1e3), min_size=9, max_size=9))
def test_a_saturated_array_reproduces_its_runs(runs):
    rows = shipped_arrays()["L9"]
    means = [effect.means for effect in main_effects(rows, runs)]
    assert np.allclose(runs_from_means(rows, means), runs, atol=1e-9)


def test_an_unsaturated_array_does_not():
    assert is_saturated(L4)
    assert is_saturated(shipped_arrays()["L16"])
    rows = [row[:2] for row in L4]
    assert not is_saturated(rows)
    with pytest.raises(ValueError, match="saturated"):
        runs_from_means(rows, [(1.0, 2.0), (1.0, 2.0)])
