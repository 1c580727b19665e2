"""Every name that a test imports from tdhil's modules, or replaces in one, exists.

CI of a commit runs one of nine shares of the heavy cases (decision 0061), so a moved name would be found late.
"""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("tdhil", "drivers", "sim_bus", "profiles")


def imported(tree: ast.Module) -> dict[str, object]:
    """Return the modules and classes of tdhil that the file imports by name."""
    found: dict[str, object] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for one in node.names:
                if one.asname and one.name.partition(".")[0] in ROOMS:
                    found[one.asname] = importlib.import_module(one.name)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in ROOMS:
            for one in node.names:
                thing = getattr(importlib.import_module(str(node.module)), one.name, None)
                if thing is None:
                    thing = importlib.import_module(f"{node.module}.{one.name}")
                if isinstance(thing, ModuleType | type):
                    found[one.asname or one.name] = thing
    return found


def missing(tree: ast.Module) -> Iterator[str]:
    """Yield each name that its module or class does not have, with its line."""
    ours = imported(tree)
    assigned = {one.id for one in ast.walk(tree) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)}
    assigned |= {one.arg for one in ast.walk(tree) if isinstance(one, ast.arg)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            holder, name = node.value.id, node.attr
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr" \
                and len(node.args) == 3 and isinstance(node.args[0], ast.Name) \
                and isinstance(node.args[1], ast.Constant) and isinstance(node.args[1].value, str):
            holder, name = node.args[0].id, node.args[1].value
        else:
            continue
        thing = ours.get(holder)
        if thing is None or holder in assigned or hasattr(thing, name):
            continue
        if isinstance(thing, ModuleType) or name.startswith("_"):        # a field of a dataclass is no class attribute
            yield f"line {node.lineno}: {holder}.{name}"


def dotted(tree: ast.Module) -> Iterator[str]:
    """Yield each dotted text of ``setattr`` without a target, with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr" \
                and len(node.args) == 2 and isinstance(node.args[0], ast.Constant):
            text = str(node.args[0].value)
            if text.partition(".")[0] not in ROOMS:
                continue
            holder, _, name = text.rpartition(".")
            if not hasattr(resolved(holder), name):
                yield f"line {node.lineno}: {text}"


def resolved(text: str) -> object:
    """Return the module or class of this dotted name, or None."""
    try:
        return importlib.import_module(text)
    except ModuleNotFoundError:
        holder, _, name = text.rpartition(".")
        return getattr(resolved(holder), name, None) if holder else None


@pytest.mark.heavy(each_share=True)
def test_every_name_exists():
    pytest.importorskip("matplotlib")
    pytest.importorskip("starlette")
    wrong = []
    for path in sorted([*(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks" / "checks").rglob("*.py")]):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        wrong += [f"{path.relative_to(ROOT).as_posix()}, {one}" for one in (*missing(tree), *dotted(tree))]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(("text", "wrong"), [
    ("import tdhil.errors as e\ne.UsageError\n", 0), ("import tdhil.errors as e\ne.gone\n", 1),
    ("from tdhil import errors\ndef test(patch):\n    patch.setattr(errors, 'gone', 1)\n", 1),
    ("from tdhil.errors import UsageError\nUsageError.entry\n", 0),
])
def test_a_name_that_moved_is_found(text, wrong):
    assert len(list(missing(ast.parse(text)))) == wrong


def test_a_dotted_text_without_a_target_is_found():
    text = "patch.setattr('tdhil.errors.{}', 1)\n"
    assert not list(dotted(ast.parse(text.format("UsageError"))))
    assert len(list(dotted(ast.parse(text.format("gone"))))) == 1
