"""Data files read strictly: one meaning for each line, or every problem at once, each with its line.

::

    file → text (size, UTF-8) → `yaml_tree` (YAML 1.2 core; no tags, aliases, duplicates) → pydantic, strict
                                                                    ↑ `settle` (100 rpm → 10.47 rad/s) ↵

A value with a unit of its own is converted if the caller shows both values (``convert``), else refused with the value
in the key's unit. Checks across several keys (`DataModel.contradictions`) run as far as the keys that they need are
valid.
"""

import difflib
import json
import types
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Generic, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from profiles import quantities, yaml_tree
from profiles.errors import DataFileError, Problem
from profiles.messages import MessageCode
from profiles.model import CROSS_FIELD, DataModel, values_of
from profiles.quantities import Unit
from profiles.yaml_tree import KeyPath, Tree, hint

# ---------------------------------------------------------------------------------------------------------------------
# Messages of a failed validation for the author of the file: the line, and the problem in plain words.


_WANTED = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "string_type": "text",
    "model_type": "a section with keys of its own",
    "model_attributes_type": "a section with keys of its own",
    "dict_type": "a section with keys of its own",
    "list_type": "a list, such as [1, 2]",
    "tuple_type": "a list, such as [1, 2]",
    "set_type": "a list, such as [1, 2]",
    "frozen_set_type": "a list, such as [1, 2]",
    "none_required": "nothing",
}
_NOT_THE_VALUE = {CROSS_FIELD, "missing", "extra_forbidden"}
"""Kinds of error that concern a section, not a value in it."""
_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


def problems_of(error: ValidationError, tree: Tree, model: type[BaseModel]) -> list[Problem]:
    """Return every problem once, without problems of values that were refused before."""
    return [
        Problem(tree.file, line, f"{_dotted(path)}: {message}" if path else message)
        for path, line, message in _explained(error, tree, model)
        if not any(path[:size] in tree.refused for size in range(len(path) + 1))
    ]


def messages_of(error: ValidationError, data: Any, model: type[BaseModel]) -> list[tuple[KeyPath, str]]:
    """Return (path, problem) in the same words for values that are not in a file."""
    return [(path, message) for path, _, message in _explained(error, Tree("", data), model)]


def _explained(error: ValidationError, tree: Tree, model: type[BaseModel]) -> list[tuple[KeyPath, int, str]]:
    items = [dict(item) for item in error.errors(include_url=False)]
    items = [item for item in items if not _long_enough(item, _value(tree.data, path_in_file(item, tree)))]
    listed: set[KeyPath] = set()          # sections whose known keys were already listed
    found = [
        explained for item in items if item["type"] not in _WANTED
        for explained in _explain(item, tree, model, listed)
    ]
    unions: dict[KeyPath, list[str]] = {}
    for item in items:
        if item["type"] in _WANTED:      # a union gives one such error for each of its members
            unions.setdefault(path_in_file(item, tree), []).append(item["type"])
    found += [(path, tree.value_lines.get(path, 0), _wanted(kinds, tree, path)) for path, kinds in unions.items()]
    wrong = {path_in_file(item, tree) for item in items if item["type"] not in _NOT_THE_VALUE} | set(tree.refused)
    told = {(path, message) for path, _, message in found}
    across = [finding for finding in _contradictions(model, tree.data, (), wrong) if finding not in told]
    return found + [(path, tree.line(path), message) for path, message in across]


def _long_enough(item: dict[str, Any], value: Any) -> bool:
    """Return whether a list is long enough. Pydantic calls it too short because it counts only the valid entries."""
    return item["type"] == "too_short" and isinstance(value, list) and len(value) >= item["ctx"]["min_length"]


def _contradictions(
    model: type[BaseModel], data: Any, at: KeyPath, wrong: Collection[KeyPath]
) -> list[tuple[KeyPath, str]]:
    """Run pydantic's checks across keys, as far as the keys are valid, for a model and its sections."""
    if not (isinstance(model, type) and issubclass(model, DataModel) and isinstance(data, dict)):
        return []
    found: list[tuple[KeyPath, str]] = []
    for name, info in model.model_fields.items():
        key, section = info.alias or name, _section_of(info.annotation)
        if section is not None and key in data:
            found += _contradictions(section, data[key], (*at, key), wrong)
    own = model.contradictions(_right_values(model, data, at, wrong))
    return found + [((*at, *(path.split(".") if path else ())), message) for path, message in own]


