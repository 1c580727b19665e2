"""EtherCAT face of the simulated drive: state machine of the slave, objects, process data, and plant time.

One thread calls `Cia402Slave.answer` and `Cia402Slave.advance_us`; nothing here waits or reads a clock. In stepped time
a frame that brings outputs 1. gets the reported values as its inputs, 2. lets its outputs act, and then 3. the plant
moves on by exactly 5FFEh:3 (µs), in equal steps of at most the control period.
"""

from collections.abc import Callable
from enum import IntEnum

import numpy as np
from canopen.objectdictionary import datatypes
from canopen.sdo import SdoAbortedError

from profiles import MARKER_INDEX, MARKER_STAGE, MARKER_TEXT
from sim_bus.canopen.application_objects import ApplicationObjects
from sim_bus.canopen.node import generic_eds
from sim_bus.canopen.objects import ABORT_LENGTH, ObjectStore, key_of
from sim_bus.cia402 import Application
from sim_bus.ethercat import esc as esc_registers
from sim_bus.ethercat.coe import CoeServer
from sim_bus.ethercat.esc import Esc
from sim_bus.ethercat.process_data import ProcessData
from sim_bus.ethercat.sii import Area, eeprom
from sim_bus.inverter import Inverter
from sim_bus.params import RigParams
from sim_bus.trace import ROW_PERIOD_US, ShaftTrace

MAILBOX = 128
"""Bytes of each mailbox."""

_OUTPUTS_AT, _INPUTS_AT = 0x1200, 0x1400
_CAN_ONLY = (0x1005, 0x1006, 0x1014, 0x1016, 0x1017, 0x1029, 0x1200,
             *(base + number for base in (0x1400, 0x1600, 0x1800, 0x1A00) for number in range(4)))
_SCRATCH = key_of(MARKER_INDEX, 5)
_SCRATCH_SIZE = 512
_HOST_LOST, _COMMUNICATION, _GENERIC = 0x8130, 0x10, 0x01
_CHUNK_US = 2_000


class AlState(IntEnum):
    """States of the slave, as 0120h and 0130h have them."""

    INIT, PRE_OPERATIONAL, BOOT, SAFE_OPERATIONAL, OPERATIONAL = 1, 2, 3, 4, 8


_NEXT = {AlState.INIT: AlState.PRE_OPERATIONAL, AlState.PRE_OPERATIONAL: AlState.SAFE_OPERATIONAL,
         AlState.SAFE_OPERATIONAL: AlState.OPERATIONAL}
_INVALID_CHANGE, _UNKNOWN_STATE, _NO_BOOT, _MAILBOX_WRONG = 0x0011, 0x0012, 0x0013, 0x0016
_WATCHDOG, _OUTPUTS_WRONG, _INPUTS_WRONG = 0x001B, 0x001D, 0x001E
_ERROR = 0x10


class SlaveObjects(ObjectStore):
    """The objects, with a text of any length to write and read back."""

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        if key_of(index, subindex) != _SCRATCH:
            super().set_data(index, subindex, data, check_writable)
        elif len(data) > _SCRATCH_SIZE:
            raise SdoAbortedError(ABORT_LENGTH)
        else:
            self.values[_SCRATCH] = data.decode("ascii", "replace")


def _ignore(_number: int) -> None:
    pass


