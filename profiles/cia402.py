"""Schema of a CiA 402 drive on any bus: its objects, their units, and the confidence in each entry.

Data only. A scaling is the number of units for one count; None means that the drive does not have the object. Each
section carries its ``source`` and its ``confidence``, because a profile is only as good as its sources.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from profiles.entry import DriveProfile, Name, ProfileEntry, Require
from profiles.model import DataModel, Finding, Positive, refuse_if

# ---------------------------------------------------------------------------------------------------------------------
# Settings of a drive beyond CiA 402's own objects: read, required, written, or used as a scale.
#
# Parameters have the same keys as `profiles.modbus.Parameter`. A value in its unit is
#
#     raw x per_lsb [x value of the parameter named in ``times``]        scale: linear
#     2^raw                                                              scale: power_of_two


Index = Annotated[int, Field(ge=0x0001, le=0xFFFF)]
SubIndex = Annotated[int, Field(ge=0, le=0xFF)]
ObjectType = Literal["u8", "u16", "u32", "i8", "i16", "i32", "f32"]
SetTo = Literal["speed_limit", "speed_limit_reverse", "torque_limit", "torque_limit_reverse", "quick_stop_time",
                "quick_stop_deceleration"]


class ObjectAt(DataModel):
    """Place of a number in the object dictionary."""

    index: Index
    sub: SubIndex = 0
    type: ObjectType


class Parameter(ProfileEntry):
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
    advice: str | None = Field(default=None, description="what to do at the drive if the value is wrong")

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


# ---------------------------------------------------------------------------------------------------------------------
# The sections of a profile: identity, modes, quick stop, speed, torque, watchdog, filters, cycle.
#
# A scaling is the number of units for one count; None means that the drive does not have the object.


U32 = Annotated[int, Field(ge=0, le=0xFFFF_FFFF)]
I16 = Annotated[int, Field(ge=-0x8000, le=0x7FFF)]
I8 = Annotated[int, Field(ge=-0x80, le=0x7F)]


class IdentityEntry(ProfileEntry):
    """Object 1018h; None = not checked."""

    vendor: U32 | None = Field(default=None, description="1018h:1")
    product: U32 | None = Field(default=None, description="1018h:2")
    revision: U32 | None = Field(default=None, description="1018h:3")


class Modes(ProfileEntry):
    """Modes of operation (6060h) in order of preference; the drive's 6502h decides which of them it gets."""

    speed: tuple[I8, ...] = Field(min_length=1, description="modes of speed control, such as [9, 3]")
    torque: tuple[I8, ...] = Field(description="modes of torque control, such as [10, 4]; [] if it has none")
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


QUICK_STOP_COASTS = 0
"""Value of 605Ah with which a quick stop disables the drive, and the shaft coasts (CiA 402-2, 605Ah)."""


class QuickStop(ProfileEntry):
    """Effect of controlword bit 2."""

    option_code: I16 | None = Field(
        description="written to 605Ah in preflight and read back; 6 = quick-stop ramp, then stay; null = not written, "
        "but a drive that reads 0 there is refused; 0 is not allowed, because the shaft would coast"
    )
    deceleration_rpm_s_per_lsb: Positive | None = Field(description="unit of 6085h in rpm/s; null = no such object")
    decelerates_in_torque_mode: bool = Field(
        description="does a quick stop in a torque mode brake the shaft under speed control? false: speed mode first"
    )
    ends: Literal["quick_stop", "off"] = Field(
        default="quick_stop", description="state of the drive after standstill; off: torque switched off"
    )

    @model_validator(mode="after")
    def _brakes(self) -> Self:
        if self.option_code == QUICK_STOP_COASTS:
            refuse_if([("option_code", "with 0 the shaft coasts (CiA 402-2, 605Ah); give 6, or null to write nothing")])
        return self


class Speed(ProfileEntry):
    """Speed as reported in 606Ch and commanded in 60FFh, and the objects that limit it."""

    vl: bool = Field(
        default=False,
        description="velocity mode (vl, mode 2): 6042h and 6044h, 16 bits each, in place of 60FFh and 606Ch, and bits "
        "4 to 6 of the controlword release the setpoint",
    )
    rpm_per_lsb: Positive = Field(description="unit of 606Ch and 60FFh in rpm, before `times` and `over`")
    times: tuple[Name, ...] = Field(default=(), description="parameters whose values multiply the unit")
    over: tuple[Name, ...] = Field(default=(), description="parameters whose values divide the unit")
    si_unit: U32 | None = Field(
        default=None,
        description="what 60A9h must read where the unit is that; null = not reported, and not checked"
    )
    max_motor_speed_rpm_per_lsb: Positive | None = Field(description="unit of 6080h in rpm; null = no such object")
    acceleration_rpm_s_per_lsb: Positive | None = Field(description="unit of 6083h in rpm/s; null = no such object")
    deceleration_rpm_s_per_lsb: Positive | None = Field(description="unit of 6084h in rpm/s; null = no such object")


