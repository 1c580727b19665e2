"""Text → plain maps, lists and scalars, with the line of each, and every problem on the way.

The module uses PyYAML's event stream only. PyYAML's constructors follow YAML 1.1, let later keys overwrite earlier
ones, and resolve tags and aliases, which no data file here needs. Other loaders stop at the first error and return
objects without the line of each key.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import yaml
from yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    Event,
    MappingEndEvent,
    MappingStartEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
    StreamEndEvent,
    StreamStartEvent,
)

from profiles.errors import Problem

# ---------------------------------------------------------------------------------------------------------------------
# Meaning of an unquoted word in a YAML file: the core rules of YAML 1.2; the ambiguous words of YAML 1.1 are text or
# refused.
#
# =================================  ==========================================================
# written                            read as
# =================================  ==========================================================
# ``12`` ``+12`` ``0x1F`` ``0o17``   whole number
# ``1.5`` ``.5`` ``5.`` ``1e3``      number (YAML 1.1 takes ``1e3`` for text)
# ``true`` ``false``                 truth value (also True, TRUE …)
# ``null`` ``~``, nothing            empty
# ``010`` ``-08``                    refused: 8 in YAML 1.1, 10 in YAML 1.2
# ``.nan`` ``.inf`` ``1e999``        refused: no quantity in these files is one
# ``on`` ``off`` ``yes`` ``no``      text (a truth value in YAML 1.1)
# ``1_000`` ``12:30`` ``0b11``       text (numbers in YAML 1.1; ``12:30`` is 750 there)
# ``2024-05-01``                     text (a date in YAML 1.1)
# anything in quotes                 text
# =================================  ==========================================================
#
# Text instead of a required number or truth value is refused later; `hint` then returns the probable meaning.


Scalar = None | bool | int | float | str

MAX_NUMBER_LENGTH = 40
"""Longest number, characters. A longer one is a typing error, and the time of Python's conversion grows with its
square."""

_NULL = frozenset({"", "~", "null", "Null", "NULL"})
_BOOL = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_INT = re.compile(r"[-+]?[0-9]+")
_LEADING_ZERO = re.compile(r"([-+]?)0+([0-9]+)")
_OCTAL = re.compile(r"0o[0-7]+")
_HEX = re.compile(r"0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_TRUTH_WORDS = {"on": "true", "yes": "true", "y": "true", "off": "false", "no": "false", "n": "false"}


def plain(text: str) -> Scalar:
    """Return the value of an unquoted scalar. Raises ValueError with a text for the user if it is refused."""
    if text in _NULL:
        return None
    if text in _BOOL:
        return _BOOL[text]
    if _NOT_FINITE.fullmatch(text):
        raise ValueError(f"{text} is no usable value; write a finite number, or leave the key out")
    return _number(text)


def _number(text: str) -> Scalar:
    if not any(pattern.fullmatch(text) for pattern in (_INT, _OCTAL, _HEX, _FLOAT)):
        return text
    if len(text) > MAX_NUMBER_LENGTH:
        raise ValueError(f"a number of {len(text)} characters; at most {MAX_NUMBER_LENGTH} are read")
    if zeros := _LEADING_ZERO.fullmatch(text):
        sign, digits = zeros[1], zeros[2]
        octal = f" or 0o{digits}" if not sign and not set(digits) & set("89") else ""
        raise ValueError(f"{text} is ambiguous (octal in YAML 1.1, decimal in YAML 1.2); write {sign}{digits}{octal},"
                         " or put text in quotes")
    if _INT.fullmatch(text):
        return int(text)
    if _OCTAL.fullmatch(text) or _HEX.fullmatch(text):
        return int(text, 0)
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is too large for a number")
    return value


def hint(text: str) -> str:
    """Return the probable meaning of ``text`` where a number or a truth value is required; '' if unknown."""
    if text.lower() in _TRUTH_WORDS:
        return f"write {_TRUTH_WORDS[text.lower()]}"
    if re.fullmatch(r"[-+]?[0-9][0-9_]*_[0-9_]*(\.[0-9_]*)?", text):
        return f"write {text.replace('_', '')}"
    if re.fullmatch(r"[-+]?[0-9]+(:[0-9]+)+(\.[0-9]*)?", text):
        return "write the value in the unit that the key names, without ':'"
    if re.fullmatch(r"[-+]?[0-9]+(,[0-9]+)+(\.[0-9]*)?", text):
        return "write it with a decimal point and without a comma"
    if len(text) <= MAX_NUMBER_LENGTH and _FLOAT.fullmatch(text):
        return f"write {text} without quotes"
    return ""


# ---------------------------------------------------------------------------------------------------------------------
# PyYAML's syntax errors in words for the author of the file.


_INDENTATION = "the indentation is wrong here or in the line above. All keys of a section start in the same column"
_COLON_IN_TEXT = "a ': ' stands inside a text; put the text in quotes"
_WORDS = (
    (r"'\t' that cannot start", "a tab; indent and separate with spaces"),
    ("mapping values are not allowed", _INDENTATION),
    ("could not find expected ':'", "a key without ':', or a text that runs over the line without quotes"),
    ("but found '<block mapping start>'", _INDENTATION),
    ("expected <block end>", "the indentation does not fit the lines above"),
    ("unexpected end of stream", "a quote or bracket is opened and never closed"),
    ("expected ',' or", "a bracket is not closed, or a ',' is missing"),
    ("that cannot start any token", "a text can't begin with this character; put it in quotes"),
)
_LINE_END = re.compile("\r\n|[\n\r\x85\u2028\u2029]")
"""Ends of lines as PyYAML counts them."""
_WITHOUT_COLON = re.compile(r"( *)([A-Za-z_]\w*)(?: +|:(?! )|$)(\S.*)?")


def syntax_error(error: yaml.MarkedYAMLError, text: str) -> tuple[int, str]:
    """Return the line (from 1; 0 if unknown) and the problem in plain words. ``text``: what PyYAML has parsed."""
    mark = error.problem_mark or error.context_mark
    problem = error.problem or error.context or "can't be parsed"
    if mark is None:
        return 0, f"not YAML: {problem}"
    lines, line = _LINE_END.split(text), int(mark.line) + 1
    if "could not find expected ':'" in problem and error.context_mark is not None:      # found at the next token
        line = int(error.context_mark.line) + 1
        if said := _no_colon(lines[line - 1]):
            return line, said
    elif "mapping values are not allowed" in problem:
        here = lines[line - 1]
        if ": " in here[: int(mark.column)]:
            return line, _COLON_IN_TEXT
        above = next((one for one in range(line - 2, -1, -1) if lines[one].split("#")[0].strip()), 0)
        if _indent(lines[above]) == _indent(here) and (said := _no_colon(lines[above])):
            return above + 1, said
    for part, words in _WORDS:
        if part in problem:
            return line, words
    return line, f"not YAML: {problem}" + (f" ({error.context})" if error.context and error.problem else "")


def _no_colon(line: str) -> str:
    """Return the problem of a line whose key has no ': ' behind it; '' for any other line."""
    line = line.split(" #", maxsplit=1)[0].rstrip()
    if ": " in line or line.endswith(":") or not (found := _WITHOUT_COLON.fullmatch(line)):
        return ""
    mended = _short(f"{found[2]}: {found[3] or '…'}")
    return f"'{_short(line.strip())}' has no ': ' after the key. Write {mended}, with a space after the colon"


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))


# ---------------------------------------------------------------------------------------------------------------------

KeyPath = tuple[str | int, ...]

MAX_DEPTH = 24
MAX_NODES = 20_000


class BrokenYaml(Exception):
    """The rest of the text can't be read. ``line`` counts from 1."""

    def __init__(self, line: int, message: str) -> None:
        super().__init__(message)
        self.line = line
        self.message = message


