"""Schema of a Modbus drive's profile: registers, words, states, scales, required settings, and their confidence.

Data only; the arithmetic is in `drivers.modbus`, and independently in `sim_bus`. Addresses are those on the wire,
counted from 0; ``reference`` repeats the manual's own notation. A value in its unit is

    raw x per_lsb [x value of the parameter named in ``times``]

Every entry carries its ``source`` and its ``confidence``.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from profiles.entry import Confidence, DriveProfile, Name, ProfileEntry, Require
from profiles.model import DataModel, Finding, Positive, refuse_if

Address = Annotated[int, Field(ge=0, le=0xFFFF)]
Word = Annotated[int, Field(ge=0, le=0xFFFF)]

Unit = Literal["rpm", "rpm_s", "nm", "rated", "s", "hz", "kw", "none"]
"""Units of a value. rated = share of the rated torque, whose value in N·m is in `ModbusProfile.rated_torque` or
rig.yaml."""


class Register(DataModel):
    """Place of a number. A 32-bit number takes two registers in the order `BusLine.word_order`."""

    address: Address = Field(description="on the wire, counted from 0")
    type: Literal["u16", "i16", "u32", "i32"] = Field(default="i16", description="how its bits are read")
    table: Literal["holding", "input"] = Field(default="holding", description="function 3 or function 4")
    reference: str | None = Field(default=None, description="as the manual writes it, such as 40111 or 16#2103")

    @property
    def count(self) -> int:
        """Number of registers that the type takes."""
        return 2 if self.type in ("u32", "i32") else 1


class CyclicSignal(ProfileEntry):
    """One number of the cycle, with its unit."""

    register_: Register = Field(alias="register")
    per_lsb: Positive = Field(description="units for one count")
    unit: Literal["rpm", "nm", "rated"]
    times: Name | None = Field(default=None, description="parameter whose value multiplies it")
    note: str | None = Field(default=None, description="further facts, such as why not the smoothed register")


class Bits(DataModel):
    """Bits of a word. They are set if word & mask == value."""

    mask: Word
    value: Word


class WordSignal(ProfileEntry):
    """A word of bits in the cycle."""

    register_: Register = Field(alias="register")


class StatusState(DataModel):
    """One state of the drive, present if statusword & mask == value. The first state of the list that fits counts."""

    mask: Word
    value: Word
    means: Literal["not_ready", "off", "ready", "enabled", "quick_stop", "fault", "fault_reaction"] = Field(
        description="off: no torque, no request; ready: on the way; enabled: setpoints act; quick_stop: braking, "
        "or holding afterwards; fault: no torque; fault_reaction: braking after a fault, or holding: the power stage "
        "is on"
    )
    onward: Word | None = Field(
        default=None, description="controlword that leads from here towards enabled; null where none does"
    )


FAULT_REACTION_ACTIVE = 0x000F
"""Status word of fault reaction active (CiA 402-2, 6041h); bits 4 to 15 don't matter, except 6, which is 0."""


