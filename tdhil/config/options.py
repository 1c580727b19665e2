"""The table of a run's options: each is declared here, once, and everything that takes options is made from it.

A row is a field of one of three dataclasses: `RunOptions` (what rig.yaml may say, too), `Overrides` and `RunDetails`
(said for one run). The field's annotation is the option's type, its default the option's default; `option` has the
rest. From `OPTIONS` come the command line, the schema of rig.yaml, the keywords of `tdhil.run`, the service's API and
its forms, and the rows of docs/rig.md. Nothing heavy is imported here: ``--help`` reads this table.
"""

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields
from enum import Enum
from operator import ge, gt, le, lt
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import Any, Final, Literal, Protocol, Self, Union, get_args, get_origin, get_type_hints

from drivers import own_limits
from profiles.quantities import FREQUENCY, FRICTION, MINUTE, PERCENT, SHARE, SPEED, TIME, Unit
from tdhil.config.registry import BUSES, DEFAULT_BUS, DEFAULT_EXCITATION, EXCITATIONS, MODELS, RegistryEntry

# ---------------------------------------------------------------------------------------------------------------------
# A value, and its source.


class Origin(Enum):
    """Who had the say on a setting. What follows from it hangs on this, never on the words that name the place."""

    COMMAND_LINE = "command line"
    RIG_FILE = "rig.yaml"
    BUS_FILE = "python-can's own files and variables"
    PROFILE = "profile"
    BUILT_IN = "default"
    SCAN = "scan"


class _File(Protocol):
    def source(self, dotted: str) -> str: ...


@dataclass(frozen=True)
class Setting:
    """One option's value, where it came from in words (``--node``, ``rig.yaml:7``, ``default``), and who that is."""

    value: Any
    source: str
    origin: Origin

    @staticmethod
    def by_flag(value: Any, flag: str) -> "Setting":
        return Setting(value, flag, Origin.COMMAND_LINE)

    @staticmethod
    def by_rig(value: Any, rig: _File, at: str) -> "Setting":
        """``at``: the key in rig.yaml."""
        return Setting(value, rig.source(at) or "rig", Origin.RIG_FILE)


# ---------------------------------------------------------------------------------------------------------------------
# What is declared of an option.


class Topic(Enum):
    """Sections of ``--help``, in their order."""

    MOTION = "motion"
    RESULT = "result"
    DRIVE = "drive"
    CYCLE = "control loop"
    OVERRIDES = "overrides"
    OUTPUT = "log and output"
    SIMULATED = "simulated rig"


_LIMITS: Final = {"gt": ("greater than", gt), "ge": ("at least", ge), "lt": ("less than", lt), "le": ("at most", le)}


@dataclass(frozen=True)
class Form:
    """A field of the service's forms. ``parts``: where it appears, of ``run``, ``simulated``,
    ``real``, ``rehearsal`` and ``replay``.

    ``unit``: the unit of a number without one. ``hint``: shown in the empty field in place of the default.
    """

    label: str
    parts: tuple[str, ...] = ("run",)
    unit: Unit | None = None
    hint: str = ""
    wide: bool = False


