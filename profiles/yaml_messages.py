"""What a failed validation says to the person who wrote the file: at which line, in plain words."""

import difflib
import types
from collections.abc import Collection, Iterator
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from profiles import quantities
from profiles.errors import Problem
from profiles.model import CROSS_FIELD, DataModel, values_of
from profiles.yaml_scalars import hint
from profiles.yaml_tree import Path, Tree

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
"""What is said of a section, not of a value in it."""
_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


def problems_of(error: ValidationError, tree: Tree, model: type[BaseModel]) -> list[Problem]:
    """Every problem, once; none about values that were refused before."""
    return [
        Problem(tree.file, line, f"{_dotted(path)}: {message}" if path else message)
        for path, line, message in _explained(error, tree, model)
        if not any(path[:size] in tree.refused for size in range(len(path) + 1))
    ]


def messages_of(error: ValidationError, data: Any, model: type[BaseModel]) -> list[tuple[Path, str]]:
    """The same words for values that stand in no file: what is wrong, and at which path."""
    return [(path, message) for path, _, message in _explained(error, Tree("", data), model)]


def _explained(error: ValidationError, tree: Tree, model: type[BaseModel]) -> list[tuple[Path, int, str]]:
    items = [dict(item) for item in error.errors(include_url=False)]
    listed: set[Path] = set()          # sections whose known keys were told: once is enough
    found = [
        explained for item in items if item["type"] not in _WANTED
        for explained in _explain(item, tree, model, listed)
    ]
    unions: dict[Path, list[str]] = {}
    for item in items:
        if item["type"] in _WANTED:      # a union gives one of these for each of its members
            unions.setdefault(path_in_file(item, tree), []).append(item["type"])
    found += [(path, tree.value_lines.get(path, 0), _wanted(kinds, tree, path)) for path, kinds in unions.items()]
    wrong = {path_in_file(item, tree) for item in items if item["type"] not in _NOT_THE_VALUE} | set(tree.refused)
    told = {(path, message) for path, _, message in found}
    across = [finding for finding in _contradictions(model, tree.data, (), wrong) if finding not in told]
    return found + [(path, tree.line(path), message) for path, message in across]


def _contradictions(model: type[BaseModel], data: Any, at: Path, wrong: Collection[Path]) -> list[tuple[Path, str]]:
    """What pydantic checks once every key is right: here as far as keys are right, of a model and its sections."""
    if not (isinstance(model, type) and issubclass(model, DataModel) and isinstance(data, dict)):
        return []
    found: list[tuple[Path, str]] = []
    for name, info in model.model_fields.items():
        key, section = info.alias or name, _section_of(info.annotation)
        if section is not None and key in data:
            found += _contradictions(section, data[key], (*at, key), wrong)
    own = model.contradictions(_right_values(model, data, at, wrong))
    return found + [((*at, *(path.split(".") if path else ())), message) for path, message in own]


def _right_values(model: type[DataModel], data: dict[Any, Any], at: Path, wrong: Collection[Path]) -> dict[str, Any]:
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
    """The one model that a key's value is a section of; None for anything else."""
    members = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    models = [one for one in members if isinstance(one, type) and issubclass(one, DataModel)]
    return models[0] if len(models) == 1 else None


def _explain(
    item: dict[str, Any], tree: Tree, model: type[BaseModel], listed: set[Path]
) -> Iterator[tuple[Path, int, str]]:
    kind, path = item["type"], path_in_file(item, tree)
    if kind == CROSS_FIELD:
        for at, message in item["ctx"]["findings"]:
            there = (*path, *(at.split(".") if at else ()))
            yield there, tree.line(there), message
    elif kind == "extra_forbidden":
        key, known = str(item["loc"][-1]), sorted(field_names(model, path[:-1]))
        if said := _never_here(model, path[:-1]).get(key):
            yield path, tree.line(path), said
            return
        said = _meant(key, known, listed=path[:-1] not in listed)
        if _nearest(key, known) is None:
            listed.add(path[:-1])
        yield path[:-1], tree.line(path), f"unknown key '{_clean(key)}'{said}"
    elif kind == "missing":
        key = str(item["loc"][-1])
        yield path, tree.line(path), f"'{key}' is missing{_description(model, path, key)}"
    else:
        said = _wrong_value(item, _value(tree.data, path), tree.written.get(path))
        yield path, tree.value_lines.get(path, tree.line(path)), said


