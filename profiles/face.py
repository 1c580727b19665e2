"""A package's face: the names that others may take from it, each loaded when it is taken.

So a face may name what is heavy (scipy, canopen, MCAP): who takes a light name from it loads a light module, and
`tdhil --help` loads next to nothing. The table stands beside the same imports under ``TYPE_CHECKING``, for mypy and the
import contracts; a test holds the two together.
"""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def lazy_face(
    package: str, names_by_module: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package (PEP 562), by its modules and the names that each of them gives.

    Nothing is kept in the package: a name that is replaced in its module is the replaced one here, too.
    """
    homes = {name: f"{package}.{module}" for module, names in names_by_module.items() for name in names}

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name]), name)

    return get, lambda: sorted(homes)
