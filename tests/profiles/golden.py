"""Golden exchanges: requests and replies derived by hand from the manufacturers' documents, one file per profile.

No line of ``golden/*.yaml`` was made by running this project's code; a comment beside each has the calculation. A
file contains::

    profile: vendor/model          as in --profile
    rated_torque_nm: 1000.0        what 100 % torque is in this file
    limits: {...}                  limits of rig.yaml, used by ``set``
    told: {name: value}            values of parameters that the exchanges need, in the profile's units
    filters_s: {speed: 0.0}        expected time constants, with ``told``
    exchanges:                     in this order, on one drive
      - does: what it is
        request: 06 0063 047E      the PDU in hex: function code and data, blanks where they help; no unit, no CRC
        reply: 06 0063 047E
        means: {...}               one of the kinds below
        drive: same                test of the simulated drive, see below
    cycles:                        whole cycles, in the order in which the driver sends them
      - does: what it is
        seen: 0x0237               status word of the cycle before
        wish: enabled              off · enabled · quick_stop
        mode: torque
        command: {speed_rad_s: 0.0, torque_nm: 250.0}
        steps: [{request: ..., reply: ...}]
        means: {state: enabled, speed_rad_s: 31.41593, torque_nm: 250.0, mode: torque}

Kinds of ``means``, one or more keys of one line:

``state``, ``remote``, ``limit_active``, ``standstill``   the status word in the reply
``wish``, ``seen``, ``mode``, ``reverse``     the control word in the request, and the status word before it
``write: speed | torque`` with ``speed_rad_s`` or ``torque_nm``      a setpoint in the request
``read: speed | torque`` with ``speed_rad_s`` or ``torque_nm``       feedback in the reply
``echo: speed | torque`` with ``speed_rad_s`` or ``torque_nm``       a setpoint as the drive shows it, in the reply
``parameter``, ``value``           a parameter in the reply, in the profile's unit
``set``, ``value``                 a limit of rig.yaml written into that parameter
``choose: speed | torque``         the mode register in the request
``shows: speed | torque``          the mode display in the reply

Values of ``drive``, the test of the simulated drive with the profile: ``same`` – the golden reply, byte for byte, in
the state after the exchanges before; ``forced`` – the same, with the reported speed and torque set by the test;
absent – no test, since such a status word needs more than exchanges.
"""

from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from profiles.model import DataModel
from profiles.yaml_loader import load_model

FOLDER = Path(__file__).parent / "golden"

Pdu = Annotated[str, Field(pattern=r"^[0-9A-F ]+$")]
ModeName = Literal["torque", "speed"]      # the order of the options: typing considers unions of both orders equal
Wish = Literal["off", "enabled", "quick_stop"]


class Means(DataModel):
    """Meaning of an exchange, derived by hand."""

    state: Literal["not_ready", "off", "ready", "enabled", "quick_stop", "fault", "fault_reaction"] | None = None
    remote: bool | None = None
    limit_active: bool | None = None
    standstill: bool | None = None
    wish: Wish | None = None
    seen: int | None = None
    mode: ModeName | None = None
    reverse: bool = False
    write: ModeName | None = None
    read: ModeName | None = None
    echo: ModeName | None = None
    speed_rad_s: float | None = None
    torque_nm: float | None = None
    parameter: str | None = None
    set: str | None = None
    value: float | None = None
    choose: ModeName | None = None
    shows: ModeName | None = None


class Exchange(DataModel):
    """One request and its reply."""

    does: str = Field(min_length=3)
    request: Pdu
    reply: Pdu
    means: Means
    drive: Literal["same", "forced"] | None = None


class Step(DataModel):
    request: Pdu
    reply: Pdu


class Wanted(DataModel):
    speed_rad_s: float
    torque_nm: float


class Cycle(DataModel):
    """One whole cycle."""

    does: str = Field(min_length=3)
    seen: int
    wish: Wish
    mode: ModeName
    command: Wanted
    steps: tuple[Step, ...] = Field(min_length=1)
    means: Means


class Limits(DataModel):
    """Limits of rig.yaml."""

    speed_rad_s: float
    torque_nm: float
    quick_stop_rad_s2: float
    watchdog_s: float


class Golden(DataModel):
    """One golden file."""

    profile: str
    rated_torque_nm: float
    limits: Limits
    told: dict[str, float] = Field(default_factory=dict)
    filters_s: dict[ModeName, float] = Field(default_factory=dict)
    exchanges: tuple[Exchange, ...]
    cycles: tuple[Cycle, ...] = Field(min_length=1)


def pdu(text: str) -> bytes:
    """Convert hex with blanks between bytes to bytes."""
    return bytes.fromhex(text)


def names() -> tuple[str, ...]:
    """Return the stems of all files."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))


@cache
def load(name: str) -> Golden:
    """Load one of `names`, strictly."""
    return load_model(FOLDER / f"{name}.yaml", Golden)
