"""Shares of the heavy cases: each case is in one share, and some cases are in every share."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CASES = """
import pytest

@pytest.mark.parametrize("number", range(20))
def test_quick(number):
    pass

@pytest.mark.heavy
@pytest.mark.parametrize("number", range(20))
def test_heavy(number):
    pass

@pytest.mark.heavy(each_share=True)
def test_in_each():
    pass

@pytest.mark.long
def test_long():
    pass
"""


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shares")
    (folder / "conftest.py").write_text((Path(__file__).parents[1] / "conftest.py").read_text())
    (folder / "pytest.ini").write_text("[pytest]\nmarkers =\n    heavy\n    long\n")
    (folder / "test_cases.py").write_text(CASES)

    def ask(*options: str) -> tuple[int, list[str]]:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "--collect-only", "-p", "no:cacheprovider", *options, folder],
            cwd=folder, env=os.environ | {"COLUMNS": "80"}, capture_output=True, text=True, timeout=300)
        return done.returncode, [line.partition("::")[2] for line in done.stdout.splitlines() if "::" in line]

    return ask


@pytest.mark.heavy
def test_a_case_is_in_one_share_and_some_are_in_each(collected):
    whole = collected("--heavy")[1]
    shares = [collected("--heavy", "--share", f"{one}/3")[1] for one in (1, 2, 3)]
    assert len(whole) == 21
    assert all("test_in_each" in one and 2 <= len(one) < 21 for one in shares)
    assert sorted(name for one in shares for name in one) == sorted([*whole, "test_in_each", "test_in_each"])
    assert len(collected("--all-but-long", "--share", "1/3")[1]) == 20 + len(shares[0])
    assert len(collected("--share", "1/3")[1]) == 20


@pytest.mark.heavy
@pytest.mark.parametrize("text", ["0/3", "4/3", "2", "a/b", "1/0", "-1/3", ""])
def test_a_share_that_does_not_exist_is_refused(collected, text):
    assert collected("--heavy", "--share", text)[0] == 4
