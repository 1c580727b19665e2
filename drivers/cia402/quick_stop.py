"""Quick stop of a CiA 402 drive by its objects: in a run that another master reverses, and outside of any run.

It is written as an object (6040h, bit 2 low), which needs no mapping and no cycle. If the quick stop of the drive is
set to coast (605Ah = 0), another option is written first; if the drive refuses it, the halt bit is used. In torque mode
the drive gets speed mode at zero first, as in a run. Otherwise the quick stop could release a turning shaft. This step
is left out if the profile states that the quick stop decelerates in torque mode, or that the mode does not change while
the drive is enabled.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext, suppress
from functools import partial

from drivers.cia402.limits import QUICK_STOP_OPTION
from drivers.cia402.objects import Objects
from drivers.cia402.polling import ANSWER_S
from drivers.cia402.position import find_angle
from drivers.cia402.preflight import read_identity, speed_unit
from drivers.cia402.process_data import TARGET_VELOCITY, VELOCITY_ACTUAL, VL_ACTUAL
from drivers.cia402.state_machine import (
    ENABLE_OPERATION,
    QUICK_STOP,
    TARGET_REACHED,
    State,
    controlword_towards,
    decode,
    power_state,
)
from drivers.clock import Clock
from drivers.drive import Identity, Outcome, PowerRequest, PowerState
from drivers.errors import CommunicationLost, DriveFault, ObjectRefused
from drivers.preflight import PreflightTable
from drivers.quick_stop import BLANK_WORDS, Seen
from drivers.standstill import PositionSource, StandstillTest
from profiles import MARKER_INDEX
from profiles.cia402 import QUICK_STOP_COASTS, Cia402Profile

# ---------------------------------------------------------------------------------------------------------------------
# Enforcing a quick stop that another master reverses.
#
# Another master that continues to send enable operation takes the drive out of its quick stop with its next frame (CiA
# 402-2, transition 16). If that is detected, all cyclic setpoints are disabled in the drive, including ours. From then
# on the controlword and setpoints of zero are written as objects; the feedback stays as it is. tdhil does not wait for
# those answers, so the cycle keeps its length. If even this fails, the drive is left to its watchdog
# (`drivers.drive.StopsFeeding`).


UNDONE_S, UNDONE_CYCLES = 0.3, 5
"""Time, s, and number of cycles. A drive that is still in operation after both does not follow the quick stop."""
_LEFT_ALONE = frozenset(State) - {State.OPERATION_ENABLED, State.UNKNOWN}


class Standing:
    """Quick stop by objects, for a drive that another master takes out of its quick stop. ``put`` sends a write request
    without waiting; ``target``: the speed's setpoint (index, subindex, bits).
    """

    def __init__(
        self, put: Callable[[int, int, bytes], None], period_s: float, target: tuple[int, int, int] = TARGET_VELOCITY
    ) -> None:
        self._put = put
        self._target = target
        self.set_period(period_s)
        self._since_s: float | None = None
        self._turn = 0
        self.offset: tuple[int, int, int] | None = None    # index, subindex, bits of a torque offset in use
        self.by_object = False

    def set_period(self, period_s: float) -> None:
        """Set the cycle period, s."""
        self._patience_s = max(UNDONE_S, UNDONE_CYCLES * period_s)
        self._period_s = period_s

    def undone(self, now_s: float, state: State, others: bool) -> bool:
        """Return whether to write objects from now on. Called once per cycle after a quick stop. ``others``: setpoints
        of another master came.
        """
        if state is not State.OPERATION_ENABLED:
            # Between two cycles such setpoints may enable the drive without being seen. A drive that shows no valid
            # state may be enabled too.
            if not others and state is not State.UNKNOWN:
                self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        wait_s = 2.0 * self._period_s if others else self._patience_s
        return not self.by_object and now_s - self._since_s >= wait_s - 1e-9

    def push(self, state: State, wish: PowerRequest, *, removes_torque: bool = False) -> None:
        """Send one write request per cycle towards ``wish``: the controlword, and setpoints of zero in between.

        A torque offset is cleared first, in any state. ``removes_torque``: the power stage is switched off at once.
        """
        if self.offset is not None and self._turn == 0:
            self._turn = 1
            self._put(self.offset[0], self.offset[1], bytes(2))
            return
        if wish is PowerRequest.QUICK_STOP and state in _LEFT_ALONE:
            return
        if wish is PowerRequest.OFF and state in (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY):
            return
        self._turn += 1
        if self._turn % 4 == 0:
            index, _, bits = self._target
            self._put(index, 0, bytes(bits // 8))
        elif self._turn % 4 == 2:
            index, sub, _ = self.offset or (0x6071, 0, 16)
            self._put(index, sub, bytes(2))
        else:
            word = controlword_towards(state, wish, removes_torque=removes_torque)
            self._put(0x6040, 0, word.to_bytes(2, "little"))


# ---------------------------------------------------------------------------------------------------------------------

HALT = 0x0100
MODE_S, MODE_PAUSE_S = 0.5, 0.01
"""Time for the change to speed mode, s, and interval between two queries, s."""
_CONTROLWORD = 0x6040
_BRAKE_AND_HOLD = 6


class Cia402Target:
    """One drive on an open bus, stopped by its objects. Each bus adds stronger means, and remarks on another master."""

    def __init__(self, objects: Objects, profile: Cia402Profile, clock: Clock) -> None:
        self._objects = objects
        self._profile = profile
        self._clock = clock
        self._stays_in_torque_mode = False
        self._rad_s_per_lsb = 0.0
        self._standstill: StandstillTest | None = None     # with the first reading
        self._speed_at = (VL_ACTUAL if profile.speed.vl else VELOCITY_ACTUAL)[0]
        self._word = QUICK_STOP
        self._prepared = False
        self._said: list[str] = []

    def ask(self, attempt: int) -> None:
        """Write the quick stop as an object, after the bus's own means for this attempt.

        Each step is taken even if the drive refuses an earlier one, or does not answer it. After a missing answer the
        steps before the controlword wait `ANSWER_S` only, because they delay it. Raises the first error:
        CommunicationLost, ObjectRefused or DriveFault.
        """
        failed: CommunicationLost | ObjectRefused | DriveFault | None = None
        last = self._write_controlword
        for step in (self._prepare, self._leave_torque_mode, partial(self.enforce, attempt), last):
            hurries = isinstance(failed, CommunicationLost) and step is not last
            try:
                with self._objects.answered_within(ANSWER_S) if hurries else nullcontext():
                    step()
            except (CommunicationLost, ObjectRefused, DriveFault) as error:
                failed = failed or error
        if failed is not None:
            raise failed

    def _write_controlword(self) -> None:
        self._objects.write(_CONTROLWORD, 0, self._word_now(), 16)

    def _word_now(self) -> int:
        """Return the controlword. The halt bit acts in operation only, and its word would enable any other drive."""
        if self._word == QUICK_STOP:
            return QUICK_STOP
        try:
            enabled = decode(self._objects.read(0x6041)) is State.OPERATION_ENABLED
        except (CommunicationLost, ObjectRefused):
            enabled = False
        return self._word if enabled else QUICK_STOP

    def enforce(self, attempt: int) -> None:
        """Use a stronger means of the bus than an object, from some attempt on. May raise DriveFault."""

    def wait(self, time_s: float) -> None:
        """Wait between two objects, s."""
        self._clock.wait_until(self._clock.now_s() + time_s)

    def stepped_by_another(self, stepped: bool) -> bool:
        """Return whether another master's cycles advance a drive in stepped time."""
        return False

    def keep_time(self) -> None:
        """Let a simulated drive in stepped time advance by itself; otherwise it would never reach standstill."""
        with suppress(ObjectRefused):
            stepped = bool(self._objects.read_if_there(MARKER_INDEX, 2))
            if not self.stepped_by_another(stepped) and stepped:
                self._objects.write(MARKER_INDEX, 2, 0, 8)

    def poll(self) -> Seen:
        """Read 6041h and 606Ch."""
        status = self._objects.read(0x6041)
        raw = self._objects.read(self._speed_at, signed=True)
        state = decode(status)
        if self._standstill is None:                   # scaled by the drive's own settings, if any
            table = PreflightTable()
            self._rad_s_per_lsb = speed_unit(table, self._objects, self._profile)
            known = all(one.outcome is not Outcome.REFUSED for one in table.checks)
            self._standstill = StandstillTest(self._rad_s_per_lsb if known else None, self._find_position)
        enabled = power_state(state) is PowerState.ENABLED
        return Seen(
            state=power_state(state),
            text=f"{state.value} (statusword {status:04X}h)",
            speed=raw * self._rad_s_per_lsb,
            unit="rad/s",
            near_zero=self._standstill.near_zero(raw),
            standstill=bool(status & TARGET_REACHED) and state in (State.QUICK_STOP_ACTIVE, State.OPERATION_ENABLED),
            follows=enabled and not (self._word & HALT and status & TARGET_REACHED),
            blank=status in BLANK_WORDS,
        )

    def identity(self) -> Identity:
        """Read 1018h after the stop, to check that it was the intended drive. Raises TdhilError."""
        return read_identity(self._objects)

    def remarks(self) -> tuple[str, ...]:
        """Return remarks on changes made in the drive, and on a speed that is too coarse."""
        return (*self._said, *(() if self._standstill is None else self._standstill.remarks()))

    def _find_position(self) -> PositionSource | None:
        """Return the drive's position as this profile reads it; None if there is none."""
        angle = find_angle(PreflightTable(), self._objects, self._profile)
        if angle is None:
            return None
        return PositionSource(angle.rad_per_count, lambda: angle.read(self._objects, self._clock, 0.0))

    def _prepare(self) -> None:
        """Clear a torque offset, and change a quick stop that coasts; once."""
        if self._prepared:
            return
        offset = self._profile.torque_offset
        if offset is not None and self._objects.read_if_there(offset.index, offset.sub):
            with suppress(ObjectRefused):          # possibly left by a host that died; cleared first
                self._objects.write(offset.index, offset.sub, 0, 16)
        option = self._objects.read_if_there(QUICK_STOP_OPTION, signed=True)
        if option == QUICK_STOP_COASTS:
            try:
                self._objects.write(QUICK_STOP_OPTION, 0, _BRAKE_AND_HOLD, 16)
                self._said.append("its quick stop was set to coast: 605Ah was changed from 0 to 6")
            except ObjectRefused:
                self._word = ENABLE_OPERATION | HALT
                self._said.append("its quick stop is set to coast (605Ah = 0): the halt bit was used instead")
        self._prepared = True
        self.keep_time()

    def _leave_torque_mode(self) -> None:
        """Switch to speed mode at zero (60FFh, then 6060h) and wait up to `MODE_S` for 6061h; only if needed.

        A drive that does not follow, or does not change its mode while enabled, gets the quick stop anyway: the bus
        offers nothing better.
        """
        profile = self._profile
        if profile.quick_stop.decelerates_in_torque_mode or self._stays_in_torque_mode:
            return
        speed_modes = [
            code for code in profile.modes.speed
            if (supported := self._objects.read_if_there(0x6502)) is None or code < 1 or supported >> code - 1 & 1
        ]
        if self._shown() not in profile.modes.torque or not speed_modes:
            return
        if decode(self._objects.read(0x6041)) is not State.OPERATION_ENABLED:
            return
        if not profile.modes.switch_while_enabled:
            self._stay_in_torque_mode()
            return
        self._objects.write(0x60FF, 0, 0, 32)
        self._objects.write(0x6060, 0, speed_modes[0], 8)
        deadline_s = self._clock.now_s() + MODE_S
        while self._shown() not in profile.modes.speed:
            if self._clock.now_s() > deadline_s:
                self._stay_in_torque_mode()
                return
            self.wait(MODE_PAUSE_S)
        said = "it was in torque mode, where its quick stop may not brake: speed mode at zero came first"
        if said not in self._said:
            self._said.append(said)

    def _stay_in_torque_mode(self) -> None:
        self._stays_in_torque_mode = True
        self._said.append("it stays in torque mode, where its quick stop may not brake the shaft")

    def _shown(self) -> int:
        return self._objects.read(0x6061, signed=True)
