"""A package's face says what others may take from it, in one place for the interpreter, mypy and the contracts."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from profiles import lazy_face

ROOT = Path(__file__).parents[2]
# The stable API at the front door, and both halves of each bus, in folders of their rooms.
WITHOUT = {"tdhil", "tdhil.cli.buses", "tdhil.session.buses"}
PACKAGES = {
    ".".join(path.parent.relative_to(ROOT).parts): path
    for root in ("tdhil", "drivers", "sim_bus", "profiles")
    for path in sorted((ROOT / root).rglob("__init__.py"))
}


def table(tree: ast.Module) -> set[tuple[str, str]]:
    """What the interpreter finds: (module, name)."""
    return {
        (module, name)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "lazy_face"
        for module, names in ast.literal_eval(node.args[1]).items()
        for name in names
    }


def typed(package: str, tree: ast.Module) -> set[tuple[str, str]]:
    """What mypy and the contracts find: (module, name)."""
    return {
        (str(imported.module).removeprefix(f"{package}."), alias.name)
        for node in tree.body
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for imported in node.body
        if isinstance(imported, ast.ImportFrom)
        for alias in imported.names
    }


@pytest.mark.parametrize("package", PACKAGES)
def test_a_lazy_face_is_the_same_for_mypy_and_for_the_interpreter(package):
    tree = ast.parse(PACKAGES[package].read_text(encoding="utf-8"))
    if package != "tdhil":
        assert table(tree) == typed(package, tree)


def test_every_package_is_held_by_a_contract():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    held = {
        contract["protected_modules"][0].removesuffix(".*"): contract["allowed_importers"][0]
        for contract in contracts
        if contract["type"] == "protected"
    }
    assert held == {package: package for package in PACKAGES if package not in WITHOUT}


def test_a_name_is_loaded_when_it_is_taken(monkeypatch):
    behind = ModuleType("a_package.behind")
    behind.answer = 41
    get, listed = lazy_face("a_package", {"behind": ("answer",)})
    assert listed() == ["answer"]
    monkeypatch.setitem(sys.modules, "a_package", ModuleType("a_package"))
    monkeypatch.setitem(sys.modules, "a_package.behind", behind)
    assert get("answer") == 41
    monkeypatch.setattr(behind, "answer", 42)      # replaced where it is defined: the face has no copy of its own
    assert get("answer") == 42
    with pytest.raises(AttributeError, match="module 'a_package' has no attribute 'question'"):
        get("question")


def test_estimation_loads_neither_drives_nor_files():
    # The contract can't see which of a lazy face's names are taken.
    script = (
        "import sys, tdhil.estimation\n"
        "print(*sorted({'drivers', 'sim_bus', 'can', 'canopen', 'mcap', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr
