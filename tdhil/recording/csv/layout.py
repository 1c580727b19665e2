"""Layout of a trace: the header with its units, and the first row of numbers.

A unit is taken from ``--columns``, else from a row of units below the header, else from the column's name
(``n_rpm``, ``Speed [rpm]``), else SI, reported as an assumption. A file that contradicts itself is refused.
"""

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

from profiles import quantities
from tdhil.errors import CsvMisnamed, CsvUnusable, MessageCode, UsageError, shown
from tdhil.recording.csv.text import decimal_sign, is_missing, looks_numeric, perhaps_thousands, split_cells

# ---------------------------------------------------------------------------------------------------------------------
# Units that the tools of drives write, and their values in SI.
#
# A value in SI is value · factor. For shares of the rated torque the factor applies to ``--rated-torque``. 1/s means a
# revolution a second, as in data sheets; a tool that writes 1/s for rad/s needs ``--columns``. Hz of a file is no unit
# of speed: the output frequency of an inverter is that of the stator, pole pairs times the turns of the shaft, plus
# slip.


QUANTITIES = ("time", "speed", "torque")
SI = {"time": "s", "speed": "rad/s", "torque": "N·m"}


@dataclass(frozen=True)
class ColumnUnit:
    """Unit of a column. ``factor`` into SI; ``of_rated``: the factor is a share of the rated torque; ``assumed``: it
    is not stated.
    """

    quantity: str
    symbol: str
    factor: float
    of_rated: bool = False
    assumed: bool = False


_TURNS = ColumnUnit("speed", "1/s", quantities.TURNS_S.times)
_PERCENT = ColumnUnit("torque", "%", 1e-2, of_rated=True)
_PERMILLE = ColumnUnit("torque", "‰", 1e-3, of_rated=True)

# Units of traces besides `profiles.quantities`, which accepts no ambiguous unit.
_ALSO = {
    "time": {},
    "speed": dict.fromkeys(("1/s", "s1"), _TURNS),
    "torque": {
        "%": _PERCENT, "pct": _PERCENT, "percent": _PERCENT, "‰": _PERMILLE, "permille": _PERMILLE,
        "promille": _PERMILLE, "permil": _PERMILLE,
    },
}
_TOLD_ONLY = {"speed": {"hz": ColumnUnit("speed", "Hz", quantities.TURNS_S.times)}}
_BRACKETED = re.compile(r"^(.*?)\s*[\[(<]\s*([^\[\]()<>]*?)\s*[\])>]$")


def unit_of(quantity: str, text: str, *, told: bool = False) -> ColumnUnit | None:
    """Return the unit that ``text`` spells for a quantity: ``rpm``, ``[1/min]``, ``N.m``; None if it is unknown.

    ``told``: the user states it, so that it may be a unit that has another meaning in a file.
    """
    found = _BRACKETED.match(text.strip())
    inner = found.group(2) if found is not None and not found.group(1) else text
    # case distinguishes mN·m from MN·m; it does not matter for a time, because no tool samples in megaseconds
    word = quantities.SIGNS_IGNORED.sub("", inner.replace("¹", "1").casefold())
    more = _TOLD_ONLY.get(quantity, {}) if told else {}
    if (also := _ALSO[quantity].get(word) or more.get(word)) is not None:
        return also
    known = quantities.unit_of(inner if quantity != "time" else inner.casefold())
    if known is None or known.dimension != quantity:
        return None
    return ColumnUnit(known.dimension, known.symbol, known.times / known.over)


def split_name(name: str) -> tuple[str, str]:
    """Return name and unit: ``Speed [rpm]`` → (Speed, rpm); a name without brackets has no unit."""
    found = _BRACKETED.match(name)
    return (found.group(1), found.group(2)) if found is not None and found.group(1) else (name, "")


def unit_in_name(quantity: str, name: str) -> ColumnUnit | None:
    """Return the unit at the end of a column's name: ``speed_rad_s``, ``n_rpm``, ``Torque [%]``; the longest ending
    counts.
    """
    base, bracketed = split_name(name)
    if bracketed:
        return unit_of(quantity, bracketed)
    parts = re.split(r"[_ ]", base)
    endings = ("_".join(parts[start:]) for start in range(1, len(parts)))
    return next((unit for ending in endings if (unit := unit_of(quantity, ending)) is not None), None)


