"""Fixtures that simulate the two published designs once."""

import pytest


@pytest.fixture(scope="session")
def table6():
    from tests.studies.simulated_runs import run

    return run("table6")


@pytest.fixture(scope="session")
def table7():
    from tests.studies.simulated_runs import run

    return run("table7")
