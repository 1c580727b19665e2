"""CANopen interface of the drive: NMT, SYNC, PDOs, heartbeat, EMCY, marker, and plant time.

One thread calls `on_frame` and `advance_us`; nothing here waits or reads a clock. In stepped time a SYNC

1. lets latched synchronous RPDOs act, 2. samples the reported values, 3. sends the synchronous TPDOs,
4. advances the plant by exactly 1006h (µs), in equal steps of at most the control period.
"""

from collections.abc import Callable
from struct import error as StructError

from profiles.canopen import CanopenProfile
from sim_bus.canopen.pdo import ReceivePdo, TransmitPdo
from sim_bus.canopen.profile_emulation import apply_on_canopen
from sim_bus.canopen.sender import PassiveNetwork, Sender
from sim_bus.canopen.services import (
    HeartbeatConsumer,
    HeartbeatProducer,
    LifeGuard,
    Nmt,
    NmtCommand,
    NmtState,
)
from sim_bus.emergency import COMMUNICATION, HOST_LOST, PDO_TOO_SHORT
from sim_bus.object_drive import ObjectDrive
from sim_bus.objects import key_of
from sim_bus.params import RigParams
from sim_bus.trace import ShaftTrace

SYNC = 0x080
COMMUNICATION_AREA = (0x1000, 0x1FFF)
PROFILE_AREA = (0x6000, 0x9FFF)
MANUFACTURER_AREA = (0x2000, 0x5FFD)      # the marker is unchanged
Route = Callable[[bytes | bytearray], None]


