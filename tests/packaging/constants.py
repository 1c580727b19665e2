"""Module-level numeric constants without a statement of their meaning or source.

``python -m tests.packaging.constants FOLDER`` lists them. A constant states it by a docstring below, or by a comment on
its line; a directive to a tool is no comment. Several names in one statement share both.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
_WORD = re.compile(r"[^\W\d_]")
_DIRECTIVE = re.compile(r"\s*(?:noqa|type:|pragma:|ruff:)")


@dataclass(frozen=True)
class Bare:
    """Statement that binds numbers without an explanation."""

    path: Path
    line: int
    names: str

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT).as_posix()}:{self.line}: {self.names}"


def numeric(node: ast.expr | None) -> bool:
    """Return whether an expression contains numbers only: literals, signs, sums, and tuples, lists or sets of them."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return numeric(node.operand)
    if isinstance(node, ast.BinOp):
        return numeric(node.left) and numeric(node.right)
    if isinstance(node, ast.Tuple | ast.List | ast.Set):
        return bool(node.elts) and all(numeric(one) for one in node.elts)
    return False


def bare_constants(path: Path) -> Iterator[Bare]:
    """Yield the constants of a module that state nothing."""
    source = path.read_text(encoding="utf-8")
    lines, body = source.split("\n"), ast.parse(source).body
    for at, node in enumerate(body):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or not numeric(node.value):
            continue
        after = body[at + 1] if at + 1 < len(body) else None
        stated = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(
            after.value.value, str)
        comments = lines[(node.end_lineno or node.lineno) - 1].split("#")[1:]
        if not stated and not any(_WORD.search(one) and not _DIRECTIVE.match(one) for one in comments):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield Bare(path, node.lineno, ", ".join(ast.unparse(one).strip("()") for one in targets))


def in_folder(folder: Path) -> list[Bare]:
    """Return the constants of every module below a folder."""
    return [one for path in sorted(folder.rglob("*.py")) for one in bare_constants(path)]


if __name__ == "__main__":
    for found in in_folder(ROOT / sys.argv[1]):
        print(found)
