"""Table of a run's options. Each option is declared here once; everything that takes options is made from it.

A row is a field of one of five dataclasses: `RunOptions` (also possible in rig.yaml), `Overrides` and `RunDetails`
(for one run only), `TraceOptions` (for a trace of another tool), and `EvidenceOptions` (for an archive of evidence).
The field's annotation is the option's type, its default the option's default; `option` has the rest. The command
line, the schema of rig.yaml, the keywords of `tdhil.run`, the service's API and forms, and the rows of
docs/reference/rig.md are made from this table. No large library is imported here, because ``--help`` reads it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields
from enum import Enum
from operator import ge, gt, le, lt
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import Any, Final, Literal, Protocol, Self, Union, get_args, get_origin, get_type_hints

from drivers import own_limits
from profiles.quantities import (
    FREQUENCY,
    FRICTION,
    INERTIA,
    MINUTE,
    PERCENT,
    SHARE,
    SPEED,
    TIME,
    TORQUE,
    Unit,
    excludes_zero,
    share_advice,
)
from tdhil.config.registry import BUSES, DEFAULT_BUS, DEFAULT_EXCITATION, EXCITATIONS, MODELS, RegistryEntry, names

# ---------------------------------------------------------------------------------------------------------------------
# Value of an option, and its source.


class Origin(Enum):
    """Kind of a setting's source. Decisions use it, and never the text that names the source."""

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
    """Value of one option, its source as text (``--node``, ``rig.yaml:7``, ``default``), and the kind of source."""

    value: Any
    source: str
    origin: Origin

    @staticmethod
    def by_flag(value: Any, flag: str) -> "Setting":
        return Setting(value, flag, Origin.COMMAND_LINE)

    @staticmethod
    def by_rig(value: Any, rig: _File, at: str) -> "Setting":
        """Return a setting from rig.yaml; ``at``: its key there."""
        return Setting(value, rig.source(at) or "rig", Origin.RIG_FILE)


# ---------------------------------------------------------------------------------------------------------------------
# Declaration of an option.


class Topic(Enum):
    """Sections of ``--help``, in their order."""

    MOTION = "motion"
    RESULT = "result"
    DRIVE = "drive"
    CYCLE = "control loop"
    OVERRIDES = "overrides"
    OUTPUT = "log and output"
    SIMULATED = "simulated rig"
    TRACE = "trace"
    EVIDENCE = "statement"


_LIMITS: Final = {"gt": ("greater than", gt), "ge": ("at least", ge), "lt": ("less than", lt), "le": ("at most", le)}


