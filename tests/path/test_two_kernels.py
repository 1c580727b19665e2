"""Replay on another kind of processor: equal to 1e-9. On the same computer: bit for bit.

OpenBLAS selects its kernels by the processor or by a setting. The tests use the setting as another kind of processor.
"""

import json
import platform
import subprocess
import sys

import numpy as np
import pytest

from tests.path.path_runs import QUICK, clean_environment, identify

OTHER = {"x86_64": "Prescott", "AMD64": "Prescott", "aarch64": "ARMV8", "arm64": "ARMV8"}
"""Oldest kernels of OpenBLAS for a kind of processor."""


def same(one, other, where=""):
    """Return whether all values are equal, and floats agree to a relative 1e-9."""
    assert type(one) is type(other), where
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for name in one:
            same(one[name], other[name], f"{where}.{name}")
    elif isinstance(one, list):
        assert len(one) == len(other), where
        for number, (a, b) in enumerate(zip(one, other, strict=True)):
            same(a, b, f"{where}[{number}]")
    elif isinstance(one, float):
        assert one == pytest.approx(other, rel=1e-9, abs=1e-12), where
    else:
        assert one == other, where


def replayed(log, **environment):
    done = subprocess.run([sys.executable, "-m", "tdhil", "replay", "--json", str(log)], capture_output=True,
                          env=clean_environment() | environment, check=True)
    return done.stdout


@pytest.mark.long        # CI runs the tests of estimation under other kernels
def test_a_replay_under_other_kernels(tmp_path):
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    if "openblas" not in blas["name"] or "DYNAMIC_ARCH" not in blas.get("openblas configuration", ""):
        pytest.skip(f"the linear algebra here is {blas['name']}, whose kernels cannot be chosen")
    if platform.machine() not in OTHER:
        pytest.skip(f"no other kernels are known for {platform.machine()}")
    live = identify(tmp_path, "--simulate", *QUICK, "--seed", 3, "--periods", 3)
    here, again = replayed(live.log), replayed(live.log)
    there = replayed(live.log, OPENBLAS_CORETYPE=OTHER[platform.machine()])
    assert here == again
    same(json.loads(here), live.document)
    same(json.loads(here), json.loads(there))
