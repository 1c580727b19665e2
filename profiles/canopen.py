"""Schema of a CANopen drive's profile: entries of CiA 402, which apply to any bus, and entries of CANopen.

Data only. Each section carries its ``source`` and its ``confidence``, because a profile is only as good as its sources.
"""

import re
from typing import Literal, Self

from pydantic import Field, model_validator

from profiles.cia402 import (
    STANDARD_POSITION,
    Cia402Profile,
    Cycle,
    HostWatchdog,
    Index,
    ObjectType,
    Parameter,
    Position,
    ReportingFilter,
    SubIndex,
)
from profiles.model import refuse_if

__all__ = [
    "STANDARD_POSITION", "CanopenProfile", "Cyclic", "ObjectType", "Parameter", "Position", "ReportingFilter",
    "Watchdog",
]



class Watchdog(HostWatchdog):
    """Means that stops the drive when the host is silent."""

    kind: Literal["heartbeat", "node_guarding", "none"] = Field(
        description="heartbeat: the drive supervises the host's heartbeat; node_guarding: it supervises the host's "
        "requests (100Ch guard time x 100Dh life time factor)"
    )
    consumer_index: Index = Field(default=0x1016, description="object with the host's node number and the time in ms")
    consumer_sub: SubIndex = Field(default=1, description="its sub-index")
    life_time_factor: int = Field(
        default=4, ge=2, le=255, description="node guarding: number of requests that may be missing (100Dh)"
    )


class Cyclic(Cycle):
    """The cycle of setpoints and feedback."""

    has_period: bool = Field(default=True, description="does the drive have 1006h, the period of the cycle?")


class CanopenProfile(Cia402Profile):
    """One drive on CANopen."""

    bus: Literal["canopen"]
    eds: str | None = Field(default=None, description="an EDS file beside this one; null = none needed")
    node: int = Field(default=1, ge=1, le=127, description="node number unless the run states another")
    watchdog: Watchdog
    cyclic: Cyclic

    @model_validator(mode="after")
    def _eds_beside(self) -> Self:
        if self.eds is not None and not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", self.eds):
            refuse_if([("eds", "must be the plain name of a file beside this profile, without a folder")])
        return self
