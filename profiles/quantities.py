"""Quantities as users write them (``100 rpm``, ``90°``, ``2 kNm``, ``5 %``), as messages show them; the unit of a key.

One table for data files, the command line and the columns of a trace. A text with two meanings is refused: ``1/s`` and
``Hz`` for a speed (revolutions or radians), ``m`` (minutes or milli), ``MNm``.
"""

import math
import re
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from fractions import Fraction
from typing import Final

_TURN: Final = 2.0 * math.pi


@dataclass(frozen=True)
class Unit:
    """A unit: value · ``times`` / ``over`` is in SI. Two numbers are kept, so that 0.35 % is 0.0035 to the last bit."""

    dimension: str
    symbol: str
    times: float = 1.0
    over: float = 1.0

    def si(self, value: float) -> float:
        """Convert ``value`` from this unit to SI."""
        return _scaled(value, self.times, self.over)

    def of_si(self, value: float) -> float:
        """Convert ``value`` from SI to this unit."""
        return _scaled(value, self.over, self.times)


def _scaled(value: float, times: float, over: float) -> float:
    if times.is_integer() and over.is_integer() and abs(value) < 1e15:
        return float(Fraction(repr(float(value))) * int(times) / int(over))       # as if typed in decimals
    return value * times / over


SPEED: Final = Unit("speed", "rad/s")
RPM: Final = Unit("speed", "rpm", _TURN, 60.0)
RAD_S_PER_RPM: Final = RPM.si(1.0)        # rad/s
ACCELERATION: Final = Unit("acceleration", "rad/s²")
ANGLE: Final = Unit("angle", "rad")
TORQUE: Final = Unit("torque", "N·m")
TORQUE_RATE: Final = Unit("change of torque", "N·m/s")
FRICTION: Final = Unit("friction over speed", "N·m·s/rad")
STIFFNESS: Final = Unit("stiffness", "N·m/rad")
INERTIA: Final = Unit("moment of inertia", "kg·m²")
TIME: Final = Unit("time", "s")
FREQUENCY: Final = Unit("frequency", "Hz")
SHARE: Final = Unit("share", "1")
BIT_RATE: Final = Unit("bit rate", "bit/s")
MILLINEWTON_METRE: Final = Unit("torque", "mN·m", 1.0, 1e3)
KILONEWTON_METRE: Final = Unit("torque", "kN·m", 1e3)
POUND_FOOT: Final = Unit("torque", "lbf·ft", 1.3558179483314004)
DEGREE: Final = Unit("angle", "°", _TURN, 360.0)
DEGREE_S: Final = Unit("speed", "°/s", _TURN, 360.0)
TURNS_S: Final = Unit("speed", "rev/s", _TURN)
RPM_S: Final = Unit("acceleration", "rpm/s", _TURN, 60.0)
MILLISECOND: Final = Unit("time", "ms", 1.0, 1e3)
MICROSECOND: Final = Unit("time", "µs", 1.0, 1e6)
MINUTE: Final = Unit("time", "min", 60.0)
HOUR: Final = Unit("time", "h", 3600.0)
PERCENT: Final = Unit("share", "%", 1.0, 100.0)
PERMILLE: Final = Unit("share", "‰", 1.0, 1000.0)

TEMPERATURE: Final = Unit("temperature", "°C")
_KILOBIT, _MEGABIT = Unit("bit rate", "kbit/s", 1e3), Unit("bit rate", "Mbit/s", 1e6)
_TURN_ANGLE = Unit("angle", "turns", _TURN)
_DEGREE_S2, _TURNS_S2 = Unit("acceleration", "°/s²", _TURN, 360.0), Unit("acceleration", "rev/s²", _TURN)
_KILO_RATE = Unit("change of torque", "kN·m/s", 1e3)
_FRICTION_RPM = Unit("friction over speed", "N·m/rpm", 60.0, _TURN)
_STIFFNESS_DEGREE = Unit("stiffness", "N·m/°", 360.0, _TURN)
_KILO_STIFFNESS = Unit("stiffness", "kN·m/rad", 1e3)
_CENTI = Unit("moment of inertia", "kg·cm²", 1.0, 1e4)
_TONNE = Unit("moment of inertia", "t·m²", 1e3)
_KILOHERTZ, _MILLIHERTZ = Unit("frequency", "kHz", 1e3), Unit("frequency", "mHz", 1.0, 1e3)

