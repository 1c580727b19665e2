"""Makes the helpers beside these tests importable, and simulates the two published designs once."""

import sys
from pathlib import Path

import pytest

HERE = str(Path(__file__).parent)
if HERE not in sys.path:
    sys.path.insert(0, HERE)


@pytest.fixture(scope="session")
def table6():
    from simulated_runs import run

    return run("table6")


@pytest.fixture(scope="session")
def table7():
    from simulated_runs import run

    return run("table7")