def _wanted(kinds: list[str], tree: Tree, path: Path) -> str:
    wanted = " or ".join(dict.fromkeys(_WANTED[kind] for kind in kinds))
    value = _value(tree.data, path)
    if value is None:
        return f"has no value; {wanted} is wanted here"
    return f"{wanted} is wanted, not {_shown(value)}{_advice(kinds[0], value, path)}"


def _wrong_value(item: dict[str, Any], value: Any, written: str | None) -> str:
    kind, context = item["type"], item.get("ctx", {})
    if kind in {"literal_error", "enum"}:
        choices = [choice.strip("' ") for choice in context["expected"].replace(" or ", ", ").split(",")]
        return f"{context['expected']} is wanted, not {_shown(value)}{_meant(str(value), choices, listed=False)}"
    if kind in _BOUNDS:
        as_written = f"{value:.4g} ({_clean(written)})" if written else ""
        return f"must be {_BOUNDS[kind][1]} {context[_BOUNDS[kind][0]]:g}, not {as_written or _shown(value)}"
    if kind in {"too_short", "too_long"}:
        limit = context.get("min_length", context.get("max_length"))
        return f"{'at least' if kind == 'too_short' else 'at most'} {limit} entries are wanted"
    return str(item["msg"]).removeprefix("Value error, ")


def _advice(kind: str, value: Any, path: Path) -> str:
    if kind == "bool_type" and not (isinstance(value, str) and hint(value)):
        return "; write true or false"
    if kind == "string_type" and isinstance(value, int | float):
        return "; put it in quotes"
    if kind.startswith("int") and isinstance(value, float) and value.is_integer():
        return f"; write {int(value)}"
    if isinstance(value, str) and hint(value):
        return f"; {hint(value)}"
    if kind.startswith(("int", "float")) and isinstance(value, str):
        return _unit_advice(value, path)
    return ""


def _unit_advice(text: str, path: Path) -> str:
    """Why a number with something behind it is not read. No number is offered: who wrote a unit meant it."""
    parts = quantities.split(text)
    if parts is None or not parts[1]:
        return ""
    unit = quantities.unit_of_key(next((part for part in reversed(path) if isinstance(part, str)), ""))
    if unit is None:
        return "; a number alone: this key has no unit"
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


def _dotted(path: Path) -> str:
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return _clean(text.removeprefix("."))


def _clean(text: str) -> str:
    """One line of bounded length: keys are the user's and may hold anything."""
    text = " ".join(text.split())
    return text if len(text) <= 80 else text[:77] + "..."


def path_in_file(item: dict[str, Any], tree: Tree) -> Path:
    """The error's location without what pydantic adds to it: names of union members, a missing key."""
    path: Path = ()
    value = tree.data
    for part in item["loc"]:
        if (isinstance(value, dict) and part in value) or (isinstance(value, list) and isinstance(part, int)):
            value, path = value[part], (*path, part)
    return path


def _value(data: Any, path: Path) -> Any:
    for part in path:
        data = data[part]
    return data


def field_names(model: type[BaseModel], path: Path) -> set[str]:
    """The keys that may stand in the section at ``path``."""
    return {info.alias or name for found in _models_at(model, path) for name, info in found.model_fields.items()}


def _never_here(model: type[BaseModel], path: Path) -> dict[str, str]:
    found: dict[str, str] = {}
    for one in _models_at(model, path):
        found |= getattr(one, "never_here", {})
    return found


def _description(model: type[BaseModel], path: Path, key: str) -> str:
    for found in _models_at(model, path):
        if key in found.model_fields and (text := found.model_fields[key].description):
            return f" ({text})"
    return ""


def _models_at(annotation: Any, path: Path) -> Iterator[type[BaseModel]]:
    """The models that may stand at ``path`` below ``annotation``."""
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
