"""What `benchmarks/mutate_guard.py` changes is there under the names that it has: a stale one would change nothing."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest

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
        tree = ast.parse((ROOT / subject.path).read_text(encoding="utf-8"))
        names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        names |= {
            name.id for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)
            for name in ast.walk(node) if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
        }
        assert subject.within <= names, subject.path
        assert all((ROOT / "tests" / test).exists() for test in subject.tests), subject.path


def test_every_line_to_be_changed_stands_where_it_is_looked_for(mutants):
    for subject, before, _ in mutants.NAMED:
        assert before in (ROOT / mutants.SUBJECTS[subject].path).read_text(encoding="utf-8"), (subject, before)