@dataclass(frozen=True)
class Form:
    """Field of the service's forms. ``parts``: its places among ``run``, ``acquire`` (details of stage 5 and of its
    evaluation), ``simulated``, ``real``, ``rehearsal``, ``replay``, ``upload``, ``trace``, ``motion``, ``motion-file``
    and ``evidence``.

    ``unit``: unit of a number that is entered without one. ``hint``: shown in the empty field instead of the default.
    ``ticks``: the field has a tick for each (name, label); its value is the ticked names, separated by commas.
    """

    label: str
    parts: tuple[str, ...] = ("run",)
    unit: Unit | None = None
    hint: str = ""
    wide: bool = False
    ticks: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Option:
    """One row of the table.

    Names: ``name`` in a parsed command line and in the API, ``keyword`` in Python, ``flag`` on the command line, ``at``
    in rig.yaml ('' if no file may state it). ``kind``: float, int, str, bool or tuple. ``limits``: gt, ge, lt, le or
    min_length, as pydantic names them. ``help``: one sentence; ``{default}`` in it is the default. ``more``: the
    sentences of the reference page, if those differ. ``unset``: the value that applies if nothing is given. ``python``:
    True for a keyword of `tdhil.run` or `tdhil.simulate`. ``api``: True if HTTP accepts it; a text is the reason for a
    refusal. ``asked_again``: its meaning in a replay, which may use another value; '' if it may not. ``beside_rig``: a
    relative path in rig.yaml starts in the folder of rig.yaml. ``is_file``: a path that a run reads or writes.
    ``longest``: most characters of a text over HTTP. ``common``: ``--help`` shows it; ``--help-all`` shows the rest.
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
    common: bool

    @property
    def joined(self) -> bool:
        """True for a list: the entries of the command line are added to those of rig.yaml."""
        return self.kind is tuple

    @property
    def free_text(self) -> bool:
        """True for a text that a person writes: neither a choice nor a file."""
        return self.kind is str and not self.allowed and not self.is_file

    @property
    def allowed(self) -> tuple[str, ...]:
        """Return every choice in the registry at present; empty if any value is possible."""
        return self.known or tuple(self.choices)

    @property
    def default_text(self) -> str:
        """Return the default as text; '' without one."""
        if self.default is None or self.joined:
            return self.unset
        return str(self.default).lower() if self.kind is bool else str(self.default)

    @property
    def label(self) -> str:
        """Return the name on a form or a report; '' for an option without a form."""
        return "" if self.form is None else self.form.label

    @property
    def help_text(self) -> str:
        """Sentence of ``--help``."""
        return self.help.replace("{default}", self.default_text)

    def refusal(self, value: float) -> str:
        """Return the limits, as text, that a number exceeds; '' if it is within them."""
        right = all(_LIMITS[name][1](value, limit) for name, limit in self.limits.items())
        if right:
            return ""
        said = " and ".join(
            "greater than 0" if name == "ge" and excludes_zero(limit, value) else f"{_LIMITS[name][0]} {limit:g}"
            for name, limit in self.limits.items())
        advice = share_advice(value) if self.unit == SHARE else ""
        return f"{said}. {advice}" if advice else said

    @property
    def form_hint(self) -> str:
        """Text of an empty field: the value that applies."""
        if self.form is None or self.form.hint or self.default is None or self.joined:
            return self.unset if self.form is None else self.form.hint or self.unset
        return f"as rig.yaml, else {self._form_default}"

    @property
    def form_help(self) -> str:
        """Sentence below the field of a form: a default has the unit of the field."""
        if self.form is None or self.form.unit is None or self.default is None:
            return self.help_text
        return self.help.replace("{default}", f"{self._form_default} {self.form.unit.symbol}")

    @property
    def _form_default(self) -> str:
        unit = None if self.form is None else self.form.unit
        return str(self.default) if unit is None else f"{unit.of_si(self.default):g}"


def option(
    flag: str, at: str = "", default: Any = None, *, group: Topic, help: str, more: str = "", unset: str = "",
    unit: Unit | None = None, choices: Mapping[str, RegistryEntry] | tuple[str, ...] = (), metavar: str | None = None,
    python: bool = True, api: bool | str = False, form: Form | None = None, asked_again: str = "",
    beside_rig: bool = False, is_file: bool = False, longest: int | None = None,
    common: bool = False, **limits: float,
) -> Any:
    """Declare a row of the table as the field of a dataclass. `Option` describes the arguments."""
    row = {name: value for name, value in locals().items() if name != "default"}
    return field(default=default, metadata={"row": row})


def _rows(table: type, *, by_field: bool = False) -> Iterator[Option]:
    """Yield the options that the fields of a dataclass declare. ``by_field``: each is named as its field."""
    hints = get_type_hints(table)
    for one in fields(table):
        if (row := one.metadata.get("row")) is None:
            continue
        kind, known = _kind(hints[one.name])
        name = one.name if by_field or row["at"] else row["flag"].removeprefix("--").replace("-", "_")
        default = None if kind is tuple or one.default is MISSING else one.default
        yield Option(name=name, keyword=one.name, kind=kind, known=known, default=default, **row)


def _kind(annotation: Any) -> tuple[type, tuple[str, ...]]:
    """Return the type of an option without its None, and the choices of a Literal."""
    if get_origin(annotation) in (Union, UnionType):
        (annotation,) = (one for one in get_args(annotation) if one is not NoneType)
    if get_origin(annotation) is Literal:
        return str, get_args(annotation)
    return get_origin(annotation) or annotation, ()


# ---------------------------------------------------------------------------------------------------------------------
# Rows of the table


@dataclass(frozen=True)
class RunOptions:
    """Every option of a run that a file may state, with its value; ``settings`` has the source of each.

    None as a value: the drive's profile or the plan of the run chooses it.
    """

    drive: str = option(
        "--drive", "drive", DEFAULT_BUS, group=Topic.DRIVE, common=True, choices=BUSES,
        help="bus of the drive (default: the profile's bus, else {default})",
        more="bus of the drive. If it is missing, it follows from `profile`, or from the section that gives the "
             "drive's address",
    )
    node: int | None = option(
        "--node", "node", group=Topic.DRIVE, common=True, metavar="N", ge=1, le=127, unset="the profile's",
        help="CANopen node-ID (default: {default})", more="CANopen node-ID of the drive, 1 to 127",
    )
    profile: str = option(
        "--profile", "profile", "generic/cia402", group=Topic.DRIVE, common=True, metavar="NAME", beside_rig=True,
        is_file=True,
        min_length=1,
        help="vendor/model, or a .yaml file (default: the generic profile of the bus, {default} on CANopen)",
        more="a profile that tdhil contains (`tdhil profiles`), or your own `.yaml` file; the default is the "
             "generic profile of the bus",
    )
    accept_unverified: tuple[str, ...] = option(
        "--accept-unverified", "accept_unverified", (), group=Topic.OVERRIDES, metavar="NAME", api=True,
        form=Form("Accept these unverified entries of the profile", ("real",), hint="none; or names, or likely",
                  wide=True),
        help="accept this unverified entry of the profile; 'likely' accepts all entries marked likely",
        more="unverified entries of the profile that are accepted, by name, such as `[watchdog, "
             "parameters.time_out]`; the name of a section accepts its `likely` entries, `likely` accepts all of "
             "those, and an `unverified` entry needs its own name. They add to those of the command line",
    )
    rate_hz: float | None = option(
        "--rate", "rate_hz", group=Topic.CYCLE, unit=FREQUENCY, metavar="HZ", api=True, gt=0, le=2000,
        form=Form("Control cycles per second", ("acquire",)),
        unset="what this computer sustains", help="cycles per second (default: {default}, up to the profile's)",
        more="cycles per second, up to 2000. Without it, tdhil tries the profile's rate (250 as a rule) and lower ones "
             "before motion. It takes the highest rate at which 999 of 1000 cycles begin, and are answered, at most "
             "half a period late",
    )
    excitation: str = option(
        "--excitation", "run.excitation", DEFAULT_EXCITATION, group=Topic.MOTION, common=True, choices=EXCITATIONS,
        api=True,
        form=Form("Motion"), help="motion of stage 5 (default {default})", more="motion of stage 5",
    )
    mode: Literal["torque", "speed"] | None = option(
        "--mode", "run.mode", group=Topic.MOTION, api=True, unset="torque, if the drive has a torque mode",
        form=Form("Controlled quantity", ("acquire",)), help="quantity that the drive controls in stage 5",
    )
    frequency_hz: float | None = option(
        "--frequency", "run.frequency_hz", group=Topic.MOTION, unit=FREQUENCY, metavar="HZ", api=True, unset="planned",
        form=Form("Lowest excited frequency, Hz", ("acquire",)),
        ge=1e-6, le=1e4, help="lowest excited frequency, or that of the sine",
        more="the lowest excited frequency, or that of the sine",
    )
    amplitude_rad_s: float | None = option(
        "--amplitude", "run.amplitude_rad_s", group=Topic.MOTION, common=True, unit=SPEED, metavar="RAD_S", api=True,
        unset="planned", form=Form("Amplitude of the speed", ("acquire",)), ge=1e-9, le=1e5,
        help="amplitude about the mean speed, such as 1.5 or 15rpm", more="amplitude of the speed",
    )
    offset_rad_s: float | None = option(
        "--offset", "run.offset_rad_s", group=Topic.MOTION, common=True, unit=SPEED, metavar="RAD_S", api=True,
        unset="planned", form=Form("Mean speed", ("acquire",)),
        ge=-1e5, le=1e5, help="mean speed, such as 4 or 40rpm", more="mean speed",
    )
    highest_speed_rad_s: float | None = option(
        "--highest-speed", "run.highest_speed_rad_s", group=Topic.MOTION, unit=SPEED, metavar="RAD_S", api=True,
        unset="that of the limits", form=Form("Highest speed of this run", ("acquire",)), ge=1e-6, le=1e5,
        help="highest speed of this run in each stage, such as 3 or 30rpm; at most limits.speed_max_rad_s",
        more="highest speed of the run in each stage, below that of `limits`, for a careful first motion",
    )
    periods: int | None = option(
        "--periods", "run.periods", group=Topic.MOTION, metavar="N", api=True, unset="planned", ge=1, le=10_000,
        form=Form("Periods at each mean speed", ("acquire",)), help="periods per mean speed, settling included",
        more="periods at each mean speed; the first one is for settling",
    )
    realisations: int = option(
        "--realisations", "run.realisations", 1, group=Topic.MOTION, metavar="N", api=True, ge=1, le=8,
        form=Form("Phase sets of the multisine", ("acquire",)),
        help="phase sets of the multisine at each mean speed (default {default}); 2 or more measure nonlinear "
             "distortion",
        more="phase sets of the multisine at each mean speed. With 2 or more, the frequency response measures the "
             "[nonlinear distortion](../how-to/read-the-frequency-response.md) of the excited lines themselves; each "
             "set settles anew",
    )
    tolerance: float = option(
        "--tolerance", "run.tolerance", 0.05, group=Topic.RESULT, common=True, unit=SHARE, metavar="SHARE", api=True,
        gt=0, lt=1,
        form=Form("Tolerance: half-width of the repeatability, ± % of J", ("run", "replay", "upload"), PERCENT),
        asked_again="largest half-width of the repeatability",
        help="acquire until the half-width of the repeatability is this share of J, such as 1% or 0.01",
        more="largest half-width, as a share of J (`0.01`; on the command line `1%` too). If it is given, stage 5 "
             "continues until the repeatability is this narrow. The verdict is `valid_wide` if the repeatability is "
             "wider. The torque scale does not count",
    )
    max_time_s: float | None = option(
        "--max-time", "run.max_time_s", group=Topic.MOTION, common=True, unit=TIME, metavar="TIME", api=True, ge=1e-6,
        le=1e7,
        unset="what remains of `limits.time_s`",
        form=Form("Longest duration of stage 5, minutes", unit=MINUTE, hint="by plan or limits"),
        help="longest duration of stage 5, such as 300 or 5min (default: its planned duration; with a tolerance, what "
        "remains of limits.time_s)",
        more="(on the command line `5min` too); longest duration of stage 5. Without a tolerance: its planned duration",
    )
    impedance: Literal["offset", "reference"] | None = option(
        "--impedance", "run.impedance", group=Topic.MOTION,
        help="measure the drive's own impedance in speed control, excited by its torque offset or its speed reference",
        more="measure [the drive's own impedance](../explanation/soft-torque.md#the-drives-own-impedance) in "
             "speed control, excited by its torque offset or its speed reference",
    )
    string_impedance_nm_s_rad: float | None = option(
        "--string-impedance", "run.string_impedance_nm_s_rad", group=Topic.MOTION, unit=FRICTION, metavar="NMS",
        ge=0, le=1e9, unset="that of the pipe in `load`, if any",
        help="impedance of the pipe for which the reflection is reported, N·m·s/rad at the main shaft",
        more="ζ, at the main shaft, of the string for which the reflection is reported",
    )
    model: str = option(
        "--model", "run.model", "auto", group=Topic.RESULT, choices=MODELS, api=True, asked_again="model of the shaft",
        form=Form("Model", ("acquire", "replay", "upload")),
        help="model of the shaft (default {default}: the simplest that fits)",
        more="model of the shaft",
    )
    confidence: float = option(
        "--confidence", "run.confidence", 0.95, group=Topic.RESULT, unit=SHARE, metavar="P", api=True, ge=0.5, lt=1,
        form=Form("Coverage of the interval, %", ("acquire",), PERCENT),
        asked_again="coverage of the interval", help="coverage of the interval (default {default})",
        more="coverage of the interval",
    )
    seed: int | None = option(
        "--seed", "run.seed", group=Topic.SIMULATED, metavar="N", api=True, ge=0, le=2**63 - 1,
        form=Form("Seed (the same seed repeats a run)", ("simulated",), hint="random"), unset="random, and printed",
        help="seed of a simulated run; the same seed repeats it",
    )
    simulate: bool = option(
        "--simulate", "run.simulate", False, group=Topic.SIMULATED, common=True, python=False,
        help="use the embedded simulator; the default if no bus or line of a drive is configured",
        more="use the embedded simulator, even if a bus is configured",
    )
    real_time: bool = option(
        "--real-time", "run.real_time", False, group=Topic.SIMULATED, api=True,
        form=Form("in real time, not as fast as possible", ("simulated", "rehearsal")),
        help="run the simulator in real time",
        more="run the embedded simulator in real time; excludes `stepped`",
    )
    stepped: bool = option(
        "--stepped", "run.stepped", False, group=Topic.SIMULATED, help="step a simulator in another process by SYNC",
        more="step a simulator in another process by SYNC; refused for a real drive, and for Modbus over a wire",
    )
    yes: bool = option(
        "--yes", "", False, group=Topic.OVERRIDES, common=True, python=False,
        help="skip the prompt before motion; the limits stay",
        api="the operator types a confirmation for each run; no option replaces it",
    )
    json: bool = option(
        "--json", "run.json", False, group=Topic.OUTPUT, common=True, python=False,
        help="print one JSON document on stdout", more="print one JSON document on stdout, and nothing else",
    )
    log: str = option(
        "--log", "run.log", "run.mcap", group=Topic.OUTPUT, common=True, metavar="run.mcap", is_file=True, min_length=1,
        help="path of the log; an older log there is moved aside",
        more="path of the log; an older log there is moved aside. If another run is writing it, this run uses another "
             "name. The log of a run that ended before motion goes to `run.refused.mcap`, beside the last good log",
    )
    plant: str | None = option(
        "--plant", "run.plant", group=Topic.SIMULATED, metavar="plant.yaml", beside_rig=True, is_file=True,
        min_length=1, help="parameters of the simulated rig",
        more="[parameters](../../examples/plant.yaml) of the simulated rig",
    )
    simulated_torque_scale: float | None = option(
        "--simulated-torque-scale", "run.simulated_torque_scale", group=Topic.SIMULATED, unit=SHARE,
        metavar="RATIO", api=True,
        ge=0.1, le=10.0, unset="the plant's", form=Form("Torque scale of the drive", ("simulated",), hint="exact"),
        help="ratio of the simulated drive's torque to the true torque, such as 1.05; unknown to the identification",
        more="ratio of the embedded drive's torque to the true torque (`1.05`: the drive reports 5 % too much). It "
             "replaces `reporting.torque_scale` of the plant, and is unknown to the identification",
    )
    simulated_speed_scale: float | None = option(
        "--simulated-speed-scale", "run.simulated_speed_scale", group=Topic.SIMULATED, unit=SHARE,
        metavar="RATIO", api=True,
        ge=0.1, le=10.0, unset="the plant's", form=Form("Speed scale of the drive", ("simulated",), hint="exact"),
        help="ratio of the simulated drive's speed to the true speed, such as 1.01; its position counts true turns",
        more="ratio of the embedded drive's speed to the true speed. It replaces `reporting.speed_scale` of the "
             "plant. The position counts true turns",
    )
    simulated_added_inertia_kg_m2: float | None = option(
        "--simulated-added-inertia", "run.simulated_added_inertia_kg_m2", group=Topic.SIMULATED,
        unit=INERTIA, metavar="J", api=True, ge=0.0, le=1e9, unset="the plant's",
        form=Form("Body bolted on, kg·m²", ("simulated",), hint="none"),
        help="body of known inertia on the simulated motor shaft, such as 55 (kg·m²)",
        more="body of known inertia on the motor shaft of the simulated rig. It replaces `plant.added_inertia_kg_m2` "
             "of the plant",
    )
    letterhead: str | None = option(
        "--letterhead", "letterhead", group=Topic.OUTPUT, metavar="letterhead.yaml", beside_rig=True, is_file=True,
        min_length=1, python=False, help="company, address and logo for the report",
        more="a file with `company`, `address` (lines) and `logo` (a PNG beside it) for the head of the report; "
             "`tdhil serve` has its own, which an admin sets",
    )
    trace: str | None = option(
        "--trace", "run.trace", group=Topic.SIMULATED, metavar="shaft.csv", is_file=True, min_length=1,
        help="CSV of the true motion of the simulated rig", more="CSV of the true motion of the simulated rig",
    )
    settings: Mapping[str, Setting] = field(default_factory=dict)

    @staticmethod
    def of(settings: Mapping[str, Setting]) -> "RunOptions":
        values = {name: setting.value for name, setting in settings.items()}
        return RunOptions(**values, settings=MappingProxyType(dict(settings)))

    def source(self, name: str) -> str:
        """Return the source of an option's value, as text."""
        return self.settings[name].source

    def given(self, name: str) -> bool:
        """Return whether the option is given; False for the built-in default."""
        return self.settings[name].origin is not Origin.BUILT_IN

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Yield (option, value, source) for printing; '-' if the profile or the plan will choose."""
        for name, setting in self.settings.items():
            yield name, _shown(setting.value), setting.source

    def files(self) -> dict[str, Path]:
        """Return the files that the options name, by their flags."""
        named = {one.flag: getattr(self, one.name) for one in RESOLVED if one.is_file}
        return {flag: Path(name) for flag, name in named.items() if name is not None and not is_name(flag, name)}

    def replaced(self, **settings: Setting) -> "RunOptions":
        """Return the same options with other settings of these names."""
        return RunOptions.of({**self.settings, **settings})


class _Said:
    """Options of one run that a file cannot state."""

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Build it from values by the names of the options; None means not given."""
        given = {one.keyword: values.get(one.name) for one in _rows(cls)}
        return cls(**{name: tuple(value) if isinstance(value, list) else value
                      for name, value in given.items() if value is not None})


