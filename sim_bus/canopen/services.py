"""Heartbeat, guarding and NMT, slave side (CiA 301)."""

from enum import IntEnum

# ---------------------------------------------------------------------------------------------------------------------
# Heartbeat in both directions, in plant time: 1017h sends the drive's, 1016h:1 supervises the host's (CiA 301).


class HeartbeatConsumer:
    """Supervision of one node, from its first heartbeat on. `expired` reports once that the node has fallen silent."""

    def __init__(self) -> None:
        self.setting = 0
        self.cob_id = -1
        self.alive = False
        self._timeout_us = 0
        self._last_us = 0

    def configure(self, value: int) -> None:
        """Set 1016h:1 = node << 16 | milliseconds; 0 in either switches off. Supervision waits for a
        heartbeat again.
        """
        self.setting = value
        node, milliseconds = value >> 16 & 0xFF, value & 0xFFFF
        active = 1 <= node <= 127 and milliseconds > 0
        self.cob_id = 0x700 + node if active else -1
        self._timeout_us = 1000 * milliseconds
        self.alive = False

    def beat(self, now_us: int) -> bool:
        """Record a heartbeat. Return True for the first one, and for the first after a silence."""
        first, self.alive = not self.alive, True
        self._last_us = now_us
        return first

    def expired(self, now_us: int) -> bool:
        """Return True once after the time has passed."""
        if self.alive and now_us - self._last_us >= self._timeout_us:
            self.alive = False
            return True
        return False


class HeartbeatProducer:
    """Timer of the drive's own heartbeat."""

    def __init__(self) -> None:
        self._period_us = 0
        self._next_us = 0
        self._now_us = 0

    @property
    def active(self) -> bool:
        """True if the heartbeat is switched on."""
        return self._period_us > 0

    def configure(self, milliseconds: int) -> None:
        """Set 1017h. 0 switches off; otherwise the first heartbeat is due at once."""
        self._period_us = 1000 * milliseconds
        self._next_us = self._now_us

    def due(self, now_us: int) -> bool:
        """Return True if a heartbeat must be sent now. Several missed heartbeats count as one."""
        self._now_us = now_us
        if not self._period_us or now_us < self._next_us:
            return False
        self._next_us = max(self._next_us + self._period_us, now_us + 1)
        return True


# ---------------------------------------------------------------------------------------------------------------------
# Node guarding and life guarding, slave side, in plant time (CiA 301).
#
# Every remote frame on 700h + node is answered with one byte: bit 7 toggles (0 in the first answer after a reset), bits
# 0 to 6 are the NMT state. If 100Ch and 100Dh are both set, the first request begins the life guarding: their product,
# in ms, is the time after which a host without requests counts as dead.


class LifeGuard:
    """Life guarding: its settings, the time of the host's last request, and the next toggle."""

    def __init__(self) -> None:
        self.guard_ms = 0
        self.factor = 0
        self.alive = False
        self._last_us = 0
        self._toggle = 0

    def set_guard(self, milliseconds: int) -> None:
        """Set 100Ch. Supervision waits for a request again."""
        self.guard_ms = milliseconds
        self.alive = False

    def set_factor(self, factor: int) -> None:
        """Set 100Dh. Supervision waits for a request again."""
        self.factor = factor
        self.alive = False

    def answer(self, state: int) -> bytes:
        """Return the byte that answers a request."""
        byte, self._toggle = self._toggle | state, self._toggle ^ 0x80
        return bytes([byte])

    def asked(self, now_us: int) -> bool:
        """Record a request. Return True if supervision begins with it."""
        if not self.guard_ms * self.factor:
            return False
        first, self.alive = not self.alive, True
        self._last_us = now_us
        return first

    def expired(self, now_us: int) -> bool:
        """Return True once after the life time has passed."""
        if self.alive and now_us - self._last_us >= 1000 * self.guard_ms * self.factor:
            self.alive = False
            return True
        return False

    def reset(self) -> None:
        """Boot: the toggle bit starts at 0 again, and supervision ends."""
        self._toggle = 0
        self.alive = False


# ---------------------------------------------------------------------------------------------------------------------

class NmtState(IntEnum):
    """Byte of a heartbeat; 0 is the boot-up message."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class NmtCommand(IntEnum):
    """First byte of a frame with identifier 0."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class Nmt:
    """NMT state, and its change by a command."""

    def __init__(self) -> None:
        self.state = NmtState.INITIALISING

    def obey(self, code: int) -> NmtCommand | None:
        """Execute a command. Return it; None for an unknown one. After a reset the node itself leaves initialising."""
        try:
            command = NmtCommand(code)
        except ValueError:
            return None
        self.state = {
            NmtCommand.START: NmtState.OPERATIONAL,
            NmtCommand.STOP: NmtState.STOPPED,
            NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
        }.get(command, NmtState.INITIALISING)
        return command
