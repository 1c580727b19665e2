"""Scripted errors of the register map: the drive's map differs from its profile. Pure.

========================  ==========================================================================================
word_order                the halves of 32-bit numbers are exchanged
scale_10                  every scaled register counts in tenths: its number is ten times as large
address_off_by_one        every register has an address that is one higher
sign                      the reported values of signed registers have the opposite sign
unsigned                  signed registers have no sign: negative setpoints count as large, magnitudes are reported
write_not_applied         parameters are written without an error, and keep their values
reads_back_something_else `:NAME` the parameter NAME reads as 1.5 times its value plus one count
========================  ==========================================================================================

A register that echoes a setpoint is another register, with a count and a type of its own. scale_10 and unsigned do not
change it, so it shows the setpoint as received by the drive.
"""


from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

from sim_bus.fault_script import FaultRefused

# ---------------------------------------------------------------------------------------------------------------------
# Refusal of a request by the drive: a Modbus exception reply (Modbus application protocol, section 7).


class RequestRefused(Exception):
    """Error that is answered by an exception of this code."""

    code = 4


class IllegalFunction(RequestRefused):
    """01: the drive does not support the function."""

    code = 1


class IllegalAddress(RequestRefused):
    """02: no such register, or it must not be written."""

    code = 2


class IllegalValue(RequestRefused):
    """03: an impossible count or value."""

    code = 3


class DeviceFailure(RequestRefused):
    """04: the request is valid, but can't be executed now."""

    code = 4


# ---------------------------------------------------------------------------------------------------------------------

Kind = Literal["word_order", "scale_10", "address_off_by_one", "sign", "unsigned", "write_not_applied",
               "reads_back_something_else"]
KINDS: tuple[str, ...] = get_args(Kind)


@dataclass(frozen=True, slots=True)
class Wrong:
    """One error of the map; ``of`` names the parameter that reads back another value."""

    kind: Kind
    of: str | None = None


def parse(text: str, parameters: Iterable[str] = ()) -> Wrong:
    """Return the error of ``scale_10`` or ``reads_back_something_else:time_out``. Raises FaultRefused with the known
    ones.
    """
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
