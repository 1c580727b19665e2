"""Frames that a scripted fault holds back, in real time."""

import time
from typing import Generic, TypeVar

To = TypeVar("To")


class Late(Generic[To]):
    """Each with whom it is for, until it is due."""

    def __init__(self) -> None:
        self._held: list[tuple[float, To, bytes]] = []

    def put(self, to: To, frame: bytes, late_s: float) -> None:
        """Due so long from now."""
        self._held.append((time.monotonic() + late_s, to, frame))

    def due(self) -> list[tuple[To, bytes]]:
        """What is due by now, in the order in which it was put."""
        if not self._held:
            return []
        now_s = time.monotonic()
        due = [(to, frame) for at_s, to, frame in self._held if at_s <= now_s]
        self._held = [one for one in self._held if one[0] > now_s]
        return due
