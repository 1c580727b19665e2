"""Text → plain maps, lists and scalars, with the line of each, and every problem found on the way.

Built on PyYAML's event stream and on nothing above it: its constructors follow YAML 1.1, let later keys
overwrite earlier ones, and resolve tags and aliases, none of which a data file here needs.
"""

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
from profiles.yaml_scalars import plain
from profiles.yaml_syntax import syntax_error

Path = tuple[str | int, ...]

MAX_DEPTH = 24
MAX_NODES = 20_000


class Broken(Exception):
    """The text can't be read on; ``line`` counts from 1."""

    def __init__(self, line: int, message: str) -> None:
        super().__init__(message)
        self.line = line
        self.message = message


@dataclass
class Tree:
    """One document.

    ``lines`` holds the line of each key (of each item in a list), ``value_lines`` the line where its value
    begins, ``refused`` the paths whose value was replaced by None because it already has its problem,
    ``written`` what stood there where a value was converted (`yaml_units`).
    """

    file: str
    data: Any = None
    lines: dict[Path, int] = field(default_factory=dict)
    value_lines: dict[Path, int] = field(default_factory=dict)
    refused: set[Path] = field(default_factory=set)
    written: dict[Path, str] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def line(self, path: Path) -> int:
        """The line of ``path``, or of the nearest thing above it that stands in the file; 1 at the top."""
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
            raise Broken(0, "the file is empty")
        if isinstance(event, DocumentStartEvent) and (event.version or event.tags):
            self._problem(event, "directives (%YAML, %TAG) are not read; remove the line")
        self._tree.data = self.node(next(self._events), ())
        next(self._events)
        event = next(self._events)
        if not isinstance(event, StreamEndEvent):
            self._problem(event, "a second document (---); one file holds one")

    def node(self, event: Event, path: Path) -> Any:
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise Broken(_line(event), f"more than {MAX_NODES} entries; this is no file of this program")
        if len(path) > MAX_DEPTH:
            raise Broken(_line(event), f"nested more than {MAX_DEPTH} deep; this is no file of this program")
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

    def _mapping(self, path: Path) -> dict[str, Any]:
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

    def _key(self, event: Event, path: Path) -> str | None:
        """The key's text; None, with a problem noted, for what can't be one."""
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

    def _sequence(self, path: Path) -> list[Any]:
        result: list[Any] = []
        while not isinstance(event := next(self._events), SequenceEndEvent):
            result.append(self.node(event, (*path, len(result))))
        return result

    def _scalar(self, event: Event, path: Path) -> Any:
        assert isinstance(event, ScalarEvent)
        if any("\ud800" <= sign <= "\udfff" for sign in event.value):
            return self._refuse(event, path, "half a surrogate pair is no character")
        if event.style is not None:
            return event.value
        try:
            return plain(event.value)
        except ValueError as error:
            return self._refuse(event, path, str(error))

    def _refuse(self, event: Event, path: Path, message: str) -> None:
        self._tree.refused.add(path)
        self._problem(event, message)

    def _problem(self, event: Event, message: str) -> None:
        self._tree.problems.append(Problem(self._tree.file, _line(event), message))


def read_tree(text: str, file: str) -> Tree:
    """Every value and every problem of ``text``; raises nothing: what can't be parsed is a problem too."""
    tree = Tree(file)
    loader: Any = None
    try:
        _check_characters(text)
        loader = yaml.SafeLoader(text)
        events = iter(loader.get_event, None)
        assert isinstance(next(events), StreamStartEvent)
        _Builder(events, tree).document()
    except Broken as broken:
        tree.problems.append(Problem(file, broken.line, broken.message))
    except yaml.MarkedYAMLError as error:
        tree.problems.append(Problem(file, *syntax_error(error)))
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        # PyYAML hands escapes such as "\UFFFFFFFF" to chr() unchecked.
        line = loader.line + 1 if loader is not None else 0
        tree.problems.append(Problem(file, line, f"not YAML ({str(error).splitlines()[0]})"))
    return tree


def _check_characters(text: str) -> None:
    if bad := yaml.SafeLoader.NON_PRINTABLE.search(text):
        raise Broken(text.count("\n", 0, bad.start()) + 1, f"the character U+{ord(bad.group()):04X} is not allowed")


def _line(event: Event) -> int:
    mark = event.start_mark
    return int(mark.line) + 1 if mark is not None else 0


def _short(text: str) -> str:
    text = text.replace("\n", " ")
    return text if len(text) <= 60 else text[:57] + "..."