def _right_values(
    model: type[DataModel], data: dict[Any, Any], at: KeyPath, wrong: Collection[KeyPath]
) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, info in model.model_fields.items():
        key, section = info.alias or name, _section_of(info.annotation)
        path = (*at, key)
        if key not in data:
            if not info.is_required():
                default = info.get_default(call_default_factory=True)
                values[name] = values_of(default) if isinstance(default, DataModel) else default
        elif section is not None and isinstance(data[key], dict):
            values[name] = _right_values(section, data[key], path, wrong)
        elif not any(path == one[: len(path)] for one in wrong):
            values[name] = data[key]
    return values


def _section_of(annotation: Any) -> type[DataModel] | None:
    """Return the one model of which the key's value is a section; None for any other value."""
    members = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    models = [one for one in members if isinstance(one, type) and issubclass(one, DataModel)]
    return models[0] if len(models) == 1 else None


def _explain(
    item: dict[str, Any], tree: Tree, model: type[BaseModel], listed: set[KeyPath]
) -> Iterator[tuple[KeyPath, int, str]]:
    kind, path = item["type"], path_in_file(item, tree)
    if kind == CROSS_FIELD:
        for at, message in item["ctx"]["findings"]:
            there = (*path, *(at.split(".") if at else ()))
            yield there, tree.line(there), message
    elif kind == "extra_forbidden":
        key, known = str(item["loc"][-1]), sorted(field_names(model, path[:-1]))
        never_here: dict[str, str] = {}
        for one in _models_at(model, path[:-1]):
            never_here |= getattr(one, "never_here", {})
        if said := never_here.get(key):
            yield path, tree.line(path), said
            return
        said = _meant(key, known, listed=path[:-1] not in listed)
        if _nearest(key, known) is None:
            listed.add(path[:-1])
        yield path[:-1], tree.line(path), f"unknown key '{_clean(key)}'{said}"
    elif kind == "missing":
        key = str(item["loc"][-1])
        known_fields = (one.model_fields[key] for one in _models_at(model, path) if key in one.model_fields)
        said = next((f" ({field.description})" for field in known_fields if field.description), "")
        yield path, tree.line(path), f"'{key}' is missing{said}"
    else:
        said = _wrong_value(item, _value(tree.data, path), tree.written.get(path), str(path[-1]) if path else "")
        yield path, tree.value_lines.get(path, tree.line(path)), said


def _wanted(kinds: list[str], tree: Tree, path: KeyPath) -> str:
    wanted = " or ".join(dict.fromkeys(_WANTED[kind] for kind in kinds))
    value = _value(tree.data, path)
    if value is None:
        return f"has no value; must be {wanted}"
    return f"must be {wanted}, not {_shown(value)}{_advice(kinds[0], value, path)}"


def _wrong_value(item: dict[str, Any], value: Any, written: str | None, key: str) -> str:
    kind, context = item["type"], item.get("ctx", {})
    if kind in {"literal_error", "enum"}:
        choices = [choice.strip("' ") for choice in context["expected"].replace(" or ", ", ").split(",")]
        return f"must be {context['expected']}, not {_shown(value)}{_meant(str(value), choices, listed=False)}"
    if kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        bound = context[name]
        if name == "ge" and quantities.excludes_zero(bound, value):
            words, bound = "greater than", 0.0
        shown = f"{value:.4g} ({_clean(written)})" if written else _shown(value).removesuffix(".0")
        of_share = not written and name in ("lt", "le") and quantities.unit_of_key(key) == quantities.SHARE
        advice = quantities.share_advice(value) if of_share else ""
        return f"must be {words} {bound:g}, not {shown}" + (f"; {advice}" if advice else "")
    if kind == "string_too_short" and context["min_length"] == 1:
        return "must not be empty"
    if kind in {"too_short", "too_long"}:
        limit = context.get("min_length", context.get("max_length"))
        return f"must have {'at least' if kind == 'too_short' else 'at most'} {limit} entries"
    return str(item["msg"]).removeprefix("Value error, ")


