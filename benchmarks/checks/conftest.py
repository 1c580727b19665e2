"""Gives the checks of the benchmarks the options and markers of the tests, if only these checks run."""

import sys

if "tests.conftest" not in sys.modules:
    from tests.conftest import *  # noqa: F403
