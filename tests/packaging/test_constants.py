"""Numbers in estimation and runner state their unit, meaning or source; a ceiling by file holds what is left.

`tests/packaging/constants.py` has the rule, and lists the numbers when it is run. A ceiling is lowered when a file is
mended, never raised.
"""

from __future__ import annotations

from collections import Counter

import pytest

from tests.packaging.constants import ROOT, bare_constants, in_folder

FOLDERS = ("tdhil/estimation", "tdhil/runner")

CEILINGS = {
    "tdhil/estimation/data_checks.py": 1,
    "tdhil/estimation/frequency_domain/before_echo.py": 2,
    "tdhil/estimation/frequency_domain/compliant_fit.py": 4,
    "tdhil/estimation/frequency_domain/shafts.py": 2,
    "tdhil/estimation/frequency_domain/signal_filters.py": 3,
    "tdhil/estimation/impedance.py": 2,
    "tdhil/estimation/result.py": 2,
    "tdhil/estimation/samples.py": 1,
    "tdhil/estimation/time_domain/equation.py": 1,
    "tdhil/estimation/time_domain/fit.py": 1,
}
"""Constants without a word, by file. A file that is not here has none."""


def test_no_file_gets_more_numbers_without_a_word():
    found = Counter(one.path.relative_to(ROOT).as_posix() for folder in FOLDERS for one in in_folder(ROOT / folder))
    assert {name: (number, CEILINGS.get(name, 0)) for name, number in found.items()
            if number > CEILINGS.get(name, 0)} == {}


@pytest.mark.parametrize(("source", "names"), [
    ("A = 1.0\n", ["A"]), ("A = 1.0   # s\n", []), ('A = 1.0\n"""A time, s."""\n', []),
    ("_A, B = -1, 2.5\n", ["_A, B"]), ('A = (1, 2)\nB = 2.0\n"""s."""\n', ["A"]),
    ("A = True\nB = 'x'\nC = f(1)\n", []), ("A: float = 2 * 3.0\n", ["A"]),
])
def test_what_counts_as_a_number_without_a_word(tmp_path, source, names):
    path = tmp_path / "module.py"
    path.write_text(source)
    assert [one.names for one in bare_constants(path)] == names
