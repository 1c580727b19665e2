"""The simulated Modbus drive in the host's own process and time: no socket, no thread, no wall clock.

A request takes its time on the line, the drive acts on it, and the reply takes its time back. The sender waits in
control time until the reply is complete, and this wait advances the plant.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from profiles.modbus import BusLine, ModbusProfile
from sim_bus.fault_script import Scripted
from sim_bus.modbus.codec import BROADCAST
from sim_bus.modbus.faults import Faults, tells_stage, wrongs_of
from sim_bus.modbus.machine import Machine
from sim_bus.modbus.wrong_maps import Wrong
from sim_bus.params import RigParams

# ---------------------------------------------------------------------------------------------------------------------
# Duration of a request and its reply on the line, s. Pure.
#
# RTU: a character is 11 bits (start, 8, parity, stop; or two stops). A frame is unit + PDU + two of CRC. Its end is
# known after 3.5 characters of silence, 1.75 ms above 19,200 baud (Modbus over serial line, section 2.5.1.1). TCP: no
# characters, but a latency in each direction, and a jitter in addition.
#
# ::
#
#     |silence| request | silence | turn-around | reply | silence | next request


CHARACTER_BITS = 11
_FRAME = 3
"""Length of unit and CRC, characters."""
_FIXED_SILENCE_S = 0.00175
_FIXED_ABOVE_BAUD = 19200
TCP_LATENCY_S = 0.0005
TCP_JITTER_S = 0.0003


@dataclass(frozen=True, slots=True)
class LineTiming:
    """Timing of one line with a drive at its end."""

    character_s: float = 0.0
    silence_s: float = 0.0
    """Silence between two frames, s."""
    turn_around_s: float = 0.0
    """Time from the end of a request at the drive to the first character of its reply, s."""
    latency_s: float = 0.0
    """Latency in each direction, s."""
    jitter_s: float = 0.0
    """Largest addition to the latency in each direction, s."""

    @classmethod
    def rtu(cls, baud: int, turn_around_s: float) -> Self:
        """Return the timing of a serial line."""
        character_s = CHARACTER_BITS / baud
        silence_s = _FIXED_SILENCE_S if baud > _FIXED_ABOVE_BAUD else 3.5 * character_s
        return cls(character_s=character_s, silence_s=silence_s, turn_around_s=turn_around_s)

    @classmethod
    def tcp(cls, turn_around_s: float, latency_s: float = TCP_LATENCY_S, jitter_s: float = TCP_JITTER_S) -> Self:
        """Return the timing of a network."""
        return cls(turn_around_s=turn_around_s, latency_s=latency_s, jitter_s=jitter_s)

    @classmethod
    def of(cls, line: BusLine) -> Self:
        """Return the timing of the line that a profile describes: TCP if the profile has it."""
        if "tcp" in line.transports:
            return cls.tcp(line.turn_around_s)
        return cls.rtu(line.baud, line.turn_around_s)

    def way_s(self, pdu_bytes: int, chance: float) -> float:
        """Return the time from first to last character of a frame, with the network, s; ``chance`` in [0, 1): its
        jitter.
        """
        return (pdu_bytes + _FRAME) * self.character_s + self.latency_s + chance * self.jitter_s

    def acts_after_s(self, pdu_bytes: int, chance: float) -> float:
        """Return the time from the first character of a request until the drive acts and begins to reply, s."""
        return self.way_s(pdu_bytes, chance) + self.silence_s + self.turn_around_s


# ---------------------------------------------------------------------------------------------------------------------

AT_REST_RAD_S = 0.01
RESTING_S, LONGEST_S = 1.2, 60.0
"""Duration of standstill after which a shaft without a host is no longer simulated, and longest simulated time, s."""
_LOOK_S = 0.1


class EmbeddedModbusDrive:
    """A drive with ``profile``, at the end of a line with ``timing`` (by default that of the profile).

    ``script``: result of `sim_bus.modbus.faults.parse_all`. Raises TdhilError if it does not fit the profile.
    """

    def __init__(self, params: RigParams, profile: ModbusProfile, *, unit: int = 1, seed: int = 0,
                 trace: Path | None = None, timing: LineTiming | None = None, wrongs: tuple[Wrong, ...] = (),
                 script: tuple[Scripted, ...] = ()) -> None:
        self.unit = unit
        self.timing = timing if timing is not None else LineTiming.of(profile.line)
        wrongs += wrongs_of(script, [one.name for one in profile.parameters])
        self.machine = Machine(params, profile, seed=seed, trace=trace, wrongs=wrongs, stepped=True)
        self._faults = Faults(self.machine, profile, script, seed)
        self._chances = np.random.default_rng((seed, 1))
        self._free_s = 0.0              # time from which the line has been silent long enough
        self._time_s = 0.0
        self._closed = False

    @property
    def time_s(self) -> float:
        """Control time up to which the drive has run, s."""
        return self._time_s

    @property
    def speed_rad_s(self) -> float:
        """Speed of the true shaft, rad/s."""
        return self.machine.inverter.speed_rad_s

    @property
    def faults_waiting(self) -> tuple[str, ...]:
        """Scripted faults that have not begun yet, as they were written."""
        return self._faults.waiting

    @property
    def rated_torque_nm(self) -> float:
        """100 % torque, N·m."""
        return self.machine.parameters.rated_torque_nm

    @property
    def untold(self) -> Mapping[str, float]:
        """Values of the parameters without a register, as rig.yaml would have to state them."""
        return self.machine.parameters.untold

    def serve(
        self, unit: int, pdu: bytes, now_s: float, connection: int = 0
    ) -> tuple[bytes | None, float]:
        """Serve a request sent at ``now_s``. Return its reply and the time when it is complete; None without an answer.

        ``connection`` distinguishes clients. The plant has then run up to the moment at which the drive acted. A busy
        line delays the request.
        """
        if unit == self.unit and tells_stage(pdu):  # the stage belongs to the rehearsal: it takes no time on the line
            self.run_until(now_s)
            return self._faults.request(pdu).pdu, now_s
        timing = self.timing
        acts_s = max(now_s, self._free_s) + timing.acts_after_s(len(pdu), self._chances.random())
        self.run_until(acts_s)
        if unit not in {self.unit, BROADCAST}:
            self._free_s = acts_s
            return None, acts_s
        reply = self._faults.request(pdu, connection)
        heard = None if reply.crc_bits else reply.pdu      # a host's receiver drops a frame with a wrong CRC
        if unit == BROADCAST or heard is None:
            self._free_s = acts_s
            return None, acts_s
        complete_s = acts_s + timing.way_s(len(heard), self._chances.random())
        self._free_s = complete_s + timing.silence_s
        return heard, complete_s + reply.late_s

    def run_until(self, time_s: float) -> None:
        """Advance the plant. A watchdog that becomes due acts on the way."""
        if time_s > self._time_s:
            self._time_s = time_s
            self.machine.run_until(time_s)

    def run_on(self) -> None:
        """Advance the plant without a host until the shaft has been at standstill for a while, or a long time is over.

        The drive then acts by its watchdog, and the trace records it.
        """
        end_s, resting_s = self._time_s + LONGEST_S, 0.0
        while not self._closed and resting_s < RESTING_S and self._time_s < end_s:
            self.run_until(self._time_s + _LOOK_S)
            resting_s = resting_s + _LOOK_S if abs(self.speed_rad_s) < AT_REST_RAD_S else 0.0

    def close(self) -> None:
        """Close the trace; safe to repeat."""
        self._closed = True
        self.machine.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
