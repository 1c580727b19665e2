"""What a scripted fault of a Modbus drive may do: come between request and reply, and lay hands on the drive itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sim_bus.modbus.reply import Reply

if TYPE_CHECKING:
    import numpy as np

    from profiles.modbus import ModbusProfile
    from sim_bus.modbus.machine import Machine

Ask = Callable[[bytes], Reply]
"""A request PDU → what comes back for it."""


@dataclass(frozen=True)
class Scene:
    """Where a fault happens."""

    machine: Machine
    profile: ModbusProfile
    rng: np.random.Generator


class Misbehaviour:
    """Nothing by itself; a fault overrides what it needs. `begin` comes before anything else."""

    scene: Scene

    def begin(self) -> None:
        """It starts."""

    def end(self) -> None:
        """It is over."""

    def asked(self, pdu: bytes, ask: Ask) -> Reply:
        """A request comes; ``ask`` is what would happen to it without this fault."""
        return ask(pdu)
