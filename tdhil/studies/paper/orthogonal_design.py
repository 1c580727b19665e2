"""Orthogonal designs as a tool: any array, any factors of the rig by name, and the runs that follow from them."""

from __future__ import annotations

from pydantic import ValidationError, model_validator

from profiles.model import DataModel, Finding, refuse_if
from tdhil.study.design_arrays import Rows, fault_of, shipped_arrays
from tdhil.study.settings import FACTORS, SYMBOLS, LoopSettings, changed, full_name


class Factor(DataModel):
    """One thing that is varied: a field of the settings, or its symbol, and a value for each level of its column."""

    name: str
    levels: tuple[float, ...]

    @property
    def field(self) -> str:
        """The name in full."""
        return full_name(self.name)


class DesignSettings(LoopSettings):
    """A design: an array (by name, or row by row), its factors in the order of its columns, and what all runs share."""

    array: str | Rows = "L9"
    factors: tuple[Factor, ...] = ()

    @property
    def varied(self) -> frozenset[str]:
        """Fields whose value comes from the array."""
        return frozenset(factor.field for factor in self.factors)

    @property
    def rows(self) -> Rows:
        """The array, only the columns that carry a factor."""
        rows = shipped_arrays()[self.array] if isinstance(self.array, str) else self.array
        return tuple(row[: len(self.factors)] for row in rows)

    def values(self, run: int) -> dict[str, float]:
        """The factors of run ``run`` (from 0), by field name."""
        return {
            factor.field: factor.levels[level - 1] for factor, level in zip(self.factors, self.rows[run], strict=True)
        }

    def runs(self) -> list[LoopSettings]:
        """Every run in full, in array order."""
        return [changed(self, **self.values(run)) for run in range(len(self.rows))]

    @model_validator(mode="after")
    def _orthogonal(self) -> DesignSettings:
        findings: list[Finding] = []
        if isinstance(self.array, str) and self.array not in shipped_arrays():
            known = ", ".join(shipped_arrays())
            findings.append(("array", f"no array '{self.array[:40]}' here (known: {known}); write it row by row"))
        elif (fault := fault_of(rows := shipped_arrays()[self.array] if isinstance(self.array, str) else self.array)):
            findings.append(("array", fault))
        else:
            findings += _unfit(self.factors, rows)
        refuse_if(findings)
        for run in range(len(self.rows)):
            try:
                changed(self, **self.values(run))
            except ValidationError as error:
                refuse_if([("factors", f"run {run + 1}: {_first(error)}")])
        return self


def _unfit(factors: tuple[Factor, ...], rows: Rows) -> list[Finding]:
    """What is wrong with factors on this array."""
    findings: list[Finding] = []
    if not factors:
        return [("factors", "a design needs at least one factor")]
    if len(factors) > len(rows[0]):
        return [("factors", f"{len(factors)} factors for the {len(rows[0])} columns of the array")]
    for index, factor in enumerate(factors):
        needed = len({row[index] for row in rows})
        if factor.field not in FACTORS:
            short = [symbol for symbol, field in SYMBOLS.items() if field in FACTORS]
            findings.append(("factors", f"no factor '{factor.name[:40]}'; known: {', '.join((*FACTORS, *short))}"))
        if factor.field in {earlier.field for earlier in factors[:index]}:
            findings.append(("factors", f"'{factor.field}' is a factor already"))
        if len(factor.levels) != needed or len(set(factor.levels)) != needed:
            findings.append(
                ("factors", f"column {index + 1} of the array needs {needed} different levels of '{factor.name}'")
            )
    return findings


def _first(error: ValidationError) -> str:
    item = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in item["loc"])
    message = item["msg"].removeprefix("Value error, ")
    return f"{where}: {message}" if where else message
