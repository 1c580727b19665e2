"""What a bare word in a YAML file means: the core rules of YAML 1.2, with 1.1's surprises defused.

=================================  ==========================================================
written                            read as
=================================  ==========================================================
``12`` ``+12`` ``0x1F`` ``0o17``   whole number
``1.5`` ``.5`` ``5.`` ``1e3``      number (YAML 1.1 takes ``1e3`` for text)
``true`` ``false``                 truth value (also True, TRUE …)
``null`` ``~``, nothing            empty
``010`` ``-08``                    refused: 8 in YAML 1.1, 10 in YAML 1.2
``.nan`` ``.inf`` ``1e999``        refused: no quantity in these files is one
``on`` ``off`` ``yes`` ``no``      text (a truth value in YAML 1.1)
``1_000`` ``12:30`` ``0b11``       text (numbers in YAML 1.1; ``12:30`` is 750 there)
``2024-05-01``                     text (a date in YAML 1.1)
anything in quotes                 text
=================================  ==========================================================

Text where a number or a truth value is wanted is refused later; `hint` then says what was meant.
"""

import math
import re

Scalar = None | bool | int | float | str

MAX_NUMBER_LENGTH = 40
"""Characters; longer ones are typing errors, and Python's conversion of them is quadratic."""

_NULL = frozenset({"", "~", "null", "Null", "NULL"})
_BOOL = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_INT = re.compile(r"[-+]?[0-9]+")
_LEADING_ZERO = re.compile(r"([-+]?)0+([0-9]+)")
_OCTAL = re.compile(r"0o[0-7]+")
_HEX = re.compile(r"0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_TRUTH_WORDS = {"on": "true", "yes": "true", "y": "true", "off": "false", "no": "false", "n": "false"}


def plain(text: str) -> Scalar:
    """The value of an unquoted scalar; ValueError, in words for the user, where it is refused."""
    if text in _NULL:
        return None
    if text in _BOOL:
        return _BOOL[text]
    if _NOT_FINITE.fullmatch(text):
        raise ValueError(f"{text} is no usable value; write a finite number, or leave the key out")
    return _number(text)


def _number(text: str) -> Scalar:
    if not any(pattern.fullmatch(text) for pattern in (_INT, _OCTAL, _HEX, _FLOAT)):
        return text
    if len(text) > MAX_NUMBER_LENGTH:
        raise ValueError(f"a number of {len(text)} characters; at most {MAX_NUMBER_LENGTH} are read")
    if zeros := _LEADING_ZERO.fullmatch(text):
        raise ValueError(_leading_zero(text, zeros[1], zeros[2]))
    if _INT.fullmatch(text):
        return int(text)
    if _OCTAL.fullmatch(text) or _HEX.fullmatch(text):
        return int(text, 0)
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is too large for a number")
    return value


def _leading_zero(text: str, sign: str, digits: str) -> str:
    decimal = f"write {sign}{digits}"
    octal = f" or 0o{digits}" if not sign and not set(digits) & set("89") else ""
    return f"{text} is ambiguous (octal in YAML 1.1, decimal in YAML 1.2); {decimal}{octal}, or put text in quotes"


def hint(text: str) -> str:
    """What the writer of ``text`` may have meant where a number or a truth value is wanted; '' if unknown."""
    if text.lower() in _TRUTH_WORDS:
        return f"write {_TRUTH_WORDS[text.lower()]}"
    if re.fullmatch(r"[-+]?[0-9][0-9_]*_[0-9_]*(\.[0-9_]*)?", text):
        return f"write {text.replace('_', '')}"
    if re.fullmatch(r"[-+]?[0-9]+(:[0-9]+)+(\.[0-9]*)?", text):
        return "write the value in the unit that the key names, without ':'"
    if re.fullmatch(r"[-+]?[0-9]+(,[0-9]+)+(\.[0-9]*)?", text):
        return "write it with a decimal point and without a comma"
    if len(text) <= MAX_NUMBER_LENGTH and _FLOAT.fullmatch(text):
        return f"write {text} without quotes"
    return ""
