"""CiA 402 on a CAN bus: PDOs, SYNC, NMT and heartbeat for `drivers.cia402.drive.Cia402Drive`.

The control loop sends all frames of a cycle; no other thread and no timer of the kernel sends any::

    tick ─ heartbeat (when due) ─ RPDO2 (when the mode changes) ─ RPDO1 ─ SYNC ─► TPDO1 (─ TPDO2)
           700h+host              6060h                         6040h 6071h 60FFh   6041h 6077h 606Ch
                                                                                   (6061h 6074h 6064h)

Both RPDOs are synchronous: data sent before a SYNC acts at that SYNC, and the TPDO shows the same instant. If a torque
offset is used (60B2h), RPDO2 carries it in every cycle. A drive without a heartbeat consumer is supervised by node
guarding instead (remote frame 700h+node). `shape_of` describes all other differences between the frames of drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from drivers.canopen import watchdog as arming
from drivers.canopen.bus import PEER_DEAD_S, CanLink
from drivers.canopen.other_master import ForeignTraffic
from drivers.canopen.pdo import NO_WORD, PdoFeedback, Slow, shape_of
from drivers.canopen.pdo_mapping import DISABLED, slow_syncs
from drivers.canopen.sdo import SdoObjects
from drivers.canopen.slow_feedback import ModeAndDemand, SlowFeedback
from drivers.canopen.supervision import HEARTBEAT_S, STOPPED, NodeWatch, SignOfLife
from drivers.cia402 import (
    DRIVE_SILENT_S,
    INTERPOLATION,
    Cia402Bus,
    Cia402Drive,
    CycleInputs,
    CycleSetpoints,
    CyclicObjects,
    FeedbackSetting,
    Group,
    Traffic,
    answer_time_s,
    download,
    set_interpolation,
    upload,
    uploaded,
)
from drivers.clock import Clock
from drivers.drive import DriveLimits, FrameTap, Identity
from drivers.errors import CommunicationLost, ObjectRefused, PreflightRefused
from drivers.preflight import PreflightTable
from drivers.undo_journal import UndoJournal
from profiles import CYCLE_ID, MessageCode
from profiles.canopen import CanopenProfile, Position

if TYPE_CHECKING:
    import can

HOST_NODE = 127
SYNC = 0x080
NMT = 0x000
START, ENTER_PRE_OPERATIONAL = 0x01, 0x80
NMT_COMMANDS = {START: "start", 0x02: "stop", ENTER_PRE_OPERATIONAL: "enter pre-operational", 0x81: "reset node",
                0x82: "reset communication"}
FIRST_ANSWERS, FIRST_ANSWER_S = 3, 0.05
"""Number of first SYNCs, at standstill, with a longer waiting time, and that time, s. They show the drive's response
time."""
DOUBLED_ANSWERS = 3
"""Number of doubled answers that shows two nodes with one node-ID. `Cia402Drive.connect` sends about ten requests."""
TPDO_COMMUNICATION, TPDO_MAPPING = 0x1800, 0x1A00


class CanopenBus(Cia402Bus):
    """One CANopen node as the bus of a CiA 402 drive. ``tap`` gets every frame."""

    feedback_timing = (TPDO_COMMUNICATION, 2)      # TPDO1: transmission type

    def __init__(
        self, bus: can.BusABC, profile: CanopenProfile, clock: Clock, *, node: int, period_s: float,
        host_node: int = HOST_NODE, tap: FrameTap | None = None,
    ) -> None:
        self._link = CanLink(bus, clock, tap)
        self._objects = SdoObjects(self._link, node)
        self._watch = NodeWatch(node, clock)
        super().__init__(self._objects, self._watch, clock, period_s)
        self._profile = profile
        self._node = node
        self.place = f"node {node}"
        self._foreign_traffic = ForeignTraffic(self._link, self._watch, clock, node=node, number=host_node)
        self._life = SignOfLife(self._link, self._watch, clock, profile, node=node, host_node=host_node)
        if self._life.asks:
            self._foreign_traffic.own_questions()
        self._objects.on_answer(self._on_sdo_answer)
        self._foreign_traffic.on_write = self._on_foreign_write
        self._watch.on_restart = self.reported.restarted
        self._link.handlers[0x080 + node] = self._watch.on_emcy
        self._rpdo1_id, self._tpdo1_id = 0x200 + node, 0x180 + node
        self._rpdo2_id, self._tpdo2_id = 0x300 + node, 0x280 + node
        self.feedback_place = f"TPDO1, {self._tpdo1_id:03X}h"
        self._link.handlers[self._tpdo2_id] = self._on_slow_feedback
        self._shape = shape_of(profile)
        self._layout = self._shape.feedback
        self._wide = self._shape.wide
        self._feedback = self._new_feedback()
        self._slow = SlowFeedback(Slow(wide=self._wide), 1)
        self._link.handlers[NMT] = self._on_nmt
        self._foreign_traffic.own(SYNC, "SYNC", lambda data: self._feedback.on_foreign_sync())
        self._own_kinds: tuple[str, ...] = tuple(rpdo_kind(n, 0x100 * (1 + n) + node) for n in range(1, 5))
        for number, kind in enumerate(self._own_kinds, start=1):
            self._foreign_traffic.own(0x100 * (1 + number) + node, kind)
        self._rpdos: dict[int, int] = {}       # number and COB-ID of each RPDO that acts or could act
        self._remapped = False         # the TPDO mapping was changed: their frames are ignored
        self._watchdog_s = self._allowed_silence_s = 0.0
        self._armed = False
        self._cycles = self._late = self._contradictions = 0

    def _new_feedback(self) -> PdoFeedback:
        feedback = PdoFeedback(self._shape, None if self.clock.stepped else self.clock.now_s, self.period_s)
        self._link.handlers[self._tpdo1_id] = feedback.on_tpdo1
        if self.clock.stepped:
            self._link.handlers[CYCLE_ID] = feedback.on_cycle_end
        return feedback

    def _new_slow(self, carried: Slow) -> SlowFeedback:
        return SlowFeedback(carried, 1 if self._wide else slow_syncs(self.period_s))

    # -- before motion ---------------------------------------------------------------------------------------

    def take(self) -> None:
        """Put the node into pre-operational."""
        self._link.send(NMT, bytes((ENTER_PRE_OPERATIONAL, self._node)))

    def confirm(self, identity: Identity) -> None:
        """Refuse two nodes with one node-ID. Raises PreflightRefused."""
        if self._objects.doubled >= DOUBLED_ANSWERS:
            raise PreflightRefused(
                "requests are answered twice: two nodes have the same node-ID",
                where=self.place,
                next_step="Disconnect one of them, or give each its own node-ID",
                entry=MessageCode.NODE_ID_CONFLICT,
            )
        self._link.asks = self.clock.stepped

    def map_cyclic(
        self, table: PreflightTable, content: CyclicObjects, demand: bool, position: Position | None
    ) -> Sequence[FeedbackSetting]:
        """Map both pairs of PDOs, and switch off the drive's other RPDOs."""
        self._shape = replace(self._shape, offset=content.offset)
        carried, others = arming.map_pdos(
            table, self._objects, self._node, self._shape, self.period_s, demand, position
        )
        for number, cob_id in others.items():
            self._foreign_traffic.own(cob_id & 0x7FF, rpdo_kind(number, cob_id & 0x7FF))
        self._rpdos = {1: self._rpdo1_id, **({2: self._rpdo2_id} if self._shape.mode_and_offset else {}), **others}
        self._slow = self._new_slow(carried)
        self.angle_mapped = carried.position is not None
        return arming.feedback_frames(self._objects)

    def arm(self, table: PreflightTable, limits: DriveLimits) -> float:
        """Set cycle, heartbeats and node number, arm the watchdog and read it back."""
        life = self._life
        life.pace(limits.watchdog_s / 5.0)
        life.host_node = self._foreign_traffic.settle_number(table)
        heard = arming.set_timing(
            table, self._objects, self._profile, self.period_s, HEARTBEAT_S, self.clock.stepped, self.interpolates
        )
        self._watchdog_s = limits.watchdog_s
        feed_s = arming.arm_watchdog(
            table,
            self._objects,
            self._profile.watchdog,
            host_node=life.host_node,
            watchdog_s=limits.watchdog_s,
            period_s=self.period_s,
            beat=life.feed,
            answered=life.answered,
            accept_none=limits.accept_no_watchdog,
        )
        life.keep_to(feed_s)
        self._armed = feed_s > 0.0
        self._allowed_silence_s = limits.watchdog_s if life.asks else DRIVE_SILENT_S if heard else 0.0
        return feed_s

    def setting(self, index: int) -> tuple[str, Group] | None:
        """Return title and group of the watchdog's objects, of the RPDOs' switches, and of the timing (not read)."""
        guards = (arming.GUARD_TIME, arming.LIFE_TIME_FACTOR)
        if index in (guards if self._life.asks else (self._profile.watchdog.consumer_index,)):
            return ("the drive's watchdog" if self._armed else ""), Group.SAFETY
        if 0x1400 <= index < 0x1600:
            return f"the switch of RPDO{index - 0x1400 + 1}", Group.REST
        return ("", Group.REST) if index in (0x1006, 0x1017, INTERPOLATION) else None

    def start(self) -> None:
        """Start the node, and supervise it."""
        self._link.send(NMT, bytes((START, self._node)))
        self._link.drain()
        self._watch.start(self._allowed_silence_s)

    def set_period(self, period_s: float) -> Sequence[tuple[int, int, bytes]]:
        """Write 1006h, 60C2h and the transmission type of TPDO2 in pre-operational."""
        self.period_s = period_s
        changed = []
        self._watch.stop()
        self._life.feed()
        self.take()
        with suppress(ObjectRefused):  # a drive without 1006h follows the SYNC alone
            arming.set_period(self._objects, self._profile, period_s)
        with suppress(ObjectRefused):
            if self.interpolates:
                set_interpolation(self._objects, period_s)
        with suppress(ObjectRefused):
            changed.append((TPDO_COMMUNICATION + 1, 2, arming.set_slow_syncs(self._objects, period_s)))
        self._life.feed()
        self._feedback = self._new_feedback()
        self._slow = self._new_slow(self._slow.carried)
        self._cycles = self._late = self._contradictions = 0
        return changed

    def refuse_motion(self) -> None:
        """Refuse motion if another node sends heartbeats under the host's number. Raises PreflightRefused."""
        self._foreign_traffic.refuse_shared()

    # -- the cycle -------------------------------------------------------------------------------------------

    def listen_until(self, tick_s: float) -> None:
        """Wait for the next tick and handle frames meanwhile. Feedback that arrives meanwhile is late."""
        clock, feedback = self.clock, self._feedback
        before = feedback.arrived - feedback.older
        if clock.stepped:
            clock.wait_until(tick_s)
        if (shown := self._slow.end()) is not None:
            self._show(shown)
        while not clock.stepped and (left_s := tick_s - clock.now_s()) > 0.0:
            if self._link.receive(left_s) is None:
                break
        self._link.drain()
        self._late += feedback.arrived - feedback.older > before

    def begin(self, try_again: bool) -> float:
        """Raise the errors so far, and send the sign of life if it is due. Return the control time, s."""
        if try_again:
            self._link.try_again()
        self.check()
        now_s = self.clock.now_s()
        self._life.feed_when_due(now_s)
        return now_s

    def send(self, setpoints: CycleSetpoints) -> None:
        """Send RPDO2 if it is needed, and RPDO1; they act at the next SYNC."""
        shape = self._shape
        if (setpoints.mode_changes and shape.mode) or shape.offset is not None:
            self._link.send(self._rpdo2_id, shape.rpdo2.pack(setpoints))
        self._link.send(self._rpdo1_id, shape.rpdo1.pack(setpoints), self.ticks.check)

    def receive(self, now_s: float, sync: bool) -> CycleInputs:
        """Send SYNC and read the feedback that belongs to it."""
        feedback = self._feedback
        feedback.begin(now_s, sync=sync)
        if sync:
            self._slow.begin()
            self._link.send(SYNC, NO_WORD, self.ticks.check)     # the SYNC makes the setpoint act
        age_s = self._await_feedback(now_s)
        self._cycles += 1
        doubted = feedback.doubted()
        while self._contradictions < feedback.contradictions:
            self._contradictions += 1
            self._watch.on_contradiction()
        if not feedback.data or self._remapped:
            return CycleInputs(age_s, False, doubted)
        status, torque, speed = self._layout.unpack(feedback.data)
        return CycleInputs(age_s, True, doubted, status, torque, speed, self._slow.counts if sync else None)

    def _await_feedback(self, sync_s: float) -> float:
        """Handle frames until TPDO1 has come. Return its age in seconds of control time."""
        clock = self.clock
        link = self._link
        if clock.stepped:
            # In stepped time a missing frame is lost, never late.
            if link.await_answer(lambda: self._feedback.done, PEER_DEAD_S) and self._slow.due:
                self._slow.wait()
                link.await_answer(lambda: self._feedback.over or not self._slow.due, PEER_DEAD_S)
            return 0.0
        feedback = self._feedback
        first = not feedback.arrived and self._cycles < FIRST_ANSWERS
        patience_s = min(FIRST_ANSWER_S, 0.1 * self._watchdog_s) if first else 0.0
        deadline_s = sync_s + max(0.8 * self.period_s, patience_s)
        while not feedback.done and (left_s := deadline_s - clock.now_s()) > 0.0:
            link.receive(left_s)
        if not feedback.done:
            link.drain()               # after a delay of this loop: frames that came in time count
            feedback.settle()
        age_s = clock.now_s() - sync_s
        if feedback.done and self._slow.due:
            self._slow.wait()
            while self._slow.due and (left_s := deadline_s - clock.now_s()) > 0.0:
                link.receive(left_s)
        if first:
            self.ticks.put_off()
        return age_s

    def check(self) -> None:
        """Raise the errors of the drive. A heartbeat that is still unread does not count as missing."""
        watch = self._watch
        if watch.quiet:
            return
        if watch.overdue:
            self._link.drain()
        watch.check()

    @property
    def others_drive(self) -> bool:
        """True if setpoints of another master were received under the identifiers of our RPDOs."""
        foreign = self._watch.foreign
        return any(foreign[kind] for kind in self._own_kinds[:2])

    # -- the watchdog ----------------------------------------------------------------------------------------

    def feed(self) -> None:
        """Send the host's sign of life now."""
        self._life.feed()

    def feed_when_due(self, now_s: float) -> None:
        """Send the host's sign of life if it is due."""
        self._life.feed_when_due(now_s)

    def feed_between(self) -> None:
        """Send one additional sign of life. It does not change the time at which the next is due."""
        self._life.feed_between()

    def stop_feeding(self) -> None:
        """End the host's sign of life, so that the drive's watchdog trips."""
        self._life.end()

    # -- beside the cycle ------------------------------------------------------------------------------------

    def ask(self, index: int, sub: int) -> None:
        """Send an upload request (SDO) without waiting."""
        self._link.send(0x600 + self._node, upload(index, sub))

    def put(self, index: int, sub: int, data: bytes) -> None:
        """Send an expedited download request (SDO) without waiting."""
        self._link.send(0x600 + self._node, download(index, sub, data))

    def disable_setpoints(self) -> int:
        """Switch every RPDO off (bit 31 of its COB-ID)."""
        done = 0
        with self._objects.answered_within(answer_time_s(self._watchdog_s)):
            for number, cob_id in self._rpdos.items():
                with suppress(CommunicationLost, ObjectRefused):
                    self._life.feed()
                    self._objects.write(0x1400 + number - 1, 1, cob_id | DISABLED, 32)
                    done += 1
        return done

    def pause(self) -> None:
        """Handle frames for a short wall time between two SDOs. Feeds the watchdog if it is armed."""
        if self._watchdog_s:
            self._life.feed()
        self._link.pump_until(lambda: False, 0.01)

    def hurry(self, stopping: bool) -> None:
        """Bound the time for received frames in a stop."""
        self._link.stopping = stopping

    def reach(self) -> None:
        """Put a stopped node into pre-operational, where it serves SDO, and feed its watchdog."""
        if self._watch.nmt_state == STOPPED:
            self.take()
        self._life.feed()

    def keep_stepping(self) -> None:
        """Set the cycle of a simulated drive again (1006h, or the marker's)."""
        arming.keep_stepping(self._objects, self._profile, self.period_s)

    def changed(self, index: int, sub: int) -> None:
        """Ignore the TPDOs from now on if their mapping was changed: such frames cannot be decoded."""
        self._remapped |= index in (TPDO_MAPPING, TPDO_MAPPING + 1)

    def intervals_s(self, period_s: float) -> tuple[float, float]:
        """Return the intervals of the mode display and of the angle in TPDO2, s."""
        apart_s = slow_syncs(period_s) * period_s
        return apart_s, period_s if self._wide else apart_s

    def late_since(self, since_s: float) -> list[float]:
        """Return the delays of TPDO1s that came after the end of their cycles, s, for arrivals since ``since_s``."""
        return self._feedback.late_since(since_s)

    def traffic(self) -> Traffic:
        """Return the errors on the bus since the start."""
        link, stamps, feedback = self._link, self._link.stamps, self._feedback
        late = self._late + feedback.second + feedback.older
        return Traffic(late, link.error_frames, link.passive, stamps.offset_s, stamps.jumps)

    def summary(self) -> tuple[str, ...]:
        """Return remarks on the writes of other masters to the drive during the whole run."""
        return self._foreign_traffic.summary()

    def _on_nmt(self, data: bytes) -> None:
        """Handle an NMT command of another master to this drive, or to all nodes (CiA 301)."""
        if len(data) < 2 or data[1] not in (0, self._node):
            return
        name = NMT_COMMANDS.get(data[0], f"command {data[0]:02X}h")
        self.watch.remark(f"another master sent NMT {name} to {'all nodes' if data[1] == 0 else 'the drive'}")
        state = {0x02: "stopped", ENTER_PRE_OPERATIONAL: "pre-operational"}.get(data[0])
        if state is not None and self.watch.expect_operational:       # a reset is detected by the boot-up message
            self.watch.interference(
                f"another master put the drive into NMT state {state}", f"node {self._node}",
                "Disconnect the second master from the bus, and start again", kind="nmt",
            )

    def _on_foreign_write(self, index: int, sub: int) -> None:
        self.on_write(index, sub)

    def _on_sdo_answer(self, data: bytes) -> None:
        """Handle an SDO answer of the drive, to this or another client (upload, expedited; abort)."""
        found = uploaded(data) if len(data) == 8 else None
        if found is not None:
            self.on_answer(*found)

    def _on_slow_feedback(self, data: bytes) -> None:
        if self._remapped:
            return
        size = self._slow.carried.size
        if self._wide and len(data) == 2 + size:
            self._feedback.on_status(data[:2])
            data = data[2:]
        if len(data) == size:
            # The two TPDOs of a wide drive come in any order with each SYNC; the two of one SYNC are combined.
            shown = self._slow.take(data, self._wide or bool(self._feedback.data))
            if shown is not None:
                self._show(shown)

    def _show(self, shown: ModeAndDemand) -> None:
        self.reported.take_slow(self.clock.now_s(), *shown)

    # -- afterwards ------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the bus."""
        self._link.close()


class CanopenDrive(Cia402Drive):
    """A CiA 402 drive on CANopen: one node. See `Cia402Drive` and `CanopenBus`."""

    def __init__(
        self,
        bus: can.BusABC,
        profile: CanopenProfile,
        clock: Clock,
        *,
        node: int,
        rate_hz: float | None = None,
        rated_torque_nm: float | None = None,
        host_node: int = HOST_NODE,
        tap: FrameTap | None = None,
        journal: UndoJournal | None = None,
    ) -> None:
        period_s = round(1e6 / (rate_hz or profile.cyclic.rate_hz)) * 1e-6
        super().__init__(
            CanopenBus(bus, profile, clock, node=node, period_s=period_s, host_node=host_node, tap=tap),
            profile, fixed_rate=rate_hz is not None, rated_torque_nm=rated_torque_nm, journal=journal,
        )


def rpdo_kind(number: int, identifier: int) -> str:
    """Return the name of an RPDO of the drive, as used in messages."""
    return f"setpoints (RPDO{number}, {identifier:03X}h)"
