"""What a scan finds: one drive, where it is, what it says of itself, and which profile may be its."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class FoundDrive:
    """``address``: node or unit number. ``line``: how a Modbus line was set when it answered."""

    bus: str                            # canopen, modbus
    address: int
    title: str
    identity: str
    simulated: bool
    profile: str | None = None
    why: str = ""                       # why this profile, or why none
    seen: str = ""                      # what it sent by itself
    line: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """As people call it."""
        return f"{'node' if self.bus == 'canopen' else 'unit'} {self.address}"