_CURRENTS = frozenset(("a", "ma", "ka", "amp", "amps", "ampere", "amperes", "arms"))
# Units that are not of `profiles.quantities`, as they end a name: in brackets no list is needed.
_ODD_UNITS = _CURRENTS | frozenset((
    "pu", "kw", "volt", "volts", "mnm", "ncm", "kgm", "kgfm", "kgcm", "kgfcm", "kpm", "inlb", "inlbs", "inlbf", "lbin",
    "lbsin", "lbfin", "ozin", "ozfin", "inoz", "krpm", "mps", "kmh", "inc", "incs", "increments", "count", "counts",
    "cnt", "digit", "digits", "lsb", "tick", "ticks", "sample", "samples",
))


def odd_unit(quantity: str, name: str) -> str:
    """Return the unit in a column's name that is none of the quantity, else ``''``: ``I_A``, ``I [A]`` → A.

    A unit of the quantity before other words counts, too, because they may change it: ``torque_percent_of_limit``. A
    letter alone is an axis or a phase, except ``_a``.
    """
    base, bracketed = split_name(name)
    if bracketed:
        return "" if unit_of(quantity, bracketed) else bracketed
    if unit_in_name(quantity, base) is not None:
        return ""
    parts = re.split(r"[_ ]", base)
    for start in range(1, len(parts)):
        ending, first = "_".join(parts[start:]), unit_of(quantity, parts[start])
        if (_is_any_unit(ending) and (len(ending) > 1 or base[-2] == "_")) or (
                first is not None and len(parts[start]) > 1 and first.symbol != SI[quantity]):
            return ending
    return ""


def _is_any_unit(text: str) -> bool:
    """Return whether a text is a unit of any quantity. Of the letters only A is one."""
    word = quantities.SIGNS_IGNORED.sub("", text.casefold())
    return word in _ODD_UNITS or (
        len(word) > 1 and word not in _SETPOINT_WORDS and quantities.unit_of(word) is not None)


# Words in names of columns that are not the actual value, in English and German. `reference` is a setpoint in the trace
# of a drive; in a calibration it is the sensor that is compared with.
_REFERENCE_WORDS = frozenset(("ref", "reference"))
_SETPOINT_WORDS = frozenset((
    "set", "setpoint", "soll", "sollwert", "target", "cmd", "command", "commanded", "demand", "demanded", "max", "min",
    "limit", "limits", "error", "deviation", *_REFERENCE_WORDS,
))
_SETPOINT_ENDS = ("soll", "setpoint", "target", "limit", "demand", "command", "grenz")
_SEPARATORS = re.compile(r"[^a-zäöüω]+")
_HUMP = re.compile(r"(?<=[a-zäöü])(?=[A-ZÄÖÜ])")


def words_of(quantity: str, name: str) -> frozenset[str]:
    """Return the words of a column's name, in lower case, without its unit: ``Torque limit [Nm]`` → torque, limit."""
    parts = re.split(r"[_ ]", split_name(name)[0])
    end = next((at for at in range(len(parts)) if unit_of(quantity, "_".join(parts[at:])) is not None), len(parts))
    humps = _HUMP.split("_".join(parts[:end]))
    return frozenset(word for part in humps for word in _SEPARATORS.split(part.casefold()) if word)


def is_setpoint(quantity: str, name: str, *, sensor: bool = False) -> bool:
    """Return whether a column of speed or torque is, by its name, a setpoint, a demand, a command, a limit or an error.

    ``sensor``: the trace is of a sensor that is a reference for a calibration, so that this word is no setpoint.
    """
    if quantity == "time":
        return False
    known = _SETPOINT_WORDS - _REFERENCE_WORDS if sensor else _SETPOINT_WORDS
    return any(word in known or word.startswith(_SETPOINT_ENDS) or word.endswith(_SETPOINT_ENDS)
               for word in words_of(quantity, name))


def known_units(quantity: str) -> tuple[str, ...]:
    """Return the symbols that a message offers."""
    plain = {"time": quantities.TIME, "speed": quantities.SPEED, "torque": quantities.TORQUE}[quantity]
    more = (*_ALSO[quantity].values(), *_TOLD_ONLY.get(quantity, {}).values())
    return tuple(dict.fromkeys((*quantities.known(plain), *(unit.symbol for unit in more))))


