"""A drive on Modbus, with the interface of `drivers.drive.Drive`.

One cycle, sent by this loop and nothing else::

    tick ─ setpoints (─ control word) ─ read status, speed, torque   (one transaction where the drive has function 23)

The time of a sample is the middle of the transactions that brought speed and torque, with half their duration as
uncertainty. The next cycle retries a cycle without a valid reply, with fresh setpoints. Without a valid reply for half
of the drive's watchdog time the drive counts as lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress

from drivers.angle import Unwrapped
from drivers.clock import Ticks
from drivers.drive import (
    LOCAL_CYCLES,
    NOT_RESTORED,
    REPEAT_MODE_CYCLES,
    Command,
    Counters,
    DriveLimits,
    FrameTap,
    Identity,
    Mode,
    Outcome,
    PositionReading,
    PowerRequest,
    PowerState,
    Preflight,
    Sample,
)
from drivers.errors import CommandRejected, CommunicationLost, DriveFault, PreflightRefused
from drivers.modbus import preflight as checks
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import Scales, register_name
from drivers.modbus.cycle import (
    Codec,
    CycleFeedback,
    Round,
    Setpoints,
    Transaction,
    go_round,
    only_reads,
    plan_cycle,
    shown_mode,
)
from drivers.modbus.identity import read_marker, refuse_if_driven, refuse_unless_stepped, tell_stage
from drivers.modbus.link import Link, late_replies
from drivers.modbus.other_master import OtherMaster
from drivers.modbus.parameters import find_filters, find_speed_loop, own_speed_limits, read_parameters, set_limits
from drivers.modbus.pdu import BUSY, CycleRefused, LinkLost, RegisterRefused
from drivers.modbus.position import AngleRegister, find_angle
from drivers.modbus.preflight import check_setpoints, clear_setpoints
from drivers.modbus.state_machine import (
    ZeroSpeed,
    controlword_towards,
    decode,
    decode_after,
    power_state,
    seen,
)
from drivers.modbus.temperature import Heat
from drivers.modbus.watchdog import arm_watchdog, check_who_feeds, measure_pace
from drivers.own_limits import SPEED, TORQUE, OwnLimits
from drivers.preflight import PreflightTable
from drivers.undo_journal import UndoJournal, left_behind
from profiles import MessageCode
from profiles.modbus import ModbusProfile, Register, StatusState

READ_MODE_CYCLES = 20
"""Number of cycles between two readings of the mode display, if they need a transaction of their own."""
RESET_PAUSE_S = 0.1
"""Pause between the words of a fault reset, s: some drives read their field bus only every few ten milliseconds."""
BUDGET_SHARE = 0.5
"""Share of the watchdog time for which a valid reply may be missing, or this loop may be delayed."""

SETTLED_CYCLES = 5
"""Number of cycles without an enabled drive. If the drive is enabled after them, another master enabled it."""
INSIST_SHARE = 0.8
"""Share of a period in which the words of the stop are repeated against another master."""
SILENT_TIMES = 1.5
"""Multiple of the watchdog's time without any read, if reading feeds the watchdog that must trip."""

PRESS_EVERY_S = 0.1
"""Interval at which the drive's own speed limit is lowered against another master, s."""

_NO_SETPOINTS = Setpoints(0, 0, False)
_NOTHING_YET = CycleFeedback(0, 0.0, 0.0, None, None)
_DRIVEN = (PowerState.ENABLED, PowerState.QUICK_STOP)
_MAY_DRIVE = (PowerState.ENABLED, PowerState.UNKNOWN)
_NOT_DRIVEN = (PowerState.OFF, PowerState.FAULT)
_NONE_YET = (PowerState.NOT_READY, PowerState.UNKNOWN)