@dataclass(frozen=True)
class Overrides(_Said):
    """Overrides by the operator, by name, for one run: rig.yaml cannot state them."""

    no_watchdog: bool = option(
        "--accept-no-watchdog", group=Topic.OVERRIDES, default=False,
        api="only the operator at the shaft could stop it: never accepted over HTTP",
        help="accept a drive whose watchdog can't be armed: it won't stop by itself if this host fails",
    )
    shared_watchdog: bool = option(
        "--accept-shared-watchdog", group=Topic.OVERRIDES, default=False,
        api="other clients may keep feeding the watchdog, and only the operator at the shaft could stop it: never"
            " accepted over HTTP",
        help="Modbus: accept a drive whose watchdog is also fed by other clients: it won't stop by itself if this host "
             "fails while one of them continues to send requests",
    )
    wider_limits: tuple[str, ...] = option(
        "--accept-wider-limit", group=Topic.OVERRIDES, default=(), choices=own_limits.NAMES, api=True,
        help="let the run widen this limit in the drive; otherwise a tighter limit of the drive stays",
    )
    speed_unit: bool = option(
        "--accept-speed-unit", group=Topic.OVERRIDES, default=False, api=True,
        form=Form("accept the profile's unit of speed without a check", ("real",)),
        help="accept the profile's unit of speed without checking that the shaft turns at the reported speed",
    )
    reset_fault: bool = option(
        "--reset-fault", group=Topic.OVERRIDES, default=False, api=True,
        form=Form("reset a drive that is in fault", ("real",)),
        help="reset a drive that is in fault; never done without this option",
    )


