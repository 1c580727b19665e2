"""What may be asked of identification."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

Model = Literal["auto", "rigid", "two-mass", "string", "paper"]
MODELS: tuple[Model, ...] = get_args(Model)


@dataclass(frozen=True)
class Options:
    """``confidence`` of every interval; ``tolerance``: relative half-width of J above which a result is `valid_wide`.

    ``model``: rigid, two-mass and string take that shaft, with reporting lags; auto the simplest of these that the
    data do not contradict; paper takes the paper's method at its word (no lags), and lets it stand only where the data
    do not contradict that.
    """

    confidence: float = 0.95
    tolerance: float = 0.02
    model: Model = "auto"

    def __post_init__(self) -> None:
        if not 0.5 <= self.confidence < 1.0:
            raise ValueError(f"confidence must be in [0.5, 1): {self.confidence!r}")
        if not (math.isfinite(self.tolerance) and self.tolerance > 0.0):
            raise ValueError(f"tolerance must be a positive number: {self.tolerance!r}")
        if self.model not in MODELS:
            raise ValueError(f"model must be {', '.join(MODELS[:-1])} or {MODELS[-1]}: {self.model!r}")