class Control(ProfileEntry):
    """Control words for each request, and meaning of the status word."""

    family: Literal["cia402", "profidrive", "abb", "danfoss_fc", "yaskawa", "delta"] = Field(
        description="family of the bits; the simulator follows that family's manual, not this file"
    )
    states: tuple[StatusState, ...] = Field(min_length=3)
    off: Word = Field(description="disables the drive at standstill")
    coast: Word | None = Field(
        default=None, description="switches the torque off at once, for a shaft that accelerates against its quick"
        " stop; null: `off` does"
    )
    quick_stop: Word = Field(description="brakes to standstill, under the drive's own speed control")
    fault_reset: tuple[Word, ...] = Field(min_length=1, description="words sent one after the other to reset a fault")
    fault_reset_register: Register | None = Field(
        default=None, description="register of the words of `fault_reset`; null: that of the control word"
    )
    speed_bits: Word = Field(default=0, description="bits set in every word in speed control")
    torque_bits: Word = Field(default=0, description="bits set in every word in torque control")
    reverse_bits: Word | None = Field(
        default=None, description="bits set for a negative speed setpoint if its register has no sign"
    )
    standstill: Bits | None = Field(default=None, description="statusword bits that show standstill")
    limit_active: Bits | None = Field(default=None, description="statusword bits that show that a limit acts")
    remote: Bits | None = Field(default=None, description="statusword bits that show that the field bus has control")

    @model_validator(mode="after")
    def _complete(self) -> Self:
        seen = {state.means for state in self.states}
        refuse_if(
            [("states", f"none means {name}") for name in ("off", "enabled", "fault") if name not in seen]
            + [("states", "none leads onward to enabled") for _ in [0] if all(s.onward is None for s in self.states)]
        )
        reaction = next((s for s in self.states if FAULT_REACTION_ACTIVE & s.mask == s.value), None)
        if self.family == "cia402" and reaction is not None and reaction.means == "fault":
            refuse_if([("states", "000Fh is fault reaction active, and its power stage is on: give a state that means "
                        "fault_reaction (mask 0x4F, value 0x0F)")])
        return self


class ModeDisplay(DataModel):
    """Register in which the drive displays its mode."""

    register_: Register = Field(alias="register")
    mask: Word = 0xFFFF
    speed: Word = Field(description="value under the mask in speed control")
    torque: Word = Field(description="value under the mask in torque control")


class ModeSwitch(ProfileEntry):
    """Control mode of the drive: speed or torque."""

    torque: bool = Field(description="can torque be regulated over the bus? false: speed-mode variant of the protocol")
    by: Literal["control_bits", "register", "none"] = Field(
        description="control_bits: speed_bits and torque_bits of `control`; register: write speed_value or torque_value"
    )
    register_: Register | None = Field(default=None, alias="register")
    speed_value: Word | None = None
    torque_value: Word | None = None
    display: ModeDisplay | None = Field(default=None, description="null: the drive does not display its mode")
    switch_while_enabled: bool = Field(description="may it change while operation is enabled?")

    @model_validator(mode="after")
    def _complete(self) -> Self:
        findings: list[Finding] = []
        if self.torque != (self.by != "none"):
            findings.append(("by", "none where torque is false, and only there"))
        given = [value is not None for value in (self.register_, self.speed_value, self.torque_value)]
        if any(given) != (self.by == "register") or any(given) != all(given):
            findings.append(("register", "register, speed_value and torque_value belong to by: register, all three"))
        refuse_if(findings)
        return self


class QuickStop(ProfileEntry):
    """Effect of the quick-stop word."""

    decelerates_in_torque_mode: bool = Field(description="false: the host requests speed mode at zero speed first")
    ends: Literal["quick_stop", "off"] = Field(description="state of the drive after standstill")


class Parameter(ProfileEntry):
    """A setting of the drive: read in preflight, and checked, written, or used as a scale.

    Without ``register`` it can't be read over the bus: rig.yaml must state it (drive_data.parameters.<name>).
    """

    name: Name
    title: str = Field(min_length=3, description="the manual's number and name, such as '46.01 Speed scaling'")
    register_: Register | None = Field(default=None, alias="register")
    per_lsb: Positive = Field(default=1.0, description="units for one count")
    times: Name | None = Field(default=None, description="parameter whose value multiplies it")
    unit: Unit = "none"
    default: float | None = Field(
        default=None, description="factory setting, in its unit; what a simulated drive starts with"
    )
    require: Require | None = Field(
        default=None, description="preflight refuses anything else; set by hand at the drive, this program never does"
    )
    set_to: Literal["speed_limit", "speed_limit_reverse", "torque_limit", "torque_limit_reverse", "watchdog",
                    "quick_stop_time", "quick_stop_deceleration", "ramp_up_time"] | None = Field(
        default=None,
        description="limit of rig.yaml written here in preflight and read back; quick_stop_time: s from the speed "
        "that 'times' names down to zero; ramp_up_time: s from rest up to it, as steep as the quick stop",
    )
    writable_in_operation: bool = Field(default=True, description="false: takes effect after a restart only")
    advice: str | None = Field(default=None, description="what to do at the drive if the value is wrong")

    @property
    def factor(self) -> str | None:
        """Name of the parameter that multiplies this one. The start or end speed of a ramp time is no such
        parameter.
        """
        return None if self.set_to in ("quick_stop_time", "ramp_up_time") else self.times

    @model_validator(mode="after")
    def _one_use(self) -> Self:
        findings: list[Finding] = []
        if self.require is not None and self.set_to is not None:
            findings.append(("set_to", "is checked by reading back already; leave 'require' out"))
        if self.set_to is not None and self.register_ is None:
            findings.append(("set_to", "needs a register"))
        refuse_if(findings)
        return self