@dataclass(frozen=True)
class RunDetails(_Said):
    """Details of one run: notes for its log, faults to rehearse, priority of its control loop."""

    operator: str | None = option(
        "--operator", group=Topic.OUTPUT, metavar="NAME", api=True, longest=500,
        form=Form("Operator", ("run", "upload")),
        help="name of the operator, for log and report",
    )
    note: str | None = option(
        "--note", group=Topic.OUTPUT, metavar="TEXT", api=True, longest=500,
        form=Form("Note", ("run", "upload"), wide=True),
        help="remark on this run, for log and report",
    )
    customer: str | None = option(
        "--customer", group=Topic.OUTPUT, metavar="NAME", api=True, longest=200,
        form=Form("Customer", ("run", "upload")),
        help="customer, for log and report",
    )
    order_number: str | None = option(
        "--order-number", group=Topic.OUTPUT, metavar="TEXT", api=True, longest=100,
        form=Form("Order number", ("run", "upload")),
        help="number of the customer's order, for log and report",
    )
    place: str | None = option(
        "--place", group=Topic.OUTPUT, metavar="TEXT", api=True, longest=200,
        form=Form("Place", ("run", "upload")),
        help="place of the run, for log and report",
    )
    faults: tuple[str, ...] = option(
        "--fault", group=Topic.SIMULATED, default=(), metavar="FAULT", api=True,
        form=Form("Rehearse a fault", ("simulated",), hint="none, or such as sto@hold+2s"),
        help="rehearse a fault of the simulated drive, such as sto@hold+2s; 'list' prints all of them",
    )
    expect: tuple[str, ...] = option(
        "--expect", group=Topic.RESULT, default=(), metavar="NAME=VALUE±TOL", api=True,
        form=Form("Expected values of an acceptance", ("run",), wide=True,
                  hint="such as inertia=104 kg·m² ± 5 %, speed-lag=400 ms ± 50 ms"),
        help="accept the result only if it agrees with this value, such as 'inertia=104±5%'; names as in `acceptance:` "
             "of rig.yaml",
    )
    real_time_priority: bool | None = option(
        "--real-time-priority", group=Topic.CYCLE, api=True,
        help="real-time priority for the control loop, and locked memory, if the system allows it",
    )

    def texts(self) -> dict[str, str | None]:
        """Return what a person stated of the run, by the names of `STATED`."""
        return {name: getattr(self, name) for name in STATED}


