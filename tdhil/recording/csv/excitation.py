"""Reading of excitation.yaml: the motion of a machine, which a trace does not contain.

::

    kind: multisine
    mode: torque
    segments:
      - {start_s: 12.0, periods: 7, period_s: 20.0, settle_periods: 1, offset_rad_s: 2.2,
         lines_hz: [0.05, 0.1, 0.15, 0.25, 0.35, 0.5]}

Times are those of the trace, in seconds. If it has clock times, they count from its first row.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from drivers import DataFileError, Problem
from profiles import DataModel, load_with_lines, messages_of, parse_with_lines, refuse_if
from tdhil.config import DEFAULT_EXCITATION, EXCITATIONS, Registered
from tdhil.recording.recording import Excitation, FloatArray, Level, Segment

_MOST_PERIODS = 100_000
_WHOLE = 1e-3       # of a period: tolerance for a whole number of periods of a line
Hertz = Annotated[float, Field(gt=0, le=1e4)]


class SegmentFile(DataModel):
    """One stretch of excitation about one mean speed."""

    start_s: float = Field(description="s; when its first period began, in the trace's time")
    periods: int | None = Field(default=None, ge=1, le=_MOST_PERIODS, description="how many there were; or end_s")
    end_s: float | None = Field(default=None, description="s; when it ended; or periods")
    period_s: float = Field(gt=0, le=86400, description="s; length of a period")
    settle_periods: int = Field(default=1, ge=0, le=_MOST_PERIODS, description="periods at the start to be left out")
    offset_rad_s: float = Field(description="rad/s; mean speed of the motor shaft")
    lines_hz: tuple[Hertz, ...] = Field(min_length=1, max_length=200, description="Hz; the excited frequencies")
    amplitudes_rad_s: tuple[float, ...] | None = Field(default=None, description="rad/s; of each line, where known")
    phases_rad: tuple[float, ...] | None = Field(default=None, description="rad; of each line, where known")

    @property
    def whole_periods(self) -> int:
        """Number of its whole periods, from either of the two keys; 0 without one."""
        if self.periods is not None:
            return self.periods
        if self.end_s is None or not self.end_s > self.start_s:
            return 0
        return math.floor(min((self.end_s - self.start_s) / self.period_s, 2.0 * _MOST_PERIODS) + 1e-6)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        findings = []
        if (self.periods is None) == (self.end_s is None):
            findings.append(("start_s", "give either periods or end_s"))
        elif not self.settle_periods < self.whole_periods <= _MOST_PERIODS:
            key = "end_s" if self.periods is None else "periods"
            whole = self.whole_periods
            findings.append((key, f"{whole} whole periods, of which {self.settle_periods} are for settling"))
        for number, hertz in enumerate(self.lines_hz):
            cycles = hertz * self.period_s
            if round(cycles) < 1 or abs(cycles - round(cycles)) > _WHOLE:
                message = f"{hertz:g} Hz is {cycles:.6g} cycles a period, not a whole number"
                findings.append((f"lines_hz.{number}", message))
        if len({round(hertz * self.period_s) for hertz in self.lines_hz}) < len(self.lines_hz):
            findings.append(("lines_hz", "a line stands there twice"))
        for key in ("amplitudes_rad_s", "phases_rad"):
            given = getattr(self, key)
            if given is not None and len(given) != len(self.lines_hz):
                findings.append((key, f"{len(given)} numbers for {len(self.lines_hz)} lines"))
        refuse_if(findings)
        return self

    def segment(self) -> Segment:
        """Return the segment for a recording; unknown amplitudes and phases are empty."""
        return Segment(
            start_s=self.start_s,
            end_s=self.start_s + self.whole_periods * self.period_s,
            period_s=self.period_s,
            settle_periods=self.settle_periods,
            offset_rad_s=self.offset_rad_s,
            lines_hz=self.lines_hz,
            amplitudes_rad_s=self.amplitudes_rad_s or (),
            phases_rad=self.phases_rad or (),
        )


class LevelFile(DataModel):
    """Stretch of steady speed, whose mean torque is friction."""

    start_s: float = Field(description="s")
    end_s: float = Field(description="s")


class ExcitationFile(DataModel):
    """Content of excitation.yaml."""

    kind: Annotated[str, Registered(EXCITATIONS, periodic=True)] = Field(
        default=DEFAULT_EXCITATION, description="a periodic excitation: multisine, sine, step or prbs"
    )
    mode: Literal["torque", "speed"] = Field(default="torque", description="controlled quantity: torque or speed")
    segments: tuple[SegmentFile, ...] = Field(min_length=1, max_length=100, description="in the order of time")
    levels: tuple[LevelFile, ...] = Field(default=(), max_length=100, description="stretches of steady speed, if any")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        findings = []
        segments = [part.segment() for part in self.segments]
        for number in range(1, len(segments)):
            if segments[number].start_s < segments[number - 1].end_s - 1e-6:
                end = segments[number - 1].end_s
                findings.append((f"segments.{number}.start_s", f"the segment before lasts until {end:g} s"))
        findings += [
            (f"levels.{number}.end_s", "must be after start_s")
            for number, level in enumerate(self.levels) if not level.end_s > level.start_s
        ]
        refuse_if(findings)
        return self


_KEYS: Mapping[str, tuple[str | int, ...]] = {
    "motion_kind": ("kind",), "motion_mode": ("mode",), "motion_start_s": ("segments", 0, "start_s"),
    "motion_period_s": ("segments", 0, "period_s"), "motion_periods": ("segments", 0, "periods"),
    "motion_settle_periods": ("segments", 0, "settle_periods"), "motion_offset_rad_s": ("segments", 0, "offset_rad_s"),
    "motion_lines_hz": ("segments", 0, "lines_hz"),
}
"""Options of a motion about one mean speed, by name, with their places in an excitation.yaml."""
_NEEDED = ("motion_start_s", "motion_period_s", "motion_periods", "motion_offset_rad_s", "motion_lines_hz")


def motion_of(given: Mapping[str, Any]) -> tuple[dict[str, Any] | None, list[tuple[str, str]]]:
    """Return the content of an excitation.yaml from the options of a motion, and their mistakes as (option, reason).

    ``given``: values of `tdhil.config.OF_A_TRACE` by name. None if no option of a motion is given.
    """
    stated = {name: given[name] for name in _KEYS if given.get(name) is not None}
    if not stated:
        return None, []
    if given.get("excitation"):
        return None, [("excitation", "contains the whole motion: leave its other fields empty")]
    if missing := [name for name in _NEEDED if name not in stated]:
        return None, [(name, "is needed for a periodic motion") for name in missing]
    segment: dict[str, Any] = {}
    content: dict[str, Any] = {"segments": (segment,)}
    for name, value in stated.items():
        *section, key = _KEYS[name]
        (segment if section else content)[str(key)] = _hertz(value) if name == "motion_lines_hz" else value
    try:
        ExcitationFile.model_validate(content)
    except ValidationError as error:
        wrong: dict[str, str] = {}
        for path, message in messages_of(error, json.loads(json.dumps(content)), ExcitationFile):
            # the option whose place is the beginning of this path
            option = next((name for name, place in _KEYS.items() if path[: len(place)] == place), "motion_start_s")
            wrong.setdefault(option, message)
        return None, list(wrong.items())
    return content, []


def _hertz(text: str) -> tuple[float | str, ...]:
    """Return the frequencies in a text; a part that is no number stays a text, which the model refuses."""
    found: list[float | str] = []
    for part in text.replace(";", " ").replace(",", " ").split():
        try:
            found.append(float(part))
        except ValueError:
            found.append(part)
    return tuple(found)


def load_excitation(
    source: Path | Mapping[str, Any], time_s: FloatArray
) -> tuple[Excitation, tuple[Level, ...]]:
    """Return the excitation in a file, or the content of one, for a trace with these times. Raises DataFileError with
    every problem and its line.
    """
    if isinstance(source, Path):
        loaded = load_with_lines(source, ExcitationFile)
    else:
        loaded = parse_with_lines(json.dumps(source), "motion", ExcitationFile)
    parts = loaded.value.segments
    first, last = float(time_s[0]), float(time_s[-1])
    outside = [
        Problem(
            loaded.file, loaded.lines.get(("segments", number, "start_s"), 0),
            f"segment {number + 1} lasts from {segment.start_s:g} to {segment.end_s:g} s, but the trace "
            f"from {first:.6g} to {last:.6g} s",
        )
        for number, segment in enumerate(part.segment() for part in parts)
        if segment.start_s >= last or segment.end_s <= first
    ]
    if outside:
        raise DataFileError(tuple(outside))
    levels = tuple(Level(level.start_s, level.end_s) for level in loaded.value.levels)
    return Excitation(loaded.value.kind, loaded.value.mode, tuple(part.segment() for part in parts)), levels
