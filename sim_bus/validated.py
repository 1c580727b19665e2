"""The base of every parameter set: frozen, strict, no unknown keys, no NaN, no infinity."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]


class Validated(BaseModel):
    """A frozen parameter set; a unit stands in every field name."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
