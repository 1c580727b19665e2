"""EtherCAT interface of the simulated drive: state machine of the slave, objects, process data.

One thread calls `Cia402Slave.answer` and `Cia402Slave.advance_us`; nothing here waits or reads a clock. In stepped time
a frame with outputs 1. gets the reported values as its inputs, 2. makes its outputs act, and 3. advances the plant by
exactly 5FFEh:3 (µs), in equal steps of at most the control period.
"""

from enum import IntEnum

from canopen.objectdictionary import datatypes

from profiles import MARKER_INDEX
from profiles.ethercat import EthercatProfile
from sim_bus.emergency import COMMUNICATION, GENERIC
from sim_bus.ethercat.coe import CoeServer
from sim_bus.ethercat.esc import AL_STATUS, AL_STATUS_CODE, Esc
from sim_bus.ethercat.process_data import ProcessData
from sim_bus.ethercat.sii import Area, eeprom
from sim_bus.object_drive import ObjectDrive
from sim_bus.objects import key_of
from sim_bus.params import RigParams
from sim_bus.trace import ShaftTrace

MAILBOX = 128
"""Length of each mailbox, bytes."""

_OUTPUTS_AT, _INPUTS_AT = 0x1200, 0x1400
_CAN_ONLY = (0x1005, 0x1006, 0x1014, 0x1016, 0x1017, 0x1029, 0x1200,
             *(base + number for base in (0x1400, 0x1600, 0x1800, 0x1A00) for number in range(4)))

class AlState(IntEnum):
    """States of the slave, with their codes in 0120h and 0130h."""

    INIT, PRE_OPERATIONAL, BOOT, SAFE_OPERATIONAL, OPERATIONAL = 1, 2, 3, 4, 8


_NEXT = {AlState.INIT: AlState.PRE_OPERATIONAL, AlState.PRE_OPERATIONAL: AlState.SAFE_OPERATIONAL,
         AlState.SAFE_OPERATIONAL: AlState.OPERATIONAL}
INVALID_CHANGE, UNKNOWN_STATE, NO_BOOT, MAILBOX_WRONG = 0x0011, 0x0012, 0x0013, 0x0016
WATCHDOG, OUTPUTS_WRONG, INPUTS_WRONG = 0x001B, 0x001D, 0x001E
"""AL status codes (ETG.1000.6, table 11)."""

_ERROR = 0x10