class Cia402Slave:
    """A CiA 402 drive on EtherCAT over a simulated inverter."""

    def __init__(self, params: RigParams, *, seed: int, trace: ShaftTrace, stepped: bool, alias: int = 0) -> None:
        self.time_us = 0
        self.stepped = stepped
        self.state = AlState.INIT
        self.cycles = 0
        self.trace = trace
        self.on_time: Callable[[int], None] = _ignore
        self.on_stage: Callable[[int], None] = _ignore
        self._next_row_us = self._period_us = 0
        self._now_s: float | None = None
        self._moves = self._op_requested = False
        self.inverter = Inverter(params, np.random.default_rng(seed))
        self.application = Application(self.inverter)
        self.store = SlaveObjects(1, generic_eds())
        for index in _CAN_ONLY:
            self.store.remove(index)
        self.setters = ApplicationObjects(self.store, self.application).setters
        self.error_code = self.error_register = 0
        self._bind()
        in_preop = lambda: self.state is AlState.PRE_OPERATIONAL  # noqa: E731
        self.received = ProcessData(self.store, outputs=True, writable=in_preop)
        self.sent = ProcessData(self.store, outputs=False, writable=in_preop)
        self.store.restore()
        areas = (Area(0x1000, MAILBOX, 0x26, 1), Area(0x1000 + MAILBOX, MAILBOX, 0x22, 2),
                 Area(_OUTPUTS_AT, self.received.size, 0x64, 3), Area(_INPUTS_AT, self.sent.size, 0x20, 4))
        identity = [int(self.store.number(key_of(0x1018, sub))) for sub in (1, 2, 3, 4)]
        pdos = [*self.received.delivered(), *self.sent.delivered()]
        self.esc = Esc(self, eeprom((identity[0], identity[1], identity[2], identity[3]), alias,
                                    str(self.store.values[key_of(0x1008)]), areas, pdos))
        self.coe = CoeServer(self.store, self.esc.post, MAILBOX)
        self.application.on_event = self.note
        self.application.on_fault_reset = self._errors_reset
        self.note("power on")

    # -- frames and time ---------------------------------------------------------------------------------

    def answer(self, frame: bytes, now_s: float) -> bytes:
        """Return the frame as it comes back from the slave at ``now_s`` of the caller's clock."""
        self.follow(now_s)
        answered = self.esc.answer(frame)
        if self._moves:
            self._moves = False
            self.pass_cycle()
        return answered

    def follow(self, now_s: float) -> None:
        """In its own time, the plant catches up with the caller's clock, in whole chunks."""
        before_s, self._now_s = self._now_s, now_s
        if self.stepped or before_s is None:
            return
        behind = int((now_s - before_s) * 1e6) // _CHUNK_US
        self._now_s = before_s + behind * _CHUNK_US * 1e-6
        for _ in range(behind):
            self.advance_us(_CHUNK_US)

    def pass_cycle(self) -> None:
        """In stepped time it is one period later."""
        self.cycles += 1
        if self.stepped and self._period_us:
            self.advance_us(self._period_us)

    def advance_us(self, duration_us: int) -> None:
        """The plant, and all that is timed, moves on."""
        application, inverter = self.application, self.inverter
        self.on_time(self.time_us)
        application.regulate()
        count, dt_s = inverter.steps(duration_us * 1e-6)
        begin_us = self.time_us
        for number in range(1, count + 1):
            application.step(dt_s)
            self.time_us = begin_us + duration_us * number // count
            if self.time_us >= self._next_row_us:
                self._next_row_us = (self.time_us // ROW_PERIOD_US + 1) * ROW_PERIOD_US
                self.note_row("")
        self.esc.clock_ns += 1000 * duration_us
        self.esc.pass_time(duration_us * 1e-6)

    def note_row(self, event: str) -> None:
        self.trace.row(self.time_us * 1e-6, self.inverter.state.speed_rad_s, self.inverter.torque_nm,
                       self.application.state.value, event)

    def note(self, event: str) -> None:
        """An event, or a change of state where ``event`` is empty, for the trace."""
        self.note_row(event or f"state: {self.application.state.value}")

    # -- the slave controller's other side ---------------------------------------------------------------

    def mailbox(self, message: bytes) -> None:
        """The master has filled the mailbox."""
        if self.state is not AlState.INIT:
            self.coe.take(message)

    def outputs(self, data: bytes) -> None:
        """The master has written the process data outputs."""
        self._moves = True
        if self._op_requested:
            self._enter(AlState.OPERATIONAL)
        if self.state is not AlState.OPERATIONAL or len(data) < self.received.size:
            return
        for key, value in zip(self.received.keys, self.received.unpack(data), strict=True):
            setter = self.setters.get(key)
            try:
                if setter is not None:
                    setter(int(value))
                else:
                    self.store.write(key, int(value))
            except SdoAbortedError:
                continue

    def inputs(self) -> bytes:
        """Return the process data inputs at this moment."""
        return self.sent.pack()

    def watchdog_expired(self) -> None:
        """No outputs have come for the time of 0420h."""
        if self.state is AlState.OPERATIONAL:
            self.al_error(_WATCHDOG)

    def al_control(self, word: int) -> None:
        """The master has requested a state."""
        failed = self.esc.word(esc_registers.AL_STATUS) & _ERROR
        if failed and not word & _ERROR:
            return
        self._op_requested = False
        code = self._refusal(word & 0x0F)
        if code:
            self._tell(code)
        elif word & 0x0F == AlState.OPERATIONAL and self.state is AlState.SAFE_OPERATIONAL:
            self._op_requested = True
            self._tell(0)
        else:
            self._enter(AlState(word & 0x0F))

    def al_error(self, code: int) -> None:
        """The slave leaves OPERATIONAL by itself, and says why."""
        if self.state is AlState.OPERATIONAL:
            self._enter(AlState.SAFE_OPERATIONAL)
        self._tell(code)

    def _refusal(self, target: int) -> int:
        """The AL status code of a state that can't be entered; 0: it can."""
        if target == AlState.BOOT:
            return _NO_BOOT
        if target not in list(AlState):
            return _UNKNOWN_STATE
        if target <= self.state:
            return 0
        if target != _NEXT.get(self.state):
            return _INVALID_CHANGE
        managers = self.esc.managers
        if target == AlState.PRE_OPERATIONAL:
            fits = all(one.enabled and one.mailbox and one.length == MAILBOX for one in managers[:2])
            return 0 if fits and managers[0].host_writes and not managers[1].host_writes else _MAILBOX_WRONG
        for data, code in ((self.received, _OUTPUTS_WRONG), (self.sent, _INPUTS_WRONG)):
            manager = managers[data.manager]
            right = manager.enabled and not manager.mailbox and manager.host_writes is data.outputs
            if (right and manager.length != data.size) or (data.size > 0) is not right:
                return code
        return 0

    def _enter(self, state: AlState) -> None:
        before, self.state = self.state, state
        self._op_requested = False
        self._tell(0)
        if state is before:
            return
        self.note(f"AL {state.name.lower().replace('_', '-')}")
        if state < AlState.PRE_OPERATIONAL or before is AlState.INIT:
            self.esc.clear_mailbox()
            self.coe.reset()
        if before is AlState.OPERATIONAL:
            self.esc.stop_watchdog()
            self._connection_lost()
        elif state is AlState.OPERATIONAL:
            self.application.warning = False

    def _tell(self, code: int) -> None:
        """AL status and its code."""
        self.esc.set_word(esc_registers.AL_STATUS, self.state | _ERROR * (code > 0))
        self.esc.set_word(esc_registers.AL_STATUS_CODE, code)
        if code:
            self.note(f"AL status code {code:04X}h")

    # -- the drive ---------------------------------------------------------------------------------------

    def report(self, code: int) -> None:
        """An error of the drive: 603Fh, 1001h and an emergency message."""
        self.error_code, self.error_register = code, self.error_register | _COMMUNICATION | _GENERIC
        self.coe.emergency(code, self.error_register)

    def _errors_reset(self) -> None:
        self.error_code = self.error_register = 0
        self.coe.emergency(0, 0)

    def _connection_lost(self) -> None:
        """The process data ended: the reaction of 6007h where torque may flow."""
        if self.application.energised:
            self.report(_HOST_LOST)
            self.application.warning = True
            self.application.abort_connection()

    def _bind(self) -> None:
        store, unsigned8 = self.store, datatypes.UNSIGNED8
        store.live[key_of(0x1001)] = lambda: self.error_register
        store.live[key_of(0x603F)] = lambda: self.error_code
        for sub, kind in enumerate((1, 2, 3, 4), 1):
            store.add(0x1C00, sub, unsigned8, writable=False, mappable=False, name="SyncManager type")
            store.values[key_of(0x1C00, sub)] = kind
            store.set_default(0x1C00, sub, kind)
        store.add(0x1C00, 0, unsigned8, writable=False, mappable=False, name="SyncManager types")
        store.set_default(0x1C00, 0, 4)
        unsigned32, text = datatypes.UNSIGNED32, datatypes.VISIBLE_STRING
        for sub, data_type, value in ((3, unsigned32, 0), (MARKER_STAGE, unsigned8, 0), (5, text, "")):
            store.add(MARKER_INDEX, sub, data_type, writable=True, mappable=False, name="Marker")
            store.set_default(MARKER_INDEX, sub, value)
        store.set_default(MARKER_INDEX, 0, 5)
        store.set_default(MARKER_INDEX, 1, MARKER_TEXT)
        store.hooks[key_of(MARKER_INDEX, 3)] = self._set_period
        store.live[key_of(MARKER_INDEX, 2)] = lambda: int(self.stepped)
        store.hooks[key_of(MARKER_INDEX, 2)] = self._set_stepped
        store.hooks[key_of(MARKER_INDEX, MARKER_STAGE)] = self._set_stage

    def _set_period(self, period_us: int) -> None:
        self._period_us = period_us

    def _set_stepped(self, value: int) -> None:
        self.stepped = bool(value)
        self.note("stepped time" if value else "own time")

    def _set_stage(self, number: int) -> None:
        if number:
            self.note(f"stage {number}")
        self.on_stage(number)
