"""What every section of a profile carries: where it comes from, and how sure we are of it."""


from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from profiles.model import DataModel, refuse_if

# ---------------------------------------------------------------------------------------------------------------------
# What a setting of a drive must read before a shaft may turn; the same words on every bus.


class Require(DataModel):
    """What a parameter must read; in its unit."""

    equals: float | None = None
    one_of: tuple[float, ...] | None = None
    at_least: float | None = None
    at_most: float | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if all(value is None for value in (self.equals, self.one_of, self.at_least, self.at_most)):
            refuse_if([("", "say equals, one_of, at_least or at_most")])
        return self


# ---------------------------------------------------------------------------------------------------------------------

Confidence = Literal["verified", "likely", "unverified"]
"""verified: read in the manufacturer's document or file · likely: a consistent second-hand source · unverified."""

Positive = Annotated[float, Field(gt=0)]
ProfileName = Annotated[str, Field(pattern=r"^[a-z0-9_-]+/[a-z0-9._-]+$")]


class Entry(DataModel):
    """One thing that a profile claims."""

    source: str = Field(min_length=3, description="the document, file or measurement that says so")
    confidence: Confidence = Field(description="verified, likely or unverified")