class Position(ProfileEntry):
    """The motor shaft's angle as the drive counts it. It shows whether the unit of speed is right.

    It is only read, and used only if the drive has the object.
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
"""Default for a drive whose profile does not state a position object."""


class TorqueActual(ObjectAt):
    """Object of the reported torque, and its unit. Its value belongs to the same instant as the speed."""

    per_lsb: Positive
    unit: Literal["rated", "nm"] = Field(description="share of the rated torque, or N·m")

    @model_validator(mode="after")
    def _signed(self) -> Self:
        if self.type not in ("i16", "i32", "f32"):
            refuse_if([("type", "torque has a sign: i16, i32 or f32")])
        return self


class Torque(ProfileEntry):
    """Torque as reported in 6077h and commanded in 6071h, as a share of the rated torque.

    6071h is used only if `Modes.torque` names a mode.
    """

    rated_torque_nm_per_lsb: Positive | None = Field(
        description="unit of 6076h in N·m; null = not reported: rig.yaml must state drive_data.rated_torque_nm"
    )
    rated: ObjectAt = Field(
        default=ObjectAt(index=0x6076, type="u32"), description="object of the rated torque, if it is not 6076h"
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


class TorqueOffset(ProfileEntry):
    """Torque that the drive adds to the output of its own speed loop: 60B2h, torque offset (CiA 402-2).

    It is mapped and used only in runs that request it, such as the measurement of the drive's own impedance.
    """

    index: Index = Field(default=0x60B2, description="object that takes it, 16 bits with a sign")
    sub: SubIndex = Field(default=0, description="its sub-index")
    rated_per_lsb: Positive = Field(description="its unit as a share of rated torque, such as 0.001")
    modes: tuple[I8, ...] = Field(
        min_length=1, description="speed modes of `modes.speed` in which the drive adds it; the standard names 9 alone"
    )


class HostWatchdog(ProfileEntry):
    """Means that stops the drive when the host is silent, and the drive's reaction. Each bus adds how it is fed."""

    kind: str = Field(description="how the drive supervises the host; none: it does not")
    reaction_index: Index | None = Field(default=None, description="object that chooses the reaction; null = none")
    reaction_sub: SubIndex = Field(default=0, description="its sub-index")
    reaction_value: I16 | None = Field(default=None, description="value that is written there and read back")
    reaction: Literal["quick_stop", "fault_reaction", "coast", "none"] = Field(
        description="reaction of the drive; coast = torque off and the shaft runs down"
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


class ReportingFilter(ProfileEntry):
    """Object with the filter that the drive applies to a reported signal."""

    signal: Literal["speed", "torque"] = Field(description="the signal that it smooths")
    index: Index = Field(description="object")
    sub: SubIndex = Field(default=0, description="its sub-index")
    type: ObjectType = Field(description="its data type")
    quantity: Literal["time_constant_s", "cutoff_hz"] = Field(description="quantity in the object")
    per_lsb: Positive = Field(default=1.0, description="seconds, or hertz, for one count")


class Cycle(ProfileEntry):
    """The cycle of setpoints and feedback."""

    rate_hz: float = Field(default=250.0, gt=0, le=2000, description="cycles per second, unless the run states a rate")


# ---------------------------------------------------------------------------------------------------------------------

class Cia402Profile(DriveProfile):
    """One drive of CiA 402, on any bus."""

    identity: IdentityEntry
    modes: Modes
    quick_stop: QuickStop
    speed: Speed
    position: Position | None = Field(
        default=STANDARD_POSITION,
        description="the motor's angle, compared with the reported speed; left out = 6064h and 608Fh where the drive "
        "has them; null = none; the operator then confirms the speed by sight",
    )
    torque: Torque
    torque_offset: TorqueOffset | None = Field(
        default=None, description="a torque added to the speed loop's, over the bus; null = none"
    )
    watchdog: HostWatchdog
    cyclic: Cycle
    filters: tuple[ReportingFilter, ...] = Field(default=(), description="where reported-signal filters can be read")
    parameters: tuple[Parameter, ...] = Field(default=(), description="settings beyond CiA 402's own objects")
    hints: tuple[str, ...] = Field(default=(), description="other settings and facts, a line each, for `profiles show`")

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
        wanted += self._speed_controller_names()
        for number, one in enumerate(self.parameters):
            wanted += [(f"parameters.{number}.times", one.times), (f"parameters.{number}.from_speed", one.from_speed)]
        findings += [(at, f"no parameter '{name}'") for at, name in wanted if name is not None and name not in names]
        # One level only: a value must not depend on itself through another one.
        scales = {one.name: one.times for one in self.parameters}
        findings += [
            (f"parameters.{number}.times", f"'{one.times}' is multiplied by another one itself")
            for number, one in enumerate(self.parameters) if one.times is not None and scales.get(one.times) is not None
        ]
        refuse_if(findings)
        return self

    def parameter(self, name: str) -> Parameter:
        """Return the parameter of that name. Raises UsageError; references are checked on loading."""
        return self.named(self.parameters, name)

    def entries(self) -> tuple[tuple[str, ProfileEntry], ...]:
        """Return (name, entry) for all entries of the profile that have a source and a confidence."""
        found: list[tuple[str, ProfileEntry]] = [
            (name, part) for name, part in self if isinstance(part, ProfileEntry) and part != STANDARD_POSITION
        ]
        found += [(f"filters.{part.signal}", part) for part in self.filters]
        return (*found, *((f"parameters.{part.name}", part) for part in self.parameters))

    @property
    def can_torque(self) -> bool:
        """True if torque can be controlled over the bus, and selected while the shaft turns."""
        return bool(self.modes.torque) and self.modes.switch_while_enabled

    @property
    def usual_rate_hz(self) -> float:
        """Cycles per second, unless the run states another rate."""
        return self.cyclic.rate_hz

    @property
    def rated_torque_by_hand(self) -> bool:
        """True if rig.yaml must state the torque of 100 %."""
        return self.torque.rated_torque_nm_per_lsb is None
