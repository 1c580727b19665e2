"""The base of every model that is read from a data file, and how a check across several keys names its line."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import BaseModel, ConfigDict
from pydantic_core import PydanticCustomError

CROSS_FIELD = "cross_field"


class DataModel(BaseModel):
    """Frozen; unknown keys refused; no conversion between text, numbers and truth values; no NaN, no infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=False, hide_input_in_errors=True
    )

    never_here: ClassVar[Mapping[str, str]] = {}
    """Keys that no file of this kind takes, and what is said of each instead of 'unknown key'."""


Finding = tuple[str, str]
"""(dotted path of the key below the model that checks, message)."""


def refuse_if(findings: Sequence[Finding]) -> None:
    """To be called in a model validator (mode 'after'): refuses with all of ``findings``, each at its key's line."""
    if findings:
        text = "; ".join(f"{at}: {message}" if at else message for at, message in findings)
        # Braces would be taken for place-holders of the template.
        raise PydanticCustomError(CROSS_FIELD, "{text}", {"text": text, "findings": list(findings)})
