"""Which column is which, as the command line says it: ``time=t_s speed=n_rpm:rpm torque=m_pct:%``."""

import difflib
from collections.abc import Iterable
from dataclasses import dataclass

from tdhil.errors import UsageError
from tdhil.record.csv_errors import shown
from tdhil.record.csv_units import QUANTITIES, Unit, known_units, unit_of

_WHERE = "--columns"
_NEXT = "Such as: --columns time=t_s speed=n_rpm:rpm torque=m:Nm"


@dataclass(frozen=True)
class Choice:
    """The column called ``name`` holds ``quantity``; ``unit`` None: as the file says. No name: the usual ones."""

    quantity: str
    name: str = ""
    unit: Unit | None = None


Choices = tuple[Choice, Choice, Choice]
USUAL: Choices = (Choice("time"), Choice("speed"), Choice("torque"))


def parse_columns(items: Iterable[str]) -> Choices:
    """Time, speed and torque, in this order; one that isn't named keeps its usual name. UsageError."""
    found: dict[str, Choice] = {}
    for item in items:
        quantity, equals, name = item.partition("=")
        quantity = quantity.strip().casefold()
        if not equals or not name.strip():
            raise UsageError(f"{shown(item)!r} is not quantity=column", where=_WHERE, next_step=_NEXT)
        if quantity not in QUANTITIES:
            meant = difflib.get_close_matches(quantity, QUANTITIES, 1)
            hint = f"; did you mean {meant[0]!r}?" if meant else f"; there are {', '.join(QUANTITIES)}"
            raise UsageError(f"there is no quantity {shown(quantity)!r}{hint}", where=_WHERE, next_step=_NEXT)
        if quantity in found:
            raise UsageError(f"{quantity} is named twice", where=_WHERE)
        found[quantity] = _choice(quantity, name.strip())
    names = [choice.name.casefold() for choice in found.values()]
    if len(set(names)) < len(names):
        raise UsageError("one column can't hold two quantities", where=_WHERE, next_step=_NEXT)
    time, speed, torque = (found.get(quantity, Choice(quantity)) for quantity in QUANTITIES)
    return time, speed, torque


def _choice(quantity: str, text: str) -> Choice:
    name, colon, spelt = text.rpartition(":")
    if not colon or spelt.startswith(" "):       # "Axis 1: speed" is a name
        return Choice(quantity, text)
    unit = unit_of(quantity, spelt)
    if unit is None or not name:
        raise UsageError(
            f"{shown(spelt)!r} is no unit of {quantity}; there are {', '.join(known_units(quantity))}",
            where=_WHERE, next_step="If the colon belongs to the column's name, write the unit behind another colon",
        )
    return Choice(quantity, name.strip(), unit)
