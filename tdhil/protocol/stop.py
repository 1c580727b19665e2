"""The one stop sequence, for every cause and for the normal end.

1. Quick stop under the drive's speed control; where the profile says that a quick stop does not decelerate from
   torque mode, speed mode at zero first.
2. Wait for standstill, by status word and by speed. The reported speed lags, so it must stay at zero for longer
   than the largest plausible lag.
3. With a drill string, bring trapped torque down under speed control (a later protocol).
4. Only then disable, and confirm.

A turning shaft is never disabled from here. If the drive can't be reached, its own watchdog must act, and that
is what the report says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers.drive import Command, Mode, PowerState, Sample
from drivers.errors import StopNotConfirmed
from tdhil.protocol.bench import Bench
from tdhil.protocol.settings import ControlAssumptions, MachineLimits

AT_REST_SHARE = 0.005
"""Standstill is a speed below this share of the speed limit, or three quanta if that is more."""

LONGEST_GAP_S = 0.2
"""Standstill must have been watched without a longer gap in the feedback."""

SILENT_S, SILENT_CYCLES = 1.0, 25
"""After so long, and so many cycles, without any feedback the drive can't be reached: its watchdog stops the shaft."""

_NO_TORQUE = (PowerState.OFF, PowerState.READY, PowerState.FAULT, PowerState.NOT_READY)


@dataclass(frozen=True)
class StopReport:
    """How the stop went. ``confirmed``: seen at rest and disabled."""

    confirmed: bool
    at_rest_s: float | None            # control time at which the shaft was seen at rest
    disabled: bool
    trouble: tuple[str, ...] = ()


class StopSequence:
    """Runs once; a second call gives the first one's report."""

    def __init__(
        self,
        bench: Bench,
        limits: MachineLimits,
        speed_resolution_rad_s: float,
        quick_stop_in_torque_mode: bool,
        assumptions: ControlAssumptions | None = None,
    ) -> None:
        assumptions = assumptions or ControlAssumptions()
        self._bench = bench
        self._limits = limits
        self._at_rest_rad_s = max(3.0 * speed_resolution_rad_s, AT_REST_SHARE * limits.speed_max_rad_s)
        self._settle_s = 3.0 * assumptions.largest_speed_lag_s
        self._quick_stop_in_torque_mode = quick_stop_in_torque_mode
        self._trouble: list[str] = []
        self._silent = 0
        self._enough_silent = max(SILENT_CYCLES, bench.cycles(SILENT_S))
        self._report: StopReport | None = None

    def run(self) -> StopReport:
        """Bring the shaft to rest and disable. Never raises; what went wrong is in the report."""
        if self._report is None:
            self._bench.guard.expected = None
            at_rest_s = self._decelerate()
            disabled = self._disable() if at_rest_s is not None else False
            self._report = StopReport(at_rest_s is not None and disabled, at_rest_s, disabled, tuple(self._trouble))
        return self._report

    def _decelerate(self) -> float | None:
        command = Command(Mode.SPEED, 0.0, 0.0)
        if not self._quick_stop_in_torque_mode:
            for _ in range(self._bench.cycles(0.5)):
                sample = self._exchange(command)
                if sample is not None and sample.mode is Mode.SPEED:
                    break
        asked = self._ask(self._bench.drive.quick_stop)
        # The ramp from the highest speed, with as much again for a drive at its torque limit, and the settling.
        slowest_s = 3.0 * self._limits.speed_max_rad_s / self._limits.quick_stop_rad_s2 + 2.0 * self._settle_s + 1.0
        quiet_since_s: float | None = None
        heard_s = 0.0
        for _ in range(self._bench.cycles(slowest_s)):
            asked = asked or self._ask(self._bench.drive.quick_stop)
            sample = self._exchange(command)
            if sample is None:
                if self._silent >= self._enough_silent:
                    return None
                continue
            # Single lost frames don't unsay what the others showed; a longer gap does.
            unheard_s, heard_s = sample.time_s - heard_s, sample.time_s
            if abs(sample.speed_rad_s) > self._at_rest_rad_s:
                quiet_since_s = None
            elif quiet_since_s is None or unheard_s > LONGEST_GAP_S:
                quiet_since_s = sample.time_s
            elif sample.time_s - quiet_since_s >= self._settle_s and (sample.standstill or sample.state in _NO_TORQUE):
                return sample.time_s
        self._trouble.append(f"the shaft was not seen at rest within {slowest_s:.1f} s of the quick stop")
        return None

    def _disable(self) -> bool:
        asked = self._ask(self._bench.drive.disable)
        command = Command(Mode.SPEED, 0.0, 0.0)
        for _ in range(self._bench.cycles(3.0)):
            asked = asked or self._ask(self._bench.drive.disable)
            sample = self._exchange(command)
            if sample is not None and sample.fresh and sample.state in (PowerState.OFF, PowerState.FAULT):
                return True
            if self._silent >= self._enough_silent:
                break
        self._trouble.append("the drive did not confirm that it is disabled")
        return False

    def _ask(self, request: Callable[[], None]) -> bool:
        """Whether the drive took a request; one that fails is made again in the next cycle."""
        try:
            request()
        except Exception as error:  # whatever it is, the stop goes on
            self._note(error)
            return False
        return True

    def _note(self, error: Exception) -> None:
        if len(self._trouble) < 20:
            self._trouble.append(str(error))

    def _exchange(self, command: Command) -> Sample | None:
        try:
            sample = self._bench.stop_cycle(command)
        except Exception as error:  # whatever it is, the stop goes on
            self._silent += 1
            self._note(error)
            return None
        self._silent = 0 if sample.fresh else self._silent + 1
        return sample if sample.fresh else None


def not_confirmed(report: StopReport) -> StopNotConfirmed:
    """The loudest error there is."""
    return StopNotConfirmed(
        "the stop was NOT confirmed: " + (report.trouble[-1] if report.trouble else "no standstill seen"),
        where="stop sequence",
        next_step="Use the hard-wired emergency stop now. The drive's own watchdog stops the shaft if it was armed",
    )
