"""What `benchmarks/mutate_guard.py` changes is there under the names that it has: a stale one would change nothing."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest

from benchmarks.prepared_tests import Trace

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def mutants():
    spec = importlib.util.spec_from_file_location("mutate_guard", ROOT / "benchmarks" / "mutate_guard.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_subject_is_there_with_its_names_and_its_tests(mutants):
    for subject in mutants.SUBJECTS.values():
        assert all((ROOT / "tests" / test).exists() for test in subject.tests), subject.path
        text = (ROOT / subject.path).read_text(encoding="utf-8")
        tree = ast.parse(text if subject.within else "")
        names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        names |= {
            name.id for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)
            for name in ast.walk(node) if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
        }
        assert subject.within <= names, subject.path


def test_every_line_to_be_changed_stands_where_it_is_looked_for(mutants):
    for subject, before, _ in mutants.NAMED:
        assert before in (ROOT / mutants.SUBJECTS[subject].path).read_text(encoding="utf-8"), (subject, before)


def test_every_file_of_the_drivers_is_a_subject(mutants):
    """But the contract and the errors, whose statements are definitions."""
    here = {subject.path for subject in mutants.SUBJECTS.values()}
    others = {"drivers/drive.py", "drivers/errors.py"}
    wanted = {path.relative_to(ROOT).as_posix() for path in (ROOT / "drivers").rglob("*.py")
              if path.name != "__init__.py"}
    assert wanted - here == others


def test_a_sample_has_some_of_each_subject_and_is_the_same_again(mutants):
    drawn = mutants.sample(["angle", "clock"], 10, 1)
    assert [one.key for one in drawn] == [one.key for one in mutants.sample(["angle", "clock"], 10, 1)]
    assert [one.key for one in drawn] != [one.key for one in mutants.sample(["angle", "clock"], 10, 2)]
    counts = [sum(one.subject == subject for one in drawn) for subject in ("angle", "clock")]
    assert min(counts) >= mutants.LEAST_OF_EACH and sum(counts) <= 12


def test_a_mutant_is_its_file_without_one_statement(mutants):
    one = next(one for one in mutants.mutants("angle") if one.function)
    whole, less = (ast.unparse(tree) for tree in (ast.parse(mutants.text_of("angle")), one.tree()))
    assert len(whole.splitlines()) >= len(less.splitlines()) and whole != less
    assert less.count("pass") == whole.count("pass") + 1


def test_a_mutant_runs_the_tests_that_enter_its_function_the_quick_ones_first(mutants):
    trace = Trace(
        {"a::slow": 2.0, "a::quick": 0.1, "b::one": 0.5, "c::other": 0.01},
        {"a::slow": [7], "a::quick": [7, 9], "b": [7], "c::other": [11], "": [3]},
    )
    assert trace.tests(7) == ["a::quick", "a::slow", "b::one"]
    assert trace.tests(9) == ["a::quick"]
    assert trace.tests(13) == []
    assert trace.tests(0) == trace.tests(3) == ["c::other", "a::quick", "a::slow", "b::one"]


def test_outcomes_are_kept_and_those_not_noticed_are_run_again(mutants, tmp_path):
    out, run = tmp_path / "rows.jsonl", []

    def judged(key):
        run.append(key)
        return {"mutant": key, "noticed": key != "b"}

    def rows(keys):
        return mutants.kept_rows(out, "mutant", keys, judged, lambda row: None)

    rows(["a", "b"])
    assert [row["mutant"] for row in rows(["a", "b", "c"])] == ["a", "b", "c"] == run
    mutants.drop_rows(out, lambda row: not row["noticed"])
    rows(["a", "b", "c"])
    assert run == ["a", "b", "c", "b"]