# ---------------------------------------------------------------------------------------------------------------------
# Columns as given on the command line: ``time=t_s speed=n_rpm:rpm torque=m_pct:%``.


_WHERE = "--columns"
REFERENCE_FLAG = "--column"


@dataclass(frozen=True)
class ColumnChoice:
    """Choice of the column ``name`` for ``quantity``; ``unit`` None: from the file. Without a name: the usual names."""

    quantity: str
    name: str = ""
    unit: ColumnUnit | None = None


Choices = tuple[ColumnChoice, ...]
USUAL: Choices = (ColumnChoice("time"), ColumnChoice("speed"), ColumnChoice("torque"))
TIME_AND_TORQUE = ("time", "torque")


def parse_columns(items: Iterable[str], quantities: Sequence[str] = QUANTITIES, flag: str = _WHERE) -> Choices:
    """Return the columns of ``quantities``, in this order; a column without a choice has its usual name. Raises
    UsageError.

    ``flag``: the option that contains the choices.
    """
    found: dict[str, ColumnChoice] = {}
    example = {"time": "time=t_s", "speed": "speed=n_rpm:rpm", "torque": "torque=m:Nm"}
    such_as = f"Such as: {flag} {' '.join(example[quantity] for quantity in quantities)}"
    for item in items:
        quantity, equals, name = item.partition("=")
        quantity = quantity.strip().casefold()
        if not equals or not name.strip():
            raise UsageError(f"{shown(item)!r} is not quantity=column", where=flag, next_step=such_as,
                             entry=MessageCode.CSV_COLUMNS_UNCLEAR)
        if quantity not in quantities:
            meant = difflib.get_close_matches(quantity, quantities, 1)
            hint = f"; did you mean {meant[0]!r}?" if meant else f"; there are {', '.join(quantities)}"
            raise UsageError(f"there is no quantity {shown(quantity)!r}{hint}", where=flag, next_step=such_as,
                             entry=MessageCode.CSV_COLUMNS_UNCLEAR)
        if quantity in found:
            raise UsageError(f"{quantity} is named twice", where=flag, entry=MessageCode.CSV_COLUMNS_UNCLEAR)
        column, colon, spelt = name.strip().rpartition(":")
        unit = unit_of(quantity, spelt, told=True)
        if not colon or spelt.startswith(" "):       # "Axis 1: speed" is a complete name
            found[quantity] = ColumnChoice(quantity, name.strip())
        elif column and unit is not None:
            found[quantity] = ColumnChoice(quantity, column.strip(), unit)
        else:
            raise UsageError(
                f"{shown(spelt)!r} is not a unit of {quantity}; use {', '.join(known_units(quantity))}",
                where=flag, next_step="If the colon belongs to the column's name, write the unit behind another colon",
                entry=MessageCode.CSV_COLUMNS_UNCLEAR,
            )
    names = [choice.name.casefold() for choice in found.values()]
    if len(set(names)) < len(names):
        raise UsageError("one column can't hold two quantities", where=flag, next_step=such_as,
                         entry=MessageCode.CSV_COLUMNS_UNCLEAR)
    return tuple(found.get(quantity, ColumnChoice(quantity)) for quantity in quantities)


# ---------------------------------------------------------------------------------------------------------------------
# Place of the table, separator of its cells, and columns of time, speed and torque.
#
# The header is the first line with all three columns; lines above it are ignored. Names are compared without regard to
# case, first complete, then without a unit in brackets.


HEADER_LINES = 50
_STANDARD = {"time": "time_s", "speed": "speed_rad_s", "torque": "torque_nm"}
MOST_COLUMNS = 512
DELIMITERS = ("\t", ";", ",")


@dataclass(frozen=True)
class Header:
    """Header of a table. ``line`` counts from 1; ``columns``: positions of the choices in ``names``, time first."""

    line: int
    delimiter: str
    names: tuple[str, ...]
    columns: tuple[int, ...]


