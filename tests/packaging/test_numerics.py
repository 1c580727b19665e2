"""Settings of numpy and scipy in processes of tdhil (`tdhil.numerics`)."""

import json
import os
import subprocess
import sys

import pytest

from tdhil.numerics import LOADED_WHEN_USED, ONE_THREAD

PROGRAM = """
import json, os, sys
from tdhil.numerics import prepare
prepare()
prepare()
import numpy, scipy.special
heavy = [name for name in ("numpy.f2py.crackfortran", "numpy.testing._private.utils") if name in sys.modules]
used = numpy.f2py.get_include()
numpy.testing.assert_allclose(scipy.special.ndtr(0.0), 0.5)
import scipy.stats, scipy.optimize, scipy.interpolate
print(json.dumps({"heavy": heavy, "include": used, "loaded": "numpy.testing._private.utils" in sys.modules,
                  "threads": {name: os.environ.get(name) for name in sys.argv[1:]}}))
"""


def prepared(**variables: str) -> dict:
    free = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *ONE_THREAD], env=free | variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.heavy
def test_unused_parts_are_loaded_at_their_first_use_and_work_then():
    found = prepared()
    assert found["heavy"] == []
    assert found["include"].endswith("src")
    assert found["loaded"]
    assert found["threads"] == ONE_THREAD


@pytest.mark.heavy
def test_the_number_of_threads_set_by_the_operator_is_kept():
    assert prepared(OMP_NUM_THREADS="3")["threads"] == ONE_THREAD | {"OMP_NUM_THREADS": "3"}


def test_the_packages_exist():
    from importlib.util import find_spec

    assert all(find_spec(name) is not None for name in LOADED_WHEN_USED)
