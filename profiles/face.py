"""A package's face: the names that others may take from it, each loaded when it is taken.

So a face may name what is heavy (scipy, canopen, MCAP): who takes a light name from it loads a light module, and
`tdhil --help` loads next to nothing. The names stand once, as imports under ``TYPE_CHECKING``, for mypy, the import
contracts and the interpreter, which reads them there when the first is taken.
"""

import ast
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any


def lazy_face(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package (PEP 562) whose ``if TYPE_CHECKING:`` imports its face's names.

    Nothing is kept in the package: a name that is replaced in its module is the replaced one here, too.
    """

    @cache
    def homes() -> dict[str, str]:
        loader = sys.modules[package].__loader__
        source_of = getattr(loader, "get_source", None)     # importlib.abc, with the class of this protocol, loads much
        return names_by_type_checking(source_of(package) or "" if source_of else "")

    def get(name: str) -> Any:
        if name not in homes():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes()[name]), name)

    return get, lambda: sorted(homes())


def names_by_type_checking(source: str) -> dict[str, str]:
    """The name of each ``from MODULE import NAME`` under a module's ``if TYPE_CHECKING:``, with the module."""
    return {
        alias.name: imported.module or ""
        for block in ast.parse(source).body
        if isinstance(block, ast.If) and isinstance(block.test, ast.Name) and block.test.id == "TYPE_CHECKING"
        for imported in block.body
        if isinstance(imported, ast.ImportFrom)
        for alias in imported.names
    }
