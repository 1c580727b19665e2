"""Texts of the tree that are not plain: openings of docstrings, words, and long sentences.

``python -m tests.packaging.language`` lists all findings; with a folder as argument, those of that folder.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOMS = ("tdhil", "drivers", "sim_bus", "profiles")
MOST_WORDS = 30
"""Limit of words in a sentence of a page or a message."""

OPENINGS = frozenset((
    "As", "At", "By", "Does", "From", "Has", "Here", "In", "Is", "May", "No", "None", "Not", "Of", "So", "There",
    "What", "Whatever", "Where", "Whether", "Who", "Whoever", "Whose",
))
"""First words of fragments. A docstring begins with a verb in the imperative or with a noun phrase."""

WORDS = {
    r"\b(he|his|him|she|her|whoever|whatever else|somebody|nobody)\b": "name the operator, the drive or the master",
    r"\b(makes it unsure|second opinion|lets? go|wound[- ]up|restless|unsaid|unasked|so often|by itself alone|let be"
    r"|takes? for nothing)\b": "use the word of the field",
    r"\b(is|are|be|was) (told|said|asked for|looked at|reckoned)\b": "active voice: who reports, states or requests",
}
"""Words and phrases to avoid, each with what to write instead."""
_ANY_WORD = re.compile("|".join(WORDS), re.IGNORECASE)

EXCEPTIONS = {
    "tdhil/report/document.py": "second_opinions is a key of the JSON document",
    "tests/packaging/language.py": "this list",
}
"""Files whose words are not checked, each with its reason."""


@dataclass(frozen=True)
class Finding:
    """One place; ``kind`` is opening, word or long."""

    path: str
    line: int
    kind: str
    text: str

    @property
    def room(self) -> str:
        """Part of the tree with its own ceiling."""
        parts = self.path.split("/")
        if parts[0] in ("tdhil", "docs") and len(parts) > 2:
            return "/".join(parts[:2])
        return parts[0] if len(parts) > 1 else "pages"


def findings() -> Iterator[Finding]:
    """Yield all findings of the tree."""
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            yield from of_code(path)
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))):
        yield from of_page(path)


def of_code(path: Path) -> Iterator[Finding]:
    """Yield the findings in docstrings, comments and messages of a module."""
    name, source = str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    docstrings = set()
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for index, one in enumerate(body if isinstance(body, list) else []):
            if isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant) and isinstance(one.value.value, str):
                docstrings.add(id(one.value))
                first = re.match(r"\s*(\w+)", one.value.value)
                of_a_definition = index == 0 and isinstance(
                    node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
                if of_a_definition and first and first[1] in OPENINGS:
                    yield Finding(name, one.lineno, "opening", one.value.value.strip().partition("\n")[0])
                yield from _words(name, one.lineno, one.value.value)
    if any("#" in row and _ANY_WORD.search(row) for row in source.splitlines()):      # tokenising is slow
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT:
                yield from _words(name, token.start[0], token.string)
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)
             if part is not node}
    for node in ast.walk(tree):
        text = _message(node)
        if text is not None and id(node) not in docstrings and id(node) not in inner and text.count(" ") > 1:
            yield from _words(name, node.lineno, text)
            yield from _long(name, node.lineno, text)


def _message(node: ast.AST) -> str | None:
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "1" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def of_page(path: Path) -> Iterator[Finding]:
    """Yield the findings in the prose of a Markdown page, without fenced blocks; a code span counts as one word."""
    name = str(path.relative_to(ROOT))
    for line, paragraph in paragraphs(path.read_text(encoding="utf-8")):
        text = re.sub(r"`[^`]*`", "code", re.sub(r"\]\([^)]*\)", "]", paragraph))
        yield from _words(name, line, text)
        for cell in text.split("|"):
            yield from _long(name, line, cell)


def paragraphs(text: str) -> Iterator[tuple[int, str]]:
    """Yield paragraphs, list items and rows of tables, each with its first line."""
    kept: list[str] = []
    begun, fenced = 1, False
    for number, row in enumerate([*text.splitlines(), ""], 1):
        fence = row.lstrip().startswith("```")
        starts = re.match(r"\s*([-*|#]|\d+\.)(\s|$)|\s*\|", row) is not None
        if (fence or fenced or starts or not row.strip()) and kept:
            yield begun, " ".join(kept)
            kept = []
        fenced ^= fence
        if not (fence or fenced) and row.strip():
            begun = begun if kept else number
            kept.append(row.strip())


def _words(name: str, line: int, text: str) -> Iterator[Finding]:
    if name in EXCEPTIONS:
        return
    for pattern in WORDS:
        for found in re.finditer(pattern, re.sub(r"``?[^`]*``?", "", text), re.IGNORECASE):
            yield Finding(name, line, "word", found[0])


def _long(name: str, line: int, text: str) -> Iterator[Finding]:
    if "</" in text or "{%" in text:      # a template of a page
        return
    for sentence in re.split(r"(?<=[.;:!?])(?:\*\*)?\s|\n", text):      # a bold sentence ends before its mark
        if len(sentence.split()) > MOST_WORDS:
            yield Finding(name, line, "long", sentence.strip()[:100])


def counted() -> Counter[tuple[str, str]]:
    """Return the number of findings by room and kind."""
    return Counter((one.room, one.kind) for one in findings())


if __name__ == "__main__":
    for found in findings():
        if found.path.startswith(tuple(sys.argv[1:]) or ""):
            print(f"{found.path}:{found.line}: {found.kind}: {found.text}")
    for (a_room, a_kind), number in sorted(counted().items()):
        print(f'    ("{a_room}", "{a_kind}"): {number},', file=sys.stderr)
