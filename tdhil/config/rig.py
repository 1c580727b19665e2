"""Bench: drive, bus, gear, load, machine limits, and the usual options of a run.

`Rig` mirrors rig.yaml key by key. The names contain the units, all of them SI. Torque and speed refer to the motor
shaft. It is frozen, and has the file and line of each key::

    drive: canopen
    bus: {interface: socketcan, channel: can0, bitrate: 500000}
    node: 1
    limits:
      speed_min_rad_s: 0.5
      …
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PrivateAttr,
    ValidationError,
    create_model,
)
from pydantic_core import core_schema

from drivers import DataFileError, PreflightRefused, Problem
from profiles import (
    Conversion,
    DataModel,
    Finding,
    Loaded,
    MessageCode,
    load_with_lines,
    messages_of,
    one_of,
    parse_with_lines,
)
from profiles.quantities import plain_number
from tdhil.config.acceptance import ACCEPTED_QUANTITIES, Expectation
from tdhil.config.options import CLOCKS, OPTIONS, Option, Topic
from tdhil.config.registry import BUSES, RegistryEntry, imported, names
from tdhil.file_kind import LOG, PAGE, PDF, RESULT, kind_of


def _within(low: float, high: float, *, zero: bool = False) -> Any:
    """Return a field with the range of real machines. A value outside is a typing error and could overflow."""
    return Field(ge=0.0 if zero else low, le=high)


@dataclass(frozen=True, eq=False)
class Registered:
    """Name in a registry, for pydantic. Another name is refused with the list of all names, as for a Literal.

    ``periodic``: only excitations with spectral lines.
    """

    registry: Mapping[str, RegistryEntry]
    periodic: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_before_validator_function(self._check, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "string", "enum": names(self.registry, periodic=self.periodic)}

    def _check(self, value: Any) -> Any:
        return one_of(names(self.registry, periodic=self.periodic), value)


Positive = Annotated[float, _within(1e-9, 1e9)]
NotNegative = Annotated[float, _within(0.0, 1e9, zero=True)]
Torque = Annotated[float, _within(1e-6, 1e7)]
Speed = Annotated[float, Field(ge=-1e5, le=1e5)]
Time = Annotated[float, _within(1e-6, 1e7)]
Inertia = Annotated[float, _within(1e-9, 1e9)]
Ratio = Annotated[float, _within(1e-6, 1e6)]

LONGEST_NAME = 200
"""Longest name of a rig, characters."""
LONGEST_BRAKING_S = 90.0
"""Longest braking from the highest speed, s. The program waits for a stop for three times its ramp, at most 5 min."""


class Limits(DataModel):
    """Limits of the machine. The host monitors them, and the drive too if possible."""

    speed_min_rad_s: Speed = Field(description="rad/s; lowest speed in torque mode")
    speed_max_rad_s: Annotated[float, _within(1e-6, 1e5)] = Field(description="rad/s; highest speed")
    torque_nm: Torque = Field(description="N·m; highest torque, either sign")
    time_s: Time = Field(description="s; longest run")
    quick_stop_rad_s2: Positive = Field(description="rad/s²; deceleration of a stop")
    watchdog_s: float = Field(default=0.5, ge=0.02, le=5, description="s of silence until the drive stops by itself")
    temperature_c: float | None = Field(
        default=None, gt=0, le=300, description="°C; above it a run is stopped, if the drive reports a temperature"
    )
    probe_torque_nm: Torque = Field(description="N·m; highest torque of the sign probe (direction and breakaway)")
    probe_travel_rad: Positive = Field(description="rad; farthest travel of the shaft during the sign probe")

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Return errors: an empty speed window, a probe torque above the limit, or a stop that takes too long."""
        findings = []
        lowest, highest = values.get("speed_min_rad_s"), values.get("speed_max_rad_s")
        if lowest is not None and highest is not None and lowest >= highest:
            findings.append(("speed_min_rad_s", f"must be below speed_max_rad_s, which is {highest:g}"))
        probe, most = values.get("probe_torque_nm"), values.get("torque_nm")
        if probe is not None and most is not None and probe > most:
            findings.append(("probe_torque_nm", f"must not be above torque_nm, which is {most:g}"))
        braking = values.get("quick_stop_rad_s2")
        if highest is not None and braking is not None and highest > LONGEST_BRAKING_S * braking:
            findings.append(("quick_stop_rad_s2", f"brakes from speed_max_rad_s in {plain_number(highest / braking, 3)}"
                             f" s, more than the limit of {LONGEST_BRAKING_S:g} s:"
                             f" give {plain_number(highest / LONGEST_BRAKING_S, 2)} or more"))
        return findings


