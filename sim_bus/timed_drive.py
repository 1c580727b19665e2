"""A simulated drive in plant time: inverter and CiA 402 application that advance together, and the trace of the shaft.

It owns no clock and no thread, and knows no bus: the caller states the time that has passed.
"""

from collections.abc import Callable

import numpy as np
from canopen.objectdictionary import datatypes

from profiles import MARKER_INDEX, MARKER_STAGE, MARKER_TEXT
from sim_bus.cia402 import Application
from sim_bus.inverter import Inverter
from sim_bus.objects import ObjectStore, key_of
from sim_bus.params import RigParams
from sim_bus.trace import ROW_PERIOD_US, ShaftTrace

CHUNK_US = 2_000
"""Step of plant time that no cycle of a host sets, µs."""
_RUN_OUT_US, _REST_US = 120_000_000, 1_500_000
_AT_REST_RAD_S = 0.02


def _ignore(_number: int) -> None:
    pass


class TimedDrive:
    """Inverter, application and trace, with their time."""

    def __init__(self, params: RigParams, *, seed: int, trace: ShaftTrace, stepped: bool) -> None:
        self.time_us = 0
        self.stepped = stepped
        self.trace = trace
        self.on_time: Callable[[int], None] = _ignore       # called with plant time in µs before each piece
        self.on_stage: Callable[[int], None] = _ignore      # called when the host reports the begin of a stage
        self._next_row_us = 0
        self.inverter = Inverter(params, np.random.default_rng(seed))
        self.application = Application(self.inverter)

    def advance_us(self, duration_us: int) -> None:
        """Advance the plant, in equal steps of at most the control period."""
        application, inverter = self.application, self.inverter
        begin_us = self.time_us
        self.on_time(begin_us)
        application.regulate()
        count, dt_s = inverter.steps(duration_us * 1e-6)
        step = application.step
        for number in range(1, count + 1):
            step(dt_s)
            self.time_us = now_us = begin_us + duration_us * number // count
            if now_us >= self._next_row_us:
                self._next_row_us = (now_us // ROW_PERIOD_US + 1) * ROW_PERIOD_US
                if self.trace.active:
                    self.trace.row(
                        now_us * 1e-6, inverter.state.speed_rad_s, inverter.torque_nm, application.state.value,
                    )

    def run_out(self) -> None:
        """Advance after a rehearsal, without the host. The drive's own actions then are part of the trace."""
        end_us = self.time_us + _RUN_OUT_US
        quiet_us = 0
        while quiet_us < _REST_US and self.time_us < end_us:
            self.advance_us(CHUNK_US)
            quiet_us = 0 if abs(self.inverter.speed_rad_s) > _AT_REST_RAD_S else quiet_us + CHUNK_US

    def note(self, event: str) -> None:
        """Add an event to the trace, or a change of state if ``event`` is empty."""
        self.trace.row(
            self.time_us * 1e-6, self.inverter.state.speed_rad_s, self.inverter.torque_nm,
            self.application.state.value, event or f"state: {self.application.state.value}",
        )

    def bind_marker(self, store: ObjectStore) -> None:
        """Connect the marker object: identity, stepped time, and stage of the host. Call this after other members are
        set.
        """
        store.add(MARKER_INDEX, MARKER_STAGE, datatypes.UNSIGNED8, writable=True, mappable=False, name="Stage")
        store.live[key_of(MARKER_INDEX, 2)] = lambda: int(self.stepped)
        store.hooks[key_of(MARKER_INDEX, 2)] = self.set_stepped
        store.hooks[key_of(MARKER_INDEX, MARKER_STAGE)] = self.tell_stage
        store.values[key_of(MARKER_INDEX, MARKER_STAGE)] = 0
        store.values[key_of(MARKER_INDEX, 0)] = max(store.object_dictionary[MARKER_INDEX].subindices)
        store.values[key_of(MARKER_INDEX, 1)] = MARKER_TEXT

    def tell_stage(self, number: int) -> None:
        """Take the begin of a stage from the host."""
        self.note(f"stage {number}")
        self.on_stage(number)

    def set_stepped(self, value: int) -> None:
        """Set 5FFEh:2: time advances with the cycles of the host, or by itself."""
        if bool(value) is not self.stepped:
            self.stepped = bool(value)
            self.note("stepped time" if value else "own time")