class ModbusWatchdog(ProfileEntry):
    """Means that stops the drive when the host is silent."""

    kind: Literal["timeout", "none"]
    parameter: Name | None = Field(default=None, description="the time-out; a parameter with set_to: watchdog, or one "
                                   "that is read and must not be longer than rig.yaml's watchdog_s")
    fed_by: Literal["any_request", "requests_of_this_connection", "writes", "writes_of_this_connection",
                    "control_word", "control_word_of_this_connection", "unknown"] = Field(
        default="unknown",
        description="what restarts the time: any_request = whatever any client asks, reading included; writes = to any "
        "register; control_word = to it or a setpoint; of_this_connection = only of the client that commands; "
        "unknown counts as any_request",
    )
    fed_by_confidence: Confidence = Field(
        default="unverified", description="confidence of fed_by alone; below verified, it counts as any_request"
    )
    reaction: Literal["quick_stop", "ramp_stop", "fault_reaction", "coast", "none"] = Field(
        description="reaction of the drive; coast = torque off and the shaft runs down"
    )
    reaction_parameter: Name | None = Field(default=None, description="parameter that chooses it, with 'require'")

    request_counter: Register | None = Field(
        default=None, description="counter of the requests to this drive from all clients; function 8 is also tried"
    )

    @property
    def fed_by_any_client(self) -> bool:
        """True if a client that only reads may feed the watchdog after this host has died."""
        return self.kind != "none" and (
            self.fed_by in ("any_request", "unknown") or self.fed_by_confidence == "unverified"
        )

    @property
    def fed_by_us_alone(self) -> bool:
        """True if silence of this host trips the watchdog, even if other clients send requests."""
        return self.fed_by.endswith("_of_this_connection") and self.fed_by_confidence != "unverified"


class ModbusFilter(ProfileEntry):
    """Filter of a reported signal: read from a parameter, or as documented."""

    signal: Literal["speed", "torque"]
    parameter: Name | None = Field(default=None, description="parameter that holds it, in s or in hz (cut-off)")
    documented_s: float | None = Field(default=None, ge=0, description="time constant in s, where it can't be changed")
    advice: str | None = Field(default=None, description="the parameter to change for a better result")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.parameter is None) == (self.documented_s is None):
            refuse_if([("parameter", "give this or documented_s, one of the two")])
        return self


class NamePlate(ProfileEntry):
    """Three parameters that must fit P = T·ω. A wrong address, scale or word order of one of them gives a mismatch."""

    power: Name
    speed: Name
    torque: Name
    tolerance: float = Field(default=0.1, gt=0, lt=1, description="relative; name plates are rounded")


class Echo(ProfileEntry):
    """A register of the drive that shows a setpoint again. It is checked at standstill, with the drive disabled.

    An echo with a unit and a scale of its own finds most errors. An echo that shares them with the setpoint can't show
    that they are wrong.
    """

    setpoint: Literal["speed", "torque"]
    register_: Register = Field(alias="register")
    per_lsb: Positive
    unit: Literal["rpm", "nm", "rated"]
    times: Name | None = None