def _load_of(value: Any) -> Any:
    """Accept a single word as the kind of load."""
    return {"kind": value} if isinstance(value, str) else value


class Load(DataModel):
    """Load on the shaft. Stated sizes of the pipe are used for the result; the kind alone is enough."""

    kind: Literal["none", "string"] = Field(default="none", description="string: a drill string is on the shaft")
    length_m: Annotated[float, _within(1.0, 2e4)] | None = Field(
        default=None, description="m; of uniform pipe, from the top down to where its section changes"
    )
    outer_diameter_m: Annotated[float, _within(1e-3, 10.0)] | None = Field(default=None, description="m; of the pipe")
    inner_diameter_m: Annotated[float, _within(0.0, 10.0, zero=True)] | None = Field(
        default=None, description="m; of the pipe"
    )
    tolerance: Annotated[float, _within(1e-3, 0.5)] = Field(
        default=0.03, description="relative standard uncertainty of the weight and stiffness that follow (1 sd)"
    )

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Return errors: missing sizes, a pipe without a wall, or sizes without a string."""
        sizes = ("length_m", "outer_diameter_m", "inner_diameter_m")
        given = [name for name in sizes if values.get(name) is not None]
        if values.get("kind") == "none" and given:
            return [(given[0], "belongs to kind: string")]
        findings = [(given[0], f"needs '{name}' beside it") for name in sizes if given and name not in given]
        outer, inner = values.get("outer_diameter_m"), values.get("inner_diameter_m")
        if outer is not None and inner is not None and inner >= outer:
            findings.append(("inner_diameter_m", f"must be less than outer_diameter_m, which is {outer:g}"))
        return findings


class Gear(DataModel):
    """Gear between motor and main shaft."""

    ratio: Ratio = Field(default=1.0, description="i = ω_motor / ω_main; J at the main shaft is J·i²")


class DriveData(DataModel):
    """Facts that the drive does not report, and the uncertainty of its signals."""

    rated_torque_nm: Torque | None = Field(default=None, description="N·m; from the name plate, if 6076h has none")
    torque_scale_rel_sd: float | None = Field(
        default=None, ge=0, lt=1,
        description="standard uncertainty of the drive's torque scale, as a share (0.02 = 2 %)",
    )
    torque_calibration: str | None = Field(
        default=None, min_length=1, description="file of `tdhil calibrate torque`, beside rig.yaml: every torque is"
        " then in calibrated N·m, and its interval replaces torque_scale_rel_sd"
    )
    calibration_valid_days: Positive = Field(
        default=365.0, description="days; an older torque calibration is used with a warning"
    )
    speed_lag_s: NotNegative | None = Field(default=None, description="s; time constant on the reported speed")
    speed_lag_sd_s: NotNegative | None = Field(default=None, description="s; its standard uncertainty")
    torque_lag_s: NotNegative | None = Field(default=None, description="s; time constant on the reported torque")
    torque_lag_sd_s: NotNegative | None = Field(default=None, description="s; its standard uncertainty")
    reference_filter_s: NotNegative | None = Field(
        default=None, description="s; time constant of the drive's filter on its speed reference"
    )
    parameters: dict[str, float] = Field(
        default={}, description="drive parameters that can't be read over the bus, by the profile's names, in its units"
    )

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Return errors: a standard deviation without its value."""
        return [
            (f"{name}_sd_s", f"needs {name}_s, the value whose standard deviation it is")
            for name in ("speed_lag", "torque_lag")
            if values.get(f"{name}_sd_s") is not None and values.get(f"{name}_s", ...) is None
        ]


