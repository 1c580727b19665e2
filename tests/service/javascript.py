"""String literals of a script, found without an engine, for the tests of translations."""

from __future__ import annotations

import re
from dataclasses import dataclass

_REGEX_AFTER = "(,=:[!&|?{};+-*%<>~^"
_REGEX = re.compile(r"/(?:\\.|\[(?:\\.|[^\]\\])*\]|[^/\\\n[])+/")
_WORD = re.compile(r"\b(?:return|typeof)\s*$")


@dataclass(frozen=True)
class Literal:
    """One string or template. ``text``: as written, each value of a template as ``${}``; ``before``: code before it."""

    line: int
    text: str
    before: str
    template: bool


class _Scanner:
    def __init__(self, source: str) -> None:
        self._source, self.found = source, list[tuple[int, Literal]]()

    def _add(self, start: int, text: str, template: bool) -> None:
        line = self._source.count("\n", 0, start) + 1
        self.found.append((start, Literal(line, text, self._source[max(0, start - 60):start], template)))

    def code(self, at: int, inside: bool) -> int:
        """Scan code to the brace that ends a value of a template, or to the end. Return the position after it."""
        source, depth, last = self._source, 0, ""
        while at < len(source):
            sign = source[at]
            if source.startswith("//", at):
                at = (source.find("\n", at) + 1 or len(source) + 1) - 1
            elif source.startswith("/*", at):
                at = source.index("*/", at) + 2
            elif sign in "\"'":
                end = at + 1
                while source[end] != sign:
                    end += 2 if source[end] == "\\" else 1
                self._add(at, source[at + 1:end], template=False)
                at, last = end + 1, sign
            elif sign == "`":
                at, last = self.template(at), sign
            elif sign == "/" and (last == "" or last in _REGEX_AFTER or _WORD.search(source[max(0, at - 9):at])) and (
                    found := _REGEX.match(source, at)):
                at, last = found.end(), "/x"
            else:
                if sign == "}" and depth == 0 and inside:
                    return at + 1
                depth += {"{": 1, "}": -1}.get(sign, 0)
                last = last if sign.isspace() else sign
                at += 1
        return at

    def template(self, start: int) -> int:
        source, at, text = self._source, start + 1, ""
        while source[at] != "`":
            if source[at] == "\\":
                text, at = text + source[at:at + 2], at + 2
            elif source.startswith("${", at):
                text, at = text + "${}", self.code(at + 2, inside=True)
            else:
                text, at = text + source[at], at + 1
        self._add(start, text, template=True)
        return at + 1


def literals(source: str) -> list[Literal]:
    """Return the literals of a script in the order of their beginnings."""
    scanner = _Scanner(source)
    scanner.code(0, inside=False)
    return [one for _, one in sorted(scanner.found, key=lambda found: found[0])]
