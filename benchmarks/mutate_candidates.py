"""Leaves out one row of the table of candidates after the other: the test that the row names must fail without it.

    python benchmarks/mutate_candidates.py                    # all rows; 1 if a test passes without its row
    python benchmarks/mutate_candidates.py "known pipe"       # rows by their names

Each test first runs with the whole table, where it must pass. Each run is a process of its own.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tdhil.estimation.candidates import CANDIDATES, CandidateModel

ROOT = Path(__file__).resolve().parents[1]
_RUN = """
import sys, pytest
from tdhil.estimation import candidates
candidates.CANDIDATES = tuple(row for row in candidates.CANDIDATES if row.name != sys.argv[2])
sys.exit(pytest.main([sys.argv[1], "--long", "-q", "-x", "-p", "no:cacheprovider"]))
"""
_PASSED, _FAILED = 0, 1      # exit codes of pytest


def code_of(row: CandidateModel, left_out: str) -> int:
    """Run the row's test and return pytest's exit code; ``left_out``: name of a row, or empty."""
    done = subprocess.run([sys.executable, "-c", _RUN, row.test, left_out], cwd=ROOT, capture_output=True, check=False)
    return done.returncode


def main() -> int:
    """Return 0 if each test passes with its row and fails without it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("rows", nargs="*", help="names of rows; default: all")
    asked = parser.parse_args()
    wrong = 0
    for row in CANDIDATES:
        if asked.rows and row.name not in asked.rows:
            continue
        with_row, without = code_of(row, ""), code_of(row, row.name)
        good = (with_row, without) == (_PASSED, _FAILED)
        wrong += not good
        print(f"{row.name:<32}{'fails without it' if good else f'with {with_row}, without {without}'}", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
