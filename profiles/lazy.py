"""Public names of a package that load when they are used (PEP 562), from a table in its ``__init__.py``."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(
    package: str, table: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    ``table``: module of the package → its public names, separated by blanks. The package keeps no copy of a name, so a
    test replaces a function where it is defined.
    """
    homes = {name: f"{package}.{module}" for module, names in table.items() for name in names.split()}

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name]), name)

    return get, lambda: sorted(homes), sorted(homes)