def _advice(kind: str, value: Any, path: KeyPath) -> str:
    if kind == "bool_type" and not (isinstance(value, str) and hint(value)):
        return "; write true or false"
    if kind == "string_type" and isinstance(value, int | float):
        return "; put it in quotes"
    if kind.startswith("int") and isinstance(value, float) and value.is_integer():
        return f"; write {int(value)}"
    number = kind.startswith(("int", "float"))
    if isinstance(value, str) and hint(value) and not (number and hint(value) in ("write true", "write false")):
        return f"; {hint(value)}"
    if number and isinstance(value, str):
        return _unit_advice(value, path)
    return ""


def _unit_advice(text: str, path: KeyPath) -> str:
    """Return why a number with a text behind it is refused. No converted number is offered, because the unit was
    intended.
    """
    parts = quantities.split(text)
    if parts is None or not parts[1]:
        return ""
    key = next((part for part in reversed(path) if isinstance(part, str)), "")
    unit = quantities.unit_of_key(key)
    if unit is None and key.endswith(("length_m", "diameter_m")):
        return "; write the number alone, in metres"
    if unit is None:
        return "; write the number alone: this key has no unit"
    try:
        quantities.read(text, unit)
    except ValueError as error:
        return f"; {error}"
    return ""


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"the text '{_clean(value)}'"
    if isinstance(value, dict):
        return "a section"
    return "a list" if isinstance(value, list) else str(value)


def _meant(word: str, known: list[str], *, listed: bool = True) -> str:
    if (near := _nearest(word, known)) is not None:
        return f"; did you mean '{near}'?"
    return f"; known here: {', '.join(known)}" if listed and known else ""


def _nearest(word: str, known: list[str]) -> str | None:
    return next(iter(difflib.get_close_matches(word[:80], known, n=1)), None)


def _dotted(path: KeyPath) -> str:
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return _clean(text.removeprefix("."))


def _clean(text: str) -> str:
    """Return the text on one line, at most 80 characters. Keys are the user's and may contain anything."""
    text = " ".join(text.split())
    return text if len(text) <= 80 else text[:77] + "..."


def path_in_file(item: dict[str, Any], tree: Tree) -> KeyPath:
    """Return the path of the error without parts that pydantic adds: names of union members, a missing key."""
    path: KeyPath = ()
    value = tree.data
    for part in item["loc"]:
        if (isinstance(value, dict) and part in value) or (isinstance(value, list) and isinstance(part, int)):
            value, path = value[part], (*path, part)
    return path


def _value(data: Any, path: KeyPath) -> Any:
    for part in path:
        data = data[part]
    return data


def field_names(model: type[BaseModel], path: KeyPath) -> set[str]:
    """Return the keys that are permitted in the section at ``path``."""
    return {info.alias or name for found in _models_at(model, path) for name, info in found.model_fields.items()}


def _models_at(annotation: Any, path: KeyPath) -> Iterator[type[BaseModel]]:
    """Yield the models that are possible at ``path`` below ``annotation``."""
    origin = get_origin(annotation)
    if origin is Annotated:
        yield from _models_at(get_args(annotation)[0], path)
    elif origin in {Union, types.UnionType}:
        for member in get_args(annotation):
            yield from _models_at(member, path)
    elif origin in {list, tuple, dict}:
        if path:
            for member in get_args(annotation):
                yield from _models_at(member, path[1:])
    elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
        if not path:
            yield annotation
        elif path[0] in annotation.model_fields:
            yield from _models_at(annotation.model_fields[str(path[0])].annotation, path[1:])


# ---------------------------------------------------------------------------------------------------------------------
# Values with a unit, and keys in another unit than the model's, are converted to the model's, because manuals use rpm.
#
# ``speed_max_rad_s: 100 rpm`` and ``speed_max_rpm: 100`` are both 10.47 rad/s. Only a value that the
# model refuses is converted, so that text stays text. `Conversion` keeps both values for the reader.


_NUMBERS = frozenset({"float_type", "int_type", "float_parsing", "int_parsing"})