class Expected(DataModel):
    """Expected values of the shaft, for planning before motion (`--dry-run`); never used for the result."""

    inertia_kg_m2: Inertia | None = Field(default=None, description="kg·m² at the motor")
    viscous_nm_s_rad: NotNegative | None = Field(default=None, description="N·m·s/rad")
    coulomb_nm: Annotated[float, _within(0.0, 1e7, zero=True)] | None = Field(default=None, description="N·m")
    load_noise_nm: Torque | None = Field(default=None, description="N·m; standard deviation of the disturbing torque")


_ONLY_THE_OPERATOR = {
    name: f"belongs to one run, never to a file; remove the line and give {one.flag}{' NAME' if one.joined else ''} on "
          "the command line"
    for one in OPTIONS if one.group is Topic.OVERRIDES and not one.at
    for name in ((one.name, f"{one.name}s") if one.joined else (one.name,))
}


def attribute_of(key: str) -> str:
    """Return the attribute of a key of rig.yaml; it differs if pydantic has a method of this name, such as ``json``."""
    return f"{key}_" if hasattr(BaseModel, key) else key


def _with_options(section: str, base: type[DataModel]) -> Any:
    """Return ``base`` with a field for each option of this section of rig.yaml; None means not given."""
    found: dict[str, Any] = {}
    for one in OPTIONS:
        at, _, key = one.at.rpartition(".")
        if one.at and at == section:
            alias = key if attribute_of(key) != key else None
            field = Field(default=None, alias=alias, description=one.help_text)
            found[attribute_of(key)] = (_annotation(one), field)
    name = base.__name__.removeprefix("_")
    return create_model(name, __base__=base, __module__=__name__, __doc__=base.__doc__, **found)


def _annotation(one: Option) -> Any:
    if one.known:
        return Literal[one.known] | None
    if isinstance(one.choices, Mapping):
        return Annotated[str, Registered(one.choices)] | None
    if one.joined:
        return tuple[str, ...] | None
    return Annotated[one.kind, Field(**one.limits)] | None if one.limits else one.kind | None


