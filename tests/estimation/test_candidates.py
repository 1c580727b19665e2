"""Table of candidates: each row is tried in its order, and has a test that fails without it."""

import ast
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from tdhil.estimation import candidates, periodic
from tdhil.estimation.candidates import CANDIDATES, CandidateModel, FitRoute, ModelTrial, rows, walk
from tdhil.estimation.frequency_domain import compliant
from tdhil.estimation.time_domain import solve

ROOT = Path(__file__).parents[2]
TRIALS = {
    FitRoute.LINES: periodic._TRIALS,
    FitRoute.LOAD: compliant._TRIALS,
    FitRoute.RECORD: solve._BAND_TRIALS,
    FitRoute.BAND: solve._FRICTION_TRIALS,
}


@pytest.mark.parametrize("route", FitRoute, ids=lambda route: route.name)
def test_each_route_has_a_trial_for_each_of_its_rows(route):
    assert set(TRIALS[route]) == {row.name for row in rows(route)}


def test_each_row_is_complete_and_has_its_own_name():
    assert len({row.name for row in CANDIDATES}) == len(CANDIDATES)
    for row in CANDIDATES:
        assert all(str(value).strip() for value in vars(row).values()), row.name


@pytest.mark.parametrize("row", CANDIDATES, ids=lambda row: row.name)
def test_the_test_of_each_row_exists(row):
    path, _, name = row.test.partition("::")
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@dataclass(frozen=True)
class Tried:
    names: tuple[str, ...] = ()
    ended: bool = field(default=False)


def _row(name):
    return CandidateModel(name, FitRoute.LOAD, *("-" for _ in range(8)))


def _trial(name, applies=True, ends=False):
    return ModelTrial(lambda now: applies, lambda now: replace(now, names=(*now.names, name), ended=ends))


def test_rows_are_tried_in_the_order_of_the_table_up_to_the_last(monkeypatch):
    monkeypatch.setattr(candidates, "CANDIDATES", (_row("a"), _row("b"), _row("c"), _row("d")))
    trials = {"d": _trial("d"), "c": _trial("c", ends=True), "b": _trial("b", applies=False), "a": _trial("a")}
    assert walk(FitRoute.LOAD, trials, Tried()).names == ("a", "c")
    assert walk(FitRoute.LINES, trials, Tried()).names == ()
    with pytest.raises(KeyError):
        walk(FitRoute.LOAD, {"a": _trial("a")}, Tried())
