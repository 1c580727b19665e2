"""Error register 1001h, error history 1003h, error code 603Fh, and the message that reports them (CiA 301), on any bus.

::

    EMCY    byte 0 1 error code, little-endian · 2 error register · 3..7 manufacturer's, 0 here
"""

from collections.abc import Callable
from struct import Struct

from canopen.sdo import SdoAbortedError

from sim_bus.objects import ABORT_NO_DATA, ABORT_VALUE, ObjectStore, key_of

GENERIC = 0x01
COMMUNICATION = 0x10
HOST_LOST = 0x8130
"""Error code of a drive that lost its host: heartbeat error of CiA 301, or no process data while torque may flow."""
PDO_TOO_SHORT = 0x8210
_EMCY = Struct("<HB5x")
_HISTORY = 8


class Emergency:
    """Present and past errors of the drive."""

    def __init__(self, store: ObjectStore, send: Callable[[bytes], None]) -> None:
        self.register = 0
        self.code = 0
        self._history: list[int] = []
        self._send = send
        store.live[key_of(0x1001)] = lambda: self.register
        store.live[key_of(0x603F)] = lambda: self.code
        store.live[key_of(0x1003)] = lambda: len(self._history)
        store.hooks[key_of(0x1003)] = self._clear_history
        for number in range(_HISTORY):
            self._bind(store, number)

    def _bind(self, store: ObjectStore, number: int) -> None:
        def read() -> int:
            if number >= len(self._history):
                raise SdoAbortedError(ABORT_NO_DATA)
            return self._history[number]

        store.live[key_of(0x1003, number + 1)] = read

    def report(self, code: int, register: int, *, lasting: bool = True) -> None:
        """Send an EMCY and record it. An error that is not ``lasting`` is not kept in 1001h and 603Fh."""
        if lasting:
            self.register |= register | GENERIC
            self.code = code
        self._history = [code, *self._history][:_HISTORY]
        self._send(_EMCY.pack(code, self.register | register | GENERIC))

    def reset(self) -> None:
        """Clear all errors, and report that if there was one."""
        if self.register or self.code:
            self.register = self.code = 0
            self._send(_EMCY.pack(0, 0))

    def forget(self) -> None:
        """Switch on: no error, no history, no message."""
        self.register = self.code = 0
        self._history = []

    def _clear_history(self, value: int) -> None:
        if value:
            raise SdoAbortedError(ABORT_VALUE)
        self._history = []