@dataclass(frozen=True)
class TraceOptions(_Said):
    """Options for reading a trace of another tool in CSV. A log of tdhil contains all of this.

    They are no options of a run, so `OPTIONS` does not have them.
    """

    columns: tuple[str, ...] = option(
        "--columns", group=Topic.TRACE, default=(), metavar="QUANTITY=NAME:UNIT", api=True,
        unset="time_s speed_rad_s torque_nm",
        help="columns of the trace, such as time=t_s speed=n_rpm:rpm torque=m_pct:%; default: {default}",
    )
    excitation: str | None = option(
        "--excitation", group=Topic.TRACE, metavar="excitation.yaml", is_file=True, api=True, longest=20_000,
        form=Form("Several mean speeds: the content of an excitation.yaml, in place of the fields of the motion",
                  ("motion-file",), hint="one mean speed", wide=True),
        help="the periodic motion that was run: period, lines, mean speeds, start times",
    )
    motion_kind: str | None = option(
        "--motion-kind", group=Topic.TRACE, choices=tuple(names(EXCITATIONS, periodic=True)), api=True,
        unset=DEFAULT_EXCITATION, form=Form("Periodic motion", ("motion",), hint="unknown, or none"),
        help="periodic motion about one mean speed (default: {default}, if another of its options is given)",
    )
    motion_mode: Literal["torque", "speed"] | None = option(
        "--motion-mode", group=Topic.TRACE, api=True, unset="torque", form=Form("Controlled quantity", ("motion",)),
        help="quantity that the drive controlled during the motion (default {default})",
    )
    motion_start_s: float | None = option(
        "--motion-start", group=Topic.TRACE, unit=TIME, metavar="S", gt=-1e9, lt=1e9, api=True,
        form=Form("Start of the first period, s in the trace", ("motion",), hint="needed"),
        help="start of the first period, in the trace's time",
    )
    motion_period_s: float | None = option(
        "--motion-period", group=Topic.TRACE, unit=TIME, metavar="S", gt=0, le=86400, api=True,
        form=Form("Length of a period, s", ("motion",), hint="needed"), help="length of a period",
    )
    motion_periods: int | None = option(
        "--motion-periods", group=Topic.TRACE, metavar="N", ge=1, le=100_000, api=True,
        form=Form("Number of periods", ("motion",), hint="needed"), help="number of periods",
    )
    motion_settle_periods: int | None = option(
        "--motion-settle-periods", group=Topic.TRACE, metavar="N", ge=0, le=100_000, api=True, unset="1",
        form=Form("Periods at the start to leave out", ("motion",), hint="1"),
        help="periods at the start to leave out (default {default})",
    )
    motion_offset_rad_s: float | None = option(
        "--motion-offset", group=Topic.TRACE, unit=SPEED, metavar="RAD_S", gt=-1e5, lt=1e5, api=True,
        form=Form("Mean speed of the motor shaft, rad/s", ("motion",), hint="needed"),
        help="mean speed of the motor shaft during the motion",
    )
    motion_lines_hz: str | None = option(
        "--motion-lines", group=Topic.TRACE, metavar="HZ,HZ,…", api=True, longest=900,
        form=Form("Excited frequencies, Hz, separated by commas", ("motion",), hint="needed, such as 0.1, 0.2, 0.4",
                  wide=True),
        help="excited frequencies, separated by commas, such as 0.1,0.2,0.4",
    )
    rated_torque_nm: float | None = option(
        "--rated-torque", group=Topic.TRACE, unit=TORQUE, metavar="NM", gt=0, lt=1e9, api=True,
        form=Form("Torque at 100 %, N·m (rated or reference torque)", ("trace",), hint="for a torque in % or ‰"),
        help="torque that is 100 %, N·m, for torque in % or ‰",
    )
    torque_limit_nm: float | None = option(
        "--torque-limit", group=Topic.TRACE, unit=TORQUE, metavar="NM", gt=0, lt=1e9, api=True,
        form=Form("Torque limit of the drive, N·m", ("trace",), hint="unknown"),
        help="the drive's torque limit, N·m: a trace that is clipped there is refused",
    )
    gear_ratio: float | None = option(
        "--gear", group=Topic.TRACE, metavar="RATIO", ge=1e-6, lt=1e6, api=True, unset="1",
        form=Form("Gear ratio, ω_motor/ω_main", ("trace",), hint="1"),
        help="gear ratio, ω_motor/ω_main (default {default})",
    )
    torque_scale_rel_sd: float | None = option(
        "--torque-scale-sd", group=Topic.TRACE, unit=SHARE, metavar="SHARE", ge=0, lt=1, api=True, unset="0.03",
        form=Form("Standard uncertainty of the torque scale, %", ("trace",), PERCENT, hint="3"),
        help="relative standard uncertainty of the torque scale (default {default})",
    )
    speed_lag_s: float | None = option(
        "--speed-lag", group=Topic.TRACE, unit=TIME, metavar="S", ge=0, lt=60, api=True,
        form=Form("Filter on the reported speed, s", ("trace",), hint="unknown"),
        help="time constant of the filter on the reported speed, such as 0.4 or 400ms",
    )
    speed_lag_sd_s: float | None = option(
        "--speed-lag-sd", group=Topic.TRACE, unit=TIME, metavar="S", ge=0, lt=1e6, api=True, unset="a tenth of it",
        form=Form("Its standard uncertainty, s", ("trace",), hint="a tenth of it"),
        help="its standard uncertainty (default {default})",
    )
    torque_lag_s: float | None = option(
        "--torque-lag", group=Topic.TRACE, unit=TIME, metavar="S", ge=0, lt=60, api=True,
        form=Form("Filter on the reported torque, s", ("trace",), hint="unknown"),
        help="time constant of the filter on the reported torque, such as 0.15 or 150ms",
    )
    torque_lag_sd_s: float | None = option(
        "--torque-lag-sd", group=Topic.TRACE, unit=TIME, metavar="S", ge=0, lt=1e6, api=True, unset="a tenth of it",
        form=Form("Its standard uncertainty, s", ("trace",), hint="a tenth of it"),
        help="its standard uncertainty (default {default})",
    )
    skew_sd_s: float | None = option(
        "--skew-sd", group=Topic.TRACE, unit=TIME, metavar="S", ge=0, lt=1e6, api=True, unset="a sample, or 10 ms",
        form=Form("Standard uncertainty of the time offset between speed and torque, s", ("trace",),
                  hint="a sample, or 0.01"),
        help="standard uncertainty of the time offset between speed and torque (default {default})",
    )


