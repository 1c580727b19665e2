"""What is said where there can be no number."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Refusal:
    """Why there can be no number, and what to do about it; a sentence each."""

    reason: str
    advice: str
