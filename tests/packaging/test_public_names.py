"""A package's `__init__.py` lists its public names. A name with a leading underscore is private to its module."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType

import pytest

from profiles import lazy_names

ROOT = Path(__file__).parents[2]
ROOMS = ("tdhil", "drivers", "sim_bus", "profiles")
PACKAGES = {
    ".".join(path.parent.relative_to(ROOT).parts): path for room in ROOMS for path in (ROOT / room).rglob("__init__.py")
}
LAZY = sorted(package for package, path in PACKAGES.items() if "lazy_names(__name__" in path.read_text("utf-8"))
# Modules whose names are clear only with the module, and the main modules of processes.
OPEN = {"profiles.quantities", "profiles.canopen", "profiles.cia402", "profiles.ethercat", "profiles.modbus",
        "drivers.undo_journal", "drivers.own_limits", "tdhil.session.real_time", "tdhil.cli.main"}


IMPORT = re.compile(rf"^ *from ((?:{'|'.join(ROOMS)})(?:\.\w+)*) import (\([^)]*\)|.*)", re.MULTILINE)


def imports(path: Path) -> list[tuple[ast.ImportFrom, bool]]:
    """Yield each import from tdhil's packages, and whether only mypy sees it."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    typed = {id(inner) for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
             for one in node.body for inner in ast.walk(one)}
    return [(node, id(node) in typed) for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in ROOMS]


@pytest.mark.parametrize("package", LAZY)
def test_mypy_and_python_have_the_same_names(package):
    module = import_module(package)
    shown = {one.name: node.module for node, typed in imports(PACKAGES[package]) if typed for one in node.names}
    assert sorted(shown) == module.__all__ == dir(module)
    assert all(getattr(module, name) is getattr(import_module(home), name) for name, home in shown.items())


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_no_public_name_is_a_module_of_its_package(package):
    # Once loaded, a module becomes an attribute of its package. The name would be ambiguous.
    names = {one.asname for node, _ in imports(PACKAGES[package]) for one in node.names}
    assert names.isdisjoint(module.name for module in iter_modules([str(PACKAGES[package].parent)]))


def test_a_package_is_imported_by_its_public_names():
    past, private = [], []
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            inside = ".".join(path.parent.relative_to(ROOT).parts)
            for module, names in IMPORT.findall(path.read_text(encoding="utf-8")):
                private += [f"{path.relative_to(ROOT)}: {module}" for name in re.findall(r"\w+", names)
                            if name.startswith("_") and not name.startswith("__")]
                package = module.rpartition(".")[0]
                if module not in PACKAGES and module not in OPEN and not f"{inside}.".startswith(f"{package}."):
                    past.append(f"{path.relative_to(ROOT)}: {module}")
    assert (past, private) == ([], [])


def test_a_name_is_loaded_when_it_is_used(monkeypatch):
    behind = ModuleType("a_package.behind")
    behind.answer = 41
    monkeypatch.setitem(sys.modules, "a_package.behind", behind)
    get, listed, public = lazy_names("a_package", {"behind": "answer"})
    assert listed() == public == ["answer"]
    assert get("answer") == 41
    monkeypatch.setattr(behind, "answer", 42)      # replaced at its definition: the package has no copy
    assert get("answer") == 42
    with pytest.raises(AttributeError, match="module 'a_package' has no attribute 'question'"):
        get("question")


def test_estimation_loads_neither_drives_nor_files():
    # The import contract cannot check which names of a package are used.
    script = (
        "import sys, tdhil.estimation\n"
        "print(*sorted({'drivers', 'sim_bus', 'can', 'canopen', 'mcap', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr
