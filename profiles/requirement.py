"""What a setting of a drive must read before a shaft may turn; the same words on every bus."""

from typing import Self

from pydantic import model_validator

from profiles.model import DataModel, refuse_if


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