class ModbusDrive:
    """One unit on a link.

    ``rated_torque_nm`` replaces a value that the drive does not report. ``given`` holds the values of parameters that
    can't be read over the bus (in the profile's units). ``tap`` gets every PDU. ``journal`` records the settings that
    are changed in the drive, for restoring them after the host has died.
    """

    def __init__(
        self,
        link: Link,
        profile: ModbusProfile,
        *,
        unit: int,
        rate_hz: float | None = None,
        rated_torque_nm: float | None = None,
        given: Mapping[str, float] | None = None,
        tap: FrameTap | None = None,
        journal: UndoJournal | None = None,
    ) -> None:
        self.clock = link.clock
        self._journal = journal
        self._asked_hz = rate_hz or profile.cycle.rate_hz
        self.period_s = round(1e6 / self._asked_hz) * 1e-6
        self._link = link
        self._profile = profile
        self._access = RegisterAccess(link, unit, profile.line.word_order, frozenset(profile.cycle.functions), tap)
        self._where = f"{link.description}, unit {unit}"
        self._rated_torque_nm = rated_torque_nm
        self._given = dict(given or {})
        self._plan = plan_cycle(profile)
        self._reads = only_reads(self._plan.cycle, frozenset(profile.cycle.functions))
        self._moving = (profile.cycle.speed.register_, profile.cycle.torque.register_)
        self._codec = Codec(profile, Scales(1.0, 1.0, 1.0, 1.0, 1.0), has_demand=self._plan.has_demand)
        self._standstill = ZeroSpeed(1.0, 1.0, self.period_s)
        self._identity: Identity | None = None
        self._stage = ""               # latest stage sent to a simulated peer
        self._modes: frozenset[Mode] = frozenset()
        self._watchdog_s = self._timeout_s = 0.0
        self._angle: AngleRegister | None = None
        self._unwrapped: Unwrapped | None = None
        self._wish = PowerRequest.OFF
        self._was_enabled = self._told_fault = self._reverse = self._at_rest = self._removes_torque = False
        self._ever_asked = False       # the drive was requested to enable at least once
        self._ever_enabled = False     # the drive was reported as enabled at least once
        self._was_remote, self._local = False, 0       # the bus had control; cycles since then without
        self._state: StatusState | None = None
        self._feedback = _NOTHING_YET
        self._shown: Mode | None = None
        self._sent_mode = Mode.SPEED
        self._since_mode_sent = self._since_mode_read = 0
        self._writes_mode = False
        self._failing_since_s: float | None = None
        self._told_loss = self._told_other = False
        self._out_of_operation = 0     # cycles without operation since this run last requested it
        self._heat = Heat(self._access, profile)
        self._other = OtherMaster(self._access, profile, self._plan)
        self._speed_limits: list[tuple[Register, float, int]] = []      # register, rad/s a count, counts as found
        self._quick_stop_rad_s2 = self._pressed_rad_s = 0.0
        self._pressed_s: float | None = None
        self._silent_since_s: float | None = None       # since when feeding has ended, to let the watchdog trip
        self._ticks = Ticks(self.clock, self.period_s)
        self._cycles = self._missed = self._late_before = 0

    @property
    def counters(self) -> Counters:
        """Errors on the line since the start."""
        late = late_replies(self._link) - self._late_before
        return Counters(self._cycles, self._missed, late, self._ticks.overruns)

    # -- before motion ---------------------------------------------------------------------------------------

    def connect(self) -> Identity:
        """Find the drive and detect whether it is simulated. Writes nothing."""
        refuse_if_driven(self._access, self._profile, self._where)
        marker = read_marker(self._access)
        if self.clock.stepped:
            refuse_unless_stepped(marker)
        self._identity = Identity(0, 0, 0, 0, self._profile.title, marker.simulated)
        self.announce(self._stage)
        return self._identity

    def announce(self, stage: str) -> None:
        """Send a stage of the run to a simulated peer. Nothing is sent to a real drive."""
        self._stage = stage
        if self._identity is not None and self._identity.simulated:
            tell_stage(self._access, stage)

    def preflight(self, limits: DriveLimits) -> Preflight:
        """Check, set and read back. The drive is then disabled, with setpoints of zero, and supervised."""
        if self._identity is None:
            raise PreflightRefused("preflight before connect", where="driver")
        table, access, profile = PreflightTable(), self._access, self._profile
        table.note("identity", f"not reported over Modbus; --profile states {profile.name}", self._where)
        if limits.torque_offset:
            table.row(
                "torque offset", "there", f"profile {profile.name} names no register that adds a torque", False,
                self._where, "The drive's own impedance can be measured from its reference (--impedance reference)",
            )
        found, scales, rated_nm = checks.read_only_checks(
            table, access, profile, self._given, self._rated_torque_nm, limits)
        watched, shared = True, False
        own = OwnLimits(limits.accept_wider)
        filters = find_filters(table, profile, found)
        speed_loop = find_speed_loop(table, profile, found, simulated=self._identity.simulated)
        if scales is not None and clear_setpoints(table, access, profile, self._off_word()):
            if self._journal is not None and access.restore_from(table, self._journal, self._identity):
                # The limits read above were those of the dead run.
                found = read_parameters(PreflightTable(), access, profile, self._given)
            set_limits(table, access, profile, limits, rated_nm, found, own)
            self._angle = find_angle(table, access, profile)
            if self._angle is not None:
                self._unwrapped = Unwrapped(self._angle.wraps_rad, limits.speed_rad_s)
            self._plan = plan_cycle(profile, position=self._angle is not None)
            self._reads = only_reads(self._plan.cycle, frozenset(profile.cycle.functions))
            self._codec = Codec(
                profile, scales, has_demand=self._plan.has_demand, has_position=self._plan.has_position
            )
            read_back = check_setpoints(table, access, profile, scales, rated_nm, found.values, limits)
            checks.check_modes(table, access, profile)
            pace = measure_pace(
                table, self._link.description, self._asked_hz, limits.watchdog_s,
                "; ".join(map(str, self._plan.cycle)), self._idle_round, self.clock.now_s,
            )
            self.period_s, self._timeout_s = pace.period_s, pace.timeout_s
            watched = arm_watchdog(
                table, access, profile, limits, rated_nm, found, self.period_s, self._idle_round
            )
            if watched:
                simulated = self._identity.simulated
                shared = check_who_feeds(table, access, profile, limits, self._idle_round, simulated=simulated)
            self._heat.prepare(table, limits.temperature_c)
            self._speed_limits = own_speed_limits(profile, found)
            if all(check.outcome is not Outcome.REFUSED for check in table.checks):
                self._other.prepare(
                    read_back, found.values, rated_nm, self.period_s, pace.usual_s, len(self._plan.cycle),
                    self._idle_round,
                )
            self._watchdog_s, self._quick_stop_rad_s2 = limits.watchdog_s, limits.quick_stop_rad_s2
            self._modes = frozenset(Mode) if profile.modes.torque else frozenset((Mode.SPEED,))
        scales = self._codec.scales
        self._standstill = ZeroSpeed(scales.speed, limits.standstill_scale_rad_s, self.period_s)
        self._ticks = Ticks(self.clock, self.period_s, BUDGET_SHARE * self._watchdog_s)
        self._late_before = late_replies(self._link)
        target = profile.cycle.torque_setpoint
        gap_s = math.inf if self._unwrapped is None else self._unwrapped.longest_gap_s
        return Preflight(
            identity=self._identity,
            checks=tuple(table.checks),
            modes=self._modes,
            switch_while_enabled=profile.modes.switch_while_enabled,
            quick_stop_in_torque_mode=profile.quick_stop.decelerates_in_torque_mode,
            rated_torque_nm=rated_nm,
            torque_resolution_nm=scales.torque,
            speed_resolution_rad_s=scales.speed,
            watchdog_s=limits.watchdog_s if watched else 0.0,
            safe_action=profile.watchdog.reaction if watched else "none",
            filters=filters,
            speed_loop=speed_loop,
            torque_setpoint=register_name(target.register_) if target is not None else "none",
            quick_stop_holds=profile.quick_stop.ends == "quick_stop",
            kept_torque_nm=own.kept.get(TORQUE),
            kept_speed_rad_s=own.kept.get(SPEED),
            fed_by_any_client=shared,
            position_resolution_rad=0.0 if self._angle is None else self._angle.rad_per_count,
            position_period_s=self.period_s if self._plan.has_position and self.period_s <= gap_s else None,
            position_gap_s=gap_s,
        )

    def _off_word(self) -> int:
        return controlword_towards(self._profile.control, None, PowerRequest.OFF, Mode.SPEED)

    def _idle_round(self) -> Round:
        """Run a whole cycle without a request: disabled, setpoints of zero; with the mode display's own read."""
        image = self._codec.image(self._off_word(), _NO_SETPOINTS, Mode.SPEED)
        return go_round(self._access, (*self._plan.cycle, *self._plan.mode_reads), image, 1.0, self._moving)

    # -- the cycle -------------------------------------------------------------------------------------------

    def enable(self, mode: Mode) -> None:
        """Move towards operation enabled in ``mode``, from the next cycle on."""
        if mode not in self._modes:
            raise PreflightRefused(
                f"the drive has no {mode.value} mode, or was not prepared for it", where="profile, modes",
                next_step="Use --mode speed",
                entry=MessageCode.NO_TORQUE_MODE,
            )
        self._wish, self._was_enabled, self._told_fault = PowerRequest.ENABLED, False, False
        self._ever_asked = True

    def quick_stop(self) -> None:
        """Send the profile's quick-stop word from the next cycle on. Enabling does not end it."""
        self._wish = PowerRequest.QUICK_STOP

    def stop_feeding(self) -> None:
        """Stop feeding the watchdog; see `drivers.drive.StopsFeeding`. If reading feeds it, nothing is sent until it
        tripped.

        Raises CommandRejected if another master commands the drive and feeds the watchdog too. Silence would leave the
        shaft to that master, so the quick stop is repeated.
        """
        if self._other.seen and not self._profile.watchdog.fed_by_us_alone:
            raise CommandRejected(
                "the other master also feeds the drive's watchdog, so the watchdog would not act if tdhil fell silent. "
                "tdhil repeats the quick stop as fast as the line allows", where=self._where,
                next_step="Use the hard-wired emergency stop, and disconnect the other master",
            )
        if self._silent_since_s is None:
            self._silent_since_s = self.clock.now_s()

    def disable(self) -> None:
        """Move towards off from the next cycle on. A shaft that turns under power is braked first."""
        self._wish = PowerRequest.OFF

    def remove_torque(self) -> None:
        """Move towards off from the next cycle on at any reported speed; see `drivers.drive.RemovesTorque`."""
        self._wish, self._removes_torque = PowerRequest.OFF, True

    def reset_fault(self) -> None:
        """Write the profile's reset words one after the other, between connect and preflight, at the operator's
        request.

        Nothing is written to a drive without a fault: such words could release a shaft that it holds.
        """
        control = self._profile.control
        status = self._access.read(self._profile.cycle.status.register_) & 0xFFFF
        if power_state(decode(control, status)) is not PowerState.FAULT:
            return
        for word in control.fault_reset:
            if control.fault_reset_register is not None:
                self._access.write(control.fault_reset_register, word)
            else:
                self._access.write(self._profile.cycle.control.register_, word | control.speed_bits)
            self.clock.wait_until(self.clock.now_s() + RESET_PAUSE_S)

    def exchange(self, command: Command) -> Sample:
        """Run one cycle: wait for the tick, write, read.

        Raises CommunicationLost (no valid reply within half the watchdog time, line lost, delayed loop, another master
        that commands the drive or changes its settings), LimitHit (temperature), DriveFault (fault state, a refused
        request) and CommandRejected. Each error of the drive is raised once, so that a stop can continue to exchange.
        """
        if command.mode not in self._modes:
            raise CommandRejected(f"the drive was not prepared for {command.mode.value} mode", where="driver")
        setpoints = self._codec.setpoints(command)
        self._unless_frozen(self._ticks.wait)
        if setpoints.speed:
            self._reverse = setpoints.reverse       # a setpoint of zero keeps the direction of the shaft that brakes
        # After feeding has ended nothing is written, except to disable a shaft at a safe standstill, or to remove the
        # torque of a shaft that accelerates: the drive's watchdog would brake with the same wrong sign.
        at_rest = self._at_rest and power_state(self._state) not in _MAY_DRIVE
        off = self._wish is PowerRequest.OFF and (at_rest or self._removes_torque)
        if self._silent_since_s is not None and not off:
            return self._watch()
        self._poll_other_masters()
        if self._wish is PowerRequest.ENABLED:
            self._heat.poll(self._timeout_s)
        word = self._word(command.mode)
        image = self._codec.image(word, setpoints, command.mode)
        self._unless_frozen(self._ticks.check)
        self._other.sent(image)
        begun_s = self.clock.now_s()
        self._cycles += 1
        try:
            got = go_round(
                self._access, self._transactions(command.mode), image, self._timeout_s, self._moving,
                begun_s + self.period_s, every_write=self._wish is not PowerRequest.ENABLED,
            )
        except (CommunicationLost, RegisterRefused) as error:
            self._missed += 1
            self._ticks.done()
            self._at_rest = False
            self._standstill.gap()
            self._fail(error, begun_s)
            return self._sample(begun_s, self.clock.now_s() - begun_s, 0.0, fresh=False)
        self._ticks.done()
        self._failing_since_s, self._told_loss = None, False
        if self._writes_mode:          # known only now: a round that failed may have written no mode
            self._sent_mode, self._since_mode_sent = command.mode, 0
        self._take(self._codec.feedback(got.words), command.mode)
        if self._other.seen and self._wish is not PowerRequest.ENABLED:
            got = self._insist(got, setpoints, command.mode, begun_s)
        self._follow_state()
        if self._wish is PowerRequest.ENABLED:
            self._heat.see(self._feedback.status)
        half_s = 0.5 * (got.received_s - got.sent_s)
        return self._sample(got.sent_s + half_s, half_s, half_s, fresh=True)

    def _poll_other_masters(self) -> None:
        """Check for another master. Raises CommunicationLost once; the stop that follows continues to exchange."""
        if self._other.seen and self._wish is not PowerRequest.ENABLED:
            return                     # known, and the line is needed for the stop
        try:
            self._other.poll(self._timeout_s)
        except LinkLost:
            self._stay_out()
            raise
        except CommunicationLost:
            if not self._told_other:
                self._told_other = True
                self._ticks.done()
                raise

    def _word(self, mode: Mode) -> int:
        """Return the control word towards the present request."""
        turning = not self._standstill.near(self._feedback.speed_rad_s)
        # A drive that was enabled and shows no valid state is not disabled: it is braked at any reported speed.
        unknown = self._ever_enabled and power_state(self._state) is PowerState.UNKNOWN
        return controlword_towards(
            self._profile.control, self._state, self._wish, mode, reverse=self._reverse, turning=turning or unknown,
            removes_torque=self._removes_torque,
        )

    def _insist(self, got: Round, setpoints: Setpoints, mode: Mode, begun_s: float) -> Round:
        """Repeat the words of the stop against another master, as often as the period permits."""
        until_s = begun_s + INSIST_SHARE * self.period_s
        self._press_speed_limits(begun_s)
        took_s = 0.0
        while (sent_s := self.clock.now_s()) + took_s < until_s:
            word = self._word(mode)
            try:
                got = go_round(
                    self._access, self._plan.cycle, self._codec.image(word, setpoints, mode), self._timeout_s,
                    self._moving,
                )
            except (CommunicationLost, RegisterRefused):
                break                  # the next cycle reports it
            self._feedback = self._codec.feedback(got.words)
            self._state = self._decoded(self._feedback.status)
            took_s = self.clock.now_s() - sent_s
            if took_s <= 0.0:          # on a line without delay this loop would not end
                break
        self._ticks.done()
        return got

    def _press_speed_limits(self, now_s: float) -> None:
        """Lower the drive's own speed limit along the quick-stop ramp, against any setpoint; `close` restores it.

        A quick stop that is ended repeatedly starts its ramp anew each time and makes no progress.
        """
        recently = self._pressed_s is not None and now_s < self._pressed_s + PRESS_EVERY_S
        if recently or power_state(self._state) not in _DRIVEN:
            return
        if self._pressed_s is None:
            self._pressed_rad_s, self._pressed_s = abs(self._feedback.speed_rad_s), now_s
        self._pressed_rad_s -= self._quick_stop_rad_s2 * (now_s - self._pressed_s)
        self._pressed_s = now_s
        for register, rad_s, before in self._speed_limits:
            counts = max(1, min(abs(before), int(max(0.0, self._pressed_rad_s) / rad_s)))
            with suppress(CommunicationLost, RegisterRefused, CommandRejected):
                self._access.press(register, counts if before >= 0 else -counts, before, self._timeout_s)

    def _watch(self) -> Sample:
        """Run a cycle that only reads, or not even that while reading feeds the watchdog."""
        begun_s = self.clock.now_s()
        self._cycles += 1
        sample = self.poll()
        if sample is None:
            self._missed += 1
            self._ticks.done()
            return self._sample(begun_s, self.clock.now_s() - begun_s, 0.0, fresh=False)
        return sample

    def _unless_frozen(self, check_ticks: Callable[[], None]) -> None:
        try:
            check_ticks()
        except CommunicationLost:
            self._stay_out()
            raise

    def poll(self) -> Sample | None:
        """Read without writing, for a stop whose cycles fail: a drive that refuses writes may still report its state.

        While the drive shows itself enabled, the quick-stop word is written alone, once each time. If the torque is
        to be removed, the word for that is written instead, in any state with power. The angle comes last.
        """
        if not self._reads:
            return None
        entry, since_s = self._profile.watchdog, self._silent_since_s
        by_reading = entry.fed_by_any_client or entry.fed_by == "requests_of_this_connection"
        if since_s is not None and by_reading and self.clock.now_s() - since_s < SILENT_TIMES * self._watchdog_s:
            return None                # a read would feed a watchdog that must trip
        try:
            until_s = self.clock.now_s() + self.period_s
            got = go_round(self._access, self._reads, {}, self._timeout_s, self._moving, until_s)
        except (CommunicationLost, RegisterRefused):
            return None
        self._take(self._codec.feedback(got.words), self._sent_mode)
        power = power_state(self._state)
        pushed = power not in _NOT_DRIVEN if self._removes_torque else power in _MAY_DRIVE
        if pushed and self._silent_since_s is None and self._wish is not PowerRequest.ENABLED:
            self._push()
        if self._feedback.position_rad is None and self._angle is not None:
            angle = self._angle.read(self._access, self._timeout_s)
            if angle is not None:
                self._feedback = self._feedback._replace(position_rad=angle.position_rad)
        self._ticks.done()
        half_s = 0.5 * (got.received_s - got.sent_s)
        return self._sample(got.sent_s + half_s, half_s, half_s, fresh=True)

    def read_position(self) -> PositionReading | None:
        """Read the motor's angle in one transaction between two cycles; None if there is none, or no valid reply."""
        if self._angle is None:
            return None
        found = self._angle.read(self._access, self._timeout_s)
        self._ticks.done()
        self._ticks.put_off()
        return found

    def _push(self) -> None:
        """Write the control word of a quick stop alone, in the shortest request that the drive supports.

        If the torque is to be removed, it is the word for that, as in a cycle: a quick stop would give it back.
        """
        control = self._profile.cycle.control.register_
        word = self._word(self._sent_mode) if self._removes_torque else controlword_towards(
            self._profile.control, self._state, PowerRequest.QUICK_STOP, self._sent_mode, reverse=self._reverse
        )
        try:
            self._access.once(self._access.write_request(control.address, (word,)), self._timeout_s)
        except (CommunicationLost, RegisterRefused):
            return                     # the next poll shows the result

    def _transactions(self, mode: Mode) -> tuple[Transaction, ...]:
        """Return the plan's transactions, with those of a mode switch: the mode after its setpoint, then its
        display.
        """
        plan, found = self._plan, self._plan.cycle
        self._since_mode_sent += 1
        self._since_mode_read += 1
        repeat = self._shown is not mode and self._since_mode_sent >= REPEAT_MODE_CYCLES
        self._writes_mode = bool(plan.mode_writes) and (mode is not self._sent_mode or repeat)
        if self._writes_mode:
            found += plan.mode_writes
        elif not plan.mode_writes:
            self._sent_mode = mode
        if plan.mode_reads and (self._shown is not mode or self._since_mode_read >= READ_MODE_CYCLES):
            self._since_mode_read = 0
            found += plan.mode_reads
        return found

    def _fail(self, error: CommunicationLost | RegisterRefused, begun_s: float) -> None:
        """Handle a cycle without feedback; each error is raised once."""
        if isinstance(error, LinkLost):
            self._stay_out()
            raise error
        if isinstance(error, RegisterRefused) and error.code != BUSY:
            self._stay_out()
            if not self._told_loss:
                self._told_loss = True
                raise CycleRefused(error.code, f"{self._where}, {error.where}") from error
            return
        if self._failing_since_s is None:
            self._failing_since_s = begun_s
        silent_s = self.clock.now_s() - self._failing_since_s
        if silent_s > BUDGET_SHARE * self._watchdog_s and not self._told_loss:
            self._told_loss = True
            self._stay_out()
            raise CommunicationLost(
                f"no good reply for {silent_s:.2f} s, last: {error.what}",
                where=self._where,
                next_step="Check cable, supply and termination. tdhil continues to send the quick stop. If no request"
                " reaches the drive, its own watchdog stops the shaft",
                entry=MessageCode.FEEDBACK_LOST,
            ) from error

    def _stay_out(self) -> None:
        """End the enable request: a line that recovers must not carry an enable and a setpoint without a new
        request.
        """
        if self._wish is PowerRequest.ENABLED:
            self._wish = PowerRequest.QUICK_STOP

    def _decoded(self, status: int) -> StatusState | None:
        state = (decode_after if self._ever_enabled else decode)(self._profile.control, status)
        self._ever_enabled = self._ever_enabled or power_state(state) is PowerState.ENABLED
        return state

    def _take(self, feedback: CycleFeedback, sent: Mode) -> None:
        self._state = self._decoded(feedback.status)
        if self._profile.modes.display is None:
            self._shown = sent
        elif feedback.mode_word is not None:
            self._shown = shown_mode(self._profile, feedback.mode_word)
        self._feedback = feedback
        at_zero = self._standstill.add(feedback.speed_rad_s)
        said = self._profile.control.standstill
        known = power_state(self._state) is not PowerState.UNKNOWN
        self._at_rest = known and (at_zero if said is None else seen(said, feedback.status))

    def _follow_state(self) -> None:
        """Keep a drive that left operation out of it until it is enabled again. Raises DriveFault, once."""
        power = power_state(self._state)
        if power in (PowerState.FAULT, PowerState.FAULT_REACTION):
            # In fault reaction the drive brakes, or holds the shaft: it is not disabled before a request for it.
            asked = self._wish
            if power is PowerState.FAULT:
                self._wish = PowerRequest.OFF
            elif asked is PowerRequest.ENABLED:
                self._wish = PowerRequest.QUICK_STOP
            if asked is not PowerRequest.OFF and not self._told_fault:
                self._told_fault = True
                raise DriveFault(
                    f"the drive went into {power.value}, status {self._feedback.status:04X}h",
                    where=f"{self._where}, {register_name(self._profile.cycle.status.register_)}",
                    next_step="See the drive's fault list, remove the cause, then start with --reset-fault",
                )
        elif self._wish is not PowerRequest.ENABLED:
            out, self._out_of_operation = self._out_of_operation, self._out_of_operation + 1
            if power is PowerState.ENABLED:
                self._out_of_operation = 0
                # A request sent just before this one may still take effect.
                self._other.seen = self._other.seen or out >= SETTLED_CYCLES
                if out >= SETTLED_CYCLES and not self._told_other:
                    self._told_other = True
                    raise CommunicationLost(
                        f"the drive is enabled, but this run does not request it (status"
                        f" {self._feedback.status:04X}h): another master commands it",
                        where=f"{self._where}, {register_name(self._profile.cycle.control.register_)}",
                        next_step="Disconnect the other master (PLC, panel, gateway)",
                        entry=MessageCode.FOREIGN_MASTER,
                    )
        elif self._wish is PowerRequest.ENABLED:
            if power is PowerState.ENABLED:
                self._was_enabled, self._out_of_operation = True, 0
                self._follow_remote()
            elif self._was_enabled or power is PowerState.QUICK_STOP:
                self._wish = PowerRequest.QUICK_STOP       # it may be in operation after all: one word can be wrong

    def _follow_remote(self) -> None:
        """Check remote control. Raises CommunicationLost, once, if the bus has lost control of an enabled drive."""
        remote, status = self._profile.control.remote, self._feedback.status
        if remote is None or seen(remote, status):
            self._was_remote, self._local = remote is not None, 0
            return
        self._local += 1
        if self._was_remote and self._local == LOCAL_CYCLES:
            raise CommunicationLost(
                f"the bus no longer controls the drive: its status {status:04X}h does not show remote control",
                where=f"{self._where}, {register_name(self._profile.cycle.status.register_)}",
                next_step="Return control to the bus at the panel or command source of the drive, and start again",
                entry=MessageCode.FOREIGN_MASTER,
            )

    def _sample(self, time_s: float, age_s: float, half_width_s: float, *, fresh: bool) -> Sample:
        feedback, control = self._feedback, self._profile.control
        return Sample(
            time_s,
            age_s,
            half_width_s,
            fresh,
            feedback.speed_rad_s,
            feedback.torque_nm,
            feedback.torque_demand_nm,
            self._shown,
            power_state(self._state),
            self._at_rest,
            seen(control.limit_active, feedback.status),
            feedback.status,
            self._unwrapped.take(time_s, feedback.position_rad)
            if fresh and self._unwrapped is not None and feedback.position_rad is not None else None,
        )

    # -- afterwards ------------------------------------------------------------------------------------------

    def close(self) -> tuple[str, ...]:
        """Restore the drive's former settings and close the line; setpoints stay at zero. Return what was not restored.

        Settings are restored only if the drive is known to be disabled. A drive that was enabled and has shown no state
        since is not known to be. Its watchdog stays armed then, and the silence that follows triggers it.
        """
        left: tuple[str, ...] = ()
        access, power = self._access, power_state(self._state)
        try:
            if power in _NOT_DRIVEN or (power in _NONE_YET and not self._ever_asked):
                if self._modes:
                    clear_setpoints(PreflightTable(), access, self._profile, self._off_word())
                left = access.restore()
            else:
                left = tuple(f"{where}: {NOT_RESTORED}" for where in access.changed)
        except CommunicationLost as error:
            left = (left_behind(access.changed, error),)
        finally:
            self._link.close()
        return left