class _RunSection(DataModel):
    """Options of a run. None: the plan, or the default, applies."""

    never_here: ClassVar[Mapping[str, str]] = _ONLY_THE_OPERATOR

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Return errors: two clocks at the same time."""
        first, second = CLOCKS
        both = values.get(first) and values.get(second)
        return [(second, f"and {first} exclude each other; keep one")] if both else []


if TYPE_CHECKING:
    RunSection = _RunSection
    _Options = DataModel
else:
    RunSection = _with_options("run", _RunSection)
    _Options = _with_options("", DataModel)


class Service(DataModel):
    """Rights of `tdhil serve` on this bench."""

    motion: Literal["never", "attended", "watched"] = Field(
        default="never",
        description="remote motion: never, with a code from the operator at the rig, or also watched all the time",
    )


class Rig(_Options):
    """Bench, without the sections of the buses (`rig_model`). Each key is optional until it is needed."""

    never_here: ClassVar[Mapping[str, str]] = _ONLY_THE_OPERATOR

    name: str | None = Field(
        default=None, min_length=1, max_length=LONGEST_NAME,
        description="name of the rig in reports and histories; required unless the drive is simulated",
    )
    limits: Limits | None = Field(default=None, description="required unless the drive is simulated")
    gear: Gear = Gear()
    load: Annotated[Load, BeforeValidator(_load_of)] = Load()
    make_up_torque_nm: Torque | None = Field(
        default=None, description="N·m at the motor: make-up torque of the joints, divided by gear.ratio")
    torque_ramp_nm_s: Positive | None = Field(default=None, description="N·m/s; release rate of trapped torque")
    allow_reverse: bool = Field(default=False, description="allow reverse rotation; it can unscrew tool joints")
    drive_data: DriveData = DriveData()
    expected: Expected = Expected()
    acceptance: dict[str, Annotated[str, Field(max_length=80)]] = Field(
        default={}, description="expected values with tolerances, such as inertia: 104 ± 5 %; names:"
        f" {', '.join(ACCEPTED_QUANTITIES)}")
    reference_inertia_kg_m2: Inertia | None = Field(default=None, description="kg·m² at the motor; shown beside J")
    run: RunSection = RunSection()
    service: Service = Service()

    _file: str = PrivateAttr(default="")
    _lines: Mapping[tuple[str | int, ...], int] = PrivateAttr(default={})
    _conversions: tuple[Conversion, ...] = PrivateAttr(default=())

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Return errors: missing keys of a string, and limits that contradict other keys."""
        asked = values.get("acceptance")
        wrong: list[Finding] = []
        for name, text in asked.items() if isinstance(asked, Mapping) else ():
            try:
                Expectation.of(str(name), str(text))
            except ValueError as error:
                wrong.append((f"acceptance.{name}", str(error)))
        load = _load_of(values.get("load"))
        is_string = isinstance(load, Mapping) and load.get("kind") == "string"
        findings = [
            ("load", f"string needs '{name}' ({_describe(name)})")
            for name in ("make_up_torque_nm", "torque_ramp_nm_s")
            if is_string and values.get(name, ...) is None
        ]
        limits: Mapping[str, Any] = values.get("limits") or {}
        torque, lowest, watchdog = (limits.get(name) for name in ("torque_nm", "speed_min_rad_s", "watchdog_s"))
        make_up, rate_hz = values.get("make_up_torque_nm"), values.get("rate_hz")
        if is_string and make_up and torque is not None and torque >= make_up:
            findings.append(("limits.torque_nm", f"must be below make_up_torque_nm, which is {make_up:g}"))
        if lowest is not None and lowest < 0 and values.get("allow_reverse") is False:
            findings.append(("limits.speed_min_rad_s", "below 0 the shaft turns backwards: needs allow_reverse: true"))
        if rate_hz and watchdog is not None and watchdog * rate_hz < 5:
            findings.append(("limits.watchdog_s", f"must span at least 5 cycles ({5 / rate_hz:g} s at rate_hz)"))
        return findings + wrong

    def line(self, dotted: str) -> int:
        """Return the line in rig.yaml of a key such as ``limits.torque_nm``; 0 if the key is missing."""
        return self._lines.get(tuple(dotted.split(".")), 0)

    def source(self, dotted: str) -> str:
        """Return the place of a key, such as ``rig.yaml:7``, or '' if the file does not have it."""
        line = self.line(dotted)
        return f"{Path(self._file).name}:{line}" if line else ""

    @property
    def conversions(self) -> tuple[tuple[str, str, str], ...]:
        """Conversions (key, '100 rpm = 10.47 rad/s', 'rig.yaml:7') of every value that had a unit."""
        keys = [".".join(map(str, one.path)) for one in self._conversions]
        return tuple((key, one.text, self.source(key)) for key, one in zip(keys, self._conversions, strict=True))

    def get(self, dotted: str) -> Any:
        """Return the value of a key such as ``run.seed``."""
        value: Any = self
        for part in dotted.split("."):
            value = getattr(value, attribute_of(part))
        return value

    @property
    def file(self) -> str:
        """Path of the file; '' without one."""
        return self._file

    @property
    def folder(self) -> Path:
        """Folder in which relative paths of rig.yaml start."""
        return Path(self._file).parent


def rig_model() -> type[Rig]:
    """Return `Rig` with the section of each bus in the table `BUSES`."""
    return _with_sections(tuple(BUSES.items()))