class Cia402Slave(ObjectDrive):
    """A CiA 402 drive on EtherCAT over a simulated inverter, with our own EDS or with a ``profile``."""

    error_register = GENERIC | COMMUNICATION

    def __init__(self, params: RigParams, *, seed: int, trace: ShaftTrace, stepped: bool, alias: int = 0,
                 profile: EthercatProfile | None = None) -> None:
        super().__init__(params, node_id=1, seed=seed, trace=trace, stepped=stepped, profile=profile)
        self.state = AlState.INIT
        self._outputs_came = self._op_requested = False
        for index in _CAN_ONLY:
            self.store.remove(index)
        pdos = (profile.cyclic.rx_pdos[0], profile.cyclic.tx_pdos[0]) if profile else (0x1600, 0x1A00)
        self.received = ProcessData(self.store, outputs=True, writable=self._configurable, usual=pdos[0],
                                    setters=self.setters)
        self.sent = ProcessData(self.store, outputs=False, writable=self._configurable, usual=pdos[1])
        short = datatypes.UNSIGNED8
        for index, sub, data_type, writable, name, value in (
            *((0x1C00, sub, short, False, "SyncManager type", sub or 4) for sub in (1, 2, 3, 4, 0)),
            (MARKER_INDEX, 5, datatypes.VISIBLE_STRING, True, "Text for segmented transfers", ""),
        ):
            self.store.add(index, sub, data_type, writable=writable, mappable=False, name=name, default=value)
        self.add_period()
        self.store.restore()
        self.bind_marker(self.store)
        areas = (Area(0x1000, MAILBOX, 0x26, 1), Area(0x1000 + MAILBOX, MAILBOX, 0x22, 2),
                 Area(_OUTPUTS_AT, self.received.data.size, 0x64, 3), Area(_INPUTS_AT, self.sent.data.size, 0x20, 4))
        identity = [int(self.store.number(key_of(0x1018, sub))) for sub in (1, 2, 3, 4)]
        self.esc = Esc(self, eeprom(identity, alias, str(self.store.values[key_of(0x1008)]), areas,
                                    [self.received.delivered(), self.sent.delivered()]))
        self.coe = CoeServer(self.store, self.esc.post, MAILBOX)
        self.note("power on")

    def answer(self, frame: bytes) -> bytes:
        """Return the frame as it leaves the slave."""
        answered = self.esc.answer(frame)
        if self._outputs_came:
            self._outputs_came = False
            self.pass_cycle()
        return answered

    def advance_us(self, duration_us: int) -> None:
        """Advance the plant and all timers."""
        super().advance_us(duration_us)
        self.esc.pass_time(duration_us)

    def send_emergency(self, message: bytes) -> None:
        """Put an emergency message into the mailbox."""
        self.coe.emergency(message)

    # -- the slave controller's other side ---------------------------------------------------------------

    def mailbox(self, message: bytes) -> None:
        """Handle a message that the master has put into the mailbox."""
        if self.state is not AlState.INIT:
            self.coe.take(message)

    def outputs(self, data: bytes) -> None:
        """Handle process data outputs of the master; they act in OPERATIONAL."""
        self._outputs_came = True
        if self._op_requested:
            self._enter(AlState.OPERATIONAL)
        if self.state is AlState.OPERATIONAL:
            self.received.data.act(data)

    def inputs(self) -> bytes:
        """Return the process data inputs at this moment."""
        return self.sent.data.pack()

    def watchdog_expired(self) -> None:
        """React to outputs that have not come for the time of 0420h."""
        if self.state is AlState.OPERATIONAL:
            self.al_error(WATCHDOG)

    def al_control(self, word: int) -> None:
        """Handle a request of the master for a state. An error must be acknowledged first."""
        if self.esc.word(AL_STATUS) & _ERROR and not word & _ERROR:
            return
        self._op_requested = False
        target = word & 0x0F
        if code := self._refusal(target):
            self._tell(code)
        elif target == AlState.OPERATIONAL and self.state is AlState.SAFE_OPERATIONAL:
            self._op_requested = True             # it begins with the first valid outputs
            self._tell(0)
        else:
            self._enter(AlState(target))

    def al_error(self, code: int) -> None:
        """Leave OPERATIONAL by the slave itself, with the AL status code as the reason."""
        if self.state is AlState.OPERATIONAL:
            self._enter(AlState.SAFE_OPERATIONAL)
        self._tell(code)

    def restart(self) -> None:
        """Restart the drive: no torque, INIT."""
        self.application.power_off()
        self._enter(AlState.INIT)

    def _configurable(self) -> bool:
        return self.state is AlState.PRE_OPERATIONAL

    def _refusal(self, target: int) -> int:
        """Return the AL status code that refuses a state; 0: the state is allowed."""
        if target == AlState.BOOT or target not in list(AlState):
            return NO_BOOT if target == AlState.BOOT else UNKNOWN_STATE
        if target <= self.state:
            return 0
        if target != _NEXT[self.state]:
            return INVALID_CHANGE
        managers = self.esc.managers
        if target == AlState.PRE_OPERATIONAL:
            fits = all(one.enabled and one.mailbox and one.length == MAILBOX for one in managers[:2])
            return 0 if fits and managers[0].host_writes and not managers[1].host_writes else MAILBOX_WRONG
        for data, code in ((self.received, OUTPUTS_WRONG), (self.sent, INPUTS_WRONG)):
            one = managers[data.manager]
            fits = not one.mailbox and one.host_writes is data.outputs and one.length == data.data.size
            if one.enabled is not (data.data.size > 0) or (one.enabled and not fits):
                return code
        return 0

    def _enter(self, state: AlState) -> None:
        before, self.state = self.state, state
        self._op_requested = False
        self._tell(0)
        if state is before:
            return
        self.note(f"AL {state.name.lower().replace('_', '-')}")
        if AlState.INIT in {before, state}:
            self.esc.clear_mailbox()
            self.coe.reset()
        if state is AlState.OPERATIONAL:
            self.application.warning = False
        elif before is AlState.OPERATIONAL:
            self.esc.stop_watchdog()
            if self.application.energised:         # torque may flow
                self.lose_host()

    def _tell(self, code: int) -> None:
        self.esc.set_word(AL_STATUS, self.state | _ERROR * (code > 0))
        self.esc.set_word(AL_STATUS_CODE, code)
        if code:
            self.note(f"AL status code {code:04X}h")
