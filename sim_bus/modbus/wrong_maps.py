"""Scripted register-level wrongs: the drive's map isn't what its profile says. Pure.

========================  ==========================================================================================
word_order                32-bit numbers stand with their halves exchanged
scale_10                  every scaled register counts in tenths: its number is ten times as large
address_off_by_one        every register stands one address higher
sign                      what the drive reports of signed registers has the opposite sign
unsigned                  signed registers have no sign: set below zero they read as large, reported is the magnitude
write_not_applied         parameters are written without an error, and keep what they had
reads_back_something_else `:NAME` the parameter NAME reads half as large again, and one more
========================  ==========================================================================================

A register that echoes a setpoint is another one, with a count and a type of its own: scale_10 and unsigned leave it as
it is, and what the drive has made of the setpoint shows there.
"""


from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

from sim_bus.fault_script import FaultRefused

# ---------------------------------------------------------------------------------------------------------------------
# How the drive refuses a request: a Modbus exception reply (Modbus application protocol, section 7).


class RequestRefused(Exception):
    """The request is answered by an exception of this code."""

    code = 4


class IllegalFunction(RequestRefused):
    """01: the drive doesn't know the function."""

    code = 1


class IllegalAddress(RequestRefused):
    """02: no such register, or not to be written."""

    code = 2


class IllegalValue(RequestRefused):
    """03: a count or a value that can't be."""

    code = 3


class DeviceFailure(RequestRefused):
    """04: understood, and can't be done now."""

    code = 4


# ---------------------------------------------------------------------------------------------------------------------

Kind = Literal["word_order", "scale_10", "address_off_by_one", "sign", "unsigned", "write_not_applied",
               "reads_back_something_else"]
KINDS: tuple[str, ...] = get_args(Kind)


@dataclass(frozen=True, slots=True)
class Wrong:
    """One wrong; ``of`` names the parameter that reads back something else."""

    kind: Kind
    of: str | None = None


def parse(text: str, parameters: Iterable[str] = ()) -> Wrong:
    """``scale_10``, or ``reads_back_something_else:time_out``; FaultRefused names what there is."""
    kind, _, of = text.partition(":")
    known = tuple(parameters)
    if kind not in KINDS:
        raise FaultRefused(f"no wrong is named '{kind[:40]}'", where="--wrong",
                           next_step=f"There are: {', '.join(KINDS)}")
    if (kind == "reads_back_something_else") != bool(of):
        raise FaultRefused(f"'{text[:60]}' is not complete or says too much", where="--wrong",
                           next_step="Only reads_back_something_else takes a parameter: reads_back_something_else:NAME")
    if of and known and of not in known:
        raise FaultRefused(f"the profile has no parameter '{of[:40]}'", where="--wrong",
                           next_step=f"It has: {', '.join(known)}")
    return Wrong(kind, of or None)  # type: ignore[arg-type]


def something_else(raw: int) -> int:
    """Return the value read instead of ``raw``."""
    return raw + abs(raw) // 2 + 1
