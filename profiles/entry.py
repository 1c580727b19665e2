"""Fields of every section of a profile: its source, and the confidence in it."""


from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final, Literal, Protocol, Self, TypeVar

from pydantic import Field, model_validator

from profiles.errors import UsageError
from profiles.messages import MessageCode
from profiles.model import DataModel, Finding, refuse_if

# ---------------------------------------------------------------------------------------------------------------------
# Required value of a drive's setting before a shaft may turn. The keys are the same on every bus.


class Require(DataModel):
    """Value that a parameter must have, in its unit."""

    equals: float | None = None
    one_of: tuple[float, ...] | None = None
    at_least: float | None = None
    at_most: float | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if all(value is None for value in (self.equals, self.one_of, self.at_least, self.at_most)):
            refuse_if([("", "say equals, one_of, at_least or at_most")])
        return self

    def met_by(self, value: float, slack: float) -> bool:
        """Return whether the value meets each part of the requirement. ``slack``: permitted difference."""
        return (
            (self.equals is None or abs(value - self.equals) <= slack)
            and (self.one_of is None or any(abs(value - one) <= slack for one in self.one_of))
            and (self.at_least is None or value >= self.at_least - slack)
            and (self.at_most is None or value <= self.at_most + slack)
        )

    def text(self, show: Callable[[float], str]) -> str:
        """Return the requirement in words. ``show``: returns a value with its unit."""
        parts = []
        if self.equals is not None:
            parts.append(show(self.equals))
        if self.one_of is not None:
            parts.append(" or ".join(show(one) for one in self.one_of))
        if self.at_least is not None:
            parts.append(f"at least {show(self.at_least)}")
        if self.at_most is not None:
            parts.append(f"at most {show(self.at_most)}")
        return ", ".join(parts)

    def text_in(self, unit: str) -> str:
        """Return the requirement in words, with values in this unit of the schema."""
        return self.text(lambda value: with_unit(value, unit))


_UNIT_TEXTS: Final = {"rpm_s": "rpm/s", "nm": "N·m", "rated": "of rated torque", "hz": "Hz", "kw": "kW", "none": ""}


def unit_text(unit: str) -> str:
    """Return the unit of a drive's parameter as in texts; "" for a number without a unit."""
    return _UNIT_TEXTS.get(unit, unit)


def with_unit(value: float, unit: str, digits: int = 10) -> str:
    """Return the value of a drive's parameter with its unit, in so many significant digits at most."""
    return f"{value:.{digits}g} {unit_text(unit)}".strip()


# ---------------------------------------------------------------------------------------------------------------------

Confidence = Literal["verified", "likely", "unverified"]
"""verified: read in the manufacturer's document or file · likely: a consistent second-hand source · unverified:
neither."""

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
ProfileName = Annotated[str, Field(pattern=r"^[a-z0-9_-]+/[a-z0-9._-]+$")]


class ProfileEntry(DataModel):
    """One entry of a profile."""

    source: str = Field(min_length=3, description="document, file or measurement that states it")
    confidence: Confidence = Field(description="verified, likely or unverified")


# ---------------------------------------------------------------------------------------------------------------------
# The speed controller's own parameters, for an engineer who types gains into the drive. No run writes them. A run reads
# those that name an entry of `parameters`.


ReadFrom = Annotated[str | None, Field(
    default=None, pattern=r"^[a-z][a-z0-9_]*$",
    description="entry of `parameters` that reads it in preflight, with a per_lsb in this unit; null = not read",
)]


CONTROLLER_UNITS = {
    "nm_s_rad": "N·m·s/rad", "a_s_rad": "A·s/rad", "percent_per_percent": "%/%", "nm_rad": "N·m/rad", "s": "s",
    "ms": "ms", "hz": "Hz",
}
"""Text of each known unit of the speed controller's parameters."""


class ControllerGain(ProfileEntry):
    """Proportional gain of the speed controller."""

    title: str = Field(min_length=3, description="the manual's number and name, such as 'p1470 P gain'")
    unit: Literal["nm_s_rad", "a_s_rad", "percent_per_percent", "unknown"] = Field(
        description="nm_s_rad: N·m per rad/s; a_s_rad: A per rad/s; percent_per_percent: torque in % of rated for a "
        "speed error in % of the rated (or reference) speed; unknown: the manual gives none"
    )
    parameter: ReadFrom = None


class ControllerIntegral(ProfileEntry):
    """Integral part of the speed controller."""

    title: str = Field(min_length=3, description="the manual's number and name")
    unit: Literal["s", "ms", "nm_rad", "unknown"] = Field(
        description="s, ms: an integral time T_I, so that I = P/T_I; nm_rad: the integral gain itself"
    )
    parameter: ReadFrom = None


