"""Values with a unit, and keys in another unit than ours, become the ones that a model has: every manual speaks rpm.

``speed_max_rad_s: 100 rpm`` and ``speed_max_rpm: 100`` are both 10.47 rad/s. Only what the model refuses as it stands
is looked at, so that text stays text. What was converted is told (`Conversion`), for the reader to see both.
"""

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError

from profiles import quantities
from profiles.errors import Problem
from profiles.quantities import Unit
from profiles.yaml_messages import field_names, path_in_file
from profiles.yaml_tree import Path, Tree

_NUMBERS = frozenset({"float_type", "int_type", "float_parsing", "int_parsing"})


@dataclass(frozen=True)
class Conversion:
    """``written`` in line ``line`` was taken for ``value`` of ``unit`` at ``path``."""

    path: Path
    line: int
    written: str
    value: float
    unit: Unit

    @property
    def text(self) -> str:
        """``100 rpm = 10.47 rad/s``."""
        return f"{self.written} = {quantities.shown(self.value, self.unit)}"

    def refused(self, file: str) -> Problem:
        """Where nobody would see what became of it."""
        key = _dotted(self.path)
        return Problem(file, self.line, f"{key}: '{self.written}' is {self.value:.12g} {self.unit.symbol}; write {key} "
                                        "as a bare number in that unit")


def settle(tree: Tree, error: ValidationError, model: type[BaseModel]) -> tuple[Conversion, ...]:
    """What of the refused values and keys can be converted, put into ``tree``; contradictions become its problems."""
    found: list[Conversion] = []
    seen: set[Path] = set()
    for item in error.errors(include_url=False, include_context=False):
        path = path_in_file(dict(item), tree)
        if path in seen or path in tree.refused or not path:
            continue
        seen.add(path)
        if item["type"] in _NUMBERS:
            found += _value(tree, path)
        elif item["type"] == "extra_forbidden":
            found += _key(tree, path, field_names(model, path[:-1]))
    return tuple(found)


def _value(tree: Tree, path: Path) -> list[Conversion]:
    written = _at(tree.data, path)
    key = next((part for part in reversed(path) if isinstance(part, str)), "")
    unit = quantities.unit_of_key(key)
    parts = quantities.split(written) if isinstance(written, str) else None
    if unit is None or parts is None or not parts[1]:
        return []
    try:
        value = quantities.read(written, unit)
    except ValueError:
        return []      # the message of the validation says why
    return [_put(tree, path, path, written.strip(), value, unit)]


def _key(tree: Tree, path: Path, known: set[str]) -> list[Conversion]:
    key, above = str(path[-1]), _at(tree.data, path[:-1])
    ours = next((name for name in sorted(known) if quantities.same_quantity(key, name)), None)
    unit = quantities.unit_of_key(key)
    if ours is None or unit is None:
        return []
    there, written = (*path[:-1], ours), above[key]
    if ours in above:
        other = tree.line(there)
        problem = f"{_dotted(path)}: '{key}' and '{ours}' (line {other}) are the same quantity; keep one"
        return _refused(tree, path, problem)
    if isinstance(written, bool) or not isinstance(written, int | float | str):
        return _refused(tree, path, f"{_dotted(path)}: a number in {unit.symbol} is wanted", there)
    try:
        value = float(written) if not isinstance(written, str) else _in_unit(written, unit)
    except ValueError as error:
        return _refused(tree, path, f"{_dotted(path)}: {error}", there)
    target = quantities.unit_of_key(ours)
    assert target is not None
    written = f"{written} {unit.symbol}" if not isinstance(written, str) else written.strip()
    return [_put(tree, path, there, written, target.of_si(unit.si(value)), target)]


def _in_unit(text: str, unit: Unit) -> float:
    parts = quantities.split(text)
    if parts is None:
        raise ValueError(f"a number in {unit.symbol} is wanted")
    if not parts[1]:
        raise ValueError("a number is wanted, without quotes")
    given = quantities.unit_of(parts[1])
    if given is not None and given.dimension == unit.dimension and given != unit:
        raise ValueError(f"the key says {unit.symbol}, the value {given.symbol}; keep one of them")
    return quantities.read(text, unit)


def _put(tree: Tree, path: Path, there: Path, written: str, value: float, unit: Unit) -> Conversion:
    above = _at(tree.data, path[:-1])
    if path != there:
        above.pop(path[-1])
        tree.lines[there] = tree.lines[path]
        tree.value_lines[there] = tree.value_lines.get(path, tree.lines[path])
    above[there[-1]] = int(value) if unit.dimension == "bit rate" and value.is_integer() else value
    tree.written[there] = written
    return Conversion(there, tree.line(there), written, value, unit)


def _refused(tree: Tree, path: Path, message: str, instead: Path | None = None) -> list[Conversion]:
    """A problem of its own words; the key is taken out, and the one that it stands for isn't said to be missing."""
    above = _at(tree.data, path[:-1])
    tree.problems.append(Problem(tree.file, tree.line(path), message))
    above.pop(path[-1])
    if instead is not None:
        above[instead[-1]] = None
        tree.refused.add(instead)
    return []


def _dotted(path: Path) -> str:
    return ".".join(map(str, path))


def _at(data: Any, path: Path) -> Any:
    for part in path:
        data = data[part]
    return data
