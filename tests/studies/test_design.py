"""Orthogonal arrays: true ones are accepted, nearly orthogonal ones are refused with the place."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tdhil.studies.paper.orthogonal_design import DesignSettings, Factor, fault_of, shipped_arrays

TABLE5 = [
    (1, 1, 1, 1), (1, 2, 2, 2), (1, 3, 3, 3), (2, 1, 2, 3), (2, 2, 3, 1), (2, 3, 1, 2), (3, 1, 3, 2), (3, 2, 1, 3),
    (3, 3, 2, 1),
]
TABLE3 = [
    (1, 1, 1, 1, 1), (1, 2, 2, 2, 2), (1, 3, 3, 3, 3), (1, 4, 4, 4, 4),
    (2, 1, 2, 3, 4), (2, 2, 1, 4, 3), (2, 3, 4, 1, 2), (2, 4, 3, 2, 1),
    (3, 1, 3, 4, 2), (3, 2, 4, 3, 1), (3, 3, 1, 2, 4), (3, 4, 2, 1, 3),
    (4, 1, 4, 2, 3), (4, 2, 3, 1, 4), (4, 3, 2, 4, 1), (4, 4, 1, 3, 2),
]


def test_the_shipped_arrays_are_those_of_tables_3_and_5():
    assert [tuple(row) for row in shipped_arrays()["L9"]] == TABLE5
    assert [tuple(row) for row in shipped_arrays()["L16"]] == TABLE3
    assert fault_of(TABLE5) is None
    assert fault_of(TABLE3) is None


def test_run_16_as_printed_would_break_the_array():
    printed = [*TABLE3[:-1], (4, 3, 1, 3, 2)]
    assert "column 2" in fault_of(printed)


@st.composite
def linear_arrays(draw):
    """Generate arrays by Bose's construction over a prime p, columns i, j, i + j, … i + (p − 1)j of all (i, j)."""
    prime = draw(st.sampled_from([2, 3, 5]))
    columns = draw(st.integers(2, prime + 1))
    pairs = product(range(prime), repeat=2)
    rows = [(i, j, *((i + k * j) % prime for k in range(1, prime)))[:columns] for i, j in pairs]
    names = [draw(st.permutations(range(1, prime + 1))) for _ in range(columns)]
    rows = [tuple(name[level] for name, level in zip(names, row, strict=True)) for row in rows]
    return draw(st.permutations(rows))


@given(linear_arrays())
def test_any_orthogonal_array_passes(rows):
    assert fault_of(rows) is None


@given(linear_arrays(), st.data())
def test_one_changed_level_is_found(rows, data):
    run, column = data.draw(st.integers(0, len(rows) - 1)), data.draw(st.integers(0, len(rows[0]) - 1))
    other = data.draw(st.sampled_from(sorted({row[column] for row in rows} - {rows[run][column]})))
    spoilt = [list(row) for row in rows]
    spoilt[run][column] = other
    assert f"column {column + 1}" in fault_of(spoilt) or "levels must be numbered" in fault_of(spoilt)


@given(linear_arrays())
def test_a_column_twice_is_found(rows):
    assert "columns 1 and" in fault_of([(*row, row[0]) for row in rows])


@given(st.lists(st.integers(2, 4), min_size=1, max_size=3))
def test_every_full_factorial_is_orthogonal(levels):
    assert fault_of(list(product(*(range(1, count + 1) for count in levels)))) is None


@pytest.mark.parametrize(("rows", "words"), [
    ([], "empty"),
    ([()], "empty"),
    ([(1, 1), (2,)], "run 2 has 1 columns where run 1 has 2"),
    ([(1,), (3,)], "numbered"),
    ([(1,), (1,)], "two at least"),
    ([(1,), (2,), (2,)], "level 2 twice and 1 once"),
    ([(1, 1), (2, 2)], "columns 1 and 2 have levels (1, 1) once and (1, 2) never"),
    ([(1,), (2,)] * 400, "800 runs"),
])
def test_faults_in_words(rows, words):
    fault = fault_of(rows)
    assert fault is not None
    if words.startswith("columns 1 and 2"):
        assert "columns 1 and 2" in fault
        assert "never" in fault
    else:
        assert words in fault


def design(**changes):
    values = {"array": ((1, 1), (1, 2), (2, 1), (2, 2)),
              "factors": (Factor(name="Kp", levels=(1000.0, 2000.0)), Factor(name="frequency_hz", levels=(0.5, 1.0)))}
    return DesignSettings(**(values | changes))


def test_runs_follow_from_array_and_factors_by_name_or_symbol():
    runs = design(inertia_kg_m2=500.0).runs()
    assert [(run.kp_nm_s_rad, run.frequency_hz) for run in runs] == [(1000, 0.5), (1000, 1.0), (2000, 0.5), (2000, 1.0)]
    assert {run.inertia_kg_m2 for run in runs} == {500.0}


def test_fewer_factors_than_columns_use_the_first_columns():
    settings = DesignSettings(array="L9", factors=(Factor(name="B", levels=(10.0, 50.0, 100.0)),))
    assert [run.viscous_nm_s_rad for run in settings.runs()] == [10] * 3 + [50] * 3 + [100] * 3


@pytest.mark.parametrize(("changes", "words"), [
    ({"factors": ()}, "at least one factor"),
    ({"factors": (Factor(name="colour", levels=(1.0, 2.0)),)}, "no factor 'colour'"),
    ({"factors": (Factor(name="duration_s", levels=(1.0, 2.0)),)}, "no factor 'duration_s'"),
    ({"factors": (Factor(name="Kp", levels=(1.0, 2.0)), Factor(name="kp_nm_s_rad", levels=(1.0, 2.0)))}, "already"),
    ({"factors": (Factor(name="Kp", levels=(1.0, 2.0, 3.0)),)}, "needs 2 different levels"),
    ({"factors": (Factor(name="Kp", levels=(1.0, 1.0)),)}, "needs 2 different levels"),
    ({"factors": (Factor(name="Kp", levels=(1.0, -1.0)),)}, "run 3"),
    ({"factors": tuple(Factor(name=name, levels=(1.0, 2.0)) for name in ("Kp", "Ki", "B"))}, "3 factors for the 2"),
    ({"array": "L8"}, "no array 'L8'"),
    ({"array": ((1, 1), (1, 2), (2, 1), (2, 1))}, "not orthogonal"),
])
def test_an_impossible_design_is_refused(changes, words):
    with pytest.raises(ValidationError) as caught:
        design(**changes)
    assert words in str(caught.value)
