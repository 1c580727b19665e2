"""Count the figures of the shape of the source: lines, files, helpers called once, constants, long signatures.

    python benchmarks/shape.py                 # the counts
    python benchmarks/shape.py --helpers       # private functions that are called once, with their lengths
    python benchmarks/shape.py --parameters    # functions of more than seven parameters
    python benchmarks/shape.py --tree FOLDER   # of another checkout, to compare

A helper is a private function or method whose name occurs once in the source apart from its definition, in a call. One
that stands as a value, in a table or as a callback, can't go inline and is not counted. A parameter is counted but for
``self`` and ``cls``; fields of a dataclass are no parameters. A numeric constant is a module-level name that is bound
to numbers only, as `tests/packaging/constants.py` reads them.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.packaging.constants import bare_constants, numeric  # noqa: E402

ROOMS = ("tdhil", "drivers", "sim_bus", "profiles")
MOST_PARAMETERS = 7     # longest signature that is not listed


@dataclass(frozen=True)
class Function:
    """A function or method, and where it stands."""

    path: Path
    node: ast.FunctionDef | ast.AsyncFunctionDef

    @property
    def lines(self) -> int:
        """Return the number of lines from its name to its end."""
        return (self.node.end_lineno or self.node.lineno) - self.node.lineno + 1

    @property
    def parameters(self) -> int:
        """Return the number of parameters but for ``self`` and ``cls``."""
        given = self.node.args
        names = [one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
        return len([name for name in names if name not in ("self", "cls")])

    @property
    def private(self) -> bool:
        """Return whether the name begins with one underscore."""
        return self.node.name.startswith("_") and not self.node.name.startswith("__")


@dataclass(frozen=True)
class Shape:
    """The counts of a tree."""

    files: int
    lines: int
    functions: tuple[Function, ...]
    named: Counter[str]
    called: frozenset[str]
    constants: int
    bare: int

    def helpers(self) -> list[Function]:
        """Return the private functions that are named once, in a call."""
        defined = Counter(one.node.name for one in self.functions)
        return [one for one in self.functions
                if one.private and defined[one.node.name] == 1 and self.named[one.node.name] == 1
                and one.node.name in self.called and not one.node.decorator_list]

    def long_signatures(self) -> list[Function]:
        """Return the functions of more than seven parameters."""
        return [one for one in self.functions if one.parameters > MOST_PARAMETERS]


def names_in(tree: ast.AST) -> Iterator[str]:
    """Yield each use of a name, an attribute or a text that is a name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
            yield node.value
        elif isinstance(node, ast.ImportFrom):
            yield from (one.name for one in node.names)


def called_in(tree: ast.AST) -> Iterator[str]:
    """Yield the name of each function that is called."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            if isinstance(node.func, ast.Name):
                yield node.func.id
            elif isinstance(node.func, ast.Attribute):
                yield node.func.attr


def shape_of(root: Path) -> Shape:
    """Read the source below a checkout and count it."""
    paths = sorted(path for room in ROOMS for path in (root / room).rglob("*.py"))
    functions: list[Function] = []
    named: Counter[str] = Counter()
    called: set[str] = set()
    lines = constants = bare = 0
    for path in paths:
        source = path.read_text(encoding="utf-8")
        tree = ast.parse(source)
        lines += source.count("\n")
        named.update(names_in(tree))
        called.update(called_in(tree))
        functions += [Function(path, node) for node in ast.walk(tree)
                      if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
        constants += sum(isinstance(node, ast.Assign | ast.AnnAssign) and numeric(node.value) for node in tree.body)
        bare += len(list(bare_constants(path)))
    return Shape(len(paths), lines, tuple(functions), named, frozenset(called), constants, bare)


def main() -> int:
    """Print the counts of the source, or a list of what one of them counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--tree", type=Path, default=ROOT, help="another checkout")
    parser.add_argument("--helpers", action="store_true", help="list the private functions that are called once")
    parser.add_argument("--parameters", action="store_true", help="list the functions of more than seven parameters")
    asked = parser.parse_args()
    found = shape_of(asked.tree.resolve())
    if asked.helpers or asked.parameters:
        listed = found.helpers() if asked.helpers else found.long_signatures()
        for one in sorted(listed, key=lambda one: one.lines):
            at = one.path.relative_to(asked.tree.resolve()).as_posix()
            print(f"{one.lines:4} lines {one.parameters:3} parameters  {at}:{one.node.lineno} {one.node.name}")
        return 0
    mean = sum(one.lines for one in found.functions) / len(found.functions)
    for name, value in (
        ("files", found.files), ("lines", found.lines), ("functions", len(found.functions)),
        ("lines of a function, mean", round(mean, 1)), ("private functions called once", len(found.helpers())),
        ("numeric constants of a module", found.constants), ("of these without a word", found.bare),
        ("functions of more than seven parameters", len(found.long_signatures())),
    ):
        print(f"{name:<42}{value:>8}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