@dataclass(frozen=True)
class Option:
    """One row of the table.

    ``name`` in a parsed command line and in the API, ``keyword`` in Python, ``flag`` on the command line, ``at`` in
    rig.yaml ('' if no file may state it). ``kind``: float, int, str, bool or tuple. ``limits``: gt, ge, lt, le or
    min_length, as pydantic names them. ``help``: one sentence; ``{default}`` in it is the default. ``more``: the
    sentences of the reference page, if those differ. ``unset``: what applies if nothing is given.
    ``python``: is it a keyword of `tdhil.run` or `tdhil.simulate`? ``api``: is it taken over HTTP? A text is the reason
    for a refusal. ``asked_again``: what it is of a replay, which may ask for another value; '' if it may not.
    ``beside_rig``: a path, looked for beside rig.yaml if it stands there. ``is_file``: a path that a run reads or
    writes. ``longest``: most characters of a text that comes over HTTP.
    """

    name: str
    keyword: str
    kind: type
    default: Any
    known: tuple[str, ...]
    flag: str
    at: str
    group: Topic
    help: str
    more: str
    unset: str
    unit: Unit | None
    choices: Mapping[str, RegistryEntry] | tuple[str, ...]
    limits: Mapping[str, Any]
    metavar: str | None
    python: bool
    api: bool | str
    form: Form | None
    asked_again: str
    beside_rig: bool
    is_file: bool
    longest: int | None

    @property
    def joined(self) -> bool:
        """A list: the command line's entries come in addition to rig.yaml's."""
        return self.kind is tuple

    @property
    def allowed(self) -> tuple[str, ...]:
        """Every choice, as the registry has it now; empty where any value will do."""
        return self.known or tuple(self.choices)

    @property
    def default_text(self) -> str:
        """The default in words: '' for none."""
        if self.default is None or self.joined:
            return self.unset
        return str(self.default).lower() if self.kind is bool else str(self.default)

    @property
    def help_text(self) -> str:
        """The sentence of ``--help``."""
        return self.help.replace("{default}", self.default_text)

    def refusal(self, value: float) -> str:
        """Return the limits, in words, that a number is not within; '' if it is."""
        right = all(_LIMITS[name][1](value, limit) for name, limit in self.limits.items())
        return "" if right else " and ".join(f"{_LIMITS[name][0]} {limit:g}" for name, limit in self.limits.items())

    @property
    def form_hint(self) -> str:
        """Text of an empty field: the value that applies."""
        if self.form is None or self.form.hint or self.default is None or self.joined:
            return self.unset if self.form is None else self.form.hint or self.unset
        default = self.default if self.form.unit is None else f"{self.form.unit.of_si(self.default):g}"
        return f"as rig.yaml, else {default}"


def option(
    flag: str, at: str = "", default: Any = None, *, group: Topic, help: str, more: str = "", unset: str = "",
    unit: Unit | None = None, choices: Mapping[str, RegistryEntry] | tuple[str, ...] = (), metavar: str | None = None,
    python: bool = True, api: bool | str = False, form: Form | None = None, asked_again: str = "",
    beside_rig: bool = False, is_file: bool = False, longest: int | None = None, **limits: float,
) -> Any:
    """A row of the table, as the field of a dataclass. The arguments: `Option`."""
    row = {name: value for name, value in locals().items() if name != "default"}
    return field(default=default, metadata={"row": row})


def _rows(table: type) -> Iterator[Option]:
    """The options that the fields of a dataclass declare."""
    hints = get_type_hints(table)
    for one in fields(table):
        if (row := one.metadata.get("row")) is None:
            continue
        kind, known = _kind(hints[one.name])
        name = one.name if row["at"] else row["flag"].removeprefix("--").replace("-", "_")
        default = None if kind is tuple or one.default is MISSING else one.default
        yield Option(name=name, keyword=one.name, kind=kind, known=known, default=default, **row)


def _kind(annotation: Any) -> tuple[type, tuple[str, ...]]:
    """The type of an option without its None, and the choices that a Literal names."""
    if get_origin(annotation) in (Union, UnionType):
        (annotation,) = (one for one in get_args(annotation) if one is not NoneType)
    if get_origin(annotation) is Literal:
        return str, get_args(annotation)
    return get_origin(annotation) or annotation, ()


# ---------------------------------------------------------------------------------------------------------------------
# The table


