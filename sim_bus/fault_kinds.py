"""What a list of scripted faults is made of, whatever the bus: name, row of the fault table, value; looking one up."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from sim_bus.fault_script import FaultRefused, Scripted, parse

M = TypeVar("M")
"""What a fault of the bus in question is."""


@dataclass(frozen=True)
class Kind(Generic[M]):
    """``value``: the default, '' where the fault takes none. ``make`` may raise ValueError."""

    row: int                           # of docs/faults.md; 0: none of its own
    summary: str
    make: Callable[[str], M]
    value: str = ""
    takes: str = ""


def share(text: str) -> float:
    """A share as a number or in percent. Raises ValueError."""
    number = float(text[:-1]) / 100.0 if text.endswith("%") else float(text)
    if not 0.0 <= number <= 1.0:
        raise ValueError("a share from 0 to 1, or 0% to 100%")
    return number


def seconds(text: str) -> float:
    """A time such as 1s or 200ms. Raises ValueError."""
    number = float(text[:-2]) / 1000.0 if text.endswith("ms") else float(text.removesuffix("s"))
    if not 0.001 <= number <= 3600.0:
        raise ValueError("a time from 1ms to 3600s")
    return number


def factor(text: str) -> float:
    """What a reported quantity may be multiplied by. Raises ValueError."""
    if not 0.01 <= float(text) <= 100.0:
        raise ValueError("a factor from 0.01 to 100")
    return float(text)


def plain(make: Callable[[], M]) -> Callable[[str], M]:
    """Of a fault that takes no value."""
    return lambda _value: make()


def make_from(kinds: Mapping[str, Kind[M]], fault: Scripted) -> M:
    """What a scripted fault does. Raises FaultRefused for a name or a value that there isn't."""
    kind = kinds.get(fault.name)
    where = f"--fault {fault.text or fault.name}"
    if kind is None:
        raise FaultRefused(f"no fault is called {fault.name!r}", where=where, next_step="--fault list shows them")
    if fault.value and not kind.takes:
        raise FaultRefused(f"{fault.name} takes no value", where=where, next_step="Leave the = out")
    try:
        return kind.make(fault.value or kind.value)
    except ValueError as error:
        raise FaultRefused(
            f"{fault.value!r} is no value of {fault.name}", where=where,
            next_step=f"It takes {kind.takes}, such as {kind.value} ({error})",
        ) from None


def parse_from(kinds: Mapping[str, Kind[M]], texts: Sequence[str]) -> tuple[Scripted, ...]:
    """All the faults of a command line, each checked. Raises FaultRefused."""
    faults = tuple(parse(text) for text in texts)
    for fault in faults:
        make_from(kinds, fault)
    return faults


def listing_of(kinds: Mapping[str, Kind[M]]) -> str:
    """Every fault with its row and value, for people."""
    lines = ["NAME[@WHEN][=VALUE][/DURATION]; WHEN is 12.5s, or a stage: setup, speed, torque, hold, acquire, hold+2s",
             "", f"{'row':>3}  {'name':<37}what happens"]
    for name, kind in sorted(kinds.items(), key=lambda item: (item[1].row or 99, item[0])):
        shown = f"{name}[={kind.value}]" if kind.takes else name
        lines.append(f"{kind.row or '-':>3}  {shown:<37}{kind.summary}")
    return "\n".join(lines)