@lru_cache(maxsize=4)
def _with_sections(buses: tuple[tuple[str, RegistryEntry], ...]) -> type[Rig]:
    found: dict[str, Any] = {}
    for bus in (imported(entry.at) for _, entry in buses):
        if bus.section_model is not None:
            found[bus.section] = (bus.section_model, bus.section_model())
    model: type[Rig] = create_model("Rig", __base__=Rig, __module__=__name__, __doc__=Rig.__doc__, **found)
    return model


def load_rig(path: Path) -> Rig:
    """Return the bench of a rig.yaml, in SI. Raises DataFileError with every problem and its line."""
    if (kind := kind_of(path)) in (LOG, RESULT, PAGE, PDF):
        raise DataFileError((Problem(str(path), 0, f"is {kind}. --rig needs rig.yaml"),))
    return _rig_of(load_with_lines(path, rig_model(), convert=True))


def parse_rig(text: str, name: str) -> Rig:
    """Return the bench of a text that is not in a file yet; problems state ``name`` as the file."""
    return _rig_of(parse_with_lines(text, name, rig_model(), convert=True))


def _rig_of(loaded: Loaded[Rig]) -> Rig:
    rig = loaded.value
    rig._file, rig._lines, rig._conversions = loaded.file, loaded.lines, loaded.conversions
    return rig


def require_limits(rig: Rig | None) -> Limits:
    """Return the limits. Raises PreflightRefused with the missing keys: no real shaft moves without limits."""
    if rig is not None and rig.limits is not None:
        return rig.limits
    where = rig._file if rig is not None and rig._file else "rig.yaml"
    raise PreflightRefused("no machine limits, and no real shaft moves without them", where=where,
                           next_step=limits_step(rig), entry=MessageCode.NO_LIMITS)


def limits_step(rig: Rig | None) -> str:
    """Return the step that adds the missing limits."""
    keys = ", ".join(name for name, field in Limits.model_fields.items() if field.is_required())
    named = rig is not None and rig._file
    return f"Add a section limits: with {keys} (docs: rig.yaml)" + ("" if named else ", and name the file with --rig")


def require_name(rig: Rig | None) -> str:
    """Return the rig's name. Raises PreflightRefused: a result of a real drive belongs to a rig."""
    if rig is not None and rig.name is not None:
        return rig.name
    raise PreflightRefused(
        "no name for the rig of a drive that is not simulated",
        where="rig.yaml" if rig is None or not rig._file else rig._file,
        next_step="Add a line with the rig's own name, such as name: bench 3. Results of one name and one drive are"
                  " one history", entry=MessageCode.NO_RIG_NAME)


_SIMULATED_LIMITS = Limits(
    speed_min_rad_s=0.5,
    speed_max_rad_s=10.0,
    torque_nm=400.0,
    time_s=900.0,
    quick_stop_rad_s2=2.0,
    watchdog_s=0.5,
    probe_torque_nm=200.0,
    probe_travel_rad=3.0,
)
_SIMULATED_TORQUE_SCALE_SD = 0.02


def simulated_default_rig(rig: Rig | None = None) -> Rig:
    """Return the bench of the simulated rig, overridden by ``rig``. Raises DataFileError for a contradiction."""
    rig = rig or rig_model()()
    data = rig.model_dump(by_alias=True)
    data["limits"] = data["limits"] or _SIMULATED_LIMITS.model_dump()
    if data["drive_data"]["torque_scale_rel_sd"] is None:
        data["drive_data"]["torque_scale_rel_sd"] = _SIMULATED_TORQUE_SCALE_SD
    try:
        filled = rig_model().model_validate(data)
    except ValidationError as error:
        file = rig._file or "rig"
        found = [
            Problem(file, rig.line(".".join(map(str, path))), f"{'.'.join(map(str, path))}: {message} (simulated rig)")
            for path, message in messages_of(error, data, rig_model())
        ]
        raise DataFileError(tuple(found)) from None
    filled._file, filled._lines, filled._conversions = rig._file, rig._lines, rig._conversions
    return filled


def _describe(name: str) -> str:
    return Rig.model_fields[name].description or name
