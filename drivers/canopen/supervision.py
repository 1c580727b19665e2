"""Supervision of a node during a run: heartbeat, boot-up, emergency messages, and the host's sign of life."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable

from drivers.canopen.bus import CanLink
from drivers.cia402 import DriveWatch
from drivers.clock import Clock
from drivers.errors import CommunicationLost
from profiles import MessageCode
from profiles.canopen import CanopenProfile

BOOT_UP = 0x00
STOPPED = 0x04
OPERATIONAL = 0x05
PRE_OPERATIONAL = 0x7F

_NMT_NAMES = {STOPPED: "stopped", OPERATIONAL: "operational", PRE_OPERATIONAL: "pre-operational"}

FOREIGN_FRAMES, FOREIGN_S = 3, 1.0
"""Number of foreign frames, with an identifier that only the drive sends, and time, s. So many frames within this time
show a second drive."""
FOREIGN_IN_A_RUN = 2
"""Number of frames of one kind that shows another node, if only this host sends that kind (SYNC, the drive's RPDOs, the
host's heartbeat). The time between the frames does not matter: CAN's checksum excludes an accident. Before the start
`FOREIGN_FRAMES` are required, because frames from the queue of another run may still arrive."""

START_GRACE_S = 0.5
"""Time after the start of the node, s, in which a heartbeat may still report pre-operational: it was in transit."""


class NodeWatch(DriveWatch):
    """Supervision of one node. Its sign of life is its heartbeat.

    With node guarding, `Guarding` passes the answers on as if they were heartbeats.
    """

    def __init__(self, node: int, clock: Clock) -> None:
        super().__init__(f"node {node}", clock)
        self._node = node
        self._foreign_s: deque[float] = deque(maxlen=FOREIGN_FRAMES)
        self.foreign: Counter[str] = Counter()     # foreign frames since the start, by kind
        self._contradicted_s: deque[float] = deque(maxlen=FOREIGN_FRAMES)
        self._started_s = 0.0
        self._operational = False
        self.nmt_state: int | None = None      # latest state that the drive reported; None before
        self.sign_of_life: Callable[[], tuple[str, str]] = lambda: ("heartbeat has been missing", "1017h")

    def on_heartbeat(self, data: bytes) -> None:
        """Handle 700h + node: the NMT state, or 0 for boot-up."""
        if not data:
            return
        state = data[0] & 0x7F
        self.heard()
        self.nmt_state = state
        if state == BOOT_UP:
            self.restarted(" (boot-up message)")
        elif not self.expect_operational:
            return
        elif state == OPERATIONAL:
            self._operational = True
        elif self._operational or self._clock.now_s() - self._started_s > START_GRACE_S:
            self.taken_out(f"NMT state {_NMT_NAMES.get(state, state)}")

    def on_foreign(self, kind: str, why: str = "") -> None:
        """Handle a frame of a kind that only this host sends: another master drives this drive, or is about to.

        ``kind``: name for messages; ``why``: its effect, if it is not a master's frame.
        """
        self.foreign[kind] += 1
        if self.expect_operational:
            certain = self.foreign[kind] >= FOREIGN_IN_A_RUN
        else:
            certain = self._no_accident(self._foreign_s)
        if certain:
            self.interference(
                why or f"a second master is on the bus: it sends {kind}",
                f"node {self._node}",
                "Disconnect it from the bus, or give it other identifiers, and start again",
                kind="master",
            )

    def on_contradiction(self) -> None:
        """Handle a feedback frame that contradicts an earlier one for the same SYNC: one of them is foreign."""
        if self._no_accident(self._contradicted_s):
            self.keep(
                "feedback",
                CommunicationLost(
                    "several different feedback frames come for one SYNC: another node sends them too",
                    where=f"node {self._node}, TPDO1 ({0x180 + self._node:03X}h)",
                    next_step="Check for a duplicate node-ID, or a recording that is played back; start again",
                    entry=MessageCode.FOREIGN_MASTER,
                ),
            )

    def silence(self) -> tuple[str, str, str]:
        """Return what is missing: the heartbeat, or the answers to node guarding."""
        missing, where = self.sign_of_life()
        return f"the drive's {missing}", f"{self.place}, {where}", "Check the drive's supply and the bus"

    def start(self, allowed_silence_s: float) -> None:
        """Treat silence, boot-up, EMCY and foreign NMT commands as errors from now on."""
        self._started_s = self._clock.now_s()
        self._operational = False
        self.foreign.clear()
        super().start(allowed_silence_s)

    def _no_accident(self, seen_s: deque[float]) -> bool:
        """Count one more event. Return whether `FOREIGN_FRAMES` came within `FOREIGN_S`."""
        now_s = self._clock.now_s()
        seen_s.append(now_s)
        return len(seen_s) == FOREIGN_FRAMES and now_s - seen_s[0] <= FOREIGN_S


# ---------------------------------------------------------------------------------------------------------------------
# Node guarding, the host's side (CiA 301): the watchdog of drives without a heartbeat consumer.
#
# ::
#
#     host   700h + node, remote frame     ─►  the drive restarts its life time (100Ch x 100Dh)
#     drive  700h + node, toggle | state   ─►  bit 7 changes with every answer, bits 0 to 6 are the NMT state
#
# The control loop itself sends the requests, so that a frozen or dead host is silent and the drive's watchdog trips. An
# answer without a toggle does not count: it is an old frame, or the frame of another station. `NodeWatch` checks the
# state and the longest time without an answer.


class Guarding:
    """Node guarding by this host; ``ask`` puts the remote frame on the bus."""

    def __init__(self, watch: NodeWatch, ask: Callable[[], None]) -> None:
        self._watch = watch
        self._ask = ask
        self._toggle: int | None = None
        self.asked = self.answers = self.repeated = 0
        watch.sign_of_life = self._missing

    def feed(self) -> None:
        """Send one request."""
        self.asked += 1
        self._ask()

    def on_frame(self, data: bytes) -> None:
        """Handle 700h + node from the drive."""
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


# ---------------------------------------------------------------------------------------------------------------------
# The host's sign of life for the drive's watchdog: a heartbeat, or a request of node guarding.
#
# Only the control loop sends it, neither a thread nor the kernel, which would outlive a frozen loop.


HEARTBEAT_S = 0.1
"""Heartbeat period in both directions, s. The host's is shorter if the watchdog is shorter than five of them."""
ANSWER_S = 0.2
"""Wall time for the answer to the first request of node guarding, s."""


class SignOfLife:
    """Heartbeat of ``host_node``, or node guarding of ``node`` with the answers from the link."""

    def __init__(
        self, link: CanLink, watch: NodeWatch, clock: Clock, profile: CanopenProfile, *, node: int, host_node: int
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
        """True if node guarding supervises the drive, so that it must answer. Otherwise the host sends a heartbeat."""
        return self._asks

    def feed(self) -> None:
        """Send a sign of life now. The next is due one period later."""
        if self._ended:
            return
        if self._guarding is not None and self._asks:
            self._guarding.feed()
        else:
            self._link.send(0x700 + self.host_node, bytes((OPERATIONAL,)))
        self._next_s = self._clock.now_s() + self._every_s

    def end(self) -> None:
        """End the sign of life, so that the drive's watchdog trips."""
        self._ended = True

    def feed_when_due(self, now_s: float) -> None:
        """Send a sign of life if it is due; called in every cycle."""
        if now_s >= self._next_s:
            self.feed()

    def feed_between(self) -> None:
        """Send one additional sign of life between two cycles. It does not change the time at which the next is due."""
        due_s = self._next_s
        self.feed()
        self._next_s = due_s

    def pace(self, every_s: float) -> None:
        """Set the period to ``every_s``, s, but at most to `HEARTBEAT_S`."""
        self._every_s = min(HEARTBEAT_S, every_s)

    def keep_to(self, feed_s: float) -> None:
        """Set the period at which the armed watchdog must be fed, s; 0: it is not armed."""
        if not feed_s:                 # not every adapter carries remote frames
            self._asks = False
        self.pace(feed_s or HEARTBEAT_S)

    def answered(self) -> bool:
        """Wait for the first answer of a guarded drive. Return whether it came."""
        guarding = self._guarding
        return guarding is None or self._link.await_answer(lambda: guarding.answers > 0, ANSWER_S)


def _guarded(profile: CanopenProfile) -> bool:
    return profile.watchdog.kind == "node_guarding"
