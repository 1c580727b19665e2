"""Settings of a CANopen drive beyond CiA 402's own objects: read, required, written, or used as a scale.

The words are those of `profiles.modbus.Parameter`. A value in its unit is

    raw x per_lsb [x value of the parameter named in ``times``]        scale: linear
    2^raw                                                              scale: power_of_two
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from profiles.entry import Entry, Positive
from profiles.model import DataModel, Finding, refuse_if
from profiles.requirement import Require

Index = Annotated[int, Field(ge=0x0001, le=0xFFFF)]
SubIndex = Annotated[int, Field(ge=0, le=0xFF)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
ObjectType = Literal["u8", "u16", "u32", "i8", "i16", "i32", "f32"]
SetTo = Literal["speed_limit", "speed_limit_reverse", "torque_limit", "torque_limit_reverse", "quick_stop_time",
                "quick_stop_deceleration"]


class ObjectAt(DataModel):
    """Where a number stands in the object dictionary."""

    index: Index
    sub: SubIndex = 0
    type: ObjectType


class Parameter(Entry):
    """A setting of the drive: read in preflight, and checked, written, or used as a scale."""

    name: Name
    title: str = Field(min_length=3, description="the manual's number and name, such as 'p2003 Reference torque'")
    index: Index
    sub: SubIndex = 0
    type: ObjectType
    scale: Literal["linear", "power_of_two"] = "linear"
    per_lsb: Positive = Field(default=1.0, description="units for one count")
    times: Name | None = Field(default=None, description="parameter whose value multiplies it")
    unit: Literal["rpm", "rpm_s", "nm", "rated", "s", "hz", "none"] = "none"
    default: float | None = Field(default=None, description="factory setting, in its unit")
    require: Require | None = Field(
        default=None, description="preflight refuses anything else; set by hand at the drive, this program never does"
    )
    set_to: SetTo | None = Field(
        default=None,
        description="limit written here in preflight and read back; a reverse one is negative; quick_stop_time: s from "
        "the speed of the parameter in `from_speed` down to zero",
    )
    from_speed: Name | None = Field(default=None, description="for quick_stop_time: the speed that the ramp begins at")
    advice: str | None = Field(default=None, description="what to do at the drive where it reads wrong")

    @model_validator(mode="after")
    def _one_use(self) -> Self:
        findings: list[Finding] = []
        if self.require is not None and self.set_to is not None:
            findings.append(("set_to", "is checked by reading back already; leave 'require' out"))
        if (self.set_to == "quick_stop_time") != (self.from_speed is not None):
            findings.append(("from_speed", "belongs to set_to: quick_stop_time, and is needed there"))
        if self.scale == "power_of_two" and (self.per_lsb != 1.0 or self.times is not None or self.set_to is not None):
            findings.append(("scale", "power_of_two goes with neither per_lsb nor times nor set_to"))
        if self.set_to is not None and self.set_to.endswith("reverse") and self.type.startswith("u"):
            findings.append(("type", "a reverse limit is negative"))
        refuse_if(findings)
        return self
