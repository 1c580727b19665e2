"""Units that drives' tools write, and what each is in SI.

A value in SI is value · factor; for shares of the rated torque the factor is of ``--rated-torque``. 1/s is a
revolution a second, as in data sheets; a tool that means rad/s by it has to be told so with ``--columns``.
"""

import math
import re
from dataclasses import dataclass

QUANTITIES = ("time", "speed", "torque")
SI = {"time": "s", "speed": "rad/s", "torque": "N·m"}
_TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Unit:
    """``factor`` into SI; ``of_rated``: the factor is a share of the rated torque."""

    quantity: str
    symbol: str
    factor: float
    of_rated: bool = False


_SECOND = Unit("time", "s", 1.0)
_MILLISECOND = Unit("time", "ms", 1e-3)
_MICROSECOND = Unit("time", "us", 1e-6)
_MINUTE = Unit("time", "min", 60.0)
_RADIAN = Unit("speed", "rad/s", 1.0)
_RPM = Unit("speed", "rpm", _TURN / 60.0)
_TURNS = Unit("speed", "1/s", _TURN)
_DEGREE = Unit("speed", "deg/s", _TURN / 360.0)
_NEWTON = Unit("torque", "N·m", 1.0)
_KILO = Unit("torque", "kN·m", 1e3)
_FOOT = Unit("torque", "lbf·ft", 1.3558179483314004)
_PERCENT = Unit("torque", "%", 1e-2, of_rated=True)
_PERMILLE = Unit("torque", "‰", 1e-3, of_rated=True)

# How they are spelt once case, spaces and the signs · . * - _ ^ are out of the way.
_SPELT = {
    "time": {
        "s": _SECOND, "sec": _SECOND, "second": _SECOND, "seconds": _SECOND, "ms": _MILLISECOND, "msec": _MILLISECOND,
        "us": _MICROSECOND, "µs": _MICROSECOND, "μs": _MICROSECOND, "usec": _MICROSECOND, "min": _MINUTE,
    },
    "speed": {
        "rad/s": _RADIAN, "rads": _RADIAN, "rad/sec": _RADIAN, "rads1": _RADIAN, "rpm": _RPM, "r/min": _RPM,
        "rev/min": _RPM, "1/min": _RPM, "min1": _RPM, "u/min": _RPM, "upm": _RPM, "1/s": _TURNS, "s1": _TURNS,
        "hz": _TURNS, "rps": _TURNS, "r/s": _TURNS, "rev/s": _TURNS, "deg/s": _DEGREE, "degs": _DEGREE,
        "°/s": _DEGREE,
    },
    "torque": {
        "nm": _NEWTON, "knm": _KILO, "lbfft": _FOOT, "ftlbf": _FOOT, "lbft": _FOOT, "ftlb": _FOOT, "ftlbs": _FOOT,
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
    word = _IGNORED.sub("", inner.replace("¹", "1").casefold().replace("μ", "µ"))
    return _SPELT[quantity].get(word)


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
    return tuple(dict.fromkeys(unit.symbol for unit in _SPELT[quantity].values()))