class Cia402Node(ObjectDrive):
    """A CiA 402 slave over a simulated inverter, with our own EDS or with a ``profile``."""

    def __init__(self, sender: Sender, params: RigParams, *, node_id: int, seed: int, trace: ShaftTrace,
                 stepped: bool, profile: CanopenProfile | None = None) -> None:
        super().__init__(params, node_id=node_id, seed=seed, trace=trace, stepped=stepped, profile=profile)
        self.id = node_id
        self._send = sender.send
        self.network = PassiveNetwork(sender)
        self.network.add_node(self.store)
        self.profile = profile
        self._guard = LifeGuard()
        if profile is not None:
            apply_on_canopen(profile, self, self._guard)
        self._receive = [ReceivePdo(self.store, n, self.setters, self._route, self._short_pdo) for n in range(4)]
        self._transmit = [TransmitPdo(self.store, n, self._route) for n in range(4)]
        self.nmt = Nmt()
        self._operational = False
        self._producer = HeartbeatProducer()
        self._consumer = HeartbeatConsumer()
        self._routes: dict[int, Route] = {}
        self._sync_receive: list[ReceivePdo] = []
        self._sync_transmit: list[TransmitPdo] = []
        self._event_transmit: list[TransmitPdo] = []
        self._bind()

    # -- frames ------------------------------------------------------------------------------------------

    def on_frame(self, can_id: int, data: bytes | bytearray) -> None:
        """Handle one data frame with an 11-bit identifier."""
        if can_id == SYNC:
            self._on_sync()
            return
        route = self._routes.get(can_id)
        if route is not None:
            route(data)

    def on_remote(self, can_id: int) -> None:
        """Handle one remote frame. A drive with node guarding and without a heartbeat of its own replies."""
        guarded = self.profile is not None and self.profile.watchdog.kind == "node_guarding"
        if can_id != 0x700 + self.id or not guarded or self._producer.active:
            return
        self._send(can_id, self._guard.answer(self.nmt.state.value))
        if self._guard.asked(self.time_us):
            self._supervised("node guarding began")

    def boot(self) -> None:
        """Switch on: everything at its defaults, boot-up message, pre-operational."""
        self._restore(COMMUNICATION_AREA, MANUFACTURER_AREA, PROFILE_AREA)
        self.note("power on")
        self.on_time(self.time_us)
        self._send(0x700 + self.id, b"\0")
        self.nmt.state = NmtState.PRE_OPERATIONAL
        self._changed_state()

    def refuse_remote_frames(self) -> None:
        """Let the drive accept only COB-IDs of TPDOs with bit 30 set (no remote frames), as some drives do."""
        for transmit in self._transmit:
            transmit.keep_no_remote()

    def send_emergency(self, message: bytes) -> None:
        """Send an EMCY."""
        self._send(0x080 + self.id, message)

    def _on_sync(self) -> None:
        if self._operational:
            for receive in self._sync_receive:
                receive.on_sync()
            for transmit in self._sync_transmit:
                data = transmit.at_sync()
                if data is not None:
                    self._send(transmit.can_id, data)
        self.pass_cycle()

    def _on_nmt(self, data: bytes | bytearray) -> None:
        if len(data) < 2 or data[1] not in {0, self.id}:
            return
        before = self.nmt.state
        command = self.nmt.obey(data[0])
        if command is None:
            return
        if command in {NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION}:
            if command is NmtCommand.RESET_NODE:
                self.application.power_off()
                self._restore(COMMUNICATION_AREA, MANUFACTURER_AREA, PROFILE_AREA)
            else:
                self._connection_lost()
                self._restore(COMMUNICATION_AREA)
            self._guard.reset()
            self.note(f"NMT {command.name.lower().replace('_', ' ')}")
            self._send(0x700 + self.id, b"\0")
            self.nmt.state = NmtState.PRE_OPERATIONAL
        elif self.nmt.state is before:
            return
        elif self.nmt.state is NmtState.STOPPED:
            self._connection_lost()
        self._changed_state()

    def _on_sdo(self, data: bytes | bytearray) -> None:
        if self.nmt.state is NmtState.STOPPED:
            return
        try:
            self.network.notify(0x600 + self.id, bytearray(data), 0.0)
        except (StructError, IndexError, TypeError) as error:     # malformed: canopen fails while aborting
            self.note(f"SDO request not understood: {error}")
        self._send_events()

    def _on_heartbeat(self, _data: bytes | bytearray) -> None:
        if self._consumer.beat(self.time_us):
            self._supervised("heartbeat supervision began")

    def _supervised(self, event: str) -> None:
        """Record that the host is supervised, for the first time or again."""
        self.note(event)
        if self.application.warning:
            self.application.warning = False
            if not self._faulted():
                self.emergency.reset()

    # -- time --------------------------------------------------------------------------------------------

    def advance_us(self, duration_us: int) -> None:
        """Advance the plant and all timers."""
        super().advance_us(duration_us)
        now_us = self.time_us
        if self._consumer.expired(now_us):
            self._host_lost("host heartbeat lost")
        if self._guard.expired(now_us):
            self._host_lost("host's node guarding lost")
        if self._producer.due(now_us) and self.nmt.state is not NmtState.INITIALISING:
            self._send(0x700 + self.id, bytes([self.nmt.state.value]))
        if self._event_transmit:
            self._send_events()

    def _send_events(self) -> None:
        if self._operational:
            for transmit in self._event_transmit:
                data = transmit.on_event(self.time_us)
                if data is not None:
                    self._send(transmit.can_id, data)

    # -- the connection ----------------------------------------------------------------------------------

    def _host_lost(self, event: str) -> None:
        """React to a silent host: EMCY 8130h, the reaction of 6007h, and 1029h:1 for the NMT state."""
        self.note(event)
        self.lose_host()
        behaviour = self.store.number(key_of(0x1029, 1))
        if self.nmt.state is NmtState.OPERATIONAL and behaviour != 1:
            self.nmt.state = NmtState.STOPPED if behaviour == 2 else NmtState.PRE_OPERATIONAL
            self._changed_state()

    def _connection_lost(self) -> None:
        """React to the end of the connection by NMT: the reaction of 6007h if torque may flow, and no EMCY except that
        of a fault.
        """
        if not self.application.energised:
            return
        self.application.abort_connection()
        if self._faulted():
            self.emergency.report(HOST_LOST, COMMUNICATION)

    def _faulted(self) -> bool:
        return self.application.state.name.startswith("FAULT")

    def _short_pdo(self) -> None:
        self.emergency.report(PDO_TOO_SHORT, COMMUNICATION, lasting=False)

    # -- configuration -----------------------------------------------------------------------------------

    def _bind(self) -> None:
        hooks = self.store.hooks
        hooks[key_of(0x1006)] = self.set_period
        hooks[key_of(0x1016, 1)] = self._set_consumer
        hooks[key_of(0x1017)] = self._producer.configure
        self.bind_marker(self.store)

    def _set_consumer(self, value: int) -> None:
        self._consumer.configure(value)
        self._route()

    def _restore(self, *areas: tuple[int, int]) -> None:
        for pdo in (*self._receive, *self._transmit):
            pdo.clear()
        for first, last in areas:
            self.store.restore(first, last)
        for pdo in (*self._receive, *self._transmit):
            pdo.load()
        if PROFILE_AREA in areas:
            self.application.warning = False
            self.emergency.forget()

    def _changed_state(self) -> None:
        self._operational = self.nmt.state is NmtState.OPERATIONAL
        self.note(f"NMT {self.nmt.state.name.lower().replace('_', '-')}")
        self._route()
        self._send_events()

    def _route(self) -> None:
        """Build the table of identifiers and their handlers again, after a PDO, the consumer or the NMT state has
        changed.
        """
        routes: dict[int, Route] = {}
        if self._consumer.cob_id >= 0:
            routes[self._consumer.cob_id] = self._on_heartbeat
        if self._operational:
            routes.update({pdo.can_id: pdo.receive for pdo in self._receive if pdo.valid})
        routes[0x600 + self.id] = self._on_sdo
        routes[0x000] = self._on_nmt
        self._routes = routes
        self._sync_receive = [pdo for pdo in self._receive if pdo.valid and pdo.synchronous]
        self._sync_transmit = [pdo for pdo in self._transmit if pdo.valid and pdo.synchronous]
        self._event_transmit = [pdo for pdo in self._transmit if pdo.valid and not pdo.synchronous]
