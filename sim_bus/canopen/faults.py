"""Scripted misbehaviour of one simulated drive: what is due begins and ends, and frames pass through what is going on.

All of it in plant time: in stepped time a script repeats to the last frame. In stepped time a SYNC that is lost on its
way to the drive lets time go on all the same, and the host is told where each cycle ends
(`profiles.simulator_marker.CYCLE_ID`), from the first one on: also what a fault makes the drive say behind its feedback
is then in its cycle.
"""

from collections.abc import Callable

import numpy as np

from profiles.simulator_marker import CYCLE_ID, CYCLE_OVER, CYCLES_END, LAST_CYCLE_OVER
from sim_bus.canopen.node import SYNC, Cia402Node
from sim_bus.canopen.sender import Sender
from sim_bus.fault_catalogue import make
from sim_bus.fault_hooks import Frame, Misbehaviour, Scene
from sim_bus.fault_script import Cast, Scripted

_SEED = 0xFA17


class Faults:
    """The script of one drive. `attach` makes it act; frames then come in by `came`."""

    def __init__(self, script: tuple[Scripted, ...], seed: int = 0) -> None:
        self._cast: Cast[Misbehaviour] = Cast(script, make)
        self._rng = np.random.default_rng((seed, _SEED))
        self._ends_cycles = False          # and the host knows

    def attach(self, node: Cia402Node, sender: Sender) -> None:
        """From now on they happen to this node."""
        self._node = node
        self._put: Callable[[int, bytes], None] = sender.put
        scene = Scene(node, sender.put, self._rng)
        for fault in self._cast.all:
            fault.scene = scene
        sender.script = self._outgoing
        node.on_time = self.moved
        node.on_stage = self._on_stage

    @property
    def waiting(self) -> tuple[str, ...]:
        """Faults whose moment hasn't come, as they were written."""
        return self._cast.waiting

    def moved(self, now_us: int) -> None:
        """Plant time has come so far."""
        self._cast.moved(now_us, self._node.note)

    def came(self, can_id: int, data: bytes | bytearray) -> None:
        """A frame from the bus, on its way to the node."""
        node = self._node
        if can_id == SYNC and node.stepped and not self._ends_cycles and self._more:
            self._ends_cycles = True
            self._put(CYCLE_ID, CYCLES_END)
        frames: list[Frame] = [(can_id, data)]
        for fault in tuple(self._cast.active):
            frames = [after for before in frames for after in fault.incoming(*before)]
        for frame in frames:
            node.on_frame(*frame)
        if can_id != SYNC or not node.stepped:
            return
        if not any(one == SYNC for one, _ in frames):
            node.pass_cycle()
        if self._ends_cycles:
            self._ends_cycles = self._more
            self._put(CYCLE_ID, CYCLE_OVER if self._more else LAST_CYCLE_OVER)

    @property
    def _more(self) -> bool:
        """Something goes on, or is still to come."""
        return bool(self._cast.active or self._cast.waiting)

    def _on_stage(self, number: int) -> None:
        self._cast.stage(number, self._node.time_us)
        self.moved(self._node.time_us)

    def _outgoing(self, can_id: int, data: bytes) -> list[Frame]:
        frames: list[Frame] = [(can_id, data)]
        for fault in tuple(self._cast.active):
            frames = [after for one, body in frames for after in fault.outgoing(one, bytes(body))]
        return frames
