"""Node guarding, the host's side (CiA 301): the watchdog of drives that know no heartbeat consumer.

::

    host   700h + node, remote frame     ─►  the drive restarts its life time (100Ch x 100Dh)
    drive  700h + node, toggle | state   ─►  bit 7 changes with every answer, bits 0 to 6 are the NMT state

The questions are asked by the control loop itself, so that a frozen or dead host falls silent and the drive acts. An
answer that doesn't toggle is no answer: it is an old one come again, or another station's. The state goes to `Watch`,
which knows what it may be and how long it may fail to come.
"""

from collections.abc import Callable

from drivers.canopen.supervision import BOOT_UP, Watch


class Guarding:
    """``ask`` puts the remote frame on the bus."""

    def __init__(self, watch: Watch, ask: Callable[[], None]) -> None:
        self._watch = watch
        self._ask = ask
        self._toggle: int | None = None
        self.asked = self.answers = self.repeated = 0
        watch.sign_of_life = self._missing

    def feed(self) -> None:
        """One question."""
        self.asked += 1
        self._ask()

    def on_frame(self, data: bytes) -> None:
        """700h + node, from the drive."""
        if not data:
            return
        state, toggle = data[0] & 0x7F, data[0] >> 7
        if state == BOOT_UP:
            self._toggle = None
        elif toggle == self._toggle:
            self.repeated += 1
            return
        else:
            self._toggle = toggle
            self.answers += 1
            self.repeated = 0
        self._watch.on_heartbeat(bytes((state,)))

    def _missing(self) -> tuple[str, str]:
        if self.repeated:
            return f"answers to node guarding have not toggled ({self.repeated} alike)", "100Ch"
        return "answers to node guarding have been missing", "100Ch"
