"""Node guarding and life guarding, slave side, in plant time (CiA 301).

Every remote frame on 700h + node is answered with one byte: bit 7 toggles (0 in the first answer after a reset), bits
0 to 6 are the NMT state. With 100Ch and 100Dh both set, the first question begins the life guarding: their product, in
ms, is the time after which a host that doesn't ask counts as dead.
"""


class LifeGuard:
    """What is set, when the host asked last, and which toggle comes next."""

    def __init__(self) -> None:
        self.guard_ms = 0
        self.factor = 0
        self.alive = False
        self._last_us = 0
        self._toggle = 0

    def set_guard(self, milliseconds: int) -> None:
        """100Ch; supervision waits for a question again."""
        self.guard_ms = milliseconds
        self.alive = False

    def set_factor(self, factor: int) -> None:
        """100Dh; supervision waits for a question again."""
        self.factor = factor
        self.alive = False

    def answer(self, state: int) -> bytes:
        """The byte that answers a question."""
        byte, self._toggle = self._toggle | state, self._toggle ^ 0x80
        return bytes([byte])

    def asked(self, now_us: int) -> bool:
        """A question came; True where supervision begins with it."""
        if not self.guard_ms * self.factor:
            return False
        first, self.alive = not self.alive, True
        self._last_us = now_us
        return first

    def expired(self, now_us: int) -> bool:
        """True once, when the life time has run out."""
        if self.alive and now_us - self._last_us >= 1000 * self.guard_ms * self.factor:
            self.alive = False
            return True
        return False

    def reset(self) -> None:
        """Boot-up: the toggle begins at 0 again, nothing is supervised."""
        self._toggle = 0
        self.alive = False
