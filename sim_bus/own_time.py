"""Time of a simulated drive beside the cycles of its host, on any bus. Pure: the caller states the time of its clock.

In stepped time only the host's cycles advance the plant, unless the host is silent. Then the drive continues in its own
time, so that its watchdog acts and the shaft comes to standstill. New frames return it to stepped time. Before the
first cycle time stands still.
"""

from sim_bus.object_drive import ObjectDrive
from sim_bus.timed_drive import CHUNK_US


class OwnTime:
    """The drive's own time. The host counts as silent after ``silence_s`` of the caller's clock without a frame."""

    def __init__(self, drive: ObjectDrive, silence_s: float) -> None:
        self._drive = drive
        self.silence_s = silence_s
        self._running_on = False           # stepped, but the host is silent
        self._plant_s: float | None = None     # time of the caller's clock up to which the plant has run
        self.silent_s = 0.0

    @property
    def runs(self) -> bool:
        """True if the caller's clock advances the plant, and not the host's cycles."""
        return self._running_on or not self._drive.stepped

    def heard(self, now_s: float) -> float:
        """Record a frame of the host. Return the lead of the caller's clock over the plant, s."""
        lead_s = self.follow(now_s)
        self.silent_s = 0.0
        if self._running_on:
            self._running_on = False
            self._drive.note("frames are back: stepped again")
        return lead_s

    def waited(self, waited_s: float, now_s: float) -> None:
        """Record that no frame has come for ``waited_s``. A shorter time counts if the caller had no processor time."""
        self.silent_s += waited_s
        if self.silent_s >= self.silence_s:
            self.run_on("host silent: running on in own time", now_s)

    def run_on(self, why: str, now_s: float) -> None:
        """Let a stepped drive continue in its own time; ``why`` becomes a note in the trace."""
        self.silent_s = 0.0
        if self._drive.stepped and self._drive.cycled and not self._running_on:
            self._running_on, self._plant_s = True, now_s
            self._drive.note(why)

    def follow(self, now_s: float) -> float:
        """Advance the plant to the caller's clock, in whole chunks. Return the lead of that clock over the plant, s.

        In stepped time nothing advances, and there is no lead.
        """
        if self._plant_s is None or not self.runs:
            self._plant_s = now_s
            return 0.0
        chunks = int((now_s - self._plant_s) * 1e6) // CHUNK_US
        for _ in range(chunks):
            self._drive.advance_us(CHUNK_US)
        self._plant_s += chunks * CHUNK_US * 1e-6
        return now_s - self._plant_s