@dataclass(frozen=True)
class RunOptions:
    """Every option of a run that a file may state, with its value, and in ``settings`` the source of each.

    None as a value: chosen by the drive's profile or by the plan of the run.
    """

    drive: str = option(
        "--drive", "drive", DEFAULT_BUS, group=Topic.DRIVE, choices=BUSES,
        help="how the drive is spoken to (default: as the profile is, else {default})",
        more="bus of the drive. Left out, it follows `profile`, or whichever of `bus` and `modbus` says where the "
             "drive is",
    )
    node: int | None = option(
        "--node", "node", group=Topic.DRIVE, metavar="N", ge=1, le=127, unset="the profile's",
        help="CANopen node number (default: {default})", more="CANopen node number of the drive, 1 to 127",
    )
    profile: str = option(
        "--profile", "profile", "generic/cia402", group=Topic.DRIVE, metavar="NAME", beside_rig=True, is_file=True,
        min_length=1, help="vendor/model, or a .yaml file (default: the generic one of the bus, {default} on CANopen)",
        more="a drive that ships (`tdhil profiles`), or a `.yaml` file of your own; on Modbus `generic/modbus` is the "
             "default",
    )
    accept_unverified: tuple[str, ...] = option(
        "--accept-unverified", "accept_unverified", (), group=Topic.OVERRIDES, metavar="NAME", api=True,
        form=Form("Entries of the profile that are not verified", ("real",), hint="likely", wide=True),
        help="accept this entry of the profile although it is not verified; 'likely' accepts all of those",
        more="entries of the profile that are accepted although they are not verified, by name, such as `[watchdog, "
             "parameters.time_out]`; the name of a section accepts its `likely` entries, `likely` accepts all of "
             "those, and an `unverified` entry is accepted by its own name only. Adds to those of the command line",
    )
    rate_hz: float | None = option(
        "--rate", "rate_hz", group=Topic.CYCLE, unit=FREQUENCY, metavar="HZ", api=True, gt=0, le=2000,
        unset="what this computer holds", help="cycles a second (default: {default}, up to the profile's)",
        more="cycles a second, up to 2000. Without it, the profile's (250 as a rule) and lower ones are "
             "tried before motion, and the highest is taken at which 999 cycles of 1000 begin, and are answered, in "
             "time by half a period",
    )
    excitation: str = option(
        "--excitation", "run.excitation", DEFAULT_EXCITATION, group=Topic.MOTION, choices=EXCITATIONS, api=True,
        form=Form("Motion"), help="stage 5 (default {default})", more="motion of stage 5",
    )
    mode: Literal["torque", "speed"] | None = option(
        "--mode", "run.mode", group=Topic.MOTION, api=True, unset="torque, where the drive has it",
        help="what the drive regulates in stage 5",
    )
    frequency_hz: float | None = option(
        "--frequency", "run.frequency_hz", group=Topic.MOTION, unit=FREQUENCY, metavar="HZ", api=True, unset="planned",
        ge=1e-6, le=1e4, help="lowest line or the tone", more="the lowest line, or the tone",
    )
    amplitude_rad_s: float | None = option(
        "--amplitude", "run.amplitude_rad_s", group=Topic.MOTION, unit=SPEED, metavar="RAD_S", api=True,
        unset="planned", ge=1e-9, le=1e5, help="peak of the speed, such as 1.5 or 15rpm", more="amplitude of the speed",
    )
    offset_rad_s: float | None = option(
        "--offset", "run.offset_rad_s", group=Topic.MOTION, unit=SPEED, metavar="RAD_S", api=True, unset="planned",
        ge=-1e5, le=1e5, help="mean speed, such as 4 or 40rpm", more="mean speed",
    )
    periods: int | None = option(
        "--periods", "run.periods", group=Topic.MOTION, metavar="N", api=True, unset="planned", ge=1, le=10_000,
        help="periods per mean speed, settling included", more="periods at each mean speed, the first of which settles",
    )
    tolerance: float = option(
        "--tolerance", "run.tolerance", 0.05, group=Topic.RESULT, unit=SHARE, metavar="SHARE", api=True, gt=0, lt=1,
        form=Form("Tolerance: how tight, ± % of J", ("run", "replay"), PERCENT),
        asked_again="half-width of the interval that is enough",
        help="acquire until the half-width of J's interval is this share of it, such as 1% or 0.01",
        more="half-width of the interval that is enough, as a share of J (`0.01`; on the command line `1%` too); a "
             "wider one is `valid_wide`. If it is given, stage 5 goes on until the interval is this tight",
    )
    max_time_s: float | None = option(
        "--max-time", "run.max_time_s", group=Topic.MOTION, unit=TIME, metavar="TIME", api=True, ge=1e-6, le=1e7,
        unset="what `limits.time_s` leaves", form=Form("At most, minutes", unit=MINUTE, hint="as the limits allow"),
        help="longest stage 5, such as 300 or 5min (default: what limits.time_s leaves)",
        more="(on the command line `5min` too); longest stage 5. Without a tolerance: how long it is planned for",
    )
    impedance: Literal["offset", "reference"] | None = option(
        "--impedance", "run.impedance", group=Topic.MOTION,
        help="measure the drive's own impedance, in its speed loop, by its torque offset or reference",
        more="measure [the drive's own impedance](soft_torque.md#the-drives-own-impedance), in its speed loop: by its "
             "torque offset, or by its speed reference",
    )
    string_impedance_nm_s_rad: float | None = option(
        "--string-impedance", "run.string_impedance_nm_s_rad", group=Topic.MOTION, unit=FRICTION, metavar="NMS",
        ge=0, le=1e9, unset="that of the pipe in `load`, if any",
        help="impedance of the pipe for which the reflection is reported, N·m·s/rad at the main shaft",
        more="ζ, at the main shaft, of the string for which the reflection is reported",
    )
    model: str = option(
        "--model", "run.model", "auto", group=Topic.RESULT, choices=MODELS, api=True, asked_again="of the shaft",
        form=Form("Model", ("replay",)), help="of the shaft (default {default}: the simplest that fits)",
        more="of the shaft",
    )
    confidence: float = option(
        "--confidence", "run.confidence", 0.95, group=Topic.RESULT, unit=SHARE, metavar="P", api=True, ge=0.5, lt=1,
        asked_again="of the interval", help="of the interval (default {default})", more="of the interval",
    )
    seed: int | None = option(
        "--seed", "run.seed", group=Topic.SIMULATED, metavar="N", api=True, ge=0, le=2**63 - 1,
        form=Form("Seed, repeats a run", ("simulated",), hint="drawn"), unset="drawn, and printed",
        help="repeats a simulated run",
    )
    simulate: bool = option(
        "--simulate", "run.simulate", False, group=Topic.SIMULATED, python=False,
        help="embedded simulator; the default if no bus or line of a drive is configured",
        more="embedded simulator, whatever bus is configured",
    )
    real_time: bool = option(
        "--real-time", "run.real_time", False, group=Topic.SIMULATED, api=True,
        form=Form("by the clock, not as fast as it goes", ("simulated", "rehearsal")), help="against the wall clock",
        more="the embedded rig against the wall clock; excludes `stepped`",
    )
    stepped: bool = option(
        "--stepped", "run.stepped", False, group=Topic.SIMULATED, help="step a simulator on the bus by SYNC",
        more="a simulator in another process is stepped by SYNC; a real drive is refused, and so is Modbus over a wire",
    )
    yes: bool = option(
        "--yes", "", False, group=Topic.OVERRIDES, python=False, help="no prompt before motion; limits stay",
        api="a confirmation is typed in for each run; nothing replaces it",
    )
    json: bool = option(
        "--json", "run.json", False, group=Topic.OUTPUT, python=False, help="one JSON document on stdout",
        more="one JSON document on stdout, nothing else there",
    )
    log: str = option(
        "--log", "run.log", "run.mcap", group=Topic.OUTPUT, metavar="run.mcap", is_file=True, min_length=1,
        help="where the log goes; an older one is moved aside",
        more="the log; an older one there is moved aside, a live one never: then this run takes a name of its own. "
             "What a run leaves that ended before anything moved goes to `run.refused.mcap`, beside the last good log",
    )
    plant: str | None = option(
        "--plant", "run.plant", group=Topic.SIMULATED, metavar="plant.yaml", beside_rig=True, is_file=True,
        min_length=1, help="other parameters of the embedded rig",
        more="[other parameters](../examples/plant.yaml) of the embedded rig",
    )
    trace: str | None = option(
        "--trace", "run.trace", group=Topic.SIMULATED, metavar="shaft.csv", is_file=True, min_length=1,
        help="true shaft of the embedded rig", more="CSV of the true shaft of the embedded rig",
    )
    settings: Mapping[str, Setting] = field(default_factory=dict)

    @staticmethod
    def of(settings: Mapping[str, Setting]) -> "RunOptions":
        values = {name: setting.value for name, setting in settings.items()}
        return RunOptions(**values, settings=MappingProxyType(dict(settings)))

    def source(self, name: str) -> str:
        """Where an option's value came from, in words."""
        return self.settings[name].source

    def given(self, name: str) -> bool:
        """Has anybody said it, or is it the built-in default?"""
        return self.settings[name].origin is not Origin.BUILT_IN

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """(option, value, source) to print; '-' where the profile or the plan will choose."""
        for name, setting in self.settings.items():
            yield name, _shown(setting.value), setting.source

    def files(self) -> dict[str, Path]:
        """The files that the options name, by their flags."""
        named = {one.flag: getattr(self, one.name) for one in RESOLVED if one.is_file}
        return {flag: Path(name) for flag, name in named.items() if name is not None and not is_name(flag, name)}

    def replaced(self, **settings: Setting) -> "RunOptions":
        """The same with other settings of these names."""
        return RunOptions.of({**self.settings, **settings})