@dataclass(frozen=True)
class Conversion:
    """A converted value: ``written`` in line ``line`` is ``value`` of ``unit`` at ``path``."""

    path: KeyPath
    line: int
    written: str
    value: float
    unit: Unit

    @property
    def text(self) -> str:
        """Text of the conversion, such as ``100 rpm = 10.47 rad/s``."""
        return f"{self.written} = {quantities.shown(self.value, self.unit)}"

    def refused(self, file: str) -> Problem:
        """Return the problem for a caller that would not show the conversion."""
        key = _key_path(self.path)
        return Problem(file, self.line, f"{key}: '{self.written}' is {self.value:.12g} {self.unit.symbol}; write {key} "
                                        "as a bare number in that unit")


def settle(tree: Tree, error: ValidationError, model: type[BaseModel]) -> tuple[Conversion, ...]:
    """Convert the refused values and keys that can be converted, in ``tree``. Contradictions become its problems."""
    found: list[Conversion] = []
    seen: set[KeyPath] = set()
    for item in error.errors(include_url=False, include_context=False):
        path = path_in_file(dict(item), tree)
        if path in seen or path in tree.refused or not path:
            continue
        seen.add(path)
        if item["type"] in _NUMBERS:
            found += _conversions(tree, path)
        elif item["type"] == "extra_forbidden":
            found += _key(tree, path, field_names(model, path[:-1]))
    return tuple(found)


def _conversions(tree: Tree, path: KeyPath) -> list[Conversion]:
    written = _value(tree.data, path)
    key = next((part for part in reversed(path) if isinstance(part, str)), "")
    unit = quantities.unit_of_key(key)
    parts = quantities.split(written) if isinstance(written, str) else None
    if unit is None or parts is None or not parts[1]:
        return []
    try:
        value = quantities.read(written, unit)
    except ValueError:
        return []      # the message of the validation states the reason
    return [_put(tree, path, path, written.strip(), value, unit)]


def _key(tree: Tree, path: KeyPath, known: set[str]) -> list[Conversion]:
    key, above = str(path[-1]), _value(tree.data, path[:-1])
    ours = next((name for name in sorted(known) if quantities.same_quantity(key, name)), None)
    unit = quantities.unit_of_key(key)
    if ours is None or unit is None:
        return []
    there, written = (*path[:-1], ours), above[key]
    if ours in above:
        other = tree.line(there)
        problem = f"{_key_path(path)}: '{key}' and '{ours}' (line {other}) are the same quantity; keep one"
        return _refused(tree, path, problem)
    if isinstance(written, bool) or not isinstance(written, int | float | str):
        return _refused(tree, path, f"{_key_path(path)}: must be a number in {unit.symbol}", there)
    try:
        value = float(written) if not isinstance(written, str) else _in_unit(written, unit)
    except ValueError as error:
        return _refused(tree, path, f"{_key_path(path)}: {error}", there)
    target = quantities.unit_of_key(ours)
    assert target is not None
    written = f"{written} {unit.symbol}" if not isinstance(written, str) else written.strip()
    return [_put(tree, path, there, written, target.of_si(unit.si(value)), target)]


def _in_unit(text: str, unit: Unit) -> float:
    parts = quantities.split(text)
    if parts is None:
        raise ValueError(f"must be a number in {unit.symbol}")
    if not parts[1]:
        raise ValueError("must be a number without quotes")
    given = quantities.unit_of(parts[1])
    if given is not None and given.dimension == unit.dimension and given != unit:
        raise ValueError(f"the key says {unit.symbol}, the value {given.symbol}; keep one of them")
    return quantities.read(text, unit)


def _put(tree: Tree, path: KeyPath, there: KeyPath, written: str, value: float, unit: Unit) -> Conversion:
    above = _value(tree.data, path[:-1])
    if path != there:
        above.pop(path[-1])
        tree.lines[there] = tree.lines[path]
        tree.value_lines[there] = tree.value_lines.get(path, tree.lines[path])
    above[there[-1]] = int(value) if unit.dimension == "bit rate" and value.is_integer() else value
    tree.written[there] = written
    return Conversion(there, tree.line(there), written, value, unit)


def _refused(tree: Tree, path: KeyPath, message: str, instead: KeyPath | None = None) -> list[Conversion]:
    """Add a problem with its own message, and remove the key. The key ``instead``, which it stands for, is not reported
    as missing.
    """
    above = _value(tree.data, path[:-1])
    tree.problems.append(Problem(tree.file, tree.line(path), message))
    above.pop(path[-1])
    if instead is not None:
        above[instead[-1]] = None
        tree.refused.add(instead)
    return []


