"""Heartbeat both ways in plant time: 1017h sends ours, 1016h:1 watches the host's (CiA 301)."""


class HeartbeatConsumer:
    """Supervision of one node, begun by its first heartbeat; `expired` says once that it has fallen silent."""

    def __init__(self) -> None:
        self.setting = 0
        self.cob_id = -1
        self.alive = False
        self._timeout_us = 0
        self._last_us = 0

    def configure(self, value: int) -> None:
        """1016h:1 = node << 16 | milliseconds; 0 in either switches off. Supervision waits for a heartbeat again."""
        self.setting = value
        node, milliseconds = value >> 16 & 0xFF, value & 0xFFFF
        active = 1 <= node <= 127 and milliseconds > 0
        self.cob_id = 0x700 + node if active else -1
        self._timeout_us = 1000 * milliseconds
        self.alive = False

    def beat(self, now_us: int) -> bool:
        """A heartbeat came; True where it is the first one, or the first after a silence."""
        first, self.alive = not self.alive, True
        self._last_us = now_us
        return first

    def expired(self, now_us: int) -> bool:
        """True once, when the time has run out."""
        if self.alive and now_us - self._last_us >= self._timeout_us:
            self.alive = False
            return True
        return False


class HeartbeatProducer:
    """When our own heartbeat is due."""

    def __init__(self) -> None:
        self._period_us = 0
        self._next_us = 0
        self._now_us = 0

    @property
    def active(self) -> bool:
        """It is switched on."""
        return self._period_us > 0

    def configure(self, milliseconds: int) -> None:
        """1017h; 0 switches off, otherwise the first one is due at once."""
        self._period_us = 1000 * milliseconds
        self._next_us = self._now_us

    def due(self, now_us: int) -> bool:
        """True when one has to be sent now; several missed ones are one."""
        self._now_us = now_us
        if not self._period_us or now_us < self._next_us:
            return False
        self._next_us = max(self._next_us + self._period_us, now_us + 1)
        return True