class _Said:
    """Options of one run that no file states."""

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Build it from values by the options' names; None is not given."""
        given = {one.keyword: values.get(one.name) for one in _rows(cls)}
        return cls(**{name: tuple(value) if isinstance(value, list) else value
                      for name, value in given.items() if value is not None})


@dataclass(frozen=True)
class Overrides(_Said):
    """Overrides by the operator, by name, for one run: rig.yaml states none of them."""

    no_watchdog: bool = option(
        "--accept-no-watchdog", group=Topic.OVERRIDES, default=False,
        api="nothing but who stands there would stop the shaft: it is never taken over HTTP",
        help="take a drive whose watchdog can't be armed: it won't stop by itself if this host dies",
    )
    shared_watchdog: bool = option(
        "--accept-shared-watchdog", group=Topic.OVERRIDES, default=False,
        api="nothing but who stands there may stop the shaft: it is never taken over HTTP",
        help="Modbus: take a drive whose watchdog other clients feed, too: it won't stop by itself if this host dies "
             "while one of them goes on asking",
    )
    wider_limits: tuple[str, ...] = option(
        "--accept-wider-limit", group=Topic.OVERRIDES, default=(), choices=own_limits.NAMES, api=True,
        help="let the run widen this limit of the drive's own; otherwise a tighter one stays",
    )
    speed_unit: bool = option(
        "--accept-speed-unit", group=Topic.OVERRIDES, default=False, api=True,
        form=Form("the profile's unit of speed, unseen", ("real",)),
        help="take the profile's unit of speed without seeing the shaft turn as fast as it says",
    )
    reset_fault: bool = option(
        "--reset-fault", group=Topic.OVERRIDES, default=False, api=True,
        form=Form("reset a drive that is in fault", ("real",)),
        help="reset a drive that is in fault; never done without this option",
    )


