"""Numbers in estimation and runner state their unit, meaning or source.

`tests/packaging/constants.py` has the rule, and lists the numbers when it is run.
"""

from __future__ import annotations

import pytest

from tests.packaging.constants import ROOT, bare_constants, in_folder

FOLDERS = ("tdhil/estimation", "tdhil/runner")

def test_no_number_is_without_an_explanation():
    assert [str(one) for folder in FOLDERS for one in in_folder(ROOT / folder)] == []


@pytest.mark.parametrize(("source", "names"), [
    ("A = 1.0\n", ["A"]), ("A = 1.0   # s\n", []), ('A = 1.0\n"""A time, s."""\n', []),
    ("_A, B = -1, 2.5\n", ["_A, B"]), ('A = (1, 2)\nB = 2.0\n"""s."""\n', ["A"]),
    ("A = True\nB = 'x'\nC = f(1)\n", []), ("A: float = 2 * 3.0\n", ["A"]),
    ("A = 1.0  # noqa: PLR2004\n", ["A"]), ("A = 1.0  # noqa: PLR2004  # s\n", []), ("A = 1.0  #\n", ["A"]),
])
def test_rule_for_numbers_without_an_explanation(tmp_path, source, names):
    path = tmp_path / "module.py"
    path.write_text(source)
    assert [one.names for one in bare_constants(path)] == names
