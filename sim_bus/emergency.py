"""Error register 1001h, error history 1003h, error code 603Fh and the EMCY that tells of them (CiA 301).

::

    EMCY    byte 0 1 error code, little-endian · 2 error register · 3..7 manufacturer's, 0 here
"""

from collections.abc import Callable
from struct import Struct

from canopen.sdo import SdoAbortedError

from sim_bus.canopen.objects import ABORT_NO_DATA, ABORT_VALUE, ObjectStore, key_of

GENERIC = 0x01
COMMUNICATION = 0x10
HEARTBEAT_LOST = 0x8130
PDO_TOO_SHORT = 0x8210
_EMCY = Struct("<HB5x")
_HISTORY = 8


class Emergency:
    """What is wrong at present, and what was."""

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
        """Sends an EMCY and notes it; what is not ``lasting`` leaves no trace in 1001h and 603Fh."""
        if lasting:
            self.register |= register | GENERIC
            self.code = code
        self._history = [code, *self._history][:_HISTORY]
        self._send(_EMCY.pack(code, self.register | register | GENERIC))

    def reset(self) -> None:
        """Nothing is wrong any more; says so where something was."""
        if self.register or self.code:
            self.register = self.code = 0
            self._send(_EMCY.pack(0, 0))

    def forget(self) -> None:
        """Power-on: no error, no history, no message."""
        self.register = self.code = 0
        self._history = []

    def _clear_history(self, value: int) -> None:
        if value:
            raise SdoAbortedError(ABORT_VALUE)
        self._history = []