@dataclass(frozen=True)
class RunDetails(_Said):
    """Details of one run: what the log states of it, faults to rehearse, the priority of its control loop."""

    operator: str | None = option(
        "--operator", group=Topic.OUTPUT, metavar="NAME", api=True, longest=500, form=Form("Operator"),
        help="who ran it, for log and report",
    )
    note: str | None = option(
        "--note", group=Topic.OUTPUT, metavar="TEXT", api=True, longest=500, form=Form("Note", wide=True),
        help="remark on this run, for log and report",
    )
    faults: tuple[str, ...] = option(
        "--fault", group=Topic.SIMULATED, default=(), metavar="FAULT", api=True,
        form=Form("Rehearse a fault", ("simulated",), hint="sto@hold+2s"),
        help="rehearse a fault of the embedded rig, such as sto@hold+2s; 'list' shows them all",
    )
    real_time_priority: bool | None = option(
        "--real-time-priority", group=Topic.CYCLE, api=True,
        help="the control loop before all other programs, its memory locked, where that is allowed",
    )


RESOLVED: Final = tuple(_rows(RunOptions))
"""The options that `resolve` decides: those of `RunOptions`."""
OPTIONS: Final = (*RESOLVED, *_rows(Overrides), *_rows(RunDetails))
"""The whole table."""
OPTION: Final = MappingProxyType({one.name: one for one in OPTIONS})
ASKED_AGAIN: Final = tuple(sorted((one for one in OPTIONS if one.asked_again), key=lambda one: one.name))
"""Options that a replay, a comparison or a fleet may set otherwise than the run."""


CLOCKS: Final = ("real_time", "stepped")
"""The two clocks of a simulated rig. They exclude each other."""


def is_name(flag: str, value: str) -> bool:
    """Tell the name of a profile that ships from a file."""
    return flag == OPTION["profile"].flag and not value.endswith((".yaml", ".yml"))


def form_options(part: str) -> list[Option]:
    """The options of one part of a form."""
    return [one for one in OPTIONS if one.form is not None and part in one.form.parts]


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "-"
    return "-" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