# Spellings of each unit, in any case, without spaces and the signs · . * - _ ^.
_SPELT: Final[tuple[tuple[Unit, str], ...]] = (
    (SPEED, "rad/s rads rad/sec rads1"),
    (RPM, "rpm r/min rev/min revs/min 1/min /min min1 u/min upm"),
    (TURNS_S, "rps rev/s r/s"),
    (DEGREE_S, "deg/s °/s degs"),
    (ACCELERATION, "rad/s2 rads2 rad/s/s"),
    (RPM_S, "rpm/s rpms rev/min/s 1/min/s min1/s u/min/s"),
    (_DEGREE_S2, "deg/s2 °/s2 degs2"),
    (_TURNS_S2, "rev/s2"),
    (ANGLE, "rad"),
    (DEGREE, "° deg degree degrees"),
    (_TURN_ANGLE, "turn turns rev revs"),
    (TORQUE, "nm"),
    (MILLINEWTON_METRE, ""),           # by case alone: mNm is no MNm
    (KILONEWTON_METRE, "knm"),
    (POUND_FOOT, "lbfft ftlbf lbft ftlb ftlbs"),
    (TORQUE_RATE, "nm/s"),
    (_KILO_RATE, "knm/s"),
    (FRICTION, "nms/rad nm/(rad/s) nmsrad"),
    (_FRICTION_RPM, "nm/rpm"),
    (STIFFNESS, "nm/rad"),
    (_STIFFNESS_DEGREE, "nm/° nm/deg"),
    (_KILO_STIFFNESS, "knm/rad"),
    (INERTIA, "kgm2"),
    (_CENTI, "kgcm2"),
    (_TONNE, "tm2"),
    (TIME, "s sec second seconds"),
    (MILLISECOND, "ms msec"),
    (MICROSECOND, "us µs usec"),
    (MINUTE, "min minute minutes"),
    (HOUR, "h hour hours"),
    (FREQUENCY, "hz"),
    (_KILOHERTZ, "khz"),
    (PERCENT, "% pct percent"),
    (PERMILLE, "‰ permille promille permil"),
    (TEMPERATURE, "°c c degc"),
    (BIT_RATE, "bit/s bits/s bps bd baud"),
    (_KILOBIT, "k kbit/s kbits/s kbps kbit kbd kbaud"),
    (_MEGABIT, "mbit/s mbits/s mbps mbit mbd mbaud"),
)
_UNITS: Final = {word: unit for unit, words in _SPELT for word in words.split()}
_CASE_COUNTS: Final = {"M": _MEGABIT, "mHz": _MILLIHERTZ, "MHz": None, "m": None, "Ms": None, "MS": None,
                       "mNm": MILLINEWTON_METRE, "MNm": None}
SIGNS_IGNORED: Final = re.compile(r"[\s·.*⋅_^⁻-]")
_NUMBER: Final = re.compile(
    r"\s*([-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)(?![0-9])\s*(\S.*)?", re.DOTALL
)
_COMMA: Final = re.compile(r",[0-9]")
_LONGEST: Final = 60
"""Longest text of a quantity, characters."""

# Endings of a key's name and their units. If several fit, the longest counts.
_ENDINGS: Final = {
    "rad_s": SPEED, "rad_s2": ACCELERATION, "rad": ANGLE, "nm": TORQUE, "nm_s": TORQUE_RATE, "nm_s_rad": FRICTION,
    "nm_rad": STIFFNESS, "kg_m2": INERTIA, "s": TIME, "hz": FREQUENCY, "rel_sd": SHARE, "share": SHARE,
    "tolerance": SHARE, "confidence": SHARE, "bitrate": BIT_RATE, "baud": BIT_RATE,
    "rpm": RPM, "rpm_s": RPM_S, "deg": DEGREE, "turns": _TURN_ANGLE, "deg_s": DEGREE_S, "deg_s2": _DEGREE_S2,
    "knm": KILONEWTON_METRE, "knm_s": _KILO_RATE, "ms": MILLISECOND, "us": MICROSECOND, "percent": PERCENT,
    "permille": PERMILLE, "kg_cm2": _CENTI, "c": TEMPERATURE, "khz": _KILOHERTZ,
}