PUBLISHABLE: Final = (
    ("log", "the log"), ("result", "the result"), ("identity", "make and type of the drive"),
    ("rig", "the name of the rig"),
)
"""Parts of an archive of evidence that a publisher may permit to publish, and their labels in a form."""


@dataclass(frozen=True)
class EvidenceOptions(_Said):
    """Statement of the publisher for an archive of evidence (`tdhil evidence`). The recorded log contains the rest.

    They are no options of a run, so `OPTIONS` does not have them.
    """

    publisher: str | None = option(
        "--publisher", group=Topic.EVIDENCE, metavar="NAME", api=True, longest=200,
        form=Form("Publisher: who permits this", ("evidence",), hint="a person or an organisation"),
        help="person or organisation that permits publication; the archive shows this name",
    )
    publish: str | None = option(
        "--publish", group=Topic.EVIDENCE, metavar="PARTS", api=True, longest=60,
        form=Form("Parts that may be published", ("evidence",), ticks=PUBLISHABLE),
        help="parts that may be published: log, result, identity, rig (the rig's name), separated by commas, or all",
    )
    reference_inertia_kg_m2: float | None = option(
        "--reference-inertia", group=Topic.EVIDENCE, unit=INERTIA, metavar="J", gt=0, lt=1e9, api=True,
        form=Form("Reference inertia at the motor shaft, kg·m²", ("evidence",), hint="none"),
        help="reference inertia at the motor shaft, from another source than this run, kg·m²",
    )
    reference_sd_kg_m2: float | None = option(
        "--reference-uncertainty", group=Topic.EVIDENCE, unit=INERTIA, metavar="U", ge=0, lt=1e9, api=True,
        form=Form("Its standard uncertainty, kg·m²", ("evidence",)),
        help="standard uncertainty of the reference inertia, kg·m²",
    )
    reference_method: Literal["weighed", "drawing", "manufacturer", "other"] | None = option(
        "--reference-method", group=Topic.EVIDENCE, api=True, unset="not stated",
        form=Form("How it is known", ("evidence",)),
        help="how the reference inertia is known",
    )
    reference_note: str | None = option(
        "--reference-note", group=Topic.EVIDENCE, metavar="TEXT", api=True, longest=500,
        form=Form("How, in words", ("evidence",), wide=True, hint="masses and radii, drawing number, test report"),
        help="how the reference inertia is known, in words, such as masses and radii, or a drawing",
    )
    firmware: str | None = option(
        "--firmware", group=Topic.EVIDENCE, metavar="TEXT", api=True, longest=100,
        form=Form("Firmware version, as the drive's panel shows it", ("evidence",)),
        help="firmware version of the drive, as its panel or tool shows it (default: as the drive reports it)",
    )
    remove: tuple[str, ...] = option(
        "--remove", group=Topic.EVIDENCE, default=(), metavar="WORD", api=True, longest=200,
        form=Form("Further words to remove", ("evidence",), hint="names of a site or a customer"),
        help="further word to remove from every text, such as the name of a site; may be repeated",
    )
    simulated: bool = option(
        "--simulated", group=Topic.EVIDENCE, default=False, api=True,
        help="mark the archive as that of the simulated drive; without this option such a run is refused",
    )


