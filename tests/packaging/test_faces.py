"""A package's face says what others may take from it, in one place for the interpreter, mypy and the contracts."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import module_from_spec
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType

import pytest

from profiles import lazy_face
from profiles.face import names_by_type_checking

ROOT = Path(__file__).parents[2]
# The stable API at the front door.
WITHOUT = {"tdhil"}
PACKAGES = {
    ".".join(path.parent.relative_to(ROOT).parts): path
    for root in ("tdhil", "drivers", "sim_bus", "profiles")
    for path in sorted((ROOT / root).rglob("__init__.py"))
}


def test_every_package_is_held_by_a_contract():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    held = {
        contract["protected_modules"][0].removesuffix(".*"): contract["allowed_importers"][0]
        for contract in contracts
        if contract["type"] == "protected"
    }
    assert held == {package: package for package in PACKAGES if package not in WITHOUT}


def test_a_name_is_loaded_when_it_is_taken(monkeypatch, tmp_path):
    face = tmp_path / "__init__.py"
    face.write_text(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n"
        "    from a_package.behind import answer as answer\n"
    )
    behind = ModuleType("a_package.behind")
    behind.answer = 41
    loader = SourceFileLoader("a_package", str(face))
    monkeypatch.setitem(sys.modules, "a_package", module_from_spec(ModuleSpec("a_package", loader, is_package=True)))
    monkeypatch.setitem(sys.modules, "a_package.behind", behind)
    get, listed = lazy_face("a_package")
    assert listed() == ["answer"]
    assert get("answer") == 41
    monkeypatch.setattr(behind, "answer", 42)      # replaced where it is defined: the face has no copy of its own
    assert get("answer") == 42
    with pytest.raises(AttributeError, match="module 'a_package' has no attribute 'question'"):
        get("question")


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_no_name_of_a_lazy_face_is_a_module_of_its_package(package):
    # Python makes a package's attribute the module once that is loaded: the name would be the one or the other.
    names = names_by_type_checking(PACKAGES[package].read_text(encoding="utf-8"))
    assert set(names).isdisjoint(module.name for module in iter_modules([str(PACKAGES[package].parent)]))


def test_estimation_loads_neither_drives_nor_files():
    # The contract can't see which of a lazy face's names are taken.
    script = (
        "import sys, tdhil.estimation\n"
        "print(*sorted({'drivers', 'sim_bus', 'can', 'canopen', 'mcap', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr
