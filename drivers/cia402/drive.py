"""A CiA 402 drive on any bus, with the interface of `drivers.drive.Drive`.

The state machine, the modes, the units, preflight, quick stop and supervision are here. Objects and cyclic frames are
carried by a `drivers.cia402.bus.Cia402Bus`. One cycle::

    tick ─ listen ─ errors, watchdog fed ─ send(6040h 6071h 60FFh [6060h] [60B2h]) ─ receive(6041h 6077h 606Ch [6064h])

The setpoints of a cycle and its feedback belong to one instant. So a mode switch and the torque target that belongs to
it act together. If a torque offset is used (60B2h), every cycle carries it. It is zero from the cycle on in which a
stop is requested.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from drivers.angle import Unwrapped
from drivers.cia402 import preflight as checks
from drivers.cia402.bus import Cia402Bus, CycleInputs, CycleSetpoints, FeedbackSetting
from drivers.cia402.limits import QUICK_STOP_OPTION, check_parameters, note_temperature, set_limits
from drivers.cia402.polling import poll, push
from drivers.cia402.position import AngleObject, find_angle
from drivers.cia402.process_data import (
    CYCLIC_SYNCHRONOUS,
    VL_RELEASED,
    CyclicObjects,
    Units,
    cyclic_objects,
    encode_speed,
    encode_torque,
    encode_torque_offset,
)
from drivers.cia402.quick_stop import Standing
from drivers.cia402.state_machine import (
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    FAULT_RESET,
    REMOTE,
    State,
    controlword_towards,
    decode,
)
from drivers.cia402.supervision import Group, ReadBack
from drivers.clock import RATES_HZ, STALL_CYCLES, STALL_S, Ticks, how_late
from drivers.drive import (
    LEAST_CYCLES,
    LOCAL_CYCLES,
    NOT_RESTORED,
    REPEAT_MODE_CYCLES,
    Command,
    Counters,
    DriveLimits,
    Identity,
    Mode,
    PositionReading,
    PowerRequest,
    Preflight,
    Sample,
)
from drivers.errors import CommandRejected, CommunicationLost, DriveFault, PreflightRefused
from drivers.own_limits import OwnLimits
from drivers.preflight import PreflightTable
from drivers.standstill import standstill_limit_rad_s
from drivers.undo_journal import UndoJournal, left_behind
from profiles import MARKER_INDEX, MARKER_STAGE, STAGE_NUMBERS, MessageCode
from profiles.cia402 import Cia402Profile

DRIVE_SILENT_S = 0.5
"""Time without the drive's sign of life after which it counts as lost, s."""
MODE_STALE_S, MODE_STALE_TIMES = 0.5, 10
"""Time without a display, s, and number of frame periods, after which the displayed mode counts as unknown."""
THIN_S, THIN_CYCLES, THIN_SHARE = 1.0, 10, 0.5
"""Time, s, least number of cycles, and share of cycles: limit for missing feedback. If more than this share of the
cycles within this time brings no feedback, the shaft cannot be guarded. A bus that loses every tenth frame is far below
the limit."""
_DISABLED = (State.SWITCH_ON_DISABLED, State.FAULT)
_OUT_OF_OPERATION = (State.QUICK_STOP_ACTIVE, State.FAULT, State.FAULT_REACTION_ACTIVE)


@dataclass(slots=True)
class _Prepared:
    """Findings of preflight that the cycle needs."""

    content: CyclicObjects
    units: Units = field(default_factory=lambda: Units(1.0, 1.0))
    codes: dict[Mode, int] = field(default_factory=dict)
    modes: dict[int, Mode] = field(default_factory=dict)
    angle: AngleObject | None = None
    unwrapped: Unwrapped | None = None
    watchdog_s: float = 0.0
    armed: bool = True             # the drive's watchdog; true while unknown


@dataclass(slots=True)
class _Power:
    """Requested power state, and whether the drive follows."""

    wish: PowerRequest = PowerRequest.OFF
    removes_torque: bool = False
    in_operation: bool = False     # enabled, and reported as enabled since
    ever_asked: bool = False       # the drive was requested to enable at least once
    was_remote: bool = False       # bit 9 was set in operation
    local: int = 0                 # number of cycles since then without bit 9
    fed: bool = True               # the host feeds the drive's watchdog


@dataclass(slots=True)
class _ModeSent:
    """Mode of operation as sent last."""

    code: int = 0
    cycles: int = 0                # number of cycles since it was sent
    overwritten: bool = False      # by another master, since it was sent


@dataclass(slots=True)
class _Cycles:
    """Count of cycles and of cycles without feedback: since the start, and in the recent cycles."""

    recent: deque[bool]            # True for each recent cycle with feedback
    all: int = 0
    missed: int = 0
    missed_lately: int = 0         # number of recent cycles without feedback

    @classmethod
    def at(cls, period_s: float) -> _Cycles:
        """Return the count for a cycle of this period, s."""
        return cls(deque(maxlen=max(THIN_CYCLES, round(THIN_S / period_s))))

    def note(self, fresh: bool) -> None:
        """Add a cycle to the recent ones. ``fresh``: it brought feedback."""
        recent = self.recent
        if len(recent) == recent.maxlen and not recent[0]:
            self.missed_lately -= 1
        recent.append(fresh)
        if not fresh:
            self.missed_lately += 1

    def forget(self) -> None:
        """Discard the recent cycles."""
        self.recent.clear()
        self.missed_lately = 0


class Cia402Drive:
    """One drive. ``rated_torque_nm`` overrides or replaces the value that the drive reports.

    ``fixed_rate``: the rate of the bus's cycle may not be changed. ``journal`` records the settings that are changed in
    the drive, for restoring them after the host has died. In stepped time a simulated peer advances its time with each
    cycle; for a real drive it is refused.
    """

    def __init__(
        self, bus: Cia402Bus, profile: Cia402Profile, *, fixed_rate: bool = False, rated_torque_nm: float | None = None,
        journal: UndoJournal | None = None,
    ) -> None:
        self.clock = bus.clock
        self.period_s = bus.period_s
        self._bus = bus
        self._profile = profile
        self._fixed_rate = fixed_rate
        self._rated_torque_nm = rated_torque_nm
        self._journal = journal
        self._identity: Identity | None = None
        self._stage = ""               # last stage sent to a simulated peer
        self._taken = False
        self._prepared = _Prepared(cyclic_objects(profile))
        self._power = _Power()
        self._mode = _ModeSent()
        self._cycles = _Cycles.at(self.period_s)
        self._reported = bus.reported
        self._read_back = ReadBack(bus.watch, bus.ask, bus.put, bus.place)
        self._standing = Standing(bus.put, self.period_s, self._prepared.content.target_speed)
        bus.on_answer = self._read_back.take
        self._read_back.on_changed = bus.changed
        bus.on_write = self._on_write
        bus.watch.host_stood_still = self._stood_still
        bus.watch.host_late = self.host_late

    def host_late(self) -> str:
        """Return the recent delay of this computer or its adapter, in words; empty if there is none."""
        begun = list(self._bus.ticks.late_s)
        since_s = self.clock.now_s() - len(begun) * self.period_s
        # The delay of an answer replaces the delay of the start of its cycle, which is usually zero.
        answered = [self.period_s + late_s for late_s in self._bus.late_since(since_s)]
        late_s = answered + begun[: max(0, len(begun) - len(answered))]
        return self._stood_still() or how_late(late_s, self.period_s)

    def _stood_still(self) -> str:
        away_s = self._bus.ticks.stood_still_s(DRIVE_SILENT_S + self._prepared.watchdog_s)
        return f"this computer was late: its control loop stood still for {away_s:.2f} s" if away_s else ""

    @property
    def counters(self) -> Counters:
        """Errors on the bus since the start."""
        traffic, cycles = self._bus.traffic(), self._cycles
        return Counters(
            cycles.all, cycles.missed, traffic.late, self._bus.ticks.overruns,
            error_frames=traffic.error_frames, passive=traffic.passive,
            wall_offset_s=traffic.wall_offset_s, wall_jumps=traffic.wall_jumps,
        )

    # -- before motion ---------------------------------------------------------------------------------------

    def connect(self) -> Identity:
        """Find the drive, put it into pre-operational, read its identity (1018h) and the simulator's marker."""
        objects = self._bus.objects
        checks.find_free_node(objects)
        self._taken = True
        self._bus.take()
        self._identity = checks.read_identity(objects)
        if self.clock.stepped:
            checks.refuse_stepped(self._identity)
        self._bus.confirm(self._identity)
        self.announce(self._stage)
        return self._identity

    def announce(self, stage: str) -> None:
        """Send a stage of the run to a simulated peer (5FFEh:4). Nothing is sent to a real drive.

        tdhil does not wait for the answer.
        """
        self._stage = stage
        if self._identity is not None and self._identity.simulated and stage in STAGE_NUMBERS:
            self._bus.put(MARKER_INDEX, MARKER_STAGE, bytes((STAGE_NUMBERS[stage],)))

    def preflight(self, limits: DriveLimits) -> Preflight:
        """Set and read back limits, watchdog and cyclic frames. The drive is then disabled, and supervised."""
        if self._identity is None:
            raise PreflightRefused("preflight before connect", where="driver")
        table, scaling = PreflightTable(), PreflightTable()
        bus, profile, ready, objects = self._bus, self._profile, self._prepared, self._bus.objects
        ready.units, rated_nm = checks.find_units(scaling, objects, profile, self._rated_torque_nm)
        checks.check_identity(table, self._identity, profile)
        if not checks.check_state(table, objects, ready.units, profile, limits):
            return checks.report(table, self._identity, profile, objects, ready.units, rated_nm, {}, 0.0, {},
                                 checks.AngleComing())
        if self._journal is not None:
            checks.restore_from(table, objects, self._journal, self._identity)
        check_parameters(table, objects, profile)
        ready.codes = checks.choose_modes(table, objects, profile, limits.torque_offset)
        ready.modes = {code: mode for mode, code in ready.codes.items()}
        bus.interpolates = not CYCLIC_SYNCHRONOUS.isdisjoint(ready.modes)
        table.checks += scaling.checks
        ready.angle = find_angle(table, objects, profile)
        own = OwnLimits(limits.accept_wider)
        set_limits(table, objects, profile, limits, rated_nm, own)
        note_temperature(table, limits.temperature_c)
        checks.clear_targets(table, objects, profile)
        for code in ready.codes.values():
            checks.check_mode_display(table, objects, code, bus.pause)
        if limits.torque_offset:
            offset = checks.find_torque_offset(table, objects, profile, rated_nm)
            if offset is not None:
                ready.content = replace(ready.content, offset=offset[0])
                ready.units = replace(ready.units, offset_nm_per_lsb=offset[1])
        self._standing.offset = ready.content.offset
        demand = profile.torque.has_demand and objects.read_if_there(0x6074) is not None
        angle = ready.angle
        frames = bus.map_cyclic(table, ready.content, demand, None if angle is None else angle.entry)
        ready.unwrapped = None if angle is None else angle.unwrapped(limits.speed_rad_s)
        ready.watchdog_s = limits.watchdog_s
        ready.armed = bus.arm(table, limits) > 0.0
        watchdog_s = limits.watchdog_s if ready.armed else 0.0
        found = checks.report(table, self._identity, profile, objects, ready.units, rated_nm, ready.codes, watchdog_s,
                              own.kept, self._angle_coming())
        self._watch_settings(watchdog_s, frames)
        self._start()
        return found

    def _angle_coming(self) -> checks.AngleComing:
        """Return how the motor's angle arrives, at any rate that this drive may get."""
        angle, unwrapped = self._prepared.angle, self._prepared.unwrapped
        if angle is None or unwrapped is None:
            return checks.AngleComing()
        periods_s = (self.period_s, *(1.0 / rate for rate in self.rates_hz))
        apart_s = max(self._bus.intervals_s(one)[1] for one in periods_s)
        gap_s = unwrapped.longest_gap_s
        comes = self._bus.angle_mapped and apart_s <= gap_s
        return checks.AngleComing(angle.rad_per_count, apart_s if comes else None, gap_s)

    @property
    def rates_hz(self) -> tuple[float, ...]:
        """The profile's rate and lower ones; none in stepped time, or if a rate was given."""
        if self._fixed_rate or self.clock.stepped:
            return ()
        highest, lowest = self._profile.cyclic.rate_hz, LEAST_CYCLES / (self._prepared.watchdog_s or math.inf)
        return (highest, *(rate for rate in RATES_HZ if lowest <= rate < highest))

    @property
    def began_late_s(self) -> float:
        """Delay of the start of the last cycle, s."""
        late_s = self._bus.ticks.late_s
        return late_s[-1] if late_s else 0.0

    def set_rate(self, rate_hz: float, *, measuring: bool = False) -> None:
        """Change the rate after preflight and before the drive is enabled.

        With ``measuring`` a delayed loop is no error, because nothing can move.
        """
        self.period_s = round(1e6 / rate_hz) * 1e-6
        for index, sub, data in self._bus.set_period(self.period_s):
            self._read_back.stands(index, sub, data)
        self._standing.set_period(self.period_s)
        self._cycles = _Cycles.at(self.period_s)
        self._start(0.0 if measuring else 0.5)

    def _watch_settings(self, watchdog_s: float, frames: Sequence[FeedbackSetting]) -> None:
        """List the settings that preflight made or relied on, for reading them back during motion."""
        watchdog, back, content = self._profile.watchdog, self._read_back, self._prepared.content
        back.clear()
        reaction = watchdog.reaction_index, watchdog.reaction_sub
        for (index, sub), data in self._bus.objects.stands.items():
            ours = self._bus.setting(index)
            if (index, sub) == reaction:
                if watchdog_s:
                    back.watch("the watchdog's reaction", index, sub, data, Group.SAFETY)
            elif ours is not None:
                title, group = ours
                if title:
                    back.watch(title, index, sub, data, group)
            elif index == QUICK_STOP_OPTION:
                back.watch("the quick-stop option", index, sub, data, Group.SAFETY)
            elif index not in (0x6060, MARKER_INDEX):
                back.watch("the drive's own limit", index, sub, data, Group.REST)
        for (index, sub), (title, data) in self._bus.objects.relied_on.items():
            if (index, sub) not in self._bus.objects.stands:
                back.watch(title, index, sub, data, Group.REST, ours=False)
        for one in frames:
            back.watch(*one, Group.FEEDBACK)
        back.watch_setpoint("the target velocity", content.target_speed[0])
        if content.target_torque:
            back.watch_setpoint("the target torque", 0x6071)
        if content.mode:
            back.watch_setpoint("the mode of operation", 0x6060)
        if content.offset is not None and content.offset[1] == 0:
            back.watch_setpoint("the torque offset", content.offset[0])

    def _start(self, stall_share: float = 0.5) -> None:
        """Start the cycle and the supervision. A delay above this share of the watchdog's time is an error."""
        bus = self._bus
        try:
            bus.watch.check()          # nothing moves yet: an error becomes a refusal
        except CommunicationLost as error:
            raise PreflightRefused(error.what, where=error.where, next_step=error.next_step,
                                   entry=MessageCode.NO_FEEDBACK) from error
        bus.start()
        bus.ticks = Ticks(self.clock, self.period_s, stall_share * self._prepared.watchdog_s)
        self._reported.shown_s = self.clock.now_s()

    # -- the cycle -------------------------------------------------------------------------------------------

    def enable(self, mode: Mode) -> None:
        """Move towards operation enabled in ``mode``, from the next cycle on."""
        if mode not in self._prepared.codes:
            raise PreflightRefused(f"the drive has no {mode.value} mode", where="6502h", next_step="Use --mode speed",
                                   entry=MessageCode.NO_TORQUE_MODE)
        self._bus.refuse_motion()
        power = self._power
        power.in_operation, power.ever_asked = False, True
        self._request(PowerRequest.ENABLED)

    def quick_stop(self) -> None:
        """Send quick stop (controlword bit 2) from the next cycle on. Enabling does not end it.

        The quick-stop option (605Ah) is restored first: another master may have set it to coasting since the last
        read-back.
        """
        if self._power.wish is PowerRequest.ENABLED and self._power.fed:
            with suppress(CommunicationLost):      # the following cycle reports it
                self._read_back.put_back(QUICK_STOP_OPTION, 0)
        self._request(PowerRequest.QUICK_STOP)

    def disable(self) -> None:
        """Move towards switch on disabled, from the next cycle on."""
        self._request(PowerRequest.OFF)

    def remove_torque(self) -> None:
        """Send disable voltage (transition 9 or 12) from the next cycle on; see `drivers.drive.RemovesTorque`."""
        self._power.removes_torque = True
        self._request(PowerRequest.OFF)

    def _request(self, wish: PowerRequest) -> None:
        self._power.wish = wish
        self._bus.hurry(wish is not PowerRequest.ENABLED)

    def reset_fault(self) -> None:
        """Reset a fault by a rising edge of controlword bit 7, as an object, between connect and preflight.

        It needs the operator's request. Nothing is written to a drive without a fault: the low word before the edge
        would release a shaft that it holds.
        """
        objects = self._bus.objects
        if decode(objects.read(0x6041)) is not State.FAULT:
            return
        # The low word first gives the drive an edge from any former value.
        for word in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):
            objects.write(0x6040, 0, word, 16)
            self._bus.pause()

    def exchange(self, command: Command) -> Sample:
        """Run one cycle: wait for the tick, send the setpoints, read the feedback.

        Raises CommunicationLost (bus, sign of life, another master, delayed loop), DriveFault (emergency, restart) and
        CommandRejected. Each error of the drive is raised once, so that a stop can continue to exchange.
        """
        ready, power, bus, back = self._prepared, self._power, self._bus, self._read_back
        units, content, reported = ready.units, ready.content, self._reported
        mode_asked, speed_rad_s, torque_nm, offset_nm = command
        code = ready.codes.get(mode_asked)
        if code is None:
            raise CommandRejected(f"the drive was not prepared for {mode_asked.value} mode", where="6060h")
        target_speed = content.target_speed
        speed_raw = encode_speed(speed_rad_s, units, target_speed)
        torque_raw = encode_torque(torque_nm, units)
        offset_raw = encode_torque_offset(offset_nm, units)
        enabled = power.wish is PowerRequest.ENABLED
        if not enabled or mode_asked is not Mode.SPEED:
            offset_raw = 0
        bus.ticks.wait(self._listen)
        # Frames that came since the last cycle are checked before this cycle's setpoint is sent.
        now_s = bus.begin(not enabled and not ready.armed)
        if self._standing.by_object or not power.fed:
            # The cyclic setpoints are disabled, or the drive is left to its own watchdog. In the second case no cyclic
            # frame is sent. In stepped time the cycle is still started, because it advances time.
            fed = power.fed
            if fed:
                self._push_object()
            sample = self._judge(now_s, bus.receive(now_s, fed or self.clock.stepped))
            if not fed and self._may_disable_unfed(sample):
                self._push_object()        # an object feeds no watchdog
            return sample
        mode = self._mode
        mode.cycles += 1
        again = code != reported.shown_code and mode.cycles >= REPEAT_MODE_CYCLES
        changes = code != mode.code or again or mode.overwritten
        word = controlword_towards(reported.state, power.wish, removes_torque=power.removes_torque)
        if content.vl and word == ENABLE_OPERATION:    # in vl mode the setpoint acts only with bits 4 to 6 set
            word |= VL_RELEASED
        # Recorded before they are sent: an answer in this cycle may show them.
        if content.offset is not None:
            back.sent(content.offset[0], offset_raw)
        back.sent(target_speed[0], speed_raw)
        back.sent(0x6071, torque_raw)
        back.sent(0x6060, code)
        bus.send(CycleSetpoints(word, torque_raw, speed_raw, code, offset_raw, changes))
        if changes:
            mode.code, mode.cycles, mode.overwritten = code, 0, False
        sample = self._judge(now_s, bus.receive(now_s, True))
        if power.wish is not PowerRequest.QUICK_STOP:
            back.step(now_s)
        elif (sample.fresh or bus.others_drive) and self._standing.undone(now_s, reported.state, bus.others_drive):
            self._stand()
        return sample

    def _push_object(self) -> None:
        """Send one object towards the request, without waiting for the answer."""
        power = self._power
        self._standing.push(self._reported.state, power.wish, removes_torque=power.removes_torque)

    def _may_disable_unfed(self, sample: Sample) -> bool:
        """Return whether to disable a drive that is left to its watchdog: at standstill, or to remove its torque.

        A shaft that still turns is left to the reaction of the watchdog: without torque it would coast.
        """
        power = self._power
        if power.wish is not PowerRequest.OFF or not sample.fresh:
            return False
        limit_rad_s = standstill_limit_rad_s(self._prepared.units.speed_rad_s_per_lsb)
        return power.removes_torque or abs(sample.speed_rad_s) <= limit_rad_s

    def _stand(self) -> None:
        """Write quick stop as an object and disable all cyclic setpoints, because another master reversed the quick
        stop or the drive did not execute it.
        """
        self._standing.by_object = True
        done = self._bus.disable_setpoints()
        self._bus.watch.remark(
            f"the quick stop was reversed or not executed: {done} RPDOs were switched off, and it was sent by SDO"
        )
        self._bus.ticks.put_off()

    def _judge(self, now_s: float, inputs: CycleInputs) -> Sample:
        """Follow the drive's state by the feedback of this cycle, and raise its errors. Return the sample."""
        reported, bus, cycles = self._reported, self._bus, self._cycles
        fresh = inputs.fresh
        cycles.all += 1
        if not fresh:
            cycles.missed += 1
        self._count(fresh)
        if inputs.doubted and self._power.wish is not PowerRequest.ENABLED:
            fresh = False
        if fresh:
            status = inputs.status
            reported.take(status, inputs.speed, inputs.torque)
            self._follow_state()
            self._follow_remote(status)
        bus.ticks.check_end()
        bus.check()
        hidden_s = now_s - reported.shown_s
        if hidden_s > MODE_STALE_S and hidden_s > MODE_STALE_TIMES * bus.intervals_s(self.period_s)[0]:
            reported.shown_code = 0    # the mode is unknown now
        angle = inputs.angle if fresh else None
        position_rad = None if angle is None else self._turned(now_s, angle)
        ready = self._prepared
        return reported.sample(now_s, inputs.age_s, fresh, ready.units, ready.modes, position_rad)

    def _turned(self, time_s: float, counts: float) -> float | None:
        """Return the motor's angle since the first reading, rad; None if it is unknown."""
        angle, unwrapped = self._prepared.angle, self._prepared.unwrapped
        if angle is None or unwrapped is None:
            return None
        return unwrapped.take(time_s, counts * angle.rad_per_count)

    def _count(self, fresh: bool) -> None:
        """Detect feedback that is too rare to guard a shaft."""
        cycles = self._cycles
        if not (self._power.in_operation and self._power.wish is PowerRequest.ENABLED):
            cycles.forget()
            return
        cycles.note(fresh)
        recent, missed = cycles.recent, cycles.missed_lately
        # If no feedback comes at all, the guard's age limit and the drive's sign of life detect it.
        if fresh and missed and missed > THIN_SHARE * (recent.maxlen or 0):
            self._bus.watch.thin_feedback(missed, len(recent), self.period_s, self._bus.feedback_place)
            if (timing := self._bus.feedback_timing) is not None:
                with suppress(CommunicationLost):      # restores the feedback for the stop that follows
                    self._read_back.put_back(*timing)

    def _listen(self, tick_s: float) -> None:
        """Listen until the tick. If this loop may have been delayed, report the delay before errors found on the
        bus. In a stop an error does not keep the cycle's frame from the drive: reading the feedback raises it again.
        """
        away_s = self.clock.now_s() - tick_s
        try:
            self._bus.listen_until(tick_s)
        except CommunicationLost as error:
            if self._power.wish is not PowerRequest.ENABLED:
                self.clock.wait_until(tick_s)
                return
            if away_s <= max(STALL_S, STALL_CYCLES * self.period_s):
                raise
            raise CommunicationLost(
                f"this computer was late: its control loop stood still for {away_s:.2f} s. After that: {error.what}",
                where=f"host; {error.where}", next_step=error.next_step,
                entry=MessageCode.HOST_LATE,
            ) from error

    def _follow_state(self) -> None:
        """Keep a drive that left operation out of operation until it is enabled again, even if another master resets
        it.

        Some drives leave operation by a fault, some by quick stop, and some are simply off after their own watchdog has
        stopped the shaft. Quick stop keeps each of them in its state. It also does no harm to a drive that is still in
        operation, if a foreign frame reported otherwise.
        """
        power, state = self._power, self._reported.state
        if power.wish is not PowerRequest.ENABLED:
            return
        if state is State.OPERATION_ENABLED:
            power.in_operation = True
        elif power.in_operation or state in _OUT_OF_OPERATION:
            self._request(PowerRequest.QUICK_STOP)

    def _follow_remote(self, status: int) -> None:
        """Check bit 9 (remote) of the statusword in operation: if it was set and clears, another place took control."""
        power = self._power
        if not (power.in_operation and power.wish is PowerRequest.ENABLED):
            power.local = 0
        elif status & REMOTE:
            power.was_remote, power.local = True, 0
        elif power.was_remote:
            power.local += 1
            if power.local == LOCAL_CYCLES:     # statusword, bit 9
                self._bus.watch.interference(
                    f"the bus no longer controls the drive: bit 9 (remote) of the statusword {status:04X}h is 0",
                    f"{self._bus.place}, 6041h",
                    "Was the drive switched to its panel or to another fieldbus? Return control to the bus",
                    kind="remote",
                )

    # -- beside the cycle ------------------------------------------------------------------------------------

    def poll(self) -> Sample | None:
        """Read status, speed, torque and angle as objects, for a stop without cyclic feedback; None without an answer.

        After a request other than enabling, the controlword (6040h) is written too: a quick stop before the reading,
        which may fail, and each step towards off after it, because it depends on the state. Raises CommunicationLost.
        """
        bus, watchdog_s = self._bus, self._prepared.watchdog_s
        bus.reach()
        stopped = self._power.wish is PowerRequest.QUICK_STOP and self._reported.since_start and self._push()
        begun_s = self.clock.now_s()
        found = poll(bus.objects, self._profile, watchdog_s)
        if found is None:
            return None
        if self.clock.stepped:
            bus.keep_stepping()
        half_s = 0.5 * (self.clock.now_s() - begun_s)
        self._reported.take(found.status, found.speed, found.torque)
        self._follow_state()
        if not stopped:
            self._push()
        bus.feed()
        # The angle comes after everything that a stop needs more urgently.
        position_rad, angle, unwrapped = None, self._prepared.angle, self._prepared.unwrapped
        if angle is not None and unwrapped is not None:
            turned = angle.read(bus.objects, self.clock, watchdog_s)
            bus.feed()
            position_rad = None if turned is None else unwrapped.take(turned.time_s, turned.position_rad)
        bus.ticks.put_off()
        return self._sample(begun_s + half_s, half_s, True, position_rad)._replace(half_width_s=half_s)

    def _push(self) -> bool:
        """Write the controlword towards the request as an object. Return False if the reported state needs none."""
        ready, power = self._prepared, self._power
        return push(self._bus.objects, self._reported.state, power.wish, ready.watchdog_s, ready.content.offset,
                    removes_torque=power.removes_torque)

    def read_position(self) -> PositionReading | None:
        """Read the motor's angle as an object between two cycles; None if the drive has none or did not answer in
        time.
        """
        angle = self._prepared.angle
        if angle is None:
            return None
        self._bus.feed_when_due(self.clock.now_s())
        found = angle.read(self._bus.objects, self.clock, self._prepared.watchdog_s)
        self._bus.ticks.put_off()
        return found

    def stop_feeding(self) -> None:
        """Send no sign of life or setpoint any more; see `drivers.drive.StopsFeeding`.

        The controlword is sent as an object only, to disable the drive; an object feeds no watchdog.
        """
        self._power.fed = False
        self._bus.stop_feeding()

    def remarks(self) -> tuple[str, ...]:
        """Return remarks on foreign traffic since the last call; see `drivers.drive.ReportsOthers`."""
        return self._bus.watch.remarks()

    def summary(self) -> tuple[str, ...]:
        """Return remarks on the writes of other masters to the drive during the whole run."""
        return self._bus.summary()

    def keep_alive(self) -> None:
        """Feed the watchdog between two cycles: in stepped time a simulated peer treats silence as a dead host.

        The time at which the next sign of life is due does not change.
        """
        self._bus.feed_between()

    def _on_write(self, index: int, sub: int) -> None:
        """Handle a write to an object of the drive by another master."""
        self._mode.overwritten |= index == 0x6060
        self._read_back.soon(index, sub)

    def _sample(self, time_s: float, age_s: float, fresh: bool, position_rad: float | None = None) -> Sample:
        ready = self._prepared
        return self._reported.sample(time_s, age_s, fresh, ready.units, ready.modes, position_rad)

    # -- afterwards ------------------------------------------------------------------------------------------

    def close(self) -> tuple[str, ...]:
        """Restore the drive's former settings and close the bus; targets stay at zero. Return what could not be
        restored.

        Settings are restored only if the drive is known to be disabled. A drive that was enabled and has shown no state
        since is not known to be. Its watchdog stays armed then, and the silence that follows triggers it.
        """
        self._bus.watch.stop()
        left: tuple[str, ...] = ()
        objects, state = self._bus.objects, self._reported.state
        disabled = state in _DISABLED or (state is State.NOT_READY and not self._power.ever_asked)
        try:
            if self._taken and disabled:
                self._bus.release()
                left = objects.restore()
            elif self._taken:
                left = tuple(f"{one}: {NOT_RESTORED}" for one in objects.changed)
        except (CommunicationLost, DriveFault) as error:
            left = (left_behind(objects.changed, error),)
        finally:
            self._bus.close()
        return left