@dataclass
class Tree:
    """One document.

    ``lines``: line of each key, and of each item in a list. ``value_lines``: line where its value begins. ``refused``:
    paths whose value was replaced by None because it already has its problem. ``written``: original text of a converted
    value (`yaml_loader.settle`).
    """

    file: str
    data: Any = None
    lines: dict[KeyPath, int] = field(default_factory=dict)
    value_lines: dict[KeyPath, int] = field(default_factory=dict)
    refused: set[KeyPath] = field(default_factory=set)
    written: dict[KeyPath, str] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def line(self, path: KeyPath) -> int:
        """Return the line of ``path``, or of the nearest key above it in the file; 1 at the top."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1)


class _Builder:
    def __init__(self, events: Iterator[Event], tree: Tree) -> None:
        self._events = events
        self._tree = tree
        self._nodes = 0

    def document(self) -> None:
        event = next(self._events)
        if isinstance(event, StreamEndEvent):
            raise BrokenYaml(0, "the file is empty")
        if isinstance(event, DocumentStartEvent) and (event.version or event.tags):
            self._problem(event, "directives (%YAML, %TAG) are not read; remove the line")
        self._tree.data = self.node(next(self._events), ())
        next(self._events)
        event = next(self._events)
        if not isinstance(event, StreamEndEvent):
            self._problem(event, "a second document (---); one file holds one")

    def node(self, event: Event, path: KeyPath) -> Any:
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise BrokenYaml(_line(event), f"more than {MAX_NODES} entries; this is no file of this program")
        if len(path) > MAX_DEPTH:
            raise BrokenYaml(_line(event), f"nested more than {MAX_DEPTH} deep; this is no file of this program")
        self._tree.lines.setdefault(path, _line(event))
        self._tree.value_lines[path] = _line(event)
        if isinstance(event, AliasEvent):
            return self._refuse(event, path, f"'*{event.anchor}' (an alias) is not read; write the value out")
        if anchor := getattr(event, "anchor", None):
            self._problem(event, f"'&{anchor}' (an anchor) is not read; write the value where it is needed")
        tag = getattr(event, "tag", None)
        if tag is not None:
            self._problem(event, f"the tag '{_short(tag)}' is not read; remove it")
        if isinstance(event, MappingStartEvent):
            value: Any = self._mapping(path)
        elif isinstance(event, SequenceStartEvent):
            value = self._sequence(path)
        else:
            value = self._scalar(event, path)
        if tag is not None:
            self._tree.refused.add(path)
            return None
        return value

    def _mapping(self, path: KeyPath) -> dict[str, Any]:
        result: dict[str, Any] = {}
        while not isinstance(event := next(self._events), MappingEndEvent):
            key = self._key(event, path)
            if key is None:
                self.node(next(self._events), (*path, ""))
                continue
            here = (*path, key)
            if key in result:
                first = self._tree.lines[here]
                self._problem(event, f"key '{_short(key)}' stands twice, in lines {first} and {_line(event)}; keep one")
                self.node(next(self._events), (*path, ""))
                continue
            self._tree.lines[here] = _line(event)
            result[key] = self.node(next(self._events), here)
        return result

    def _key(self, event: Event, path: KeyPath) -> str | None:
        """Return the key's text; None, with a problem added, if it can't be a key."""
        if not isinstance(event, ScalarEvent):
            self.node(event, (*path, ""))
            self._problem(event, "a key must be text, not a list, a map or an alias")
            return None
        if event.anchor or event.tag is not None:
            self._problem(event, "a key has no anchor and no tag; remove it")
        if event.style is None and event.value == "<<":
            self._problem(event, "'<<' (a merge key) is not read; write the keys out")
            return None
        value = self._scalar(event, (*path, ""))
        if isinstance(value, str):
            return value
        if (*path, "") not in self._tree.refused:
            self._problem(event, f"the key {_short(event.value) or '(empty)'} is not text; put it in quotes")
        self._tree.refused.discard((*path, ""))
        return None

    def _sequence(self, path: KeyPath) -> list[Any]:
        result: list[Any] = []
        while not isinstance(event := next(self._events), SequenceEndEvent):
            result.append(self.node(event, (*path, len(result))))
        return result

    def _scalar(self, event: Event, path: KeyPath) -> Any:
        assert isinstance(event, ScalarEvent)
        if any("\ud800" <= sign <= "\udfff" for sign in event.value):
            return self._refuse(event, path, "half a surrogate pair is no character")
        if event.style is not None:
            return event.value
        try:
            return plain(event.value)
        except ValueError as error:
            return self._refuse(event, path, str(error))

    def _refuse(self, event: Event, path: KeyPath, message: str) -> None:
        self._tree.refused.add(path)
        self._problem(event, message)

    def _problem(self, event: Event, message: str) -> None:
        self._tree.problems.append(Problem(self._tree.file, _line(event), message))


def read_tree(text: str, file: str) -> Tree:
    """Return all values and problems of ``text``. Raises nothing: text that can't be parsed is a problem too."""
    tree = Tree(file)
    loader: Any = None
    try:
        if bad := yaml.SafeLoader.NON_PRINTABLE.search(text):
            raise BrokenYaml(text.count("\n", 0, bad.start()) + 1,
                             f"the character U+{ord(bad.group()):04X} is not allowed")
        loader = yaml.SafeLoader(text)
        events = iter(loader.get_event, None)
        assert isinstance(next(events), StreamStartEvent)
        _Builder(events, tree).document()
    except BrokenYaml as broken:
        tree.problems.append(Problem(file, broken.line, broken.message))
    except yaml.MarkedYAMLError as error:
        tree.problems.append(Problem(file, *syntax_error(error, text)))
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        # PyYAML passes escapes such as "\UFFFFFFFF" to chr() without a check.
        line = loader.line + 1 if loader is not None else 0
        tree.problems.append(Problem(file, line, f"not YAML ({str(error).splitlines()[0]})"))
    return tree


def _line(event: Event) -> int:
    mark = event.start_mark
    return int(mark.line) + 1 if mark is not None else 0


def _short(text: str) -> str:
    text = text.replace("\n", " ")
    return text if len(text) <= 60 else text[:57] + "..."