def find_header(lines: Sequence[str], choices: Choices, file: str) -> Header:
    """Return the header from the file's first lines. Raises CsvMisnamed without a column, CsvUnusable without a
    table.
    """
    best: tuple[tuple[int, int, int], int, list[str]] | None = None
    usual = ",".join(_STANDARD[choice.quantity] for choice in choices)
    sensor = columns_flag(choices) == REFERENCE_FLAG
    for number, line in enumerate(lines[:HEADER_LINES], 1):
        for delimiter in DELIMITERS:
            if delimiter not in line:
                continue
            names = split_cells(line, delimiter)
            if len(names) > MOST_COLUMNS:
                raise CsvUnusable(f"more than {MOST_COLUMNS} columns", where=f"{file}:{number}")
            found = [_positions(names, choice, sensor=sensor) for choice in choices]
            if all(found):
                return Header(number, delimiter, tuple(names), _one_each(found, names, choices, f"{file}:{number}"))
            words = sum(bool(name) and not looks_numeric(name) for name in names)
            score = (sum(map(bool, found)), words, -number)
            if best is None or score > best[0]:
                best = score, number, names
    if best is None:
        raise CsvUnusable(
            f"there is no table: no comma, semicolon or tab in the first {HEADER_LINES} lines", where=file,
            next_step="Export the trace as CSV, with a header above its columns",
        )
    (_, words, _), number, names = best
    if words < 2:
        raise CsvMisnamed(
            f"no header in the first {HEADER_LINES} lines", where=file,
            next_step=f"Put a line with the columns' names above them, such as {usual}",
        )
    missing = next(choice for choice in choices if not _positions(names, choice, sensor=sensor))
    raise _no_column(missing, names, f"{file}:{number}", choices)


def _positions(names: Sequence[str], choice: ColumnChoice, *, sensor: bool) -> list[int]:
    """Return the columns that fit a choice: by the whole name, else by the name without its unit.

    A column that is no actual value by its name fits only if the choice names it.
    """
    full = [_folded(name) for name in names]
    bare = [_folded(split_name(name)[0]) for name in names]
    if choice.name:
        wanted = _folded(choice.name)
        exact = [at for at, name in enumerate(full) if name == wanted]
        return exact or [at for at, name in enumerate(bare) if name == wanted]
    quantity = choice.quantity
    exact = [at for at, name in enumerate(full) if name == _STANDARD[quantity]]
    return exact or [
        at for at, name in enumerate(bare)
        if name == quantity or (name.startswith(f"{quantity}_") and unit_in_name(quantity, names[at]) is not None
                                and not is_setpoint(quantity, names[at], sensor=sensor))
    ]


def _folded(name: str) -> str:
    return " ".join(name.casefold().split())


def _one_each(
    found: Sequence[Sequence[int]], names: Sequence[str], choices: Choices, where: str
) -> tuple[int, ...]:
    for choice, positions in zip(choices, found, strict=True):
        if len(positions) > 1:
            several = ", ".join(repr(shown(names[at])) for at in positions[:4])
            raise CsvMisnamed(
                f"{len(positions)} columns could be {choice.quantity}: {several}", where=where,
                next_step=f"Name one with {columns_flag(choices)}, and rename it in the file if the names are the same",
            )
    chosen = tuple(positions[0] for positions in found)
    if len(set(chosen)) < len(chosen):
        raise CsvMisnamed("one column would hold two quantities", where=where,
                          next_step=f"Name all with {columns_flag(choices)}")
    return chosen


def columns_flag(choices: Choices) -> str:
    """Return the option that names these columns: `--column` for a reference without a speed, else `--columns`."""
    return _WHERE if len(choices) == len(QUANTITIES) else REFERENCE_FLAG


