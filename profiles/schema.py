"""What a profile says of a CANopen drive: which objects it has, in which units, and how sure we are of it.

Data only. Scalings are "so many <unit> for one count"; None says that the drive does not have the object.
Each section carries its ``source`` and its ``confidence``, for a profile is only as good as where it came from.
"""

import re
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from profiles.data_model import DataModel, refuse_if
from profiles.entry import Confidence, Entry, Positive, ProfileName

Index = Annotated[int, Field(ge=0x0001, le=0xFFFF)]
SubIndex = Annotated[int, Field(ge=0, le=0xFF)]
U32 = Annotated[int, Field(ge=0, le=0xFFFF_FFFF)]
I16 = Annotated[int, Field(ge=-0x8000, le=0x7FFF)]
I8 = Annotated[int, Field(ge=-0x80, le=0x7F)]


class IdentityEntry(Entry):
    """Object 1018h; None = not checked."""

    vendor: U32 | None = Field(default=None, description="1018h:1")
    product: U32 | None = Field(default=None, description="1018h:2")
    revision: U32 | None = Field(default=None, description="1018h:3")


class Modes(Entry):
    """Modes of operation (6060h) in order of preference; the drive's 6502h decides which of them it gets."""

    speed: tuple[I8, ...] = Field(min_length=1, description="modes that regulate speed, such as [9, 3]")
    torque: tuple[I8, ...] = Field(description="modes that regulate torque, such as [10, 4]; [] if it has none")
    switch_while_enabled: bool = Field(description="may 6060h change while operation is enabled?")

    @model_validator(mode="after")
    def _apart(self) -> Self:
        both = sorted(set(self.speed) & set(self.torque))
        refuse_if([("torque", f"mode {mode} can't be a speed mode and a torque mode") for mode in both])
        return self


class QuickStop(Entry):
    """What controlword bit 2 does."""

    option_code: I16 | None = Field(
        description="written to 605Ah in preflight and read back; 6 = quick-stop ramp, then stay; null = not written"
    )
    deceleration_rpm_s_per_lsb: Positive | None = Field(description="unit of 6085h in rpm/s; null = no such object")
    decelerates_in_torque_mode: bool = Field(
        description="does a quick stop in a torque mode brake the shaft under speed control? false: speed mode first"
    )


class Speed(Entry):
    """Speed as reported in 606Ch and commanded in 60FFh, and what limits it."""

    rpm_per_lsb: Positive = Field(description="unit of 606Ch and 60FFh in rpm")
    max_motor_speed_rpm_per_lsb: Positive | None = Field(description="unit of 6080h in rpm; null = no such object")
    acceleration_rpm_s_per_lsb: Positive | None = Field(description="unit of 6083h in rpm/s; null = no such object")
    deceleration_rpm_s_per_lsb: Positive | None = Field(description="unit of 6084h in rpm/s; null = no such object")


class Torque(Entry):
    """Torque as reported in 6077h and commanded in 6071h, as a share of the rated torque."""

    rated_torque_nm_per_lsb: Positive | None = Field(
        description="unit of 6076h in N·m; null = not told by the drive: rig.yaml must (drive_data.rated_torque_nm)"
    )
    rated_per_lsb: Positive = Field(description="unit of 6071h and 6077h as a share of rated torque, such as 0.001")
    max_torque_rated_per_lsb: Positive | None = Field(
        description="unit of 6072h as a share of rated torque; null = no such object"
    )
    slope_rated_s_per_lsb: Positive | None = Field(
        description="unit of 6087h as a share of rated torque per second; null = no such object"
    )
    has_demand: bool = Field(description="does the drive report its torque demand in 6074h, in the unit of 6077h?")


class Watchdog(Entry):
    """What stops the drive when the host falls silent."""

    kind: Literal["heartbeat", "none"] = Field(description="heartbeat: the drive watches the host's heartbeat")
    consumer_index: Index = Field(default=0x1016, description="object with the host's node number and the time in ms")
    consumer_sub: SubIndex = Field(default=1, description="its sub-index")
    reaction_index: Index | None = Field(default=None, description="object that chooses the reaction; null = none")
    reaction_sub: SubIndex = Field(default=0, description="its sub-index")
    reaction_value: I16 | None = Field(default=None, description="what is written there and read back")
    reaction: Literal["quick_stop", "fault_reaction", "coast", "none"] = Field(
        description="what the drive then does; coast = torque off and the shaft runs out"
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        findings = []
        if self.kind == "none" and self.reaction != "none":
            findings.append(("reaction", "must be none where kind is none"))
        if self.kind != "none" and self.reaction == "none":
            findings.append(("reaction", "say what the drive does when the heartbeat is missing"))
        if (self.reaction_index is None) != (self.reaction_value is None):
            findings.append(("reaction_value", "reaction_index and reaction_value belong together; give both or none"))
        refuse_if(findings)
        return self


class ReportingFilter(Entry):
    """An object that holds the smoothing which the drive puts on a reported signal."""

    signal: Literal["speed", "torque"] = Field(description="the signal that it smooths")
    index: Index = Field(description="object")
    sub: SubIndex = Field(default=0, description="its sub-index")
    type: Literal["u8", "u16", "u32", "i8", "i16", "i32", "f32"] = Field(description="its data type")
    quantity: Literal["time_constant_s", "cutoff_hz"] = Field(description="what it holds")
    per_lsb: Positive = Field(default=1.0, description="seconds, or hertz, for one count")


class Cyclic(Entry):
    """The cycle of setpoints and feedback."""

    rate_hz: float = Field(default=250.0, gt=0, le=2000, description="cycles a second unless told otherwise")


class CanopenProfile(DataModel):
    """One drive on CANopen."""

    name: ProfileName = Field(description="vendor/model, as in --profile")
    title: str = Field(min_length=3, description="one line for tables and reports")
    bus: Literal["canopen"]
    eds: str | None = Field(default=None, description="an EDS file beside this one; null = none needed")
    node: int = Field(default=1, ge=1, le=127, description="node number unless told otherwise")
    identity: IdentityEntry
    modes: Modes
    quick_stop: QuickStop
    speed: Speed
    torque: Torque
    watchdog: Watchdog
    cyclic: Cyclic
    filters: tuple[ReportingFilter, ...] = Field(default=(), description="where reported-signal filters can be read")

    @model_validator(mode="after")
    def _eds_beside(self) -> Self:
        if self.eds is not None and not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", self.eds):
            refuse_if([("eds", "must be the plain name of a file beside this profile, without a folder")])
        return self

    def entries(self) -> tuple[tuple[str, Entry], ...]:
        """(name, entry) of everything that carries a source and a confidence."""
        found: list[tuple[str, Entry]] = [(name, part) for name, part in self if isinstance(part, Entry)]
        return (*found, *((f"filters.{part.signal}", part) for part in self.filters))

    def below(self, confidence: Confidence) -> tuple[str, ...]:
        """Names of the entries of exactly this confidence."""
        return tuple(name for name, part in self.entries() if part.confidence == confidence)