class Temperature(ProfileEntry):
    """A temperature that the drive reports: warning bits, or a number with a limit."""

    title: str = Field(min_length=3, description="the manual's number and name")
    register_: Register = Field(alias="register")
    too_hot: Bits | None = Field(default=None, description="bits that show it; the status word needs no request")
    per_lsb: Positive = Field(default=1.0, description="units for one count")
    unit: Literal["celsius", "share"] = Field(
        default="celsius", description="celsius: limit in limits.temperature_c of rig.yaml; share: of the allowed value"
    )
    at_most: Positive | None = Field(default=None, description="in its unit; with celsius, rig.yaml's may be lower")

    @model_validator(mode="after")
    def _limited(self) -> Self:
        if self.unit == "share" and self.too_hot is None and self.at_most is None:
            refuse_if([("at_most", "a share needs its limit")])
        return self


_NO_ECHO = ProfileEntry(
    source="no register shows before motion what the drive has made of this setpoint; look its address, type, scale "
    "and sign up in the manual",
    confidence="unverified",
)
"""Entry for a missing echo: no check at standstill can find an error in that setpoint's entry, so the
operator decides.
"""


class Position(ProfileEntry):
    """The motor shaft's angle as the drive counts it. It shows whether the unit of speed is right. Read only."""

    register_: Register = Field(alias="register")
    counts_per_turn: Positive = Field(description="counts for one turn of the motor; 1 for a counter of turns")
    wrap_counts: Positive | None = Field(
        default=None, description="counts after which it starts over; null = when its register is full"
    )


class ModbusCycle(ProfileEntry):
    """Registers of every cycle."""

    control: WordSignal
    status: WordSignal
    speed_setpoint: CyclicSignal
    torque_setpoint: CyclicSignal | None = None
    speed: CyclicSignal
    torque: CyclicSignal
    torque_demand: CyclicSignal | None = None
    functions: tuple[Literal[3, 4, 6, 8, 16, 23], ...] = Field(
        min_length=1, description="function codes that the drive supports"
    )
    largest_gap: int = Field(
        default=0, ge=0, le=60, description="number of registers between two required ones that may be read too"
    )
    largest_read: int = Field(default=125, ge=1, le=125, description="registers in one read")
    largest_write: int = Field(default=123, ge=1, le=123, description="registers in one write")
    rate_hz: float = Field(default=20.0, gt=0, le=1000, description="cycles per second, unless the run states a rate")


class BusLine(ProfileEntry):
    """Connection to the drive, with its factory settings."""

    transports: tuple[Literal["tcp", "rtu"], ...] = Field(min_length=1)
    port: int = Field(default=502, ge=1, le=65535)
    baud: int = Field(default=19200, ge=1200, le=1_000_000)
    parity: Literal["N", "E", "O"] = "E"
    stop_bits: Literal[1, 2] = 1
    unit: int = Field(default=1, ge=0, le=247)
    word_order: Literal["high_first", "low_first"] = "high_first"
    turn_around_s: float = Field(default=0.005, ge=0, le=1, description="from the end of a request to its reply")