_NOTHING: Final = 1e-9
"""SI value below which a quantity is rounding of the arithmetic: 8.8e-12 s is no lag."""


def plain_number(number: float, digits: int = 4) -> str:
    """Return the number with some significant digits, without an exponent from 1e-4 to 1e9; below 1e-9 it is 0."""
    if abs(number) < _NOTHING:
        return "0"
    return f"{float(f'{number:.{digits}g}'):.9g}"


_EXACT_DIGITS: Final = 12
"""Significant digits of a double that count. The rounding of the arithmetic below them moves no printed end."""


def printed_ends(low: float, high: float, decimals: int) -> tuple[str, str]:
    """Return the ends of an interval with some decimals, rounded outwards: the printed interval contains the true one.

    Negative decimals round to tens and hundreds.
    """
    step = Decimal(1).scaleb(-decimals)
    found = []
    for number, way in ((low, ROUND_FLOOR), (high, ROUND_CEILING)):
        if not math.isfinite(number):
            found.append(plain_number(number))
            continue
        whole = (Decimal(f"{number:.{_EXACT_DIGITS}g}") / step).to_integral_value(way)
        found.append(f"{float(whole * step) + 0.0:.{max(0, decimals)}f}")          # avoids −0
    return found[0], found[1]


def printed_bound(value: float, digits: int, *, up: bool = False) -> str:
    """Return a positive number with some significant digits, rounded down, or up: 4.97 Hz is no bandwidth of 5 Hz."""
    if not 0.0 < value < math.inf:
        return f"{value:.{digits}g}"
    return printed_ends(value, value, digits - 1 - math.floor(math.log10(value)))[up]


def printed_share(share: float) -> str:
    """Return ``±0.80 %`` for 0.008, the half-width of an interval as a share: two significant digits, rounded up."""
    if not math.isfinite(share):
        return "±?"
    percent = 100.0 * share
    if percent <= 0.0:
        return "±0 %"
    return f"±{printed_ends(0.0, percent, 1 - math.floor(math.log10(percent)))[1]} %"


def printed_interval(low: float, high: float, digits: int = 4, sign: bool = False) -> str:
    """Return ``103.1 to 104.8``: some significant digits of the larger end, rounded outwards, without zeros at the end.

    ``sign``: also a plus.
    """
    largest = max(abs(low), abs(high))
    decimals = digits - 1 - math.floor(math.log10(largest)) if 0.0 < largest < math.inf else 0
    ends = (one.rstrip("0").rstrip(".") if "." in one else one for one in printed_ends(low, high, decimals))
    return " to ".join(f"{'+' if sign and not one.startswith('-') else ''}{one}" for one in ends)


def in_rad_s_and_rpm(*speeds_rad_s: float) -> str:
    """Return a speed, or a range of two, in both units: ``0.5 to 10 rad/s (4.77 to 95.5 rpm)``."""
    radians, turns = (" to ".join(plain_number(unit.of_si(one), 3) for one in speeds_rad_s) for unit in (SPEED, RPM))
    return f"{radians} rad/s ({turns} rpm)"


def rpm_advice(value: float, flag: str, low: float, high: float) -> str:
    """Return the advice for a speed in rad/s that was probably meant in rpm, and would fit between two speeds."""
    typed = plain_number(value)
    fits = low <= RPM.si(value) <= high and float(typed) == value
    return f"If you meant rpm, write {flag} {typed}rpm. Otherwise change" if fits else "Change"


def share_advice(value: float) -> str:
    """Return the advice for a share that was probably meant in percent; '' for any other value."""
    if not 1.0 <= value <= 100.0:
        return ""
    return f"{value:g} means {100.0 * value:g} %. For {value:g} % write {value:g}% or {PERCENT.si(value):g}"


_SMALLEST: Final = 1e-6


