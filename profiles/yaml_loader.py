"""Data files read strictly: one answer to what each line means, or every problem at once, each with its line.

::

    file → text (size, UTF-8) → `yaml_tree` (YAML 1.2 core; no tags, aliases, duplicates) → pydantic, strict
                                                                    ↑ `yaml_units` (100 rpm → 10.47 rad/s) ↵

A value with a unit of its own is converted where the reader shows both (``convert``), else refused with what it is.
Checks across several keys (`DataModel.contradictions`) run as far as the keys that they need are right.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Generic, TypeVar

from pydantic import BaseModel, ValidationError

from profiles import yaml_tree
from profiles.errors import DataFileError, Problem
from profiles.model import DataModel
from profiles.yaml_messages import problems_of
from profiles.yaml_units import Conversion, settle

__all__ = ["Conversion", "DataModel", "Loaded", "load_model", "load_with_lines", "parse_model", "parse_with_lines"]

M = TypeVar("M", bound=BaseModel)

MAX_BYTES = 256 * 1024
MAX_PROBLEMS = 50


@dataclass(frozen=True)
class Loaded(Generic[M]):
    """A model with the line of each of its keys; a path is a tuple of keys and list positions."""

    value: M
    file: str
    lines: MappingProxyType[yaml_tree.Path, int]
    conversions: tuple[Conversion, ...] = ()
    """What stood there with a unit of its own."""


def load_model(path: Path, model: type[M]) -> M:
    """The model in the file at ``path``; DataFileError with all its problems."""
    return load_with_lines(path, model).value


def parse_model(text: str, name: str, model: type[M]) -> M:
    """The model in ``text``, which messages call ``name``; DataFileError with all its problems."""
    return parse_with_lines(text, name, model).value


def load_with_lines(path: Path, model: type[M], *, convert: bool = False) -> Loaded[M]:
    """As `load_model`, with the line of each key besides."""
    return parse_with_lines(_read(path), str(path), model, convert=convert)


def parse_with_lines(text: str, name: str, model: type[M], *, convert: bool = False) -> Loaded[M]:
    """As `parse_model`, with the line of each key besides. ``convert``: the caller shows ``conversions`` to people."""
    if len(text) > MAX_BYTES:
        raise _one(name, 0, f"larger than {MAX_BYTES // 1024} KiB; this is no file of this program")
    tree = yaml_tree.read_tree(text, name)
    if tree.data is None:
        raise _all(tree.problems or [Problem(name, 0, "the file is empty")])
    conversions: tuple[Conversion, ...] = ()
    try:
        try:
            value = _validated(tree, model)
        except ValidationError as error:
            conversions = settle(tree, error, model)
            if not convert:
                tree.problems += [one.refused(name) for one in conversions]
            value = _validated(tree, model)
    except ValidationError as error:
        raise _all(tree.problems + problems_of(error, tree, model)) from None
    if tree.problems:
        raise _all(tree.problems)
    return Loaded(value, name, MappingProxyType(tree.lines), conversions)


def _validated(tree: yaml_tree.Tree, model: type[M]) -> M:
    # By way of JSON: strict Python input takes no list for a tuple and no word for an enumeration.
    return model.model_validate_json(json.dumps(tree.data), strict=True)


def _read(path: Path) -> str:
    name = str(path)
    try:
        with path.open("rb") as stream:
            raw = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise _one(name, 0, "no such file") from None
    except IsADirectoryError:
        raise _one(name, 0, "is a directory; name the file in it") from None
    except PermissionError:
        raise _one(name, 0, "may not be read; check its permissions (ls -l)") from None
    except (OSError, ValueError) as error:
        raise _one(name, 0, f"can't be read ({error})") from error
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if len(raw) > MAX_BYTES:      # the cut may go through a character; the size is what is wrong
            return "x" * (MAX_BYTES + 1)
        line = raw.count(b"\n", 0, error.start) + 1
        raise _one(name, line, "not UTF-8 text; save the file in UTF-8") from None


def _one(name: str, line: int, message: str) -> DataFileError:
    return DataFileError((Problem(name, line, message),))


def _all(problems: list[Problem]) -> DataFileError:
    unique = sorted(dict.fromkeys(problems), key=lambda problem: problem.line)
    shown = unique[:MAX_PROBLEMS]
    if len(unique) > MAX_PROBLEMS:
        shown.append(Problem(unique[0].file, 0, f"and {len(unique) - MAX_PROBLEMS} more problems"))
    return DataFileError(tuple(shown))
