"""Units that drives' tools write, and what each is in SI.

A value in SI is value · factor; for shares of the rated torque the factor is of ``--rated-torque``. 1/s is a
revolution a second, as in data sheets; a tool that means rad/s by it has to be told so with ``--columns``.
"""

import math
import re
from dataclasses import dataclass

from profiles import quantities

QUANTITIES = ("time", "speed", "torque")
SI = {"time": "s", "speed": "rad/s", "torque": "N·m"}
_TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Unit:
    """Of a column. ``factor`` into SI; ``of_rated``: the factor is a share of the rated torque."""

    quantity: str
    symbol: str
    factor: float
    of_rated: bool = False


_TURNS = Unit("speed", "1/s", _TURN)
_PERCENT = Unit("torque", "%", 1e-2, of_rated=True)
_PERMILLE = Unit("torque", "‰", 1e-3, of_rated=True)

# What a trace may say beyond `profiles.quantities`, which takes nothing that could mean two things.
_ALSO = {
    "time": {},
    "speed": dict.fromkeys(("1/s", "s1", "hz"), _TURNS),
    "torque": {
        "%": _PERCENT, "pct": _PERCENT, "percent": _PERCENT, "‰": _PERMILLE, "permille": _PERMILLE,
        "promille": _PERMILLE, "permil": _PERMILLE,
    },
}
_BRACKETED = re.compile(r"^(.*?)\s*[\[(<]\s*([^\[\]()<>]*?)\s*[\])>]$")
_IGNORED = re.compile(r"[\s·.*⋅_^⁻-]")


def unit_of(quantity: str, text: str) -> Unit | None:
    """The unit that ``text`` spells for a quantity: ``rpm``, ``[1/min]``, ``N.m``; None if none of ours."""
    found = _BRACKETED.match(text.strip())
    inner = found.group(2) if found is not None and not found.group(1) else text
    # Case tells milli from mega; nobody samples in megaseconds, and mN·m and MN·m are not read at all.
    word = _IGNORED.sub("", inner.replace("¹", "1").casefold())
    if (also := _ALSO[quantity].get(word)) is not None:
        return also
    known = quantities.unit_of(inner if quantity != "time" else inner.casefold())
    return _in_trace(known) if known is not None and known.dimension == quantity else None


def _in_trace(unit: quantities.Unit) -> Unit:
    return Unit(unit.dimension, unit.symbol, unit.times / unit.over)


def split_name(name: str) -> tuple[str, str]:
    """``Speed [rpm]`` → (Speed, rpm); a name without brackets is itself, with no unit."""
    found = _BRACKETED.match(name)
    return (found.group(1), found.group(2)) if found is not None and found.group(1) else (name, "")


def unit_in_name(quantity: str, name: str) -> Unit | None:
    """The unit a column's name ends with: ``speed_rad_s``, ``n_rpm``, ``Torque [%]``; the longest ending counts."""
    base, bracketed = split_name(name)
    if bracketed:
        return unit_of(quantity, bracketed)
    parts = re.split(r"[_ ]", base)
    endings = ("_".join(parts[start:]) for start in range(1, len(parts)))
    return next((unit for ending in endings if (unit := unit_of(quantity, ending)) is not None), None)


def known_units(quantity: str) -> tuple[str, ...]:
    """The symbols to be offered in a message."""
    plain = {"time": quantities.TIME, "speed": quantities.SPEED, "torque": quantities.TORQUE}[quantity]
    return tuple(dict.fromkeys((*quantities.known(plain), *(unit.symbol for unit in _ALSO[quantity].values()))))