def excludes_zero(limit: float, value: float) -> bool:
    """Return whether the lowest permitted value only excludes 0, and ``value`` is not positive."""
    return 0.0 < limit <= _SMALLEST and value <= 0.0


def in_nm(torque_nm: float) -> str:
    """Return a torque with its unit, for a message: ``1143 N·m``, ``0.2133 N·m``. A servo drive has 1 N·m or less."""
    return f"{plain_number(torque_nm)} N·m"


def unit_of(text: str) -> Unit | None:
    """Return the unit that ``text`` spells: ``rpm``, ``1/min``, ``N.m``, ``kg m^2``; None if it is unknown."""
    bare = SIGNS_IGNORED.sub("", text.replace("¹", "1").replace("²", "2"))
    folded = bare.casefold().replace("\u03bc", "\u00b5")       # casefold makes a Greek mu of the micro sign
    return _CASE_COUNTS[bare] if bare in _CASE_COUNTS else _UNITS.get(folded)


def split(text: str) -> tuple[float, str] | None:
    """Return the number and the text behind it (``''`` without one); None if the text does not begin with a number."""
    if len(text) > _LONGEST or (found := _NUMBER.fullmatch(text)) is None:
        return None
    value = float(found[1])
    return (value, (found[2] or "").strip()) if math.isfinite(value) else None


def read(text: str, unit: Unit) -> float:
    """Return the quantity ``text`` in ``unit``. A number alone is in ``unit``. Raises ValueError with a text for the
    user, which repeats no number.
    """
    parts = split(text)
    if parts is None:
        raise ValueError(f"must be a number and its unit, such as '3 {example(unit)}'")
    value, word = parts
    given = unit_of(word) if word else unit
    if given is None and _COMMA.match(word):
        raise ValueError("a number has a decimal point and no comma")
    if given is None:
        raise ValueError(f"'{word}' is not a unit of {unit.dimension}; use {', '.join(known(unit))}")
    if given.dimension != unit.dimension:
        raise ValueError(f"{given.symbol} is a unit of {given.dimension}, not of {unit.dimension}; "
                         f"use {', '.join(known(unit))}")
    converted = value if given == unit else unit.of_si(given.si(value))
    if not math.isfinite(converted):
        raise ValueError("too large for a number")
    return converted


def example(unit: Unit) -> str:
    """Return the unit's spelling as a user can type it."""
    return "%" if unit.dimension == "share" else unit.symbol


def known(unit: Unit) -> tuple[str, ...]:
    """Return the symbols of the same dimension, for a message."""
    return tuple(one.symbol for one, _ in _SPELT if one.dimension == unit.dimension)


def key_ending(key: str) -> tuple[str, Unit] | None:
    """Return a quantity's key without its unit, and the unit: ``speed_max_rpm`` → (speed_max, rpm)."""
    parts = key.split("_")
    for start in range(len(parts)):
        if (unit := _ENDINGS.get("_".join(parts[start:]))) is not None:
            # 'tolerance' is the name of the quantity, 'torque_scale_rel_sd' ends with its unit. The base distinguishes
            # such keys.
            base = key if unit is SHARE else "_".join(parts[:start])
            return base, unit
    return None


def unit_of_key(key: str) -> Unit | None:
    """Return the unit of the key's value; None if its name states none."""
    found = key_ending(key)
    return found[1] if found is not None else None


def same_quantity(key: str, other: str) -> bool:
    """Return whether two keys are one quantity in different units, such as ``speed_max_rpm`` and
    ``speed_max_rad_s``.
    """
    one, two = key_ending(key), key_ending(other)
    if one is None or two is None or one[1] == two[1] or one[1].dimension != two[1].dimension:
        return False
    bases = {key.removesuffix("_percent").removesuffix("_permille"), other} if two[1] is SHARE else {one[0], two[0]}
    return len(bases) == 1


def shown(value: float, unit: Unit) -> str:
    """Return the value for messages: ``10.47 rad/s``; a share as a number alone."""
    number = f"{value:.4g}" if not float(value).is_integer() or abs(value) >= 1e9 else f"{value:.0f}"
    return number if unit is SHARE else f"{number} {unit.symbol}"
