"""The base of every model that is read from a data file, and how a check across several keys names its line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError, PydanticKnownError

# ---------------------------------------------------------------------------------------------------------------------
# The base of every parameter set: frozen, strict, no unknown keys, no NaN, no infinity.


Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]


class Validated(BaseModel):
    """A frozen parameter set; field names include the unit."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


# ---------------------------------------------------------------------------------------------------------------------

CROSS_FIELD = "cross_field"

Finding = tuple[str, str]
"""(dotted path of the key, relative to the model that checks; message)."""


class DataModel(BaseModel):
    """Base of all models of data files: frozen, no unknown keys, no NaN, no infinity. Text, numbers and truth values
    are not converted into each other.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=False, hide_input_in_errors=True
    )

    never_here: ClassVar[Mapping[str, str]] = {}
    """Keys that no file of this kind accepts, with the message for each instead of 'unknown key'."""

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Return errors that involve several keys.

        ``values`` holds the fields that are valid by themselves, by name, defaults included; sections are mappings
        likewise. Missing and invalid fields are not in it, so that each check runs as far as possible.
        """
        return []

    @model_validator(mode="after")
    def _without_contradictions(self) -> Self:
        refuse_if(self.contradictions(values_of(self)))
        return self


def refuse_if(findings: Sequence[Finding]) -> None:
    """Refuse with all of ``findings``, each at its key's line. For use in a model validator (mode 'after')."""
    if findings:
        text = "; ".join(f"{at}: {message}" if at else message for at, message in findings)
        # Braces in the text would count as placeholders of the template.
        raise PydanticCustomError(CROSS_FIELD, "{text}", {"text": text, "findings": list(findings)})


def one_of(known: Sequence[str], value: Any) -> Any:
    """Return ``value`` in a validator. If it is not one of ``known``, refuse it with their list, as for a Literal."""
    if value in known:
        return value
    *first, last = map(repr, known)
    raise PydanticKnownError("literal_error", {"expected": f"{', '.join(first)} or {last}" if first else last})


def values_of(model: DataModel) -> dict[str, Any]:
    """Return every value by its field's name; sections are mappings likewise."""
    found = {name: getattr(model, name) for name in type(model).model_fields}
    return {name: values_of(value) if isinstance(value, DataModel) else value for name, value in found.items()}