def _no_column(choice: ColumnChoice, names: Sequence[str], where: str, choices: Choices) -> CsvMisnamed:
    there = [name for name in names if name]
    listed = ", ".join(shown(name) for name in there[:12]) + (", …" if len(there) > 12 else "")
    wanted = choice.name or choice.quantity
    sensor = columns_flag(choices) == REFERENCE_FLAG
    others = [] if choice.name else [name for name in there if choice.quantity in name.casefold()
                                     and is_setpoint(choice.quantity, name, sensor=sensor)]
    if others:
        several = ", ".join(repr(shown(name)) for name in others[:4])
        return CsvMisnamed(
            f"no column holds the actual {choice.quantity}. By name, {several} {'is' if len(others) == 1 else 'are'} a "
            "setpoint, a limit or an error", where=where,
            next_step=f"Name the column of the actual {choice.quantity}: {columns_flag(choices)} {choice.quantity}=…. "
            f"The columns are: {listed}. A setpoint is read only if it is named here",
        )
    folded = {_folded(form): name for name in there for form in (split_name(name)[0], name)}
    close = difflib.get_close_matches(_folded(wanted)[:80], [form[:80] for form in folded], 1)
    hint = f"; did you mean {shown(folded.get(close[0], close[0]))!r}?" if close else ""
    missing = f"no column {shown(wanted)!r}" if choice.name else f"no column is called {choice.quantity}"
    step = f"The columns are: {listed}"
    if not choice.name:
        step += f". Say which is which: {columns_flag(choices)} {' '.join(f'{one.quantity}=…' for one in choices)}"
    return CsvMisnamed(f"{missing}{hint}", where=where, next_step=step)


# ---------------------------------------------------------------------------------------------------------------------

_BELOW = 5          # most rows between the header and the numbers
_LOOKED_AT = 5000   # rows examined for the decimal sign


@dataclass(frozen=True)
class ColumnLayout:
    """Layout: ``units`` of the columns; ``clock``: times are clock times; ``comma``: the decimal sign."""

    header: Header
    first_line: int
    units: tuple[ColumnUnit, ...]
    clock: bool
    comma: bool
    assumed: tuple[str, ...]


def find_layout(lines: Sequence[str], choices: Choices, file: str) -> ColumnLayout:
    """Return the layout from the first block. Raises CsvMisnamed for columns and units, CsvUnusable without numbers."""
    header = find_header(lines, choices, file)
    below = range(header.line, min(header.line + _BELOW + 1, len(lines)))     # positions of the lines below the header
    rows = {at: _wanted(lines[at], header) for at in below if lines[at].strip()}
    first = next((at for at, row in rows.items() if _holds_data(row)), None)
    if first is None:
        raise CsvUnusable(
            f"no numbers in {named(choices)} in the lines below the header ({_listed(header)})",
            where=f"{file}:{header.line}", next_step="Look at the file in an editor",
        )
    quantities = [choice.quantity for choice in choices]
    stated = next(
        (row for at, row in rows.items() if at < first and _states_units(quantities, row)), [""] * len(choices)
    )
    clock = ":" in rows[first][0]
    # the first lines, and some later ones with a sign that is no separator: at standstill all values are 0
    later = chain.from_iterable(islice((line for line in lines[first + _LOOKED_AT:] if sign in line), _LOOKED_AT)
                                for sign in ",." if header.delimiter != ",")
    seen = [_wanted(line, header)[clock:] for line in chain(lines[first:first + _LOOKED_AT], later)]
    sign = decimal_sign(seen)
    if sign == "?":
        raise CsvUnusable(
            "some numbers have a decimal comma and some a decimal point", where=f"{file}:{first + 1}",
            next_step="Export again with one of them, and without signs between thousands",
        )
    where = f"{file}:{header.line}"
    units, assumed = [], [f"{file}: numbers were read with a decimal comma"] if sign == "," else []
    for position, choice in enumerate(choices):
        if clock and choice.quantity == "time":
            units.append(ColumnUnit("time", "clock", 1.0))
            assumed.append(f"{file}: clock times; the first row is at 0 s")
            continue
        name = header.names[header.columns[position]]
        unit, notes = _unit(choice, name, stated[position], where, columns_flag(choices))
        units.append(unit)
        assumed += [f"{file}: {note}" for note in notes]
    # a table with commas between its cells has no points between thousands, and a drive's trace no steps of 1 s
    if (sign == "," or header.delimiter != ",") and (clock or units[0].factor < 1.0 or not any(
            sign in row[0] for row in seen)) and (doubt := perhaps_thousands(seen)) is not None:
        at, cell = doubt
        name, word = shown(header.names[header.columns[at + clock]]), "comma" if sign == "," else "point"
        raise CsvUnusable(
            f"the {word} in {cell!r}, of column {name!r}, may be a decimal sign or may separate thousands",
            where=f"{file}:{first + 1}",
            next_step=f"Export again without signs between thousands. If the {word} is the decimal sign, write one "
            f"number of this column with four decimals in a copy of the file, such as {cell}0",
        )
    return ColumnLayout(header, first + 1, tuple(units), clock, sign == ",", tuple(assumed))


