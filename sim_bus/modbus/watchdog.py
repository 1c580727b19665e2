"""The drive's supervision of its host: begins with the first message that feeds it, acts once when none comes. Pure."""

from profiles.modbus import ModbusWatchdog

_OWN = "_of_this_connection"


class Watchdog:
    """What feeds it, and for how long it waits."""

    def __init__(self, watchdog: ModbusWatchdog) -> None:
        self._fed_by = watchdog.fed_by.removesuffix(_OWN)
        self._own_only = watchdog.fed_by.endswith(_OWN)
        self._commander: int | None = None
        self._fed_s: float | None = None
        self.lost = False
        """The host has been found silent, and hasn't been heard since."""

    def heard(self, time_s: float, *, wrote: bool, commanded: bool, connection: int = 0) -> None:
        """A request for this drive came; ``connection`` tells clients apart: the first that commands is the host."""
        if commanded and (self._commander is None or self.lost):
            self._commander = connection
        if self._own_only and connection != self._commander:
            return
        if {"writes": wrote, "control_word": commanded}.get(self._fed_by, True):
            self._fed_s = time_s
            self.lost = False

    def expired(self, time_s: float, timeout_s: float) -> bool:
        """The host has just been silent for too long; 0 s switches the supervision off."""
        if self._fed_s is None or timeout_s <= 0.0 or time_s - self._fed_s < timeout_s:
            return False
        self._fed_s = None
        self.lost = True
        return True