class ModbusProfile(DriveProfile):
    """One drive on Modbus."""

    bus: Literal["modbus"]
    line: BusLine
    control: Control
    modes: ModeSwitch
    quick_stop: QuickStop
    cycle: ModbusCycle
    position: Position | None = Field(
        default=None,
        description="the motor's angle, compared with the reported speed; null = none; the operator then "
        "confirms the speed by sight",
    )
    rated_torque: Name | None = Field(
        default=None, description="parameter in nm that is 100 % torque; null: rig.yaml drive_data.rated_torque_nm"
    )
    watchdog: ModbusWatchdog
    parameters: tuple[Parameter, ...] = ()
    filters: tuple[ModbusFilter, ...] = ()
    name_plate: NamePlate | None = None
    echoes: tuple[Echo, ...] = ()
    temperatures: tuple[Temperature, ...] = ()
    hints: tuple[str, ...] = Field(default=(), description="other settings and facts, a line each, for `profiles show`")

    @model_validator(mode="after")
    def _refers(self) -> Self:
        names = [parameter.name for parameter in self.parameters]
        known = set(names)
        findings: list[Finding] = [
            ("parameters", f"'{name}' stands there twice") for name in sorted({n for n in names if names.count(n) > 1})
        ]
        wanted: list[tuple[str, str | None]] = [
            ("rated_torque", self.rated_torque),
            ("watchdog.parameter", self.watchdog.parameter),
            ("watchdog.reaction_parameter", self.watchdog.reaction_parameter),
        ]
        for at in ("speed_setpoint", "torque_setpoint", "speed", "torque", "torque_demand"):
            signal = getattr(self.cycle, at)
            wanted.append((f"cycle.{at}.times", signal.times if signal else None))
        wanted += self._speed_controller_names()
        wanted += [(f"filters.{number}.parameter", one.parameter) for number, one in enumerate(self.filters)]
        wanted += [(f"parameters.{number}.times", one.times) for number, one in enumerate(self.parameters)]
        wanted += [(f"echoes.{number}.times", one.times) for number, one in enumerate(self.echoes)]
        if self.name_plate is not None:
            wanted += [(f"name_plate.{part}", getattr(self.name_plate, part)) for part in ("power", "speed", "torque")]
        findings += [(at, f"no parameter '{name}'") for at, name in wanted if name is not None and name not in known]
        if self.modes.torque and self.cycle.torque_setpoint is None:
            findings.append(("cycle.torque_setpoint", "needed where modes.torque is true"))
        for number, one in enumerate(self.echoes):
            setpoint = self.cycle.speed_setpoint if one.setpoint == "speed" else self.cycle.torque_setpoint
            if setpoint is None:
                findings.append((f"echoes.{number}.setpoint", f"this profile has no {one.setpoint} setpoint"))
            elif setpoint.register_.type[0] == "i" and one.register_.type[0] == "u":
                findings.append((f"echoes.{number}.register", "has no sign, and the setpoint that it shows has one"))
        refuse_if(findings)
        return self

    def parameter(self, name: str) -> Parameter:
        """Return the parameter of that name. Raises UsageError; references are checked on loading."""
        return self.named(self.parameters, name)

    def entries(self) -> tuple[tuple[str, ProfileEntry], ...]:
        """Return (name, entry) for all entries with a source and a confidence. A missing echo is an
        unverified entry.
        """
        found: list[tuple[str, ProfileEntry]] = [(name, part) for name, part in self if isinstance(part, ProfileEntry)]
        found += [(f"cycle.{name}", part) for name, part in self.cycle if isinstance(part, ProfileEntry)]
        found += [(f"parameters.{part.name}", part) for part in self.parameters]
        found += [(f"filters.{part.signal}", part) for part in self.filters]
        found += [(f"echoes.{part.setpoint}", part) for part in self.echoes]
        found += [(f"temperatures.{number}", part) for number, part in enumerate(self.temperatures)]
        found += [(f"echoes.{setpoint}", _NO_ECHO) for setpoint in self.unseen]
        return tuple(found)

    @property
    def unseen(self) -> tuple[Literal["speed", "torque"], ...]:
        """Setpoints that the drive doesn't show back before motion."""
        used: tuple[Literal["speed", "torque"], ...] = ("speed", "torque") if self.modes.torque else ("speed",)
        shown = {echo.setpoint for echo in self.echoes}
        return tuple(setpoint for setpoint in used if setpoint not in shown)

    @property
    def can_torque(self) -> bool:
        """True if torque can be controlled over the bus, and selected while the shaft turns."""
        return self.modes.torque and self.modes.switch_while_enabled

    @property
    def usual_rate_hz(self) -> float:
        """Cycles per second, unless the run states another rate."""
        return self.cycle.rate_hz

    @property
    def rated_torque_by_hand(self) -> bool:
        """True if rig.yaml must state the torque of 100 %."""
        return self.rated_torque is None

    @property
    def untold(self) -> tuple[Parameter, ...]:
        """Parameters without a register."""
        return tuple(one for one in self.parameters if one.register_ is None)
