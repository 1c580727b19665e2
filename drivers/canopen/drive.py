"""A CiA 402 drive on a CAN bus, with the interface of `drivers.drive.Drive`.

One cycle; this loop sends all of it, no other thread and not the kernel::

    tick ─ heartbeat (when due) ─ RPDO2 (when the mode changes) ─ RPDO1 ─ SYNC ─► TPDO1 (─ TPDO2)
           700h+host              6060h                         6040h 6071h 60FFh   6041h 6077h 606Ch
                                                                                   (6061h 6074h 6064h)

Both RPDOs are synchronous: data sent before a SYNC acts at that SYNC, and the TPDO shows the same instant. So a mode
switch and the torque target that belongs to it act together. If a torque offset is used (60B2h), RPDO2 carries it in
every cycle; it is zero from the cycle on in which a stop is requested. A drive without a heartbeat consumer is
supervised by node guarding instead (remote frame 700h+node). `shape_of` describes all other differences between the
frames of drives.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from drivers.angle import Unwrapped
from drivers.canopen import preflight as checks
from drivers.canopen import watchdog as arming
from drivers.canopen.bus import PEER_DEAD_S, CanLink
from drivers.canopen.limits import check_parameters, note_temperature, set_limits
from drivers.canopen.other_master import ForeignTraffic
from drivers.canopen.pdo import (
    PdoFeedback,
    Reported,
    Slow,
    Units,
    encode_speed,
    encode_torque,
    encode_torque_offset,
    shape_of,
)
from drivers.canopen.pdo_mapping import slow_syncs
from drivers.canopen.position import AngleObject, find_angle
from drivers.canopen.preflight import (
    find_free_node,
    find_torque_offset,
    find_units,
    read_identity,
    refuse_in_doubt,
)
from drivers.canopen.quick_stop import Standing
from drivers.canopen.sdo import Objects
from drivers.canopen.sdo_feedback import keep_stepping, poll, push
from drivers.canopen.slow_feedback import ModeAndDemand, SlowFeedback
from drivers.canopen.state_machine import (
    DISABLE_VOLTAGE,
    FAULT_RESET,
    REMOTE,
    State,
    controlword_towards,
    decode,
)
from drivers.canopen.supervision import HEARTBEAT_S, STOPPED, Group, NodeWatch, ReadBack, SignOfLife
from drivers.clock import RATES_HZ, STALL_CYCLES, STALL_S, Clock, Ticks, how_late
from drivers.drive import (
    Command,
    Counters,
    DriveLimits,
    FrameTap,
    Identity,
    Mode,
    PositionReading,
    PowerRequest,
    Preflight,
    Sample,
)
from drivers.errors import CommandRejected, CommunicationLost, ObjectRefused, PreflightRefused
from drivers.own_limits import OwnLimits
from drivers.preflight import PreflightTable
from drivers.undo_journal import UndoJournal
from profiles import CYCLE_ID, MARKER_INDEX, MARKER_STAGE, STAGE_NUMBERS, MessageCode
from profiles.canopen import CanopenProfile

if TYPE_CHECKING:
    import can

HOST_NODE = 127
SYNC = 0x080
NMT = 0x000
START, ENTER_PRE_OPERATIONAL = 0x01, 0x80
NMT_COMMANDS = {START: "start", 0x02: "stop", ENTER_PRE_OPERATIONAL: "enter pre-operational", 0x81: "reset node",
                0x82: "reset communication"}
LOCAL_CYCLES = 3
"""A missing bit counts after this number of cycles; one damaged frame does not matter."""
FIRST_ANSWERS, FIRST_ANSWER_S = 3, 0.05
"""The first SYNCs, at standstill, get this waiting time, s. It shows the response time of the drive."""
QUICK_STOP_OPTION = 0x605A
DRIVE_SILENT_S = 0.5
"""A drive counts as lost after this time without its heartbeat, s."""
MODE_STALE_S, MODE_STALE_TIMES = 0.5, 10
"""The displayed mode counts as unknown after this time, s, and this number of frame periods without a display."""
THIN_S, THIN_CYCLES, THIN_SHARE = 1.0, 10, 0.5
"""Limit for missing feedback: more than this share of the cycles within this time (at least this number of cycles).
With less feedback the shaft cannot be guarded. A bus that loses every tenth frame is far below the limit."""
TPDO_COMMUNICATION, TPDO_MAPPING = 0x1800, 0x1A00
_NO_WORD = b""
_DISABLED = (State.SWITCH_ON_DISABLED, State.FAULT)
_OUT_OF_OPERATION = (State.QUICK_STOP_ACTIVE, State.FAULT, State.FAULT_REACTION_ACTIVE)
_REPEAT_MODE_CYCLES = 25
"""A mode that is not displayed is requested again after this number of cycles: one lost frame must not end a run."""


class Cia402Drive:
    """One node. ``rated_torque_nm`` overrides or replaces the value that the drive reports. ``tap`` gets every frame.
    ``journal`` records the settings that are changed in the drive, for restoring them after the host has died.

    In stepped time a simulated peer advances its time with each SYNC; for a real drive it is refused.
    """

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
        self.clock = clock
        self.period_s = round(1e6 / (rate_hz or profile.cyclic.rate_hz)) * 1e-6
        self._rate_is_named = rate_hz is not None
        self._profile = profile
        self._node = node
        self._rated_torque_nm = rated_torque_nm
        self._link = CanLink(bus, clock, tap)
        self._objects = Objects(self._link, node)
        self._journal = journal
        self._watch = NodeWatch(node, clock)
        self._foreign_traffic = ForeignTraffic(self._link, self._watch, clock, node=node, number=host_node)
        self._life = SignOfLife(self._link, self._watch, clock, profile, node=node, host_node=host_node)
        if self._life.asks:
            self._foreign_traffic.own_questions()
        self._read_back = ReadBack(
            self._watch, lambda request: self._link.send(0x600 + node, request), self._foreign_traffic.tell, node
        )
        self._objects.on_answer(self._read_back.take)
        self._read_back.on_changed = self._on_changed
        self._foreign_traffic.on_write = self._on_write
        self._shape = shape_of(profile)
        self._standing = Standing(self._objects, self._link, node, self.period_s, self._shape.target_speed)
        self._fed = True
        self._link.handlers[0x080 + node] = self._watch.on_emcy
        self._rpdo1_id, self._tpdo1_id = 0x200 + node, 0x180 + node
        self._rpdo2_id, self._tpdo2_id = 0x300 + node, 0x280 + node
        self._link.handlers[self._tpdo2_id] = self._on_slow_feedback
        self._identity: Identity | None = None
        self._stage = ""               # last stage sent to a simulated peer
        self._taken = False
        self._remapped = False         # the TPDO mapping was changed: their frames are ignored
        self._units = Units(1.0, 1.0)
        self._codes: dict[Mode, int] = {}
        self._modes: dict[int, Mode] = {}
        self._layout = self._shape.feedback
        self._wide = self._shape.wide
        self._feedback = self._new_feedback()
        self._link.handlers[NMT] = self._on_nmt
        self._foreign_traffic.own(SYNC, "SYNC", lambda data: self._feedback.on_foreign_sync())
        for number in range(1, 5):
            self._foreign_traffic.own(0x100 * (1 + number) + node, rpdo_kind(number, 0x100 * (1 + number) + node))
        self._has_target = self._shape.target_torque
        self._slow = SlowFeedback(Slow(wide=self._wide), 1)
        self._watchdog_s = self._allowed_silence_s = 0.0
        self._angle: AngleObject | None = None
        self._unwrapped: Unwrapped | None = None
        self._shown_s = clock.now_s()  # when the mode was last displayed
        self._wish = PowerRequest.OFF
        self._removes_torque = False
        self._in_operation = False     # enabled, and seen enabled since
        self._was_remote, self._local = False, 0       # bit 9: was set in operation; cycles without it
        self._ever_asked = False       # to be enabled
        self._armed = True             # the drive's watchdog; true while unknown
        self._reported = Reported()
        self._sent_code = 0
        self._since_mode_sent = 0
        self._mode_overwritten = False
        self._contradictions = 0
        self._ticks = Ticks(clock, self.period_s)
        self._watch.host_stood_still = self._stood_still
        self._watch.host_late = self.host_late
        self._watch.on_boot_up = self._reported.restarted
        self._cycles = self._missed = self._late = 0

    def _new_feedback(self) -> PdoFeedback:
        self._recent: deque[bool] = deque(maxlen=max(THIN_CYCLES, round(THIN_S / self.period_s)))
        feedback = PdoFeedback(self._shape, None if self.clock.stepped else self.clock.now_s, self.period_s)
        self._link.handlers[self._tpdo1_id] = feedback.on_tpdo1
        if self.clock.stepped:
            self._link.handlers[CYCLE_ID] = feedback.on_cycle_end
        return feedback

    def _new_slow(self, carried: Slow) -> SlowFeedback:
        return SlowFeedback(carried, 1 if self._wide else slow_syncs(self.period_s))

    def _angle_coming(self) -> checks.AngleComing:
        """Return how the motor's angle arrives, at any rate that this drive may get."""
        if self._angle is None or self._unwrapped is None:
            return checks.AngleComing()
        periods_s = (self.period_s, *(1.0 / rate for rate in self.rates_hz))
        apart_s = max(periods_s if self._wide else (slow_syncs(one) * one for one in periods_s))
        gap_s = self._unwrapped.longest_gap_s
        comes = self._slow.carried.position is not None and apart_s <= gap_s
        return checks.AngleComing(self._angle.rad_per_count, apart_s if comes else None, gap_s)

    def host_late(self) -> str:
        """Return the recent delay of this computer or its adapter, in words; empty if there is none."""
        begun = list(self._ticks.late_s)
        since_s = self.clock.now_s() - len(begun) * self.period_s
        # The delay of an answer replaces the delay of the start of its cycle, which is usually zero.
        answered = [self.period_s + late_s for late_s in self._feedback.late_since(since_s)]
        late_s = answered + begun[: max(0, len(begun) - len(answered))]
        return self._stood_still() or how_late(late_s, self.period_s)

    def _stood_still(self) -> str:
        away_s = self._ticks.stood_still_s(DRIVE_SILENT_S + self._watchdog_s)
        return f"this computer was late: its control loop stood still for {away_s:.2f} s" if away_s else ""

    @property
    def counters(self) -> Counters:
        """Errors on the bus since the start."""
        stamps = self._link.stamps
        return Counters(
            self._cycles, self._missed, self._late + self._feedback.second + self._feedback.older,
            self._ticks.overruns,
            error_frames=self._link.error_frames, passive=self._link.passive,
            wall_offset_s=stamps.offset_s, wall_jumps=stamps.jumps,
        )

    # -- before motion ---------------------------------------------------------------------------------------

    def connect(self) -> Identity:
        """Find the node, put it into pre-operational, read its identity (1018h) and the simulator's marker."""
        find_free_node(self._objects)
        self._taken = True
        self._link.send(NMT, bytes((ENTER_PRE_OPERATIONAL, self._node)))
        self._identity = read_identity(self._objects)
        refuse_in_doubt(self._objects, self._identity, self._node, self.clock.stepped)
        self._link.asks = self.clock.stepped
        self.announce(self._stage)
        return self._identity

    def announce(self, stage: str) -> None:
        """Send a stage of the run to a simulated peer (5FFEh:4). Nothing is sent to a real drive.

        It is an expedited SDO download (CiA 301); tdhil does not wait for the answer.
        """
        self._stage = stage
        if self._identity is not None and self._identity.simulated and stage in STAGE_NUMBERS:
            request = bytes((0x2F, MARKER_INDEX & 0xFF, MARKER_INDEX >> 8, MARKER_STAGE, STAGE_NUMBERS[stage], 0, 0, 0))
            self._link.send(0x600 + self._node, request)

    def preflight(self, limits: DriveLimits) -> Preflight:
        """Set and read back limits, watchdog and PDOs. The node is then operational, disabled, and supervised."""
        if self._identity is None:
            raise PreflightRefused("preflight before connect", where="driver")
        table, objects, scaling = PreflightTable(), self._objects, PreflightTable()
        self._units, rated_nm = find_units(scaling, objects, self._profile, self._rated_torque_nm)
        checks.check_identity(table, self._identity, self._profile)
        if not checks.check_state(table, objects, self._units, self._profile, limits):
            return checks.report(table, self._identity, self._profile, objects, self._units, rated_nm, {}, 0.0, {},
                                 checks.AngleComing())
        if self._journal is not None:
            checks.restore_from(table, objects, self._journal, self._identity)
        check_parameters(table, objects, self._profile)
        self._codes = checks.choose_modes(table, objects, self._profile, limits.torque_offset)
        self._modes = {code: mode for mode, code in self._codes.items()}
        table.checks += scaling.checks
        self._angle = find_angle(table, objects, self._profile)
        own = OwnLimits(limits.accept_wider)
        set_limits(table, objects, self._profile, limits, rated_nm, own)
        note_temperature(table, limits.temperature_c)
        checks.clear_targets(table, objects, self._profile)
        for code in self._codes.values():
            checks.check_mode_display(table, objects, code, self._pause)
        if limits.torque_offset and (offset := find_torque_offset(table, objects, self._profile, rated_nm)) is not None:
            self._shape = replace(self._shape, offset=offset[0])
            self._units = replace(self._units, offset_nm_per_lsb=offset[1])
        self._standing.offset = self._shape.offset
        carried, others = arming.map_pdos(
            table, objects, self._node, self._profile, self._shape, self.period_s,
            None if self._angle is None else self._angle.entry,
        )
        for number, cob_id in others.items():
            self._foreign_traffic.own(cob_id & 0x7FF, rpdo_kind(number, cob_id & 0x7FF))
        self._standing.rpdos = {1: self._rpdo1_id, **({2: self._rpdo2_id} if self._shape.second else {}), **others}
        self._slow = self._new_slow(carried)
        frames = arming.feedback_frames(objects)
        self._unwrapped = None if self._angle is None else self._angle.unwrapped(limits.speed_rad_s)
        self._life.pace(limits.watchdog_s / 5.0)
        self._life.host_node = self._foreign_traffic.settle_number(table)
        heard = arming.set_timing(table, objects, self._profile, self.period_s, HEARTBEAT_S, self.clock.stepped)
        self._watchdog_s = limits.watchdog_s
        feed_s = arming.arm_watchdog(
            table,
            objects,
            self._profile.watchdog,
            host_node=self._life.host_node,
            watchdog_s=limits.watchdog_s,
            period_s=self.period_s,
            beat=self._life.feed,
            answered=self._life.answered,
            accept_none=limits.accept_no_watchdog,
        )
        self._life.keep_to(feed_s)
        self._armed = feed_s > 0.0
        self._watch_settings(limits.watchdog_s if feed_s else 0.0, frames)
        found = checks.report(
            table, self._identity, self._profile, objects, self._units, rated_nm, self._codes,
            limits.watchdog_s if feed_s else 0.0, own.kept, self._angle_coming(),
        )
        self._allowed_silence_s = limits.watchdog_s if self._life.asks else DRIVE_SILENT_S if heard else 0.0
        self._start()
        return found

    @property
    def rates_hz(self) -> tuple[float, ...]:
        """The profile's rate and lower ones; none in stepped time, or if a rate was given."""
        if self._rate_is_named or self.clock.stepped:
            return ()
        highest, lowest = self._profile.cyclic.rate_hz, arming.LEAST_CYCLES / (self._watchdog_s or math.inf)
        return (highest, *(rate for rate in RATES_HZ if lowest <= rate < highest))

    @property
    def began_late_s(self) -> float:
        """Delay of the start of the last cycle, s."""
        return self._ticks.late_s[-1] if self._ticks.late_s else 0.0

    def set_rate(self, rate_hz: float, *, measuring: bool = False) -> None:
        """Change the rate after preflight and before the drive is enabled. 1006h is written in pre-operational.

        With ``measuring`` a delayed loop is no error, because nothing can move.
        """
        self.period_s = round(1e6 / rate_hz) * 1e-6
        self._watch.stop()
        self._life.feed()
        self._link.send(NMT, bytes((ENTER_PRE_OPERATIONAL, self._node)))
        with suppress(ObjectRefused):  # then it follows the SYNC alone
            arming.set_period(self._objects, self._profile, self.period_s)
        with suppress(ObjectRefused):
            self._read_back.stands(0x1801, 2, arming.set_slow_syncs(self._objects, self.period_s))
        self._standing.set_period(self.period_s)
        self._life.feed()
        self._feedback = self._new_feedback()
        self._slow = self._new_slow(self._slow.carried)
        self._cycles = self._missed = self._late = self._contradictions = 0
        self._start(0.0 if measuring else 0.5)

    def _watch_settings(self, watchdog_s: float, frames: Sequence[tuple[str, int, int, bytes]]) -> None:
        """List the settings that preflight made, for reading them back during motion."""
        watchdog, back = self._profile.watchdog, self._read_back
        back.clear()
        reaction = watchdog.reaction_index, watchdog.reaction_sub
        guards = [arming.GUARD_TIME, arming.LIFE_TIME_FACTOR] if self._life.asks else [watchdog.consumer_index]
        for (index, sub), data in self._objects.stands.items():
            if index in guards or (index, sub) == reaction:
                if watchdog_s:
                    title = "the watchdog's reaction" if (index, sub) == reaction else "the drive's watchdog"
                    back.watch(title, index, sub, data, Group.SAFETY)
            elif 0x1400 <= index < 0x1600:
                back.watch(f"the switch of RPDO{index - 0x1400 + 1}", index, sub, data, Group.REST)
            elif index == QUICK_STOP_OPTION:
                back.watch("the quick-stop option", index, sub, data, Group.SAFETY)
            elif index not in (0x1006, 0x1017, 0x6060, MARKER_INDEX):
                back.watch("the drive's own limit", index, sub, data, Group.REST)
        for one in frames:
            back.watch(*one, Group.FEEDBACK)
        back.watch_setpoint("the target velocity", self._shape.target_speed[0])
        if self._has_target:
            back.watch_setpoint("the target torque", 0x6071)
        if self._shape.mode:
            back.watch_setpoint("the mode of operation", 0x6060)
        if self._shape.offset is not None and self._shape.offset[1] == 0:
            back.watch_setpoint("the torque offset", self._shape.offset[0])

    def _start(self, stall_share: float = 0.5) -> None:
        """Start the node and its supervision. A delay above this share of the watchdog's time is an error."""
        try:
            self._watch.check()        # nothing moves yet: an error becomes a refusal
        except CommunicationLost as error:
            raise PreflightRefused(error.what, where=error.where, next_step=error.next_step,
                                   entry=MessageCode.NO_FEEDBACK) from error
        self._link.send(NMT, bytes((START, self._node)))
        self._link.drain()
        self._ticks = Ticks(self.clock, self.period_s, stall_share * self._watchdog_s)
        self._shown_s = self.clock.now_s()
        self._watch.start(self._allowed_silence_s)

    def _pause(self) -> None:
        """Wait a short wall time between two SDOs for a drive that needs it. Feeds the watchdog if it is armed."""
        if self._watchdog_s:
            self._life.feed()
        self._link.pump_until(lambda: False, 0.01)

    # -- the cycle -------------------------------------------------------------------------------------------

    def enable(self, mode: Mode) -> None:
        """Move towards operation enabled in ``mode``, from the next cycle on."""
        if mode not in self._codes:
            raise PreflightRefused(f"the drive has no {mode.value} mode", where="6502h", next_step="Use --mode speed",
                                   entry=MessageCode.NO_TORQUE_MODE)
        self._foreign_traffic.refuse_shared()
        self._wish, self._in_operation, self._ever_asked = PowerRequest.ENABLED, False, True

    def quick_stop(self) -> None:
        """Send quick stop (controlword bit 2) from the next cycle on. Enabling does not end it.

        The quick-stop option (605Ah) is restored first: another master may have set it to coasting since the last
        read-back.
        """
        if self._wish is PowerRequest.ENABLED and self._fed:
            with suppress(CommunicationLost):      # the following cycle reports it
                self._read_back.put_back(QUICK_STOP_OPTION, 0)
        self._wish = PowerRequest.QUICK_STOP

    def disable(self) -> None:
        """Move towards switch on disabled, from the next cycle on."""
        self._wish = PowerRequest.OFF

    def remove_torque(self) -> None:
        """Send disable voltage (transition 9 or 12) from the next cycle on; see `drivers.drive.RemovesTorque`."""
        self._wish, self._removes_torque = PowerRequest.OFF, True

    def reset_fault(self) -> None:
        """Reset a fault by a rising edge of controlword bit 7, by SDO, between connect and preflight.

        It needs the operator's request. Nothing is written to a drive without a fault: the low word before the edge
        would release a shaft that it holds.
        """
        if decode(self._objects.read(0x6041)) is not State.FAULT:
            return
        # The low word first gives the drive an edge from any former value.
        for word in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):
            self._objects.write(0x6040, 0, word, 16)
            self._pause()

    def exchange(self, command: Command) -> Sample:
        """Run one cycle: wait for the tick, send the setpoints and SYNC, read the feedback.

        Raises CommunicationLost (bus, heartbeat, foreign NMT command, delayed loop), DriveFault (EMCY, restart) and
        CommandRejected. Each error of the drive is raised once, so that a stop can continue to exchange.
        """
        if command.mode not in self._codes:
            raise CommandRejected(f"the drive was not prepared for {command.mode.value} mode", where="6060h")
        speed_raw = encode_speed(command.speed_rad_s, self._units, self._shape.target_speed)
        torque_raw = encode_torque(command.torque_nm, self._units)
        offset_raw = encode_torque_offset(command.torque_offset_nm, self._units)
        if self._wish is not PowerRequest.ENABLED or command.mode is not Mode.SPEED:
            offset_raw = 0
        self._ticks.wait(self._listen_after_all)
        if self._wish is not PowerRequest.ENABLED and not self._armed:
            self._link.try_again()
        # Frames that came since the last cycle are checked before this cycle's setpoint is sent.
        self._check()
        now_s = self.clock.now_s()
        self._life.feed_when_due(now_s)
        if self._standing.by_sdo or not self._fed:
            return self._exchange_without_setpoints(now_s)
        code, shown_code = self._codes[command.mode], self._reported.shown_code
        self._since_mode_sent += 1
        again = code != shown_code and self._since_mode_sent >= _REPEAT_MODE_CYCLES
        changes = code != self._sent_code or again or self._mode_overwritten
        offset = self._shape.offset
        if (changes and self._shape.mode) or offset is not None:
            self._link.send(self._rpdo2_id, self._shape.slow_setpoints(code, offset_raw))
            if offset is not None:
                self._read_back.sent(offset[0], offset_raw)
        if changes:
            self._sent_code, self._since_mode_sent, self._mode_overwritten = code, 0, False
        word = DISABLE_VOLTAGE if self._removes_torque else controlword_towards(self._reported.state, self._wish)
        self._link.send(self._rpdo1_id, self._shape.setpoints(word, torque_raw, speed_raw), self._ticks.check)
        self._read_back.sent(self._shape.target_speed[0], speed_raw)
        self._read_back.sent(0x6071, torque_raw)
        self._read_back.sent(0x6060, code)
        sample = self._finish(now_s)
        if self._wish is not PowerRequest.QUICK_STOP:
            self._read_back.step(now_s)
        elif (sample.fresh or self._others_drive) and self._standing.undone(
            now_s, self._reported.state, self._others_drive
        ):
            self._stand()
        return sample

    def _exchange_without_setpoints(self, now_s: float) -> Sample:
        """Run one cycle for a drive whose RPDOs are switched off, or that is left to its own watchdog.

        In the second case no frame is sent. In stepped time SYNC is still sent, because it advances time.
        """
        if self._fed:
            self._standing.push(self._reported.state, self._wish)
        return self._finish(now_s, self._fed or self.clock.stepped)

    @property
    def _others_drive(self) -> bool:
        """True if setpoints of another master were received under the identifiers of our RPDOs."""
        foreign = self._watch.foreign
        return any(foreign[rpdo_kind(n, 0x100 * (1 + n) + self._node)] for n in (1, 2))

    def _stand(self) -> None:
        """Send quick stop by SDO and switch all RPDOs off: another master reversed it, or the drive did not execute
        it.
        """
        done = self._standing.take_over(self._watchdog_s, self._life.feed)
        self._foreign_traffic.tell(
            f"the quick stop was reversed or not executed: {done} RPDOs were switched off, and it was sent by SDO"
        )
        self._ticks.put_off()

    def _finish(self, now_s: float, sync: bool = True) -> Sample:
        """Send SYNC and read the feedback that belongs to it."""
        feedback = self._feedback
        feedback.begin(now_s, sync=sync)
        if sync:
            self._slow.begin()
            self._link.send(SYNC, _NO_WORD, self._ticks.check)     # it is the SYNC that makes a setpoint act
        age_s = self._await_feedback(now_s)
        self._cycles += 1
        fresh = bool(feedback.data) and not self._remapped
        if not fresh:
            self._missed += 1
        self._count(fresh)
        if feedback.doubted() and self._wish is not PowerRequest.ENABLED:
            fresh = False
        if fresh:
            status, torque_raw, speed_raw = self._layout.unpack(feedback.data)
            self._reported.take(status, speed_raw, torque_raw)
            self._follow_state()
            self._follow_remote(status)
        while self._contradictions < feedback.contradictions:
            self._contradictions += 1
            self._watch.on_contradiction()
        self._ticks.check_end()
        self._check()
        hidden_s = now_s - self._shown_s
        if hidden_s > MODE_STALE_S and hidden_s > MODE_STALE_TIMES * slow_syncs(self.period_s) * self.period_s:
            self._reported.shown_code = 0      # the mode is unknown now
        counts = self._slow.counts if fresh and sync else None
        return self._sample(now_s, age_s, fresh, None if counts is None else self._turned(now_s, counts))

    def _turned(self, time_s: float, counts: float) -> float | None:
        """Return the motor's angle since the first reading, rad; None if it is unknown."""
        if self._angle is None or self._unwrapped is None:
            return None
        return self._unwrapped.take(time_s, counts * self._angle.rad_per_count)

    def _count(self, fresh: bool) -> None:
        """Detect feedback that is too rare to guard a shaft."""
        recent = self._recent
        if not (self._in_operation and self._wish is PowerRequest.ENABLED):
            recent.clear()
            return
        recent.append(fresh)
        # If no feedback comes at all, the guard's age limit and the drive's heartbeat detect it.
        if fresh and (missed := recent.count(False)) > THIN_SHARE * (recent.maxlen or 0):
            self._watch.thin_feedback(missed, len(recent), self.period_s, f"TPDO1, {self._tpdo1_id:03X}h")
            with suppress(CommunicationLost):      # for the stop that follows
                self._read_back.put_back(TPDO_COMMUNICATION, 2)

    def _check(self) -> None:
        """Raise the errors of the drive. A heartbeat that is still unread does not count as missing."""
        if self._watch.overdue:
            self._link.drain()
        self._watch.check()

    def poll(self) -> Sample | None:
        """Read status, speed, torque and angle by SDO, for a stop without cyclic feedback; None without an answer.

        After a request other than enabling, the controlword (6040h) is sent by SDO too. Raises CommunicationLost.
        """
        if self._watch.nmt_state == STOPPED:
            self._link.send(NMT, bytes((ENTER_PRE_OPERATIONAL, self._node)))
        self._life.feed()
        begun_s = self.clock.now_s()
        found = poll(self._objects, self._profile, self._watchdog_s)
        if found is None:
            return None
        if self.clock.stepped:
            keep_stepping(self._objects, self._profile, self.period_s)
        half_s = 0.5 * (self.clock.now_s() - begun_s)
        self._reported.take(found.status, found.speed, found.torque)
        self._follow_state()
        push(self._objects, self._reported.state, self._wish, self._watchdog_s, self._shape.offset)
        self._life.feed()
        position_rad = self._poll_angle()
        self._ticks.put_off()
        return self._sample(begun_s + half_s, half_s, True, position_rad)._replace(half_width_s=half_s)

    def _poll_angle(self) -> float | None:
        """Read the angle by SDO, after everything that a stop needs more urgently."""
        if self._angle is None or self._unwrapped is None:
            return None
        found = self._angle.read(self._objects, self.clock, self._watchdog_s)
        self._life.feed()
        return None if found is None else self._unwrapped.take(found.time_s, found.position_rad)

    def read_position(self) -> PositionReading | None:
        """Read the motor's angle by one SDO between two cycles; None if the drive has none or did not answer in
        time.
        """
        if self._angle is None:
            return None
        self._life.feed_when_due(self.clock.now_s())
        found = self._angle.read(self._objects, self.clock, self._watchdog_s)
        self._ticks.put_off()
        return found

    def _follow_state(self) -> None:
        """Keep a drive that left operation out of operation until it is enabled again, even if another master resets
        it.

        Some drives leave operation by a fault, some by quick stop, and some are simply off after their own watchdog has
        stopped the shaft. Quick stop keeps each of them in its state. It also does no harm to a drive that is still in
        operation, if a foreign frame reported otherwise.
        """
        if self._wish is not PowerRequest.ENABLED:
            return
        if self._reported.state is State.OPERATION_ENABLED:
            self._in_operation = True
        elif self._in_operation or self._reported.state in _OUT_OF_OPERATION:
            self._wish = PowerRequest.QUICK_STOP

    def _follow_remote(self, status: int) -> None:
        """Check bit 9 (remote) of the statusword in operation: if it was set and clears, another place took control."""
        if not (self._in_operation and self._wish is PowerRequest.ENABLED):
            self._local = 0
        elif status & REMOTE:
            self._was_remote, self._local = True, 0
        elif self._was_remote:
            self._local += 1
            if self._local == LOCAL_CYCLES:
                self._watch.interference(
                    f"the bus no longer controls the drive: bit 9 (remote) of the statusword {status:04X}h is 0",
                    f"node {self._node}, 6041h",
                    "Was the drive switched to its panel or to another fieldbus? Return control to the bus",
                    kind="remote",
                )

    def _on_nmt(self, data: bytes) -> None:
        """Handle an NMT command of another master to this drive, or to all nodes (CiA 301)."""
        if len(data) < 2 or data[1] not in (0, self._node):
            return
        name = NMT_COMMANDS.get(data[0], f"command {data[0]:02X}h")
        self._foreign_traffic.tell(f"another master sent NMT {name} to {'all nodes' if data[1] == 0 else 'the drive'}")
        state = {0x02: "stopped", ENTER_PRE_OPERATIONAL: "pre-operational"}.get(data[0])
        if state is not None and self._watch.expect_operational:       # a reset is detected by the boot-up message
            self._watch.interference(
                f"another master put the drive into NMT state {state}", f"node {self._node}",
                "Disconnect the second master from the bus, and start again", kind="nmt",
            )

    def _listen_after_all(self, tick_s: float) -> None:
        """Listen until the tick. If this loop may have been delayed, report the delay before errors found on the
        bus.
        """
        away_s = self.clock.now_s() - tick_s
        try:
            self._listen_until(tick_s)
        except CommunicationLost as error:
            if away_s <= max(STALL_S, STALL_CYCLES * self.period_s):
                raise
            raise CommunicationLost(
                f"this computer was late: its control loop stood still for {away_s:.2f} s. After that: {error.what}",
                where=f"host; {error.where}", next_step=error.next_step,
                entry=MessageCode.HOST_LATE,
            ) from error

    def _listen_until(self, tick_s: float) -> None:
        """Wait for the next tick and handle frames meanwhile. Feedback among them is late."""
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
            self._ticks.put_off()
        return age_s

    def stop_feeding(self) -> None:
        """Send no heartbeat, setpoint or controlword any more; see `drivers.drive.StopsFeeding`."""
        self._fed = False
        self._life.end()

    def remarks(self) -> tuple[str, ...]:
        """Return what other masters sent since the last call; see `drivers.drive.Telling`."""
        return self._foreign_traffic.remarks()

    def summary(self) -> tuple[str, ...]:
        """Return what other masters wrote to the drive during the whole run."""
        return self._foreign_traffic.summary()

    def keep_alive(self) -> None:
        """Send a heartbeat between two cycles, without a SYNC: in stepped time a simulated peer treats silence as a
        dead host.

        The heartbeats that are due in control time stay due.
        """
        self._life.feed_between()

    def _on_write(self, index: int, sub: int) -> None:
        """Handle a write to an object of the drive by another master."""
        self._mode_overwritten |= index == 0x6060
        self._read_back.soon(index, sub)

    def _on_changed(self, index: int, sub: int) -> None:
        """Handle a change of a supervised object by another master. A frame with a foreign mapping cannot be
        decoded.
        """
        self._remapped |= index in (TPDO_MAPPING, TPDO_MAPPING + 1)

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
        self._shown_s = self.clock.now_s()
        self._reported.take_slow(*shown)

    def _sample(self, time_s: float, age_s: float, fresh: bool, position_rad: float | None = None) -> Sample:
        return self._reported.sample(time_s, age_s, fresh, self._units, self._modes, position_rad)

    # -- afterwards ------------------------------------------------------------------------------------------

    def close(self) -> tuple[str, ...]:
        """Restore the drive's former settings and close the bus; targets stay at zero. Return what could not be
        restored.

        Settings are restored only if the drive is known to be disabled. A drive that was enabled and has shown no state
        since is not known to be. Its watchdog stays armed then, and the silence that follows triggers it.
        """
        self._watch.stop()
        left: tuple[str, ...] = ()
        state = self._reported.state
        disabled = state in _DISABLED or (state is State.NOT_READY and not self._ever_asked)
        try:
            if self._taken and disabled:
                self._link.send(NMT, bytes((ENTER_PRE_OPERATIONAL, self._node)))
                left = self._objects.restore()
        except CommunicationLost as error:
            left = (str(error),)
        finally:
            self._link.close()
        return left


def rpdo_kind(number: int, identifier: int) -> str:
    """Return the name of an RPDO of the drive, as used in messages."""
    return f"setpoints (RPDO{number}, {identifier:03X}h)"
