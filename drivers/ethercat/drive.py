"""CiA 402 on EtherCAT (CoE): the process data, AL states and the watchdog for `drivers.cia402.drive.Cia402Drive`.

One cycle; this loop sends all of it::

    tick ─ LRW(6040h 6071h 60FFh 6060h ─► 6041h 6077h 606Ch 6061h [6074h] [6064h]) ─ AL status ─ mailbox (when due)

The working counter shows whether the drive took the setpoints and gave its feedback: with a wrong one the cycle has no
feedback. The AL state is read in every cycle. Where the slave controller has distributed clocks, SYNC0 has the period
of the cycle, and the ticks of this loop follow the clock of the segment.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

from drivers import cia402
from drivers.clock import Clock
from drivers.drive import DriveLimits, FrameTap, Identity, RawFrame
from drivers.errors import CommunicationLost, DriveFault, ObjectRefused, PreflightRefused
from drivers.ethercat.mailbox import CoeObjects, Mailbox
from drivers.ethercat.pdo import map_cyclic, settings
from drivers.ethercat.segment import EthercatSegment
from drivers.ethercat.station import CYCLE_US, INIT, OP, PRE_OP, REGISTER_US, SAFE_OP, has_clocks
from drivers.ethercat.supervision import ProcessDataWatchdog, SlaveWatch
from drivers.preflight import PreflightTable
from drivers.undo_journal import UndoJournal
from profiles import MARKER_INDEX, MessageCode
from profiles.cia402 import Position
from profiles.ethercat import EthercatProfile

MAILBOX_S = 0.05
"""Interval between two queries of the mailbox for emergency messages, s."""
STEPPED_ANSWER_US = 200_000
"""Wall time for a frame in stepped time, µs. A frame that takes longer is lost."""
ANSWER_SHARE, CYCLE_SHARE = 0.5, 0.2
"""Longest wait for the frame of a cycle, and for the answer of a register, as shares of the period."""
SYNC0_SHARE = 0.5
"""Distance of SYNC0 behind the frame, as a share of the period: as far from the frames as possible on both sides."""
NO_SETPOINTS = cia402.CycleSetpoints(0, 0, 0, 0, 0, False)
Layouts = tuple[cia402.CyclicLayout, cia402.CyclicLayout]
"""Places of the setpoints and of the feedback."""
SETPOINTS, FEEDBACK = 2, 3
"""Identifiers of the process data in the log: the sync managers."""


class EthercatBus(cia402.Cia402Bus):
    """One EtherCAT slave as the bus of a CiA 402 drive. ``tap`` gets the process data and the mailbox messages; the
    identifier is the sync manager.
    """

    feedback_place = "working counter"

    def __init__(
        self, segment: EthercatSegment, profile: EthercatProfile, clock: Clock, *, period_s: float,
        tap: FrameTap | None = None,
    ) -> None:
        self._segment, self._station, self._profile, self._tap = segment, segment.station, profile, tap
        self._mailbox = Mailbox(segment.station, clock)
        self._slave_watch = SlaveWatch(segment.station.place, clock)
        super().__init__(CoeObjects(self._mailbox), self._slave_watch, clock, period_s)
        self.place = segment.station.place
        self._slave_watch.on_restart = self.reported.restarted
        self._mailbox.on_emergency = self._slave_watch.on_emcy
        self._mailbox.on_answer = self._on_answer
        self._mailbox.on_message = self._seen
        self._watchdog = ProcessDataWatchdog(segment.station)
        self._setpoints = NO_SETPOINTS
        self._outputs = cia402.CyclicLayout((), ())
        self._inputs: cia402.CyclicLayout | None = None     # None: nothing can be decoded
        self._assign: Callable[[], Layouts]                 # set by `map_cyclic`
        self._asked, self._looked_s, self._al_state = 0, 0.0, OP
        self._sent, self._fed, self._clocks = False, True, False

    # -- before motion ---------------------------------------------------------------------------------------

    def take(self) -> None:
        """Put the slave into PRE-OP. Raises DriveFault if it refuses."""
        self._station.wait_us = REGISTER_US
        if self._clocks:
            self._segment.slave.dc_sync(False, 0)
        self._station.reach(PRE_OP)

    def confirm(self, identity: Identity) -> None:
        """Refuse a slave whose SII and objects name different drives. Raises PreflightRefused."""
        slave = self._segment.slave
        if (slave.man, slave.id) != (identity.vendor, identity.product):
            raise PreflightRefused(
                f"the SII names vendor {slave.man:X}h and product {slave.id:X}h, the objects (1018h) vendor "
                f"{identity.vendor:X}h and product {identity.product:X}h", where=self.place,
                next_step="The EEPROM of the slave controller may be damaged or of another drive; see the manufacturer",
                entry=MessageCode.PREFLIGHT_REFUSED,
            )

    def map_cyclic(
        self, table: PreflightTable, content: cia402.CyclicObjects, demand: bool, position: Position | None
    ) -> Sequence[cia402.FeedbackSetting]:
        """Map and assign the PDOs, in PRE-OP."""
        self._setpoints, self.angle_mapped = NO_SETPOINTS, False

        def assign(angle: Position | None) -> Layouts:
            self._assign = partial(map_cyclic, self.objects, self._profile, content, demand, angle)
            return self._assign()

        def work() -> tuple[str, bool]:
            (self._outputs, inputs), done = cia402.with_angle(table, position, assign)
            angle, self._inputs = cia402.angle_object(position), inputs
            self.angle_mapped = angle is not None and not inputs.missing([angle])
            return done, True

        mapped = table.attempt("PDO mapping", "setpoints and feedback", "1C12h, 1C13h", work)
        return settings(self.objects, self._profile) if mapped else ()

    def arm(self, table: PreflightTable, limits: DriveLimits) -> float:
        """Set the period of the cycle, arm the watchdog of the process data and read it back."""
        objects, period_us = self.objects, round(self.period_s * 1e6)
        if self.clock.stepped:
            for title, sub, value, bits in (("simulator's cycle", 3, period_us, 32), ("stepped time", 2, 1, 8)):
                back = objects.change(MARKER_INDEX, sub, value, bits)
                table.row(title, str(value), str(back), back == value, cia402.name(MARKER_INDEX, sub))
        cia402.note_period(table, self.period_s, "60C2h", self._set_interpolation, "the frames")
        wanted = self._profile.cyclic.distributed_clocks and not self.clock.stepped
        self._clocks = wanted and has_clocks(self._station)
        table.note("distributed clocks", "SYNC0 in the middle of the cycle" if self._clocks else "not used",
                   "register 0008h")
        return self._watchdog.arm(table, objects, self._profile, limits, self.period_s)

    def setting(self, index: int) -> tuple[str, cia402.Group] | None:
        """Return an empty title for the timing, which is not read back in motion."""
        return ("", cia402.Group.REST) if index == cia402.INTERPOLATION else None

    def start(self) -> None:
        """Bring the slave to OP with setpoints of zero, and supervise it.

        Raises PreflightRefused if it does not get there.
        """
        if self._inputs is None:
            return                                     # the mapping was refused: nothing may move
        self._setpoints = self._setpoints.stopped(0)
        try:
            self._segment.map(self._outputs.size, self._inputs.size, self._assign_again)
            if self._clocks:
                self._segment.master.config_dc()
                self._segment.slave.dc_sync(True, round(self.period_s * 1e9))
            self._station.reach(SAFE_OP)
            self._watchdog.check()
            self._station.reach(OP, self._frame)
            self._al_state = OP
        except DriveFault as error:                    # nothing moves yet: an error becomes a refusal
            raise PreflightRefused(error.what, where=error.where, next_step=error.next_step,
                                   entry=MessageCode.NO_FEEDBACK) from error
        in_cycle_us = min(CYCLE_US, round(CYCLE_SHARE * self.period_s * 1e6))
        self._station.wait_us = REGISTER_US if self.clock.stepped else in_cycle_us
        self._slave_watch.start(cia402.DRIVE_SILENT_S)

    def _assign_again(self) -> None:
        """Assign the PDOs after a second start of the segment. All settings must stand, and all places be the same.

        Raises PreflightRefused.
        """
        self._station.reach(PRE_OP)
        self._mailbox.find()
        before = [one and one.content for one in (self._outputs, self._inputs)]
        if [one.content for one in self._assign()] != before:
            raise PreflightRefused("the drive has other process data after a second start of the segment",
                                   where=self.place, next_step="Start again", entry=MessageCode.PDO_NOT_POSSIBLE)
        self.objects.check_stands()

    def set_period(self, period_s: float) -> Sequence[tuple[int, int, bytes]]:
        """Change the period in PRE-OP, with 60C2h."""
        self.period_s = period_s
        self.watch.stop()
        self.take()
        with suppress(ObjectRefused):                  # a drive without 60C2h follows the frames
            self._set_interpolation()
        return ()

    def _set_interpolation(self) -> int:
        return cia402.set_interpolation(self.objects, self.period_s)

    # -- the cycle -------------------------------------------------------------------------------------------

    def listen_until(self, tick_s: float) -> None:
        """Wait until the tick. A simulated drive that is left to its watchdog continues in its own time."""
        if self.clock.stepped and not self._fed:
            time.sleep(self.period_s)
        self.clock.wait_until(tick_s)

    def send(self, setpoints: cia402.CycleSetpoints) -> None:
        """Send the process data. Outside of OP the drive ignores them: then the controlword is also sent by SDO, to
        stop.
        """
        self.ticks.check()
        self._setpoints = setpoints
        self._transmit()
        if self._al_state != OP and not self._asked and not setpoints.enables:
            self.put(0x6040, 0, setpoints.word.to_bytes(2, "little"))

    def receive(self, now_s: float, sync: bool) -> cia402.CycleInputs:
        """Receive the frame, and check working counter, AL state and mailbox.

        Without ``sync``, or if the watchdog is no longer fed, the feedback is read from the slave's memory.
        """
        data: bytes | None = None
        if not (sync and self._fed):
            with suppress(CommunicationLost):
                start, length, _ = self._station.sync_manager(FEEDBACK)
                if self._inputs is not None and length == self._inputs.size:
                    data = self._station.read(start, length)
        else:
            if not self._sent:
                self._transmit()
            data = self._take()
            if self._clocks and data is not None:
                periods = self._segment.master.dc_time / (self.period_s * 1e9)
                self.ticks.follow(periods % 1.0 - SYNC0_SHARE)
        seen = self._inputs.unpack(data) if data and self._inputs and len(data) >= self._inputs.size else None
        self._look(now_s, seen is not None and bool(seen[0] & cia402.FAULT_BIT))
        age_s = 0.0 if self.clock.stepped else self.clock.now_s() - now_s
        if seen is None:
            return cia402.CycleInputs(age_s)
        self._slave_watch.heard()
        status, torque, speed, shown, demand, angle = seen
        self.reported.take_slow(now_s, shown, demand)
        return cia402.CycleInputs(age_s, True, False, status, torque, speed, angle)

    def _transmit(self) -> None:
        self._sent = True
        if not self._segment.mapped:                   # pysoem would write to no memory
            return
        data = self._outputs.pack(self._setpoints)
        self._segment.slave.output = data
        self._seen(True, SETPOINTS, data)
        self._segment.master.send_processdata()

    def _take(self) -> bytes | None:
        """Return the inputs of the frame that was sent; None with a wrong working counter."""
        self._sent = False
        master = self._segment.master
        if not self._segment.mapped:
            return None
        wait_us = STEPPED_ANSWER_US if self.clock.stepped else round(ANSWER_SHARE * self.period_s * 1e6)
        if master.receive_processdata(wait_us) != master.expected_wkc:
            return None
        data: bytes = self._segment.slave.input
        self._seen(False, FEEDBACK, data)
        return data

    def _look(self, now_s: float, fault: bool) -> None:
        """Check AL state, mailbox (at once if a fault shows) and watchdog. A lost datagram shows in the counter too."""
        with suppress(CommunicationLost):
            found = self._station.al_status()
            self._al_state = found.state
            self._slave_watch.on_al_status(found)
            if fault or self._asked or now_s - self._looked_s >= MAILBOX_S:
                self._looked_s = now_s
                self._asked = max(0, self._asked - 1)
                self._mailbox.look()
            self._watchdog.look(now_s, self.watch)

    def _frame(self) -> None:
        """Exchange one frame beside the cycle."""
        self._transmit()
        self._take()

    def _seen(self, outgoing: bool, identifier: int, data: bytes) -> None:
        if self._tap is not None:
            self._tap(RawFrame(self.clock.now_s(), outgoing, identifier, data))

    def feed(self) -> None:
        """Feed the watchdog: exchange the setpoints of the last cycle. In stepped time only a cycle does."""
        if self._fed and self._inputs is not None and not self.clock.stepped:
            self._frame()
        else:
            self.feed_between()

    def feed_between(self) -> None:
        """Feed the watchdog between two cycles. A simulated drive gets a frame by which no time passes."""
        if self.clock.stepped or not self._fed:
            with suppress(CommunicationLost):
                self._station.al_status()
        elif self.watch.expect_operational:
            self._frame()

    def stop_feeding(self) -> None:
        """End the setpoints, so that the watchdog trips. A simulated drive in stepped time then continues in its own
        time.
        """
        if self._fed and self.clock.stepped:
            self.put(MARKER_INDEX, 2, bytes(1))
        self._fed = False

    # -- beside the cycle ------------------------------------------------------------------------------------

    def ask(self, index: int, sub: int) -> None:
        """Send a read request without waiting. A full mailbox counts as a missing answer."""
        self._post(cia402.upload(index, sub))

    def put(self, index: int, sub: int, data: bytes) -> None:
        """Send a write request without waiting. The controlword is also set in the process data, which would overwrite
        it.
        """
        if (index, sub) == (0x6040, 0):
            self._setpoints = self._setpoints.stopped(int.from_bytes(data, "little"))
        self._post(cia402.download(index, sub, data))

    def _post(self, request: bytes) -> None:
        with suppress(CommunicationLost, ObjectRefused):
            self._mailbox.post(request)
            self._asked = round(MAILBOX_S / self.period_s) + 1

    def _on_answer(self, sdo: bytes) -> None:
        found = cia402.uploaded(sdo)
        if found is not None:
            self._asked = 0
            self.on_answer(*found)

    def disable_setpoints(self) -> int:
        """Set the process data to quick stop and setpoints of zero, which they keep. No PDO is switched off."""
        self._setpoints = self._setpoints.stopped(cia402.QUICK_STOP)
        return 0

    def reach(self) -> None:
        """Make the objects readable, and feed the watchdog without setpoints that drive the shaft."""
        if self._setpoints.enables:
            self._setpoints = self._setpoints.stopped(cia402.QUICK_STOP)
        with suppress(CommunicationLost):
            if self._station.al_status().state == INIT:
                self._station.ask_for(PRE_OP)
        self.feed()

    def changed(self, index: int, sub: int) -> None:
        """Ignore the feedback from now on if its mapping was changed: it cannot be decoded."""
        if index in (0x1C13, *self._profile.cyclic.tx_pdos):
            self._inputs = None

    # -- afterwards ------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the interface."""
        self._segment.close()


class EthercatDrive(cia402.Cia402Drive):
    """A CiA 402 drive on EtherCAT: one slave. See `Cia402Drive` and `EthercatBus`."""

    def __init__(
        self,
        segment: EthercatSegment,
        profile: EthercatProfile,
        clock: Clock,
        *,
        rate_hz: float | None = None,
        rated_torque_nm: float | None = None,
        tap: FrameTap | None = None,
        journal: UndoJournal | None = None,
    ) -> None:
        period_s = round(1e6 / (rate_hz or profile.cyclic.rate_hz)) * 1e-6
        super().__init__(
            EthercatBus(segment, profile, clock, period_s=period_s, tap=tap), profile,
            fixed_rate=rate_hz is not None, rated_torque_nm=rated_torque_nm, journal=journal,
        )