def _key_path(path: KeyPath) -> str:
    return ".".join(map(str, path))


# ---------------------------------------------------------------------------------------------------------------------

M = TypeVar("M", bound=BaseModel)

MAX_BYTES = 256 * 1024
MAX_PROBLEMS = 50
_FOREIGN_KEYS = 5      # unknown keys, from which a file may be one of another kind
_FOREIGN_TIMES = 4     # unknown keys for each known one, from which it is one


@dataclass(frozen=True)
class Loaded(Generic[M]):
    """A model with the line of each of its keys; a path is a tuple of keys and list positions."""

    value: M
    file: str
    lines: MappingProxyType[yaml_tree.KeyPath, int]
    conversions: tuple[Conversion, ...] = ()
    """Values that were converted from another unit."""


def load_model(path: Path, model: type[M]) -> M:
    """Return the model in the file at ``path``. Raises DataFileError with all problems."""
    return load_with_lines(path, model).value


def parse_model(text: str, name: str, model: type[M]) -> M:
    """Return the model in ``text``; messages call it ``name``. Raises DataFileError with all problems."""
    return parse_with_lines(text, name, model).value


def load_with_lines(path: Path, model: type[M], *, convert: bool = False) -> Loaded[M]:
    """Return the model in the file at ``path``, with the line of each key."""
    return parse_with_lines(read_text(path), str(path), model, convert=convert)


def parse_with_lines(text: str, name: str, model: type[M], *, convert: bool = False) -> Loaded[M]:
    """Return the model in ``text``, with the line of each key. ``convert``: the caller shows ``conversions``."""
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
        unknown = sum(item["type"] == "extra_forbidden" and len(item["loc"]) == 1 for item in error.errors())
        if unknown >= _FOREIGN_KEYS and unknown >= _FOREIGN_TIMES * (len(tree.data) - unknown):
            known = sorted(info.alias or key for key, info in model.model_fields.items())
            raise _one(name, 0, f"a file of another kind: {unknown} of its {len(tree.data)} keys are unknown; known "
                       f"here: {', '.join(known)}") from None
        raise _all(tree.problems + problems_of(error, tree, model)) from None
    if tree.problems:
        raise _all(tree.problems)
    return Loaded(value, name, MappingProxyType(tree.lines), conversions)


def _validated(tree: yaml_tree.Tree, model: type[M]) -> M:
    # By way of JSON: strict Python input accepts no list for a tuple and no text for an enumeration.
    return model.model_validate_json(json.dumps(tree.data), strict=True)


def read_text(path: Path) -> str:
    """Return the text of the file at ``path``. Raises DataFileError if it can't be read or is not UTF-8."""
    name = str(path)
    try:
        with path.open("rb") as stream:
            raw = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise _one(name, 0, "no such file", MessageCode.FILE_NOT_FOUND) from None
    except IsADirectoryError:
        raise _one(name, 0, "is a directory; name the file in it") from None
    except PermissionError:
        raise _one(name, 0, "may not be read; check its permissions (ls -l)") from None
    except (OSError, ValueError) as error:
        raise _one(name, 0, f"can't be read ({error})") from error
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if len(raw) > MAX_BYTES:      # the cut may split a character; the error is the size
            return "x" * (MAX_BYTES + 1)
        line = raw.count(b"\n", 0, error.start) + 1
        raise _one(name, line, "not UTF-8 text; save the file in UTF-8") from None


def _one(name: str, line: int, message: str, entry: MessageCode | None = None) -> DataFileError:
    return DataFileError((Problem(name, line, message),), entry=entry)


def _all(problems: list[Problem]) -> DataFileError:
    unique = sorted(dict.fromkeys(problems), key=lambda problem: problem.line)
    shown = unique[:MAX_PROBLEMS]
    if len(unique) > MAX_PROBLEMS:
        shown.append(Problem(unique[0].file, 0, f"and {len(unique) - MAX_PROBLEMS} more problems"))
    return DataFileError(tuple(shown))


__all__ = [
    "Conversion", "DataModel", "Loaded", "load_model", "load_with_lines",
    "parse_model", "parse_with_lines", "read_text",
]
