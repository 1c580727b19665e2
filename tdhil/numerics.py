"""Settings of numpy and scipy for a process of tdhil's own, made before either is loaded (decision 0031).

Linear algebra has one thread: the matrices of an identification are small, so that a second thread only waits. Also,
sums are added in the same order on any machine.

Some packages are loaded at their first use. scipy's array-API layer takes every public name of numpy, `numpy.f2py` and
`numpy.testing` among them. tdhil uses neither, and they are a third of the time that scipy takes to load.
"""

import os
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Final

ONE_THREAD: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment variables of a process that computes on one thread."""
LOADED_WHEN_USED: Final = frozenset({"numpy.f2py", "numpy.testing"})
"""Packages that the import of scipy loads and that tdhil does not use."""


class _Deferring:
    """Import finder that loads the modules of `LOADED_WHEN_USED` at the first use of an attribute."""

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a module of `LOADED_WHEN_USED`, with a lazy loader; None for any other module."""
        if name not in LOADED_WHEN_USED:
            return None
        from importlib.util import LazyLoader

        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
        return spec


def prepare() -> None:
    """Set up this process. Variables that the operator has set in the environment keep their values."""
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)
    if _Deferring not in sys.meta_path:
        sys.meta_path.insert(0, _Deferring)