RESOLVED: Final = tuple(_rows(RunOptions))
"""The options that `resolve` decides: those of `RunOptions`."""
OPTIONS: Final = (*RESOLVED, *_rows(Overrides), *_rows(RunDetails))
"""All rows of the table that are options of a run."""
OF_A_TRACE: Final = tuple(_rows(TraceOptions, by_field=True))
"""Options for reading a trace of another tool."""
OF_EVIDENCE: Final = tuple(_rows(EvidenceOptions, by_field=True))
"""Options of the statement in an archive of evidence."""
OPTION: Final = MappingProxyType({one.name: one for one in OPTIONS})
STATED: Final = tuple(one.name for one in _rows(RunDetails) if one.kind is str)
"""Names of the texts that a person states of a run, for log and report. They may be edited later."""
OF_THE_HEAD: Final = tuple(OPTION[name] for name in STATED if name not in ("operator", "note"))
"""Texts in the head of every report: they identify it for its customer."""
ASKED_AGAIN: Final = tuple(sorted((one for one in OPTIONS if one.asked_again), key=lambda one: one.name))
"""Options that a replay, a comparison or a fleet may set differently from the run."""


CLOCKS: Final = ("real_time", "stepped")
"""The two clocks of a simulated rig. They exclude each other."""


def is_name(flag: str, value: str) -> bool:
    """Return whether ``value`` is the name of a profile in tdhil, not a file."""
    return flag == OPTION["profile"].flag and not value.endswith((".yaml", ".yml"))


def form_options(part: str) -> list[Option]:
    """Return the options of one part of a form."""
    return [one for one in (*OPTIONS, *OF_A_TRACE, *OF_EVIDENCE) if one.form is not None and part in one.form.parts]


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "-"
    return "-" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
