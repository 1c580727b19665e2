"""The bare quick stop of a CiA 402 drive (`drivers.quick_stop`): controlword 6040h, bit 2 low.

It is sent by SDO, which needs no mapping and no SYNC. Another master that continues to send enable operation in its
RPDO reverses it with its next frame (transition 16 of the state machine). Then the same word is sent in that RPDO too,
in a burst, so that one of them is in the drive when the SYNC comes. A master that watches the state sees the stop and
gives up. If even that is reversed, the RPDO that carries 6040h is switched off in the drive (bit 31 of 1400h:1).

If the quick stop of the drive is set to coast (605Ah = 0), another option is written first; if the drive refuses it,
the halt bit is used. In torque mode the drive gets speed mode at zero first, as in a run, unless the profile states
that its quick stop decelerates in torque mode. Otherwise the quick stop could release a turning shaft.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from drivers.canopen.bus import CanLink
from drivers.canopen.pdo import TARGET_VELOCITY, VELOCITY_ACTUAL, VL_ACTUAL, mapping_entry
from drivers.canopen.pdo_mapping import DISABLED
from drivers.canopen.preflight import read_identity, speed_unit
from drivers.canopen.sdo import Objects, name
from drivers.canopen.sdo_feedback import ANSWER_S, WATCHDOG_SHARE
from drivers.canopen.state_machine import (
    ENABLE_OPERATION,
    QUICK_STOP,
    TARGET_REACHED,
    State,
    controlword_towards,
    decode,
    power_state,
)
from drivers.clock import Clock
from drivers.drive import Identity, PowerRequest, PowerState
from drivers.errors import CommunicationLost, DriveFault, ObjectRefused
from drivers.preflight import PreflightTable
from drivers.quick_stop import BLANK_WORDS, Seen
from profiles import MARKER_INDEX
from profiles.canopen import CanopenProfile

if TYPE_CHECKING:
    import can


# ---------------------------------------------------------------------------------------------------------------------
# Enforcing a quick stop that another master reverses.
#
# Another master that continues to send enable operation in an RPDO takes the drive out of its quick stop with its next
# frame (CiA 402-2, transition 16). If that is detected, every RPDO of the drive is switched off (1400h:1 and on, bit
# 31), including ours. From then on the controlword and setpoints of zero are sent by SDO; the feedback stays as it is.
# tdhil does not wait for those answers, so the cycle keeps its length. If even this fails, the drive is left to its
# watchdog (`drivers.drive.StopsFeeding`).


UNDONE_S, UNDONE_CYCLES = 0.3, 5
"""A drive that is in operation for this time, s, and this number of cycles after a quick stop does not follow it."""
_EXPEDITED_2, _EXPEDITED_4 = 0x2B, 0x23
_LEFT_ALONE = frozenset(State) - {State.OPERATION_ENABLED, State.UNKNOWN}


class Standing:
    """``rpdos``: number and COB-ID of each RPDO that acts or could act."""

    def __init__(
        self, objects: Objects, link: CanLink, node: int, period_s: float,
        target: tuple[int, int, int] = TARGET_VELOCITY,
    ) -> None:
        self._objects = objects
        self._link = link
        self._node = node
        self._target = target
        self.set_period(period_s)
        self._since_s: float | None = None
        self._turn = 0
        self.rpdos: dict[int, int] = {}
        self.offset: tuple[int, int, int] | None = None    # index, subindex, bits of a torque offset in use
        self.by_sdo = False

    def set_period(self, period_s: float) -> None:
        """Set the cycle period, s."""
        self._patience_s = max(UNDONE_S, UNDONE_CYCLES * period_s)
        self._period_s = period_s

    def undone(self, now_s: float, state: State, others: bool) -> bool:
        """Return whether to take over, once per cycle after a quick stop. ``others``: RPDOs of another master came."""
        if state is not State.OPERATION_ENABLED:
            # With such frames the drive may be enabled in between unseen; so may one that shows no valid state.
            if not others and state is not State.UNKNOWN:
                self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        wait_s = 2.0 * self._period_s if others else self._patience_s
        return not self.by_sdo and now_s - self._since_s >= wait_s - 1e-9

    def take_over(self, watchdog_s: float, feed: Callable[[], None]) -> int:
        """Switch every RPDO off. Return the number of RPDOs switched off. Raises nothing."""
        self.by_sdo = True
        done = 0
        with self._objects.answered_within(min(ANSWER_S, WATCHDOG_SHARE * watchdog_s) if watchdog_s else ANSWER_S):
            for number, cob_id in self.rpdos.items():
                with suppress(CommunicationLost, ObjectRefused):
                    feed()
                    self._objects.write(0x1400 + number - 1, 1, cob_id | DISABLED, 32)
                    done += 1
        return done

    def push(self, state: State, wish: PowerRequest) -> None:
        """Send one SDO request per cycle towards ``wish``: the controlword, and setpoints of zero in between.

        A torque offset is cleared first, in any state.
        """
        if self.offset is not None and self._turn == 0:
            self._turn = 1
            self._write(_EXPEDITED_2, self.offset[0], 0, self.offset[1])
            return
        if wish is PowerRequest.QUICK_STOP and state in _LEFT_ALONE:
            return
        if wish is PowerRequest.OFF and state in (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY):
            return
        self._turn += 1
        if self._turn % 4 == 0:
            index, _, bits = self._target
            self._write(_EXPEDITED_4 if bits == 32 else _EXPEDITED_2, index, 0)
        elif self._turn % 4 == 2:
            index, sub, _ = self.offset or (0x6071, 0, 16)
            self._write(_EXPEDITED_2, index, 0, sub)
        else:
            self._write(_EXPEDITED_2, 0x6040, controlword_towards(state, wish))

    def _write(self, command: int, index: int, value: int, sub: int = 0) -> None:
        request = bytes((command,)) + index.to_bytes(2, "little") + bytes((sub,)) + value.to_bytes(4, "little")
        self._link.send(0x600 + self._node, request)


# ---------------------------------------------------------------------------------------------------------------------

HALT = 0x0100
BY_SDO_TRIES, BY_RPDO_TRIES = 3, 6
"""Attempts by SDO alone, then attempts with a burst of RPDOs; after them the RPDO is switched off."""
BURST, BURST_PAUSE_S = 200, 0.0005
NEAR_ZERO_RAD_S, NEAR_ZERO_LSB = 0.05, 3
MODE_S, MODE_PAUSE_S = 0.5, 0.01
"""Time for the change to speed mode, s, and interval between two queries, s."""
_RPDOS = 4
_CONTROLWORD = 0x6040
_COAST, _BRAKE_AND_HOLD = 0, 6


class Cia402Target:
    """One node on an open bus."""

    def __init__(self, bus: can.BusABC, profile: CanopenProfile, clock: Clock, *, node: int) -> None:
        self._link = CanLink(bus, clock)
        self._objects = Objects(self._link, node)
        self._node = node
        self._profile = profile
        self._clock = clock
        self._stays_in_torque_mode = False
        self._rad_s_per_lsb: float | None = None
        self._speed_at = (VL_ACTUAL if profile.speed.vl else VELOCITY_ACTUAL)[0]
        self._word = QUICK_STOP
        self._prepared = False
        self._foreign = 0
        self._syncs = 0
        self._said: list[str] = []
        for identifier in (0x200, 0x300, 0x400, 0x500):
            self._link.handlers[identifier + node] = self._on_foreign
        self._link.handlers[0x600 + node] = self._on_foreign
        self._link.handlers[0x080] = self._on_sync

    def ask(self, attempt: int) -> None:
        """Send the quick stop by SDO, then also in RPDOs, then with the other master's RPDO switched off.

        The controlword itself is written even if the drive refuses the rest. Raises CommunicationLost, ObjectRefused or
        DriveFault.
        """
        if not self._prepared:
            self._prepare()
        refused: ObjectRefused | DriveFault | None = None
        try:
            self._leave_torque_mode()
            if attempt > BY_SDO_TRIES + BY_RPDO_TRIES:
                self._switch_off_rpdos()
            elif attempt > BY_SDO_TRIES:
                self._burst()
        except (ObjectRefused, DriveFault) as error:
            refused = error
        self._objects.write(_CONTROLWORD, 0, self._word, 16)
        if refused is not None:
            raise refused

    def poll(self) -> Seen:
        """Read 6041h and 606Ch."""
        status = self._objects.read(0x6041)
        raw = self._objects.read(self._speed_at, signed=True)
        state = decode(status)
        if self._rad_s_per_lsb is None:                # scaled by the drive's own settings, if any
            self._rad_s_per_lsb = speed_unit(PreflightTable(), self._objects, self._profile)
        speed = raw * self._rad_s_per_lsb
        enabled = power_state(state) is PowerState.ENABLED
        return Seen(
            state=power_state(state),
            text=f"{state.value} (statusword {status:04X}h)",
            speed=speed,
            unit="rad/s",
            near_zero=abs(raw) <= NEAR_ZERO_LSB or abs(speed) <= NEAR_ZERO_RAD_S,
            standstill=bool(status & TARGET_REACHED) and state in (State.QUICK_STOP_ACTIVE, State.OPERATION_ENABLED),
            follows=enabled and not (self._word & HALT and status & TARGET_REACHED),
            blank=status in BLANK_WORDS,
        )

    def identity(self) -> Identity:
        """Read 1018h after the stop, to check that it was the intended drive. Raises TdhilError."""
        return read_identity(self._objects)

    def remarks(self) -> tuple[str, ...]:
        """Return remarks on another master, and on changes made in the drive."""
        heard: tuple[str, ...] = ()
        if self._foreign or self._syncs:
            heard = (f"another master is on the bus: {self._foreign} frames to node {self._node} and {self._syncs}"
                     " SYNC were received. Stop it too",)
        return (*heard, *self._said)

    def close(self) -> None:
        """Close the bus."""
        self._link.close()

    def _prepare(self) -> None:
        offset = self._profile.torque_offset
        if offset is not None and self._objects.read_if_there(offset.index, offset.sub):
            with suppress(ObjectRefused):          # possibly left by a host that died; cleared first
                self._objects.write(offset.index, offset.sub, 0, 16)
        option = self._objects.read_if_there(0x605A, signed=True)
        self._prepared = True
        if option == _COAST:
            try:
                self._objects.write(0x605A, 0, _BRAKE_AND_HOLD, 16)
                self._said.append("its quick stop was set to coast: 605Ah was changed from 0 to 6")
            except ObjectRefused:
                self._word = ENABLE_OPERATION | HALT
                self._said.append("its quick stop is set to coast (605Ah = 0): the halt bit was used instead")
        self._keep_time()

    def _leave_torque_mode(self) -> None:
        """Switch to speed mode at zero (60FFh, then 6060h) and wait up to `MODE_S` for 6061h; only if needed.

        A drive that does not follow gets the quick stop anyway: the bus offers nothing better.
        """
        profile = self._profile
        if profile.quick_stop.decelerates_in_torque_mode or self._stays_in_torque_mode:
            return
        speed_modes = [code for code in profile.modes.speed if self._supports(code)]
        if self._shown() not in profile.modes.torque or not speed_modes:
            return
        if decode(self._objects.read(0x6041)) is not State.OPERATION_ENABLED:
            return
        self._objects.write(0x60FF, 0, 0, 32)
        self._objects.write(0x6060, 0, speed_modes[0], 8)
        deadline_s = self._clock.now_s() + MODE_S
        while self._shown() not in profile.modes.speed:
            if self._clock.now_s() > deadline_s:
                self._stays_in_torque_mode = True
                self._said.append("it stays in torque mode, where its quick stop may not brake the shaft")
                return
            self._link.pump_until(lambda: False, MODE_PAUSE_S)
        said = "it was in torque mode, where its quick stop may not brake: speed mode at zero came first"
        if said not in self._said:
            self._said.append(said)

    def _shown(self) -> int:
        return self._objects.read(0x6061, signed=True)

    def _supports(self, code: int) -> bool:
        supported = self._objects.read_if_there(0x6502)
        return supported is None or code < 1 or bool(supported >> code - 1 & 1)

    def _keep_time(self) -> None:
        """Let a simulated drive in stepped time advance by itself; otherwise it would never reach standstill."""
        try:
            stepped = self._objects.read_if_there(MARKER_INDEX, 2)
            self._link.pump_until(lambda: self._syncs > 0, 0.2 if stepped else 0.0)
            if stepped and not self._syncs:
                self._objects.write(MARKER_INDEX, 2, 0, 8)
        except ObjectRefused:
            return

    def _burst(self) -> None:
        frames = [
            (cob_id & 0x7FF, self._packed(offset, length))
            for _, cob_id, offset, length in self._rpdos()
        ]
        if not frames:
            raise DriveFault("no RPDO carries the controlword", where=name(0x1600))
        for _ in range(BURST):
            for identifier, data in frames:
                self._link.send(identifier, data)
            self._link.pump_until(lambda: False, BURST_PAUSE_S)

    def _packed(self, offset: int, length: int) -> bytes:
        """Return an RPDO of zeros with the controlword in its place; offset and length in bits."""
        return (self._word << offset).to_bytes(length // 8, "little")

    def _switch_off_rpdos(self) -> None:
        for index, cob_id, _, _ in self._rpdos():
            self._objects.write(index, 1, cob_id | DISABLED, 32)
            self._said.append(
                f"the RPDO of the other master was switched off: {name(index, 1)} = {cob_id | DISABLED:08X}h;"
                " to enable it again, restart the drive or start a run"
            )

    def _rpdos(self) -> list[tuple[int, int, int, int]]:
        """Return (1400h…, COB-ID, bit offset of 6040h, length in bits) of every enabled RPDO that carries 6040h."""
        found = []
        for number in range(_RPDOS):
            cob_id = self._objects.read_if_there(0x1400 + number, 1)
            if cob_id is None or cob_id & DISABLED:
                continue
            count = self._objects.read_if_there(0x1600 + number, 0) or 0
            at, place = 0, None
            for sub in range(1, min(count, 8) + 1):
                entry = self._objects.read(0x1600 + number, sub)
                if entry == mapping_entry((_CONTROLWORD, 0, 16)):
                    place = at
                at += entry & 0xFF
            if place is not None and at % 8 == 0 and at <= 64:
                found.append((0x1400 + number, cob_id, place, at))
        return found

    def _on_foreign(self, data: bytes) -> None:
        self._foreign += 1

    def _on_sync(self, data: bytes) -> None:
        self._syncs += 1
