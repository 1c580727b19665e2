"""A quick stop that somebody else undoes, made to stand.

Another master that goes on sending enable operation in an RPDO takes the drive out of its quick stop with its next
frame (CiA 402-2, transition 16). Where that is seen, every RPDO is switched off in the drive (1400h:1 and on, bit 31),
ours too, and from then on the controlword goes out by SDO, with setpoints of zero beside it; feedback stays as it is.
Nobody waits for those answers: a cycle is a cycle. What can't be made to stand even so is left to the drive's watchdog
(`drivers.drive.StopsFeeding`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from drivers.canopen.bus import CanLink
from drivers.canopen.pdo_mapping import DISABLED
from drivers.canopen.sdo import Objects
from drivers.canopen.sdo_feedback import ANSWER_S, WATCHDOG_SHARE
from drivers.canopen.state_machine import State, Wish, controlword_towards
from drivers.cia402.objects import TARGET_VELOCITY
from drivers.errors import CommunicationLost, ObjectRefused

UNDONE_S, UNDONE_CYCLES = 0.3, 5
"""A drive that is in operation for so long, and so many cycles, after a quick stop was asked for does not follow it."""
_EXPEDITED_2, _EXPEDITED_4 = 0x2B, 0x23
_LEFT_ALONE = frozenset(State) - {State.OPERATION_ENABLED}


class Standing:
    """``rpdos``: number of each RPDO that acts or could, and its COB-ID."""

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
        self.by_sdo = False

    def set_period(self, period_s: float) -> None:
        """A cycle takes so long."""
        self._patience_s = max(UNDONE_S, UNDONE_CYCLES * period_s)
        self._period_s = period_s

    def undone(self, now_s: float, state: State, others: bool) -> bool:
        """After a quick stop, once a cycle: is it time to take over? ``others``: somebody else's RPDOs were heard."""
        if state is not State.OPERATION_ENABLED:
            if not others:                         # while they are there it may be enabled in between unseen
                self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        wait_s = 2.0 * self._period_s if others else self._patience_s
        return not self.by_sdo and now_s - self._since_s >= wait_s - 1e-9

    def take_over(self, watchdog_s: float, feed: Callable[[], None]) -> int:
        """Switch every RPDO off; how many there were that it worked for. Raises nothing."""
        self.by_sdo = True
        done = 0
        with self._objects.answered_within(min(ANSWER_S, WATCHDOG_SHARE * watchdog_s) if watchdog_s else ANSWER_S):
            for number, cob_id in self.rpdos.items():
                with suppress(CommunicationLost, ObjectRefused):
                    feed()
                    self._objects.write(0x1400 + number - 1, 1, cob_id | DISABLED, 32)
                    done += 1
        return done

    def push(self, state: State, wish: Wish) -> None:
        """Towards ``wish`` by SDO, one request a cycle: the controlword, and zero setpoints in between."""
        if wish is Wish.QUICK_STOP and state in _LEFT_ALONE:
            return
        if wish is Wish.OFF and state in (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY):
            return
        self._turn += 1
        if self._turn % 4 == 0:
            index, _, bits = self._target
            self._write(_EXPEDITED_4 if bits == 32 else _EXPEDITED_2, index, 0)
        elif self._turn % 4 == 2:
            self._write(_EXPEDITED_2, 0x6071, 0)
        else:
            self._write(_EXPEDITED_2, 0x6040, controlword_towards(state, wish))

    def _write(self, command: int, index: int, value: int) -> None:
        request = bytes((command,)) + index.to_bytes(2, "little") + b"\0" + value.to_bytes(4, "little")
        self._link.send(0x600 + self._node, request)
