"""What a scripted fault may do: change frames on their way in or out, and lay hands on the drive itself."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from sim_bus.canopen.node import Cia402Node

Frame = tuple[int, bytes | bytearray]
Frames = Iterable[Frame]


@dataclass(frozen=True)
class Scene:
    """Where a fault happens. ``put`` sends a frame past all faults, as another station on the bus would."""

    node: Cia402Node
    put: Callable[[int, bytes], None]
    rng: np.random.Generator

    def foreign(self, can_id: int, data: bytes) -> None:
        """A frame of a third party: everybody on the bus hears it, the drive among them."""
        self.put(can_id, data)
        self.node.on_frame(can_id, data)


class Misbehaviour:
    """Nothing by itself; a fault overrides what it needs. `begin` comes before anything else."""

    scene: Scene

    def begin(self) -> None:
        """It starts."""

    def end(self) -> None:
        """It is over."""

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        """What becomes of a frame that the drive sends."""
        return ((can_id, data),)

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        """What becomes of a frame that comes to the drive."""
        return ((can_id, data),)
