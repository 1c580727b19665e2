"""Each constant of a room is declared once, since two declarations of one rule would diverge."""

import ast
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("drivers", "profiles", "sim_bus", *sorted(
    f"tdhil/{one.name}" for one in (ROOT / "tdhil").iterdir() if (one / "__init__.py").exists()))
TYPES = ("TypeVar(", "NDArray[", "Callable[", "Mapping[", "Annotated[", "Literal[")
"""Values that are types, and therefore no limits or rules."""

CHANCE: Mapping[str, str] = {
    "drivers WINDOW_S": "of a wall clock's offset, and of a position at standstill",
    "drivers RECENT": "answers of a bus, and cycles of a clock: each has its own statistics",
    "sim_bus LIGHTLY_DAMPED": "a batch of shafts has the arithmetic of one shaft, with arrays; tests compare both",
    "sim_bus TINY": "as LIGHTLY_DAMPED",
    "sim_bus POLL_S": "a socket of EtherCAT, and one of Modbus",
    "sim_bus SHORT": "series of two friction laws",
    "tdhil/estimation BLOCK_S": "one follows from the load's memory, the other from the periods of a level",
    "tdhil/estimation FEWEST": "samples of a level, and samples of a ramp",
    "tdhil/estimation LEAST_DOF": "of a quantile, and of a scatter",
    "tdhil/estimation LEAST_PERIODS": "of an impedance, and of a transient",
    "tdhil/runner RAMP_S": "of the sign probe, and of the braking probe",
    "tdhil/service EVERY_S": "each feed has its own interval",
    "tdhil/service LONGEST_NAME": "of a person, and of an uploaded file",
}
"""Equal names and values of different rules, with the reason."""


def declarations(room: str) -> Iterator[tuple[str, str, str]]:
    """Yield name, value and place of each constant in the modules of a room."""
    for path in sorted((ROOT / room).rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
                continue
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            value = ast.unparse(node.value)
            if isinstance(target, ast.Name) and target.id.isupper() and not value.startswith(TYPES):
                yield target.id.strip("_"), value, f"{path.relative_to(ROOT).as_posix()}:{node.lineno}"


@pytest.mark.parametrize("room", ROOMS)
def test_a_constant_is_declared_once_in_its_room(room):
    places = defaultdict(list)
    for name, value, place in declarations(room):
        places[name, value].append(place)
    twice = {name: where for (name, _), where in places.items() if len(where) > 1}
    known = {one.split()[1] for one in CHANCE if one.split()[0] == room}
    assert {name: where for name, where in twice.items() if name not in known} == {}
    assert known <= set(twice), "the table lists a name that is declared once"
