"""What a profile says of a CANopen drive: which objects it has, in which units, and how sure we are of it.

Data only. Scalings are "so many <unit> for one count"; None says that the drive does not have the object.
Each section carries its ``source`` and its ``confidence``, for a profile is only as good as where it came from.
"""

import re
from typing import Literal, Self

from pydantic import Field, model_validator

from profiles.canopen_parameter import Parameter
from profiles.canopen_sections import (
    STANDARD_POSITION,
    Cyclic,
    IdentityEntry,
    Modes,
    Position,
    QuickStop,
    ReportingFilter,
    Speed,
    Torque,
    Watchdog,
)
from profiles.entry import Confidence, Entry, ProfileName
from profiles.model import DataModel, Finding, refuse_if

__all__ = ["CanopenProfile", "ReportingFilter", "Watchdog"]


class CanopenProfile(DataModel):
    """One drive on CANopen."""

    name: ProfileName = Field(description="vendor/model, as in --profile")
    title: str = Field(min_length=3, description="one line for tables and reports")
    bus: Literal["canopen"]
    experimental: bool = Field(default=False, description="second-hand, or never tried on the bus that it names")
    eds: str | None = Field(default=None, description="an EDS file beside this one; null = none needed")
    node: int = Field(default=1, ge=1, le=127, description="node number unless told otherwise")
    identity: IdentityEntry
    modes: Modes
    quick_stop: QuickStop
    speed: Speed
    position: Position | None = Field(
        default=STANDARD_POSITION,
        description="the motor's angle, held against the reported speed; left out = 6064h and 608Fh where the drive "
        "has them; null = none, and the operator is asked what he sees",
    )
    torque: Torque
    watchdog: Watchdog
    cyclic: Cyclic
    filters: tuple[ReportingFilter, ...] = Field(default=(), description="where reported-signal filters can be read")
    parameters: tuple[Parameter, ...] = Field(default=(), description="settings beyond CiA 402's own objects")
    hints: tuple[str, ...] = Field(default=(), description="what else to set or know, a line each, for `profiles show`")

    @model_validator(mode="after")
    def _eds_beside(self) -> Self:
        if self.eds is not None and not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", self.eds):
            refuse_if([("eds", "must be the plain name of a file beside this profile, without a folder")])
        return self

    @model_validator(mode="after")
    def _vl_alone(self) -> Self:
        findings: list[Finding] = []
        if self.speed.vl != (2 in self.modes.speed):
            findings.append(("speed.vl", "velocity mode (2 in modes.speed) has objects of its own: both or neither"))
        elif self.speed.vl and (len(self.modes.speed) > 1 or self.modes.torque):
            findings.append(("modes", "velocity mode (2) stands alone: its setpoint is not where other modes have it"))
        refuse_if(findings)
        return self

    @model_validator(mode="after")
    def _refers(self) -> Self:
        names = [parameter.name for parameter in self.parameters]
        findings: list[Finding] = [
            ("parameters", f"'{name}' stands there twice") for name in sorted({n for n in names if names.count(n) > 1})
        ]
        wanted: list[tuple[str, str | None]] = [("speed.times", name) for name in self.speed.times]
        wanted += [("speed.over", name) for name in self.speed.over]
        for number, one in enumerate(self.parameters):
            wanted += [(f"parameters.{number}.times", one.times), (f"parameters.{number}.from_speed", one.from_speed)]
        findings += [(at, f"no parameter '{name}'") for at, name in wanted if name is not None and name not in names]
        # One level only: no value may hang on itself by a detour.
        scales = {one.name: one.times for one in self.parameters}
        findings += [
            (f"parameters.{number}.times", f"'{one.times}' is multiplied by another one itself")
            for number, one in enumerate(self.parameters) if one.times is not None and scales.get(one.times) is not None
        ]
        refuse_if(findings)
        return self

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name; KeyError if there is none (references are checked on loading)."""
        return {one.name: one for one in self.parameters}[name]

    def entries(self) -> tuple[tuple[str, Entry], ...]:
        """(name, entry) of everything that the profile says, with its source and confidence."""
        found: list[tuple[str, Entry]] = [
            (name, part) for name, part in self if isinstance(part, Entry) and part != STANDARD_POSITION
        ]
        found += [(f"filters.{part.signal}", part) for part in self.filters]
        return (*found, *((f"parameters.{part.name}", part) for part in self.parameters))

    def below(self, confidence: Confidence) -> tuple[str, ...]:
        """Names of the entries of exactly this confidence."""
        return tuple(name for name, part in self.entries() if part.confidence == confidence)