def _states_units(quantities: Sequence[str], row: Sequence[str]) -> bool:
    """Return whether a row below the header is a row of units: one is a unit, or all are in brackets."""
    return any(map(unit_of, quantities, row)) or any(_is_any_unit(cell.strip("[](){}<> ")) for cell in row) or all(
        (found := _BRACKETED.match(cell.strip())) is not None and not found.group(1) for cell in row)


def _wanted(line: str, header: Header) -> list[str]:
    cells = split_cells(line, header.delimiter)
    return [cells[at] if at < len(cells) else "" for at in header.columns]


def _holds_data(row: Sequence[str]) -> bool:
    """Return whether a row has a time and numbers or empty cells: channels that start late are empty at first."""
    timed = looks_numeric(row[0]) or (":" in row[0] and any(sign.isdigit() for sign in row[0]))
    values = [looks_numeric(cell) for cell in row[1:]]
    return (timed or is_missing(row[0])) and all(
        known or is_missing(cell) for known, cell in zip(values, row[1:], strict=True)
    ) and timed + sum(values) >= 1


def named(choices: Choices) -> str:
    """Return the quantities as ``time, speed and torque``."""
    *first, last = (choice.quantity for choice in choices)
    return f"{', '.join(first)} and {last}"


def _unit(choice: ColumnChoice, name: str, stated: str, where: str, flag: str) -> tuple[ColumnUnit, list[str]]:
    """Return the unit of one column, and remarks about it."""
    quantity = choice.quantity
    below = unit_of(quantity, stated)
    named = unit_in_name(quantity, name)
    notes = [f"{shown(name)!r} is a setpoint, a limit or an error by its name. It was read as the actual {quantity}, "
             "as told"] if is_setpoint(quantity, name, sensor=flag == REFERENCE_FLAG) else []
    if choice.unit is not None:
        other = below or named
        if choice.unit.symbol == "Hz":
            notes.append(f"{shown(name)!r} in Hz was read as revolutions of the shaft a second, as told")
        if other is not None and other != choice.unit:
            notes.append(f"{quantity} was read in {choice.unit.symbol} as told; the file says {other.symbol}")
        return choice.unit, notes
    # SI is assumed only if the file states no unit: a unit that is not known would be a wrong factor
    odd = stated if below is None and not is_missing(stated) else odd_unit(quantity, name) if below is None else ""
    next_step = f"behind a colon: {flag} {quantity}='{shown(name)}:…'"
    if odd:
        what, first = f"{shown(odd)!r}, of column {shown(name)!r}, is ", "Convert the column"
        if quantity == "torque" and odd.casefold() in _CURRENTS:
            what += "a unit of current. A current is not a torque"
            first += " with the torque constant of the motor"
        elif quantity == "speed" and odd.casefold() == "hz":
            what += ("a frequency. The output frequency of an inverter is that of the stator: the pole pairs times the "
                     "turns of the shaft a second, plus slip")
            raise CsvMisnamed(what, where=where, next_step="Export the actual speed of the motor, such as in rpm. If "
                              f"the column is the turns of the shaft a second, state Hz {next_step[:-2]}Hz'")
        else:
            what += f"not a unit of {quantity}; use {', '.join(known_units(quantity))}"
        raise CsvMisnamed(what, where=where,
                          next_step=f"{first}. If it is a {quantity} in another unit, state this unit {next_step}")
    if below is not None and named is not None and below != named:
        raise CsvMisnamed(
            f"the unit of {shown(name)!r} is {named.symbol} by its name but {below.symbol} by the row of units",
            where=where, next_step=f"State the right one {next_step}",
        )
    unit = below or named
    if unit is None:
        si = unit_of(quantity, SI[quantity])
        assert si is not None
        return replace(si, assumed=True), [*notes, f"no unit is stated for {shown(name)!r}; {SI[quantity]} was assumed"]
    if unit.symbol == "1/s":
        return unit, [*notes, f"{shown(name)!r} in 1/s was read as revolutions a second"]
    return unit, notes


def _listed(header: Header) -> str:
    return ", ".join(shown(header.names[at]) for at in header.columns)