class ControllerFilter(ProfileEntry):
    """Filter of the speed that the speed controller sees."""

    title: str = Field(min_length=3, description="the manual's number and name")
    unit: Literal["s", "ms", "hz", "unknown"] = Field(description="s, ms: a time constant; hz: a cut-off frequency")
    parameter: ReadFrom = None


class NotchParameter(ProfileEntry):
    """One parameter of the drive's notch filter (s² + 2 ζ_z ω s + ω²)/(s² + 2 ζ_p ω s + ω²)."""

    title: str = Field(min_length=3, description="the manual's number and name")
    quantity: Literal["frequency_hz", "width_hz", "depth_db", "numerator_damping", "denominator_damping"] = Field(
        description="width_hz: between the frequencies of −3 dB; depth_db: attenuation at the frequency, above 0; "
        "numerator_damping, denominator_damping: ζ_z and ζ_p"
    )


class SpeedControllerParameters(DataModel):
    """Entries for typing the gains of `tdhil tune` into the drive; tdhil never writes them."""

    gain: ControllerGain
    integral: ControllerIntegral
    filter: ControllerFilter | None = Field(
        default=None, description="filter of the speed that it sees; null = not known"
    )
    notch: tuple[NotchParameter, ...] = Field(
        default=(), description="parameters of its notch filter; [] = the drive has none, or it is not known"
    )
    simulated_only: bool = Field(
        default=False, description="true: only the simulated drive has them; nothing is read from a real one"
    )
    note: str | None = Field(default=None, description="further facts: adaptation, a filter, where it acts")

    @model_validator(mode="after")
    def _one_notch(self) -> Self:
        found = [one.quantity for one in self.notch]
        findings: list[Finding] = [("notch", f"{name} stands there twice") for name in sorted(set(found))
                                   if found.count(name) > 1]
        if found and "frequency_hz" not in found:
            findings.append(("notch", "a notch needs its frequency_hz"))
        refuse_if(findings)
        return self

    def belongs_to(self, *, simulated: bool) -> bool:
        """Return whether a simulated or a real drive has these parameters."""
        return simulated or not self.simulated_only

    def read_from(self) -> dict[str, str]:
        """Return the names of the `parameters` that are read: of ``gain``, ``integral`` and ``filter``."""
        parts = (("gain", self.gain), ("integral", self.integral), ("filter", self.filter))
        return {name: part.parameter for name, part in parts if part is not None and part.parameter is not None}


# ---------------------------------------------------------------------------------------------------------------------


class NamedParameter(Protocol):
    """Setting of a drive, with the name that other entries of the profile use for it."""

    @property
    def name(self) -> str: ...


Setting = TypeVar("Setting", bound=NamedParameter)


class DriveProfile(DataModel):
    """Common part of every profile; the schema of each bus is in a module of its name."""

    name: ProfileName = Field(description="vendor/model, as in --profile")
    title: str = Field(min_length=3, description="one line for tables and reports")
    bus: str
    experimental: bool = Field(default=False, description="second-hand, or never tested on the bus that it names")
    speed_controller: SpeedControllerParameters | None = Field(
        default=None, description="parameters of its speed controller, for `tdhil tune`; no run changes them"
    )

    def _speed_controller_names(self) -> list[tuple[str, str | None]]:
        """Return (place, name) of each entry of `parameters` that the speed controller refers to."""
        parts = {} if self.speed_controller is None else self.speed_controller.read_from()
        return [(f"speed_controller.{part}.parameter", name) for part, name in parts.items()]

    def entries(self) -> tuple[tuple[str, ProfileEntry], ...]:
        """Return (name, entry) for all entries of the profile that have a source and a confidence."""
        raise NotImplementedError

    def named(self, parameters: Sequence[Setting], name: str) -> Setting:
        """Return the parameter of that name. Raises UsageError if there is none."""
        found = next((one for one in parameters if one.name == name), None)
        if found is None:
            raise UsageError(f"the profile has no parameter {name!r}", where=self.name,
                             next_step=f"Parameters: {', '.join(one.name for one in parameters) or 'none'}",
                             entry=MessageCode.UNKNOWN_PROFILE_ENTRY)
        return found

    def below(self, confidence: Confidence) -> tuple[str, ...]:
        """Return the names of the entries of exactly this confidence."""
        return tuple(name for name, part in self.entries() if part.confidence == confidence)

    @property
    def can_torque(self) -> bool:
        """True if torque can be controlled over the bus, and selected while the shaft turns."""
        raise NotImplementedError

    @property
    def usual_rate_hz(self) -> float:
        """Cycles per second, unless the run states another rate."""
        raise NotImplementedError

    @property
    def rated_torque_by_hand(self) -> bool:
        """True if rig.yaml must state the torque of 100 %."""
        raise NotImplementedError

    @property
    def untold(self) -> Sequence[Any]:
        """Parameters that can't be read over the bus, each with ``name``, ``title`` and ``unit``."""
        return ()
