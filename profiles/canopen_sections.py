"""The sections of a CANopen profile: identity, modes, quick stop, speed, torque, watchdog, filters, cycle.

Scalings are "so many <unit> for one count"; None says that the drive does not have the object.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from profiles.canopen_parameter import Index, Name, ObjectAt, ObjectType, SubIndex
from profiles.entry import Entry, Positive
from profiles.model import Finding, refuse_if

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
    mapped: bool = Field(
        default=True, description="can 6060h be mapped into a PDO? false: written by SDO in preflight, and it stays"
    )

    @model_validator(mode="after")
    def _apart(self) -> Self:
        both = sorted(set(self.speed) & set(self.torque))
        findings: list[Finding] = [("torque", f"mode {mode} can't be a speed mode and a torque mode") for mode in both]
        if self.torque and not self.mapped:
            findings.append(("mapped", "a drive with torque modes is switched in the cycle: 6060h must be mappable"))
        refuse_if(findings)
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
    ends: Literal["quick_stop", "off"] = Field(
        default="quick_stop", description="the state in which the drive is left once at rest; off: torque switched off"
    )


class Speed(Entry):
    """Speed as reported in 606Ch and commanded in 60FFh, and what limits it."""

    vl: bool = Field(
        default=False,
        description="velocity mode (vl, mode 2): 6042h and 6044h, 16 bits each, in place of 60FFh and 606Ch, and bits "
        "4 to 6 of the controlword release the setpoint",
    )
    rpm_per_lsb: Positive = Field(description="unit of 606Ch and 60FFh in rpm, before `times` and `over`")
    times: tuple[Name, ...] = Field(default=(), description="parameters whose values multiply the unit")
    over: tuple[Name, ...] = Field(default=(), description="parameters whose values divide the unit")
    si_unit: U32 | None = Field(
        default=None, description="what 60A9h must read where the unit is that; null = not told there, not checked"
    )
    max_motor_speed_rpm_per_lsb: Positive | None = Field(description="unit of 6080h in rpm; null = no such object")
    acceleration_rpm_s_per_lsb: Positive | None = Field(description="unit of 6083h in rpm/s; null = no such object")
    deceleration_rpm_s_per_lsb: Positive | None = Field(description="unit of 6084h in rpm/s; null = no such object")


class Position(Entry):
    """The motor shaft's angle as the drive counts it: what tells whether the unit of speed is right.

    Read only, and believed only where the drive has it.
    """

    index: Index = Field(default=0x6064, description="object with the count")
    sub: SubIndex = Field(default=0, description="its sub-index")
    type: ObjectType = Field(default="i32", description="its data type")
    counts_per_turn: Positive | None = Field(
        default=None,
        description="counts for one turn of the motor; 1 for a counter of turns; null = 608Fh:1 over 608Fh:2",
    )
    wrap_counts: Positive | None = Field(
        default=None, description="counts after which it starts over; null = when its data type is full"
    )


STANDARD_POSITION = Position(source="CiA 402-2, 6064h and 608Fh, where the drive has them", confidence="verified")
"""What is looked for in a drive whose profile says nothing of it."""


class TorqueActual(ObjectAt):
    """Where the torque is reported, of one instant with the speed, and in which unit."""

    per_lsb: Positive
    unit: Literal["rated", "nm"] = Field(description="share of the rated torque, or N·m")

    @model_validator(mode="after")
    def _signed(self) -> Self:
        if self.type not in ("i16", "i32", "f32"):
            refuse_if([("type", "torque has a sign: i16, i32 or f32")])
        return self


class Torque(Entry):
    """Torque as reported in 6077h and commanded in 6071h, as a share of the rated torque.

    6071h is used where `Modes.torque` names a mode, and only there.
    """

    rated_torque_nm_per_lsb: Positive | None = Field(
        description="unit of 6076h in N·m; null = not told by the drive: rig.yaml must (drive_data.rated_torque_nm)"
    )
    rated: ObjectAt = Field(
        default=ObjectAt(index=0x6076, type="u32"), description="where what counts as rated torque stands instead"
    )
    actual: TorqueActual | None = Field(default=None, description="instead of 6077h; null = 6077h")
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

    kind: Literal["heartbeat", "node_guarding", "none"] = Field(
        description="heartbeat: the drive watches the host's heartbeat; node_guarding: it watches the host's questions "
        "(100Ch guard time x 100Dh life time factor)"
    )
    consumer_index: Index = Field(default=0x1016, description="object with the host's node number and the time in ms")
    consumer_sub: SubIndex = Field(default=1, description="its sub-index")
    life_time_factor: int = Field(
        default=4, ge=2, le=255, description="node guarding: so many questions may fail to come (100Dh)"
    )
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
            findings.append(("reaction", "say what the drive does when the host falls silent"))
        if (self.reaction_index is None) != (self.reaction_value is None):
            findings.append(("reaction_value", "reaction_index and reaction_value belong together; give both or none"))
        refuse_if(findings)
        return self


class ReportingFilter(Entry):
    """An object that holds the smoothing which the drive puts on a reported signal."""

    signal: Literal["speed", "torque"] = Field(description="the signal that it smooths")
    index: Index = Field(description="object")
    sub: SubIndex = Field(default=0, description="its sub-index")
    type: ObjectType = Field(description="its data type")
    quantity: Literal["time_constant_s", "cutoff_hz"] = Field(description="what it holds")
    per_lsb: Positive = Field(default=1.0, description="seconds, or hertz, for one count")


class Cyclic(Entry):
    """The cycle of setpoints and feedback."""

    rate_hz: float = Field(default=250.0, gt=0, le=2000, description="cycles a second unless told otherwise")
    has_period: bool = Field(default=True, description="does the drive have 1006h, the period of the cycle?")
