"""The host's sign of life, which the drive's watchdog waits for: a heartbeat, or a question of the node guarding.

Sent by whoever calls, and by nothing else: neither a thread nor the kernel, which would outlive a frozen loop.
"""

from drivers.canopen.bus import CanLink
from drivers.canopen.supervision import OPERATIONAL, Watch
from drivers.cia402.guarding import Guarding
from drivers.clock import Clock
from profiles.canopen import CanopenProfile

HEARTBEAT_S = 0.1
"""Both ways; the host's comes faster where the watchdog is shorter than five of them."""
ANSWER_S = 0.2
"""Wall time that the drive may take to answer the first question of the node guarding."""


class SignOfLife:
    """Of ``host_node`` towards ``node``; the answers of a guarded drive are taken from the link too."""

    def __init__(
        self, link: CanLink, watch: Watch, clock: Clock, profile: CanopenProfile, *, node: int, host_node: int
    ) -> None:
        self._link = link
        self._clock = clock
        self.host_node = host_node
        self._ended = False
        self._guarding = Guarding(watch, lambda: link.ask(0x700 + node)) if _guarded(profile) else None
        self._asks = self._guarding is not None
        link.handlers[0x700 + node] = watch.on_heartbeat if self._guarding is None else self._guarding.on_frame
        self._every_s = HEARTBEAT_S
        self._next_s = 0.0

    @property
    def asks(self) -> bool:
        """The drive is asked by node guarding, so it must answer; else the host's heartbeat goes out."""
        return self._asks

    def feed(self) -> None:
        """One now; the next is due a while later."""
        if self._ended:
            return
        if self._guarding is not None and self._asks:
            self._guarding.feed()
        else:
            self._link.send(0x700 + self.host_node, bytes((OPERATIONAL,)))
        self._next_s = self._clock.now_s() + self._every_s

    def end(self) -> None:
        """None any more: the drive's watchdog is to act."""
        self._ended = True

    def feed_when_due(self, now_s: float) -> None:
        """Called in every cycle."""
        if now_s >= self._next_s:
            self.feed()

    def feed_between(self) -> None:
        """One more between two cycles: those that are due in control time stay due."""
        due_s = self._next_s
        self.feed()
        self._next_s = due_s

    def pace(self, every_s: float) -> None:
        """One every so often, at least."""
        self._every_s = min(HEARTBEAT_S, every_s)

    def keep_to(self, feed_s: float) -> None:
        """The watchdog is armed and wants one so often; 0: it isn't armed."""
        if not feed_s:                 # nobody is asked who may not hear it: not every adapter carries remote frames
            self._asks = False
        self.pace(feed_s or HEARTBEAT_S)

    def answered(self) -> bool:
        """Waits for the first answer of a guarded drive."""
        guarding = self._guarding
        return guarding is None or self._link.await_answer(lambda: guarding.answers > 0, ANSWER_S)


def _guarded(profile: CanopenProfile) -> bool:
    return profile.watchdog.kind == "node_guarding"
