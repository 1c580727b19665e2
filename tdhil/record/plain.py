"""Dataclasses from plain values: from JSON's lists and dictionaries, or from a protobuf message.

The live run sends its facts through here too, so that a NumPy scalar or an int in place of a float can't make
the live recording differ from the replayed one.
"""

from dataclasses import asdict, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

hints_of = cache(get_type_hints)


def structure(hint: Any, value: Any) -> Any:
    """``value`` as an object of type ``hint``: a dataclass, tuple[X, ...], X | None, float, int, bool or str.

    Members that the type doesn't know are left out, members that are absent take their defaults.
    Raises TypeError or ValueError where the value doesn't fit the type.
    """
    if get_origin(hint) is UnionType:
        inner = next(one for one in get_args(hint) if one is not NoneType)
        return None if value is None else structure(inner, value)
    if get_origin(hint) is tuple:
        return tuple(structure(get_args(hint)[0], one) for one in value)
    if is_dataclass(hint):
        return _dataclass(hint, value)
    if hint in (float, int, bool, str):
        if hint is not str and isinstance(value, str):
            raise TypeError(f"{value!r:.40} is no {hint.__name__}")
        return hint(value)
    return value


def plain(value: Any) -> Any:
    """The way back, for JSON: dataclasses as dictionaries, everything else as it is."""
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value


def _dataclass(kind: Any, value: Any) -> Any:
    hints = hints_of(kind)
    known = {}
    for field in fields(kind):
        found, member = _member(value, field.name, hints[field.name])
        if found:
            known[field.name] = structure(hints[field.name], member)
    return kind(**known)


def _member(value: Any, name: str, hint: Any) -> tuple[bool, Any]:
    if isinstance(value, dict):
        return name in value, value.get(name)
    if not hasattr(value, name):
        return False, None
    if get_origin(hint) is UnionType and hasattr(value, "HasField") and not value.HasField(name):
        return True, None
    return True, getattr(value, name)
