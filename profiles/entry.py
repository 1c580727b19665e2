"""What every section of a profile carries: where it comes from, and how sure we are of it."""

from typing import Annotated, Literal

from pydantic import Field

from profiles.model import DataModel

Confidence = Literal["verified", "likely", "unverified"]
"""verified: read in the manufacturer's document or file · likely: a consistent second-hand source · unverified."""

Positive = Annotated[float, Field(gt=0)]
ProfileName = Annotated[str, Field(pattern=r"^[a-z0-9_-]+/[a-z0-9._-]+$")]


class Entry(DataModel):
    """One thing that a profile claims."""

    source: str = Field(min_length=3, description="the document, file or measurement that says so")
    confidence: Confidence = Field(description="verified, likely or unverified")
